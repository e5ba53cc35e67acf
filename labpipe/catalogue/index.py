"""Index of a results folder: an SQLite file kept up to date with the identification.json files below it; it can be deleted at any time.

It is read whole into memory and written whole: no process waits for another one's lock, and what was damaged is made again.
"""

from __future__ import annotations

import json
import sqlite3
import time
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.json_file import read_bytes
from labpipe.artefacts.writing import finished, output_file
from labpipe.errors import DataError
from labpipe.quantities import UnitError, si_amount
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
    tests INTEGER, verdict TEXT, warnings TEXT, fault TEXT
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
# An index of another version, or of other tables, is made anew.
MADE_BY = f"{__version__} {zlib.crc32(_TABLES.encode()):08x}"


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
        identification = read_identification(path)
    except DataError as error:
        _insert(connection, "result", {"path": name, "stamp": stamp, "date": file_date, "verdict": "unreadable", "fault": error.what})
        return
    conditions = identification.test_conditions
    dates = sorted(of_test[DATE] for of_test in conditions.values() if DATE in of_test)
    entry = {
        "path": name,
        "stamp": stamp,
        "title": identification.title,
        "rig": identification.rig.get("name", ""),
        "pipeline": identification.pipeline,
        "version": identification.version,
        "date": dates[-1] if dates else file_date,
        "tests": len(conditions),
        "verdict": verdict(identification),
        "warnings": ", ".join(sorted(_all_codes(identification))),
    }
    number = _insert(connection, "result", entry)
    for listed in listed_parameters(identification):
        _add_value(connection, number, listed, conditions.get(listed.test, {}).get(DATE, str(entry["date"])))
    for test, of_test in conditions.items():
        for condition, text in of_test.items():
            amount, unit = _amount(text)
            row = {"result": number, "test": test, "name": condition, "text": text, "amount": amount, "unit": unit}
            _insert(connection, "condition", row)


def _add_value(connection: sqlite3.Connection, number: int, listed: ListedParameter, date: str) -> None:
    parameter = listed.parameter
    low, high = interval(parameter)
    row = {
        **{name: getattr(listed, name) for name in ("fit", "term", "test", "model", "estimator")},
        **{"result": number, "low_hz": listed.band_hz[0], "high_hz": listed.band_hz[1]},
        **{"parameter": parameter.name, "value": parameter.value, "unit": parameter.unit},
        **{"std_error": parameter.full_error, "random_error": listed.random_error, "changes": json.dumps(dict(listed.changes))},
        **{"ci_low": low, "ci_high": high},
        **{"significant": parameter.significant, "warnings": ", ".join(listed.warnings), "date": date},
    }
    _insert(connection, "value", row)


def interval(parameter: Parameter) -> tuple[float | None, float | None]:
    """The ends of the 95 % interval, which is wider than noise alone makes it where the residual is not noise."""
    return (None, None) if parameter.ci95 is None else parameter.ci95


def _insert(connection: sqlite3.Connection, table: str, row: dict[str, Any]) -> int:
    """Add a row and return its number. Table and column names are constants of this module."""
    marks = ", ".join("?" for _ in row)
    cursor = connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))
    return int(cursor.lastrowid or 0)


def _amount(text: str) -> tuple[float | None, str]:
    """A condition as a number in SI, or none for words such as "up"."""
    try:
        return si_amount(text)
    except UnitError:
        return None, ""


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
    return of_fits | {finding.code for _, finding in pairs if finding.level == WARNING}
