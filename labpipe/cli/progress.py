"""How far a run over many tests is, and how long the rest will take."""

from __future__ import annotations

import sys
import time

import click

# Shorter runs need no progress.
QUIET_SECONDS = 1.0


class Progress:
    """Says after each test how many are done and what time is left: one line that changes on a terminal, one line each with -v."""

    def __init__(self, verbose: bool) -> None:
        self._begin = time.monotonic()
        self._verbose = verbose
        self._shown = False

    def __call__(self, done: int, total: int, name: str) -> None:
        elapsed = time.monotonic() - self._begin
        left = f", {duration(elapsed / done * (total - done))} left" if done < total else f" in {duration(elapsed)}"
        if self._verbose:
            click.echo(f"test {done} of {total}  {name}{left}", err=True)
        elif sys.stderr.isatty() and (elapsed > QUIET_SECONDS or self._shown):
            self._shown = True
            click.echo(f"\r\x1b[K{done} of {total} tests{left}", err=True, nl=done == total)


def silent(_done: int, _total: int, _name: str) -> None:
    """No progress: -q."""


def duration(seconds: float) -> str:
    """A time as people say it: 45 s, 3 min 20 s, 2 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
