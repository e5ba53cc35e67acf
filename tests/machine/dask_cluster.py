"""A Dask scheduler and workers on loopback, as people start them: each a process that can be measured, or
killed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

START_SECONDS, END_SECONDS = 60.0, 30.0


@dataclass(frozen=True)
class DaskCluster:
    """Where the scheduler answers, its process, and those of the workers' keepers, which start a worker again
    that has ended.
    """

    address: str
    scheduler: subprocess.Popen[bytes]
    keepers: tuple[subprocess.Popen[bytes], ...]

    def workers(self) -> list[int]:
        """The processes in which tests are worked on, as they are now."""
        import psutil

        found: list[int] = []
        for keeper in self.keepers:
            with suppress(psutil.Error):
                children = psutil.Process(keeper.pid).children(recursive=True)
                found.extend(child.pid for child in children if "spawn_main" in " ".join(child.cmdline()))
        return found


@contextmanager
def dask_cluster(folder: Path, count: int, mark: dict[str, str] | None = None) -> Iterator[DaskCluster]:
    """A scheduler and *count* workers, none of which is left at the end; *mark*: further variables of their
    environment.
    """
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    with (folder / "dask.log").open("ab") as log:

        def start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
            command = [
                sys.executable,
                "-m",
                f"distributed.cli.{module}",
                "--host",
                "127.0.0.1",
                "--dashboard-address",
                "127.0.0.1:0",
                *arguments,
            ]
            environment = {**os.environ, **(mark or {})}
            return subprocess.Popen(
                [*command, "--scheduler-file", str(file)], stdout=log, stderr=log, env=environment, cwd=folder
            )

        scheduler = start("dask_scheduler", "--port", "0")
        processes = [scheduler]
        try:
            end = time.monotonic() + START_SECONDS
            # The scheduler writes the file in place: for a moment it is there and empty, and "}" alone may
            # end a part of it.
            while (
                not (text := file.read_text() if file.exists() else "").endswith("\n}")
                and time.monotonic() < end
            ):
                time.sleep(0.05)
            address = json.loads(text)["address"]
            keepers = tuple(
                start("dask_worker", "--nthreads", "1", "--death-timeout", "20") for _ in range(count)
            )
            processes.extend(keepers)
            yield DaskCluster(address, scheduler, keepers)
        finally:
            for process in reversed(processes):
                process.terminate()
            for process in processes:
                try:
                    process.wait(END_SECONDS)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
