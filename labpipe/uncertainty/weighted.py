"""Weighted means and lines of few values, scatter within and between settings, control limits and
outliers.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import linalg

from labpipe import distributions
from labpipe.arrays import FloatArray
from labpipe.display import chance_text
from labpipe.errors import FitError
from labpipe.records.dataset import DATE
from labpipe.records.finding import Parameter
from labpipe.uncertainty.amounts import holm, joint_errors, with_error

# p-value below which the scatter is larger than the standard errors explain.
SCATTER_LEVEL = 0.05
# p-value below which squares take what a line or a plane leaves, and the fewest degrees of freedom that tell.
CURVED_LEVEL, FEWEST_LEFT = 1e-3, 2
# Variance inflation of a condition above which tests do not tell it from the others.
MOST_INFLATED = 5.0


@dataclass(frozen=True)
class WeightedFit:
    """Least squares weighted by the covariance of the values: parameters (n_parameter,) [any unit],
    covariance (n_parameter, n_parameter).

    Where values scatter more than by their errors in the mean (chi2 above dof), single ones have a *spread*
    besides, a variance [unit^2 of the values], and intervals are Student's. Equation (comp-spread). *moved*
    (n_parameter, n_source): changes by errors in common, which no scatter shows, with *moved_dof* (n_source,)
    degrees of freedom, known by default. *by_errors*: what the errors alone make of *covariance*. *behind*:
    degrees of freedom of errors that were estimated from scatter themselves. *curved*: what a straight trend
    does not hold, as of `curvature_text`.
    """

    values: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    p_value: float | None
    spread: float
    moved: FloatArray
    by_errors: FloatArray
    behind: float = np.inf
    moved_dof: FloatArray | float = np.inf
    curved: str = ""

    @property
    def inflated(self) -> bool:
        """Whether the scatter exceeds the errors, beyond what chance makes of these."""
        return self.p_value is not None and self.p_value < SCATTER_LEVEL

    @property
    def effective_dof(self) -> float:
        """Degrees of freedom of the scatter, infinite where no error was estimated from it."""
        return self.dof if self.spread > 0 else self.behind

    def dof_of(self, direction: FloatArray) -> float:
        """Welch and Satterthwaite's degrees of freedom [1] along a *direction* (n_parameter,)."""
        # Two values alone, as far apart as chance makes them, leave the errors as known.
        as_stated = self.dof == 1 and self.spread > 0 and not self.inflated
        by_source = (direction @ self.moved) ** 2
        variance, known_variance = (
            direction @ matrix @ direction for matrix in (self.covariance, self.by_errors)
        )
        estimated = max(variance - (known_variance if as_stated else np.sum(by_source)), 1e-12 * variance)
        terms = estimated**2 / self.effective_dof + np.sum(by_source**2 / self.moved_dof)
        return float(variance**2 / terms) if terms else np.inf

    def reach(self, direction: FloatArray) -> float:
        """Half the 95 % interval [any unit] along a *direction* (n_parameter,). Equation (comp-quantile)."""
        error = float(np.sqrt(direction @ self.covariance @ direction))
        return distributions.coverage_factor(0.95, self.dof_of(direction)) * error

    def quantile(self, number: int) -> float:
        """Standard errors of a parameter to either side of its 95 % interval."""
        return self.reach(np.eye(self.values.size)[number]) / self.std_error(number)

    def std_error(self, number: int) -> float:
        return float(np.sqrt(self.covariance[number, number]))

    def state(self, number: int = 0) -> tuple[float, float, float]:
        """A parameter, its standard error [any unit], and standard errors to either end of its interval."""
        return float(self.values[number]), self.std_error(number), self.quantile(number)

    def amount(self, name: str, unit: str, number: int) -> Parameter:
        """The parameter [unit] with its error and interval."""
        return with_error(name, unit, *self.state(number))

    def p_of(self, number: int, value: float = 0.0) -> float:
        """Two-sided p-value of the hypothesis that the parameter equals *value*."""
        ratio = (self.values[number] - value) / self.std_error(number)
        return distributions.two_sided(ratio, self.dof_of(np.eye(self.values.size)[number]))


def weighted_fit(
    columns: FloatArray,
    values: FloatArray,
    errors: FloatArray,
    changes: FloatArray | None = None,
    dofs: FloatArray | float = np.inf,
) -> WeightedFit:
    """Generalised least squares of values (n,) [any unit] = columns (n, n_parameter) p.

    *errors*: standard errors (n,), or the covariance (n, n) of correlated values; *changes* (n_source, n) of
    the values by sources that they have in common, with *dofs* (n_source,) [1] behind these. FitError where p
    is not determined. Equation (comp-weighted).
    """
    if values.size < columns.shape[1]:
        raise FitError(f"{values.size} tests cannot determine {columns.shape[1]} parameters")
    if not np.all((errors if errors.ndim == 1 else np.diag(errors)) > 0):
        what = "a value has no standard error, so tests cannot be weighted"
        raise FitError(what, hint="a response without noise gives none")
    if not np.all(np.isfinite(values)):
        raise FitError("a value is not a number, so tests cannot be weighted")
    changes = np.zeros((0, values.size)) if changes is None else changes
    # Before the search for the scatter: no scatter makes columns alike.
    if np.linalg.matrix_rank(_whiten(columns, joint_errors(errors, changes))) < columns.shape[1]:
        hint = "a trend needs at least two different values"
        raise FitError("the tests do not differ in the condition", hint=hint)
    inverse, chi2, weights = _solve(columns, values, errors, changes)
    dof, by_errors = values.size - columns.shape[1], inverse
    p_value = distributions.chi2_tail(chi2, dof) if dof else None
    spread = 0.0
    if chi2 > dof > 0:
        largest = 10 * float(np.mean((values - columns @ (weights @ values)) ** 2))

        def solve_with(share: float) -> tuple[FloatArray, float, FloatArray]:
            added = share * largest
            enlarged = (
                np.sqrt(errors**2 + added) if errors.ndim == 1 else errors + added * np.eye(values.size)
            )
            return _solve(columns, values, enlarged, changes)

        share = scipy.optimize.brentq(lambda share: solve_with(share)[1] - dof, 0.0, 1.0)
        spread, (inverse, _, weights) = share * largest, solve_with(share)
    moved = weights @ changes.T
    return WeightedFit(
        weights @ values, inverse, chi2, dof, p_value, spread, moved, by_errors, moved_dof=dofs
    )


def _solve(
    columns: FloatArray, values: FloatArray, errors: FloatArray, changes: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """Covariance (n_parameter, n_parameter), chi-square, weights (n_parameter, n) of the values."""
    joint = joint_errors(errors, changes)
    design, whitened = _whiten(columns, joint), _whiten(np.eye(values.size), joint)
    covariance = np.linalg.inv(design.T @ design)
    weights = covariance @ design.T @ whitened
    return covariance, float(np.sum((whitened @ (values - columns @ (weights @ values))) ** 2)), weights


def _whiten(columns: FloatArray, errors: FloatArray) -> FloatArray:
    if errors.ndim == 1:
        return columns / errors[:, None]
    whitened: FloatArray = linalg.solve_triangular(np.linalg.cholesky(errors), columns, lower=True)
    return whitened


def dof_of_sum(errors: FloatArray, dofs: FloatArray) -> float:
    """Welch and Satterthwaite's degrees of freedom [1] of a sum of independent parts with standard *errors*
    (n,) [one unit] and *dofs* (n,) [1]: (sum s^2)^2 / sum (s^4 / dof).
    """
    fourth_powers = float(np.sum(errors**4 / dofs))
    return float(np.sum(errors**2)) ** 2 / fourth_powers if fourth_powers else np.inf


def weighted_mean(values: FloatArray, errors: FloatArray, *sources: Any) -> WeightedFit:
    """The weighted mean of values (n,) [any unit], with errors and *sources* as of `weighted_fit`."""
    return weighted_fit(np.ones((values.size, 1)), values, errors, *sources)


# Repeatability: scatter within and between settings (one-way random effects).

TAIL = 0.025


@dataclass(frozen=True, kw_only=True)
class Components:
    """y_ij = mean + setting_i + repeat_ij: standard deviations *within* and *between* settings with 95 %
    intervals.

    *between* is 0 where the settings scatter less than their repeats. p_value: of no effect of the setting (F
    test). *mean*: of the means of settings, by *weights* (n,) [1] of the values; mean_error: of their scatter
    alone, with *settings* - 1 degrees of freedom.
    """

    weights: FloatArray
    mean: float
    mean_error: float
    within: float
    within_ci: tuple[float, float]
    between: float
    between_ci: tuple[float, float]
    p_value: float
    settings: int
    repeats: int


def components(values: FloatArray, groups: NDArray[np.str_]) -> Components:
    """Variance components of values (n,) [any unit] in groups (n,), by the analysis of variance.

    Equation (comp-components). Interval of within^2 by chi-square, of between^2 after Tukey (1951) and
    Williams (1962). Searle, Casella and McCulloch, Variance Components (1992), sec. 3.5-3.6. FitError for
    fewer than two settings or no repeats.
    """
    _, group, counts = np.unique(groups, return_inverse=True, return_counts=True)
    a, n = counts.size, values.size
    if a < 2 or n <= a:
        what = f"{n} test(s) in {a} setting(s) show no scatter within and between"
        raise FitError(what, hint="repeat tests in two settings or more")
    means = np.bincount(group, values) / counts
    within_sum = float(np.sum((values - means[group]) ** 2))
    between_sum = float(np.sum(counts * (means - np.mean(values)) ** 2))
    within, between = within_sum / (n - a), between_sum / (a - 1)
    if not within > 0:
        raise FitError("the repeats do not scatter at all", hint="are they the same recording?")
    n_0 = (n - np.sum(counts**2) / n) / (a - 1)
    f = between / within
    # SSB (1 - F_q / F), which has no F to divide by where the means are alike.
    between_squares = [
        (between_sum - (a - 1) * within * distributions.f_quantile(q, a - 1, n - a))
        / (n_0 * distributions.chi2_quantile(q, a - 1))
        for q in (1 - TAIL, TAIL)
    ]
    between_low, between_high = (float(np.sqrt(max(square, 0.0))) for square in between_squares)
    quantiles = [distributions.chi2_quantile(q, n - a) for q in (1 - TAIL, TAIL)]
    within_low, within_high = (float(np.sqrt(within_sum / quantile)) for quantile in quantiles)
    return Components(
        weights=1 / (a * counts[group]),
        mean=float(np.mean(means)),
        mean_error=float(np.std(means, ddof=1) / np.sqrt(a)),
        within=float(np.sqrt(within)),
        within_ci=(within_low, within_high),
        between=float(np.sqrt(max((between - within) / n_0, 0.0))),
        between_ci=(between_low, between_high),
        p_value=distributions.f_tail(f, a - 1, n - a),
        settings=a,
        repeats=n,
    )


# Many results of one coefficient: control limits, straight trends over conditions, and outliers against the
# other results.

# Mean of the range of two normal values in standard deviations, 2 / sqrt(pi).
D2 = 2 / np.sqrt(np.pi)
# Chance of any false alarm among all trends, and among all charts, of one report.
LEVEL = 0.05
# Fewest values that show a line or limits.
FEWEST = 3
# Number of values above which the limits themselves are accurate.
SETTLED = 12


@dataclass(frozen=True)
class ControlLimits:
    """Limits of an individuals chart: centre -+ reach sigma, sigma = mean moving range / 1.128; *outside*:
    indices of values beyond.
    """

    centre: float
    sigma: float
    reach: float
    low: float
    high: float
    outside: tuple[int, ...]

    @property
    def rounding(self) -> float:
        """The number whose second digit is the last one of the limits that is shown."""
        return min(self.sigma, 1e-4 * abs(self.centre))

    @property
    def formula(self) -> str:
        chart = f"Individuals chart: mean ∓ {self.reach:.2f} × mean moving range / 1.128"
        return f"{chart}, beyond which one value or more lies in {100 * LEVEL:g} % of sound reports"


def control_limits(values: FloatArray, n_value: int) -> ControlLimits:
    """Limits of values (n,) [any unit] in order of time, one chart of *n_value* in all, from the ranges of
    neighbours: a shift does not widen them. Equation (comp-control); Montgomery, Introduction to Statistical
    Quality Control, sec. 6.4. FitError for fewer than three values.
    """
    if values.size < FEWEST:
        raise FitError(f"{values.size} value(s) give no control limits", hint="at least three are needed")
    reach = -float(distributions.normal_quantile(LEVEL / (2 * n_value)))
    sigma = float(np.mean(np.abs(np.diff(values))) / D2)
    centre = float(np.mean(values))
    low, high = centre - reach * sigma, centre + reach * sigma
    outside = tuple(int(n) for n in np.flatnonzero((values < low) | (values > high)))
    return ControlLimits(centre, sigma, reach, low, high, outside)


def straight_trend(
    conditions: FloatArray,
    values: FloatArray,
    errors: FloatArray,
    changes: FloatArray | None = None,
    dofs: FloatArray | float = np.inf,
) -> WeightedFit:
    """value = level + slope (x - mean x) of values (n,) [any unit] over a condition (n,), or several
    (n_condition, n) with a slope each; errors and sources as of `weighted_fit`. FitError for fewer than
    three. Equation (comp-straight).
    """
    if values.size < FEWEST:
        raise FitError(f"{values.size} value(s) show no trend", hint="at least three are needed")
    fit = weighted_fit(straight_columns(conditions), values, errors, changes, dofs)
    return replace(fit, curved=curvature_text(conditions, values, errors, changes, fit.values[0]))


def straight_columns(conditions: FloatArray) -> FloatArray:
    """1 and x - mean x (n, 1 + n_condition) of conditions (n,), or (n_condition, n) [any unit]."""
    rows = np.atleast_2d(conditions)
    return np.vstack([np.ones(rows.shape[1]), rows - rows.mean(axis=1, keepdims=True)]).T


def variable_conditions(
    tests: Sequence[Mapping[str, tuple[float, str]]],
) -> dict[str, tuple[str, list[float]]]:
    """Of the conditions of *tests*, value and unit by name, those that all have and that differ between them:
    unit and values (n,) [that unit] by name.
    """
    variable = {}
    for name, (_, unit) in tests[0].items():
        amounts = [conditions.get(name, (0.0, "")) for conditions in tests]
        if len(set(amounts)) > 1 and all(of == unit for _, of in amounts):
            variable[name] = unit, [amount for amount, _ in amounts]
    return variable


def are_separable(conditions: FloatArray) -> bool:
    """Whether tests tell what each of several conditions (n_condition, n) [any unit] does: those that
    moved with the others, their variance inflation above 5, and too few tests do not.
    """
    n_condition, n = conditions.shape
    if n < n_condition + 1 + FEWEST_LEFT or not np.all(np.ptp(conditions, axis=1)):
        return False
    correlation = np.atleast_2d(np.corrcoef(conditions))
    if np.linalg.matrix_rank(correlation, tol=1e-9) < n_condition:
        return False
    return bool(np.max(np.diag(np.linalg.inv(correlation))) <= MOST_INFLATED)


def trend_verdict(slope: float, curved: str, *, sure: bool) -> str:
    """What a trend of that *slope* [any unit] does: "rising" or "falling" where it is *sure*, beyond chance,
    else "curved" of *curved* values, as of `curvature_text`, or "no trend".
    """
    if sure:
        return "rising" if slope > 0 else "falling"
    return "curved" if curved else "no trend"


def curvature_text(
    conditions: FloatArray, values: FloatArray, errors: FloatArray, changes: FloatArray | None, scale: float
) -> str:
    """How far *values* (n,) [any unit], as of `straight_trend`, bend off a straight line over one condition
    (n,), off a plane over several (n_condition, n), in % of *scale*: where they scatter about it beyond their
    errors and the squares and products of the conditions take that (F test). Else empty. Equation
    (comp-curved).
    """
    rows = np.atleast_2d(conditions)
    span = np.maximum(np.ptp(rows, axis=1, keepdims=True), np.finfo(float).tiny)
    columns = np.column_stack(
        [np.ones(values.size), *(2 * (rows - rows.min(axis=1, keepdims=True)) / span - 1)]
    )
    n_flat = columns.shape[1]
    columns = bent_columns(columns)
    n_bent = columns.shape[1] - n_flat
    if not n_bent or values.size < columns.shape[1] + FEWEST_LEFT:
        return ""
    flat, bent = (weighted_fit(columns[:, :n], values, errors, changes) for n in (n_flat, columns.shape[1]))
    ratio = max(flat.chi2 - bent.chi2, 0.0) * bent.dof / n_bent / max(bent.chi2, np.finfo(float).tiny)
    p_value = distributions.f_tail(ratio, n_bent, bent.dof)
    if not flat.inflated or p_value >= CURVED_LEVEL:
        return ""
    because, percent = f"({chance_text(p_value)}), which a", 100 / abs(scale)
    if len(rows) > 1:
        largest = float(np.max(np.abs(columns[:, n_flat:] @ bent.values[n_flat:])))
        return f"curved, by up to {percent * largest:.2g} % off a plane {because} plane does not hold"
    side = "below" if bent.values[2] > 0 else "above"
    deviation = percent * abs(bent.values[2])
    return f"curved, in the middle {deviation:.2g} % {side} the chord {because} straight line does not hold"


def bent_columns(columns: FloatArray) -> FloatArray:
    """*columns* (n, 1 + n_condition) [any unit] of a plane, with squares and products that are determined."""
    n_flat = columns.shape[1]
    for first, second in itertools.combinations_with_replacement(range(1, n_flat), 2):
        extended = np.column_stack([columns, columns[:, first] * columns[:, second]])
        columns = extended if np.linalg.matrix_rank(extended) > columns.shape[1] else columns
    return columns


def from_the_rest(
    values: FloatArray,
    errors: FloatArray,
    changes: FloatArray | None = None,
    dofs: FloatArray | float = np.inf,
    columns: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Difference (n,) [unit of the values] of every value from the weighted mean of all others, or from their
    trend by *columns* (n, n_parameter), and p-values.

    Where the others scatter more than their errors, all have that spread, and the p-values are Student's.
    Two values give one test. *errors* (n,), or the covariance (n, n) of values with errors in common, or
    sources of these as of `weighted_fit`, which cancel as far as they are alike. FitError for fewer than two.
    Equation (comp-outlier).
    """
    if values.size < 2:
        raise FitError(f"{values.size} value(s) cannot be compared", hint="at least two are needed")
    changes = np.zeros((0, values.size)) if changes is None else changes
    joint = joint_errors(errors, changes)
    joint = np.diag(joint**2) if joint.ndim == 1 else joint
    differences, chances = np.empty(values.size), np.empty(values.size)
    columns = np.ones((values.size, 1)) if columns is None else columns
    for n in range(values.size):
        others = np.arange(values.size) != n
        covariance = joint[np.ix_(others, others)]
        others_mean = weighted_fit(columns[others], values[others], covariance)
        covariance = covariance + others_mean.spread * np.eye(values.size - 1)
        # The weights of the values in what their generalised least squares make of this one.
        weights = np.linalg.solve(covariance, columns[others]) @ others_mean.covariance @ columns[n]
        with_mean = float(weights @ joint[others, n])
        variance = joint[n, n] - 2 * with_mean + others_mean.spread
        variance = np.atleast_2d(variance + columns[n] @ others_mean.covariance @ columns[n])
        by_errors = np.atleast_2d(columns[n] @ others_mean.by_errors @ columns[n])
        apart = values[[n]] - columns[n] @ others_mean.values
        by_sources = (changes[:, n] - changes[:, others] @ weights)[None]
        difference = replace(others_mean, values=apart, covariance=variance, by_errors=by_errors)
        difference = replace(difference, moved=by_sources, moved_dof=dofs)
        differences[n], chances[n] = difference.values[0], difference.p_of(0)
    return differences, chances


class SeriesOfTests(ABC):
    """Values of one coefficient in several tests, in order of time where they have one."""

    @property
    @abstractmethod
    def values(self) -> FloatArray:
        """Values (n,) [any unit]."""

    @property
    @abstractmethod
    def parted_errors(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Standard errors (n,) [unit of the values] of each test alone, and sources as of `weighted_fit`."""

    @property
    @abstractmethod
    def amounts(self) -> Mapping[str, FloatArray]:
        """Amounts (n,) [any unit] by condition."""

    def joint_conditions(self, condition: str) -> tuple[tuple[str, ...], FloatArray]:
        """Names, and amounts (n_condition, n) [any unit], of a condition and all others that tests tell
        apart; of this one alone where they do not.
        """
        others = (name for name, of in self.amounts.items() if name != condition and np.ptp(of))
        names = (condition, *others)
        rows = np.array([self.amounts[name] for name in names])
        number = len(names) if are_separable(rows) else 1
        return names[:number], rows[:number]

    def line_over(self, condition: str) -> WeightedFit | None:
        """The straight trend over a condition, the `joint_conditions` held; None where there is none."""
        try:
            return straight_trend(self.joint_conditions(condition)[1], self.values, *self.parted_errors)
        except FitError:
            return None


Series = TypeVar("Series", bound=SeriesOfTests)


@dataclass(frozen=True)
class Trend(Generic[Series]):
    """The straight *line* of a series over a condition; p-value among all trends of a report after Holm."""

    series: Series
    condition: str
    line: WeightedFit
    p_value: float

    @property
    def is_sure(self) -> bool:
        return self.p_value < LEVEL


def trends_of(series: Sequence[Series]) -> list[Trend[Series]]:
    """Every trend of all series over each of their conditions."""
    lines = [
        (of, name, line) for of in series for name in of.amounts if (line := of.line_over(name)) is not None
    ]
    corrected = holm(np.array([line.p_of(1) for *_, line in lines])).tolist()
    return [Trend(*line, p) for line, p in zip(lines, corrected, strict=True)]


@dataclass(frozen=True)
class Adjusted(Generic[Series]):
    """A *series* without its trends beyond chance over *conditions* other than the date: *columns* (n,
    n_parameter) of these, *values* (n,) [unit of the series] at the mean conditions; limits of three or more.
    """

    series: Series
    conditions: tuple[str, ...]
    columns: FloatArray
    values: FloatArray
    limits: ControlLimits | None = None

    @property
    def without(self) -> str:
        return f", less its trend over {' and '.join(self.conditions)}" if self.conditions else ""


def adjust(series: Sequence[Series], trends: Sequence[Trend[Series]]) -> list[Adjusted[Series]]:
    """All series of a report, less those of its *trends* that are sure."""
    n_value = sum(n for of in series if (n := of.values.size) >= FEWEST)
    each = []
    for of in series:
        adjusted = _adjust_one(of, [trend for trend in trends if trend.series is of and trend.is_sure])
        limits = control_limits(adjusted.values, n_value) if of.values.size >= FEWEST else None
        each.append(replace(adjusted, limits=limits))
    return each


def _adjust_one(series: Series, steep: Sequence[Trend[Series]]) -> Adjusted[Series]:
    """Of curved values with squares and products of the conditions, as far as these are determined."""
    values, trends = series.values, [of for of in steep if of.condition != DATE]
    if not trends:
        return Adjusted(series, (), np.ones((values.size, 1)), values)
    names = tuple(of.condition for of in trends)
    rows = np.array([series.amounts[name] for name in names])
    # Trends over conditions that are not told apart from each other are one.
    number = len(names) if are_separable(rows) else 1
    columns = straight_columns(rows[:number])
    columns /= np.max(np.abs(columns), axis=0)
    if any(of.line.curved for of in trends):
        columns = bent_columns(columns)
    slopes = weighted_fit(columns, values, *series.parted_errors).values[1:]
    return Adjusted(series, names[:number], columns, values - columns[:, 1:] @ slopes)
