"""The record of runs of a folder: who ran what and when, on which inputs, with which outcome, a line each. A
line holds the digests of the line before and of its result, so that changed or removed lines show, and
results of no run. It is beside the artefacts, which hold no clock.
"""

from __future__ import annotations

import datetime
import getpass
import hashlib
import json
import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from labpipe import __version__
from labpipe.artefacts.digest import file_sha256
from labpipe.artefacts.header import code_digest
from labpipe.artefacts.identification_file import NAME
from labpipe.artefacts.json_file import BAD_ENTRY
from labpipe.artefacts.writing import hold_lock, is_remote, output_file, without_staging
from labpipe.errors import ConfigError, DataError, shorten
from labpipe.records.identification import Identification

RECORD = "labpipe-runs.jsonl"
LOCK = ".labpipe-runs.lock"
# Before the first line there is none.
NOTHING = "0" * 64
BEGUN = "begun"
# Seconds for which a line waits for another process.
PATIENCE = 20.0


@dataclass(frozen=True, kw_only=True)
class Run:
    """A line of the record. *result*: the identification.json, relative to the record, and its *digest*;
    *inputs*: paths and digests of what it was made from; *results*: of the first line, digests of results
    that were there; *previous*: digest of the line before.
    """

    number: int
    time: str
    who: str
    outcome: str
    previous: str
    version: str = ""
    code: str = ""
    pipeline: str = ""
    result: str = ""
    digest: str = ""
    inputs: tuple[Mapping[str, str], ...] = ()
    results: Mapping[str, str] = field(default_factory=dict)

    @property
    def line(self) -> bytes:
        return (json.dumps(asdict(self), ensure_ascii=False) + "\n").encode()


def begin(folder: Path) -> Path:
    """Begin the record of a folder; ConfigError where there is one in or above it."""
    if not folder.is_dir():
        raise DataError("no such folder", folder, "name the folder that holds your results")
    if (there := record_of_runs(folder)) is not None:
        raise ConfigError("the record was begun already", there)
    results = {name: digest for name, digest in _digests(folder).items() if digest}
    with output_file(folder / RECORD) as path:
        path.write_bytes(_next([], NOTHING, outcome=BEGUN, results=results).line)
    return folder / RECORD


def record_of_runs(folder: Path) -> Path | None:
    """The record in or above a folder of results; None where none was begun."""
    here = folder.resolve()
    return next((path for place in (here, *here.parents) if (path := place / RECORD).is_file()), None)


@contextmanager
def record_run(folder: Path, pipeline: Path) -> Iterator[list[Identification]]:
    """Record a run, where a record was begun: of what the caller puts into the list, or as failed."""
    made: list[Identification] = []
    try:
        yield made
    except BaseException as error:
        what = str(error).splitlines() or [type(error).__name__]
        _add(folder, pipeline, None, f"failed: {shorten(what[0])}")
        raise
    identification = made[0] if made else None
    outcome = "no result" if identification is None else identification.verdict
    _add(folder, pipeline, identification, outcome)


def _add(folder: Path, pipeline: Path, identification: Identification | None, outcome: str) -> None:
    path = None if is_remote(folder) else record_of_runs(folder)
    if path is None:
        return
    result = folder.resolve() / NAME
    inputs: Sequence[Mapping[str, str]] = ()
    if identification is not None:
        inputs = (*identification.sources, *identification.inputs)
    with _lock(path.parent):
        runs, digest = _read(path)
        run = _next(
            runs,
            digest,
            outcome=outcome,
            pipeline=pipeline.name,
            result=result.relative_to(path.parent).as_posix(),
            digest=file_sha256(result) if identification is not None else "",
            inputs=tuple({"path": entry["path"], "sha256": entry["sha256"]} for entry in inputs),
        )
        with path.open("ab") as stream:
            stream.write(run.line)
            stream.flush()
            os.fsync(stream.fileno())


def _next(runs: Sequence[Run], previous: str, **entries: object) -> Run:
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    try:
        who = getpass.getuser()
    except (KeyError, OSError):
        who = "unknown"
    return Run(
        number=len(runs) + 1,
        time=now,
        who=f"{who}@{platform.node()}",
        previous=previous,
        version=__version__,
        code=code_digest(),
        **entries,  # type: ignore[arg-type]
    )


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    end = time.monotonic() + PATIENCE
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(hold_lock(folder / LOCK))
                break
            except DataError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.02)
        yield


def runs_of(path: Path) -> list[Run]:
    """The runs of a record, whether or not its chain holds; DataError for a line that is none."""
    return _read(path)[0]


def _read(path: Path) -> tuple[list[Run], str]:
    runs: list[Run] = []
    digest = NOTHING
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True), 1):
        try:
            entries = json.loads(line)
            runs.append(Run(**{**entries, "inputs": tuple(entries["inputs"])}))
            if runs[-1].line != line:
                raise ValueError("another layout")
        except (*BAD_ENTRY, UnicodeDecodeError) as error:
            raise DataError(f"line {number} is not a run ({shorten(str(error))})", path) from None
        digest = hashlib.sha256(line).hexdigest()
    return runs, digest


def days_of_runs(path: Path) -> dict[str, str]:
    """The day [UTC] of the first run that made a result, by the result's digest; none of a damaged record."""
    with suppress(DataError):
        return {run.digest: run.time[:10] for run in reversed(runs_of(path))}
    return {}


def faults_of_record(path: Path) -> list[str]:
    """What does not hold: lines changed, removed or put in, results not of their last run."""
    runs = runs_of(path)
    faults = [] if runs and runs[0].outcome == BEGUN else ["its beginning was removed"]
    previous = NOTHING
    for place, run in enumerate(runs, 1):
        if run.number != place or run.previous != previous:
            faults.append(f"before run {run.number} of {run.time} a line was changed, removed or put in")
            break
        previous = hashlib.sha256(run.line).hexdigest()
    digests: dict[str, str] = dict(runs[0].results) if runs else {}
    digests.update({run.result: run.digest for run in runs if run.digest})
    for name, digest in _digests(path.parent).items():
        if name not in digests:
            faults.append(f"'{name}' was made by no run that is recorded")
        elif digests[name] != digest:
            faults.append(f"'{name}' is not what the last recorded run made")
    return faults


def head(path: Path) -> str:
    """The digest of the last line: noted elsewhere, it proves that none was removed since."""
    return _read(path)[1]


def _digests(folder: Path) -> dict[str, str]:
    results = sorted(without_staging(folder.rglob(NAME)))
    return {path.relative_to(folder).as_posix(): file_sha256(path) for path in results}
