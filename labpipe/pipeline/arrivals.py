"""Recordings that arrive in a folder of this machine, or under a prefix of an object storage."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from labpipe.formats.packed import plain_suffix
from labpipe.formats.table import READERS
from labpipe.places.address import is_remote
from labpipe.places.storage import below


@dataclass(frozen=True)
class Arrived:
    """A recording in the watched folder, with what shows whether it still changes; *marked*: a file beside it says that it is complete."""

    path: Path
    size: int
    changed: float
    marked: bool = False


def arrived_in(folder: Path, names: str, marker: str) -> Iterator[Arrived]:
    """The files of readable kinds whose names fit the glob *names*, without hidden ones; *marker*: ending of the files that mark others."""
    for arrival in _objects(folder, names, marker) if is_remote(folder) else _files(folder, names, marker):
        if plain_suffix(arrival.path) in READERS and not any(part.startswith(".") for part in arrival.path.relative_to(folder).parts):
            yield arrival


def _files(folder: Path, names: str, marker: str) -> Iterator[Arrived]:
    for path in folder.rglob(names):
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        if path.is_file():
            yield Arrived(path, status.st_size, status.st_mtime, bool(marker) and path.with_name(path.name + marker).exists())


def _objects(folder: Path, names: str, marker: str) -> Iterator[Arrived]:
    objects = {status.path: status for status in below(folder)}
    for path, status in objects.items():
        if path.match(names):
            yield Arrived(path, status.size, status.changed, bool(marker) and path.with_name(path.name + marker) in objects)
