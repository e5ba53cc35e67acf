"""A logger's file to its FRF by the command, against bare reading and bare FFTs of the same file: CPU, clock
and memory as ratios.

python -m tests.benchmarks.raw_files [--rows N | --size MB] [--block N] [--repeats N] [KIND ...]

Files of two forces and two displacements (white noise) are made on the spot, in the folder for temporary
files (TMPDIR): Parquet of single precision, TDMS of double precision in segments of 100,000 rows, CSV with
five decimals. Both sides are processes of their own; the import of the libraries, which both need, is
measured too and subtracted from both. The bare side reads piece by piece, or the whole file where it is
small, whichever is faster: a gigabyte read at once costs more than twice as much by the memory that it takes.
Least of all repeats, in turns. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
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
PIECE = 1 << 20
KINDS = ("parquet", "tdms", "csv")
# As they are written here.
BYTES_PER_ROW = {"parquet": 14.73, "tdms": 32.0, "csv": 33.56}
WHOLE, PIECES = "whole", "pieces"
# Files [byte] that the bare side may read at once.
SMALL = 300e6
TABLE = """| file | size | bare, CPU | command / bare | bare, by the clock | command / bare | memory of the command |
|---|---|---|---|---|---|---|"""
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
    """A raw file of *n_row* rows in *folder*, with a rig and a pipeline for it.

    In pieces, so that it may be larger than the memory.
    """
    write = {"parquet": _write_parquet, "csv": _write_csv, "tdms": _write_tdms}[kind]
    write(folder / f"raw.{kind}", _pieces(n_row))
    entries = (
        f"  {n}: {{quantity: {'force' if n[0] == 'f' else 'displacement'}, dof: {'xy'[n[-1] == 'z']}}}\n"
        for n in NAMES
    )
    (folder / "rig.yaml").write_text(f"name: R\nsample_rate: {RATE:g} Hz\nchannels:\n{''.join(entries)}")
    (folder / f"{kind}.yaml").write_text(
        f"rig: rig.yaml\nrecordings: raw.{kind}\nfrf: {{excitation: random, block: {n_block / RATE!r} s}}\n"
    )


def _pieces(n_row: int) -> Iterator[np.ndarray]:
    """White noise (n, 4) in single precision, 1 << 20 rows at a time."""
    rng = np.random.default_rng(1)
    for start in range(0, n_row, PIECE):
        yield rng.normal(size=(min(PIECE, n_row - start), len(NAMES))).astype(np.float32)


def _write_parquet(path: Path, pieces: Iterator[np.ndarray]) -> None:
    schema = pa.schema([(name, pa.float32()) for name in NAMES])
    with pq.ParquetWriter(
        path, schema, compression="zstd", use_dictionary=False, use_byte_stream_split=True
    ) as writer:
        for piece in pieces:
            writer.write_table(pa.table({name: piece[:, n] for n, name in enumerate(NAMES)}))


def _write_csv(path: Path, pieces: Iterator[np.ndarray]) -> None:
    with pc.CSVWriter(path, pa.schema([(name, pa.float64()) for name in NAMES])) as writer:
        for piece in pieces:
            writer.write_table(
                pa.table({name: np.round(piece[:, n].astype(float), 5) for n, name in enumerate(NAMES)})
            )


def _write_tdms(path: Path, pieces: Iterator[np.ndarray]) -> None:
    with TdmsWriter(path) as writer:
        for piece in pieces:
            for start in range(0, piece.shape[0], SEGMENT):
                part = piece[start : start + SEGMENT].astype(float)
                facts = {"wf_increment": 1 / RATE, "wf_samples": part.shape[0]}
                writer.write_segment(
                    [ChannelObject("g", name, part[:, n], properties=facts) for n, name in enumerate(NAMES)]
                )


def rows_of(kind: str, megabytes: float) -> int:
    """Rows of a file of that size."""
    return round(megabytes * 1e6 / BYTES_PER_ROW[kind])


def read_whole(path: Path) -> Iterator[list[np.ndarray]]:
    """The columns of a raw file, read at once the shortest way."""
    if path.suffix == ".tdms":
        group = TdmsFile.read(path)["g"]
        yield [group[name][:] for name in NAMES]
        return
    table = pq.read_table(path, use_threads=False) if path.suffix == ".parquet" else pc.read_csv(path)
    yield [column.combine_chunks().to_numpy() for column in table.columns]


def read_in_pieces(path: Path) -> Iterator[list[np.ndarray]]:
    """The columns of a raw file piece by piece, by the library's own iterator."""
    if path.suffix == ".tdms":
        with TdmsFile.open(path) as file:
            for chunk in file.data_chunks():
                yield [chunk["g"][name][:] for name in NAMES]
        return
    if path.suffix == ".parquet":
        batches = pq.ParquetFile(path, pre_buffer=False).iter_batches(batch_size=1 << 17, use_threads=False)
    else:
        batches = pc.open_csv(path, pc.ReadOptions(block_size=1 << 22))
    for batch in batches:
        yield [column.to_numpy() for column in batch.columns]


def bare(path: str, n_block: int, way: str) -> None:
    """A raw file read, and the FFT of every block of every channel; nothing else. *way*: WHOLE or PIECES."""
    rest = np.empty((len(NAMES), 0))
    for piece in (read_whole if way == WHOLE else read_in_pieces)(Path(path)):
        columns = (
            np.concatenate([rest, np.stack(piece).astype(float)], axis=1)
            if rest.size
            else np.stack(piece).astype(float)
        )
        start = 0
        while start + n_block <= columns.shape[1]:
            fft.rfft(columns[:, start : start + n_block], axis=1)
            start += n_block // 2
        rest = columns[:, start:]


def least_costs(folder: Path, commands: list[list[str]], repeats: int) -> list[Cost]:
    """The least cost of each of the commands, run in turns in *folder*.

    Of an installed labpipe, which is compiled only once.
    """
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"} | {
        "PYTHONPATH": str(ROOT)
    }
    found: list[list[Cost]] = [[] for _ in commands]
    for _ in range(repeats):
        for number, command in enumerate(commands):
            ended = subprocess.run(
                [sys.executable, "-c", COUNTED, *command],
                cwd=folder,
                env=environment,
                capture_output=True,
                check=True,
            )
            found[number].append(Cost(*json.loads(ended.stdout)))
    return [
        Cost(*(min(getattr(cost, name) for cost in costs) for name in ("cpu", "clock", "memory")))
        for costs in found
    ]


def measured(kind: str, n_row: int, n_block: int, repeats: int) -> tuple[int, Cost, Cost]:
    """(bytes of the raw file, cost of bare reading and FFTs, cost of the command), both without the import of
    the libraries.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_raw(folder, kind, n_row, n_block)
        path = folder / f"raw.{kind}"
        size = path.stat().st_size
        ways = [PIECES, WHOLE] if size <= SMALL else [PIECES]
        bares = [
            f"from tests.benchmarks.raw_files import bare; bare({str(path)!r}, {n_block}, {way!r})"
            for way in ways
        ]
        command = (
            "from labpipe.cli.main import run_command; import sys, tempfile; "
            f"sys.exit(run_command({_arguments(kind)}))"
        )
        imports, *floors, own = least_costs(
            folder, [[sys.executable, "-c", text] for text in (LIBRARIES, *bares, command)], repeats
        )
        floor = Cost(*(min(getattr(floor, name) for floor in floors) for name in ("cpu", "clock", "memory")))
        return size, floor.less(imports), own.less(imports)


def row_of(kind: str, n_row: int, n_block: int, repeats: int) -> str:
    """The row of the table of a kind of file."""
    size, floor, own = measured(kind, n_row, n_block, repeats)
    return (
        f"| {kind} | {size / 1e6:.0f} MB | {floor.cpu:.2f} s | {own.cpu / floor.cpu:.2f} | {floor.clock:.2f} "
        f"s | {own.clock / floor.clock:.2f} | {own.memory:.0f} MB |"
    )


def _arguments(kind: str) -> str:
    return f"['frf', '-c', '{kind}.yaml', '-o', tempfile.mkdtemp(dir='.'), '-q']"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", choices=[*KINDS, []], default=[])
    parser.add_argument("--rows", type=int, default=16_000_000)
    parser.add_argument("--size", type=float, help="of the files [MB], in place of rows")
    parser.add_argument("--block", type=int, default=25_600)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    print(TABLE)
    for kind in options.kinds or KINDS:
        print(
            row_of(
                kind,
                rows_of(kind, options.size) if options.size else options.rows,
                options.block,
                options.repeats,
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
