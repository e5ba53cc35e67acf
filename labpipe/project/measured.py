"""What a test is measured as: its frequency response, its free decays, or the spectra of its channels.

One file for each test.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from numpy.linalg import LinAlgError

from labpipe.artefacts.header import Header, SourceRef, source_ref
from labpipe.artefacts.identification_file import FOLDER as FITS
from labpipe.artefacts.measured_files import (
    DECAY_SUFFIX,
    RESPONSE_SUFFIX,
    SPECTRA_SUFFIX,
    read_decays,
    read_response,
    read_spectra,
    write_decays,
    write_response,
    write_spectra,
)
from labpipe.artefacts.parquet import fresh_path
from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError, LabpipeError
from labpipe.project.raw_recording import RawRecording
from labpipe.project.tests import ReadyFrf
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra, FreeDecays
from labpipe.spectra.settings import DECAYS, FrfSettings
from labpipe.spectra.settings import SPECTRA as OF_ALL_CHANNELS

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
        inputs=tuple(recording.source_ref() for recording in recordings),
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
    seen: Callable[[], Sequence[Finding]] = tuple,
) -> FrequencyResponse:
    """The response of one test, made unless the one on disk is fresh; LabpipeError names the recording.

    *seen*: what else was found in its raw files.
    """
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
    response = response.with_findings(seen())
    write_response(output.write_path(name), response, header())
    return response


def where_recorded(recordings: Sequence[MeasuredSource]) -> str:
    """The raw files behind recordings, for messages."""
    return ", ".join(
        recording.header.inputs[0].path
        if isinstance(recording, StoredRecording) and recording.header.inputs
        else recording.path.name
        for recording in recordings
    )


def ready_refs(frf: ReadyFrf) -> list[SourceRef]:
    """What a ready response depends on: its files, and how they are described."""
    files = [source_ref(path, path.parent) for path in frf.paths]
    if frf.layout is None:
        return files
    described = repr((frf.layout, frf.outputs, frf.inputs))
    return [*files, SourceRef(DESCRIPTION, hashlib.sha256(described.encode()).hexdigest())]


MeasuredTest = FrequencyResponse | FreeDecays | ChannelSpectra


@dataclasses.dataclass(frozen=True)
class _Kind:
    """What recordings give beside a frequency response: the *name* of the kind in headers, how it is made,
    written and read.
    """

    name: str
    suffix: str
    make: Callable[..., Any]
    write: Callable[[Path, Any, Header], None]
    read: Callable[[Path], Any]


def _free_decays(recordings: Sequence[SampleSource], settings: FrfSettings, **of_test: Any) -> FreeDecays:
    from labpipe.spectra.free_decays import free_decays

    return free_decays(recordings, settings, **of_test)


def _channel_spectra(
    recordings: Sequence[SampleSource], settings: FrfSettings, **of_test: Any
) -> ChannelSpectra:
    from labpipe.spectra.all_channels import channel_spectra

    return channel_spectra(recordings, settings, **of_test)


# What measures is imported when something is measured: a run that finds all fresh needs none of it.
DECAY = _Kind("decay", DECAY_SUFFIX, _free_decays, write_decays, read_decays)
SPECTRA = _Kind("spectra", SPECTRA_SUFFIX, _channel_spectra, write_spectra, read_spectra)
OTHERS = {DECAYS: DECAY, OF_ALL_CHANNELS: SPECTRA}


def _kind(settings: FrfSettings | None) -> _Kind | None:
    """The kind of what the settings measure; None for a response."""
    return None if settings is None else OTHERS.get(settings.gives)


def _kind_of_file(path: Path) -> _Kind | None:
    return next((kind for kind in (DECAY, SPECTRA) if path.name.endswith(kind.suffix)), None)


def measured_file_name(test: str, settings: FrfSettings | None) -> str:
    """The file name of a test's response, free decays or spectra."""
    name, kind = frf_file_name(test), _kind(settings)
    return name if kind is None else name.removesuffix(RESPONSE_SUFFIX) + kind.suffix


def fits_file_name(test: str) -> str:
    """The file name of a test's fits, where each test has its own file."""
    return f"{FITS}/{frf_file_name(test).removesuffix(RESPONSE_SUFFIX)}.json"


def files_of_test(test: str) -> list[str]:
    """The names that a test's files may have in a folder of results, but for its recordings."""
    stem = frf_file_name(test).removesuffix(RESPONSE_SUFFIX)
    return [
        fits_file_name(test),
        *(stem + suffix for suffix in (RESPONSE_SUFFIX, DECAY_SUFFIX, SPECTRA_SUFFIX)),
    ]


def measured_files(folder: Path, test: str) -> list[Path]:
    """What a folder of results holds of a test: its response, free decays or spectra."""
    return [path for name in files_of_test(test)[1:] if (path := folder / name).is_file()]


def measure_test(
    recordings: Sequence[MeasuredSource],
    settings: FrfSettings,
    output: OutputFolder,
    test: str,
    conditions: dict[str, str],
    seen: Callable[[], Sequence[Finding]] = tuple,
) -> MeasuredTest:
    """What the recordings of a test give, made unless what is on disk is fresh.

    LabpipeError names the recording; *seen* as in `frf`.
    """
    kind = _kind(settings)
    if kind is None:
        return frf(recordings, settings, output, test, conditions, seen)
    header = partial(measured_header, kind.name, recordings, settings, test, conditions)
    name = measured_file_name(test, settings)
    if (existing := fresh_measured(output, name, header)) is not None:
        return kind.read(existing)
    try:
        measured = kind.make(recordings, settings, name=test, conditions=conditions)
    except LabpipeError as error:
        error.where = error.where or where_recorded(recordings)
        raise
    except LinAlgError as error:
        raise DataError(
            f"a matrix of spectra has no solution ({error})", where=where_recorded(recordings), hint=ALIKE
        ) from error
    kind.write(output.write_path(name), measured, header())
    return measured


def load_measured(path: Path, name: str = "", conditions: dict[str, str] | None = None) -> MeasuredTest:
    """Ready decays or spectra of labpipe's own, or a ready response.

    Name and conditions of its test take the place of its own.
    """
    kind = _kind_of_file(path)
    if kind is not None:
        measured = kind.read(path)
    elif path.name.endswith(RESPONSE_SUFFIX) and path.is_file():
        response = read_response(path)
        return response.renamed(name or response.name, conditions or response.conditions)
    else:
        return _load_response(path, name, conditions)
    return dataclasses.replace(
        measured, name=name or measured.name, conditions=conditions or measured.conditions
    )


def _load_response(path: Path, name: str, conditions: dict[str, str] | None) -> FrequencyResponse:
    # The readers of other programs' files are not imported by a run that reads its own responses.
    from labpipe.project.ready_response import load_response

    return load_response(path, name, conditions)


def load_ready_measured(
    ready: ReadyFrf, test: str = "", conditions: dict[str, str] | None = None
) -> MeasuredTest:
    """What stands under frfs: of a test: labpipe's own free decays or spectra, or a response of any
    layout.
    """
    if ready.layout is None and _kind_of_file(ready.paths[0]) is not None:
        return load_measured(ready.paths[0], test or ready.name, conditions)
    from labpipe.project.ready_response import load_ready

    return load_ready(ready, test, conditions)
