"""Minima of the misfit: bounded least squares from a mesh of starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.wear.misfit import Misfit
from labpipe.wear.settings import ANGLE, DEPTH, WearSettings

# Least depth of a start [m]: at zero depth the response does not depend on depth (to first order) or angle.
SHALLOWEST_START = 1e-6
# Distance (um, deg) below which two minima are the same; below this depth (um) at any angle.
SAME, SHALLOW = 0.1, 0.5
TOLERANCE = 1e-10
# The same until the minima that starts share are known.
START_TOLERANCE = 1e-5
MOST_EVALUATIONS = 60
# Change of a refined minimum, in standard errors, that counts as converged, and the largest number of corrections.
SETTLED, MOST_REFINEMENTS = 0.03, 12
# The films' slopes cost several films each: they are computed once the last correction moved the minimum by less than NEAR standard
# errors, at the latest in round LATEST (from 0), and again after one that moves it by more than FAR, SLOPE_ROUNDS times at most.
NEAR, LATEST, FAR, SLOPE_ROUNDS = 3.0, 2, 1.0, 3


@dataclass(frozen=True)
class Minimum:
    """Scaled parameters (n,) [1] at a minimum, its chi-square, and the number of starts that lead to it."""

    parameters: FloatArray
    chi2: float
    starts: int
    converged: bool
    evaluations: int


def start_mesh(settings: WearSettings, misfit: Misfit) -> list[FloatArray]:
    """Every start (n,), scaled [1]: depths by angles, the other parameters at their prior mean; that alone where wear is known before."""
    model = misfit.model
    mean = np.array(model.prior.mean) / model.scale[len(model.names) - misfit.n_prior :]
    if DEPTH not in model.names or DEPTH in model.prior.names:
        return [mean]
    depths = [max(depth, SHALLOWEST_START) for depth in settings.start_depths]
    scales = [model.scale[model.names.index(name)] for name in (DEPTH, ANGLE)]
    return [np.array([depth / scales[0], angle / scales[1], *mean]) for depth, angle in product(depths, settings.start_angles)]


def descend(misfit: Misfit, start: FloatArray, free: Sequence[int] | None = None, tolerance: float = TOLERANCE) -> Minimum:
    """Minimum within the bounds from a scaled *start* (n,) [1]; *free*: indices of the parameters that move (default: all)."""
    moving = list(range(start.size)) if free is None else list(free)
    model, whole = misfit.model, np.array(start, float)
    low, high = model.low[moving], model.high[moving]

    def full(moved: FloatArray) -> FloatArray:
        point = whole.copy()
        point[moving] = moved
        return point

    if not moving:
        return Minimum(whole, misfit.chi2(whole), 1, True, 1)

    def residual(moved: FloatArray) -> FloatArray:
        return misfit.residual(full(moved))

    def jacobian(moved: FloatArray) -> FloatArray:
        return misfit.jacobian(full(moved))[:, moving]

    inward = 1e-6 * (high - low)
    solution = least_squares(
        residual,
        np.clip(whole[moving], low + inward, high - inward),
        jacobian,
        (low, high),
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=MOST_EVALUATIONS,
    )
    return Minimum(full(solution.x), 2 * float(solution.cost), 1, solution.status > 0, int(solution.nfev))


def minima(misfit: Misfit, starts: Sequence[FloatArray]) -> list[Minimum]:
    """The distinct minima of all scaled starts (n,) [1], the lowest first; FitError when no start leads to a finite misfit."""
    rough = _ranked([descend(misfit, start, tolerance=START_TOLERANCE) for start in starts])
    candidates = _ranked([_continued(misfit, minimum) for minimum in merged(rough)])
    if not np.isfinite(candidates[0].chi2):
        raise FitError("no start leads to a finite misfit", hint="check the rotor file and the response")
    return merged(candidates)


def _ranked(candidates: Sequence[Minimum]) -> list[Minimum]:
    return sorted(candidates, key=lambda minimum: (not minimum.converged, minimum.chi2))


def _continued(misfit: Misfit, minimum: Minimum) -> Minimum:
    """A minimum that was reached roughly, to the full tolerance."""
    if not minimum.converged:
        return minimum
    end = descend(misfit, minimum.parameters)
    return replace(end, starts=minimum.starts, evaluations=minimum.evaluations + end.evaluations)


def merged(candidates: Sequence[Minimum]) -> list[Minimum]:
    """The minima in their order, those at the same place merged."""
    distinct: list[Minimum] = []
    for candidate in candidates:
        near = next((n for n, other in enumerate(distinct) if _is_same(candidate.parameters, other.parameters)), None)
        if near is None:
            distinct.append(candidate)
        else:
            first = distinct[near]
            distinct[near] = replace(first, starts=first.starts + candidate.starts, evaluations=first.evaluations + candidate.evaluations)
    return distinct


def _is_same(first: FloatArray, second: FloatArray) -> bool:
    """True if depth and angle agree; below SHALLOW the angle is ignored."""
    apart = np.abs(first - second)[:2]
    return bool(apart[0] < SAME and (np.max(apart) < SAME or max(first[0], second[0]) < SHALLOW))


def refined(misfit: Misfit, minimum: Minimum, free: Sequence[int] | None = None, hopeless: float = np.inf) -> tuple[Misfit, Minimum]:
    """Minimum on the films instead of the tables: correct the tables at the minimum and descend, repeatedly.

    The first corrections have the tables' slopes, since they move the minimum furthest, the next one the films' own. The minimum is
    marked as not converged where this does not settle; beyond a chi-square that is *hopeless* it is left as it stands.
    """
    slopes, moved = 0, np.inf
    for number in range(MOST_REFINEMENTS):
        before = minimum.parameters
        with_slopes = slopes < SLOPE_ROUNDS and (moved > FAR if slopes else moved < NEAR or number >= LATEST)
        slopes += with_slopes
        misfit = replace(misfit, model=misfit.model.refined(before, with_slopes), _last=None)
        correction = descend(misfit, before, free)
        minimum = replace(correction, starts=minimum.starts, evaluations=minimum.evaluations + correction.evaluations)
        if minimum.chi2 > hopeless:
            break
        moved = float(np.linalg.norm(misfit.jacobian(minimum.parameters) @ (minimum.parameters - before)))
        if slopes and moved < SETTLED:
            return misfit, minimum
    return misfit, replace(minimum, converged=False)
