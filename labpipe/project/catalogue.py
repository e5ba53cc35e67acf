"""Index of a results folder: what is known of each result below it, in a file that follows them. Read and
written whole, it needs no lock, and a damaged one is made again.
"""

from __future__ import annotations

import datetime
import functools
import hashlib
import json
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.dataset_file import table_of
from labpipe.artefacts.digest import file_sha256
from labpipe.artefacts.header import code_digest
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.json_file import BAD_ENTRY, plain, read_bytes
from labpipe.artefacts.writing import output_file, without_staging
from labpipe.errors import ConfigError, DataError, shorten
from labpipe.project.run_record import days_of_runs, record_of_runs
from labpipe.quantities import UnitError, si_amount
from labpipe.records.dataset import DATE, DatasetRow, day_of, entries_of
from labpipe.records.finding import WARNING
from labpipe.records.identification import Identification, listed_parameters, warning_codes
from labpipe.records.sections import section
from labpipe.registry import nearest

INDEX = ".labpipe-catalogue.json"
# What gives the date of a result without a condition.
BY_RUN, BY_FILE = "the record of runs", "the last change of its file, which is another in a copy"
# An index of another version or build is made anew.
MADE_BY = f"{__version__} {code_digest()}"
# Of every result, by the path of its file, a `ResultRow` and the rows of a dataset of its tests.
Index = dict[str, dict[str, Any]]


def open_index(folder: Path) -> Index:
    """What is known of the results below a folder, kept in it where that is allowed. DataError for no folder
    or no results.
    """
    if not folder.is_dir():
        raise DataError("no such folder", folder, "name the folder that holds the results of your runs")
    kept, index = _read(folder / INDEX), Index()
    runs = functools.cache(days_of_runs)
    for path in without_staging(folder.rglob(NAME)):
        try:
            status = path.stat()
        except FileNotFoundError:
            # Removed since the folder was listed.
            continue
        name, stamp = path.relative_to(folder).as_posix(), [status.st_mtime_ns, status.st_size, status.st_ino]
        index[name] = kept.get(name, {})
        if index[name].get("stamp") != stamp:
            record = record_of_runs(path.parent)
            day = "" if record is None else runs(record).get(file_sha256(path), "")
            dated, changed = BY_RUN if day else BY_FILE, time.gmtime(status.st_mtime)
            entry = _entry(path, day or time.strftime("%Y-%m-%d", changed))
            index[name] = {"stamp": stamp, **entry, "path": name, "dated": dated}
    if not index:
        raise DataError(
            f"holds no {NAME}", folder, "results appear with `labpipe run PIPELINE -o FOLDER/NAME`"
        )
    if index != kept and ((folder / INDEX).is_file() or not (folder / INDEX).exists()):
        # Written as a whole: others may do so at once.
        content = json.dumps(index, default=plain).encode()
        with suppress(DataError, OSError), output_file(folder / INDEX) as path:
            path.write_bytes(_digest(content) + b"\n" + content)
    return index


def _read(path: Path) -> Index:
    """The index as it was kept; empty where none of this version was, or a damaged one."""
    with suppress(DataError, OSError):
        digest, _, content = read_bytes(path).partition(b"\n")
        if digest == _digest(content):
            kept: Index = json.loads(content)
            return kept
    return {}


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(MADE_BY.encode() + content).hexdigest().encode()


def _entry(path: Path, day: str) -> dict[str, Any]:
    """What the index holds of a result of that *day*, or why it cannot be read."""
    try:
        entry = _contents(read_identification(path), day)
        # What no table and no terminal takes is found now.
        table_of([DatasetRow(**row) for row in entry["rows"]])
        json.dumps(entry, ensure_ascii=False, default=plain).encode()
    except (DataError, *BAD_ENTRY) as error:
        other = f"holds what labpipe did not write ({type(error).__name__}: {error})"
        what = error.what if isinstance(error, DataError) else other
        entry = {**dict.fromkeys(OF_RESULT, ""), "date": day, "verdict": "unreadable"}
        entry |= {"fault": shorten(what), "dataset": False, "rows": []}
    return entry


def _contents(identification: Identification, day: str) -> dict[str, Any]:
    conditions = {test: _texts(of_test) for test, of_test in identification.test_conditions.items()}
    (rig,) = _texts({"rig": identification.rig.get("name", "")}).values()
    day = max((of_test[DATE] for of_test in conditions.values() if DATE in of_test), default=day)
    listed = [(of.test, entries_of(of)) for of in listed_parameters(identification)]
    with_values = {test for test, _ in listed}
    listed += [(test, {}) for test in conditions if test not in with_values]
    common = {"rig": rig, "date": day, "source": " ".join(sorted(identification.digests))}
    return {
        "title": identification.title,
        "rig": rig,
        "date": day,
        "tests": len(conditions) if identification.dataset is None else identification.dataset.tests,
        "dataset": identification.dataset is not None,
        "verdict": identification.verdict,
        "warnings": ", ".join(sorted(_codes_of(identification))),
        "fault": "",
        "rows": [
            {**common, "test": test, "conditions": conditions.get(test, {}), **row} for test, row in listed
        ],
    }


def _texts(conditions: Mapping[str, Any]) -> dict[str, str]:
    """Conditions as texts: people write numbers as well."""
    for condition in conditions.values():
        if not isinstance(condition, (str, int, float)):
            raise TypeError(f"{condition!r} is not a condition")
    return {str(name): str(condition) for name, condition in conditions.items()}


def _codes_of(identification: Identification) -> set[str]:
    of_fits = {code for fit in identification.fits for code in warning_codes(fit)}
    sections = identification.sections.items()
    pairs = (pair for name, record in sections for pair in section(name).findings(record))
    counted = identification.dataset.of_level(WARNING) if identification.dataset else ()
    of_many = {of_kind.finding.code for of_kind in counted}
    return of_fits | of_many | {finding.code for _, finding in pairs if finding.level == WARNING}


# What of results is asked for: by rig, condition, date, fit and parameter.

_WHERE = re.compile(r"^\s*(?P<name>[\w.-]+)\s*(?P<sign>>=|<=|!=|=|>|<)\s*(?P<bound>.+?)\s*$")
# Relative tolerance in SI of two amounts written alike.
SAME = 1e-9
# Criteria that are patterns of names.
NAMED = ("fit", "test", "parameter")


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

    def __post_init__(self) -> None:
        self._ends()

    def _ends(self) -> list[datetime.date | None]:
        return [parse_day(day) if day else None for day in (self.since, self.until)]

    def covers(self, date: str) -> bool:
        """Whether a date is one of the days; what is none is neither before nor after another."""
        (since, until), day = self._ends(), day_of(date)
        if day is None:
            return since is until is None
        return (since is None or day >= since) and (until is None or day <= until)


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
# Columns that are None where there is no such number.
MAY_LACK = ("std_error", "random_error", "ci_low", "ci_high")
VALUE_COLUMNS = tuple(field.name for field in fields(ValueRow) if field.name not in NOT_COLUMNS)


OF_RESULT = tuple(field.name for field in fields(ResultRow))


def results(index: Index, criteria: Filter) -> list[ResultRow]:
    """The results of the rig and the days that are asked for, the oldest first."""
    rows = [ResultRow(**{name: entry[name] for name in OF_RESULT}) for entry in index.values()]
    rows = [row for row in rows if is_of_rig(criteria.rig, row.rig) and criteria.covers(row.date)]
    return sorted(rows, key=lambda row: (row.date, row.path))


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


def parse_day(text: str) -> datetime.date:
    """The day that a text says; ConfigError for what is none."""
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"'{text}' is not a date", hint="write it as 2026-11-03") from None


def split_condition(text: str) -> tuple[str, str, str]:
    """Name, sign and bound of a condition such as "preload >= 400 N"; ConfigError for what is none."""
    match = _WHERE.match(text)
    if match is None:
        hint = "for example 'preload >= 400 N' or 'direction = up'"
        raise ConfigError(f"'{text}' is not a condition", hint=hint)
    return match["name"], match["sign"], match["bound"]


def meeting(condition: str, amounts: Mapping[str, tuple[float, str] | None]) -> list[str]:
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
    units = {amount[1] for amount in amounts.values() if amount}
    if amounts and unit not in units:
        others = ", ".join(sorted(units)) or "words"
        raise ConfigError(f"'{condition}': the condition '{name}' is in {others}, not in {unit}")
    return [
        text
        for text, amount in amounts.items()
        if (sign == "!=" if amount is None or amount[1] != unit else _is_so(amount[0], sign, limit))
    ]


def _is_so(amount: float, sign: str, limit: float) -> bool:
    if abs(amount - limit) <= SAME * max(abs(limit), SAME):
        return sign in ("=", ">=", "<=")
    return sign == "!=" or (amount > limit if sign.startswith(">") else sign[0] == "<" and amount < limit)
