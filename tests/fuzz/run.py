"""python -m tests.fuzz.run [--seconds S] [--start SEED] [--kinds a.csv ...]: mutated inputs for as long as you like.

Every kind of file is read in processes of its own, each with a limit of memory; one that does not answer within ten seconds counts as
hung, is ended, and the next seed follows. Prints a table and what must not be; exit code 1 if there is any of that.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

from labpipe.catalogue.index import INDEX
from tests.fuzz.seeds import READS, write_seeds
from tests.fuzz.trials import Tally, trial_of_file, trial_of_yaml
from tests.unit.pipeline.laboratory import ALONE, laboratory

YAML = ("pipeline.yaml", "rig.yaml")
HANG_SECONDS = 10.0
GIGABYTE = 1 << 30
BATCH = 50


def _work(kind: str, folder: Path, start: int, pipe: Connection) -> None:
    """In a process: trials from seed *start* on, a report after each batch."""
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory(dir=folder) as name:
        scratch = Path(name)
        whole: object = None
        if kind in YAML:
            laboratory(scratch, ALONE)
        else:
            if kind == INDEX:
                (scratch / "identification.json").write_bytes((folder / "laboratory/out/identification.json").read_bytes())
            (scratch / kind).write_bytes((folder / kind).read_bytes())
            whole = READS[kind](scratch / kind)[0]
        seed = start
        while True:
            tally = Tally(kind)
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            for _ in range(BATCH):
                pipe.send(seed)
                if kind in YAML:
                    trial_of_yaml(kind, scratch, seed, tally)
                else:
                    trial_of_file(kind, folder, scratch, seed, tally, whole)
                seed += 1
            if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before > GIGABYTE:
                tally.faults.append(f"{kind} seeds {start}-{seed}: more than 1 GB")
            pipe.send(tally)


def _trials(kind: str, folder: Path, seconds: float, start: int) -> tuple[Tally, int]:
    """The trials of one kind within a time; processes that hang or crash are replaced."""
    context = multiprocessing.get_context("fork")
    total, seed, end = Tally(kind), start, time.monotonic() + seconds
    while time.monotonic() < end:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(kind, folder, seed, theirs), daemon=False)
        process.start()
        theirs.close()
        fault = _listen(ours, total, end)
        process.kill()
        process.join()
        if fault is None:
            break
        seed, what = fault
        total.add(what, f"{kind} seed {seed}: {what}")
        seed += 1
    return total, seed


def _listen(pipe: Connection, total: Tally, end: float) -> tuple[int, str] | None:
    """Take the reports of a process until the end; the seed at which it hung or crashed."""
    seed = 0
    while time.monotonic() < end:
        try:
            if not pipe.poll(HANG_SECONDS):
                return seed, "hung"
            said = pipe.recv()
        except (EOFError, OSError):
            return seed, "crashed"
        if isinstance(said, int):
            seed = said
        else:
            total.counts.update(said.counts)
            total.faults.extend(said.faults)
    return None


def main() -> int:
    """The table of all kinds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for every kind of file")
    parser.add_argument("--start", type=int, default=0, help="the first seed")
    parser.add_argument("--kinds", nargs="*", default=[*READS, *YAML])
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
