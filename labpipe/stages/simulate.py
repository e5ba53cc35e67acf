"""simulate: a virtual rig -> recorded files as a logger would write them, and truth.json."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from labpipe.artefacts.writing import OutputFolder
from labpipe.config.faults import Faults
from labpipe.config.reader import read_settings
from labpipe.marked_yaml import load_marked, set_entry
from labpipe.records.recording import Recording
from labpipe.simulate.magnetic_rig import SimulatedRun, simulate
from labpipe.simulate.settings import VirtualRig

# What the virtual logger writes for a channel: (recorded unit, recorded value per SI value). y comes as the probe's voltage.
RECORDED = {"f": ("N", 1.0), "x": ("um", 1e6), "y": ("V", 8e3), "z": ("um", 1e6)}
CSV_RUNS = ("pedestal", "axial")


def load_virtual_rig(path: Path, overrides: Iterable[str] = ()) -> VirtualRig:
    """The virtual rig of a YAML file; ConfigErrors with every fault at its place."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults()
    rig = read_settings(VirtualRig, tree, "", faults)
    faults.raise_any()
    assert rig is not None
    return rig


def simulate_files(rig: VirtualRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """Write the files of the runs and truth.json; their names."""
    made = simulate(rig, seed, runs)
    names = [_write_run(run, output) for run in made]
    truth = {"seed": seed, "rig": rig.name, "runs": {run.name: run.truth for run in made}}
    output.write_path("truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return [*names, "truth.json"]


def _write_run(run: SimulatedRun, output: OutputFolder) -> str:
    if run.table is not None:
        return _write_csv(run.name, run.table, output)
    assert run.recording is not None
    columns = _recorded_columns(run.recording)
    if run.name not in CSV_RUNS:
        name = f"{run.name}.parquet"
        pq.write_table(pa.table({k: v.astype(np.float32) for k, v in columns.items()}), output.write_path(name), compression="zstd")
        return name
    time = np.arange(run.recording.n_sample) / run.recording.sample_rate
    return _write_csv(run.name, {"t [s]": time, **columns}, output)


def _recorded_columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """The channels as the logger records them: "force [N]", "x [um]", "y [V]"."""
    columns = {}
    for number, channel in enumerate(recording.channels):
        unit, per_si = RECORDED[channel.name]
        title = "force" if channel.name == "f" else channel.name
        columns[f"{title} [{unit}]"] = recording.samples[:, number] * per_si
    return columns


def _write_csv(name: str, columns: dict[str, NDArray[np.float64]], output: OutputFolder) -> str:
    """A text table with six significant digits, which is what a 16-bit logger holds and more."""
    path = output.write_path(f"{name}.csv")
    rounded = {title: np.array([float(f"{value:.6g}") for value in values]) for title, values in columns.items()}
    pc.write_csv(pa.table(rounded), path, pc.WriteOptions(quoting_style="none"))
    return path.name
