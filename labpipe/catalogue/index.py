"""Index of a results folder: an SQLite file kept up to date with the identification.json files below it; it can be deleted at any time.

It is read whole into memory and written whole: no process waits for another one's lock, and what was damaged is made again.
"""

from __future__ import annotations

import json
import sqlite3
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.code import code_digest
from labpipe.artefacts.dataset_file import amount_of
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.json_file import read_bytes
from labpipe.artefacts.typed_json import RECORD_FAULTS
from labpipe.artefacts.writing import finished, output_file
from labpipe.errors import DataError, cut
from labpipe.records.finding import WARNING
from labpipe.records.identification import Identification, Parameter
from labpipe.records.listed import ListedParameter, listed_parameters, warning_codes
from labpipe.sections import section

INDEX = ".labpipe-catalogue.sqlite"
# Condition of the tests that gives a result's date; by default that of its file.
DATE = "date"

_TABLES = """
CREATE TABLE result (
    id INTEGER PRIMARY KEY, path TEXT UNIQUE, stamp TEXT, title TEXT, rig TEXT, pipeline TEXT, version TEXT, date TEXT,
    tests INTEGER, verdict TEXT, warnings TEXT, fault TEXT, dataset INTEGER
);
CREATE TABLE value (
    id INTEGER PRIMARY KEY, result INTEGER REFERENCES result ON DELETE CASCADE,
    fit TEXT, term TEXT, test TEXT, model TEXT, estimator TEXT, low_hz REAL, high_hz REAL,
    parameter TEXT, value REAL, unit TEXT, std_error REAL, random_error REAL, changes TEXT,
    ci_low REAL, ci_high REAL, significant INTEGER, warnings TEXT, date TEXT
);
CREATE TABLE condition (
    result INTEGER REFERENCES result ON DELETE CASCADE, test TEXT, name TEXT, text TEXT, amount REAL, unit TEXT
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
    """The index of a folder, brought up to date; in memory for a read-only folder.

    DataError for a missing folder or one without results.
    """
    if not folder.is_dir():
        raise DataError("no such folder", where=str(folder), hint="name the folder that holds the results of your runs")
    with closing(_opened(folder)) as connection:
        if _bring_up_to_date(connection, folder):
            _keep(connection, folder)
        if not connection.execute("SELECT count(*) FROM result").fetchone()[0]:
            raise DataError(f"holds no {NAME}", where=str(folder), hint="results appear with `labpipe run PIPELINE -o FOLDER/NAME`")
        yield connection


def _opened(folder: Path) -> sqlite3.Connection:
    """The index in memory: as it was kept, or empty where none of this version was, or a damaged one."""
    try:
        kept = read_bytes(folder / INDEX)
    except (DataError, OSError):
        kept = b""
    if kept and kept == _stamped(kept):
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


def _stamped(database: bytes) -> bytes:
    """The bytes of a database with their CRC-32 in the place of the user's version, by which a damaged index is noticed."""
    first, last = database[: _STAMP.start], database[_STAMP.stop :]
    return first + zlib.crc32(last, zlib.crc32(first)).to_bytes(4, "big") + last


def _keep(connection: sqlite3.Connection, folder: Path) -> None:
    """Write the index beside the results, as a whole: several processes may do so at once. Not to a folder that may not be written."""
    if (folder / INDEX).exists() and not (folder / INDEX).is_file():
        return
    try:
        with output_file(folder / INDEX) as path:
            path.write_bytes(_stamped(connection.serialize()))
    except (DataError, OSError):
        return


def _bring_up_to_date(connection: sqlite3.Connection, folder: Path) -> bool:
    """Read new and changed results, remove deleted ones; True if there were any."""
    before = connection.total_changes
    stamps = dict(connection.execute("SELECT path, stamp FROM result"))
    here = {path.relative_to(folder).as_posix(): path for path in finished(folder.rglob(NAME))}
    for name in stamps.keys() - here.keys():
        _remove(connection, name)
    for name, path in here.items():
        try:
            status = path.stat()
        except FileNotFoundError:
            # Removed since the folder was listed.
            continue
        stamp = f"{status.st_mtime_ns}:{status.st_size}:{status.st_ino}"
        if stamps.get(name) != stamp:
            _remove(connection, name)
            _add(connection, name, path, stamp, time.strftime("%Y-%m-%d", time.localtime(status.st_mtime)))
    connection.commit()
    return connection.total_changes != before


def _remove(connection: sqlite3.Connection, name: str) -> None:
    for (number,) in connection.execute("SELECT id FROM result WHERE path = ?", (name,)).fetchall():
        for table, column in (("value", "result"), ("condition", "result"), ("result", "id")):
            connection.execute(f"DELETE FROM {table} WHERE {column} = ?", (number,))


def _add(connection: sqlite3.Connection, name: str, path: Path, stamp: str, file_date: str) -> None:
    try:
        rows = _rows(read_identification(path), file_date)
    except (DataError, *RECORD_FAULTS) as error:
        what = error.what if isinstance(error, DataError) else f"holds what no labpipe wrote ({type(error).__name__}: {error})"
        rows = [("result", {"date": file_date, "verdict": "unreadable", "fault": cut(what)})]
    number = 0
    for table, row in rows:
        if table == "result":
            number = _insert(connection, table, {"path": name, "stamp": stamp, **row})
        else:
            _insert(connection, table, {"result": number, **row})


def _rows(identification: Identification, file_date: str) -> list[tuple[str, dict[str, Any]]]:
    """The rows of a result with their tables; one of RECORD_FAULTS for entries of other types than labpipe writes."""
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
        "verdict": verdict(identification),
        "warnings": ", ".join(sorted(_all_codes(identification))),
    }
    rows = [("result", _checked(entry))]
    for listed in listed_parameters(identification):
        rows.append(("value", _checked(_value_row(listed, conditions.get(listed.test, {}).get(DATE, str(entry["date"]))))))
    for test, of_test in conditions.items():
        for condition, text in of_test.items():
            amount, unit = amount_of(text)
            rows.append(("condition", _checked({"test": test, "name": condition, "text": text, "amount": amount, "unit": unit})))
    return rows


def _texts(conditions: Mapping[str, Any]) -> dict[str, str]:
    """Conditions as texts: people write numbers as well."""
    for condition in conditions.values():
        if not isinstance(condition, (str, int, float)):
            raise TypeError(f"{condition!r} is no condition")
    return {str(name): str(condition) for name, condition in conditions.items()}


def _checked(row: dict[str, Any]) -> dict[str, Any]:
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
    low, high = interval(parameter)
    return {
        **{name: getattr(listed, name) for name in ("fit", "term", "test", "model", "estimator")},
        **{"low_hz": listed.band_hz[0], "high_hz": listed.band_hz[1]},
        **{"parameter": parameter.name, "value": parameter.value, "unit": parameter.unit},
        **{"std_error": parameter.full_error, "random_error": listed.random_error, "changes": json.dumps(dict(listed.changes))},
        **{"ci_low": low, "ci_high": high},
        **{"significant": parameter.significant, "warnings": ", ".join(listed.warnings), "date": date},
    }


def interval(parameter: Parameter) -> tuple[float | None, float | None]:
    """The ends of the 95 % interval, which is wider than noise alone makes it where the residual is not noise."""
    return (None, None) if parameter.ci95 is None else parameter.ci95


def _insert(connection: sqlite3.Connection, table: str, row: dict[str, Any]) -> int:
    """Add a row and return its number. Table and column names are constants of this module."""
    marks = ", ".join("?" for _ in row)
    cursor = connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))
    return int(cursor.lastrowid or 0)


def verdict(identification: Identification) -> str:
    """Outcome of the rules in a word."""
    if identification.failed:
        return "incomplete"
    if not identification.outcomes:
        return "no rules"
    return "accepted" if identification.accepted else "not accepted"


def _all_codes(identification: Identification) -> set[str]:
    """The warnings of all fits, and of every other section."""
    of_fits = {code for fit in identification.fits for code in warning_codes(fit)}
    pairs = (pair for name, record in identification.sections.items() for pair in section(name).call("findings", record))
    of_many = {counted.finding.code for counted in identification.dataset.of_level(WARNING)} if identification.dataset else set()
    return of_fits | of_many | {finding.code for _, finding in pairs if finding.level == WARNING}
