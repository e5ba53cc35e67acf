"""An archive taken apart again: every file held against its digest, then the result where verification and the pipeline find it."""

from __future__ import annotations

import datetime
import os
from dataclasses import dataclass
from pathlib import Path

from labpipe.archive.contents import RESULTS
from labpipe.archive.crate import NAME, Listed, read_metadata
from labpipe.archive.zip_file import opened


@dataclass(frozen=True)
class Unpacked:
    """The folders of an archive that was unpacked, and what does not hold of its files, by their names.

    left_out: files of which the archive holds the digest only, without which the pipeline cannot be run.
    """

    pipeline: Path
    results: Path
    files: int
    left_out: int
    faults: tuple[tuple[str, str], ...]


def unpacked(path: Path, folder: Path) -> Unpacked:
    """Unpack an archive into a folder; DataError where it cannot be read as one."""
    with opened(path) as archive:
        crate = read_metadata(archive.metadata, f"{path}: {NAME}")
        listed = {file.name: file for file in crate.files}
        faults = [(name, "is not listed among the metadata") for name in archive.members if name not in listed]
        for file in listed.values():
            fault = archive.unpack(file, folder)
            if fault:
                faults.append((file.name, fault))
            else:
                _date(file, folder)
    return Unpacked(folder / crate.pipeline, folder / RESULTS, len(listed), crate.left_out, tuple(sorted(faults)))


def _date(file: Listed, folder: Path) -> None:
    """Have a file the day on which it was last changed: the day of a test of a dataset that states none."""
    try:
        day = datetime.datetime.fromisoformat(file.day).replace(hour=12, tzinfo=datetime.UTC).timestamp()
    except ValueError:
        return
    os.utime(folder / file.name, (day, day))
