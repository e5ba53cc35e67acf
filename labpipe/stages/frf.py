"""frf: recordings -> one frequency response matrix per test, with covariance and coherence."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

from labpipe.artefacts.header import Header, source_ref
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.response_file import SUFFIX, read_response, write_response
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError, LabpipeError
from labpipe.formats.frf_csv import FREQUENCY
from labpipe.formats.frf_file import MATRIX_SUFFIXES, read_frf_file
from labpipe.formats.mat_frf import holds_response
from labpipe.formats.packed import plain_suffix
from labpipe.formats.table import TEXT_SUFFIXES, open_table
from labpipe.formats.uff import TIME, UFF_SUFFIXES, read_uff
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings


def frf_file_name(test: str) -> str:
    """The file name of a test's response."""
    return (re.sub(r"[^\w.+-]+", "-", test).strip("-") or "frf") + SUFFIX


def frf(
    recordings: Sequence[StoredRecording],
    settings: FrfSettings,
    output: OutputFolder,
    test: str = "",
    conditions: dict[str, str] | None = None,
) -> FrequencyResponse:
    """The response of one test, made unless the one on disk is fresh; LabpipeError names the recording."""
    inputs = tuple(source_ref(recording.path, recording.path.parent) for recording in recordings)
    parameters = {"frf": dataclasses.asdict(settings), "test": test, "conditions": conditions or {}}
    header = Header("frf", parameters, inputs=inputs)
    name = frf_file_name(test)
    existing = output.read_path(name)
    if existing.exists() and read_header(existing, "frf").same_work(header):
        return read_response(existing)
    try:
        response = measure(recordings, settings, name=test, conditions=conditions or {})
    except LabpipeError as error:
        error.where = error.where or where_recorded(recordings)
        raise
    write_response(output.write_path(name), response, header)
    return response


def where_recorded(recordings: Sequence[StoredRecording]) -> str:
    """The raw files behind recordings, for messages."""
    return ", ".join(recording.header.inputs[0].path if recording.header.inputs else recording.path.name for recording in recordings)


def is_response(path: Path) -> bool:
    """Whether a file holds FRFs and no recording: labpipe's own, or another program's."""
    if not path.is_file():
        return False
    suffix = plain_suffix(path)
    if suffix in MATRIX_SUFFIXES:
        return holds_response(path)
    if suffix in UFF_SUFFIXES:
        return all(record.function != TIME for record in read_uff(path))
    return path.name.endswith(SUFFIX) or (suffix in TEXT_SUFFIXES and FREQUENCY in open_table(path).columns)


def load_response(path: Path, name: str = "", conditions: dict[str, str] | None = None) -> FrequencyResponse:
    """A ready response: labpipe's own file, or another program's; name and conditions of its test take the place of its own."""
    if path.is_dir():
        raise DataError("is a folder, a file is needed", where=str(path))
    if not path.exists():
        raise DataError("no such file", where=str(path))
    try:
        response = read_response(path) if path.suffix == ".parquet" else read_frf_file(path)
    except DataError as error:
        error.where = error.where or str(path)
        raise
    return dataclasses.replace(response, name=name or response.name, conditions=conditions or response.conditions)
