"""python -m tests.hostile.run [--seconds S] [--start SEED] [--kinds a.csv ...]: mutated inputs for as long as
you like.

Every kind of file is read in processes of its own, each with a limit of memory; one that takes ten seconds of
the processor counts as hung, is ended, and the next seed follows. Prints a table and what must not be; exit
code 1 if there is any of that.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from labpipe.project.catalogue import INDEX
from tests.hostile.scenarios import SCENARIOS, write_scenario
from tests.hostile.seeds import READS, write_seeds
from tests.hostile.trials import Tally, trial_of_file, trial_of_yaml

HANG_SECONDS = 10.0
# A process that waits for something else than the processor, or for a turn on a busy machine.
WAIT_SECONDS = 120.0
GIGABYTE = 1 << 30
# Time after which a process reports, and its share of the machine's memory.
BATCH_SECONDS, MOST_MEMORY = 1.0, 6 * GIGABYTE


def _work(kind: str, folder: Path, start: int, pipe: Connection) -> None:
    """In a process: trials from seed *start* on, a report after each batch."""
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    with tempfile.TemporaryDirectory(dir=folder) as name:
        trial = _trial(kind, folder, Path(name))
        seed = start
        while True:
            tally, end = Tally(kind), time.monotonic() + BATCH_SECONDS
            while time.monotonic() < end:
                pipe.send(seed)
                before, peak = _held(), _peak()
                trial(seed, tally)
                if _peak() > max(before + GIGABYTE, peak):
                    tally.faults.append(f"{kind} seed {seed}: {(_peak() - before) / GIGABYTE:.1f} GB")
                seed += 1
            pipe.send(tally)


def _trial(kind: str, folder: Path, scratch: Path) -> Callable[[int, Tally], None]:
    """The trial of a seed for a kind of file or a scenario, prepared in *scratch*."""
    if kind in SCENARIOS:
        write_scenario(kind, scratch)
        return lambda seed, tally: trial_of_yaml(kind, scratch, seed, tally)
    if kind == INDEX:
        (scratch / "identification.json").write_bytes(
            (folder / "laboratory/out/identification.json").read_bytes()
        )
    (scratch / kind).write_bytes((folder / kind).read_bytes())
    whole = READS[kind](scratch / kind)[0]
    return lambda seed, tally: trial_of_file(kind, folder, scratch, seed, tally, whole)


def _held() -> int:
    """The memory of this process [B]."""
    return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * resource.getpagesize()


def _peak() -> int:
    """The most that it ever held [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _processor_seconds(process: int) -> float:
    """Time that a process has had on a processor."""
    fields = Path(f"/proc/{process}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _trials(kind: str, folder: Path, seconds: float, start: int) -> tuple[Tally, int]:
    """The trials of one kind within a time; processes that hang or crash are replaced."""
    context = multiprocessing.get_context("fork")
    total, seed, end = Tally(kind), start, time.monotonic() + seconds
    while time.monotonic() < end:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(kind, folder, seed, theirs), daemon=False)
        process.start()
        theirs.close()
        fault = _listen(ours, process.pid or 0, total, end)
        process.kill()
        process.join()
        if fault is None:
            break
        seed, what = fault
        total.add(what, f"{kind} seed {seed}: {what}")
        seed += 1
    return total, seed


def _listen(pipe: Connection, process: int, total: Tally, end: float) -> tuple[int, str] | None:
    """Take the reports of a process until the end; the seed at which it hung or crashed."""
    seed, began, clock = 0, time.monotonic(), 0.0
    while time.monotonic() < end:
        try:
            if not pipe.poll(HANG_SECONDS):
                # A trial that began before the time was over is waited for.
                busy, waited = _processor_seconds(process) - clock, time.monotonic() - began
                if busy > HANG_SECONDS or waited > WAIT_SECONDS:
                    return seed, "hung"
                continue
            said = pipe.recv()
        except (EOFError, OSError):
            return seed, "crashed"
        if isinstance(said, int):
            seed, began = said, time.monotonic()
            # Looked up for each trial: a lookup takes 20 us.
            clock = _processor_seconds(process)
        else:
            total.counts.update(said.counts)
            total.faults.extend(said.faults)
    return None


def main() -> int:
    """The table of all kinds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for every kind of file")
    parser.add_argument("--start", type=int, default=0, help="the first seed")
    parser.add_argument("--kinds", nargs="*", default=[*READS, *SCENARIOS])
    arguments = parser.parse_args()
    columns = ("refused", "as it was", "with a finding", "other numbers", "run", "foreign", "hung", "crashed")
    print(f"{'kind':<28}{'trials':>9}" + "".join(f"{name:>15}" for name in columns), flush=True)
    every: Counter[str] = Counter()
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_seeds(folder)
        for kind in arguments.kinds:
            tally, _ = _trials(kind, folder, arguments.seconds, arguments.start)
            every.update(tally.counts)
            faults.extend(tally.faults)
            numbers = "".join(f"{tally.counts[column]:>15}" for column in columns)
            print(f"{kind:<28}{tally.counts.total():>9}{numbers}", flush=True)
            for fault in tally.faults[:5]:
                print(f"    {fault}", flush=True)
    print(f"{'all':<28}{every.total():>9}" + "".join(f"{every[column]:>15}" for column in columns))
    print(f"{len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
