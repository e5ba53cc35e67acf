"""simulate: a virtual rig -> recorded files as a logger would write them, and truth.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError
from labpipe.formats.frf_csv import write_frf_csv
from labpipe.formats.run_up_csv import write_run_up_csv
from labpipe.records.recording import Recording
from labpipe.simulate import ball_bearing_rig, journal_rig, mdof_rig, unbalance_rig, white_noise_rig
from labpipe.simulate.ball_bearing_rig import VirtualBallBearingRig
from labpipe.simulate.journal_rig import VirtualJournalRig
from labpipe.simulate.loop_runs import LOOP_RUNS
from labpipe.simulate.magnetic_rig import SimulatedRun, simulate
from labpipe.simulate.mdof_rig import VirtualMdofRig
from labpipe.simulate.settings import VirtualRig
from labpipe.simulate.unbalance_rig import VirtualUnbalanceRig
from labpipe.simulate.white_noise_rig import WhiteNoiseRig

# What the virtual logger writes for a channel: (recorded unit, recorded value per SI value). y comes as the probe's voltage.
RECORDED = {"f": ("N", 1.0), "x": ("um", 1e6), "y": ("V", 8e3), "z": ("um", 1e6)}
CSV_RUNS = ("pedestal", "axial")
# Runs under the control loop are stored as whole numbers: quantity -> (recorded unit, recorded value per SI value).
WHOLE = {"force": ("mN", 1e3), "displacement": ("nm", 1e9), "current": ("mA", 1e3), "tacho": ("V", 1.0)}
FINE_VOLTAGE, COARSE_VOLTAGE = ("uV", 1e6), ("mV", 1e3)


def simulate_files(rig: Any, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """Write the files of a virtual rig and truth.json; their names."""
    return SIMULATED[rig.kind](rig, seed, runs, output)


def _magnetic(rig: VirtualRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    made = simulate(rig, seed, runs)
    names = [_write_run(run, output) for run in made]
    return [*names, _write_truth({"seed": seed, "rig": rig.name, "runs": {run.name: run.truth for run in made}}, output)]


def _mdof(rig: VirtualMdofRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """One FRF table: this rig has no recordings."""
    if runs is not None:
        raise ConfigError("this rig has no runs, it is one FRF", hint="leave --run out")
    write_frf_csv(output.write_path("frf.csv"), mdof_rig.simulated_response(rig, np.random.default_rng(seed)))
    return ["frf.csv", _write_truth({"seed": seed, "rig": rig.name, "truth": mdof_rig.truth(rig)}, output)]


def _white_noise(rig: WhiteNoiseRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """One file per force direction."""
    names = _write_noise(white_noise_rig.white_noise_runs(rig, seed, runs), "xy", output)
    return [*names, _write_truth({"seed": seed, "rig": rig.name, "truth": white_noise_rig.truth(rig)}, output)]


def _journal(rig: VirtualJournalRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """One file per state and force direction."""
    names = _write_noise(journal_rig.journal_runs(rig, seed, runs), "yz", output)
    return [*names, _write_truth({"seed": seed, "rig": rig.name, "truth": journal_rig.truth(rig)}, output)]


def _write_noise(runs: Iterable[Recording], directions: str, output: OutputFolder) -> list[str]:
    """Parquet files of force and two displacements in um; the bytes of noise pack best one position after the other."""
    titles = ("force [N]", *(f"{direction} [um]" for direction in directions))
    names = []
    for run in runs:
        columns = dict(zip(titles, (run.samples * [1.0, 1e6, 1e6]).T.astype(np.float32), strict=True))
        names.append(f"{run.name}.parquet")
        path = output.write_path(names[-1])
        pq.write_table(pa.table(columns), path, compression="zstd", use_dictionary=False, use_byte_stream_split=True)
    return names


def _ball_bearing(rig: VirtualBallBearingRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """Shaker tests as a 16-bit logger stores them: force in cN, accelerometers in mV at 10 mV per m/s^2; calibrations as CSV."""
    made = ball_bearing_rig.simulate_ball_bearing(rig, seed, runs)
    names = []
    for run in made:
        if run.table is not None:
            names.append(_write_csv(run.name, run.table, output))
            continue
        assert run.recording is not None
        steps = np.rint(run.recording.samples * [100.0, *[10.0] * (len(run.recording.channels) - 1)])
        titles = ["force [cN]", *(f"{channel.name} [mV]" for channel in run.recording.channels[1:])]
        columns = {title: column.astype(np.int16) for title, column in zip(titles, steps.T, strict=True)}
        names.append(f"{run.name}.parquet")
        pq.write_table(pa.table(columns), output.write_path(names[-1]), compression="zstd", compression_level=19, use_dictionary=False)
    truth = {"seed": seed, "rig": rig.name, "runs": {run.name: run.truth for run in made}}
    return [*names, _write_truth(truth, output)]


def _run_ups(rig: VirtualUnbalanceRig, seed: int, runs: Iterable[str] | None, output: OutputFolder) -> list[str]:
    """One table of 1x amplitudes and phases over speed per run."""
    names = []
    for run in unbalance_rig.run_ups(rig, seed, runs):
        names.append(f"{run.name}.csv")
        write_run_up_csv(output.write_path(names[-1]), run)
    return [*names, _write_truth({"seed": seed, "rig": rig.name, "truth": unbalance_rig.truth(rig)}, output)]


def _write_truth(truth: dict[str, Any], output: OutputFolder) -> str:
    output.write_path("truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return "truth.json"


SIMULATED: dict[str, Callable[[Any, int, Iterable[str] | None, OutputFolder], list[str]]] = {
    "virtual-magnetic-rig": _magnetic,
    mdof_rig.KIND: _mdof,
    white_noise_rig.KIND: _white_noise,
    ball_bearing_rig.KIND: _ball_bearing,
    journal_rig.KIND: _journal,
    unbalance_rig.KIND: _run_ups,
}


def _write_run(run: SimulatedRun, output: OutputFolder) -> str:
    if run.table is not None:
        return _write_csv(run.name, run.table, output)
    assert run.recording is not None
    if run.name in LOOP_RUNS:
        return _write_whole(run.recording, output)
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


def _write_whole(recording: Recording, output: OutputFolder) -> str:
    """Columns such as "x [nm]", "ix [mA]", "ux [mV]" as whole numbers; injected voltages are small, so in uV."""
    columns = {}
    for number, channel in enumerate(recording.channels):
        voltage = FINE_VOLTAGE if channel.role != "reference" else COARSE_VOLTAGE
        unit, per_si = WHOLE.get(channel.quantity, voltage)
        columns[f"{channel.name} [{unit}]"] = np.rint(recording.samples[:, number] * per_si).astype(np.int32)
    path = output.write_path(f"{recording.name}.parquet")
    pq.write_table(pa.table(columns), path, compression="zstd", compression_level=19, use_dictionary=False, use_byte_stream_split=True)
    return path.name


def _write_csv(name: str, columns: dict[str, NDArray[np.float64]], output: OutputFolder) -> str:
    """A text table with six significant digits, which is what a 16-bit logger holds and more."""
    path = output.write_path(f"{name}.csv")
    rounded = {title: np.array([float(f"{value:.6g}") for value in values]) for title, values in columns.items()}
    pc.write_csv(pa.table(rounded), path, pc.WriteOptions(quoting_style="none"))
    return path.name
