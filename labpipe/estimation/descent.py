"""Levenberg-Marquardt for a sum of squares with analytic derivatives, and the triangular factor of tall
matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import FitError

# Condition number up to which the products of columns tell the factor to about half of all digits.
WELL_CONDITIONED = 1e4


def scaled_triangle(columns: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """(lengths S of the columns [any unit], R (n, n) [1] of columns S^-1 = Q R, True if R is by products).

    *columns* (n_row, n) [any unit]; a column of zeros keeps its length 1. Products of columns (Cholesky) cost
    a fraction of Householder's QR and are as accurate while the condition number is far below 1 /
    sqrt(rounding); QR beyond that.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        products = columns.T @ columns
    triangle = triangle_of_products(products)
    if triangle is not None:
        return *triangle, True
    lengths = np.linalg.norm(columns, axis=0)
    scale = np.where(lengths > 0, lengths, 1.0)
    return scale, np.asarray(np.linalg.qr(columns / scale, mode="r")), False


def triangle_of_products(products: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """(lengths S of the columns [any unit], R (n, n) [1]) from the products (n, n) of columns, of zeros with
    the length 1; None where R is too inexact, FitError beyond all numbers.
    """
    scale = np.sqrt(products.diagonal())
    if not np.isfinite(scale).all():
        raise FitError("the fit reached values too far off to compute with")
    scale[scale == 0] = 1.0
    try:
        triangle: FloatArray = np.linalg.cholesky(products / (scale[:, None] * scale)).T
    except np.linalg.LinAlgError:
        return None
    singular = np.linalg.svd(triangle, compute_uv=False)
    return (scale, triangle) if singular[0] < WELL_CONDITIONED * singular[-1] else None


MAX_ITERATIONS = 100
MAX_DAMPING_STEPS = 20
# Convergence: share of the residual in the range of the Jacobian, close to the rounding of chi-square.
GRADIENT_TOLERANCE = 1e-6
# Standard errors (residual per equation) from a minimum that count as converged where no step goes lower.
NEGLIGIBLE = 1e-3
# Convergence for noise-free FRFs, as a share of the FRF.
ROUNDING = 1e-12


class SquareSum(Protocol):
    """A residual (n_equation,) [-] and its Jacobian."""

    @property
    def size(self) -> float:
        """Euclidean norm of the fitted values, in the residual's units."""
        ...

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Weighted residual (n_equation,) [-] at *parameters* (n_parameter,)."""
        ...

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivatives (n_equation, n_parameter) [1/parameter unit] of the residual."""
        ...

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [-] of the residual at *parameters* (n_parameter,), infinite without response."""
        return sum_of_squares(self.residual, parameters)


def sum_of_squares(residual: Callable[[FloatArray], FloatArray], parameters: FloatArray) -> float:
    """Sum of squares [-] of a residual (n_equation,); infinite where the model has no finite response."""
    try:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            values = residual(parameters)
    except (FitError, np.linalg.LinAlgError):
        return float("inf")
    return float(values @ values) if np.all(np.isfinite(values)) else float("inf")


@dataclass(frozen=True)
class Minimum:
    """End point *values* (n_parameter,) [parameter units] of a descent, and whether it is a minimum."""

    values: FloatArray
    converged: bool
    steps: int


@dataclass(frozen=True)
class Linearisation:
    """What the steps of one iteration need of J = Q R S and r, S the lengths of the columns of J.

    *triangle* R (n_parameter, n_parameter) [-], *projected* Q^T r (n_parameter,) [-], *scale* S
    (n_parameter,) [1/parameter unit], *chi2* r^T r [-] of *n_equation* residuals.
    """

    triangle: FloatArray
    projected: FloatArray
    scale: FloatArray
    chi2: float
    n_equation: int


def linearise_problem(problem: SquareSum, parameters: FloatArray) -> Linearisation:
    """The linearisation at *parameters* (n_parameter,) [parameter units] from residual and Jacobian."""
    rows = problem.jacobian(parameters), problem.residual(parameters)
    return linearise_blocks(lambda: [(np.arange(parameters.size), *rows)], parameters.size)


def linearise_blocks(
    blocks: Callable[[], Iterable[tuple[IntArray, FloatArray, FloatArray]]], n_parameter: int
) -> Linearisation:
    """The linearisation from *blocks*: places (n,) of the parameters that move some rows, these rows of the
    Jacobian (n_row, n) [1/parameter unit] and of the residual (n_row,) [-]. One block at a time is held; they
    are gone through again where products are too inexact (QR of the triangle so far above the next rows).
    """
    products: FloatArray = np.zeros((n_parameter, n_parameter))
    projected: FloatArray = np.zeros(n_parameter)
    chi2, n_equation = 0.0, 0
    for places, jacobian, residual in blocks():
        with np.errstate(over="ignore", invalid="ignore"):
            products[np.ix_(places, places)] += jacobian.T @ jacobian
        projected[places] += jacobian.T @ residual
        chi2 += float(residual @ residual)
        n_equation += residual.size
    factor = triangle_of_products(products)
    if factor is not None:
        scale, triangle = factor
        projected = np.linalg.solve(triangle.T, projected / scale)
        return Linearisation(triangle, projected, scale, chi2, n_equation)
    # A parameter on which nothing depends has the length 1: damping keeps the step finite.
    lengths = np.sqrt(products.diagonal())
    lengths[lengths == 0] = 1.0
    joint: FloatArray = np.empty((0, n_parameter + 1))
    for places, jacobian, residual in blocks():
        rows = np.zeros((residual.size, n_parameter + 1))
        rows[:, places], rows[:, -1] = jacobian / lengths[places], residual
        joint = np.asarray(np.linalg.qr(np.vstack([joint, rows]), mode="r"))
    above = joint[:n_parameter]
    return Linearisation(above[:, :-1], above[:, -1], lengths, chi2, n_equation)


def minimise(
    problem: SquareSum,
    start: FloatArray,
    near: float = 0.0,
    most_steps: int = MAX_ITERATIONS,
    linearise: Callable[[FloatArray], Linearisation] | None = None,
) -> Minimum:
    """Levenberg-Marquardt from *start* (n_parameter,) [parameter units].

    *near*: distance to the minimum in standard errors (residual per equation) at which the descent stops. Not
    converged after *most_steps*. *linearise* replaces `linearise_problem` where a shorter way is known.
    Equation (est-levenberg).
    """
    values, damping = start, 1e-3
    rounding = ROUNDING * problem.size
    for steps in range(most_steps):
        linear = linearise(values) if linearise else linearise_problem(problem, values)
        # Unlike the last step, the gain of a further full step does not become small by large damping.
        gain, size = float(np.linalg.norm(linear.projected)), float(np.sqrt(linear.chi2))
        standard_error = size / np.sqrt(linear.n_equation)
        if gain <= max(GRADIENT_TOLERANCE * size, rounding, near * standard_error):
            return Minimum(values, True, steps)
        step, damping = _damped_step(problem, values, linear, damping)
        if step is None:
            return Minimum(values, gain <= NEGLIGIBLE * standard_error, steps)
        values = values + step
    return Minimum(values, False, most_steps)


def _damped_step(
    problem: SquareSum, values: FloatArray, linear: Linearisation, damping: float
) -> tuple[FloatArray | None, float]:
    n = values.size
    right_side = np.concatenate([-linear.projected, np.zeros(n)])
    for _ in range(MAX_DAMPING_STEPS):
        joint = np.vstack([linear.triangle, np.sqrt(damping) * np.eye(n)])
        step = np.linalg.lstsq(joint, right_side, rcond=None)[0] / linear.scale
        if problem.chi2(values + step) < linear.chi2:
            return step, max(damping / 10, 1e-15)
        damping *= 10
    return None, damping
