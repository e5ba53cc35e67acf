"""Trend of a parameter over a condition or over time in selected results, and values beyond their control limits."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.common_sources import joint_errors, matrix_of
from labpipe.campaign.control import ControlLimits, control_limits, straight_trend
from labpipe.campaign.weighted import WeightedFit
from labpipe.catalogue.index import DATE
from labpipe.catalogue.query import ValueRow
from labpipe.errors import ConfigError, FitError
from labpipe.registry import nearest

FEWEST = 3


@dataclass(frozen=True)
class Series:
    """One parameter of one fit in many tests, [SI]; *condition* (n,) in *condition_unit*, ascending."""

    fit: str
    parameter: str
    over: str
    condition_unit: str
    condition: FloatArray
    rows: tuple[ValueRow, ...]

    @property
    def unit(self) -> str:
        return self.rows[0].unit

    @property
    def values(self) -> FloatArray:
        """Values of the parameter, (n,) [unit]."""
        return np.array([row.value for row in self.rows])

    @property
    def errors(self) -> FloatArray:
        """Standard errors (n,) [unit] of each test alone, NaN where missing; or, where tests have sources in common, covariance (n, n)."""
        errors = np.array([np.nan if row.random_error is None else row.random_error for row in self.rows])
        return joint_errors(errors, matrix_of([json.loads(row.changes) for row in self.rows]))

    @property
    def line(self) -> WeightedFit | None:
        """The weighted straight line; None where values, errors or differences of the condition are missing."""
        try:
            return straight_trend(self.condition, self.values, self.errors)
        except FitError:
            return None

    @property
    def limits(self) -> ControlLimits | None:
        """Control limits of the values in the order of their dates; None for fewer than three."""
        return control_limits(np.array([row.value for row in self.by_date])) if len(self.rows) >= FEWEST else None

    @property
    def by_date(self) -> list[ValueRow]:
        return sorted(self.rows, key=lambda row: row.date)

    @property
    def outside(self) -> list[ValueRow]:
        """The values beyond the control limits."""
        return [] if self.limits is None else [self.by_date[place] for place in self.limits.outside]


def trends(rows: Sequence[ValueRow], over: str) -> list[Series]:
    """One series for each fit, term and band; tests without the condition, or with a date that is none, are ignored.

    ConfigError when no test has the condition as an amount, or tests have it in different dimensions.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.amounts))
    if over != DATE and over not in names:
        raise ConfigError(f"no test has the amount '{over}'", hint=nearest(over, (*names, DATE)))
    groups: dict[tuple[str, str, str], list[ValueRow]] = {}
    for row in rows:
        if _day(row) is not None if over == DATE else over in row.amounts:
            band = f" {row.low_hz:g}-{row.high_hz:g} Hz" if row.high_hz > row.low_hz else ""
            name = f"{row.fit} of {row.term}" if row.term else row.fit
            groups.setdefault((name + band, row.parameter, row.unit), []).append(row)
    return [_series(fit, parameter, over, group) for (fit, parameter, _), group in groups.items()]


def _series(fit: str, parameter: str, over: str, rows: Sequence[ValueRow]) -> Series:
    if over == DATE:
        first = min(row.date for row in rows if _day(row) is not None)
        pairs, unit = [(float(_days(first, row.date)), row) for row in rows], f"d since {first}"
    else:
        units = sorted({row.amounts[over][1] for row in rows})
        if len(units) > 1:
            raise ConfigError(f"the condition '{over}' has the units {', '.join(units)}", hint="write it in one dimension")
        pairs, unit = [(row.amounts[over][0], row) for row in rows], units[0]
    pairs.sort(key=lambda pair: (pair[0], pair[1].date, pair[1].path))
    return Series(fit, parameter, over, unit, np.array([x for x, _ in pairs]), tuple(row for _, row in pairs))


def _day(row: ValueRow) -> datetime.date | None:
    """The day of a value; None for a condition `date` that is no date."""
    try:
        return datetime.date.fromisoformat(row.date[:10])
    except ValueError:
        return None


def undated(rows: Sequence[ValueRow]) -> list[ValueRow]:
    """The values whose date is none."""
    return [row for row in rows if _day(row) is None]


def _days(first: str, day: str) -> int:
    return (datetime.date.fromisoformat(day[:10]) - datetime.date.fromisoformat(first[:10])).days
