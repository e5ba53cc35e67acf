"""Minima of the misfit, profile intervals and joint regions, the probability of a healthy bearing, and what
the mesh of the films adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.distributions import chi2_quantile
from labpipe.errors import FitError
from labpipe.methods.wear.model import WornMisfit
from labpipe.methods.wear.settings import ANGLE, DEPTH, WearSettings

# Least depth of a start [m]: at zero depth the response does not depend on depth (to first order) or angle.
SHALLOWEST_START = 1e-6
# Distance (um, deg) below which two minima are the same; below this depth (um) at any angle.
SAME, SHALLOW = 0.1, 0.5
TOLERANCE = 1e-10
# The same until the minima that starts share are known.
START_TOLERANCE = 1e-5
MOST_EVALUATIONS = 60
# Change of a refined minimum, in standard errors, that counts as converged, and most corrections.
SETTLED, MOST_REFINEMENTS = 0.03, 12
# The films' slopes cost several films each: they are computed once a correction moved the minimum by less
# than NEAR standard errors or in round LATEST, again after a move beyond FAR, SLOPE_ROUNDS times at most.
NEAR, LATEST, FAR, SLOPE_ROUNDS = 3.0, 2, 1.0, 3


@dataclass(frozen=True)
class WearMinimum:
    """Scaled parameters (n,) [1] at a minimum, its chi-square, and the number of starts that lead to it."""

    parameters: FloatArray
    chi2: float
    starts: int
    converged: bool
    evaluations: int


def start_mesh(settings: WearSettings, misfit: WornMisfit) -> list[FloatArray]:
    """Every start (n,), scaled [1]: depths by angles, unless wear is known, the rest at its mean."""
    model = misfit.model
    mean = np.array(model.prior.mean) / model.scale[len(model.names) - misfit.n_prior :]
    if DEPTH not in model.names or DEPTH in model.prior.names:
        return [mean]
    depths = [max(depth, SHALLOWEST_START) for depth in settings.start_depths]
    scales = [model.scale[model.names.index(name)] for name in (DEPTH, ANGLE)]
    return [
        np.array([depth / scales[0], angle / scales[1], *mean])
        for depth, angle in product(depths, settings.start_angles)
    ]


def descend(
    misfit: WornMisfit, start: FloatArray, free: Sequence[int] | None = None, tolerance: float = TOLERANCE
) -> WearMinimum:
    """Minimum within the bounds from a scaled *start* (n,) [1]; *free*: those that move, by default all."""
    moving = list(range(start.size)) if free is None else list(free)
    whole, low, high = np.array(start, float), misfit.model.low[moving], misfit.model.high[moving]

    def full(moved: FloatArray) -> FloatArray:
        point = whole.copy()
        point[moving] = moved
        return point

    if not moving:
        return WearMinimum(whole, misfit.chi2(whole), 1, True, 1)

    inward = 1e-6 * (high - low)
    solution = scipy.optimize.least_squares(
        lambda moved: misfit.residual(full(moved)),
        np.clip(whole[moving], low + inward, high - inward),
        lambda moved: misfit.jacobian(full(moved))[:, moving],
        (low, high),
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=MOST_EVALUATIONS,
    )
    return WearMinimum(full(solution.x), 2 * float(solution.cost), 1, solution.status > 0, int(solution.nfev))


def minima(misfit: WornMisfit, starts: Sequence[FloatArray]) -> list[WearMinimum]:
    """Distinct minima of all scaled starts (n,) [1], the lowest first; FitError where none is finite."""
    rough = _rank([descend(misfit, start, tolerance=START_TOLERANCE) for start in starts])
    candidates = _rank([_continue(misfit, minimum) for minimum in merge(rough)])
    if not np.isfinite(candidates[0].chi2):
        raise FitError("no start leads to a finite misfit", hint="check the rotor file and the response")
    return merge(candidates)


def _rank(candidates: Sequence[WearMinimum]) -> list[WearMinimum]:
    return sorted(candidates, key=lambda minimum: (not minimum.converged, minimum.chi2))


def _continue(misfit: WornMisfit, minimum: WearMinimum) -> WearMinimum:
    if not minimum.converged:
        return minimum
    return _join(descend(misfit, minimum.parameters), minimum, minimum.starts)


def merge(candidates: Sequence[WearMinimum]) -> list[WearMinimum]:
    distinct: list[WearMinimum] = []
    for candidate in candidates:
        alike = (n for n, other in enumerate(distinct) if _is_same(candidate.parameters, other.parameters))
        if (near := next(alike, None)) is None:
            distinct.append(candidate)
        else:
            distinct[near] = _join(distinct[near], candidate, distinct[near].starts + candidate.starts)
    return distinct


def _join(minimum: WearMinimum, other: WearMinimum, starts: int) -> WearMinimum:
    return replace(minimum, starts=starts, evaluations=minimum.evaluations + other.evaluations)


def _is_same(first: FloatArray, second: FloatArray) -> bool:
    apart = np.abs(first - second)[:2]
    return bool(apart[0] < SAME and (np.max(apart) < SAME or max(first[0], second[0]) < SHALLOW))


def refine(
    misfit: WornMisfit, minimum: WearMinimum, free: Sequence[int] | None = None, hopeless: float = np.inf
) -> tuple[WornMisfit, WearMinimum]:
    """Minimum on the films instead of the tables: correct the tables at the minimum and descend, repeatedly,
    first with the tables' slopes, then with the films' own. Not converged where this does not settle, or
    beyond a chi-square that is *hopeless*.
    """
    slopes, moved = 0, np.inf
    for number in range(MOST_REFINEMENTS):
        before = minimum.parameters
        with_slopes = slopes < SLOPE_ROUNDS and (moved > FAR if slopes else moved < NEAR or number >= LATEST)
        slopes += with_slopes
        misfit = replace(misfit, model=misfit.model.refine(before, with_slopes), _last=None)
        minimum = _join(descend(misfit, before, free), minimum, minimum.starts)
        if minimum.chi2 > hopeless:
            break
        moved = float(np.linalg.norm(misfit.jacobian(minimum.parameters) @ (minimum.parameters - before)))
        if slopes and moved < SETTLED:
            return misfit, minimum
    return misfit, replace(minimum, converged=False)


PROFILE_STEPS = 10
# Tolerance of the profile's distance from the limit, in standard deviations.
CLOSE = 0.02
PROFILE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Interval:
    """Ends of a profile interval, scaled; *open*: whether it ends only because the range does."""

    low: float
    high: float
    open_low: bool
    open_high: bool


def profile_interval(
    misfit: WornMisfit, best: WearMinimum, number: int, std_error: float, limit: float = 1.96
) -> Interval:
    """Where the root of the misfit's increase reaches *limit*, all other parameters re-estimated;
    *std_error*: a first guess of the distance for one, scaled. Equation (wear-profile).
    """
    ends = [_end(misfit, best, number, side, std_error, limit) for side in (-1, 1)]
    return Interval(ends[0][0], ends[1][0], ends[0][1], ends[1][1])


def _end(
    misfit: WornMisfit, best: WearMinimum, number: int, side: int, std_error: float, limit: float
) -> tuple[float, bool]:
    here = float(best.parameters[number])
    bound = float((misfit.model.low if side < 0 else misfit.model.high)[number])
    room = abs(bound - here)
    inside, near, step = 0.0, 0.0, min(max(limit * std_error, 1e-3), room)
    outside: float | None = None
    for _ in range(PROFILE_STEPS):
        if room <= 0:
            return bound, True
        distance = profile_distance(misfit, best, {number: here + side * step})
        if abs(distance - limit) < CLOSE:
            break
        if distance < limit:
            if step >= room:
                return bound, True
            inside, near = step, distance
        else:
            outside = step
        guess = step * limit / max(distance, 1e-3) if distance > 0 else 2 * step
        if outside is not None and not inside < guess < outside:
            guess = (inside + outside) / 2
        step = min(max(guess, inside * 1.01), room, 4 * step)
    assert near <= limit
    return here + side * step, False


def profile_distance(misfit: WornMisfit, best: WearMinimum, fixed: dict[int, float]) -> float:
    """sqrt(chi2 - chi2_min) with some parameters fixed at scaled values and the others estimated again."""
    start = best.parameters.copy()
    start[[*fixed]] = [*fixed.values()]
    free = [number for number in range(start.size) if number not in fixed]
    return float(np.sqrt(max(descend(misfit, start, free, PROFILE_TOLERANCE).chi2 - best.chi2, 0.0)))


def joint_region(
    misfit: WornMisfit, best: WearMinimum, covariance: FloatArray, level: float = 0.95, directions: int = 24
) -> FloatArray:
    """Outline of the joint confidence region of the first two parameters, (n_direction, 2), scaled [1]: along
    rays from the estimate, in units of the *covariance* (n, n), to where the profile increases by the
    chi-square quantile of two parameters; cut at the bounds. Equation (wear-region).
    """
    limit = float(np.sqrt(chi2_quantile(level, 2)))
    root = np.linalg.cholesky(covariance[:2, :2])
    low, high = misfit.model.low[:2], misfit.model.high[:2]
    outline = []
    for turn in np.linspace(0, 2 * np.pi, directions, endpoint=False):
        ray = root @ np.array([np.cos(turn), np.sin(turn)])
        length = limit
        for _ in range(4):
            point = np.clip(best.parameters[:2] + length * ray, low, high)
            distance = profile_distance(misfit, best, {0: float(point[0]), 1: float(point[1])})
            if abs(distance - limit) < CLOSE:
                break
            length *= float(np.clip(limit / max(distance, 1e-3), 0.4, 2.5))
        outline.append(np.clip(best.parameters[:2] + length * ray, low, high))
    return np.array(outline)


# Increase of chi-square beyond which the integral over wear is that of one narrow peak, and beyond which no
# refining brings the probability of no wear back from zero.
NARROW, HOPELESS = 20.0, 6000.0
N_DEPTH, N_ANGLE = 13, 5
# Mesh around the best wear, in standard errors.
AROUND = np.linspace(-3.0, 3.0, 7)
# Least information on a parameter, as the angle at zero depth: a standard error of 10,000 scaled units.
LEAST_INFORMATION = 1e-8


def healthy_minimum(misfit: WornMisfit, best: WearMinimum) -> tuple[WornMisfit, WearMinimum]:
    """Minimum at zero depth, refined on the films; no start leads there, where the slope by depth is zero."""
    nuisances = range(2, len(misfit.model.names))
    healthy = descend(misfit, np.array([0.0, 0.0, *best.parameters[2:]]), nuisances)
    refined_misfit, healthy = refine(misfit, healthy, nuisances, best.chi2 + HOPELESS)
    return refined_misfit, replace(healthy, starts=0)


def healthy_probability(misfit: WornMisfit, best: WearMinimum, healthy_chi2: float) -> float:
    """P(no wear | response) = 1 / (1 + B), even odds before and wear evenly likely over its range: B is the
    mean there of exp(-(chi2(depth, angle) - chi2(0)) / 2), the other parameters estimated again at every
    point (their spread cancels). Equation (wear-healthy).
    """
    gain = healthy_chi2 - best.chi2
    share = peak_share(misfit, best) if gain > NARROW else _mean_likelihood(misfit, best)
    return float(np.exp(-gain / 2) / (np.exp(-gain / 2) + share))


def peak_share(misfit: WornMisfit, best: WearMinimum) -> float:
    """Of one narrow peak: 2 pi sqrt(det cov) over the area."""
    area = float(np.prod(misfit.model.high[:2] - misfit.model.low[:2]))
    spread = np.linalg.det(covariance_of(misfit, best)[:2, :2])
    return min(float(2 * np.pi * np.sqrt(max(spread, 1e-12))) / area, 1.0)


def covariance_of(misfit: WornMisfit, best: WearMinimum) -> FloatArray:
    """Covariance (n, n) [1] of the scaled parameters at a minimum by the noise, (J^T J)^-1."""
    jacobian = misfit.jacobian(best.parameters)
    return np.linalg.inv(jacobian.T @ jacobian + LEAST_INFORMATION * np.eye(jacobian.shape[1]))


def _mean_likelihood(misfit: WornMisfit, best: WearMinimum) -> float:
    """Mean of exp(-(chi2 - chi2_min) / 2), dense at small depths and around the best wear."""
    low, high = misfit.model.low[:2], misfit.model.high[:2]
    widths = np.minimum(np.sqrt(np.diag(covariance_of(misfit, best))[:2]), (high - low) / 8)
    places = [best.parameters[number] + widths[number] * AROUND for number in (0, 1)]
    depths = _mesh(high[0] * np.linspace(0, 1, N_DEPTH) ** 3, places[0], low[0], high[0])
    angles = _mesh(np.linspace(low[1], high[1], N_ANGLE), places[1], low[1], high[1])
    along_angle = np.zeros(depths.size)
    for row, depth in enumerate(depths):
        distances = [profile_distance(misfit, best, {0: float(depth), 1: float(angle)}) for angle in angles]
        along_angle[row] = scipy.integrate.trapezoid(np.exp(-np.square(distances) / 2), angles)
        if depth > best.parameters[0] and along_angle[row] < 1e-6 * along_angle.max():
            break
    return float(scipy.integrate.trapezoid(along_angle, depths)) / float(np.prod(high - low))


def _mesh(ticks: FloatArray, around: FloatArray, low: float, high: float) -> FloatArray:
    both = np.concatenate([ticks, around])
    return np.unique(both[(both >= low) & (both <= high)])


def film_covariance(misfit: WornMisfit, parameters: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (n, n) [1] of the scaled *parameters* (n,) at a refined minimum by the mesh of the films:
    sum of b b^T with b = -covariance J^T dr, dr the change of the residual by a film's error and *covariance*
    (n, n) [1] that of the noise. Equation (wear-film).
    """
    residual, jacobian = misfit.residual(parameters), misfit.jacobian(parameters)
    total = np.zeros_like(covariance)
    for model in misfit.model.with_mesh_error(parameters):
        change = replace(misfit, model=model, _last=None).residual(parameters) - residual
        shift = covariance @ (jacobian.T @ change)
        total += np.outer(shift, shift)
    return total


def widen(interval: Interval, best: float, distance: float, low: float, high: float) -> Interval:
    """An interval about *best* with half-widths sqrt(w^2 + *distance*^2), within *low* and *high*; scaled."""
    first = best - np.hypot(best - interval.low, distance)
    last = best + np.hypot(interval.high - best, distance)
    return Interval(
        float(interval.low if interval.open_low else max(first, low)),
        float(interval.high if interval.open_high else min(last, high)),
        interval.open_low or bool(first <= low),
        interval.open_high or bool(last >= high),
    )


def widened_region(outline: FloatArray, best: FloatArray, noise: FloatArray, film: FloatArray) -> FloatArray:
    """An *outline* (n, 2) about *best* (2,) by *noise* (2, 2), stretched to noise and *film* (2, 2) [1]."""
    stretch = np.linalg.cholesky(noise + film) @ np.linalg.inv(np.linalg.cholesky(noise))
    return best + (outline - best) @ stretch.T
