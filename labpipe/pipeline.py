"""A whole pipeline: the stages in their order, what is fresh left as it is, everything written or nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.pipeline import Pipeline, Test
from labpipe.errors import ConfigError
from labpipe.records.identification import Identification
from labpipe.records.response import FrequencyResponse
from labpipe.stages.frf import frf, load_response
from labpipe.stages.identify import identify_stage
from labpipe.stages.ingest import ingest, recording_ref, unique_names

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Measured:
    """The responses of all tests and the files behind them."""

    responses: tuple[FrequencyResponse, ...]
    sources: tuple[SourceRef, ...]


def ingest_tests(pipeline: Pipeline, output: OutputFolder, tell: Tell) -> dict[str, list[StoredRecording]]:
    """The calibrated recordings of every test, by the test's name."""
    sources = [source for test in pipeline.tests for source in test.recordings]
    names = iter(unique_names([source.path for source in sources]))
    recordings: dict[str, list[StoredRecording]] = {}
    for test in pipeline.tests:
        for source in test.recordings:
            tell(f"ingest    {source.path.name}")
            stored = ingest(source.path, source.rig, output, f"recordings/{next(names)}", pipeline.folder)
            recordings.setdefault(test.name, []).append(stored)
    return recordings


def measure_tests(pipeline: Pipeline, output: OutputFolder, tell: Tell) -> Measured:
    """ingest and frf of every test; ready responses are read as they are."""
    recordings = ingest_tests(pipeline, output, tell)
    responses: list[FrequencyResponse] = []
    sources: list[SourceRef] = []
    for test in pipeline.tests:
        found = recordings.get(test.name, [])
        if found:
            responses.append(measure_one(pipeline, test, found, output, tell))
            sources.extend(recording_ref(recording, pipeline.folder) for recording in found)
        responses.extend(load_response(path, test.name or path.stem, test.conditions) for path in test.frfs)
        sources.extend(source_ref(path, pipeline.folder) for path in test.frfs)
    sources.extend(source_ref(path, pipeline.folder) for path in pipeline.side_files)
    return Measured(tuple(responses), tuple(sources))


def measure_one(
    pipeline: Pipeline, test: Test, recordings: Sequence[StoredRecording], output: OutputFolder, tell: Tell
) -> FrequencyResponse:
    """The response of one test."""
    if pipeline.frf is None:
        raise ConfigError("frf: is missing", where=str(pipeline.path), hint="say how the recordings become FRFs")
    tell(f"frf       {test.name or pipeline.title}")
    return frf(recordings, pipeline.frf, output, test.name, test.conditions)


def run(pipeline: Pipeline, output: OutputFolder, tell: Tell, jobs: int = 0) -> Identification:
    """All stages up to the identification; *jobs*: processes of a study, 0 for one per processor."""
    measured = measure_tests(pipeline, output, tell)
    tell(f"identify  {pipeline.title}")
    return identify_stage(pipeline, measured.responses, measured.sources, output, tell, jobs)
