"""Queries of a dataset of results: its parts are read column by column, and only those whose folders can hold what is asked for."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from labpipe.artefacts.dataset_file import AMOUNT, CONDITION, Part, amount_of, columns_of_conditions, parts, read_part
from labpipe.artefacts.identification_file import NAME
from labpipe.catalogue.query import SAME, VALUE_COLUMNS, Filter, ValueRow, checked_day, split_condition
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, si_amount
from labpipe.records.listed import ListedParameter
from labpipe.records.parameter import Parameter
from labpipe.registry import nearest

# Columns of the dataset by those of a listed value, where they differ.
_NAMES = {"std_error": "full_error"}
_GIVEN = ("path", "date")
_NAMED = ("fit", "test", "parameter")
_COMPARE = {">=": pc.greater_equal, "<=": pc.less_equal, ">": pc.greater, "<": pc.less}


def dataset_values(folder: Path, name: str, criteria: Filter) -> list[ValueRow]:
    """The parameters in the dataset of a *folder* that meet the criteria, by date and test; *name*: of the folder as lists show it.

    ConfigError for a name or a condition that no test has.
    """
    table = _chosen(folder, criteria)
    for column in _NAMED:
        pattern = getattr(criteria, column)
        if pattern:
            table = _by_name(table, column, pattern)
    table = _at_conditions(table, criteria.where)
    conditions = list(columns_of_conditions(table.column_names))
    units = {condition: _unit(table, condition) for condition in conditions}
    rows = table.sort_by([("date", "ascending"), ("test", "ascending")]).to_pylist()
    return [_value_row(row, f"{name}/{NAME}" if name != "." else NAME, conditions, units) for row in rows]


def dataset_parameters(folder: Path) -> list[ListedParameter]:
    """The parameters of all fits in the dataset of a *folder*, by date and test, with what comparing them takes."""
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
        )
        for row in dataset_values(folder, ".", Filter())
    ]


def has_test(folder: Path, criteria: Filter) -> bool:
    """Whether a dataset has a test at the conditions and of the days of the criteria."""
    return bool(_at_conditions(_chosen(folder, criteria), criteria.where).num_rows)


def _chosen(folder: Path, criteria: Filter) -> pa.Table:
    """The rows with a value of the rigs and days asked for."""
    columns = {_NAMES.get(name, name) for name in VALUE_COLUMNS if name not in _GIVEN}
    tables = [read_part(part, columns) for part in parts(folder) if _may_hold(part, criteria)]
    if not tables:
        return pa.table({name: pa.array([], pa.string()) for name in (*_NAMED, "date")})
    table = pa.concat_tables(tables, promote_options="default")
    return table.filter(pc.is_valid(table["parameter"]))


def _may_hold(part: Part, criteria: Filter) -> bool:
    since, until = (checked_day(day) if day else "" for day in (criteria.since, criteria.until))
    in_time = (not since or part.date >= since) and (not until or part.date <= until)
    return in_time and (not criteria.rig or bool(_pattern(f"*{criteria.rig}*").match(part.rig)))


def _pattern(text: str) -> re.Pattern[str]:
    """A name in which '*' stands for any characters."""
    return re.compile(".*".join(re.escape(piece) for piece in text.split("*")) + r"\Z", re.IGNORECASE | re.DOTALL)


def _by_name(table: pa.Table, column: str, pattern: str) -> pa.Table:
    names = [name for name in pc.unique(table[column]).to_pylist() if name is not None]
    kept = [name for name in names if re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), name, re.DOTALL)]
    if not kept:
        raise ConfigError(f"no result has the {column} '{pattern}'", hint=nearest(pattern, names))
    return table.filter(pc.is_in(table[column], pa.array(kept, pa.string())))


def _at_conditions(table: pa.Table, conditions: Sequence[str]) -> pa.Table:
    for text in conditions:
        table = table.filter(_holds(table, text))
    return table


def _holds(table: pa.Table, text: str) -> Any:
    """Whether a condition such as "preload >= 400 N" holds, for every row; ConfigError for one that cannot be read or that no test has."""
    name, sign, bound = split_condition(text)
    if CONDITION + name not in table.column_names:
        raise ConfigError(f"no test has the condition '{name}'", hint=nearest(name, list(columns_of_conditions(table.column_names))))
    try:
        amount, unit = si_amount(bound)
    except UnitError as error:
        if sign not in ("=", "!="):
            raise ConfigError(f"'{text}': {error.what}", hint=error.hint) from None
        return (pc.equal if sign == "=" else pc.not_equal)(table[CONDITION + name], bound)
    present = _unit(table, name)
    if unit != present:
        raise ConfigError(f"'{text}': the condition '{name}' is in {present or 'words'}, not in {unit}")
    near = SAME * max(abs(amount), SAME)
    values = table[AMOUNT + name]
    if sign in ("=", "!="):
        same = pc.less_equal(pc.abs(pc.subtract(values, amount)), near)
        return same if sign == "=" else pc.invert(same)
    return _COMPARE[sign](values, amount + near if sign in ("<=", ">") else amount - near)


def _unit(table: pa.Table, condition: str) -> str:
    """The unit of a condition's amounts; empty for words, and where tests have it in different dimensions."""
    texts = (text for text in pc.unique(table[CONDITION + condition]).to_pylist() if text is not None)
    units = {amount_of(text)[1] for text in texts}
    return units.pop() if len(units) == 1 else ""


def _value_row(row: dict[str, Any], path: str, conditions: Sequence[str], units: dict[str, str]) -> ValueRow:
    entries = {name: row[_NAMES.get(name, name)] for name in VALUE_COLUMNS if name not in ("path", "changes")}
    texts = {name: text for name in conditions if (text := row[CONDITION + name]) is not None}
    return ValueRow(
        **entries,
        path=path,
        changes=json.dumps(dict(row["changes"])),
        conditions=texts,
        amounts={name: (amount, units[name]) for name in texts if (amount := row.get(AMOUNT + name)) is not None},
    )


def folders(names: Sequence[str], folder: Path) -> Iterator[tuple[str, Path]]:
    """The folders of results with a dataset, by the paths of their results below *folder*."""
    for name in names:
        home = Path(name).parent
        yield home.as_posix(), folder / home
