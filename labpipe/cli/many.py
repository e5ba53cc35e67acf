"""Common parts of the commands for several tests: executors, progress, and the list of failed tests."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from labpipe.cli import options
from labpipe.cli.output import echo, message_line
from labpipe.cli.progress import Progress, silent
from labpipe.errors import ConfigError
from labpipe.pipeline.cluster import LOCAL, on_cluster
from labpipe.pipeline.executors import Execute, in_processes, serially
from labpipe.pipeline.run import Manner
from labpipe.places.address import is_remote, shown
from labpipe.records.identification import Failed


def manner(quiet: bool, verbose: bool, jobs: int, cluster: str | None) -> Manner:
    """The manner of running tests according to the options of a command."""
    return Manner(options.teller(quiet, verbose), silent if quiet else Progress(verbose), executor(jobs, cluster))


def check_shared(output: Path, cluster: str | None) -> None:
    """ConfigError for results that go elsewhere from a folder that the workers of a cluster do not share."""
    if is_remote(output) and cluster not in (None, LOCAL) and "TMPDIR" not in os.environ:
        what = "the workers do not see the folder of this machine in which the results are made"
        raise ConfigError(what, where=shown(output), hint="set TMPDIR to a folder that all workers share")


def executor(jobs: int, cluster: str | None) -> Execute:
    """Where tests run according to the options of a command."""
    if cluster is not None and jobs != 1:
        raise ConfigError("--cluster and -j exclude each other", hint="the cluster's workers determine how many tests run at once")
    if cluster is not None:
        return on_cluster(cluster)
    processes = jobs or os.cpu_count() or 1
    return serially if processes == 1 else in_processes(processes)


def echo_failed(failed: Sequence[Failed]) -> None:
    """List the failed tests on standard error, at the end."""
    for failure in failed:
        echo(message_line(f"error: {failure.name}: {failure.message}"), err=True)
    if failed:
        echo(f"{len(failed)} failed, the rest is finished; correct the fault and run the same command again", err=True)
