"""Profile intervals and joint confidence region of depth and angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import chi2_quantile
from labpipe.wear.misfit import Misfit
from labpipe.wear.search import Minimum, descend

PROFILE_STEPS = 10
# Tolerance of the profile's distance from the limit, in standard deviations.
CLOSE = 0.02
PROFILE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Interval:
    """Ends of a profile interval in scaled units; *open*: whether it ends at the bound only because the range does."""

    low: float
    high: float
    open_low: bool
    open_high: bool


def profile_interval(misfit: Misfit, best: Minimum, number: int, std_error: float, limit: float = 1.96) -> Interval:
    """Where the root of the misfit's increase reaches *limit* standard deviations, all other parameters re-estimated.

    *std_error*: a first guess of the distance for one standard deviation, scaled. Equation (wear-profile).
    """
    ends = [_end(misfit, best, number, side, std_error, limit) for side in (-1, 1)]
    return Interval(ends[0][0], ends[1][0], ends[0][1], ends[1][1])


def _end(misfit: Misfit, best: Minimum, number: int, side: int, std_error: float, limit: float) -> tuple[float, bool]:
    """One end of the interval, and True if it is the bound."""
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


def profile_distance(misfit: Misfit, best: Minimum, fixed: dict[int, float]) -> float:
    """sqrt(chi2 - chi2_min) with some parameters fixed at scaled values and the others estimated again."""
    start = best.parameters.copy()
    for number, value in fixed.items():
        start[number] = value
    free = [number for number in range(start.size) if number not in fixed]
    return float(np.sqrt(max(descend(misfit, start, free, PROFILE_TOLERANCE).chi2 - best.chi2, 0.0)))


def joint_region(misfit: Misfit, best: Minimum, covariance: FloatArray, level: float = 0.95, directions: int = 24) -> FloatArray:
    """Outline of the joint confidence region of the first two parameters, (n_direction, 2), scaled [1]; *covariance* (n, n), scaled.

    Along rays from the estimate, in units of the covariance's ellipse, to where the profile increases by the chi-square quantile of
    two parameters; cut at the bounds. Equation (wear-region).
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
