"""A table on disk: named columns of numbers, read chunk by chunk. READERS by suffix."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError, LabpipeError, shorten
from labpipe.raw_files.text_table import check_filled, plain_suffix
from labpipe.records.rig import time_scale
from labpipe.registry import Registry, nearest


def unique(names: Sequence[str]) -> tuple[str, ...]:
    """The names, with repeated ones numbered from the second on: a, a_2, a_3."""
    unique_names: list[str] = []
    for name in names:
        candidate, number = name, 1
        while candidate in unique_names:
            number += 1
            candidate = f"{name}_{number}"
        unique_names.append(candidate)
    return tuple(unique_names)


# The boundary to files of other programs: whatever damaged bytes make a library raise is a fault of the
# file.

Read = TypeVar("Read")


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """DataError for every exception of a library inside the block."""
    try:
        # Numbers out of range are refused by the screening, with channel and sample.
        with np.errstate(all="ignore"):
            yield
    except LabpipeError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise _unreadable(path, error) from None
    except Exception as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> DataError:
    text = (str(error).splitlines() or [""])[0].rstrip(".")
    return DataError(
        f"cannot be read ({shorten(': '.join(filter(None, (type(error).__name__, text))))})", path, DAMAGED
    )


DAMAGED = "the file is damaged, or not what its ending says"


def guard(read: Callable[..., Read], path: Path, *arguments: Any) -> Read:
    """What *read* makes of a file."""
    with readable(path):
        return read(path, *arguments)


class GuardedTable:
    """A table whose chunks are read within the boundary. Satisfies RawTable."""

    def __init__(self, table: Any) -> None:
        self._table = table

    def __getattr__(self, name: str) -> Any:
        return getattr(self._table, name)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """The chunks (n, n_column) [unit of the file] of the table."""
        return self._guard(self._table.chunks(columns))

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """Column by column (n,) [unit of the file], of a table that has them so."""
        return self._guard(self._table.column_chunks(columns))

    def _guard(self, chunks: Iterator[Read]) -> Iterator[Read]:
        while True:
            with readable(self._table.path):
                chunk = next(chunks, None)
            if chunk is None:
                return
            yield chunk


# A look at a file by a child process: a damaged one can loop for ever or crash inside a library, out of
# reach of exceptions.

# Reads a file as the program does later: it raises, loops or crashes where that would.
Touch = Callable[[Path], object]

# Processor seconds for a file, and for each of its megabytes; and a wall clock of some times as much.
SECONDS, SECONDS_PER_MB, PATIENCE = 1.9, 0.05, 4
# Memory [bytes] that looking at a file may take beside what the program has already, and the file itself.
MEMORY = 2 << 30
GOOD, UNREADABLE = 0, 3

_looked_at: dict[tuple[str, int, int, int], int] = {}


def check_in_child(path: Path, kind: str, touch: Touch) -> None:
    """DataError for a file of a *kind* that a child process cannot *touch*, a function of a module, within
    its limits.
    """
    status = path.stat()
    key = (str(path), status.st_mtime_ns, status.st_size, status.st_ino)
    if key not in _looked_at:
        _looked_at[key] = _look(path, touch, math.ceil(SECONDS + SECONDS_PER_MB * status.st_size / 1e6))
    code = _looked_at[key]
    if code not in (GOOD, UNREADABLE):
        too_long = code in (-signal.SIGXCPU, -signal.SIGKILL)
        how = "takes too long" if too_long else f"fails inside the {kind} library"
        raise DataError(f"is not a readable {kind} file (reading it {how})", path, "the file is damaged")


def _look(path: Path, touch: Touch, seconds: int) -> int:
    if not hasattr(os, "fork"):
        module = [sys.executable, "-m", "labpipe.raw_files.table"]
        command = [*module, touch.__module__, touch.__name__, str(path)]
        try:
            return subprocess.run(command, timeout=seconds * PATIENCE, check=False).returncode
        except subprocess.TimeoutExpired:
            return -signal.SIGTERM
    import tempfile

    # A child that crashes leaves its temporary files behind: they go with this folder.
    with tempfile.TemporaryDirectory(prefix="labpipe-") as folder:
        child = os.fork()
        if child == 0:
            tempfile.tempdir = folder
            os._exit(_read_within(path, touch, seconds))
        return _ending(child, seconds * PATIENCE)


def _ending(child: int, seconds: float) -> int:
    pause, deadline = 0.0005, time.monotonic() + seconds
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(pause)
        pause = min(2 * pause, 0.05)


def _read_within(path: Path, touch: Touch, seconds: int) -> int:
    """In the child: its limits, then the file. Nothing of the parent's is touched or flushed."""
    try:
        import faulthandler
        import gc
        import resource

        # The parent's objects are no garbage of the child's: looking at them would copy all their pages.
        gc.freeze()
        faulthandler.disable()
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with open("/proc/self/statm", encoding="ascii") as statm:
            most = int(statm.read().split()[0]) * resource.getpagesize() + path.stat().st_size + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    except (ImportError, OSError, ValueError):
        pass
    try:
        touch(path)
    except BaseException:
        # What it is the parent finds by the same exception, and says.
        return UNREADABLE
    return GOOD


if __name__ == "__main__":
    module, name, file = sys.argv[1:]
    sys.exit(_read_within(Path(file), getattr(import_module(module), name), 1 << 20))

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".asc")
READERS = Registry("reader")


class RawTable(Protocol):
    """Columns by name; *units* and *sample_rate* [Hz] where the file states them; missing numbers are NaN."""

    path: Path
    columns: tuple[str, ...]
    units: dict[str, str]
    sample_rate: float | None

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file] of the named columns."""
        ...


def open_table(path: Path) -> RawTable:
    """The table of a file by its suffix; DataError for a missing file, a folder, or an unknown kind."""
    if path.is_dir():
        raise DataError("is a folder, not a file", path)
    if not path.exists():
        raise DataError("no such file", path)
    suffix = plain_suffix(path)
    if suffix not in READERS.names():
        what = f"files with the ending '{suffix}' cannot be read"
        raise DataError(what, path, f"known: {', '.join(READERS.names())}")
    if not path.is_file():
        raise DataError("is not a regular file", path)
    check_filled(path)
    table: RawTable = GuardedTable(guard(READERS.load(suffix), path))
    return table


class QuickTable(RawTable, Protocol):
    """A table whose file states its *n_row* rows and is read as fast as labpipe's own recordings, column by
    column.
    """

    n_row: int

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """Consecutive chunks of the named columns, each (n,) [unit of the file], in single precision or
        integers where the file is.
        """
        ...


def as_quick(table: RawTable) -> QuickTable | None:
    """The table where it is a quick one; None for any other."""
    return cast(QuickTable, table) if getattr(table, "n_row", None) is not None else None


def load_extra(module: str, extra: str, path: Path) -> Any:
    """A library that only some files need; DataError names the extra by which it is installed."""
    try:
        return import_module(module)
    except ImportError:
        raise DataError(f"needs the package {module}", path, f"pip install 'labpipe[{extra}]'") from None


def check_names(path: Path, required: Sequence[str], columns: Sequence[str]) -> None:
    """DataError for a *required* column that is not among the *columns* of a file, with the nearest."""
    for name in required:
        if name not in columns:
            raise DataError(f"no column '{name}'", path, nearest(name, columns))


def check_columns(table: RawTable, required: Sequence[str]) -> None:
    """DataError for a required column that is missing (with the nearest name) or not unique."""
    for name in required:
        count, unused = table.columns.count(name), getattr(table, "unused", {})
        if count == 0 and name in unused:
            if getattr(table, "others", None):
                what = f"'{name}' lies in another group than the others, or has another rate"
                hint = "resample: RATE in the rig file brings all to one rate"
            else:
                what = f"'{name}' has {unused[name]} values, fewer than the others"
                hint = "channels of one recording have as many values"
            raise DataError(what, table.path, hint)
        if name in getattr(table, "texts", ()):
            raise DataError(f"the column '{name}' holds text, not numbers", table.path)
        check_names(table.path, [name], table.columns)
        if count > 1:
            raise DataError(f"the column '{name}' appears {count} times", table.path, "rename one of them")


def check_time(table: RawTable, time: str | None) -> None:
    """DataError where the *time* column has the unit of something else; there may be none."""
    if table.units.get(time or "") == "Hz":
        hint = "the file holds a spectrum; a recording is needed, or an FRF under `frfs:`"
        raise DataError(f"'{time}' is a frequency, no time", table.path, hint)
    time_scale(time, table.units, table.path)
