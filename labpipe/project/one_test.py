"""The work of one test: its recordings -> its response or decays -> its fits on disk, and its result."""

from __future__ import annotations

import datetime
import errno
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import KW_ONLY, asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from labpipe.artefacts.dataset_file import CONDITION, UNNAMED, columns_of_conditions, read_rows
from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.identification_file import fits_with_digest, has_fresh_fits, read_fits, write_fits
from labpipe.artefacts.parquet import read_header, remake_line
from labpipe.artefacts.places import StorageError, fetch, status
from labpipe.artefacts.recording_file import SUFFIX as RECORDING, StoredRecording
from labpipe.artefacts.writing import OutputFolder, is_remote, output_folder
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.estimation.settings import FitSettings
from labpipe.project.ingest import (
    check_made_with,
    check_rig,
    ingest,
    is_recording,
    raw_recording,
    recording_refs,
)
from labpipe.project.judging import forbidden, judged_part
from labpipe.project.measured import (
    CONDITIONS,
    RIGS,
    MeasuredTest,
    fits_file_name,
    load_measured,
    load_ready_measured,
    measure_test,
    measured_file_name,
    measured_files,
    ready_refs,
)
from labpipe.project.rules import Rule
from labpipe.project.tests import Test
from labpipe.project.work import fits_of, with_repeats_of
from labpipe.quantities import QUANTITIES, to_display
from labpipe.raw_files.screening import ChannelScreen
from labpipe.raw_files.table import open_table
from labpipe.records.dataset import DatasetRow, TestResult, day_of, is_accepted, rows_of_fit
from labpipe.records.finding import Finding
from labpipe.records.identification import Failed, Fit, Identification
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import RecordedCondition
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import nearest
from labpipe.report.wording import fit_title
from labpipe.spectra.channels import READ_SAMPLES
from labpipe.spectra.settings import FrfSettings, ShaftLines
from labpipe.spectra.shaft import shaft_motion


def read_one_of_many(identification: Identification, folder: Path, test: str) -> Identification:
    """The fits and the response of one test in a result's *folder*. ConfigError for an unknown test."""
    rows = read_rows(folder)
    names = rows["test"].to_pylist()
    if test not in names:
        raise ConfigError(f"the result has no test '{test}'", hint=nearest(test, list(dict.fromkeys(names))))
    row = rows.slice(names.index(test), 1).to_pylist()[0]
    if row["failed"] is not None:
        raise ConfigError(f"test '{test}' could not be evaluated: {row['failed']}")
    conditions = {
        name: text
        for name in columns_of_conditions(rows.column_names)
        if (text := row[CONDITION + name]) is not None
    }
    measured = [load_measured(path) for path in measured_files(folder, test)]
    fits = folder / fits_file_name(test)
    return replace(
        identification,
        fits=tuple(read_fits(fits)) if fits.exists() else (),
        responses=tuple(part for part in measured if isinstance(part, FrequencyResponse)),
        spectra=tuple(part for part in measured if isinstance(part, ChannelSpectra)),
        settings={**identification.settings, "tests": [{"name": test, "conditions": conditions}]},
        dataset=None,
    )


DATE = "date"
AGAIN = "run `labpipe frf` again"


def result_of_test(
    test: Test,
    conditions: Mapping[str, str],
    fits: Sequence[Fit],
    findings: Sequence[Finding],
    rules: Sequence[Rule],
    sources: Sequence[SourceRef],
    digest: str,
) -> TestResult:
    """The result of a test from its *fits* and the *findings* of its measurement; *sources*: its files,
    *digest*: of its fits.
    """
    partial = tuple(judged_part(rule, fits) for rule in rules)
    outcomes = forbidden(rules, fits)
    common = {
        **identity(test, conditions),
        "accepted": is_accepted(partial, outcomes),
        "source": digest_of_sources(sources),
        "digest": digest,
    }
    rows = tuple(row for fit in fits for row in rows_of_fit(fit, common))
    return TestResult(
        # A test without fits has a row as well: the dataset knows that it was worked on.
        rows=rows or (DatasetRow(**common),),  # type: ignore[arg-type]
        findings=(
            *((test.name, finding) for finding in findings),
            *((fit_title(fit), of_fit) for fit in fits for of_fit in fit.findings),
        ),
        partial=partial,
        forbidden=outcomes,
    )


def failed_result(test: Test, message: str) -> TestResult:
    """The result of a test that could not be evaluated, and why."""
    row = DatasetRow(**identity(test, test.conditions), failed=message)  # type: ignore[arg-type]
    return TestResult(rows=(row,))


def identity(test: Test, conditions: Mapping[str, str]) -> dict[str, object]:
    """What all rows of a test share: whose they are, of which day, at which conditions. The day is that of
    the condition `date`, else that on which the first file was last changed, in UTC.
    """
    day = stated_day(conditions) or change_day(files_of(test)[0])
    rig = next((source.rig.name for source in test.recordings if source.rig.name), UNNAMED)
    return {"rig": rig, "date": day, "test": test.name, "conditions": dict(conditions)}


def stated_day(conditions: Mapping[str, str]) -> str:
    """The day that the condition `date` states, ISO 8601; '' without one."""
    day = day_of(conditions.get(DATE, ""))
    return day.isoformat() if day else ""


def files_of(test: Test) -> list[Path]:
    """The files that a test was recorded in, or its ready responses."""
    recorded = [path for source in test.recordings for path in source.paths]
    return [*recorded, *(path for ready in test.frfs for path in ready.paths)]


def change_day(path: Path) -> str:
    """The day [UTC] on which a file was last changed."""
    seconds = 0.0
    # Where it is gone since, the test has failed for that reason.
    with suppress(OSError, DataError):
        if not is_remote(path):
            seconds = path.stat().st_mtime
        elif (there := status(path)) is not None:
            seconds = there.changed
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).date().isoformat()


def digest_of_sources(sources: Sequence[SourceRef]) -> str:
    """SHA-256 over the digests of a test's files, or of its only file; empty where none was read."""
    digests = [source.sha256 for source in sources]
    if len(digests) <= 1:
        return digests[0] if digests else ""
    return hashlib.sha256("".join(digests).encode()).hexdigest()


Tell = Callable[[str], None]
# Errors of the machine, not of a recording: no room left, or a disk that takes nothing.
HALTING = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def silent(_message: str) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class Job:
    """All that one test needs. names: the file names of its calibrated recordings. fits: those that depend on
    no other fit. target: the run's output folder; scratch: for what is not finished. rules: by which the test
    is judged by itself, for a dataset; None for others. measured_before: its response is there, by `labpipe
    frf`.
    """

    test: Test
    names: tuple[str, ...]
    _: KW_ONLY
    frf: FrfSettings | None
    fits: tuple[FitSettings, ...]
    pipeline_path: Path
    target: Path
    scratch: Path
    rules: tuple[Rule, ...] | None = None
    measured_before: bool = False

    @property
    def folder(self) -> Path:
        return self.pipeline_path.parent

    @property
    def fits_name(self) -> str:
        return fits_file_name(self.test.name)

    @property
    def measured_name(self) -> str:
        return measured_file_name(self.test.name, self.frf)

    def absolute(self) -> Job:
        """The same job, to be done by a process that works in another folder."""
        recordings = tuple(source.absolute() for source in self.test.recordings)
        frfs = tuple(frf.absolute() for frf in self.test.frfs)
        test = replace(self.test, recordings=recordings, frfs=frfs)
        paths = {name: getattr(self, name).absolute() for name in ("pipeline_path", "target", "scratch")}
        return replace(self, test=test, **paths)


@dataclass(frozen=True)
class Done:
    """How a test ended: the raw files behind it, or why it failed; what was found damaged and made again; its
    *result* for a dataset. halts: by a fault of the machine that other tests will meet as well.
    """

    test: str
    sources: tuple[SourceRef, ...] = ()
    failed: Failed | None = None
    remarks: tuple[str, ...] = ()
    result: TestResult | None = None
    halts: bool = False


def work(job: Job) -> Done:
    """Do the job; a fault of its input is its outcome, and what was finished before the fault stays."""
    remarks: list[str] = []
    try:
        with fetch_recordings(job) as near:
            with output_folder(near.target, near.scratch, remarks) as output:
                sources = measure(near, output)
            if near.fits:
                with output_folder(near.target, near.scratch, remarks) as output:
                    fit(near, output)
            result = None if near.rules is None else _result(near, near.rules, sources)
    except LabpipeError as error:
        failed, halts = Failed(job.test.name, str(error)), isinstance(error, StorageError)
        return Done(job.test.name, failed=failed, remarks=tuple(remarks), halts=halts)
    except OSError as error:
        if error.errno is None:
            raise
        failed = Failed(job.test.name, f"{error.filename or 'output'}: {os.strerror(error.errno).lower()}")
        return Done(job.test.name, failed=failed, halts=error.errno in HALTING)
    except Exception as error:
        error.add_note(f"in test '{job.test.name}' of {job.pipeline_path}")
        raise
    return Done(job.test.name, sources, remarks=tuple(remarks), result=result)


@contextmanager
def fetch_recordings(job: Job) -> Iterator[Job]:
    """The job with its recordings on this machine: objects of a storage lie in the scratch folder."""
    paths = [path for source in job.test.recordings for path in source.paths]
    with fetch([] if job.measured_before else paths, job.scratch) as here:
        recordings = tuple(source.at(here) for source in job.test.recordings)
        yield replace(job, test=replace(job.test, recordings=recordings))


def _result(job: Job, rules: Sequence[Rule], sources: Sequence[SourceRef]) -> TestResult:
    fits, digest = fits_with_digest(job.target / job.fits_name) if job.fits else ([], "")
    conditions, findings = job.test.conditions, []
    if job.test.recordings:
        header = read_header(job.target / job.measured_name)
        conditions, findings = header.contents["conditions"], list(header.findings)
    return result_of_test(job.test, conditions, fits, findings, rules, sources, digest)


def measure(job: Job, output: OutputFolder, tell: Tell = silent) -> tuple[SourceRef, ...]:
    """ingest and frf of the test; the references of the raw files or ready responses behind it."""
    if job.measured_before:
        return sources_before(job)
    recorded = _measure_raw_files(job, output, tell)
    if recorded is None:
        stored = []
        for source, name in zip(job.test.recordings, job.names, strict=True):
            tell(f"ingest    {source.path.name}")
            stored.append(ingest(source, output, f"recordings/{name}", job.folder))
        if stored:
            if job.frf is None:
                raise ConfigError("frf: is missing", job.pipeline_path, "say how the recordings become FRFs")
            tell(f"frf       {job.test.name or job.pipeline_path.stem}")
            conditions = {**job.test.conditions, **recorded_conditions(stored, job.test.recorded)}
            measure_test(stored, job.frf, output, job.test.name, conditions, partial(_window_findings, job))
        recorded = tuple(
            reference for recording in stored for reference in recording_refs(recording, job.folder)
        )
    return (*recorded, *_ready_sources(job))


def _ready_sources(job: Job) -> list[SourceRef]:
    return [source_ref(path, job.folder) for ready in job.test.frfs for path in ready.paths]


def _measure_raw_files(job: Job, output: OutputFolder, tell: Tell) -> tuple[SourceRef, ...] | None:
    if (
        job.frf is None
        or job.test.recorded
        or not job.test.recordings
        or any(source.joined or not source.span.is_whole for source in job.test.recordings)
    ):
        return None
    n_remark = len(output.remarks)
    try:
        raw = [raw_recording(source.path, source.rig, job.folder) for source in job.test.recordings]
        recordings = [recording for recording in raw if recording is not None]
        if len(recordings) < len(raw):
            return None
        tell(f"frf       {job.test.name or job.pipeline_path.stem}")
        seen = partial(_window_findings, job)
        measure_test(recordings, job.frf, output, job.test.name, job.test.conditions, seen)
        for recording in recordings:
            recording.check_unchanged()
    except DataError:
        del output.remarks[n_remark:]
        output.write_path(job.measured_name).unlink(missing_ok=True)
        return None
    for name in job.names:
        # Of an earlier run, which made one.
        output.outdate(f"recordings/{name}{RECORDING}")
    return tuple(recording.source_ref() for recording in recordings)


def _window_findings(job: Job) -> list[Finding]:
    """What the first raw file with copies of its channels says against the window that is stated."""
    # A run that changes nothing needs none of what looks at raw files.
    from labpipe.project.first_guess import windows_of_copies_alone

    if job.frf is None or job.frf.windowed is None:
        return []
    for source in job.test.recordings:
        if not is_recording(source.path):
            measured = [part.column for part in source.rig.channels if part.channel.role == "output"]
            if (finding := windows_of_copies_alone(open_table(source.path), measured)) is not None:
                return [finding]
    return []


def sources_before(job: Job) -> tuple[SourceRef, ...]:
    """The references of the raw files behind a response that is there, by its calibrated recordings, or else
    its own. DataError where it was made with other settings, conditions, rigs or files than there are now.
    """
    if not job.test.recordings:
        return tuple(_ready_sources(job))
    path = job.target / job.measured_name
    if not path.exists():
        raise DataError("no such file", path, "run `labpipe frf` first, or `labpipe run` for all stages")
    header = read_header(path)
    made = header.parameters
    conditions = {**dict.fromkeys(job.test.conditions), **made.get("conditions", {})}
    check_made_with("frf", made.get("frf", {}), asdict(job.frf) if job.frf else {}, path, AGAIN)
    check_made_with("conditions", conditions, job.test.conditions, path, AGAIN)
    if RIGS in made:
        rigs, recorded = made[RIGS], list(header.inputs)
    else:
        calibrated = [
            source.path if is_recording(source.path) else job.target / f"recordings/{name}{RECORDING}"
            for source, name in zip(job.test.recordings, job.names, strict=True)
        ]
        # One that is gone tells nothing of its rig.
        headers = [read_header(recording) if recording.exists() else None for recording in calibrated]
        rigs = [recording.parameters if recording else {} for recording in headers]
        recorded = [reference for recording in headers if recording for reference in recording.inputs]
        recorded = recorded if None not in headers else []
    for source, rig in zip(job.test.recordings, rigs, strict=True):
        check_rig(rig, source.rig, path, AGAIN)
    for raw in files_of(job.test):
        _check_unchanged(raw, path, recorded, job.folder)
    return (*(recorded or [source_ref(path, job.target)]), *_ready_sources(job))


def _check_unchanged(raw: Path, made: Path, recorded: Sequence[SourceRef], base: Path) -> None:
    if is_remote(raw) or not raw.exists() or raw.stat().st_mtime <= made.stat().st_mtime:
        return
    now = source_ref(raw, base)
    if any(reference.path == now.path and reference != now for reference in recorded):
        raise DataError(f"was made before '{raw.name}' was changed", made, AGAIN)


def load_measured_tests(job: Job, output: OutputFolder) -> list[MeasuredTest]:
    """What was measured of the test, and its ready responses."""
    measured = [load_measured(output.read_path(job.measured_name))] if job.test.recordings else []
    test = job.test
    return [*measured, *(load_ready_measured(ready, test.name, test.conditions) for ready in test.frfs)]


def measured_refs(job: Job, output: OutputFolder) -> list[SourceRef]:
    """The digests of what was measured of the test, by their file names."""
    path = output.read_path(job.measured_name)
    measured = [source_ref(path, path.parent)] if job.test.recordings else []
    return [*measured, *(reference for ready in job.test.frfs for reference in ready_refs(ready))]


def fit(job: Job, output: OutputFolder) -> None:
    """The independent fits of the test, made unless those on disk are fresh."""
    inputs = measured_refs(job, output)
    if job.test.frfs and job.test.conditions:
        # A response that is measured here holds them itself.
        digest = hashlib.sha256(repr(job.test.conditions).encode()).hexdigest()
        inputs.append(SourceRef(CONDITIONS, digest))
    path = output.read_path(job.fits_name)
    # With what the test says of several recordings, where it does.
    settings_of_test = tuple(with_repeats_of(settings, job.test.repeats) for settings in job.fits)
    try:
        if has_fresh_fits(path, settings_of_test, inputs):
            return
    except DamagedError as error:
        output.remarks.append(remake_line(error, path))
    measured = load_measured_tests(job, output)
    fits = [made for settings in settings_of_test for made in fits_of(measured, settings, job.pipeline_path)]
    write_fits(output.write_path(job.fits_name), fits, settings_of_test, inputs)


def finished_fits(jobs: Sequence[Job], output: OutputFolder) -> dict[str, list[Fit]]:
    """The independent fits of finished jobs by their name in the pipeline, each in the order of the tests."""
    read = [read_fits(output.read_path(job.fits_name)) for job in jobs if job.fits]
    names = dict.fromkeys(settings.name for job in jobs for settings in job.fits)
    return {name: [test_fit for fits in read for test_fit in fits if test_fit.name == name] for name in names}


# A scatter is of the same unit without the offset of its scale.
SCATTER_UNITS = {"degC": "K"}


def recorded_conditions(
    recordings: Sequence[StoredRecording], recorded: Mapping[str, RecordedCondition]
) -> dict[str, str]:
    """Every condition as text, "1000.2 N +- 3.1 N": mean over all recordings and scatter of the samples (of
    revolutions: speeds). ConfigError for a channel that a recording lacks; DataError for a tacho without
    pulses.
    """
    return {name: _text(*_amount(recordings, source)) for name, source in recorded.items()}


def _amount(recordings: Sequence[StoredRecording], source: RecordedCondition) -> tuple[float, float, str]:
    """Mean and standard deviation [SI], and the unit in which people read them."""
    parts = [
        _speed(recording, source) if source.tacho else _level(recording, source.channel)
        for recording in recordings
    ]
    mean = float(np.mean([part[0] for part in parts]))
    spread = float(np.sqrt(np.mean([part[1] ** 2 + (part[0] - mean) ** 2 for part in parts])))
    return mean, spread, parts[0][2]


def _level(recording: StoredRecording, name: str) -> tuple[float, float, str]:
    channel = next((channel for channel in recording.channels if channel.name == name), None)
    if channel is None:
        names = [channel.name for channel in recording.channels]
        raise ConfigError(f"recording '{recording.name}' has no channel '{name}'", hint=nearest(name, names))
    mean, scatter = recording.levels.get(name) or _levels_of(recording)[name]
    return mean, scatter, QUANTITIES[channel.quantity].display_unit


def _levels_of(recording: StoredRecording) -> dict[str, tuple[float, float]]:
    screen = ChannelScreen([channel.name for channel in recording.channels])
    for block in recording.blocks(READ_SAMPLES):
        screen.add(block)
    return screen.levels()


def _speed(recording: StoredRecording, source: RecordedCondition) -> tuple[float, float, str]:
    motion = shaft_motion(recording, ShaftLines(tacho=source.tacho, pulses=source.pulses))
    mean = (motion.revolutions[-1] - motion.revolutions[0]) / (motion.times[-1] - motion.times[0])
    return float(mean), float(np.std(motion.speeds)), QUANTITIES["speed"].display_unit


def _text(mean: float, scatter: float, unit: str) -> str:
    spread = abs(to_display(scatter, unit) - to_display(0.0, unit))
    return f"{to_display(mean, unit):.7g} {unit} +- {spread:.2g} {SCATTER_UNITS.get(unit, unit)}"
