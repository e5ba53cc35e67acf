"""`labpipe live` for hours and through kills: samples counted, memory watched, equal results.

`python -m tests.draws.soak 60` pipes an hour of 8 channels at 51.2 kHz into the command as fast as it takes
them, `python -m tests.draws.soak 10 clock` ten minutes by the clock, 51 ms at a time;
`python -m tests.draws.soak kills 50` kills it at so many moments, of a file that grows and of frames, and
takes it up again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from labpipe.arrays import FloatArray
from tests.methods.live.test_live import PIPELINE, RIG, killed_and_taken_up, samples, write_csv

RATE, CHANNELS = 51200, 8


# Pieces of a period in which it is written by the clock.
PIECES = 20


def cpu_seconds(process: int) -> float:
    """Time of the processor that a process took so far [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Screen:
    """The command on frames of its standard input; when its lines and the news of its page came [s]."""

    def __init__(self, pipeline: Path, page: bool) -> None:
        command = [sys.executable, "-m", "labpipe", "live", str(pipeline), "-", "--json"]
        self.child = subprocess.Popen(
            [*command, *(["--page"] if page else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert self.child.stdin is not None
        self.frames, self.lines = self.child.stdin, list[dict[str, Any]]()
        self.times: dict[str, list[float]] = {"line": [], "page": []}
        self._page = page

    def begin(self, head: str) -> None:
        self.frames.write(head.encode())
        self.frames.flush()
        self._follower = threading.Thread(target=self._follow, daemon=True)
        self._follower.start()
        if self._page:
            assert self.child.stderr is not None
            address = self.child.stderr.readline().decode().split()[-1]
            threading.Thread(target=self._listen, args=(address,), daemon=True).start()
        time.sleep(1.0)

    def _follow(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self.times["line"].append(time.monotonic())
            self.lines.append(json.loads(line))

    def _listen(self, address: str) -> None:
        try:
            with urllib.request.urlopen(address.replace("/?", "/events?")) as news:
                self.times["page"] += [time.monotonic() for line in news if line.startswith(b"data")]
        except OSError:
            pass

    def ended(self) -> int:
        """Its exit code, once all is followed."""
        self.frames.close()
        self._follower.join()
        return self.child.wait()

    @property
    def memory(self) -> float:
        """What it holds [MB]."""
        status = Path(f"/proc/{self.child.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1024


def one_period(rng: np.random.Generator) -> FloatArray:
    """A second of a multisine of 401 lines: force [N] and displacement [um], (n, 2)."""
    lines = slice(20, 421)
    spectrum = np.zeros(RATE // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(401)) * RATE / 40
    w = 2 * np.pi * np.arange(spectrum.size)
    motion = spectrum / (80e3 - 0.5 * w**2 + 6j * w) * 1e6
    return np.stack([np.fft.irfft(part, RATE) for part in (spectrum, motion)], axis=1)


def soak(minutes: float, clock: bool = False) -> None:
    """Print averages, memory after a tenth and at the end, the processor's time, and how much faster than the
    clock it is; by the *clock* how long after its last sample an average is on the screen.
    """
    names = ["f", "y", *(f"a{number}" for number in range(CHANNELS - 2))]
    others = "".join(
        f"  {name}: {{quantity: displacement, unit: um, role: output, dof: {name}}}\n" for name in names[2:]
    )
    folder = Path(tempfile.mkdtemp())
    (folder / "rig.yaml").write_text(RIG.replace("1 kHz", "51.2 kHz") + others)
    text = "rig: rig.yaml\nfrf: {excitation: periodic, period: 1 s, skip: 0, band: 20-420 Hz}\n"
    (folder / "pipeline.yaml").write_text(text + PIPELINE.split("\n", 2)[2])
    rng = np.random.default_rng(3)
    period = one_period(rng)
    screen = Screen(folder / "pipeline.yaml", clock)
    screen.begin(json.dumps({"sample_rate": RATE, "channels": names, "dtype": "<f4"}) + "\n")
    n_period = round(60 * minutes)
    begun, memory, processor, written = time.monotonic(), {}, [], []
    for number in range(n_period):
        rows = 0.05 * rng.standard_normal((RATE, CHANNELS), np.float32)
        rows[:, :2] += period
        pieces = np.array_split(rows, PIECES if clock else 1)
        for part, piece in enumerate(pieces, 1):
            if clock:
                time.sleep(max(begun + number + part / PIECES - time.monotonic(), 0.0))
            screen.frames.write(piece.astype("<f4").tobytes())
        screen.frames.flush()
        written.append(time.monotonic())
        if number in (n_period // 10, n_period - 1):
            memory[number] = screen.memory
            processor.append(cpu_seconds(screen.child.pid))
    code, last = screen.ended(), screen.lines[-1]
    taken = time.monotonic() - begun
    print(f"exit {code}; {last['averages']} averages of {n_period}; {len(screen.lines)} lines; {memory} MB")
    share = (processor[-1] - processor[0]) / (n_period - 1 - n_period // 10)
    print(f"{60 * minutes / taken:.1f} times as fast as the clock; {1000 * share:.0f} ms of CPU an average")
    for where, times in screen.times.items() if clock else ():
        delay = np.array(times[:n_period]) - np.array(written[: len(times)])
        print(f"{where}: {len(times)}; delay [s] median, 99 %, most: {np.quantile(delay, [0.5, 0.99, 1])}")
    print(last["parameters"])


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
    pieces = np.array_split(np.frombuffer((folder / "test.csv").read_bytes(), np.uint8), 50)
    equal, n_line = 0, []
    for _ in range(count):
        # Written within the time that the command took, cut anywhere within lines, and whole after the kill.
        (folder / "test.csv").write_bytes(b"")
        writer = threading.Thread(target=grow, args=(folder / "test.csv", pieces, length / len(pieces)))
        writer.start()
        child = subprocess.Popen([*command, "--idle", "5"], stdout=subprocess.PIPE)
        time.sleep(rng.uniform(0.05, 1.2 * length))
        child.kill()
        assert child.stdout is not None
        before = child.stdout.readlines()
        child.wait()
        writer.join()
        again = subprocess.run(command, capture_output=True, check=True).stdout
        same = again == whole and b"".join(before[:-1]) == whole[: sum(map(len, before[:-1]))]
        equal += same and (folder / "out" / "identification.json").read_bytes() == result
        n_line.append(len(before))
    print(f"a file that grows: {count} kills behind {n_line} lines, {equal} times the same lines and results")
    kills_of_frames(folder, count, rng)


def grow(path: Path, pieces: list[NDArray[np.uint8]], pause: float) -> None:
    """Append the *pieces* of a file, a *pause* [s] before each."""
    for piece in pieces:
        time.sleep(pause)
        with path.open("ab") as stream:
            stream.write(piece.tobytes())


def kills_of_frames(folder: Path, count: int, rng: np.random.Generator) -> None:
    """The same of frames on standard input, whose source goes on behind what was read last: the lines that
    were printed come again, every frame is in the recordings, and the fits are those of a run of these.
    """
    rows, out = samples(40), folder / "out"
    lines_equal = frames_equal = fits_equal = 0
    for _ in range(count):
        before, lines = killed_and_taken_up(folder, rows, int(rng.integers(0, len(rows) - 1)))
        lines_equal += lines[: max(len(before) - 1, 0)] == before[:-1]
        files = sorted(out.glob("recording*.parquet"))
        stored = np.concatenate([np.stack([c.to_numpy() for c in pq.read_table(f)], axis=1) for f in files])
        frames_equal += np.array_equal(stored, rows)
        command = [sys.executable, "-m", "labpipe", "run", str(folder / "pipeline.yaml"), "-q", "-o"]
        named = f"recordings={json.dumps([str(path) for path in files])}"
        command += [str(folder / "run"), "--set", named, "--set", "report.formats=[md]"]
        subprocess.run(command, capture_output=True, check=True)
        fits = [
            json.loads((place / "identification.json").read_text())["fits"] for place in (out, folder / "run")
        ]
        fits_equal += fits[0] == fits[1]
    print(f"frames: {count} kills; equal lines {lines_equal}, all frames {frames_equal}, fits {fits_equal}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["kills"]:
        kills(int(sys.argv[2]))
    else:
        soak(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0, "clock" in sys.argv)
