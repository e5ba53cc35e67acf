"""A run over several recordings, killed at a random moment, then finished: the same bytes as an undisturbed
one, and nothing left behind.

python -m tests.machine.kills [--count N] [--processes J | --cluster] [--worker | --scheduler] [--dataset]

With --cluster the tests run on a Dask scheduler with two workers on loopback, which are started and stopped
here. With --worker it is a worker that is killed; the run goes on and ends as if nothing had been. With
--scheduler it is the scheduler: the run says so, and the same command with another one finishes it. With
--dataset the results are kept as a dataset.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from tests.machine.dask_cluster import dask_cluster
from tests.project.laboratory import contents, laboratory, recording

TESTS = 3
PIPELINE = """title: Killed
rig: rig.yaml
tests:
{tests}
frf: {{excitation: periodic, period: 1 s, skip: 0}}
identify:
  direct: {{model: sdof, input: f, output: y, band: 10-40 Hz}}
report: {{formats: [md]}}
results: {results}
"""
MARK = "LABPIPE_KILL_TEST"
# So long processes may take to see that their parent is no more, and a cluster's workers to end a task that
# nobody waits for.
GONE_SECONDS, TASK_SECONDS = 10.0, 0.5
# From the first worker to the end of a run on a cluster, on a busy machine.
SCHEDULER_SECONDS = 6.0
# A killed worker is replaced, which may take a while; nothing may wait for ever.
RUN_SECONDS = 120.0


@dataclass(frozen=True)
class Way:
    """How runs are done: the *options* of the command, and the *workers* of a run that are there now, by its
    mark.
    """

    options: tuple[str, ...]
    workers: Callable[[Path], list[int]]

    @property
    def name(self) -> str:
        return " ".join(self.options)


def prepared(folder: Path, results: str = "whole", options: tuple[str, ...] = ()) -> float:
    """Recordings of several tests, their pipeline, and the result of an undisturbed run in "whole"; that
    run's duration [s].
    """
    laboratory(folder)
    for number in range(TESTS):
        (folder / f"run{number}.csv").write_text(recording(18e3 + 100 * number, seed=number))
    tests = "\n".join(f"  - {{name: t{number}, recordings: run{number}.csv}}" for number in range(TESTS))
    (folder / "pipeline.yaml").write_text(PIPELINE.format(tests=tests, results=results))
    began = time.monotonic()
    assert _begun(folder, "whole", options).wait() == 0
    return time.monotonic() - began


def killed(folder: Path, name: str, way: Way, seconds: float) -> list[str]:
    """Kill a run after *seconds*, finish it, and name what is not as it should be."""
    run = _begun(folder, name, way.options)
    time.sleep(seconds)
    run.send_signal(signal.SIGKILL)
    run.wait()
    end = time.monotonic() + GONE_SECONDS
    while (left := _processes(folder / name)) and time.monotonic() < end:
        time.sleep(0.05)
    faults = [f"processes {left} outlive their parent"] if left else []
    code = _begun(folder, name, way.options).wait()
    return [
        f"killed after {seconds:.3f} s, {way.name}: {fault}"
        for fault in (*faults, *_amiss(folder, name, code, way))
    ]


def worker_killed(folder: Path, name: str, way: Way, seconds: float, rng: random.Random) -> list[str]:
    """Kill a worker of a run *seconds* after the first one is there, and name what is not as it should be at
    the run's end.
    """
    run = _begun(folder, name, way.options)
    while not way.workers(folder / name) and run.poll() is None:
        time.sleep(0.005)
    time.sleep(seconds)
    # A run may end while it is looked at: nothing is killed then.
    if (workers := way.workers(folder / name)) and run.poll() is None:
        with suppress(ProcessLookupError):
            os.kill(rng.choice(workers), signal.SIGKILL)
    try:
        code = run.wait(RUN_SECONDS)
    except subprocess.TimeoutExpired:
        run.kill()
        code = run.wait()
    return [
        f"worker killed after {seconds:.3f} s, {way.name}: {fault}"
        for fault in _amiss(folder, name, code, way)
    ]


def _working(cluster: Any) -> list[int]:
    """The workers that have begun: Dask gives one up that is killed while it starts, and those of a run would
    come to an end.
    """
    keepers = [
        keeper
        for keeper in cluster.workers.values()
        if keeper.process is not None and keeper.process.status.name == "running"
    ]
    return [keeper.pid for keeper in keepers if keeper.pid]


def scheduler_killed(folder: Path, name: str, seconds: float) -> list[str]:
    """Kill the scheduler of a run *seconds* after its first worker is there, finish by another one.

    What is not as it should be.
    """
    faults = []
    with dask_cluster(folder, 1) as first, (folder / f"{name}.err").open("w+") as said:
        run = _begun(folder, name, ("--cluster", first.address), said)
        while not first.workers() and run.poll() is None:
            time.sleep(0.01)
        time.sleep(seconds)
        first.scheduler.kill()
        try:
            code = run.wait(RUN_SECONDS)
        except subprocess.TimeoutExpired:
            run.kill()
            code = run.wait()
        said.seek(0)
        text = said.read()
        if code not in (0, 2) or (code == 2 and len(text.splitlines()) != 1):
            faults.append(f"the run ends with {code}: {text[-500:]}")
    with dask_cluster(folder, 1) as second:
        way = Way(("--cluster", second.address), lambda _: second.workers())
        code = _begun(folder, name, way.options).wait()
        return [
            f"scheduler killed after {seconds:.3f} s: {fault}"
            for fault in (*faults, *_amiss(folder, name, code, way))
        ]


def _amiss(folder: Path, name: str, code: int, way: Way) -> Iterator[str]:
    """What is not as after an undisturbed run.

    On a cluster also when the tasks of the killed run have ended.
    """
    if code != 0:
        yield f"the finished run ends with {code}"
    for pause in (0.0, TASK_SECONDS) if "--cluster" in way.options else (0.0,):
        time.sleep(pause)
        if (found := contents(folder / name)) != (whole := contents(folder / "whole")):
            other = sorted(key for key in found.keys() | whole.keys() if found.get(key) != whole.get(key))
            yield f"other bytes: {', '.join(other)}"
        if staging := [path.name for path in (folder / name).glob(".labpipe-*")]:
            yield f"left behind: {staging}"


def _begun(
    folder: Path, name: str, options: tuple[str, ...], said: IO[str] | int = subprocess.DEVNULL
) -> subprocess.Popen[bytes]:
    arguments = ["run", str(folder / "pipeline.yaml"), "-o", str(folder / name), "-q", *options]
    environment = {**os.environ, MARK: str(folder / name)}
    return subprocess.Popen([sys.executable, "-m", "labpipe", *arguments], env=environment, stderr=said)


def _processes(mark: Path, words: bytes = b"") -> list[int]:
    """The processes of a run, by its mark in their environment, whose command line holds the *words*."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            marked = (
                f"{MARK}={mark}\0".encode() in (entry / "environ").read_bytes()
                and words in (entry / "cmdline").read_bytes()
            )
            if marked and (entry / "stat").read_bytes().rpartition(b")")[2].split()[0] != b"Z":
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def alone(processes: int) -> Way:
    """Runs on this machine; workers are the processes that Python's spawn begins."""
    return Way(("-j", str(processes)), lambda mark: _processes(mark, b"spawn_main"))


@contextmanager
def cluster(folder: Path) -> Iterator[Way]:
    """Runs on two workers of a Dask scheduler on loopback, none of which is left at the end."""
    import distributed

    mark = folder / "cluster"
    os.environ[MARK] = str(mark)
    try:
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as scheduler:
            yield Way(("--cluster", scheduler.scheduler_address), lambda _: _working(scheduler))
    finally:
        del os.environ[MARK]
    end = time.monotonic() + GONE_SECONDS
    while (left := _processes(mark, b"spawn_main")) and time.monotonic() < end:
        time.sleep(0.05)
    assert not left, f"processes {left} of the cluster are left"


def scheduler_kills(count: int, folder: Path, seed: int = 0) -> list[str]:
    """What went wrong in *count* kills of schedulers at random moments of the first seconds of work, in a
    prepared *folder*.
    """
    rng = random.Random(seed)
    return [
        fault
        for number in range(count)
        for fault in scheduler_killed(folder, f"out{number}", rng.uniform(0, SCHEDULER_SECONDS))
    ]


def kills(
    count: int, way: Way, folder: Path, results: str = "whole", *, worker: bool = False, seed: int = 0
) -> list[str]:
    """What went wrong in *count* kills at random moments of a run's duration, in an empty *folder*."""
    rng, duration = random.Random(seed), prepared(folder, results, way.options)
    faults: list[str] = []
    for number in range(count):
        name = f"out{number}"
        if worker:
            # Workers do their part in the second half of a run.
            faults += worker_killed(folder, name, way, rng.uniform(0, 0.7) * duration, rng)
        else:
            faults += killed(folder, name, way, rng.uniform(0.2, 1) * duration)
    return faults


def main() -> int:
    """Kill runs and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--worker", action="store_true")
    parser.add_argument("--scheduler", action="store_true")
    parser.add_argument("--dataset", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        results = "dataset" if arguments.dataset else "whole"
        if arguments.scheduler:
            prepared(folder, results)
            faults = scheduler_kills(arguments.count, folder, arguments.seed)
        else:
            with cluster(folder) if arguments.cluster else nullcontext(alone(arguments.processes)) as way:
                options = {"worker": arguments.worker, "seed": arguments.seed}
                faults = kills(arguments.count, way, folder, results, **options)
    print(*faults, f"{arguments.count} kills, {len(faults)} faults", sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
