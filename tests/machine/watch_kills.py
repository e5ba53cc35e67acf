"""A watch over arriving recordings, killed at random moments, then finished: every recording has its rows
once, with the same numbers.

python -m tests.machine.watch_kills [--count N] [--seed S] [--s3]

With --s3 recordings arrive in an object storage, an S3 server on loopback, and the results go there.
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
from contextlib import nullcontext
from pathlib import Path

from labpipe.artefacts.dataset_file import read_rows
from labpipe.artefacts.mirrored import everything, read_results
from labpipe.artefacts.writing import is_remote, path_of
from tests.machine.s3_server import s3_client, s3_server
from tests.project.laboratory import PIPELINE, RIG, recording

RECORDINGS = 8
BUCKET = "benches"
BENCH = 'title: Bench\nrig: rig.yaml\ntests:\n  - {each: "*.csv"}\n' + PIPELINE[PIPELINE.index("frf:") :]
COMMAND = (sys.executable, "-m", "labpipe", "watch")
# The longest time until a kill: starting up, working and appending lie within it.
LONGEST_SECONDS = 6.0


def watch(folder: Path, *more: str) -> subprocess.Popen[bytes]:
    """A watch of the recordings of a folder that appends each result at once."""
    settings = ("--settle", "0 s", "--every", "0.2 s", "--append", "0 s", "-q", *more)
    runs, out = (place(folder, name) for name in ("runs", "out"))
    logs = ("--log", str(folder / "log")) if is_remote(path_of(out)) else ()
    return subprocess.Popen([*COMMAND, runs, "-c", str(folder / "bench.yaml"), "-o", out, *logs, *settings])


def place(folder: Path, name: str) -> str:
    """A folder of a bench, or its prefix in the storage that the environment names."""
    return f"s3://{BUCKET}/{folder.name}/{name}" if "AWS_ENDPOINT_URL" in os.environ else str(folder / name)


def prepared(folder: Path) -> Path:
    """A bench without recordings yet."""
    (folder / "runs").mkdir(parents=True)
    (folder / "rig.yaml").write_text(RIG)
    (folder / "bench.yaml").write_text(BENCH)
    return folder


def arrive(folder: Path, number: int) -> None:
    """A recording comes; every fourth is none."""
    text = "no recording" if number % 4 == 3 else recording(18e3 + 100 * number, seed=number)
    if is_remote(path_of(place(folder, "runs"))):
        s3_client().put_object(Bucket=BUCKET, Key=f"{folder.name}/runs/{number}.csv", Body=text.encode())
        return
    (folder / f"{number}.part").write_text(text)
    (folder / f"{number}.part").rename(folder / f"runs/{number}.csv")


def rows_in(folder: Path) -> list[dict[str, object]]:
    """The rows of the dataset by test, fit and parameter."""
    with read_results(path_of(place(folder, "out")), everything) as here:
        rows = read_rows(here).to_pylist()
    return sorted(rows, key=lambda row: (row["test"], str(row["fit"]), str(row["parameter"])))


def killed_and_finished(folder: Path, draw: random.Random) -> list[dict[str, object]]:
    """The rows after a watch that is killed again and again while recordings arrive, and then finished."""
    prepared(folder)
    numbers = list(range(RECORDINGS))
    while numbers:
        process = watch(folder)
        end = time.monotonic() + draw.uniform(0.2, LONGEST_SECONDS)
        while time.monotonic() < end and numbers:
            arrive(folder, numbers.pop(0))
            time.sleep(min(draw.uniform(0, 1.5), max(end - time.monotonic(), 0)))
        process.send_signal(signal.SIGKILL)
        process.wait()
    if watch(folder, "--once").wait() != 0:
        return []
    return rows_in(folder)


def kills(count: int, seed: int) -> list[str]:
    """What is not as it should be after each of *count* trials."""
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        whole = prepared(Path(name) / "whole")
        for number in range(RECORDINGS):
            arrive(whole, number)
        watch(whole, "--once").wait()
        expected = [_numbers(row) for row in rows_in(whole)]
        for trial in range(count):
            folder = Path(name) / str(trial)
            found = [_numbers(row) for row in killed_and_finished(folder, random.Random(seed + trial))]
            if found != expected:
                faults.append(f"trial {trial}: {len(found)} rows for {len(expected)}, or other numbers")
            if left := [path.name for path in (folder / "out").rglob(".labpipe-*") if path.is_dir()]:
                faults.append(f"trial {trial}: left behind: {left}")
            with read_results(path_of(place(folder, "out")), everything) as here:
                aside = len(list((here / "quarantine").glob("*.csv.reason.txt")))
            if aside != RECORDINGS // 4:
                faults.append(f"trial {trial}: {aside} recordings in quarantine")
    return faults


def _numbers(row: dict[str, object]) -> dict[str, object]:
    """A row without the folder of its trial, which stands in the reasons, and in URLs, which a recording's
    digest counts in.
    """
    where = {"digest": ""} if "AWS_ENDPOINT_URL" in os.environ else {}
    return {**row, **where, "failed": row["failed"] is not None}


def main() -> None:
    """Print what is not as it should be; exit code 1 if there is any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--s3", action="store_true")
    asked = parser.parse_args()
    with s3_server() if asked.s3 else nullcontext({}) as environment:
        os.environ.update(environment)
        if asked.s3:
            s3_client().create_bucket(Bucket=BUCKET)
        faults = kills(asked.count, asked.seed)
    print(*faults, f"{asked.count} trials of a killed watch, {len(faults)} faults", sep="\n")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
