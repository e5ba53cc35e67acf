"""A run over several recordings, killed at a random moment, then finished: the same bytes as an undisturbed one, and nothing left behind.

python -m tests.machine.kills [--count N] [--processes J]
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
from pathlib import Path

from tests.unit.pipeline.laboratory import contents, laboratory, recording

TESTS = 3
PIPELINE = """title: Killed
rig: rig.yaml
tests:
{tests}
frf: {{excitation: periodic, period: 1 s, skip: 0}}
identify:
  direct: {{model: sdof, input: f, output: y, band: 10-40 Hz}}
report: {{formats: [md]}}
"""
# So long processes may take to see that their parent is no more.
GONE_SECONDS = 10.0


def prepared(folder: Path) -> None:
    """Recordings of several tests, their pipeline, and the result of an undisturbed run in "whole"."""
    laboratory(folder)
    for number in range(TESTS):
        (folder / f"run{number}.csv").write_text(recording(18e3 + 100 * number, seed=number))
    tests = "\n".join(f"  - {{name: t{number}, recordings: run{number}.csv}}" for number in range(TESTS))
    (folder / "pipeline.yaml").write_text(PIPELINE.format(tests=tests))
    assert _begun(folder, "whole", 1).wait() == 0


def killed(folder: Path, name: str, processes: int, seconds: float) -> list[str]:
    """Kill a run after *seconds*, finish it, and name what is not as it should be."""
    run = _begun(folder, name, processes)
    time.sleep(seconds)
    run.send_signal(signal.SIGKILL)
    run.wait()
    end = time.monotonic() + GONE_SECONDS
    while (left := _processes(folder / name)) and time.monotonic() < end:
        time.sleep(0.05)
    faults = [f"processes {left} outlive their parent"] if left else []
    if (code := _begun(folder, name, processes).wait()) != 0:
        faults.append(f"the finished run ends with {code}")
    if contents(folder / name) != contents(folder / "whole"):
        faults.append("the finished run has other bytes")
    if staging := [path.name for path in (folder / name).glob(".labpipe-*")]:
        faults.append(f"left behind: {staging}")
    return [f"killed after {seconds:.3f} s, -j {processes}: {fault}" for fault in faults]


def _begun(folder: Path, name: str, processes: int) -> subprocess.Popen[bytes]:
    arguments = ["run", str(folder / "pipeline.yaml"), "-o", str(folder / name), "-q", "-j", str(processes)]
    environment = {**os.environ, "LABPIPE_KILL_TEST": str(folder / name)}
    return subprocess.Popen([sys.executable, "-m", "labpipe.cli.main", *arguments], env=environment, stderr=subprocess.DEVNULL)


def _processes(mark: Path) -> list[int]:
    """The processes of a run, by its mark in their environment."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            marked = f"LABPIPE_KILL_TEST={mark}\0".encode() in (entry / "environ").read_bytes()
            if marked and (entry / "stat").read_bytes().split()[2] != b"Z":
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def kills(count: int, processes: int, seed: int = 0) -> list[str]:
    """What went wrong in *count* kills at random moments of a run's duration."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepared(folder)
        began = time.monotonic()
        assert _begun(folder, "timed", processes).wait() == 0
        duration = time.monotonic() - began
        return [fault for number in range(count) for fault in killed(folder, f"out{number}", processes, rng.uniform(0.3, 1) * duration)]


def main() -> int:
    """Kill runs and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    faults = kills(arguments.count, arguments.processes, arguments.seed)
    print(*faults, f"{arguments.count} kills, {len(faults)} faults", sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
