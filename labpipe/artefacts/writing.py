"""Atomic writing: files appear complete under their name, or not at all; and rows of records as CSV."""

from __future__ import annotations

import csv
import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, TypeVar
from urllib.parse import unquote, urlsplit

from labpipe.errors import ConfigError, DataError

if TYPE_CHECKING:
    import pandas as pd

try:
    import fcntl
except ImportError:  # Windows, where a folder of a killed run stays
    fcntl = None  # type: ignore[assignment]

# What is being made stands in folders whose names begin like this, and is not looked at by anyone else.
STAGING = ".labpipe-"
LOCK = ".lock"


def without_staging(paths: Iterable[Path]) -> list[Path]:
    """The paths in order, without those in folders of what is being made."""
    return sorted(path for path in paths if not any(part.startswith(STAGING) for part in path.parts[:-1]))


@dataclass(frozen=True)
class OutputFolder:
    """A folder being filled: files move from *staging* to *target* together, at the end."""

    target: Path
    staging: Path
    outdated: set[str] = field(default_factory=set)
    # What was found damaged in the target and is made again, one line each.
    remarks: list[str] = field(default_factory=list)

    def write_path(self, name: str) -> Path:
        """Where to write the file that will be *name* in the target folder."""
        path = self.staging / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def outdate(self, name: str) -> None:
        """*name* in the target folder goes when the new files come, unless it comes anew."""
        self.outdated.add(name)

    def leave_same(self, name: str) -> None:
        """Leave *name* in the target folder untouched where what was written for it has the same content."""
        staged, there = self.staging / name, self.target / name
        if there.is_file() and staged.read_bytes() == there.read_bytes():
            staged.unlink()

    def read_path(self, name: str) -> Path:
        """Where *name* can be read now: just written, or from before."""
        staged = self.staging / name
        return staged if staged.exists() else self.target / name


def existing_home(target: Path) -> Path:
    """The folder itself or its nearest existing parent; DataError when *target* is a file."""
    if target.exists() and not target.is_dir():
        raise DataError("is a file, a folder is needed", target)
    while not target.exists():
        target = target.parent
    return target


@contextmanager
def output_folder(
    target: Path, scratch: Path | None = None, remarks: list[str] | None = None
) -> Iterator[OutputFolder]:
    """A folder that changes only if the block succeeds; DataError when it cannot be a folder or may not be
    written.

    What is being made stands in a hidden folder in *scratch*, by default in the target itself. *remarks*: a
    list that takes the folder's remarks.
    """
    home = existing_home(target)
    with staging_folder(scratch or home) as staging:
        folder = OutputFolder(target, staging, remarks=[] if remarks is None else remarks)
        yield folder
        _remove(folder)
        _move_all(staging, target)


@contextmanager
def staging_folder(home: Path) -> Iterator[Path]:
    """A hidden folder in *home*, removed at the end in every case, as are those of killed runs."""
    _remove_abandoned(home)
    staging = home / f"{_staging_prefix()}{os.getpid()}-{os.urandom(8).hex()}"
    # An interruption as soon as the folder is there finds it removed as well.
    try:
        try:
            staging.mkdir(mode=0o700)
        except OSError as error:
            error.filename = str(home)
            raise
        with (staging / LOCK).open("w") as lock:
            _take_lock(lock)
            yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _staging_prefix() -> str:
    """How the names of this machine's staging folders begin."""
    # Only where something is written: --help starts in less time without it.
    import socket

    return f"{STAGING}{socket.gethostname()}-"


def _remove_abandoned(home: Path) -> None:
    """Remove the staging folders of this machine's processes that are no more: nobody holds their locks."""
    for staging in home.glob(f"{_staging_prefix()}*"):
        try:
            with (staging / LOCK).open("r+") as lock:
                abandoned = _take_lock(lock)
        except FileNotFoundError:
            # Just made, and not yet locked; unless its process ended there.
            abandoned = fcntl is not None and not _runs(staging.name)
        except OSError:
            # Not ours to remove.
            continue
        if abandoned:
            shutil.rmtree(staging, ignore_errors=True)


def _runs(name: str) -> bool:
    number = name.split("-")[-2]
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OverflowError, OSError):
        pass
    return True


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Hold a lock file, as long as the process lives; DataError where another process holds it."""
    with path.open("w") as lock:
        if fcntl is not None and not _take_lock(lock):
            raise DataError("another process works on this folder", path.parent)
        yield


def _take_lock(lock: IO[str]) -> bool:
    """Take a lock, which goes with the process that holds it; False where another one does."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove(folder: OutputFolder) -> None:
    for name in folder.outdated:
        if not (folder.staging / name).exists():
            (folder.target / name).unlink(missing_ok=True)


def _move_all(staging: Path, target: Path) -> None:
    """Move the files to their places: on the disk before their names are, so that no cut of power leaves a
    name without its content.
    """
    sources = sorted(path for path in staging.rglob("*") if path.is_file() and path != staging / LOCK)
    for source in sources:
        sync_to_disk(source)
    goals = [target / source.relative_to(staging) for source in sources]
    for source, goal in zip(sources, goals, strict=True):
        goal.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, goal)
    for folder in dict.fromkeys(goal.parent for goal in goals):
        sync_to_disk(folder)


def sync_to_disk(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems cannot for folders; a full or broken disk is said.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(descriptor)


Writer = TypeVar("Writer", bound=Callable[..., None])


def with_endings(*endings: str) -> Callable[[Writer], Writer]:
    """Of a function that writes a file: the *endings* of names that such a file may have."""

    def state(writer: Writer) -> Writer:
        setattr(writer, "endings", endings)  # noqa: B010
        return writer

    return state


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """A path that becomes *path* if the block succeeds; a device such as /dev/stdout is written as it is."""
    if path.is_dir():
        raise DataError("is a folder, a file name is needed", path)
    if path.exists() and not path.is_file():
        yield path
        return
    with output_folder(path.parent) as folder:
        yield folder.write_path(path.name)


# Addresses of files: paths of this machine, and the URLs of an object storage, which are kept as paths.

# Storages of objects; what else pyarrow reaches is a file system that can be mounted.
SCHEMES = ("s3:", "gs:", "gcs:", "abfs:", "abfss:")
FILE = "file://"


def path_of(text: str) -> Path:
    """The path of an address; ConfigError for a URL that names no object, or not clearly."""
    if text.startswith(FILE):
        return Path(unquote(urlsplit(text).path))
    path = Path(text)
    if is_remote(path):
        if len(path.parts) < 2 or "//" in text.split("://", 1)[-1] or ".." in path.parts:
            raise ConfigError("is not a URL of an object", text, "write it as s3://bucket/folder/name")
    elif "://" in text:
        schemes = ", ".join(f"{scheme}//" for scheme in SCHEMES)
        raise ConfigError("is a URL that cannot be read", text, f"known: {schemes}, {FILE}")
    return path


def is_remote(path: Path) -> bool:
    """Whether a path stands for a URL of an object storage."""
    return bool(path.parts) and path.parts[0] in SCHEMES


def show(path: Path) -> str:
    """The path as people write it."""
    return f"{path.parts[0]}//{'/'.join(path.parts[1:])}" if is_remote(path) else str(path)


# Texts as cells of a CSV file: none of them is a formula to the spreadsheet that opens it.

_ACTING = ("=", "+", "-", "@", "\t", "\r", "\n", "'")
_AMOUNT = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?: ?[A-Za-zµ°%./^0-9]{0,12})?|[+-]")


def cell(text: object) -> object:
    """A text as a cell that no spreadsheet computes; anything else as it is."""
    if isinstance(text, str) and text.startswith(_ACTING) and not _AMOUNT.fullmatch(text):
        return f"'{text}"
    return text


def text_of(written: str) -> str:
    """The text that `cell` wrote."""
    return written[1:] if written.startswith("'") and cell(written[1:]) == written else written


def write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows that may lack some columns; columns in the order of first appearance."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with output_file(path) as target, target.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names, restval="", lineterminator="\n")
        writer.writerow({name: cell(name) for name in names})
        writer.writerows({name: cell(entry) for name, entry in row.items()} for row in rows)


def write_table_csv(table: pd.DataFrame, target: Path) -> None:
    """Write a table whose texts no spreadsheet takes for formulas."""
    import pandas as pd

    texts = {
        name: table[name].map(cell)
        for name in table.columns
        if not pd.api.types.is_numeric_dtype(table[name])
    }
    table.assign(**texts).rename(columns=cell).to_csv(target, index=False)
