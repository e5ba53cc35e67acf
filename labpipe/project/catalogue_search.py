"""What results below a folder hold: search, comparison of two results, trends over conditions or time. Single
results are found by their index, which spares reading their JSON; those of many tests by their datasets,
which are asked where they lie.
"""

from __future__ import annotations

import datetime
import functools
import itertools
import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from labpipe import distributions
from labpipe.arrays import FloatArray
from labpipe.artefacts import dataset_file
from labpipe.artefacts.identification_file import NAME
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.project.catalogue import (
    BY_SOURCE,
    DATE,
    NAMED,
    VALUE_COLUMNS,
    Filter,
    ResultRow,
    ValueRow,
    checked_day,
    is_of_rig,
    meeting,
    names_meant,
    open_index,
    results,
    split_condition,
    values,
)
from labpipe.records.finding import Parameter
from labpipe.records.identification import ListedParameter
from labpipe.registry import list_names, nearest
from labpipe.uncertainty.amounts import count_once, sources_in_common
from labpipe.uncertainty.bandwise import holm
from labpipe.uncertainty.weighted import (
    ControlLimits,
    WeightedFit,
    control_limits,
    dof_of_sum,
    straight_trend,
)

# Columns of the dataset by those of a listed value, where they differ.
_NAMES = {"std_error": "full_error"}
_GIVEN = ("path", "date")
# What gives the date of a test of many without the condition `date`.
BY_RECORDING = "the last change of its first recording before it was evaluated"


def dataset_values(folder: Path, name: str, criteria: Filter) -> list[ValueRow]:
    """The parameters in the dataset of a *folder*, listed as *name*, that meet the criteria, by date and
    test. ConfigError for a name or a condition that no test has.
    """
    table = _choose(folder, criteria)
    for column in NAMED:
        if pattern := getattr(criteria, column):
            names = [name for name in pc.unique(table[column]).to_pylist() if name is not None]
            kept = names_meant(column, pattern, names)
            table = table.filter(pc.is_in(table[column], pa.array(kept, pa.string())))
    table = _filter_conditions(table, criteria.where)
    names = list(dataset_file.columns_of_conditions(table.column_names))
    amounts = {condition: _amounts(table, condition) for condition in names}
    sorted_rows = table.sort_by([("date", "ascending"), ("test", "ascending")]).to_pylist()
    rows = [value_row(row, (Path(name) / NAME).as_posix(), amounts) for row in sorted_rows]
    # A date that is not a day is neither before nor after another.
    return [row for row in rows if _day(row) is not None or not (criteria.since or criteria.until)]


def dataset_parameters(folder: Path) -> list[ListedParameter]:
    """The parameters in the dataset of a *folder*, by date and test, ready for comparison."""
    return [
        ListedParameter(
            fit=row.fit,
            parameter=Parameter(row.parameter, row.value, row.unit, std_error=row.std_error),
            test=row.test,
            term=row.term,
            model=row.model,
            estimator=row.estimator,
            band_hz=(row.low_hz, row.high_hz),
            random=row.random_error,
            changes=json.loads(row.changes),
            dofs=json.loads(row.dofs),
        )
        for row in dataset_values(folder, ".", Filter())
    ]


def _choose(folder: Path, criteria: Filter) -> pa.Table:
    columns = {_NAMES.get(name, name) for name in VALUE_COLUMNS if name not in _GIVEN} | {"source"}
    chosen = (part for part in dataset_file.parts(folder) if _may_hold(part, criteria))
    tables = [dataset_file.read_part(part, columns) for part in chosen]
    if not tables:
        return pa.table({name: pa.array([], pa.string()) for name in (*NAMED, "date")})
    table = pa.concat_tables(tables, promote_options="default")
    return table.filter(pc.is_valid(table["parameter"]))


def _may_hold(part: dataset_file.DatasetPart, criteria: Filter) -> bool:
    since, until = (checked_day(day) if day else "" for day in (criteria.since, criteria.until))
    in_time = (not since or part.date >= since) and (not until or part.date <= until)
    return in_time and (not criteria.rig or is_of_rig(criteria.rig, part.rig))


def _filter_conditions(table: pa.Table, conditions: Sequence[str]) -> pa.Table:
    for text in conditions:
        table = table.filter(condition_holds(table, text))
    return table


def condition_holds(table: pa.Table, text: str) -> Any:
    """Whether a condition holds, for every row; ConfigError for one that no test has, or as of `meeting`."""
    name, _, _ = split_condition(text)
    if dataset_file.CONDITION + name not in table.column_names:
        names = list(dataset_file.columns_of_conditions(table.column_names))
        raise ConfigError(f"no test has the condition '{name}'", hint=nearest(name, names))
    met = pa.array(meeting(text, _amounts(table, name)), pa.string())
    return pc.is_in(table[dataset_file.CONDITION + name], met)


def _amounts(table: pa.Table, condition: str) -> dict[str, tuple[float | None, str]]:
    texts = pc.unique(table[dataset_file.CONDITION + condition]).to_pylist()
    return {text: dataset_file.amount_of(text) for text in texts if text is not None}


def value_row(
    row: dict[str, Any], path: str, amounts: Mapping[str, Mapping[str, tuple[float | None, str]]]
) -> ValueRow:
    """A *row* of a dataset at *path*; *amounts*: SI values and units of its conditions by their texts."""
    given = ("path", *BY_SOURCE)
    entries = {name: row[_NAMES.get(name, name)] for name in VALUE_COLUMNS if name not in given}
    entries |= {name: json.dumps(dict(row.get(name) or ())) for name in BY_SOURCE}
    texts = {name: text for name in amounts if (text := row[dataset_file.CONDITION + name]) is not None}
    of_row = {name: amounts[name][text] for name, text in texts.items()}
    entries["date"] = texts.get(DATE, entries["date"])
    return ValueRow(
        **entries,
        path=path,
        conditions=texts,
        amounts={name: (amount, unit) for name, (amount, unit) in of_row.items() if amount is not None},
        digests=frozenset(filter(None, [row.get("source")])),
        dated="" if DATE in texts else BY_RECORDING,
    )


def _homes(index: sqlite3.Connection, folder: Path) -> dict[str, Path]:
    rows = index.execute("SELECT path FROM result WHERE dataset = 1 ORDER BY path")
    return {Path(path).parent.as_posix(): (folder / path).parent for (path,) in rows}


Row = TypeVar("Row", ResultRow, ValueRow)


def found_values(folder: Path, criteria: Filter) -> list[ValueRow]:
    """The parameters that meet the criteria in all results below a folder, by date and result. ConfigError
    for an unknown name or condition; DataError for a folder without results.
    """
    with open_index(folder) as index:
        homes = _homes(index, folder).items()
        of_datasets = [functools.partial(dataset_values, home, name, criteria) for name, home in homes]
        rows = _collect_rows(index, functools.partial(values, index, criteria), of_datasets)
    if not criteria.source:
        return rows
    sources = dict.fromkeys(source for row in rows for source in json.loads(row.changes))
    meant = set(names_meant("source", criteria.source, [*sources]))
    return [row for row in rows if meant & json.loads(row.changes).keys()]


def _keep(row: ResultRow, home: Path, criteria: Filter) -> list[ResultRow]:
    return [row] if _filter_conditions(_choose(home, criteria), criteria.where).num_rows else []


def found_results(folder: Path, criteria: Filter) -> list[ResultRow]:
    """The results with a test that meets the criteria, the oldest first. Errors as of `found_values`."""
    with open_index(folder) as index:
        homes = _homes(index, folder)
        if not homes or not criteria.where:
            return results(index, criteria)
        everything = results(index, Filter(rig=criteria.rig, since=criteria.since, until=criteria.until))
        pairs = ((row, homes.get(Path(row.path).parent.as_posix())) for row in everything)
        of_datasets = [
            functools.partial(_keep, row, home, criteria) for row, home in pairs if home is not None
        ]
        return _collect_rows(index, functools.partial(results, index, criteria), of_datasets)


def _collect_rows(
    index: sqlite3.Connection,
    of_index: Callable[[], list[Row]],
    of_datasets: Sequence[Callable[[], list[Row]]],
) -> list[Row]:
    """The rows of all that have what is asked for; the first ConfigError where none has."""
    asked: list[Callable[[], list[Row]]] = list(of_datasets)
    if index.execute("SELECT 1 FROM value LIMIT 1").fetchone():
        asked.insert(0, of_index)
    rows: list[Row] = []
    faults: list[ConfigError] = []
    for ask in asked:
        try:
            rows.extend(ask())
        except ConfigError as error:
            faults.append(error)
    if faults and len(faults) == len(asked):
        raise faults[0]
    return sorted(rows, key=lambda row: (row.date, row.path))


# Comparison of two results, parameter by parameter.

LEVEL = 0.05


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One parameter in two results [SI]. p_value: probability of an equal or larger difference by the
    standard errors, corrected for the number compared (Holm); None where one is missing.
    """

    fit: str
    test: str
    parameter: str
    unit: str
    first: float
    second: float
    std_error: float | None
    p_value: float | None

    @property
    def differs(self) -> bool:
        return self.p_value is not None and self.p_value < LEVEL

    @property
    def is_same(self) -> bool:
        """Whether the two agree; without a standard error only if they are equal."""
        return self.first == self.second if self.p_value is None else not self.differs


def differences(first: Iterable[ListedParameter], second: Iterable[ListedParameter]) -> list[Difference]:
    """The parameters common to two results, in the order of the first one; DataError when there is none.

    t = (b - a) / sqrt(s_a^2 + s_b^2 + sum (c_b - c_a)^2), c the changes by sources that both may have in
    common, two-sided, with Welch and Satterthwaite's degrees of freedom of sources that are not known, Holm's
    correction over all of them. Parameters are
    matched by fit, term, band, test, name and unit; the test's name is ignored where neither result has two.
    """
    mine, others = list(first), list(second)
    one_test = _have_one_test(mine, others)
    theirs = {_key(listed, one_test): listed for listed in others}
    pairs = [
        _difference(listed, partner)
        for listed in mine
        if (partner := theirs.get(_key(listed, one_test))) is not None
    ]
    if not pairs:
        of_fits, of_tests = (
            [
                list_names([*dict.fromkeys(getattr(listed, column) for listed in side)])
                for side in (mine, others)
            ]
            for column in ("fit", "test")
        )
        names = (
            f"fits: {'; '.join(of_fits)}"
            if len({*of_fits}) > 1 or len({*of_tests}) == 1
            else f"tests: {'; '.join(of_tests)}"
        )
        hint = "name, term, band and test must be the same"
        raise DataError(f"the two have no fit in common ({names})", hint=hint)
    with_p_value = [number for number, pair in enumerate(pairs) if pair.p_value is not None]
    corrected = holm(np.array([pairs[number].p_value for number in with_p_value], np.float64))
    for number, p_value in zip(with_p_value, corrected, strict=True):
        pairs[number] = replace(pairs[number], p_value=float(p_value))
    return pairs


def lone_parameters(
    mine: Sequence[ListedParameter], others: Sequence[ListedParameter]
) -> Iterator[tuple[str, ...]]:
    """What only the first, and what only the second of two results has, of the same unit: such as 'pedestal,
    test a: k [N/m]'. These are not compared.
    """
    one_test = _have_one_test(mine, others)
    keys = [{_key(listed, one_test) for listed in side} for side in (mine, others)]
    for side, there in zip((mine, others), reversed(keys), strict=True):
        alone = (listed for listed in side if _key(listed, one_test) not in there)
        yield tuple(
            f"{listed.title}{f', test {listed.test}' if listed.test and not one_test else ''}: "
            f"{listed.parameter.name} [{listed.parameter.unit}]"
            for listed in alone
        )


def _have_one_test(*sides: Sequence[ListedParameter]) -> bool:
    return all(len({listed.test for listed in side} - {""}) < 2 for side in sides)


def _key(listed: ListedParameter, one_test: bool) -> tuple[str, ...]:
    band = f"{listed.band_hz[0]:g}-{listed.band_hz[1]:g}"
    test, parameter = "" if one_test else listed.test, listed.parameter
    return listed.fit, listed.term, band, test, parameter.name, parameter.unit


def _difference(mine: ListedParameter, other: ListedParameter) -> Difference:
    changes, dofs = sources_in_common([(of.changes, of.dofs) for of in (mine, other)])
    first, second = mine.random_error, other.random_error
    error = p_value = None
    if first and second:
        parts = np.array([first, second, *(changes[:, 1] - changes[:, 0])])
        error = float(np.sqrt(np.sum(parts**2)))
    value, other_value = mine.parameter.value, other.parameter.value
    if error is not None and np.isfinite(error + value + other_value):
        dof = dof_of_sum(parts, np.array([np.inf, np.inf, *dofs]))
        p_value = distributions.two_sided((other_value - value) / error, dof)
    return Difference(
        fit=mine.title,
        test=mine.test,
        parameter=mine.parameter.name,
        unit=mine.parameter.unit,
        first=value,
        second=other_value,
        std_error=error,
        p_value=p_value,
    )


# Trend of a parameter over a condition or over time in selected results, and values beyond their control
# limits.

FEWEST = 3


@dataclass(frozen=True)
class ParameterSeries:
    """One parameter of one fit in many tests, [SI]; *condition* (n,) in *condition_unit*, ascending. copies:
    values of the same recordings as *rows*, which count once.
    """

    fit: str
    parameter: str
    over: str
    condition_unit: str
    condition: FloatArray
    rows: tuple[ValueRow, ...]
    copies: tuple[ValueRow, ...] = ()

    @property
    def unit(self) -> str:
        return self.rows[0].unit

    @property
    def values(self) -> FloatArray:
        """Values of the parameter, (n,) [unit]."""
        return np.array([row.value for row in self.rows])

    @property
    def line(self) -> WeightedFit | None:
        """The weighted line; None where values, errors or differences of the condition are missing."""
        errors = np.array([row.random_error for row in self.rows], np.float64)
        sources = sources_in_common([(json.loads(row.changes), json.loads(row.dofs)) for row in self.rows])
        try:
            return straight_trend(self.condition, self.values, errors, *sources)
        except FitError:
            return None

    @property
    def limits(self) -> ControlLimits | None:
        """Control limits of the values in the order of their dates; None for fewer than three."""
        values = np.array([row.value for row in self.by_date])
        return control_limits(values) if values.size >= FEWEST else None

    @property
    def by_date(self) -> list[ValueRow]:
        return sorted(self.rows, key=lambda row: row.date)

    @property
    def outside(self) -> list[ValueRow]:
        """The values beyond the control limits."""
        return [] if self.limits is None else [self.by_date[place] for place in self.limits.outside]


def trends(rows: Sequence[ValueRow], over: str) -> list[ParameterSeries]:
    """One series for each fit, term and band; tests without the condition, or a date, are ignored.
    ConfigError where none has it as an amount, or in different dimensions.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.amounts))
    if over != DATE and over not in names:
        raise ConfigError(f"no test has the amount '{over}'", hint=nearest(over, (*names, DATE)))
    groups: dict[tuple[str, str, str], list[ValueRow]] = {}
    for row in rows:
        if _day(row) is not None if over == DATE else over in row.amounts:
            title = f"{row.title} {row.band}".rstrip()
            groups.setdefault((title, row.parameter, row.unit), []).append(row)
    return [_series(fit, parameter, over, group) for (fit, parameter, _), group in groups.items()]


def _series(fit: str, parameter: str, over: str, rows: Sequence[ValueRow]) -> ParameterSeries:
    if over == DATE:
        days = [datetime.date.fromisoformat(row.date[:10]) for row in rows]
        condition, unit = [float((day - min(days)).days) for day in days], f"d since {min(days)}"
    else:
        units = sorted({row.amounts[over][1] for row in rows})
        if len(units) > 1:
            what = f"the condition '{over}' has the units {', '.join(units)}"
            raise ConfigError(what, hint="write it in one dimension")
        condition, unit = [row.amounts[over][0] for row in rows], units[0]
    pairs = sorted(zip(condition, rows, strict=True), key=lambda pair: (pair[0], pair[1].date, pair[1].path))
    places, of_rows = zip(*pairs, strict=True)
    values, errors = np.array([(row.value, row.std_error) for row in of_rows], np.float64).T
    counted = count_once(values, errors, [row.digests for row in of_rows])
    copies = tuple(row for row, counts in zip(of_rows, counted, strict=True) if not counts)
    once = tuple(itertools.compress(of_rows, counted))
    return ParameterSeries(fit, parameter, over, unit, np.array(places)[counted], once, copies)


def _day(row: ValueRow) -> datetime.date | None:
    try:
        return datetime.date.fromisoformat(row.date[:10])
    except ValueError:
        return None


def undated_rows(rows: Sequence[ValueRow]) -> list[ValueRow]:
    """The values whose date is none."""
    return [row for row in rows if _day(row) is None]
