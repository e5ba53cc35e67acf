"""Recordings of an object storage on this machine, as long as they are worked on."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from labpipe.errors import LabpipeError
from labpipe.places.address import SCHEMES, is_remote, shown
from labpipe.places.storage import get

SPOOL = "labpipe-fetched-"


@contextmanager
def fetched(paths: Sequence[Path], home: Path) -> Iterator[dict[Path, Path]]:
    """Where those of some paths that are URLs lie here, in a folder in *home* that goes at the end. Messages of the block name the URLs.

    The parts of such a path end with those of the URL, from which `origin` tells it.
    """
    remote = [path for path in dict.fromkeys(paths) if is_remote(path)]
    if not remote:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix=SPOOL, dir=home, ignore_cleanup_errors=True) as name:
        here = {path: Path(name) / path for path in remote}
        for path, local in here.items():
            get(path, local)
        with naming({str(local): shown(path) for path, local in here.items()}):
            yield here


@contextmanager
def naming(names: dict[str, str]) -> Iterator[None]:
    """Have the messages of the block's errors name places by other names."""
    try:
        yield
    except LabpipeError as error:
        for name, other in names.items():
            error.where, error.what = error.where.replace(name, other), error.what.replace(name, other)
        raise


def origin(path: Path) -> Path | None:
    """The URL that a fetched file comes from, as a path; None for a file of this machine."""
    for number, part in enumerate(path.parts[:-1], 1):
        if part.startswith(SPOOL) and path.parts[number] in SCHEMES:
            return Path(*path.parts[number:])
    return None
