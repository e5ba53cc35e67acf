"""Questions to the index: which results there are, and what they found, by rig, condition, date, fit and parameter."""

from __future__ import annotations

import datetime
import re
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, si_amount
from labpipe.registry import nearest

_WHERE = re.compile(r"^\s*(?P<name>[\w.-]+)\s*(?P<sign>>=|<=|!=|=|>|<)\s*(?P<bound>.+?)\s*$")
# Two amounts that people wrote alike are alike in SI to this.
SAME = 1e-9


@dataclass(frozen=True)
class Filter:
    """What is asked for; names may hold `*`. since, until: days such as 2026-11-03. where: "preload >= 400 N", "direction = up"."""

    rig: str = ""
    fit: str = ""
    test: str = ""
    parameter: str = ""
    since: str = ""
    until: str = ""
    where: tuple[str, ...] = ()


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class ValueRow:
    """One parameter of one fit, in SI units; *conditions* of its test as people wrote them, *amounts* of those that are numbers."""

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
    ci_low: float | None
    ci_high: float | None
    warnings: str
    conditions: dict[str, str]
    amounts: dict[str, tuple[float, str]]

    @property
    def label(self) -> str:
        """How the value is called beside others of its kind."""
        return self.test or self.path.removesuffix("/identification.json")


def results(index: sqlite3.Connection, asked: Filter) -> list[ResultRow]:
    """The results of which at least one test is asked for, the oldest first."""
    clauses, values = _result_clauses(asked)
    for condition in asked.where:
        clause, own = _condition_clause(index, condition, "")
        clauses.append(clause)
        values.extend(own)
    sql = "SELECT r.path, r.date, r.rig, r.title, r.tests, r.verdict, r.warnings, r.fault FROM result r"
    rows = index.execute(f"{sql}{_where(clauses)} ORDER BY r.date, r.path", values)
    return [ResultRow(*(("" if entry is None else entry) for entry in row)) for row in rows]


def values(index: sqlite3.Connection, asked: Filter) -> list[ValueRow]:
    """The parameters that are asked for, by date, result and fit; ConfigError for a name that no result has."""
    clauses, bound = _result_clauses(asked, "v.date")
    for column in ("fit", "test", "parameter"):
        wanted = getattr(asked, column)
        if wanted:
            _check_known(index, column, wanted)
            clauses.append(f"v.{column} GLOB ?")
            bound.append(wanted)
    for condition in asked.where:
        clause, own = _condition_clause(index, condition, " AND c.test = v.test")
        clauses.append(clause)
        bound.extend(own)
    columns = "r.path, v.date, fit, term, test, model, estimator, low_hz, high_hz, parameter, value, unit, std_error, ci_low, ci_high"
    sql = f"SELECT {columns}, v.warnings, r.id FROM value v JOIN result r ON r.id = v.result"
    rows = index.execute(f"{sql}{_where(clauses)} ORDER BY v.date, r.path, v.id", bound).fetchall()
    known: dict[tuple[int, str], tuple[dict[str, str], dict[str, tuple[float, str]]]] = {}
    found = []
    for *row, number in rows:
        key = (number, row[4])
        if key not in known:
            known[key] = _conditions(index, *key)
        found.append(ValueRow(*row, *known[key]))
    return found


def _conditions(index: sqlite3.Connection, result: int, test: str) -> tuple[dict[str, str], dict[str, tuple[float, str]]]:
    rows = index.execute("SELECT name, text, amount, unit FROM condition WHERE result = ? AND test = ?", (result, test)).fetchall()
    texts = {name: text for name, text, _, _ in rows}
    return texts, {name: (amount, unit) for name, _, amount, unit in rows if amount is not None}


def _result_clauses(asked: Filter, date: str = "r.date") -> tuple[list[str], list[Any]]:
    clauses, bound = [], []
    if asked.rig:
        clauses.append("r.rig LIKE ?")
        bound.append(f"%{asked.rig}%".replace("*", "%"))
    for sign, day in ((">=", asked.since), ("<=", asked.until)):
        if day:
            clauses.append(f"{date} {sign} ?")
            bound.append(_day(day))
    return clauses, bound


def _day(text: str) -> str:
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ConfigError(f"'{text}' is no date", hint="write it as 2026-11-03") from None


def _where(clauses: Sequence[str]) -> str:
    return f" WHERE {' AND '.join(clauses)}" if clauses else ""


def _check_known(index: sqlite3.Connection, column: str, wanted: str) -> None:
    known = [name for (name,) in index.execute(f"SELECT DISTINCT {column} FROM value ORDER BY {column}")]
    if not index.execute(f"SELECT 1 FROM value WHERE {column} GLOB ?", (wanted,)).fetchone():
        raise ConfigError(f"no result has the {column} '{wanted}'", hint=nearest(wanted, known))


def _condition_clause(index: sqlite3.Connection, text: str, same_test: str) -> tuple[str, list[Any]]:
    """The SQL for one condition; ConfigError for one that cannot be read or that no test states."""
    match = _WHERE.match(text)
    if match is None:
        raise ConfigError(f"'{text}' is no condition", hint="for example 'preload >= 400 N' or 'direction = up'")
    name, sign = match["name"], match["sign"]
    units = {unit for (unit,) in index.execute("SELECT DISTINCT unit FROM condition WHERE name = ?", (name,))}
    if not units:
        known = [known for (known,) in index.execute("SELECT DISTINCT name FROM condition ORDER BY name")]
        raise ConfigError(f"no test states the condition '{name}'", hint=nearest(name, known))
    begin = f"EXISTS (SELECT 1 FROM condition c WHERE c.result = r.id{same_test} AND c.name = ? AND "
    try:
        amount, unit = si_amount(match["bound"])
    except UnitError as error:
        if sign not in ("=", "!="):
            raise ConfigError(f"'{text}': {error.what}", hint=error.hint) from None
        return f"{begin}c.text {sign} ?)", [name, match["bound"]]
    if unit not in units:
        raise ConfigError(f"'{text}': the condition '{name}' is in {', '.join(sorted(units - {''})) or 'words'}, not in {unit}")
    near = SAME * max(abs(amount), SAME)
    test = {"=": "BETWEEN ? AND ?", "!=": "NOT BETWEEN ? AND ?"}.get(sign)
    if test is not None:
        return f"{begin}c.unit = ? AND c.amount {test})", [name, unit, amount - near, amount + near]
    # Amounts that are alike fall on the side of the sign that includes equality.
    edge = amount + near if sign in ("<=", ">") else amount - near
    return f"{begin}c.unit = ? AND c.amount {sign} ?)", [name, unit, edge]
