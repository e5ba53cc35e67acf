"""What a test is measured as, one file each: frequency response, free decays, or spectra of its channels."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
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
from labpipe.errors import ConfigError, DataError, locate_errors
from labpipe.project.ingest import RawRecording
from labpipe.project.tests import ReadyFrf
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra, FreeDecays
from labpipe.spectra.settings import DECAYS, RESPONSES, SPECTRA, FrfSettings

ALIKE = "look for channels that are silent or alike"

# The paths of references to how files are described, and at what they were measured, which are no files.
DESCRIPTION, CONDITIONS = "(entry under frfs)", "(conditions)"
# The parameter of what was measured from raw files: their rigs. Its inputs then are the raw files, with paths
# from the pipeline.
RIGS = "rigs"


def file_stem(test: str) -> str:
    """What the names of a test's files begin with."""
    return re.sub(r"[^\w.+-]+", "-", test).strip("-") or "frf"


def file_stems(names: Iterable[str], what: str, where: Path | str = "") -> dict[str, str]:
    """The file stem of every name; ConfigError where two would write the same file."""
    stems: dict[str, str] = {}
    for name in names:
        stem = file_stem(name)
        if stem in stems:
            both = f"{what} '{stems[stem]}' and '{name}'"
            raise ConfigError(f"{both} would write the same file", where, "rename one")
        stems[stem] = name
    return {name: stem for stem, name in stems.items()}


class MeasuredSource(SampleSource, Protocol):
    """A recording that results can name: calibrated, on disk, or a raw file as it is read."""

    @property
    def path(self) -> Path: ...
    def source_ref(self) -> SourceRef: ...


def measured_header(
    kind: str,
    recordings: Sequence[MeasuredSource],
    settings: FrfSettings,
    test: str,
    conditions: dict[str, str] | None,
) -> Header:
    """The header of what is measured from recordings, of raw ones with their rigs."""
    parameters: dict[str, Any] = {"frf": asdict(settings), "test": test, "conditions": conditions or {}}
    raw = [recording for recording in recordings if isinstance(recording, RawRecording)]
    if raw:
        parameters[RIGS] = [asdict(recording.rig) for recording in raw]
    return Header(kind, parameters, inputs=tuple(recording.source_ref() for recording in recordings))


def _check_copies(recordings: Sequence[MeasuredSource], header: Header) -> None:
    seen: dict[Any, str] = {}
    for recording, ref in zip(recordings, header.inputs, strict=True):
        files = recording.header.inputs if isinstance(recording, StoredRecording) else (ref,)
        path = files[0].path if files else ref.path
        first = seen.setdefault((*(file.sha256 for file in files), recording.channels), path)
        if first != path:
            raise DataError(f"holds the same bytes as '{Path(first).name}'", path, "a recording counts once")


def list_sources(recordings: Sequence[MeasuredSource]) -> str:
    """The raw files behind recordings, each once, for messages."""
    names = (
        recording.header.inputs[0].path
        if isinstance(recording, StoredRecording) and recording.header.inputs
        else recording.path.name
        for recording in recordings
    )
    return ", ".join(dict.fromkeys(names))


def ready_refs(frf: ReadyFrf) -> list[SourceRef]:
    """What a ready response depends on: its files, and how they are described."""
    files = [source_ref(path, path.parent) for path in frf.paths]
    if frf.layout is None:
        return files
    described = repr((frf.layout, frf.outputs, frf.inputs))
    return [*files, SourceRef(DESCRIPTION, hashlib.sha256(described.encode()).hexdigest())]


MeasuredTest = FrequencyResponse | FreeDecays | ChannelSpectra


@dataclass(frozen=True)
class _MeasuredKind:
    name: str
    suffix: str
    write: Callable[[Path, Any, Header], None]
    read: Callable[[Path], Any]


KINDS = {
    RESPONSES: _MeasuredKind("frf", RESPONSE_SUFFIX, write_response, read_response),
    DECAYS: _MeasuredKind("decay", DECAY_SUFFIX, write_decays, read_decays),
    SPECTRA: _MeasuredKind("spectra", SPECTRA_SUFFIX, write_spectra, read_spectra),
}


def measurement(recordings: Sequence[SampleSource], settings: FrfSettings, **of_test: Any) -> MeasuredTest:
    """What recordings give; a run that finds all fresh imports none of what measures."""
    if settings.gives == DECAYS:
        from labpipe.spectra.free_decays import free_decays

        return free_decays(recordings, settings, **of_test)
    if settings.gives == SPECTRA:
        from labpipe.spectra.all_channels import channel_spectra

        return channel_spectra(recordings, settings, **of_test)
    from labpipe.spectra.measurement import measure

    return measure(recordings, settings, **of_test)


def measured_file_name(test: str, settings: FrfSettings | None) -> str:
    """The file name of a test's response, free decays or spectra."""
    return file_stem(test) + KINDS[RESPONSES if settings is None else settings.gives].suffix


def fits_file_name(test: str) -> str:
    """The file name of a test's fits, where each test has its own file."""
    return f"{FITS}/{file_stem(test)}.json"


def files_of_test(test: str) -> list[str]:
    """The names that a test's files may have in a folder of results, but for its recordings."""
    return [fits_file_name(test), *(file_stem(test) + kind.suffix for kind in KINDS.values())]


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
    """What the recordings of a test give, made unless what is on disk is fresh. LabpipeError names the
    recording. *seen*: what else was found in the raw files of a response.
    """
    kind = KINDS[settings.gives]
    header = partial(measured_header, kind.name, recordings, settings, test, conditions)
    name = measured_file_name(test, settings)
    # The header digests raw files, and is asked for only where there is something.
    there = output.read_path(name).exists()
    if there and (existing := fresh_path(output, name, header())) is not None:
        return kind.read(existing)
    try:
        with locate_errors(list_sources(recordings)):
            result = measurement(recordings, settings, name=test, conditions=conditions)
    except LinAlgError as error:
        what = f"a matrix of spectra has no solution ({error})"
        raise DataError(what, list_sources(recordings), ALIKE) from error
    if isinstance(result, FrequencyResponse):
        result = result.with_findings(seen())
    made = header()
    _check_copies(recordings, made)
    kind.write(output.write_path(name), result, made)
    return result


def load_measured(path: Path, name: str = "", conditions: dict[str, str] | None = None) -> MeasuredTest:
    """What labpipe measured, or any ready response; *name*, *conditions*: of its test, for its own."""
    kind = next((kind for kind in KINDS.values() if path.name.endswith(kind.suffix)), None)
    if kind is None or not path.is_file():
        # The readers of other programs' files are not imported by a run that reads its own responses.
        from labpipe.project.ready_response import load_response

        return load_response(path, name, conditions)
    result: MeasuredTest = kind.read(path)
    name, conditions = name or result.name, conditions or result.conditions
    if isinstance(result, FrequencyResponse):
        return result.rename(name, conditions)
    return replace(result, name=name, conditions=conditions)


def load_ready_measured(ready: ReadyFrf, test: str, conditions: dict[str, str]) -> MeasuredTest:
    """What stands under frfs: of a test: what labpipe measured, or a response of any layout."""
    name = test or ready.name
    if ready.layout is None:
        return load_measured(ready.paths[0], name, conditions)
    from labpipe.project.ready_response import load_described

    return load_described(ready, ready.layout, name, conditions)
