"""What results below a folder hold: search, comparison of two results, trends over conditions or time. The
rows of single results, by their index, and those of datasets, which are asked where they lie, are tables of
one kind.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from labpipe import distributions
from labpipe.arrays import FloatArray
from labpipe.artefacts import dataset_file
from labpipe.errors import ConfigError, DataError
from labpipe.project.catalogue import (
    BY_SOURCE,
    MAY_LACK,
    NAMED,
    VALUE_COLUMNS,
    Filter,
    Index,
    ResultRow,
    ValueRow,
    is_of_rig,
    meeting,
    names_meant,
    open_index,
    results,
    split_condition,
)
from labpipe.records.dataset import DATE, DatasetRow, amount_of, day_of
from labpipe.records.finding import Parameter
from labpipe.records.identification import ListedParameter
from labpipe.registry import list_names, nearest
from labpipe.uncertainty import weighted
from labpipe.uncertainty.amounts import count_once, holm, sources_in_common

# What gives the date of a test of many without the condition `date`.
BY_RECORDING = "the last change of its first recording before it was evaluated"

# What reads the rows of some tests, and what is the same of all of them.
Rows = tuple[Callable[[], pa.Table], Mapping[str, str]]
Chosen = TypeVar("Chosen")
# Amounts of a condition, SI values and units, by its texts; None of words.
Amounts = Mapping[str, tuple[float, str] | None]


def found_values(folder: Path, criteria: Filter) -> list[ValueRow]:
    """The parameters that meet the criteria in all results below a folder, by date and result. ConfigError
    for an unknown name or condition; DataError for a folder without results.
    """
    index = open_index(folder)
    found = _collect(partial(_values, criteria), _all_rows(index, folder, criteria))
    of_rig = {row.path for row in results(index, Filter(rig=criteria.rig))}
    rows = sorted((row for row in found if row.path in of_rig), key=lambda row: (row.date, row.path))
    if not criteria.source:
        return rows
    sources = dict.fromkeys(source for row in rows for source in json.loads(row.changes))
    meant = set(names_meant("source", criteria.source, [*sources]))
    return [row for row in rows if meant & json.loads(row.changes).keys()]


def found_results(folder: Path, criteria: Filter) -> list[ResultRow]:
    """The results with a test that meets the criteria, the oldest first. Errors as of `found_values`."""
    index = open_index(folder)
    rows = results(index, criteria)
    if not criteria.where:
        return rows
    met = set(_collect(partial(_paths, criteria), _all_rows(index, folder, criteria)))
    return [row for row in rows if row.path in met]


def dataset_parameters(folder: Path) -> list[ListedParameter]:
    """The parameters in the dataset of a *folder*, by date and test, ready for comparison."""
    criteria = Filter()
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
        for row in _values(criteria, _dataset_table(folder, criteria), {"path": ".", "dated": ""})
    ]


def _all_rows(index: Index, folder: Path, criteria: Filter) -> list[Rows]:
    """Those of single results, where there are any, and of every dataset below a folder."""
    single: list[Rows] = [(partial(_index_table, index), {})]
    return [
        *(single if any(entry["rows"] for entry in index.values()) else []),
        *(
            (partial(_dataset_table, (folder / path).parent, criteria), {"path": path, "dated": BY_RECORDING})
            for path, entry in index.items()
            if entry["dataset"]
        ),
    ]


def _collect(
    choose: Callable[[pa.Table, Mapping[str, str]], list[Chosen]], asked: Sequence[Rows]
) -> Iterator[Chosen]:
    """What is chosen of all that have what is asked for; the first ConfigError where none has it."""
    faults: list[ConfigError] = []
    for read, shared in asked:
        try:
            yield from choose(read(), shared)
        except ConfigError as error:
            faults.append(error)
    if faults and len(faults) == len(asked):
        raise faults[0]


def _index_table(index: Index) -> pa.Table:
    rows = [(entry, row) for entry in index.values() for row in entry["rows"]]
    table = dataset_file.table_of([DatasetRow(**row) for _, row in rows])
    for name in ("path", "dated", "date"):
        table = table.append_column(name, pa.array([entry[name] for entry, _ in rows], pa.string()))
    return table


def _dataset_table(folder: Path, criteria: Filter) -> pa.Table:
    """The parameters in the dataset of a folder, by date and test, in its parts of the rig and the days."""
    columns = {"full_error" if name == "std_error" else name for name in VALUE_COLUMNS} | {"source"}
    chosen = (
        part
        for part in dataset_file.parts(folder)
        if is_of_rig(criteria.rig, part.rig) and criteria.covers(part.date)
    )
    tables = [dataset_file.read_part(part, columns) for part in chosen]
    if not tables:
        return pa.table({name: pa.array([], pa.string()) for name in (*NAMED, "date")})
    table = pa.concat_tables(tables, promote_options="default")
    return table.filter(pc.is_valid(table["parameter"]))


def _paths(criteria: Filter, table: pa.Table, shared: Mapping[str, str]) -> list[str]:
    """The files of the results whose tests are at the conditions."""
    table = table.filter(reduce(pc.and_, (condition_holds(table, text) for text in criteria.where)))
    return [shared["path"]] * min(table.num_rows, 1) if shared else pc.unique(table["path"]).to_pylist()


def condition_holds(table: pa.Table, text: str) -> Any:
    """Whether a condition holds, for every row; ConfigError for one that no test has, or as of `meeting`."""
    name, _, _ = split_condition(text)
    if dataset_file.CONDITION + name not in table.column_names:
        names = list(dataset_file.columns_of_conditions(table.column_names))
        raise ConfigError(f"no test has the condition '{name}'", hint=nearest(name, names))
    met = pa.array(meeting(text, _amounts(table, name)), pa.string())
    return pc.is_in(table[dataset_file.CONDITION + name], met)


def _amounts(table: pa.Table, condition: str) -> Amounts:
    texts = pc.unique(table[dataset_file.CONDITION + condition].drop_null())
    return {text: amount_of(text) for text in texts.to_pylist()}


def _values(criteria: Filter, table: pa.Table, shared: Mapping[str, str]) -> list[ValueRow]:
    """The parameters among the rows of a *table* that meet the criteria; *shared*: what all rows share."""
    holds = [pc.is_valid(table["parameter"]), *(condition_holds(table, text) for text in criteria.where)]
    for column in NAMED:
        if pattern := getattr(criteria, column):
            names = sorted(pc.unique(table[column].drop_null()).to_pylist())
            kept = names_meant(column, pattern, names)
            holds.append(pc.is_in(table[column], pa.array(kept, pa.string())))
    table = table.filter(reduce(pc.and_, holds))
    conditions = list(dataset_file.columns_of_conditions(table.column_names))
    if shared:
        table = table.sort_by([("date", "ascending"), ("test", "ascending")])
    else:
        # Single results state them in many orders.
        conditions.sort()
    amounts = {condition: _amounts(table, condition) for condition in conditions}
    rows = (value_row({**row, **shared}, amounts) for row in table.to_pylist())
    return [row for row in rows if criteria.covers(row.date)]


def value_row(row: dict[str, Any], amounts: Mapping[str, Amounts]) -> ValueRow:
    """A *row* of a dataset; *amounts*: of its conditions."""
    row = {**row, "std_error": row["full_error"]}
    entries = {name: row[name] for name in VALUE_COLUMNS if name not in BY_SOURCE}
    entries |= {name: None for name in MAY_LACK if entries[name] != entries[name]}
    entries |= {name: json.dumps(dict(row.get(name) or ())) for name in BY_SOURCE}
    texts = {name: text for name in amounts if (text := row[dataset_file.CONDITION + name]) is not None}
    entries["date"] = texts.get(DATE, entries["date"])
    return ValueRow(
        **entries,
        conditions=texts,
        amounts={name: amount for name, text in texts.items() if (amount := amounts[name][text])},
        digests=frozenset((row.get("source") or "").split()),
        dated="" if DATE in texts else row["dated"],
    )


# Comparison of two results, parameter by parameter.


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
        return self.p_value is not None and self.p_value < weighted.LEVEL

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
        dof = weighted.dof_of_sum(parts, np.array([np.inf, np.inf, *dofs]))
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


@dataclass(frozen=True)
class ParameterSeries(weighted.SeriesOfTests):
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
        """Values (n,) [unit]."""
        return np.array([row.value for row in self.rows])

    @property
    def parted_errors(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of each test alone (n,), by sources (n_source, n) [unit], degrees of freedom (n_source,) [1]."""
        errors = np.array([row.random_error for row in self.rows], np.float64)
        return errors, *sources_in_common(
            [(json.loads(row.changes), json.loads(row.dofs)) for row in self.rows]
        )

    @cached_property
    def amounts(self) -> dict[str, FloatArray]:
        """Amounts (n,) [SI] that all tests have and that differ, and the condition."""
        there = weighted.variable_conditions([row.amounts for row in self.rows])
        return {name: np.array(amounts) for name, (_, amounts) in there.items()} | {self.over: self.condition}


def trends(rows: Sequence[ValueRow], over: str) -> list[ParameterSeries]:
    """One series for each fit, term and band; tests without the condition, or a date, are ignored.
    ConfigError where none has it as an amount, or in different dimensions.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.amounts))
    if over != DATE and over not in names:
        raise ConfigError(f"no test has the amount '{over}'", hint=nearest(over, (*names, DATE)))
    groups: dict[tuple[str, str, str], list[ValueRow]] = {}
    for row in rows:
        if day_of(row.date) if over == DATE else over in row.amounts:
            title = f"{row.title} {row.band}".rstrip()
            groups.setdefault((title, row.parameter, row.unit), []).append(row)
    return [_series(fit, parameter, over, group) for (fit, parameter, _), group in groups.items()]


def _series(fit: str, parameter: str, over: str, rows: Sequence[ValueRow]) -> ParameterSeries:
    if over == DATE:
        days = [day for row in rows if (day := day_of(row.date))]
        condition, unit = [float((day - min(days)).days) for day in days], f"d since {min(days)}"
    else:
        units = sorted({row.amounts[over][1] for row in rows})
        if len(units) > 1:
            what = f"the condition '{over}' has the units {', '.join(units)}"
            raise ConfigError(what, hint="write it in one dimension")
        condition, unit = [row.amounts[over][0] for row in rows], units[0]
    pairs = sorted(zip(condition, rows, strict=True), key=lambda pair: (pair[0], pair[1].date, pair[1].path))
    once, copies = count_once(pairs, [(row.value, row.std_error, row.digests) for _, row in pairs])
    places, counted = zip(*once, strict=True)
    return ParameterSeries(
        fit, parameter, over, unit, np.array(places), counted, tuple(row for _, row in copies)
    )
