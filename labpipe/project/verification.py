"""verify: whether artefacts are what labpipe wrote, and the files they were made from still the same."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from labpipe.artefacts import measured_files
from labpipe.artefacts.dataset_file import SUFFIX as RESULTS_SUFFIX, DatasetPart, read_part
from labpipe.artefacts.header import source_ref
from labpipe.artefacts.identification_file import FOLDER, NAME, read_fits, read_identification
from labpipe.artefacts.json_file import DIGEST, read_digested
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.places import fetch, status
from labpipe.artefacts.recording_file import SUFFIX as RECORDING_SUFFIX, open_recording
from labpipe.artefacts.writing import is_remote, without_staging
from labpipe.errors import DataError
from labpipe.project.measured import CONDITIONS, DESCRIPTION, RIGS
from labpipe.registry import Registry

Reference = tuple[str, str]
# So many folders above a result may hold the pipeline that made it.
ABOVE = 3


@dataclass(frozen=True)
class Verified:
    """One artefact: faults do not hold, remarks could not be compared, inputs were found the same."""

    path: Path
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    inputs: int = 0


@dataclass(frozen=True)
class _ArtefactKind:
    """An artefact by the end of its name: how it is read, its digest, and the files that it names."""

    read: Callable[[Path], Any]
    digest: Callable[[Path], str]
    sources: Callable[[Path], Sequence[Reference]]
    inputs: Callable[[Path], Sequence[Reference]]


def _nothing(_: Path) -> Sequence[Reference]:
    return ()


def _header_inputs(path: Path) -> Sequence[Reference]:
    return [(reference.path, reference.sha256) for reference in read_header(path).inputs]


def _from(raw: bool, path: Path) -> Sequence[Reference]:
    return _header_inputs(path) if (RIGS in read_header(path).parameters) == raw else ()


def _json_digest(path: Path) -> str:
    return str(read_digested(path, path.name).get(DIGEST, ""))


def _entries(key: str, path: Path) -> Sequence[Reference]:
    entries = read_digested(path, path.name).get(key, [])
    return [(entry["path"], entry["sha256"]) for entry in entries]


def _measure(read: Callable[[Path], Any]) -> _ArtefactKind:
    return _ArtefactKind(read, _digest_of, partial(_from, True), partial(_from, False))


def _digest_of(path: Path) -> str:
    return read_header(path).digest


KINDS: Mapping[str, _ArtefactKind] = {
    NAME: _ArtefactKind(
        read_identification, _json_digest, partial(_entries, "sources"), partial(_entries, "inputs")
    ),
    RESULTS_SUFFIX: _ArtefactKind(
        lambda path: read_part(DatasetPart(path, "", "")), _digest_of, _nothing, _nothing
    ),
    RECORDING_SUFFIX: _ArtefactKind(
        lambda path: open_recording(path).in_memory(), _digest_of, _header_inputs, _nothing
    ),
    measured_files.RESPONSE_SUFFIX: _measure(measured_files.read_response),
    measured_files.DECAY_SUFFIX: _measure(measured_files.read_decays),
    measured_files.SPECTRA_SUFFIX: _measure(measured_files.read_spectra),
}
# Further artefacts in JSON by the name of their file: from its path to its record, with DataError for a
# damaged one.
ARTEFACTS = Registry("artefact")
FITS = _ArtefactKind(read_fits, _json_digest, _nothing, partial(_entries, "responses"))


def _kind(path: Path) -> _ArtefactKind | None:
    if path.parent.name == FOLDER and path.suffix == ".json":
        return FITS
    if path.name in ARTEFACTS.names():
        return _ArtefactKind(ARTEFACTS.load(path.name), _json_digest, _nothing, _nothing)
    for suffix, kind in KINDS.items():
        if path.name == suffix or (suffix[0] == "." and path.name.endswith(suffix)):
            return kind
    return None


def verify_artefacts(folder: Path, base: Path | None) -> Iterator[Verified]:
    """Every artefact below a folder. *base*: the folder of their pipeline, by default that in or above the
    results; paths of raw files are relative to it. DataError for no folder or no artefacts.
    """
    if not folder.is_dir():
        raise DataError("no such folder", folder, "name the folder that holds the results of your runs")
    artefacts = artefacts_below(folder)
    if not artefacts:
        hint = "results appear with `labpipe run PIPELINE -o FOLDER`"
        raise DataError("holds no artefact of labpipe", folder, hint)
    for path in artefacts:
        kind = _kind(path)
        assert kind is not None
        yield _verify(path, kind, base)


def artefacts_below(folder: Path) -> list[Path]:
    """The files below a folder that have an artefact's name, in order."""
    below = without_staging(folder.rglob("*"))
    return [path for path in below if _kind(path) is not None and not path.is_dir()]


def _verify(path: Path, kind: _ArtefactKind, base: Path | None) -> Verified:
    try:
        kind.read(path)
        digest = kind.digest(path)
        sources, inputs = kind.sources(path), kind.inputs(path)
    except DataError as error:
        return Verified(path, (error.what,))
    except OSError as error:
        return Verified(path, (f"cannot be read ({error.strerror or error})".lower(),))
    remarks = [] if digest else ["carries no digest"]
    faults: list[str] = []
    same = 0
    base = base or pipeline_folder(path.parent if (path.parent / NAME).exists() else path.parent.parent)
    for (name, sha256), folders in [
        *((source, [base] if base else []) for source in sources),
        *((file, [path.parent, path.parent / "recordings", path.parent.parent]) for file in inputs),
    ]:
        if name in (DESCRIPTION, CONDITIONS):
            continue
        actual = _digest(name, folders)
        if actual is None:
            remarks.append(f"'{name}' is not there to be compared")
        elif actual != sha256:
            faults.append(f"'{name}' is not the file that it was made from")
        else:
            same += 1
    return Verified(path, tuple(faults), tuple(remarks), same)


def _digest(name: str, folders: Sequence[Path]) -> str | None:
    address = Path(name)
    if not is_remote(address):
        here = next((candidate for place in folders if (candidate := place / name).is_file()), None)
        return None if here is None else source_ref(here, here.parent).sha256
    if status(address) is None:
        return None
    with tempfile.TemporaryDirectory() as scratch, fetch([address], Path(scratch)) as here_by_url:
        return source_ref(here_by_url[address], Path(scratch)).sha256


def pipeline_folder(path: Path) -> Path | None:
    """The folder of a result's pipeline, where a file of its name stands above or beside it."""
    try:
        name = read_identification(path / NAME if path.is_dir() else path).pipeline
    except DataError:
        return None
    above = list(path.resolve().parents)[:ABOVE]
    near = (folder for place in above for folder in (place, place / "pipelines"))
    return next((folder for folder in near if name and (folder / name).is_file()), None)


def differences(first: Path, second: Path) -> list[str]:
    """The artefacts of a first folder of results that a second lacks, or has with another content."""
    lines = []
    for path in filter(Path.is_file, artefacts_below(first)):
        other = second / path.relative_to(first)
        if not other.exists():
            lines.append(f"{path}: is not made by this pipeline")
        elif other.read_bytes() != path.read_bytes():
            lines.append(f"{path}: running again gives another content")
    return lines
