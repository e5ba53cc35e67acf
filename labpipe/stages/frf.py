"""frf: recordings -> one frequency response matrix per test, with covariance and coherence."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Sequence

from labpipe.artefacts.freshness import fresh_path
from labpipe.artefacts.header import Header, SourceRef, source_ref
from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.response_file import SUFFIX, read_response, write_response
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.ready_frf import ReadyFrf
from labpipe.errors import LabpipeError
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.settings import FrfSettings

# The path of the reference to how files are described, which is no file.
DESCRIPTION = "(entry under frfs)"


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
    inputs = tuple(recording.source_ref() for recording in recordings)
    parameters = {"frf": dataclasses.asdict(settings), "test": test, "conditions": conditions or {}}
    header = Header("frf", parameters, inputs=inputs)
    name = frf_file_name(test)
    if (existing := fresh_path(output, name, header)) is not None:
        return read_response(existing)
    # What measures is not imported by a run that finds all its responses fresh.
    from labpipe.spectra.measurement import measure

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


def ready_refs(frf: ReadyFrf) -> list[SourceRef]:
    """What a ready response depends on: its files, and how they are described."""
    files = [source_ref(path, path.parent) for path in frf.paths]
    if frf.layout is None:
        return files
    described = repr((frf.layout, frf.outputs, frf.inputs))
    return [*files, SourceRef(DESCRIPTION, hashlib.sha256(described.encode()).hexdigest())]
