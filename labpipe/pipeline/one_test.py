"""The work of one test, by itself: its recordings -> its response or decays -> its fits, all on disk, so that any process can do it."""

from __future__ import annotations

import dataclasses
import errno
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.fits_file import fits_with_digest, has_fresh_fits, read_fits, write_fits
from labpipe.artefacts.freshness import made_again
from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.parquet import header_of
from labpipe.artefacts.recording_file import SUFFIX as RECORDING
from labpipe.artefacts.writing import OutputFolder, output_folder
from labpipe.config.rules import Rule
from labpipe.config.tests import Test
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.identify.settings import FitSettings
from labpipe.places.fetched import fetched
from labpipe.places.storage import StorageError
from labpipe.records.dataset_row import TestResult
from labpipe.records.identification import Failed, Fit
from labpipe.spectra.settings import FrfSettings
from labpipe.stages.fits import fits_of
from labpipe.stages.frf import RIGS, ready_refs
from labpipe.stages.ingest import ingest, recording_refs
from labpipe.stages.measured import MeasuredTest, fits_file_name, load_measured, load_ready_measured, measure_test, measured_file_name
from labpipe.stages.raw_recording import raw_recording
from labpipe.stages.recorded_conditions import recorded_conditions
from labpipe.stages.result_of_test import result_of_test

Tell = Callable[[str], None]
# Errors of the machine, not of a recording: no room left, or a disk that takes nothing.
HALTING = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def silent(_message: str) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class Job:
    """All that one test needs.

    names: the file names of its calibrated recordings. fits: those that depend on no other fit. target: the run's output folder;
    scratch: the run's folder for what is not finished. rules: of a run whose results are kept as a dataset, by which the test is judged
    by itself; None for others. measured_before: its response is there, by `labpipe frf`, and its recordings are not looked at.
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
        test = dataclasses.replace(self.test, recordings=recordings, frfs=tuple(frf.absolute() for frf in self.test.frfs))
        paths = {name: getattr(self, name).absolute() for name in ("pipeline_path", "target", "scratch")}
        return dataclasses.replace(self, test=test, **paths)


@dataclass(frozen=True)
class Done:
    """How a test ended: the raw files behind it, or why it failed; what was found damaged and made again; its *result* for a dataset.

    halts: it failed by a fault of the machine that other tests will meet as well, such as a full disk.
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
        with brought(job) as near:
            sources, result = _worked(near, remarks)
    except LabpipeError as error:
        failed = Failed(job.test.name, str(error))
        return Done(job.test.name, failed=failed, remarks=tuple(remarks), halts=isinstance(error, StorageError))
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
def brought(job: Job) -> Iterator[Job]:
    """The job with recordings of this machine: those of an object storage lie in its scratch folder meanwhile."""
    paths = [path for source in job.test.recordings for path in (source.path, *source.joined)]
    with fetched([] if job.measured_before else paths, job.scratch) as here:
        recordings = tuple(source.at(here) for source in job.test.recordings)
        yield dataclasses.replace(job, test=dataclasses.replace(job.test, recordings=recordings))


def _worked(job: Job, remarks: list[str]) -> tuple[tuple[SourceRef, ...], TestResult | None]:
    """What went into the test, and its result for a dataset."""
    with output_folder(job.target, job.scratch, remarks) as output:
        sources = sources_before(job) if job.measured_before else measure(job, output)
    if job.fits:
        with output_folder(job.target, job.scratch, remarks) as output:
            fit(job, output)
    return sources, None if job.rules is None else _result(job, job.rules, sources)


def _result(job: Job, rules: Sequence[Rule], sources: Sequence[SourceRef]) -> TestResult:
    """What the finished test comes to, from its files."""
    fits, digest = fits_with_digest(job.target / job.fits_name) if job.fits else ([], "")
    conditions, findings = job.test.conditions, []
    if job.test.recordings:
        header = header_of(job.target / job.measured_name)
        conditions, findings = header.contents["conditions"], list(header.findings)
    return result_of_test(job.test, conditions, fits, findings, rules, sources, digest)


def measure(job: Job, output: OutputFolder, tell: Tell = silent) -> tuple[SourceRef, ...]:
    """ingest and frf of the test; the references of the raw files or ready responses behind it."""
    recorded = _measured_as_read(job, output, tell)
    if recorded is None:
        recorded = _measured_from_calibrated(job, output, tell)
    return (*recorded, *(source_ref(path, job.folder) for ready in job.test.frfs for path in ready.paths))


def _measured_as_read(job: Job, output: OutputFolder, tell: Tell) -> tuple[SourceRef, ...] | None:
    """The test measured from its raw files as they are read; their references. None where they need a calibrated recording, or where a
    fault was met.

    A fault is told by the longer way, which looks at whole files before anything is measured from them.
    """
    if job.frf is None or job.test.recorded or not job.test.recordings or any(source.joined for source in job.test.recordings):
        return None
    n_remark = len(output.remarks)
    try:
        raw = [raw_recording(source.path, source.rig, job.folder) for source in job.test.recordings]
        recordings = [recording for recording in raw if recording is not None]
        if len(recordings) < len(raw):
            return None
        tell(f"frf       {job.test.name or job.pipeline_path.stem}")
        measure_test(recordings, job.frf, output, job.test.name, job.test.conditions)
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


def _measured_from_calibrated(job: Job, output: OutputFolder, tell: Tell) -> tuple[SourceRef, ...]:
    """The test measured from calibrated recordings, made where they are not there; the references of the raw files."""
    stored = []
    for source, name in zip(job.test.recordings, job.names, strict=True):
        tell(f"ingest    {source.path.name}")
        stored.append(ingest(source.path, source.rig, output, f"recordings/{name}", job.folder, source.joined, source.by))
    if stored:
        if job.frf is None:
            raise ConfigError("frf: is missing", where=str(job.pipeline_path), hint="say how the recordings become FRFs")
        tell(f"frf       {job.test.name or job.pipeline_path.stem}")
        conditions = {**job.test.conditions, **recorded_conditions(stored, job.test.recorded)}
        measure_test(stored, job.frf, output, job.test.name, conditions)
    return tuple(reference for recording in stored for reference in recording_refs(recording, job.folder))


def sources_before(job: Job) -> tuple[SourceRef, ...]:
    """The references of the raw files behind a response that is there, by the calibrated recordings beside it, or else its own."""
    path = job.target / job.measured_name
    if job.test.recordings and not path.exists():
        raise DataError("no such file", where=str(path), hint="run `labpipe frf` first, or `labpipe run` for all stages")
    recordings = [job.target / f"recordings/{name}{RECORDING}" for name in job.names]
    if job.test.recordings and RIGS in (header := header_of(path)).parameters:
        recorded = list(header.inputs)
    elif all(recording.exists() for recording in recordings):
        recorded = [reference for recording in recordings for reference in header_of(recording).inputs]
    else:
        recorded = [source_ref(path, job.target)]
    return (*recorded, *(source_ref(ready_path, job.folder) for ready in job.test.frfs for ready_path in ready.paths))


def measured_of(job: Job, output: OutputFolder) -> list[MeasuredTest]:
    """What was measured of the test, and its ready responses."""
    measured = [load_measured(output.read_path(job.measured_name))] if job.test.recordings else []
    return [*measured, *(load_ready_measured(ready, job.test.name, job.test.conditions) for ready in job.test.frfs)]


def measured_refs(job: Job, output: OutputFolder) -> list[SourceRef]:
    """The digests of what was measured of the test, by their file names."""
    path = output.read_path(job.measured_name)
    measured = [source_ref(path, path.parent)] if job.test.recordings else []
    return [*measured, *(reference for ready in job.test.frfs for reference in ready_refs(ready))]


def fit(job: Job, output: OutputFolder) -> None:
    """The independent fits of the test, made unless those on disk are fresh."""
    inputs = measured_refs(job, output)
    path = output.read_path(job.fits_name)
    try:
        if has_fresh_fits(path, job.fits, inputs):
            return
    except DamagedError as error:
        output.remarks.append(made_again(error, path))
    measured = measured_of(job, output)
    fits = [test_fit for settings in job.fits for test_fit in fits_of(measured, settings, job.pipeline_path)]
    write_fits(output.write_path(job.fits_name), fits, job.fits, inputs)


def finished_fits(jobs: Sequence[Job], output: OutputFolder) -> dict[str, list[Fit]]:
    """The independent fits of finished jobs by their name in the pipeline, each in the order of the tests."""
    read = [read_fits(output.read_path(job.fits_name)) for job in jobs if job.fits]
    names = dict.fromkeys(settings.name for job in jobs for settings in job.fits)
    return {name: [test_fit for fits in read for test_fit in fits if test_fit.name == name] for name in names}
