"""Goodness of fit, standard errors, intervals, collinearity; systematic errors at a minimum of squares."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.distributions import normal_quantile, student_quantile
from labpipe.records.finding import Parameter
from labpipe.records.identification import Goodness


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Result of an estimator: parameters, their covariance, goodness of fit.

    values (n_parameter,) [parameter units]; covariance (n_parameter, n_parameter); scaled_design
    (n_parameter, n_parameter): triangular factor of the design or Jacobian with columns of length 1; dof:
    equations - parameters; parameter_dof (n_parameter,): that of each parameter's regression where a fit is
    of several (ls: one per direction). amplification (n_parameter,) [parameter units]: largest change per
    relative error of the FRF; squares: of the weighted residual [1]; both None where not computed.
    """

    values: FloatArray
    covariance: FloatArray
    scaled_design: FloatArray
    gof: Goodness
    dof: int
    converged: bool = True
    iterations: int = 0
    notes: tuple[str, ...] = ()
    parameter_dof: IntArray | None = None
    amplification: FloatArray | None = None
    squares: float | None = None

    @property
    def student_dof(self) -> IntArray:
        """Degrees of freedom of every parameter's t-ratio, (n_parameter,)."""
        return np.full(self.values.size, self.dof) if self.parameter_dof is None else self.parameter_dof


def determination(right_side: ComplexArray, residual: ComplexArray, n_parameter: int) -> tuple[float, float]:
    """R^2 = 1 - SS_residual / SS_total [1], and adjusted 1 - (1 - R^2)(n - 1)/(n - k), n real equations.

    right_side, residual (n_line, n_dof, n_input). SS_total is about the mean of the real and imaginary parts
    in one column, as in the regression (Lim et al. 2009, eq. 23). Equation (est-r2).
    """
    side = stack(right_side.reshape(-1))
    n = side.size
    total = float(np.sum((side - side.mean()) ** 2))
    r2 = 1 - float(np.sum(np.abs(residual) ** 2)) / total if total > 0 else 0.0
    return r2, 1 - (1 - r2) * (n - 1) / max(n - n_parameter, 1)


@functools.cache
def student_limit(dof: int) -> float:
    """The two-sided 95 % Student quantile."""
    return student_quantile(0.975, max(dof, 1))


def appraise(
    name: str, unit: str, value: float, std_error: float, dof: int, vif: float | None, derived: bool = False
) -> Parameter:
    """An estimated parameter with t-ratio, 95 % interval and significance. Equation (est-interval)."""
    if not np.isfinite(std_error):
        return Parameter(name, value, unit, vif=vif, derived=derived)
    reach = student_limit(dof) * std_error
    ends, ratio = (value - reach, value + reach), value / std_error if std_error > 0 else None
    said: Any = {"t_ratio": ratio, "ci95": ends, "significant": abs(value) > reach}
    return Parameter(name, value, unit, std_error=std_error, vif=vif, derived=derived, **said)


def widen(parameter: Parameter, factor: float) -> Parameter:
    """The parameter with its interval *factor* [1] times as wide; std_error stays that of noise."""
    if parameter.std_error is None:
        return parameter
    error, value = factor * parameter.std_error, parameter.value
    interval, ratio, significant = parameter.ci95, parameter.t_ratio, parameter.significant
    if interval is not None:
        interval = (value + factor * (interval[0] - value), value + factor * (interval[1] - value))
        significant = None if significant is None else bool(interval[0] > 0 or interval[1] < 0)
    ratio = None if ratio is None or factor == 0 else ratio / factor
    return replace(parameter, std_error_inflated=error, ci95=interval, t_ratio=ratio, significant=significant)


# Times the value from which on an end of its interval bounds nothing: its order of magnitude is unknown.
BOUNDLESS = 100.0
UNDETERMINED = f"not determined: at 95 % beyond {BOUNDLESS:g} times the value"


def restate(
    parameter: Parameter, value: float, error: float, ci95: tuple[float, float], **others: Any
) -> Parameter:
    """The parameter with another *value*, full standard *error* and interval *ci95* [all its unit], with
    ratio and significance by these where it has them; *others*: further fields. The value alone, and as the
    reason so, where both ends have one sign and one is BOUNDLESS times as large.
    """
    same_sign = not ci95[0] < 0 < ci95[1] or not math.isfinite(error)
    if same_sign and max(map(abs, ci95)) > BOUNDLESS * abs(value):
        bare = replace(parameter, value=value, **others).without_interval
        why = bare.reason.removeprefix(UNDETERMINED).removeprefix("; ")
        return replace(bare, reason=f"{UNDETERMINED}; {why}".removesuffix("; "))
    return replace(
        parameter,
        value=value,
        std_error_inflated=error,
        ci95=ci95,
        t_ratio=None if parameter.t_ratio is None or error == 0 else value / error,
        significant=None if parameter.significant is None else not ci95[0] <= 0 <= ci95[1],
        **others,
    )


def derive(name: str, unit: str, value: float, std_error: float, dof: int) -> Parameter:
    """A parameter computed from estimated ones, with its propagated standard error."""
    limit = student_limit(dof)
    interval = (value - limit * std_error, value + limit * std_error)
    return Parameter(name, value, unit, std_error=std_error, t_ratio=None, ci95=interval, derived=True)


def inflation_factors(scaled_design: FloatArray) -> FloatArray:
    """Variance inflation of each parameter, (n_parameter,) [1]: diag((W^T W)^-1) of *scaled_design*
    (n_parameter, n_parameter); 1 for an orthogonal column. Equation (est-vif).
    """
    _, singular, vectors = np.linalg.svd(scaled_design, full_matrices=False)
    with np.errstate(divide="ignore"):
        return np.sum((vectors / singular[:, None]) ** 2, axis=0)


def condition_number(scaled_design: FloatArray) -> float:
    """Largest over smallest singular value [1] of a design (n_parameter, n_parameter) of unit columns
    (Belsley, Kuh and Welsch 1980). Equation (est-condition).
    """
    singular = np.linalg.svd(scaled_design, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")


def correlation(covariance: FloatArray) -> FloatArray:
    """The correlation matrix (n, n) [1] of a covariance. Equation (est-correlation)."""
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0, std, 1.0)
    matrix: FloatArray = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def stack(values: ComplexArray) -> FloatArray:
    """Real and imaginary parts (..., 2 n) [unit of the values] of values (..., n), concatenated."""
    return np.concatenate([values.real, values.imag], axis=-1)


def stacked_terms(terms: ComplexArray) -> FloatArray:
    """Regressors (n_parameter, n_line, n_dof, n_input) as real rows (n_parameter, n_equation) [same unit]."""
    rows = np.empty((terms.shape[0], 2, *terms.shape[1:]))
    rows[:, 0], rows[:, 1] = terms.real, terms.imag
    return rows.reshape(terms.shape[0], -1)


def bisect(is_below: Callable[[float], bool], low: float, high: float) -> float:
    """Where *is_below* ends to hold between *low* and *high* [any unit], to the last digit."""
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if is_below(middle) else (low, middle)
    return middle


def mixture_interval(weights: FloatArray, means: FloatArray, deviations: FloatArray) -> tuple[float, float]:
    """The 2.5 and 97.5 % quantiles [any unit] of a mixture of normal distributions, *weights* (n,) [1] of sum
    1, *means* and *deviations* (n,) [any unit].
    """

    def is_below(p: float, x: float) -> bool:
        return bool(weights @ special.ndtr((x - means) / deviations) < p)

    # By rounding, one component alone may lie on either side of its own end.
    margin = 1e-6 * float(np.max(deviations))
    ends = []
    for p in (0.025, 0.975):
        of_each = means + special.ndtri(p) * deviations
        low, high = float(np.min(of_each)) - margin, float(np.max(of_each)) + margin
        ends.append(bisect(functools.partial(is_below, p), low, high))
    return ends[0], ends[1]


def combination_text(names: Sequence[str], direction: FloatArray, least: float = 0.2) -> str:
    """A *direction* (n_parameter,) [-] as "clearance +1.00, viscosity +2.00"; no parts below *least*."""
    # Sorted as printed: parts that look alike keep the order of their names, whatever their last digits.
    order = np.argsort(-np.round(np.abs(direction) / np.max(np.abs(direction)), 2), kind="stable")
    direction = direction / direction[order[0]]
    parts = [f"{names[n]} {direction[n]:+.2f}" for n in order if abs(direction[n]) >= least]
    return ", ".join(parts)


# Singular values of columns of length 1 below which they are dependent.
DEPENDENT = 1e-8


def orthonormal(columns: FloatArray) -> FloatArray:
    """Orthonormal columns (n_datum, rank) [1] that span *columns* (n_datum, n) [any units]."""
    length = np.linalg.norm(columns, axis=0)
    basis, singular, _ = np.linalg.svd(columns[:, length > 0] / length[length > 0], full_matrices=False)
    return basis[:, singular > DEPENDENT]


def steps_by(changes: FloatArray, slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """-C J^T dr (n_source, n_parameter) [parameter units] by changes dr (n_source, n_datum) [1] of the
    residual of slopes J: slopes (n_datum, n_parameter) [1/parameter unit]; covariance (n_parameter,
    n_parameter) [parameter units] (J^T J)^-1. Equation (unc-step).
    """
    return -changes @ slopes @ covariance


# Standard uncertainties of both together from a stated number to what the data ask for, beyond which they
# contradict each other; with many numbers the one of chance among all of them.
FAR, FAR_P = 3.0, 0.01
# Part of a posterior variance by the data below which they say nothing of a number.
SAYS_NOTHING = 1e-9


@dataclass(frozen=True)
class Pulls:
    """What a residual says of numbers that were stated with their uncertainty, each 0 +- 1 standard
    uncertainty away from what was stated.

    likely (n_source,) [standard uncertainties]: the most likely change of each number; asked, error
    (n_source,): what the data ask for, the others within what was stated, and its standard error, large where
    they say nothing. explained [1]: what the residual's squares lose by the most likely changes.
    """

    likely: FloatArray
    asked: FloatArray
    error: FloatArray
    explained: float

    @property
    def sizes(self) -> FloatArray:
        """|asked| over the standard uncertainty of what was asked and what was stated together (n_source,)
        [1]. Equation (unc-pull).
        """
        return np.abs(self.asked) / np.hypot(1.0, self.error)

    @property
    def far(self) -> BoolArray:
        """Whether data and stated number contradict each other (n_source,)."""
        by_chance = -normal_quantile(FAR_P / 2 / max(self.asked.size, 1))
        return self.sizes > max(FAR, by_chance)

    @property
    def factors(self) -> FloatArray:
        """By what each uncertainty grows (n_source,) [1]: to the distance of what the data ask for if far."""
        return np.where(self.far, np.abs(self.asked), 1.0)


@dataclass(frozen=True)
class Stated:
    """Stated numbers as a residual sees them: *changes* (n_source, n_datum) [1] of it by one standard
    uncertainty of each, *at* (n_source,) [standard uncertainties] from what was stated; *by_noise* [1]
    (n_source,), or of all: what noise that is in residual and change may make of their product.
    """

    changes: FloatArray
    at: FloatArray
    by_noise: FloatArray | float = 0.0

    def enlarge(self, factors: FloatArray) -> Stated:
        """The numbers with standard uncertainties *factors* (n_source,) [1] times as large."""
        return Stated(factors[:, None] * self.changes, self.at / factors, self.by_noise * factors)

    @classmethod
    def of(cls, changes: FloatArray) -> Stated:
        """The numbers as they were stated; *changes* (n_source, n_datum) [1]."""
        return cls(changes, np.zeros(len(changes)))


def pulls_of(
    residual: FloatArray, stated: Stated, slopes: FloatArray, covariance: FloatArray, noise: float = 1.0
) -> Pulls:
    """The most likely changes t of stated numbers: least |r + D^T t|^2 / s + |t|^2 over parameters and t.
    residual r (n_datum,) [1] at the minimum; slopes (n_datum, n_parameter) [1/parameter unit], covariance
    (n_parameter, n_parameter) [parameter units]; *noise* s [1]: variance of a projection by noise. Equation
    (unc-explained).
    """
    left = stated.changes + steps_by(stated.changes, slopes, covariance) @ slopes.T
    information = left @ stated.changes.T / noise
    score = stated.changes @ residual / noise + stated.at
    posterior = np.linalg.inv(np.eye(stated.at.size) + information)
    by_data = np.diag(posterior @ information)
    says_nothing = by_data <= SAYS_NOTHING
    share = np.where(says_nothing, SAYS_NOTHING**2, by_data)
    likely = stated.at - posterior @ score
    by_noise = stated.by_noise * (1 - np.minimum(share, 1.0)) / share
    error = np.hypot(np.sqrt(np.maximum(np.diag(posterior), 0.0) / share), by_noise)
    explained = float(noise * (score @ posterior @ score - stated.at @ stated.at))
    return Pulls(likely, np.where(says_nothing, 0.0, likely / share), error, explained)
