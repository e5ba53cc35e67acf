"""A look at an HDF5 file by a child process: a damaged one can loop for ever or crash inside the library, out of reach of exceptions."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from labpipe.errors import DataError

# Processor seconds for a file, and for each of its megabytes; and a wall clock of some times as much.
SECONDS, SECONDS_PER_MB, PATIENCE = 1.9, 0.05, 4
# Memory [bytes] that looking at a file may take beside what the program has already.
MEMORY = 2 << 30
# Elements read at once.
PART = 1 << 20
GOOD, UNREADABLE = 0, 3

_looked_at: dict[tuple[str, int, int, int], int] = {}


def check_hdf5(path: Path) -> None:
    """DataError for a file that a child process cannot read whole within its limits of time and memory."""
    status = path.stat()
    key = (str(path), status.st_mtime_ns, status.st_size, status.st_ino)
    if key not in _looked_at:
        _looked_at[key] = _look(path, math.ceil(SECONDS + SECONDS_PER_MB * status.st_size / 1e6))
    code = _looked_at[key]
    if code not in (GOOD, UNREADABLE):
        how = "takes too long" if code in (-signal.SIGXCPU, -signal.SIGKILL) else "fails inside the HDF5 library"
        raise DataError(f"is not a readable HDF5 file (reading it {how})", where=str(path), hint="the file is damaged")


def _look(path: Path, seconds: int) -> int:
    """The exit code of a child process that reads the file, negative for the signal that ended it."""
    if not hasattr(os, "fork"):
        command = [sys.executable, "-m", "labpipe.formats.hdf5_probe", str(path)]
        try:
            return subprocess.run(command, timeout=seconds * PATIENCE, check=False).returncode
        except subprocess.TimeoutExpired:
            return -signal.SIGTERM
    child = os.fork()
    if child == 0:
        os._exit(_read_within(path, seconds))
    return _ended(child, seconds * PATIENCE)


def _ended(child: int, seconds: float) -> int:
    """How the child ended; it is killed when it takes longer."""
    pause, deadline = 0.0005, time.monotonic() + seconds
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(pause)
        pause = min(2 * pause, 0.05)


def _read_within(path: Path, seconds: int) -> int:
    """In the child: its limits, then the file. Nothing of the parent's is touched or flushed."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with open("/proc/self/statm", encoding="ascii") as statm:
            held = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
    except (ImportError, OSError, ValueError):
        pass
    return _read(path)


def _read(path: Path) -> int:
    import h5py

    def touch(_: str, item: object) -> None:
        dict(item.attrs.items())  # type: ignore[attr-defined]
        if isinstance(item, h5py.Dataset) and item.shape and h5py.check_ref_dtype(item.dtype) is None:
            rows = max(1, PART * item.shape[0] // max(item.size, 1))
            for start in range(0, item.shape[0] if item.size else 0, rows):
                item[start : start + rows]

    try:
        with h5py.File(path, "r") as file:
            dict(file.attrs.items())
            file.visititems(touch)
    except BaseException:
        # What it is the parent finds by the same exception, and says.
        return UNREADABLE
    return GOOD


if __name__ == "__main__":
    sys.exit(_read_within(Path(sys.argv[1]), 1 << 20))
