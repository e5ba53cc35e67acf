"""What a fleet of recordings costs: the figures of docs/pages/how-to/fleet.md.

python -m tests.benchmarks.fleet [--recordings 2000] [--results 20000] [--cluster 1000 4000 16000] [--folder
DIR]

Recordings have 16,000 rows of two channels and one fit of one mass on a spring. Times are of the processor,
of all processes together; those by the clock say something on a machine that does nothing else, whose load is
printed first. With 0 a part is left out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.machine.dask_cluster import dask_cluster

RATE, PERIOD, PERIODS = 2000, 2000, 8
# Of tests on a cluster, where it is the handing out of them that is looked at.
TINY_RATE, TINY_PERIOD = 128, 128
MASS, DAMPING, STIFFNESS = 12.0, 120.0, 100e3
RIG = """name: fleet
sample_rate: {rate} Hz
channels:
  force: {{quantity: force, role: input, unit: V, sensitivity: 0.01 V/N, dof: x}}
  disp: {{quantity: displacement, role: output, unit: V, sensitivity: 8 V/mm, dof: x}}
"""
PIPELINE = """title: Fleet
rig: rig.yaml
tests:
  - {each: "runs/*.parquet", pattern: "{load}-{serial}"}
frf: {excitation: periodic, period: 1 s, skip: 1, band: 5-60 Hz}
identify:
  direct: {model: sdof, estimator: ml, input: force, output: disp, band: 5-60 Hz}
accept: {direct.k: 100 kN/m +- 20 %}
results: dataset
report: {formats: []}
"""
# A command in a process that tells what it and its children took.
COUNTED = """
import json, resource, sys, time
from labpipe.cli.main import run_command
began = time.perf_counter()
code = run_command(sys.argv[2:])
own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
usage = {"code": code, "wall": time.perf_counter() - began, "cpu": sum(one.ru_utime + one.ru_stime for one in (own, others))}
open(sys.argv[1], "w").write(json.dumps({**usage, "own": own.ru_utime + own.ru_stime, "peak": own.ru_maxrss / 1024}))
"""
QUERY = """SELECT test, value FROM read_parquet('{folder}/dataset/*/*/*.parquet', hive_partitioning = true)
WHERE parameter = 'k' AND "amount.load" >= 6000"""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=int, default=2000)
    parser.add_argument("--results", type=int, default=20_000)
    parser.add_argument("--cluster", type=int, nargs="*", default=[1000, 4000, 16_000])
    parser.add_argument(
        "--folder", type=Path, help="keeps the files; by default a folder that goes at the end"
    )
    asked = parser.parse_args()
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} at the beginning", flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = asked.folder or Path(name)
        if asked.recordings:
            table(recordings(folder / "recordings", asked.recordings))
        if asked.results:
            table(results(folder / "results", asked.results))
        if counts := [count for count in asked.cluster if count]:
            table(cluster(folder / "cluster", counts))
    print(f"load {os.getloadavg()[0]:.1f} at the end")


def table(rows: Iterator[tuple[str, str]]) -> None:
    """Lines of a Markdown table as they are found."""
    print("\n| what | measured |\n|---|---|")
    for what, found in rows:
        print(f"| {what} | {found} |", flush=True)


def prepared(
    folder: Path, count: int, rate: int = RATE, period: int = PERIOD, periods: int = PERIODS
) -> Path:
    """Recordings of rigs whose stiffness goes up and down by a tenth, seeds pinned, and their pipeline."""
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    (folder / "rig.yaml").write_text(RIG.format(rate=rate))
    (folder / "pipeline.yaml").write_text(PIPELINE)
    f = np.arange(period // 2 + 1) * rate / period
    lines = (f >= 5) & (f <= 60)
    omega = 2 * np.pi * f[lines]
    for number in range(count):
        rng = np.random.default_rng(number)
        stiffness = STIFFNESS * (1 + 0.1 * math.sin(number / 200))
        force, disp = np.zeros(f.size, complex), np.zeros(f.size, complex)
        force[lines] = np.exp(2j * np.pi * rng.random(omega.size)) * period / 2 * 5
        disp[lines] = force[lines] / (stiffness - MASS * omega**2 + 1j * DAMPING * omega)
        volts = {
            "force": np.tile(np.fft.irfft(force), periods) / 100
            + 5e-4 * rng.standard_normal(period * periods),
            "disp": np.tile(np.fft.irfft(disp), periods) * 8000
            + 2e-3 * rng.standard_normal(period * periods),
        }
        columns = {name: values.astype(np.float32) for name, values in volts.items()}
        pq.write_table(pa.table(columns), folder / f"runs/{number % 7 + 1}kN-{number:06d}.parquet")
    return folder


def counted(*arguments: object) -> dict[str, float]:
    """What a command takes: seconds by the clock and of the processor, own and of all, its peak of memory
    [MB].
    """
    with tempfile.TemporaryDirectory() as name:
        usage = Path(name) / "usage"
        command = [sys.executable, "-c", COUNTED, str(usage), *map(str, arguments)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        found: dict[str, float] = json.loads(usage.read_text())
    # Among thousands of tests some warning is false, and a warning that spoils a fit is a rule that fails.
    assert found["code"] in (0, 1), arguments
    return found


def recordings(folder: Path, count: int) -> Iterator[tuple[str, str]]:
    """The cost of each of many recordings, beside what their numbers alone cost."""
    few = prepared(folder / "few", count // 10)
    many = prepared(folder / "many", count)
    bare = bare_cpu(few) / (count // 10)
    yield (
        f"bare loop: read, transform, fit; {count // 10} recordings",
        (f"{1e3 * bare:.1f} ms CPU per recording"),
    )
    less, more = (counted("run", home / "pipeline.yaml", "-o", home / "one", "-q") for home in (few, many))
    each = (more["cpu"] - less["cpu"]) / (count - count // 10)
    yield (
        f"`labpipe run`, {count} recordings",
        (f"{1e3 * each:.1f} ms CPU per recording, {1e3 * (each - bare):.1f} ms beyond the bare loop"),
    )
    yield "processor time of the whole command", f"{more['cpu']:.1f} s, {more['wall']:.1f} s by the clock"
    yield f"peak memory with {count // 10} and {count} recordings", peaks(less, more)
    two_few, two = (
        counted("run", home / "pipeline.yaml", "-o", home / "two", "-q", "-j", "2") for home in (few, many)
    )
    yield (
        "`-j 2`",
        (
            f"{two['cpu']:.1f} s CPU, {two['wall']:.1f} s by the clock, "
            f"{more['wall'] / two['wall']:.2f} times as fast as `-j 1`"
        ),
    )
    yield f"peak memory of the parent with {count // 10} and {count} recordings, `-j 2`", peaks(two_few, two)
    warm = counted("run", many / "pipeline.yaml", "-o", many / "one", "-q")
    yield "the same command again, nothing new", f"{warm['cpu']:.1f} s CPU"
    report = counted("report", many / "one", "-o", folder / "report.html", "-q")
    yield (
        "summary report",
        (f"{report['cpu']:.1f} s CPU, {(folder / 'report.html').stat().st_size / 1e6:.2f} MB"),
    )
    for name, pattern in (
        ("raw recording", "runs/*"),
        ("response", "one/*.frf.parquet"),
        ("fits", "one/fits/*"),
        ("rows of the dataset", "one/dataset/*/*/*"),
    ):
        yield (
            f"disk, {name}",
            f"{sum(path.stat().st_size for path in many.glob(pattern)) / count / 1e3:.1f} kB per recording",
        )


def peaks(less: dict[str, float], more: dict[str, float]) -> str:
    """Two peaks of memory and their difference."""
    return f"{less['peak']:.0f} and {more['peak']:.0f} MB ({100 * (more['peak'] / less['peak'] - 1):+.1f} %)"


def bare_cpu(folder: Path) -> float:
    """Processor time of reading, transforming and fitting in this process, with nothing written and nothing
    checked but by the numbers.
    """
    from labpipe.project.pipeline_file import load_pipeline
    from labpipe.project.work import fits_of
    from labpipe.records.recording import Recording
    from labpipe.spectra.measurement import measure

    pipeline = load_pipeline(folder / "pipeline.yaml")
    rig, settings = pipeline.rig, pipeline.frf
    assert rig is not None and settings is not None
    scale = np.array([channel.scale for channel in rig.channels])
    paths = sorted((folder / "runs").iterdir())
    began = 0.0
    for path in (paths[0], *paths):
        # The first one loads what all need.
        began = began or (time.process_time() if path is not paths[0] else 0.0)
        read = pq.read_table(path)
        samples = np.column_stack([read[channel.column].to_numpy() for channel in rig.channels]) * scale
        response = measure(
            [Recording(rig.all_channels, samples, float(rig.sample_rate or 0), path.stem)],
            settings,
            name=path.stem,
        )
        assert len(fits_of([response], pipeline.fits[0], pipeline.path)) == 1
    return time.process_time() - began


def results(folder: Path, count: int) -> Iterator[tuple[str, str]]:
    """Questions to a dataset of so many results, written by the product's own writer from one result."""
    from labpipe.artefacts.dataset_file import write_parts
    from labpipe.artefacts.identification_file import NAME, write_identification
    from labpipe.artefacts.writing import output_folder
    from labpipe.project.many_tests import PART_TESTS, summarise_tests
    from labpipe.project.one_test import Job, work
    from labpipe.project.pipeline_file import load_pipeline
    from labpipe.records.dataset import sum_summaries, summary_of

    home = prepared(folder, 1)
    pipeline = load_pipeline(home / "pipeline.yaml")
    where = {"pipeline_path": pipeline.path, "target": home / "first", "scratch": home}
    done = work(
        Job(
            pipeline.tests[0], ("first",), frf=pipeline.frf, fits=pipeline.fits, rules=pipeline.rules, **where
        )
    )
    assert done.result is not None
    first = done.result
    out = home / "out"
    with output_folder(out) as output:
        made = []
        for number in range(count):
            own = {
                "test": f"{number % 7 + 1}kN-{number:06d}",
                "conditions": {"load": f"{number % 7 + 1}kN", "serial": f"{number:06d}"},
            }
            rows = tuple(
                replace(row, **own, value=(row.value or 0) * (1 + 1e-6 * number)) for row in first.rows
            )  # type: ignore[arg-type]
            made.append(replace(first, rows=rows))
        for start in range(0, count, PART_TESTS):
            write_parts(made[start : start + PART_TESTS], output)
        write_identification(
            output.write_path(NAME),
            summarise_tests(pipeline, sum_summaries(summary_of(result) for result in made)),
        )
    size = sum(path.stat().st_size for path in out.rglob("*.parquet"))
    yield f"dataset of {count} results", f"{size / 1e6:.1f} MB in {len(list(out.rglob('*.parquet')))} parts"
    for what in (["--where", "load = 3 kN"], ["--where", "load >= 6 kN"]):
        asked = [counted("list", out, "-p", "k", *what) for _ in range(3)]
        best = min(asked, key=lambda one: one["cpu"])
        yield (
            f'`labpipe list -p k {what[0]} "{what[1]}"`',
            f"{best['cpu']:.2f} s CPU, {min(one['wall'] for one in asked):.2f} s by the clock",
        )
    report = counted("report", out, "-o", home / "report.html", "-q")
    size = (home / "report.html").stat().st_size
    yield (
        f"summary report of {count} results",
        (f"{report['cpu']:.1f} s CPU, {size / 1e6:.2f} MB, peak memory {report['peak']:.0f} MB"),
    )
    yield "`labpipe --version`", f"{min(version_seconds() for _ in range(3)):.2f} s by the clock"
    yield from same_by_duckdb(out)


def version_seconds() -> float:
    """The clock's time of a command that does nothing."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "labpipe", "--version"], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def same_by_duckdb(out: Path) -> Iterator[tuple[str, str]]:
    """The same question to DuckDB; the same numbers."""
    import csv

    import duckdb

    counted("list", out, "-p", "k", "--where", "load >= 6 kN", "--csv", out / "k.csv")
    with (out / "k.csv").open() as file:
        mine = {row["test"]: float(row["value"]) for row in csv.DictReader(file)}
    began = time.process_time()
    other = dict(duckdb.sql(QUERY.format(folder=out)).fetchall())
    cpu = time.process_time() - began
    same = mine.keys() == other.keys() and all(abs(mine[name] / other[name] - 1) < 1e-12 for name in mine)
    yield (
        "DuckDB on the same parts",
        (f"{cpu:.2f} s CPU; {len(other)} values, {'the same' if same else 'OTHERS'}"),
    )


def cluster(folder: Path, counts: Sequence[int]) -> Iterator[tuple[str, str]]:
    """Tiny tests on a Dask cluster of this machine: what each costs as they become more, and what the
    scheduler needs.
    """
    import psutil

    cost: dict[int, float] = {}
    for count in counts:
        home = prepared(folder / str(count), count, TINY_RATE, TINY_PERIOD, 3)
        with dask_cluster(home, os.cpu_count() or 1) as started:
            took = counted(
                "run", home / "pipeline.yaml", "-o", home / "out", "-q", "--cluster", started.address
            )
            scheduler, *workers = [
                psutil.Process(process.pid) for process in (started.scheduler, *started.keepers)
            ]
            peak = memory_peak(scheduler.pid)
            in_workers = sum(
                sum(one.cpu_times()[:2])
                for worker in workers
                for one in (worker, *worker.children(recursive=True))
            )
            in_scheduler = sum(scheduler.cpu_times()[:2])
        cost[count] = took["cpu"] + in_workers + in_scheduler
        shares = (
            f"workers {1e3 * in_workers / count:.1f}, scheduler {1e3 * in_scheduler / count:.2f}, client "
            f"{1e3 * took['cpu'] / count:.1f}"
        )
        yield f"{count} tiny tests, CPU per test [ms]", shares
        yield (
            f"{count} tiny tests, per second and core",
            (f"{count / cost[count]:.1f} of processor time, {took['wall']:.0f} s by the clock"),
        )
        yield f"{count} tiny tests, peak memory", f"scheduler {peak:.0f} MB, client {took['peak']:.0f} MB"
    if len(cost) > 1:
        slope, level = np.polyfit(np.log(list(cost)), np.log(list(cost.values())), 1)
        yield "exponent of the cost over the number", f"{slope:.3f}"
        yield "100,000 tiny tests by that line", f"{math.exp(level) * 1e5**slope / 3600:.2f} core hours"


def memory_peak(number: int) -> float:
    """The peak of a process's memory [MB]."""
    text = Path(f"/proc/{number}/status").read_text()
    return next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmHWM")) / 1024


if __name__ == "__main__":
    main()
