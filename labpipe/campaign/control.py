"""Many results of one coefficient: control limits, straight trends over conditions, and outliers against the other results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.weighted import WeightedFit, weighted_fit, weighted_mean
from labpipe.distributions import normal_tail
from labpipe.errors import FitError

# Mean of the range of two normal values in standard deviations, 2 / sqrt(pi).
D2 = 2 / np.sqrt(np.pi)
REACH = 3.0
# Number of values above which the limits themselves are accurate.
SETTLED = 12


@dataclass(frozen=True)
class ControlLimits:
    """Limits of an individuals chart: centre -+ 3 sigma, sigma = mean moving range / 1.128; *outside*: indices of values beyond."""

    centre: float
    sigma: float
    low: float
    high: float
    outside: tuple[int, ...]

    @property
    def formula(self) -> str:
        return "individuals (Shewhart) chart: mean ∓ 3 × mean moving range / 1.128"


def control_limits(values: FloatArray) -> ControlLimits:
    """Control limits of values (n,) [any unit] in order of time, from the ranges of neighbours: a shift does not widen them.

    sigma = mean |y_i - y_(i-1)| / d_2, d_2 = 2 / sqrt(pi). Montgomery, Introduction to Statistical Quality Control, sec. 6.4.
    FitError for fewer than three values. Equation (comp-control).
    """
    if values.size < 3:
        raise FitError(f"{values.size} value(s) give no control limits", hint="at least three are needed")
    sigma = float(np.mean(np.abs(np.diff(values))) / D2)
    centre = float(np.mean(values))
    low, high = centre - REACH * sigma, centre + REACH * sigma
    outside = tuple(int(n) for n in np.flatnonzero((values < low) | (values > high)))
    return ControlLimits(centre, sigma, low, high, outside)


def straight_trend(condition: FloatArray, values: FloatArray, errors: FloatArray) -> WeightedFit:
    """value = level + slope (x - mean x), weighted by the standard errors (n,) [unit of the values]; parameters (level, slope).

    *errors* may be the covariance (n, n) of values with errors in common. FitError for fewer than three values. Equation (comp-straight).
    """
    if values.size < 3:
        raise FitError(f"{values.size} value(s) show no trend", hint="at least three are needed")
    return weighted_fit(np.column_stack([np.ones_like(condition), condition - np.mean(condition)]), values, errors)


def from_the_rest(values: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Difference (n,) [unit of the values] of every value from the weighted mean of all others, and p-values (n,) by the standard errors.

    z_i = (y_i - m_i) / sqrt(s_i^2 + s_m^2); where the others scatter more than their errors, these are enlarged (Birge). Two values give
    one test with one result for both. *errors* (n,), or the covariance (n, n) of values with errors in common, which cancel here as far
    as they are alike. FitError for fewer than two. Equation (comp-outlier).
    """
    if values.size < 2:
        raise FitError(f"{values.size} value(s) cannot be compared", hint="at least two are needed")
    differences, chances = np.empty(values.size), np.empty(values.size)
    for n in range(values.size):
        others = np.arange(values.size) != n
        if errors.ndim == 1:
            rest = weighted_mean(values[others], errors[others])
            variance = errors[n] ** 2 + rest.std_error(0) ** 2
        else:
            rest = weighted_mean(values[others], errors[np.ix_(others, others)])
            weights = _mean_weights(errors[np.ix_(others, others)])
            variance = errors[n, n] + rest.std_error(0) ** 2 - 2 * float(weights @ errors[others, n])
        differences[n] = values[n] - rest.values[0]
        chances[n] = 2 * normal_tail(abs(differences[n]) / np.sqrt(variance))
    return differences, chances


def _mean_weights(covariance: FloatArray) -> FloatArray:
    """Weights (n,) [1] of values in their generalised least-squares mean."""
    inverse = np.linalg.solve(covariance, np.ones(covariance.shape[0]))
    return np.asarray(inverse / inverse.sum())
