"""Where the misfit is least: bounded least squares from a mesh of starts, and the minima that are found."""

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

# At zero depth the response does not depend on depth (to first order) or angle: starts stand this deep at least [m].
SHALLOWEST_START = 1e-6
# Minima this near (um, deg) are one; below this depth (um) whatever their angle.
SAME, SHALLOW = 0.1, 0.5
TOLERANCE = 1e-10
MOST_EVALUATIONS = 60
# Change of a refined minimum, in standard errors, below which it has settled, and the corrections it may take.
SETTLED, MOST_REFINEMENTS = 0.03, 12
# Corrections that determine the films' slopes anew; they change little from there on.
SLOPE_ROUNDS = 2


@dataclass(frozen=True)
class Minimum:
    """Scaled parameters at a minimum, the misfit there, and how many starts lead to it."""

    parameters: FloatArray
    chi2: float
    starts: int
    converged: bool
    evaluations: int


def start_mesh(settings: WearSettings, misfit: Misfit) -> list[FloatArray]:
    """Every start (n,), scaled: depths by angles, what is known of the other parameters at its mean."""
    model = misfit.model
    mean = np.array(model.known.mean) / model.scale[len(model.names) - misfit.n_known :]
    if DEPTH not in model.names:
        return [mean]
    depths = [max(depth, SHALLOWEST_START) for depth in settings.start_depths]
    scales = [model.scale[model.names.index(name)] for name in (DEPTH, ANGLE)]
    return [np.array([depth / scales[0], angle / scales[1], *mean]) for depth, angle in product(depths, settings.start_angles)]


def descend(misfit: Misfit, start: FloatArray, free: Sequence[int] | None = None, tolerance: float = TOLERANCE) -> Minimum:
    """The minimum that a start leads to, within the bounds; *free*: numbers of the parameters that move (default: all)."""
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
    found = least_squares(
        residual,
        np.clip(whole[moving], low + inward, high - inward),
        jacobian,
        (low, high),
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=MOST_EVALUATIONS,
    )
    return Minimum(full(found.x), 2 * float(found.cost), 1, found.status > 0, int(found.nfev))


def minima(misfit: Misfit, starts: Sequence[FloatArray]) -> list[Minimum]:
    """The distinct minima of all starts, the lowest first; FitError when no start leads anywhere."""
    found = sorted((descend(misfit, start) for start in starts), key=lambda one: (not one.converged, one.chi2))
    if not np.isfinite(found[0].chi2):
        raise FitError("no start leads to a finite misfit", hint="check the rotor file and the response")
    return merged(found)


def merged(found: Sequence[Minimum]) -> list[Minimum]:
    """The minima in their order, those at the same place as one."""
    distinct: list[Minimum] = []
    for one in found:
        near = next((n for n, other in enumerate(distinct) if _is_same(one.parameters, other.parameters)), None)
        if near is None:
            distinct.append(one)
        else:
            first = distinct[near]
            distinct[near] = replace(first, starts=first.starts + one.starts, evaluations=first.evaluations + one.evaluations)
    return distinct


def _is_same(one: FloatArray, other: FloatArray) -> bool:
    """Whether depth and angle agree; the angle of hardly any wear means nothing."""
    apart = np.abs(one - other)[:2]
    return bool(apart[0] < SAME and (np.max(apart) < SAME or max(one[0], other[0]) < SHALLOW))


def refined(misfit: Misfit, minimum: Minimum, free: Sequence[int] | None = None) -> tuple[Misfit, Minimum]:
    """A minimum of the films themselves instead of the tables: correct the tables where it lies, descend, and again.

    Where that does not settle, the minimum is marked as not converged.
    """
    for number in range(MOST_REFINEMENTS):
        before = minimum.parameters
        misfit = replace(misfit, model=misfit.model.refined(before, number < SLOPE_ROUNDS), _last=None)
        found = descend(misfit, before, free)
        minimum = replace(found, starts=minimum.starts, evaluations=minimum.evaluations + found.evaluations)
        moved = misfit.jacobian(minimum.parameters) @ (minimum.parameters - before)
        if np.linalg.norm(moved) < SETTLED:
            return misfit, minimum
    return misfit, replace(minimum, converged=False)
