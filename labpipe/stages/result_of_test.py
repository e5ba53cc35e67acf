"""What one test among many comes to, as the dataset of results holds it: its rows, and what the rules find in it."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from labpipe.artefacts.dataset_file import UNNAMED
from labpipe.artefacts.header import SourceRef
from labpipe.config.rules import Rule
from labpipe.config.tests import Test
from labpipe.errors import DataError
from labpipe.places.address import is_remote
from labpipe.places.storage import status
from labpipe.records.dataset_row import DatasetRow, TestResult, accepted, rows_of_fit
from labpipe.records.finding import Finding
from labpipe.records.identification import Fit
from labpipe.report.wording import fit_title
from labpipe.stages.judging import forbidden, judged_part

# Condition of a test that says on which day it was run; by default that on which its file was last changed.
DATE = "date"


def result_of_test(
    test: Test,
    conditions: Mapping[str, str],
    fits: Sequence[Fit],
    findings: Sequence[Finding],
    rules: Sequence[Rule],
    sources: Sequence[SourceRef],
    digest: str,
) -> TestResult:
    """The result of a test from its *fits* and the *findings* of its measurement; *sources* are its files, *digest* that of its fits."""
    partial = tuple(judged_part(rule, fits) for rule in rules)
    outcomes = forbidden(rules, fits)
    common = {
        **identity(test, conditions),
        "accepted": accepted(partial, outcomes),
        "source": digest_of_sources(sources),
        "digest": digest,
    }
    return TestResult(
        # A test without fits has a row as well: the dataset knows that it was worked on.
        rows=tuple(row for fit in fits for row in rows_of_fit(fit, common)) or (DatasetRow(**common),),  # type: ignore[arg-type]
        findings=(*((test.name, finding) for finding in findings), *((fit_title(fit), of_fit) for fit in fits for of_fit in fit.findings)),
        partial=partial,
        forbidden=outcomes,
    )


def failed_result(test: Test, message: str, sources: Sequence[SourceRef] = ()) -> TestResult:
    """The result of a test that could not be evaluated, and why."""
    row = DatasetRow(**identity(test, test.conditions), failed=message, source=digest_of_sources(sources))  # type: ignore[arg-type]
    return TestResult(rows=(row,))


def identity(test: Test, conditions: Mapping[str, str]) -> dict[str, object]:
    """What all rows of a test share: whose they are, of which day, at which conditions."""
    return {"rig": rig_name(test), "date": day_of(test, conditions), "test": test.name, "conditions": dict(conditions)}


def rig_name(test: Test) -> str:
    """The rig of the test's recordings."""
    return next((source.rig.name for source in test.recordings if source.rig.name), UNNAMED)


def day_of(test: Test, conditions: Mapping[str, str]) -> str:
    """The day of a test: its condition `date`, else that on which its first file was last changed, in UTC."""
    try:
        return datetime.date.fromisoformat(str(conditions.get(DATE, ""))[:10]).isoformat()
    except ValueError:
        return _changed(next(path for path in files_of(test)))


def files_of(test: Test) -> list[Path]:
    """The files that a test was recorded in, or its ready responses."""
    recorded = [path for source in test.recordings for path in (source.path, *source.joined)]
    return [*recorded, *(path for ready in test.frfs for path in ready.paths)]


def _changed(path: Path) -> str:
    try:
        seconds = _seconds(path)
    except (OSError, DataError):
        # Gone since; the test has failed for that reason.
        seconds = 0.0
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).date().isoformat()


def _seconds(path: Path) -> float:
    if not is_remote(path):
        return path.stat().st_mtime
    status_of_file = status(path)
    return 0.0 if status_of_file is None else status_of_file.changed


def digest_of_sources(sources: Sequence[SourceRef]) -> str:
    """SHA-256 over the digests of a test's files, or that of the file where it is one; empty where none could be read."""
    digests = [source.sha256 for source in sources]
    if len(digests) <= 1:
        return digests[0] if digests else ""
    return hashlib.sha256("".join(digests).encode()).hexdigest()
