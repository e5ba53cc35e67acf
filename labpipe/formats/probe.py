"""A look at a file by a child process: a damaged one can loop for ever or crash inside a library, out of reach of exceptions."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from labpipe.errors import DataError

# Reads a file as the program does later: it raises, loops or crashes where that would.
Touch = Callable[[Path], None]

# Processor seconds for a file, and for each of its megabytes; and a wall clock of some times as much.
SECONDS, SECONDS_PER_MB, PATIENCE = 1.9, 0.05, 4
# Memory [bytes] that looking at a file may take beside what the program has already, and the file itself.
MEMORY = 2 << 30
GOOD, UNREADABLE = 0, 3

_looked_at: dict[tuple[str, int, int, int], int] = {}


def check_in_child(path: Path, kind: str, touch: Touch) -> None:
    """DataError for a file of a *kind* that a child process cannot *touch*, a function of a module, within its limits."""
    status = path.stat()
    key = (str(path), status.st_mtime_ns, status.st_size, status.st_ino)
    if key not in _looked_at:
        _looked_at[key] = _look(path, touch, math.ceil(SECONDS + SECONDS_PER_MB * status.st_size / 1e6))
    code = _looked_at[key]
    if code not in (GOOD, UNREADABLE):
        how = "takes too long" if code in (-signal.SIGXCPU, -signal.SIGKILL) else f"fails inside the {kind} library"
        raise DataError(f"is not a readable {kind} file (reading it {how})", where=str(path), hint="the file is damaged")


def _look(path: Path, touch: Touch, seconds: int) -> int:
    """The exit code of a child process that reads the file, negative for the signal that ended it."""
    if not hasattr(os, "fork"):
        command = [sys.executable, "-m", "labpipe.formats.probe", touch.__module__, touch.__name__, str(path)]
        try:
            return subprocess.run(command, timeout=seconds * PATIENCE, check=False).returncode
        except subprocess.TimeoutExpired:
            return -signal.SIGTERM
    child = os.fork()
    if child == 0:
        os._exit(_read_within(path, touch, seconds))
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
