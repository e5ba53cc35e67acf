"""What a test is measured as: its frequency response, or its free decays. One file of either for each test."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from labpipe.artefacts.decay_file import SUFFIX, read_decays, write_decays
from labpipe.artefacts.header import Header, source_ref
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.response_file import SUFFIX as RESPONSE_SUFFIX
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.ready_frf import ReadyFrf
from labpipe.errors import LabpipeError
from labpipe.records.free_decay import FreeDecays
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.settings import FrfSettings
from labpipe.stages.frf import frf, frf_file_name, load_ready, load_response, where_recorded

MeasuredTest = FrequencyResponse | FreeDecays


def measured_file_name(test: str, settings: FrfSettings | None) -> str:
    """The file name of a test's response or free decays."""
    name = frf_file_name(test)
    return name.removesuffix(RESPONSE_SUFFIX) + SUFFIX if settings is not None and settings.excitation == "decay" else name


def measure_test(
    recordings: Sequence[StoredRecording], settings: FrfSettings, output: OutputFolder, test: str, conditions: dict[str, str]
) -> MeasuredTest:
    """What the recordings of a test give, made unless what is on disk is fresh; LabpipeError names the recording."""
    if settings.excitation != "decay":
        return frf(recordings, settings, output, test, conditions)
    inputs = tuple(source_ref(recording.path, recording.path.parent) for recording in recordings)
    header = Header("decay", {"frf": dataclasses.asdict(settings), "test": test, "conditions": conditions}, inputs=inputs)
    name = measured_file_name(test, settings)
    existing = output.read_path(name)
    if existing.exists() and read_header(existing, "decay").same_work(header):
        return read_decays(existing)
    try:
        decays = free_decays(recordings, settings, name=test, conditions=conditions)
    except LabpipeError as error:
        error.where = error.where or where_recorded(recordings)
        raise
    write_decays(output.write_path(name), decays, header)
    return decays


def load_measured(path: Path, name: str = "", conditions: dict[str, str] | None = None) -> MeasuredTest:
    """Ready free decays of labpipe's own, or a ready response; name and conditions of its test take the place of its own."""
    if not path.name.endswith(SUFFIX):
        return load_response(path, name, conditions)
    decays = read_decays(path)
    return dataclasses.replace(decays, name=name or decays.name, conditions=conditions or decays.conditions)


def load_ready_measured(ready: ReadyFrf, test: str = "", conditions: dict[str, str] | None = None) -> MeasuredTest:
    """What stands under frfs: of a test: labpipe's own free decays, or a response of any layout."""
    if ready.layout is None and ready.paths[0].name.endswith(SUFFIX):
        return load_measured(ready.paths[0], test or ready.name, conditions)
    return load_ready(ready, test, conditions)
