"""Common parts of the commands for several tests: executors and progress."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import click

from labpipe.artefacts.writing import is_remote, show
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.errors import ConfigError
from labpipe.project.executors import LOCAL, Execute, in_processes, on_cluster, serially
from labpipe.project.run import Manner

# Duration below which no progress is shown.
QUIET_SECONDS = 1.0


class Progress:
    """Tests finished and time left: one changing line on a terminal, one line each with -v."""

    def __init__(self, verbose: bool) -> None:
        self._begin = time.monotonic()
        self._verbose = verbose
        self._shown = False

    def __call__(self, finished: int, total: int, name: str) -> None:
        elapsed = time.monotonic() - self._begin
        left = duration(elapsed / finished * (total - finished))
        remaining = f", {left} left" if finished < total else f" in {duration(elapsed)}"
        if self._verbose:
            echo(f"test {finished} of {total}  {name}{remaining}", err=True)
        elif sys.stderr.isatty() and (elapsed > QUIET_SECONDS or self._shown):
            self._shown = True
            # Past our own `echo`, which lets no control character reach the terminal.
            line = f"\r\x1b[K{finished} of {total} tests{remaining}"
            click.echo(line, err=True, nl=finished == total)


def duration(seconds: float) -> str:
    """A duration as text: 45 s, 3 min 20 s, 2 h 5 min."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def manner(quiet: bool, verbose: bool, jobs: int, cluster: str | None) -> Manner:
    """The manner of running tests according to the options of a command."""
    how = Manner(options.teller(quiet, verbose), execute=executor(jobs, cluster))
    return how if quiet else replace(how, progress=Progress(verbose))


def check_shared(output: Path, cluster: str | None) -> None:
    """ConfigError for results that go elsewhere from a folder that the workers of a cluster do not share."""
    if is_remote(output) and cluster not in (None, LOCAL) and "TMPDIR" not in os.environ:
        what = "the workers do not see the folder of this machine in which the results are made"
        raise ConfigError(what, show(output), "set TMPDIR to a folder that all workers share")


def executor(jobs: int, cluster: str | None) -> Execute:
    """Where tests run according to the options of a command."""
    if cluster is not None and jobs != 1:
        hint = "the cluster's workers determine how many tests run at once"
        raise ConfigError("--cluster and -j exclude each other", hint=hint)
    if cluster is not None:
        return on_cluster(cluster)
    processes = jobs or os.cpu_count() or 1
    return serially if processes == 1 else in_processes(processes)
