"""Queries of the index: results, and values of parameters, by rig, condition, date, fit and parameter."""

from __future__ import annotations

import dataclasses
import datetime
import math
import re
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, si_amount
from labpipe.registry import nearest

_WHERE = re.compile(r"^\s*(?P<name>[\w.-]+)\s*(?P<sign>>=|<=|!=|=|>|<)\s*(?P<bound>.+?)\s*$")
# Relative tolerance in SI of two amounts written alike.
SAME = 1e-9


@dataclass(frozen=True)
class Filter:
    """Criteria of a query; names may hold `*`. since, until: days such as 2026-11-03. where: "preload >= 400 N", "direction = up"."""

    rig: str = ""
    fit: str = ""
    test: str = ""
    parameter: str = ""
    since: str = ""
    until: str = ""
    where: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One identification.json."""

    path: str
    date: str
    rig: str
    title: str
    tests: int
    verdict: str
    warnings: str
    fault: str


@dataclass(frozen=True, kw_only=True)
class ValueRow:
    """One parameter of one fit, in SI units; *conditions* of its test as written, *amounts* of the numeric ones.

    random_error: standard error without what given numbers add; changes: by each of these, as JSON.
    """

    path: str
    date: str
    fit: str
    term: str
    test: str
    model: str
    estimator: str
    low_hz: float
    high_hz: float
    parameter: str
    value: float
    unit: str
    std_error: float | None
    random_error: float | None
    changes: str
    ci_low: float | None
    ci_high: float | None
    warnings: str
    conditions: dict[str, str]
    amounts: dict[str, tuple[float, str]]

    @property
    def label(self) -> str:
        """Label of the value beside others of the same parameter."""
        return self.test or self.path.removesuffix("/identification.json")


VALUE_COLUMNS = tuple(field.name for field in dataclasses.fields(ValueRow) if field.name not in ("conditions", "amounts"))

# Columns of which no result lacks the number, though it may not be one.
NUMBERS = ("value", "low_hz", "high_hz")


def results(index: sqlite3.Connection, criteria: Filter) -> list[ResultRow]:
    """The results with at least one test that meets the criteria, the oldest first."""
    clauses, values = _result_clauses(criteria)
    for condition in criteria.where:
        clause, bounds = _condition_clause(index, condition, "")
        clauses.append(clause)
        values.extend(bounds)
    columns = [field.name for field in dataclasses.fields(ResultRow)]
    sql = f"SELECT {', '.join(f'r.{name}' for name in columns)} FROM result r"
    rows = index.execute(f"{sql}{_where(clauses)} ORDER BY r.date, r.path", values)
    entries: list[dict[str, Any]] = [dict(zip(columns, ("" if entry is None else entry for entry in row), strict=True)) for row in rows]
    return [ResultRow(**entry) for entry in entries]


def values(index: sqlite3.Connection, criteria: Filter) -> list[ValueRow]:
    """The parameters that meet the criteria, by date, result and fit; ConfigError for a name that no result has."""
    clauses, bound = _result_clauses(criteria, "v.date")
    for column in ("fit", "test", "parameter"):
        pattern = getattr(criteria, column)
        if pattern:
            _check_name(index, column, pattern)
            clauses.append(f"v.{column} GLOB ?")
            bound.append(pattern)
    for condition in criteria.where:
        clause, bounds = _condition_clause(index, condition, " AND c.test = v.test")
        clauses.append(clause)
        bound.extend(bounds)
    columns = ", ".join({"path": "r.path"}.get(name, f"v.{name}") for name in VALUE_COLUMNS)
    sql = f"SELECT {columns}, r.id FROM value v JOIN result r ON r.id = v.result"
    rows = index.execute(f"{sql}{_where(clauses)} ORDER BY v.date, r.path, v.id", bound).fetchall()
    cache: dict[tuple[int, str], tuple[dict[str, str], dict[str, tuple[float, str]]]] = {}
    value_rows = []
    for *row, number in rows:
        # SQLite has no not-a-number.
        named = zip(VALUE_COLUMNS, row, strict=True)
        entries: dict[str, Any] = {name: math.nan if entry is None and name in NUMBERS else entry for name, entry in named}
        key = (number, entries["test"])
        if key not in cache:
            cache[key] = _conditions(index, *key)
        conditions, amounts = cache[key]
        value_rows.append(ValueRow(**entries, conditions=conditions, amounts=amounts))
    return value_rows


def _conditions(index: sqlite3.Connection, result: int, test: str) -> tuple[dict[str, str], dict[str, tuple[float, str]]]:
    rows = index.execute("SELECT name, text, amount, unit FROM condition WHERE result = ? AND test = ?", (result, test)).fetchall()
    texts = {name: text for name, text, _, _ in rows}
    return texts, {name: (amount, unit) for name, _, amount, unit in rows if amount is not None}


def _result_clauses(criteria: Filter, date: str = "r.date") -> tuple[list[str], list[Any]]:
    clauses, bound = [], []
    if criteria.rig:
        clauses.append("r.rig LIKE ?")
        bound.append(f"%{criteria.rig}%".replace("*", "%"))
    for sign, day in ((">=", criteria.since), ("<=", criteria.until)):
        if day:
            clauses.append(f"{date} {sign} ?")
            bound.append(checked_day(day))
    return clauses, bound


def checked_day(text: str) -> str:
    """The day in ISO form; ConfigError for what is none."""
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ConfigError(f"'{text}' is not a date", hint="write it as 2026-11-03") from None


def _where(clauses: Sequence[str]) -> str:
    return f" WHERE {' AND '.join(clauses)}" if clauses else ""


def _check_name(index: sqlite3.Connection, column: str, pattern: str) -> None:
    names = [name for (name,) in index.execute(f"SELECT DISTINCT {column} FROM value ORDER BY {column}")]
    if not index.execute(f"SELECT 1 FROM value WHERE {column} GLOB ?", (pattern,)).fetchone():
        raise ConfigError(f"no result has the {column} '{pattern}'", hint=nearest(pattern, names))


def split_condition(text: str) -> tuple[str, str, str]:
    """Name, sign and bound of a condition such as "preload >= 400 N"; ConfigError for what is none."""
    match = _WHERE.match(text)
    if match is None:
        raise ConfigError(f"'{text}' is not a condition", hint="for example 'preload >= 400 N' or 'direction = up'")
    return match["name"], match["sign"], match["bound"]


def with_datasets(index: sqlite3.Connection) -> list[str]:
    """The paths of the results whose tests stand in a dataset beside them."""
    return [path for (path,) in index.execute("SELECT path FROM result WHERE dataset = 1 ORDER BY path")]


def _condition_clause(index: sqlite3.Connection, text: str, same_test: str) -> tuple[str, list[Any]]:
    """The SQL of one condition; ConfigError for an unreadable condition, or one without tests."""
    name, sign, limit = split_condition(text)
    units = {unit for (unit,) in index.execute("SELECT DISTINCT unit FROM condition WHERE name = ?", (name,))}
    if not units:
        names = [entry for (entry,) in index.execute("SELECT DISTINCT name FROM condition ORDER BY name")]
        raise ConfigError(f"no test has the condition '{name}'", hint=nearest(name, names))
    begin = f"EXISTS (SELECT 1 FROM condition c WHERE c.result = r.id{same_test} AND c.name = ? AND "
    try:
        amount, unit = si_amount(limit)
    except UnitError as error:
        if sign not in ("=", "!="):
            raise ConfigError(f"'{text}': {error.what}", hint=error.hint) from None
        return f"{begin}c.text {sign} ?)", [name, limit]
    if unit not in units:
        raise ConfigError(f"'{text}': the condition '{name}' is in {', '.join(sorted(units - {''})) or 'words'}, not in {unit}")
    near = SAME * max(abs(amount), SAME)
    test = {"=": "BETWEEN ? AND ?", "!=": "NOT BETWEEN ? AND ?"}.get(sign)
    if test is not None:
        return f"{begin}c.unit = ? AND c.amount {test})", [name, unit, amount - near, amount + near]
    # Amounts equal within the tolerance fall on the side of the sign that includes equality.
    edge = amount + near if sign in ("<=", ">") else amount - near
    return f"{begin}c.unit = ? AND c.amount {sign} ?)", [name, unit, edge]
