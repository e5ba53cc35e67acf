"""Amounts of comparisons with intervals, the errors that tests have in common, and their budget."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.estimation.budget import contribute, full_errors
from labpipe.estimation.derived import INTERVAL, with_systematic
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, random_part
from labpipe.records.uncertain import Budget, Uncertainty


def with_error(name: str, unit: str, value: float, std_error: float, quantile: float) -> Parameter:
    """value +- quantile standard errors."""
    reach = quantile * std_error
    ratio = value / std_error if std_error > 0 else None
    plain = Parameter(name, value, unit, std_error=std_error, t_ratio=ratio)
    return replace(plain, ci95=(value - reach, value + reach), significant=abs(value) > reach)


def from_log(name: str, unit: str, log: float, log_error: float, quantile: float) -> Parameter:
    """exp(log) with the interval exp(log +- quantile log_error), wider upwards. Its standard error to first
    order. Equation (comp-log).
    """
    value = math.exp(log)
    interval = (math.exp(log - quantile * log_error), math.exp(log + quantile * log_error))
    return Parameter(name, value, unit, std_error=value * log_error, ci95=interval)


def relative_change(name: str, log: float, log_error: float, quantile: float) -> Parameter:
    """exp(log) - 1 with its interval: a relative difference."""
    factor = from_log(name, "1", log, log_error, quantile)
    assert factor.ci95 is not None
    low, high = (end - 1 for end in factor.ci95)
    return replace(factor, value=factor.value - 1, ci95=(low, high), significant=not low <= 0 <= high)


def chance(name: str, p_value: float | None) -> Parameter:
    """A p-value; NaN where no test was possible."""
    return Parameter(name, math.nan if p_value is None else p_value, "1", derived=True)


def holm(p_values: FloatArray) -> FloatArray:
    """Holm's corrected p-values (n,) [1]: the i-th smallest times n - i + 1, not below those before it; valid
    under any dependence. Equation (comp-holm).
    """
    order = np.argsort(p_values)
    steps = np.maximum.accumulate(p_values[order] * np.arange(p_values.size, 0, -1))
    corrected = np.empty_like(p_values)
    corrected[order] = np.minimum(steps, 1.0)
    return corrected


# Amounts of a comparison with what systematic sources add to their uncertainty, and the budget of all of
# them.

# Share of a combined uncertainty below which the change by a source is rounding: the source cancels.
CANCELLED = 1e-9


def with_budget(
    amounts: Sequence[Parameter],
    sources: Sequence[Uncertainty],
    changes: FloatArray,
    dof: float | None = None,
    logarithmic: Collection[str] = (),
) -> tuple[tuple[Parameter, ...], Budget | None]:
    """The amounts with combined uncertainties, expanded intervals and shares, and their budget, whose sources
    are zero where all of them cancel; as they are without sources.

    changes (n_source, n_amount) [unit of the amount]: by one standard uncertainty of every source. dof:
    degrees of freedom behind the random parts, None where these are known. Intervals of the *logarithmic*
    amounts are those of a factor.
    """
    if not sources:
        return tuple(amounts), None
    random = full_errors(amounts)
    whole = Budget(tuple(amount.name for amount in amounts), random, dof, tuple(sources), changes)
    smallest = CANCELLED * np.hypot(np.nan_to_num(random), whole.systematic)
    counted = np.where((np.abs(changes) > smallest) & np.isfinite(random), changes, 0.0)
    kept = [number for number, row in enumerate(counted) if np.any(row)] or list(range(len(sources)))
    budget = replace(whole, sources=tuple(sources[number] for number in kept), changes=counted[kept])
    stated = list(contribute(with_systematic(amounts, budget), budget, INTERVAL))
    for number, amount in enumerate(stated):
        factor, error = amount.coverage_factor, amount.combined
        if amount.name in logarithmic and factor is not None and error is not None and amount.value > 0:
            reach = float(np.exp(factor * error / amount.value))
            stated[number] = replace(amount, ci95=(amount.value / reach, amount.value * reach))
    return tuple(stated), budget


# Errors that tests have in common: the uncertainty of one sensor, one mass, which no repetition shows and
# which a ratio may not carry.


def random_error(fit: Fit, parameter: Parameter) -> float | None:
    """Standard error [unit of the parameter] without what given numbers add; None where there is none."""
    return parameter.full_error if (random := random_part(fit, parameter)) is None else random


def common_changes(fits: Sequence[Fit], change_of: Callable[[Fit, str], float]) -> FloatArray:
    """Changes (n_source, n_fit) of one quantity of every fit [unit of the quantity] by one standard
    uncertainty of every source. *change_of*: of a fit and a source. Sources of one name are one error; none
    gives (0, n_fit).
    """
    return matrix_of(
        [
            {} if fit.budget is None else {s.source: change_of(fit, s.source) for s in fit.budget.sources}
            for fit in fits
        ]
    )


def source_dofs(fits: Sequence[Fit]) -> FloatArray:
    """Degrees of freedom (n_source,) [1] behind every source of `common_changes`, infinite where it is
    known.
    """
    sources = (source for fit in fits if fit.budget is not None for source in fit.budget.sources)
    return np.array([*{of.source: of.dof or math.inf for of in sources}.values()])


def parameter_changes(fits: Sequence[Fit], name: str) -> FloatArray:
    """Changes (n_source, n_fit) [unit of the parameter] of the parameter *name* of every fit."""
    return common_changes(fits, lambda fit, source: change_in(fit, source, name))


def change_in(fit: Fit, source: str, name: str) -> float:
    """Change of a parameter [its unit] by one standard uncertainty of a source. Zero where the fit has no
    such source or parameter.
    """
    if fit.budget is None or name not in fit.budget.names:
        return 0.0
    return fit.budget.change_by(source, name)


def matrix_of(changes: Sequence[Mapping[str, float]]) -> FloatArray:
    """Changes (n_source, n) [unit as given] from those of every value by source. Zero where a value does not
    have a source.
    """
    sources = dict.fromkeys(source for of_value in changes for source in of_value)
    rows = [[of_value.get(source, 0.0) for of_value in changes] for source in sources]
    return np.array(rows).reshape(len(sources), len(changes))


def sources_in_common(
    values: Sequence[tuple[Mapping[str, float], Mapping[str, float]]],
) -> tuple[FloatArray, FloatArray]:
    """Changes (n_source, n) [unit as given] of *values* as of `matrix_of`, and degrees of freedom (n_source,)
    [1] behind every source. A value is given by its changes, and the degrees of freedom of those sources that
    are not known.
    """
    changes = [of_value for of_value, _ in values]
    stated = {source: dof for _, dofs in values for source, dof in dofs.items()}
    sources = dict.fromkeys(source for of_value in changes for source in of_value)
    return matrix_of(changes), np.array([stated.get(source, math.inf) for source in sources])


# Standard errors by which two values of one recording differ at most, computed on different machines.
ALIKE = 1e-6


Row = TypeVar("Row")


def count_once(
    rows: Sequence[Row], amounts: Sequence[tuple[float, float | None, frozenset[str]]]
) -> tuple[list[Row], list[Row]]:
    """The rows that count beside the others, and copies of these, by *amounts*: value, standard error and
    digests of the files behind each. Of those of one recording the first counts: they agree within ALIKE
    standard errors, as do their errors, and share a digest.
    """
    values, errors = np.array([amount[:2] for amount in amounts], np.float64).T
    digests, counted = [amount[2] for amount in amounts], [True] * len(rows)
    for first, other in itertools.pairwise(np.argsort(values, kind="stable").tolist()):
        apart = max(abs(values[other] - values[first]), abs(errors[other] - errors[first]))
        if apart <= ALIKE * errors[first] > 0 and digests[first] & digests[other]:
            counted[other] = False
    once = list(itertools.compress(rows, counted))
    return once, [row for row, counts in zip(rows, counted, strict=True) if not counts]


def joint_errors(errors: FloatArray, changes: FloatArray) -> FloatArray:
    """Errors (n,) of independent values, or the covariance (n, n) [unit^2 of the values] where *changes*
    (n_source, n) are common to them. Equations (unc-common) and (comp-covariance).
    """
    if not np.any(changes):
        return errors
    return (np.diag(errors**2) if errors.ndim == 1 else errors) + changes.T @ changes
