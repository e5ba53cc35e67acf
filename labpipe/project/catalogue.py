"""Index of a results folder: an SQLite file up to date with the results below it, and its queries. Read and
written whole, it needs no lock, and a damaged one is made again.
"""

from __future__ import annotations

import datetime
import functools
import json
import math
import re
import sqlite3
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.dataset_file import amount_of
from labpipe.artefacts.digest import file_sha256
from labpipe.artefacts.header import code_digest
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.json_file import BAD_ENTRY, read_bytes
from labpipe.artefacts.writing import output_file, without_staging
from labpipe.errors import ConfigError, DataError, shorten
from labpipe.project.run_record import days_of_runs, record_of_runs
from labpipe.quantities import UnitError, si_amount
from labpipe.records.finding import WARNING
from labpipe.records.identification import Identification, ListedParameter, listed_parameters, warning_codes
from labpipe.records.sections import section
from labpipe.registry import nearest

INDEX = ".labpipe-catalogue.sqlite"
# Condition of the tests that gives a result's date, and what gives it else.
DATE = "date"
BY_RUN, BY_FILE = "the record of runs", "the last change of its file, which is another in a copy"

_TABLES = """
CREATE TABLE result (
    id INTEGER PRIMARY KEY, path TEXT UNIQUE, stamp TEXT, title TEXT, rig TEXT, pipeline TEXT,
    version TEXT, date TEXT, tests INTEGER, verdict TEXT, warnings TEXT, fault TEXT, dataset INTEGER,
    sources TEXT, dated TEXT
);
CREATE TABLE value (
    id INTEGER PRIMARY KEY, result INTEGER REFERENCES result ON DELETE CASCADE,
    fit TEXT, term TEXT, test TEXT, model TEXT, estimator TEXT, low_hz REAL, high_hz REAL,
    parameter TEXT, value REAL, unit TEXT, std_error REAL, random_error REAL, changes TEXT, dofs TEXT,
    ci_low REAL, ci_high REAL, significant INTEGER, warnings TEXT, date TEXT
);
CREATE TABLE condition (
    result INTEGER REFERENCES result ON DELETE CASCADE,
    test TEXT, name TEXT, text TEXT, amount REAL, unit TEXT
);
CREATE INDEX value_parameter ON value (parameter, fit);
CREATE INDEX condition_name ON condition (result, test, name);
"""
# Where SQLite keeps a number for the application.
_STAMP = slice(60, 64)
# An index of another version or build is made anew.
MADE_BY = f"{__version__} {code_digest()}"


@contextmanager
def open_index(folder: Path) -> Iterator[sqlite3.Connection]:
    """The index of a folder, up to date; in memory where read-only. DataError for no folder or no results."""
    if not folder.is_dir():
        raise DataError("no such folder", folder, "name the folder that holds the results of your runs")
    with closing(_open(folder)) as connection:
        if _bring_up_to_date(connection, folder):
            # Write the index as a whole beside the results, where that is allowed: others may do so at once
            index = folder / INDEX
            if index.is_file() or not index.exists():
                with suppress(DataError, OSError), output_file(index) as path:
                    path.write_bytes(_stamp(connection.serialize()))
        if not connection.execute("SELECT count(*) FROM result").fetchone()[0]:
            hint = "results appear with `labpipe run PIPELINE -o FOLDER/NAME`"
            raise DataError(f"holds no {NAME}", folder, hint)
        yield connection


def _open(folder: Path) -> sqlite3.Connection:
    """The index in memory: as it was kept, or empty where none of this version was, or a damaged one."""
    try:
        kept = read_bytes(folder / INDEX)
    except (DataError, OSError):
        kept = b""
    if kept and kept == _stamp(kept):
        connection = sqlite3.connect(":memory:")
        try:
            connection.deserialize(kept)
            if connection.execute("SELECT version FROM made_by").fetchone() == (MADE_BY,):
                return connection
        except sqlite3.Error:
            # Of another program, under our name.
            connection.close()
    connection = sqlite3.connect(":memory:")
    connection.executescript(_TABLES)
    connection.execute("CREATE TABLE made_by (version TEXT)")
    connection.execute("INSERT INTO made_by VALUES (?)", (MADE_BY,))
    return connection


def _stamp(database: bytes) -> bytes:
    """The database with its CRC-32 as the user's version, by which a damaged index is noticed."""
    first, last = database[: _STAMP.start], database[_STAMP.stop :]
    return first + zlib.crc32(last, zlib.crc32(first)).to_bytes(4, "big") + last


def _bring_up_to_date(connection: sqlite3.Connection, folder: Path) -> bool:
    before = connection.total_changes
    stamps = dict(connection.execute("SELECT path, stamp FROM result"))
    runs = functools.cache(days_of_runs)
    here = {path.relative_to(folder).as_posix(): path for path in without_staging(folder.rglob(NAME))}
    remove = "DELETE FROM result WHERE path = ?"
    connection.execute("PRAGMA foreign_keys = ON")
    connection.executemany(remove, [(name,) for name in stamps.keys() - here.keys()])
    for name, path in here.items():
        try:
            status = path.stat()
        except FileNotFoundError:
            # Removed since the folder was listed.
            continue
        stamp = f"{status.st_mtime_ns}:{status.st_size}:{status.st_ino}"
        if stamps.get(name) != stamp:
            connection.execute(remove, (name,))
            record = record_of_runs(path.parent)
            day = "" if record is None else runs(record).get(file_sha256(path), "")
            dated, changed = BY_RUN if day else BY_FILE, time.gmtime(status.st_mtime)
            day = day or time.strftime("%Y-%m-%d", changed)
            _add(connection, name, path, {"stamp": stamp, "date": day, "dated": dated})
    connection.commit()
    return connection.total_changes != before


def _add(connection: sqlite3.Connection, name: str, path: Path, given: dict[str, str]) -> None:
    try:
        rows = _rows(read_identification(path), given["date"])
    except (DataError, *BAD_ENTRY) as error:
        other = f"holds what labpipe did not write ({type(error).__name__}: {error})"
        what = error.what if isinstance(error, DataError) else other
        rows = [("result", {"verdict": "unreadable", "fault": shorten(what)})]
    (_, whole), *parts = rows
    number = _insert(connection, "result", {"path": name, **given, **whole})
    for table, row in parts:
        _insert(connection, table, {"result": number, **row})


def _rows(identification: Identification, file_date: str) -> list[tuple[str, dict[str, Any]]]:
    """The rows of a result with their tables. One of BAD_ENTRY for entries that labpipe does not write."""
    conditions = {test: _texts(of_test) for test, of_test in identification.test_conditions.items()}
    dates = sorted(of_test[DATE] for of_test in conditions.values() if DATE in of_test)
    entry = {
        "title": identification.title,
        "rig": identification.rig.get("name", ""),
        "pipeline": identification.pipeline,
        "version": identification.version,
        "date": dates[-1] if dates else file_date,
        "tests": len(conditions) if identification.dataset is None else identification.dataset.tests,
        "dataset": int(identification.dataset is not None),
        "verdict": identification.verdict,
        "warnings": ", ".join(sorted(_codes_of(identification))),
        "sources": " ".join(identification.digests),
    }
    rows = [("result", entry)]
    for listed in listed_parameters(identification):
        date = conditions.get(listed.test, {}).get(DATE, str(entry["date"]))
        rows.append(("value", _value_row(listed, date)))
    for test, of_test in conditions.items():
        for condition, text in of_test.items():
            amount, unit = amount_of(text)
            row = {"test": test, "name": condition, "text": text, "amount": amount, "unit": unit}
            rows.append(("condition", row))
    return [(table, _check(row)) for table, row in rows]


def _texts(conditions: Mapping[str, Any]) -> dict[str, str]:
    """Conditions as texts: people write numbers as well."""
    for condition in conditions.values():
        if not isinstance(condition, (str, int, float)):
            raise TypeError(f"{condition!r} is not a condition")
    return {str(name): str(condition) for name, condition in conditions.items()}


def _check(row: dict[str, Any]) -> dict[str, Any]:
    """The row; TypeError or OverflowError for what the index cannot hold."""
    for name, entry in row.items():
        if entry is not None and not isinstance(entry, (str, int, float)):
            raise TypeError(f"{name} is a {type(entry).__name__}")
        if isinstance(entry, str):
            entry.encode()
        if isinstance(entry, int) and abs(entry) >= 1 << 63:
            raise OverflowError(f"{name} is too large")
    return row


def _value_row(listed: ListedParameter, date: str) -> dict[str, Any]:
    parameter = listed.parameter
    low, high = parameter.ci95 or (None, None)
    same = ("fit", "term", "test", "model", "estimator", "random_error")
    row = {name: getattr(listed, name) for name in same}
    row |= {name: getattr(parameter, name) for name in ("value", "unit", "significant")}
    row |= {"parameter": parameter.name, "std_error": parameter.full_error, "ci_low": low, "ci_high": high}
    row |= {"low_hz": listed.band_hz[0], "high_hz": listed.band_hz[1], "date": date}
    row |= {name: json.dumps(dict(getattr(listed, name))) for name in BY_SOURCE}
    return {**row, "warnings": ", ".join(listed.warnings)}


def _insert(connection: sqlite3.Connection, table: str, row: dict[str, Any]) -> int:
    """Add a row and return its number. Table and column names are constants of this module."""
    marks = ", ".join(f":{name}" for name in row)
    cursor = connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", row)
    return int(cursor.lastrowid or 0)


def _codes_of(identification: Identification) -> set[str]:
    of_fits = {code for fit in identification.fits for code in warning_codes(fit)}
    sections = identification.sections.items()
    pairs = (pair for name, record in sections for pair in section(name).findings(record))
    counted = identification.dataset.of_level(WARNING) if identification.dataset else ()
    of_many = {of_kind.finding.code for of_kind in counted}
    return of_fits | of_many | {finding.code for _, finding in pairs if finding.level == WARNING}


# Queries of the index: results, and values of parameters, by rig, condition, date, fit and parameter.

_WHERE = re.compile(r"^\s*(?P<name>[\w.-]+)\s*(?P<sign>>=|<=|!=|=|>|<)\s*(?P<bound>.+?)\s*$")
# Relative tolerance in SI of two amounts written alike.
SAME = 1e-9
# Criteria that are patterns of names, and the SQL of one of several texts, which are given as JSON.
NAMED = ("fit", "test", "parameter")
_AMONG = "IN (SELECT value FROM json_each(?))"


@dataclass(frozen=True)
class Filter:
    """Criteria of a query; names may hold `*`. since, until: days such as 2026-11-03. where: "preload >= 400
    N", "direction = up". source: of the uncertainty of a value, such as a sensor or its certificate.
    """

    rig: str = ""
    fit: str = ""
    test: str = ""
    parameter: str = ""
    since: str = ""
    until: str = ""
    where: tuple[str, ...] = ()
    source: str = ""


def name_of(path: str) -> str:
    """The folder of a result by the path of its file."""
    return path.removesuffix(f"/{NAME}")


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
    """One parameter of one fit [SI]; *conditions* of its test, *amounts* of the numeric ones. random_error:
    without what given numbers add; changes: by each of these, and dofs behind those not known, as JSON.
    digests: of the files behind it. dated: by what, where not by the condition `date`.
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
    digests: frozenset[str] = frozenset()
    dated: str = ""
    dofs: str = "{}"

    @property
    def label(self) -> str:
        """Label of the value beside others of the same parameter."""
        return self.test or name_of(self.path)

    @property
    def title(self) -> str:
        """The fit, with its term."""
        return f"{self.fit} of {self.term}" if self.term else self.fit

    @property
    def band(self) -> str:
        """The band of the fit; empty for a single frequency."""
        return f"{self.low_hz:g}-{self.high_hz:g} Hz" if self.high_hz > self.low_hz else ""


# Columns that are JSON by source, and what a value has beside its columns.
BY_SOURCE = ("changes", "dofs")
NOT_COLUMNS = ("conditions", "amounts", "digests", "dated")
VALUE_COLUMNS = tuple(field.name for field in fields(ValueRow) if field.name not in NOT_COLUMNS)

# Columns of which no result lacks the number, though it may not be one.
NUMBERS = ("value", "low_hz", "high_hz")


def results(index: sqlite3.Connection, criteria: Filter) -> list[ResultRow]:
    """The results with at least one test that meets the criteria, the oldest first."""
    clauses, bound = _clauses(index, criteria)
    columns = [field.name for field in fields(ResultRow)]
    filled = ", ".join(f"coalesce(r.{name}, '')" for name in columns)
    sql = f"SELECT {filled} FROM result r"
    rows = index.execute(f"{sql} WHERE {' AND '.join(clauses)} ORDER BY r.date, r.path", bound)
    return [ResultRow(**dict(zip(columns, row, strict=True))) for row in rows]


def values(index: sqlite3.Connection, criteria: Filter) -> list[ValueRow]:
    """The parameters that meet the criteria, by date, result and fit. ConfigError for an unknown name."""
    clauses, bound = _clauses(index, criteria, "v.date", " AND c.test = v.test")
    for column in NAMED:
        if pattern := getattr(criteria, column):
            names = index.execute(f"SELECT DISTINCT {column} FROM value ORDER BY {column}")
            clauses.append(f"v.{column} {_AMONG}")
            bound.append(json.dumps(names_meant(column, pattern, [name for (name,) in names])))
    columns = ", ".join({"path": "r.path"}.get(name, f"v.{name}") for name in VALUE_COLUMNS)
    sql = f"SELECT {columns}, r.sources, r.dated, r.id FROM value v JOIN result r ON r.id = v.result"
    rows = index.execute(f"{sql} WHERE {' AND '.join(clauses)} ORDER BY v.date, r.path, v.id", bound)
    of_test = functools.cache(functools.partial(_conditions, index))
    value_rows = []
    for *row, sources, dated, number in rows:
        # SQLite has no not-a-number.
        named = zip(VALUE_COLUMNS, row, strict=True)
        entries: dict[str, Any] = {
            name: math.nan if entry is None and name in NUMBERS else entry for name, entry in named
        }
        conditions, amounts = of_test(number, entries["test"])
        entries |= {"conditions": conditions, "amounts": amounts, "digests": frozenset(sources.split())}
        value_rows.append(ValueRow(**entries, dated="" if DATE in conditions else dated))
    return value_rows


def _conditions(
    index: sqlite3.Connection, result: int, test: str
) -> tuple[dict[str, str], dict[str, tuple[float, str]]]:
    sql = "SELECT name, text, amount, unit FROM condition WHERE result = ? AND test = ?"
    rows = index.execute(sql, (result, test)).fetchall()
    texts = {name: text for name, text, _, _ in rows}
    return texts, {name: (amount, unit) for name, _, amount, unit in rows if amount is not None}


def _clauses(
    index: sqlite3.Connection, criteria: Filter, date: str = "r.date", same_test: str = ""
) -> tuple[list[str], list[Any]]:
    clauses, bound = ["1"], []
    if criteria.rig:
        rigs = index.execute("SELECT DISTINCT rig FROM result WHERE rig IS NOT NULL")
        clauses.append(f"r.rig {_AMONG}")
        bound.append(json.dumps([rig for (rig,) in rigs if is_of_rig(criteria.rig, rig)]))
    for sign, day in ((">=", criteria.since), ("<=", criteria.until)):
        if day:
            # Not a number, which nothing is before or after, for what is not a day.
            clauses.append(f"date(substr({date}, 1, 10)) {sign} ?")
            bound.append(checked_day(day))
    for condition in criteria.where:
        name, _, _ = split_condition(condition)
        rows = index.execute("SELECT DISTINCT text, amount, unit FROM condition WHERE name = ?", (name,))
        amounts = {written: (amount, unit) for written, amount, unit in rows}
        if not amounts:
            names = [entry for (entry,) in index.execute("SELECT DISTINCT name FROM condition ORDER BY name")]
            raise ConfigError(f"no test has the condition '{name}'", hint=nearest(name, names))
        begin = f"EXISTS (SELECT 1 FROM condition c WHERE c.result = r.id{same_test} AND c.name = ?"
        clauses.append(f"{begin} AND c.text {_AMONG})")
        bound.extend([name, json.dumps(meeting(condition, amounts))])
    return clauses, bound


def fits(pattern: str, name: str, flags: int = 0) -> bool:
    """Whether a name is one of a pattern in which '*' stands for any characters."""
    return bool(re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), name, flags | re.DOTALL))


def is_of_rig(part: str, rig: str) -> bool:
    """Whether the name of a rig contains *part*, capital or small."""
    return fits(f"*{part}*", rig, re.IGNORECASE)


def names_meant(column: str, pattern: str, names: Sequence[str]) -> list[str]:
    """Those of a column's *names* that a pattern means; ConfigError for none."""
    kept = [name for name in names if fits(pattern, name)]
    if not kept:
        raise ConfigError(f"no result has the {column} '{pattern}'", hint=nearest(pattern, names))
    return kept


def checked_day(text: str) -> str:
    """The day in ISO form; ConfigError for what is none."""
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ConfigError(f"'{text}' is not a date", hint="write it as 2026-11-03") from None


def split_condition(text: str) -> tuple[str, str, str]:
    """Name, sign and bound of a condition such as "preload >= 400 N"; ConfigError for what is none."""
    match = _WHERE.match(text)
    if match is None:
        hint = "for example 'preload >= 400 N' or 'direction = up'"
        raise ConfigError(f"'{text}' is not a condition", hint=hint)
    return match["name"], match["sign"], match["bound"]


def meeting(condition: str, amounts: Mapping[str, tuple[float | None, str]]) -> list[str]:
    """Those of a condition's texts, with their *amounts*, that meet it. ConfigError for one that cannot be
    read, or in another unit than theirs.
    """
    name, sign, bound = split_condition(condition)
    try:
        limit, unit = si_amount(bound)
    except UnitError as error:
        if sign not in ("=", "!="):
            raise ConfigError(f"'{condition}': {error.what}", hint=error.hint) from None
        return [text for text in amounts if (text == bound) == (sign == "=")]
    units = {unit_of_text for _, unit_of_text in amounts.values()}
    if units and unit not in units:
        others = ", ".join(sorted(units - {""})) or "words"
        raise ConfigError(f"'{condition}': the condition '{name}' is in {others}, not in {unit}")
    return [
        text
        for text, (amount, unit_of_text) in amounts.items()
        if (sign == "!=" if amount is None or unit_of_text != unit else _is_so(amount, sign, limit))
    ]


def _is_so(amount: float, sign: str, limit: float) -> bool:
    if abs(amount - limit) <= SAME * max(abs(limit), SAME):
        return sign in ("=", ">=", "<=")
    return sign == "!=" or (amount > limit if sign.startswith(">") else sign[0] == "<" and amount < limit)
