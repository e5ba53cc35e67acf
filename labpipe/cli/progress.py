"""Progress of a run over many tests, and its remaining time."""

from __future__ import annotations

import sys
import time

from labpipe.cli.output import echo

# Duration below which no progress is shown.
QUIET_SECONDS = 1.0


class Progress:
    """Shows after each test the number finished and the remaining time: one changing line on a terminal, one line each with -v."""

    def __init__(self, verbose: bool) -> None:
        self._begin = time.monotonic()
        self._verbose = verbose
        self._shown = False

    def __call__(self, finished: int, total: int, name: str) -> None:
        elapsed = time.monotonic() - self._begin
        remaining = f", {duration(elapsed / finished * (total - finished))} left" if finished < total else f" in {duration(elapsed)}"
        if self._verbose:
            echo(f"test {finished} of {total}  {name}{remaining}", err=True)
        elif sys.stderr.isatty() and (elapsed > QUIET_SECONDS or self._shown):
            self._shown = True
            echo(f"\r\x1b[K{finished} of {total} tests{remaining}", err=True, nl=finished == total)


def silent(_finished: int, _total: int, _name: str) -> None:
    """No progress: -q."""


def duration(seconds: float) -> str:
    """A duration as text: 45 s, 3 min 20 s, 2 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
