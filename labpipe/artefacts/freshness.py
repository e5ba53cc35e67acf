"""Which artefacts of an earlier run are kept: made by the same work, and as labpipe wrote them."""

from __future__ import annotations

from pathlib import Path

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import Header
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError


def fresh_path(output: OutputFolder, name: str, header: Header) -> Path | None:
    """The path of an artefact that need not be made again; a damaged one is named in the remarks and made again."""
    path = output.read_path(name)
    if not path.exists():
        return None
    try:
        existing = read_header(path, header.kind)
    except DamagedError as error:
        output.remarks.append(made_again(error, path))
        return None
    if not existing.same_work(header):
        return None
    if not existing.digest:
        # This code writes a digest: it was lost.
        output.remarks.append(made_again(DamagedError("carries no digest"), path))
        return None
    return path


def made_again(fault: DataError, path: Path) -> str:
    """The line that says why an artefact is made again."""
    return f"{path}: {fault.what}; it is made again"
