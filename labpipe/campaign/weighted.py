"""Weighted means and lines of a few values with standard errors, and a test of their scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from labpipe.arrays import FloatArray
from labpipe.distributions import chi2_tail, normal_quantile, normal_tail, student_quantile, student_tail
from labpipe.errors import FitError

# p-value below which the scatter is larger than the standard errors explain.
SCATTER_LEVEL = 0.05


@dataclass(frozen=True)
class WeightedFit:
    """Least squares weighted by the covariance of the values: parameters (n_parameter,) [any unit], covariance (n_parameter, n_parameter).

    chi-square of the residual; where the scatter exceeds the errors (p_value below SCATTER_LEVEL), *covariance* is enlarged by the square
    of Birge's ratio sqrt(chi2 / dof), and intervals use Student's t instead of the normal distribution. Equation (comp-birge).
    """

    values: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    p_value: float | None
    inflated: bool

    @property
    def quantile(self) -> float:
        """Standard errors to either side of a 95 % interval. Equation (comp-quantile)."""
        return student_quantile(0.975, self.dof) if self.inflated else normal_quantile(0.975)

    def std_error(self, number: int) -> float:
        return float(np.sqrt(self.covariance[number, number]))

    def p_of(self, number: int, value: float = 0.0) -> float:
        """Two-sided p-value of the hypothesis that the parameter equals *value*."""
        ratio = abs(self.values[number] - value) / self.std_error(number)
        return 2 * (student_tail(ratio, self.dof) if self.inflated else normal_tail(ratio))


def weighted_fit(columns: FloatArray, values: FloatArray, errors: FloatArray) -> WeightedFit:
    """Generalised least squares of values (n,) [any unit] = columns (n, n_parameter) p.

    *errors*: standard errors (n,), or the covariance (n, n) of correlated values. FitError where p is not determined.
    Equation (comp-weighted).
    """
    if values.size < columns.shape[1]:
        raise FitError(f"{values.size} tests cannot determine {columns.shape[1]} parameters")
    if not np.all((errors if errors.ndim == 1 else np.diag(errors)) > 0):
        raise FitError("a value has no standard error, so tests cannot be weighted", hint="a response without noise gives none")
    design, whitened = _whitened(columns, errors), _whitened(values[:, None], errors)[:, 0]
    if np.linalg.matrix_rank(design) < columns.shape[1]:
        raise FitError("the tests do not differ in the condition", hint="a trend needs at least two different values")
    covariance = np.linalg.inv(design.T @ design)
    solved = covariance @ design.T @ whitened
    chi2 = float(np.sum((whitened - design @ solved) ** 2))
    dof = values.size - columns.shape[1]
    p_value = chi2_tail(chi2, dof) if dof else None
    inflated = p_value is not None and p_value < SCATTER_LEVEL
    return WeightedFit(solved, covariance * chi2 / dof if inflated else covariance, chi2, dof, p_value, inflated)


def _whitened(columns: FloatArray, errors: FloatArray) -> FloatArray:
    """Columns (n, m) divided by the standard errors, or by the Cholesky factor of the covariance."""
    if errors.ndim == 1:
        return columns / errors[:, None]
    whitened: FloatArray = linalg.solve_triangular(np.linalg.cholesky(errors), columns, lower=True)
    return whitened


def weighted_mean(values: FloatArray, errors: FloatArray) -> WeightedFit:
    """The weighted mean of values (n,) [any unit] with standard errors (n,) or covariance (n, n)."""
    return weighted_fit(np.ones((values.size, 1)), values, errors)
