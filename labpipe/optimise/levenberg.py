"""Levenberg-Marquardt for a sum of squares with known slopes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import FitError

MAX_ITERATIONS = 100
MAX_DAMPING_STEPS = 20
# Share of the residual that a further step could still remove: 1e-6 of it is far below a standard error, and near to where the
# rounding of chi-square (its square) hides any further gain.
GRADIENT_TOLERANCE = 1e-6
# Where rounding hides what a step gains: distance to the minimum in standard errors (residual per equation) that does not matter.
NEGLIGIBLE = 1e-3
# The same as the first for data without noise, as a share of the FRF itself.
ROUNDING = 1e-12


class SquareSum(Protocol):
    """A residual (n_equation,) and its slopes (n_equation, n_parameter); chi2 is infinite where there is none."""

    @property
    def size(self) -> float:
        """Length of what is fitted, in the residual's units."""
        ...

    def residual(self, parameters: FloatArray) -> FloatArray: ...
    def jacobian(self, parameters: FloatArray) -> FloatArray: ...
    def chi2(self, parameters: FloatArray) -> float: ...


def sum_of_squares(residual: Callable[[FloatArray], FloatArray], parameters: FloatArray) -> float:
    """The squared length of a residual; infinite where the model has no finite response."""
    try:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            values = residual(parameters)
    except FitError:
        return float("inf")
    return float(values @ values) if np.all(np.isfinite(values)) else float("inf")


@dataclass(frozen=True)
class Minimum:
    """Where the descent ended, whether that is a minimum, and the steps taken."""

    values: FloatArray
    converged: bool
    steps: int


def minimise(problem: SquareSum, start: FloatArray, near: float = 0.0) -> Minimum:
    """Levenberg-Marquardt from *start*; *near*: distance to the minimum in standard errors (residual per equation) that will do."""
    values, damping = start, 1e-3
    rounding = ROUNDING * problem.size
    for steps in range(MAX_ITERATIONS):
        residual, jacobian = problem.residual(values), problem.jacobian(values)
        scale = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / scale
        left, size = _explained(scaled, residual), float(np.linalg.norm(residual))
        if left <= max(GRADIENT_TOLERANCE * size, rounding, near * size / np.sqrt(residual.size)):
            return Minimum(values, True, steps)
        step, damping = _damped_step(problem, values, residual, scaled, scale, damping)
        if step is None:
            return Minimum(values, left <= NEGLIGIBLE * size / np.sqrt(residual.size), steps)
        values = values + step
    return Minimum(values, False, MAX_ITERATIONS)


def _explained(scaled: FloatArray, residual: FloatArray) -> float:
    """Length of the part of the residual that a further full step would remove: its projection on the Jacobian's columns.

    Unlike the length of the last step it does not get small because the damping is large.
    """
    return float(np.linalg.norm(np.linalg.qr(scaled)[0].T @ residual))


def _damped_step(
    problem: SquareSum,
    values: FloatArray,
    residual: FloatArray,
    scaled: FloatArray,
    scale: FloatArray,
    damping: float,
) -> tuple[FloatArray | None, float]:
    """A step that lowers chi-square and the damping for the next one; no step when none lowers it any more."""
    n = values.size
    before = float(residual @ residual)
    for _ in range(MAX_DAMPING_STEPS):
        joint = np.vstack([scaled, np.sqrt(damping) * np.eye(n)])
        step = np.linalg.lstsq(joint, np.concatenate([-residual, np.zeros(n)]), rcond=None)[0] / scale
        if problem.chi2(values + step) < before:
            return step, max(damping / 10, 1e-15)
        damping *= 10
    return None, damping
