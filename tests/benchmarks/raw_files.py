"""A logger's file to its FRF by the command, against bare reading and bare FFTs of the same file: CPU, clock and memory as ratios.

python -m tests.benchmarks.raw_files [--rows N] [--block N] [--repeats N] [KIND ...]

Files of two forces and two displacements (white noise) are made on the spot: Parquet of single precision, TDMS of double precision in
segments of 100,000 rows, CSV with five decimals. Both sides are processes of their own; the import of the libraries, which both need, is
measured too and subtracted from both. Least of all repeats, in turns. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
from nptdms import ChannelObject, TdmsFile, TdmsWriter
from scipy import fft

ROOT = Path(__file__).parents[2]
RATE = 10240.0
NAMES = ("f_y", "f_z", "y", "z")
SEGMENT = 100_000
KINDS = ("parquet", "tdms", "csv")
# A small process starts the command: of a child of this one the memory of this one would count.
COUNTED = """
import json, os, subprocess, sys, time
begin = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
process.returncode = os.waitstatus_to_exitcode(status)
assert process.returncode == 0, sys.argv
print(json.dumps([usage.ru_utime + usage.ru_stime, time.perf_counter() - begin, usage.ru_maxrss / 1024]))
"""
LIBRARIES = "import numpy, nptdms, pyarrow.csv, pyarrow.parquet, scipy.fft"


@dataclass(frozen=True)
class Cost:
    """CPU and time by the clock [s], largest memory [MB] of a process."""

    cpu: float
    clock: float
    memory: float

    def less(self, other: Cost) -> Cost:
        """Without what *other* takes already; memory as it is."""
        return Cost(self.cpu - other.cpu, self.clock - other.clock, self.memory)


def write_raw(folder: Path, kind: str, n_row: int, n_block: int) -> None:
    """A raw file of *n_row* rows in *folder*, with a rig and a pipeline for it."""
    rng = np.random.default_rng(1)
    samples = rng.normal(size=(n_row, len(NAMES))).astype(np.float32)
    if kind == "parquet":
        table = pa.table({name: samples[:, n] for n, name in enumerate(NAMES)})
        pq.write_table(table, folder / "raw.parquet", compression="zstd", use_dictionary=False, use_byte_stream_split=True)
    elif kind == "csv":
        pc.write_csv(pa.table({name: np.round(samples[:, n].astype(float), 5) for n, name in enumerate(NAMES)}), folder / "raw.csv")
    else:
        with TdmsWriter(folder / "raw.tdms") as writer:
            for start in range(0, n_row, SEGMENT):
                part = samples[start : start + SEGMENT].astype(float)
                facts = {"wf_increment": 1 / RATE, "wf_samples": part.shape[0]}
                writer.write_segment([ChannelObject("g", name, part[:, n], properties=facts) for n, name in enumerate(NAMES)])
    entries = (f"  {n}: {{quantity: {'force' if n[0] == 'f' else 'displacement'}, dof: {'xy'[n[-1] == 'z']}}}\n" for n in NAMES)
    (folder / "rig.yaml").write_text(f"name: R\nsample_rate: {RATE:g} Hz\nchannels:\n{''.join(entries)}")
    (folder / f"{kind}.yaml").write_text(
        f"rig: rig.yaml\nrecordings: raw.{kind}\nfrf: {{excitation: random, block: {n_block / RATE!r} s}}\n"
    )


def raw_columns(folder: Path, kind: str) -> np.ndarray:
    """The columns of a raw file (n_channel, n_row), read the shortest way."""
    if kind == "tdms":
        group = TdmsFile.read(folder / "raw.tdms")["g"]
        return np.stack([group[name][:] for name in NAMES])
    table = pq.read_table(folder / "raw.parquet", use_threads=False) if kind == "parquet" else pc.read_csv(folder / "raw.csv")
    return np.stack([column.combine_chunks().to_numpy() for column in table.columns]).astype(float)


def bare(folder: str, kind: str, n_block: int) -> None:
    """A raw file read, and the FFT of every block of every channel; nothing else."""
    columns = raw_columns(Path(folder), kind)
    for start in range(0, columns.shape[1] - n_block + 1, n_block // 2):
        fft.rfft(columns[:, start : start + n_block], axis=1)


def least_costs(folder: Path, commands: list[list[str]], repeats: int) -> list[Cost]:
    """The least cost of each of the commands, run in turns in *folder*."""
    found: list[list[Cost]] = [[] for _ in commands]
    for _ in range(repeats):
        for number, command in enumerate(commands):
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            ended = subprocess.run([sys.executable, "-c", COUNTED, *command], cwd=folder, env=environment, capture_output=True, check=True)
            found[number].append(Cost(*json.loads(ended.stdout)))
    return [Cost(*(min(getattr(cost, name) for cost in costs) for name in ("cpu", "clock", "memory"))) for costs in found]


def measured(kind: str, n_row: int, n_block: int, repeats: int) -> tuple[int, Cost, Cost]:
    """(bytes of the raw file, cost of bare reading and FFTs, cost of the command), both without the import of the libraries."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_raw(folder, kind, n_row, n_block)
        bare = f"from tests.benchmarks.raw_files import bare; bare({str(folder)!r}, {kind!r}, {n_block})"
        command = f"from labpipe.cli.main import run_command; import sys, tempfile; sys.exit(run_command({_arguments(kind)}))"
        run = [[sys.executable, "-c", text] for text in (LIBRARIES, bare, command)]
        imports, floor, own = least_costs(folder, run, repeats)
        return (folder / f"raw.{kind}").stat().st_size, floor.less(imports), own.less(imports)


def _arguments(kind: str) -> str:
    return f"['frf', '-c', '{kind}.yaml', '-o', tempfile.mkdtemp(dir='.'), '-q']"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", choices=[*KINDS, []], default=[])
    parser.add_argument("--rows", type=int, default=16_000_000)
    parser.add_argument("--block", type=int, default=25_600)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    print("| file | size | bare CPU | command / bare, CPU | by the clock | memory of the command |\n|---|---|---|---|---|---|")
    for kind in options.kinds or KINDS:
        size, floor, own = measured(kind, options.rows, options.block, options.repeats)
        ratios = f"{own.cpu / floor.cpu:.2f} | {own.clock / floor.clock:.2f}"
        print(f"| {kind} | {size / 1e6:.0f} MB | {floor.cpu:.2f} s | {ratios} | {own.memory:.0f} MB |", flush=True)


if __name__ == "__main__":
    main()
