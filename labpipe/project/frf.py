"""frf: recordings -> one frequency response matrix per test, with covariance and coherence."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from numpy.linalg import LinAlgError

from labpipe.artefacts.header import Header, SourceRef, source_ref
from labpipe.artefacts.measured_files import RESPONSE_SUFFIX, read_response, write_response
from labpipe.artefacts.parquet import fresh_path
from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError, LabpipeError
from labpipe.project.raw_recording import RawRecording
from labpipe.project.tests import ReadyFrf
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.settings import FrfSettings

ALIKE = "look for channels that are silent or alike"

# The path of the reference to how files are described, which is no file.
DESCRIPTION = "(entry under frfs)"
# The parameter of what was measured from raw files: their rigs. Its inputs then are the raw files, with paths
# from the pipeline.
RIGS = "rigs"


def frf_file_name(test: str) -> str:
    """The file name of a test's response."""
    return (re.sub(r"[^\w.+-]+", "-", test).strip("-") or "frf") + RESPONSE_SUFFIX


class MeasuredSource(SampleSource, Protocol):
    """A recording that results can name: calibrated, on disk, or a raw file as it is read."""

    @property
    def path(self) -> Path: ...
    def source_ref(self) -> SourceRef:
        """The reference by which a result names it."""
        ...


def measured_header(
    kind: str,
    recordings: Sequence[MeasuredSource],
    settings: FrfSettings,
    test: str,
    conditions: dict[str, str] | None,
) -> Header:
    """The header of what is measured from recordings.

    Of raw ones with their rigs, which make them what they are.
    """
    parameters = {"frf": dataclasses.asdict(settings), "test": test, "conditions": conditions or {}}
    rigs = [
        dataclasses.asdict(recording.rig) for recording in recordings if isinstance(recording, RawRecording)
    ]
    return Header(
        kind,
        {**parameters, **({RIGS: rigs} if rigs else {})},
        inputs=tuple(one.source_ref() for one in recordings),
    )


def fresh_measured(output: OutputFolder, name: str, header: Callable[[], Header]) -> Path | None:
    """The path of what is measured already with the same *header*, which digests raw files and is asked for
    only where there is one.
    """
    return fresh_path(output, name, header()) if output.read_path(name).exists() else None


def frf(
    recordings: Sequence[MeasuredSource],
    settings: FrfSettings,
    output: OutputFolder,
    test: str = "",
    conditions: dict[str, str] | None = None,
) -> FrequencyResponse:
    """The response of one test, made unless the one on disk is fresh; LabpipeError names the recording."""
    header = partial(measured_header, "frf", recordings, settings, test, conditions)
    name = frf_file_name(test)
    if (existing := fresh_measured(output, name, header)) is not None:
        return read_response(existing)
    # What measures is not imported by a run that finds all its responses fresh.
    from labpipe.spectra.measurement import measure

    try:
        response = measure(recordings, settings, name=test, conditions=conditions or {})
    except LabpipeError as error:
        error.where = error.where or where_recorded(recordings)
        raise
    except LinAlgError as error:
        raise DataError(
            f"a matrix of spectra has no solution ({error})", where=where_recorded(recordings), hint=ALIKE
        ) from error
    write_response(output.write_path(name), response, header())
    return response


def where_recorded(recordings: Sequence[MeasuredSource]) -> str:
    """The raw files behind recordings, for messages."""
    return ", ".join(
        one.header.inputs[0].path if isinstance(one, StoredRecording) and one.header.inputs else one.path.name
        for one in recordings
    )


def ready_refs(frf: ReadyFrf) -> list[SourceRef]:
    """What a ready response depends on: its files, and how they are described."""
    files = [source_ref(path, path.parent) for path in frf.paths]
    if frf.layout is None:
        return files
    described = repr((frf.layout, frf.outputs, frf.inputs))
    return [*files, SourceRef(DESCRIPTION, hashlib.sha256(described.encode()).hexdigest())]
