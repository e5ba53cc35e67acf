"""`labpipe live` for hours and through kills: samples counted, memory watched, equal results.

`python -m tests.draws.soak 60` pipes an hour of 8 channels at 51.2 kHz into the command as fast as it takes
them; `python -m tests.draws.soak kills 50` kills it at so many moments and takes it up again.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from tests.methods.live.test_live import PIPELINE, RIG, samples, write_csv

RATE, CHANNELS = 51200, 8


def soak(minutes: float) -> None:
    """Print averages, memory after a tenth and at the end, and how much faster than the clock it is."""
    names = ["f", "y", *(f"a{number}" for number in range(CHANNELS - 2))]
    others = "".join(
        f"  {name}: {{quantity: displacement, unit: um, role: output, dof: {name}}}\n" for name in names[2:]
    )
    folder = Path(tempfile.mkdtemp())
    (folder / "rig.yaml").write_text(RIG.replace("1 kHz", "51.2 kHz") + others)
    text = "rig: rig.yaml\nfrf: {excitation: periodic, period: 1 s, skip: 0, band: 20-420 Hz}\n"
    (folder / "pipeline.yaml").write_text(text + PIPELINE.split("\n", 2)[2])
    rng = np.random.default_rng(3)
    lines = slice(20, 421)
    spectrum = np.zeros(RATE // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(401)) * RATE / 40
    w = 2 * np.pi * np.arange(spectrum.size)
    motion = spectrum / (80e3 - 0.5 * w**2 + 6j * w) * 1e6
    period = np.stack([np.fft.irfft(part, RATE) for part in (spectrum, motion)], axis=1)
    head = json.dumps({"sample_rate": RATE, "channels": names, "dtype": "<f4"}) + "\n"
    command = [sys.executable, "-m", "labpipe", "live", str(folder / "pipeline.yaml"), "-", "--json"]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdin is not None and child.stdout is not None
    ended: list[dict[str, object]] = []

    def follow() -> None:
        assert child.stdout is not None
        ended.extend(json.loads(line) for line in child.stdout)

    reader = threading.Thread(target=follow)
    reader.start()
    begun, memory = time.monotonic(), {}
    child.stdin.write(head.encode())
    noise = rng.standard_normal((8, RATE, CHANNELS))
    n_period = round(60 * minutes)
    for number in range(n_period):
        rows = 0.05 * noise[number % 8]
        rows[:, :2] += period
        child.stdin.write(rows.astype("<f4").tobytes())
        if number in (n_period // 10, n_period - 1):
            status = Path(f"/proc/{child.pid}/status").read_text()
            memory[number] = int(status.split("VmRSS:")[1].split()[0]) / 1024
    child.stdin.close()
    reader.join()
    code = child.wait()
    taken = time.monotonic() - begun
    last = ended[-1]
    print(f"exit {code}; {last['averages']} averages of {n_period}; {len(ended)} lines; memory [MB] {memory}")
    print(f"{60 * minutes / taken:.0f} times as fast as the clock; {last['parameters']}")


def kills(count: int) -> None:
    """Kill the command at *count* moments, take it up again each time, and compare the results."""
    folder = Path(tempfile.mkdtemp())
    (folder / "rig.yaml").write_text(RIG)
    (folder / "pipeline.yaml").write_text(PIPELINE)
    write_csv(folder / "test.csv", samples(40))
    command = [sys.executable, "-m", "labpipe", "live", str(folder / "pipeline.yaml")]
    command += [str(folder / "test.csv"), "--json", "--idle", "0.3", "-o", str(folder / "out")]
    begun = time.monotonic()
    whole = subprocess.run(command, capture_output=True, check=True).stdout
    length = time.monotonic() - begun
    result = (folder / "out" / "identification.json").read_bytes()
    rng = np.random.default_rng(9)
    unequal = 0
    for _ in range(count):
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.05, length))
        child.kill()
        child.wait()
        again = subprocess.run(command, capture_output=True, check=True).stdout
        unequal += again != whole or (folder / "out" / "identification.json").read_bytes() != result
    print(f"{count} kills, {unequal} unequal results")


if __name__ == "__main__":
    if sys.argv[1:2] == ["kills"]:
        kills(int(sys.argv[2]))
    else:
        soak(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
