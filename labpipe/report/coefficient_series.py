"""One coefficient in many results: its values with their doubt, and the conditions of the tests that they come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.common_sources import joint_errors, matrix_of
from labpipe.quantities import UnitError, display_unit, si_amount, to_display
from labpipe.records.identification import Identification, of_points
from labpipe.records.listed import ListedParameter, listed_parameters
from labpipe.records.parameter import Parameter
from labpipe.report.chart import Axis
from labpipe.report.cover import DATES
from labpipe.report.wording import unit_text


@dataclass(frozen=True)
class Value:
    """A parameter of a fit in one result; *label*: distinct label of the test, *day* is None where no condition gives it.

    random_error: standard error of this test alone; changes: by sources that tests may have in common.
    """

    label: str
    parameter: Parameter
    conditions: dict[str, tuple[float, str]]
    day: date | None
    random_error: float | None = None
    changes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class CoefficientSeries:
    """The values of one parameter of one fit, by their dates where all tests have one, else as the results were given."""

    fit: str
    name: str
    values: tuple[Value, ...]

    @property
    def title(self) -> str:
        """The parameter and its fit."""
        return f"{self.name} of {self.fit}"

    @property
    def unit(self) -> str:
        """The unit that all values are shown in."""
        return display_unit(self.values[0].parameter.unit)

    @property
    def axis(self) -> Axis:
        """The ordinate of its figures."""
        return Axis(self.name, unit_text(self.values[0].parameter.unit))

    @property
    def dated(self) -> bool:
        """Whether the conditions give a date for every value."""
        return all(value.day is not None for value in self.values)

    def shown(self) -> FloatArray:
        """Values (n,) [display unit]."""
        return np.array([to_display(value.parameter.value, self.unit) for value in self.values])

    def errors(self) -> FloatArray:
        """Standard errors (n,) [display unit], NaN where a fit has none."""
        zero = to_display(0.0, self.unit)
        errors = [value.parameter.full_error for value in self.values]
        return np.array([np.nan if error is None else abs(to_display(error, self.unit) - zero) for error in errors])

    def joint_errors(self) -> FloatArray:
        """Standard errors (n,) [display unit] of each test alone, or the covariance (n, n) where tests have sources in common."""
        scale = abs(to_display(1.0, self.unit) - to_display(0.0, self.unit))
        alone = np.array([np.nan if value.random_error is None else scale * value.random_error for value in self.values])
        return joint_errors(alone, scale * matrix_of([value.changes for value in self.values]))

    def intervals(self) -> FloatArray:
        """95 % intervals (n, 2) [display unit], NaN where there is none."""
        ends = [value.parameter.ci95 or (np.nan, np.nan) for value in self.values]
        return np.array([[to_display(end, self.unit) for end in pair] for pair in ends])

    def over(self) -> dict[str, tuple[Axis, FloatArray]]:
        """condition -> (axis, values (n,) [axis unit]) for every amount that all tests have and that differs between them."""
        names = [name for name in self.values[0].conditions if all(name in value.conditions for value in self.values)]
        conditions = {}
        for name in names:
            units = {value.conditions[name][1] for value in self.values}
            if len(units) == 1 and len({value.conditions[name][0] for value in self.values}) > 1:
                unit = units.pop()
                amounts = [to_display(value.conditions[name][0], display_unit(unit)) for value in self.values]
                conditions[name] = (Axis(name, unit_text(unit)), np.array(amounts))
        days = [value.day for value in self.values if value.day is not None]
        if self.dated and len(set(days)) > 1:
            since = np.array([float((day - min(days)).days) for day in days])
            conditions["date"] = (Axis(f"days since {min(days).isoformat()}", "d"), since)
        return conditions


def coefficient_series(results: Sequence[tuple[str, Identification]]) -> list[CoefficientSeries]:
    """Every parameter that two results or more have, of fits and other sections; sliding fits are drawn over frequency instead."""
    groups: dict[tuple[str, str], list[Value]] = {}
    for result, identification in results:
        for listed in single_parameters(identification):
            title = f"{listed.fit} of {listed.term}" if listed.term else listed.fit
            groups.setdefault((title, listed.parameter.name), []).append(_value(result, identification, listed))
    series = [CoefficientSeries(fit, name, _ordered(values)) for (fit, name), values in groups.items() if len(values) > 1]
    return [entry for entry in series if len({value.parameter.unit for value in entry.values}) == 1]


def single_parameters(identification: Identification) -> list[ListedParameter]:
    """Parameters that occur once for their fit, test and term."""
    rows = [listed for listed in listed_parameters(identification) if not of_points(listed.model)]
    counts = Counter((listed.fit, listed.test, listed.term, listed.parameter.name) for listed in rows)
    return [listed for listed in rows if counts[listed.fit, listed.test, listed.term, listed.parameter.name] == 1]


def _ordered(values: Sequence[Value]) -> tuple[Value, ...]:
    if any(value.day is None for value in values):
        return tuple(values)
    return tuple(sorted(values, key=lambda value: value.day or date.min))


def _value(result: str, identification: Identification, listed: ListedParameter) -> Value:
    label = f"{result}, {listed.test}" if listed.test and result else listed.test or result
    conditions = identification.test_conditions.get(listed.test, {})
    amounts = {name: amount for name, text in conditions.items() if (amount := _amount(str(text))) is not None}
    days = (_day(str(text)) for name, text in conditions.items() if name.lower() in DATES)
    day = next((day for day in days if day is not None), None)
    return Value(label, listed.parameter, amounts, day, listed.random_error, listed.changes)


def _amount(text: str) -> tuple[float, str] | None:
    try:
        return si_amount(text)
    except UnitError:
        return None


def _day(text: str) -> date | None:
    """The day of an ISO date such as 2026-03-02 or 2026-03-02T14:10."""
    try:
        return date.fromisoformat(text[:10])
    except ValueError:
        return None
