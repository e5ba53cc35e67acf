"""labpipe live from raw samples: growing files, folders, frames, the same numbers as a run afterwards."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from asammdf import MDF, Signal
from nptdms import ChannelObject, RootObject, TdmsWriter
from scipy.io import wavfile

from labpipe.errors import DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live.bench import Bench
from labpipe.methods.live.charts import Goal
from labpipe.methods.live.session import Session, WholeFits
from labpipe.methods.live.sources import (
    Folder,
    GrowingHdf5,
    GrowingMdf,
    GrowingTdms,
    GrowingText,
    GrowingWav,
    open_source,
)
from labpipe.methods.live.view import Page, course
from labpipe.project.pipeline_file import load_for_stream
from labpipe.raw_files.table import open_table
from labpipe.records.recording import Channel, Recording
from labpipe.report.document import Document, Paragraph, Section
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ImpactSettings
from tests.conftest import Command, Ended
from tests.draws.stops import RATE as TURNS_RATE, RIGS, SOUND, TRUTH

RATE, N, SKIPPED = 1000.0, 1000, 1
STIFFNESS, DAMPING, MASS = 80e3, 6.0, 0.5
RIG = """name: Bench of another kind
sample_rate: 1 kHz
channels:
  f: {quantity: force, unit: N, role: input, dof: y}
  y: {quantity: displacement, unit: um, role: output, dof: y}
"""
PIPELINE = """rig: rig.yaml
frf: {excitation: periodic, period: 1 s, skip: 1, band: 20-150 Hz}
identify:
  s: {model: sdof, input: f, output: y, band: 40-90 Hz}
"""


def samples(n_period: int, seed: int = 4, noise: float = 1.0, stiffness: float = STIFFNESS) -> np.ndarray:
    """Periods of a multisine: force [N] and displacement [um], (n, 2)."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(N, 1 / RATE)
    lines = (frequency >= 20) & (frequency <= 150)
    spectrum = np.where(lines, np.exp(2j * np.pi * rng.random(frequency.size)), 0) * N / 20
    w = 2 * np.pi * frequency
    motion = np.fft.irfft(spectrum / (stiffness - w**2 * MASS + 1j * w * DAMPING), N) * 1e6
    clean = np.stack([np.fft.irfft(spectrum, N), motion], axis=1)
    return np.tile(clean, (n_period, 1)) + noise * rng.standard_normal((n_period * N, 2)) * [0.05, 0.5]


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A folder with rig and pipeline."""
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    return tmp_path


def write_csv(path: Path, rows: np.ndarray) -> None:
    path.write_text("f,y\n" + "".join(f"{f:.9g},{y:.9g}\n" for f, y in rows))


class Followed:
    """`labpipe live` on the pipeline of a folder: its JSON lines and exit code."""

    def __init__(self, folder: Path, command: Command) -> None:
        self.folder, self._command = folder, command

    def __call__(self, source: object, *options: str, code: int = 0) -> list[dict[str, Any]]:
        ended = self._command(
            "live", self.folder / "pipeline.yaml", source, "--json", "--idle", "0.3", *options
        )
        assert ended.code == code, ended.err
        return [json.loads(line) for line in ended.out.splitlines() if line.startswith("{")]


@pytest.fixture
def follow(bench: Path, labpipe: Command) -> Followed:
    """Follow a source with the bench's pipeline."""
    return Followed(bench, labpipe)


@pytest.fixture
def piped(bench: Path, labpipe: Command, monkeypatch: pytest.MonkeyPatch) -> Command:
    """The command with these bytes on its standard input."""

    def run(stdin: bytes, *options: str) -> Ended:
        (bench / "stdin").write_bytes(stdin)
        with (bench / "stdin").open(encoding="utf-8") as stream:
            monkeypatch.setattr("sys.stdin", stream)
            return labpipe("live", bench / "pipeline.yaml", "-", *options)

    return run


def test_a_file_followed_to_its_end_gives_the_numbers_of_a_run(bench, follow):
    write_csv(bench / "test.csv", samples(12))
    last = follow(bench / "test.csv", "-o", str(bench / "out"))[-1]
    assert last["averages"] == 11 and not last["stop"]
    result = json.loads((bench / "out" / "identification.json").read_text())
    by_run = {p["name"]: p for p in result["fits"][0]["parameters"]}
    for name, truth in (("k", STIFFNESS), ("c", DAMPING), ("m", MASS)):
        followed = last["parameters"][f"s.{name}"]
        low, high = followed["ci95"]
        assert low < truth < high
        # Both are weighted fits of the same averages; they smooth the noise over other widths.
        assert abs(followed["value"] - by_run[name]["value"]) < 0.3 * by_run[name]["std_error"]
    # The run follows the whole file once more, for the course in the report.
    (course,) = result["courses"]
    stiffness = next(c for c in course["coefficients"] if c["name"] == "s.k")
    assert stiffness["averages"][-1] == 11 and stiffness["value"][-1] == last["parameters"]["s.k"]["value"]
    assert "Course of the test" in (bench / "out" / "report.html").read_text()


def test_goals_of_the_pipeline_end_a_test_and_the_run_says_when(bench, follow, labpipe):
    write_csv(bench / "test.csv", samples(24, noise=2.5))
    goals = "live: {until: [s.c.expanded<=2%]}\nrecordings: [test.csv]\n"
    (bench / "pipeline.yaml").write_text(PIPELINE + goals)
    stopped = follow(bench / "test.csv")[-1]
    assert stopped["stop"] and 4 < stopped["averages"] < 20
    ran = labpipe("run", bench / "pipeline.yaml", "-o", bench / "out", "--set", "report.formats=[md]")
    assert f"were reached after {stopped['averages']} of 23 periods" in ran.out
    assert "Course of the test" in (bench / "out" / "report.md").read_text()
    (bench / "pipeline.yaml").write_text(PIPELINE + "live: {until: [s.c>=5]}\n")
    refused = labpipe("live", bench / "pipeline.yaml", bench / "test.csv")
    assert refused.code == 2 and "is not a rule on a width" in refused.err


@pytest.mark.parametrize("estimator", ["ml", "ls"])
def test_a_stated_uncertainty_is_in_the_interval_and_no_average_takes_it_away(bench, follow, estimator):
    """A gain of the force known to 0.5 % is one of k; 1.96 times it is the half-width, of a fit that is
    followed (ml) as of one that is made of all samples (ls).
    """
    fit = PIPELINE.replace("40-90 Hz}", f"40-90 Hz, estimator: {estimator}}}")
    (bench / "pipeline.yaml").write_text(fit)
    (bench / "rig.yaml").write_text(RIG.replace("role: input", "role: input, uncertainty: {gain: 0.5 %}"))
    write_csv(bench / "test.csv", samples(16))
    last = follow(bench / "test.csv", "--until", "s.k.expanded<=0.5%", code=1)[-1]
    k = last["parameters"]["s.k"]
    half = (k["ci95"][1] - k["ci95"][0]) / 2
    assert half == pytest.approx(1.96 * 0.005 * k["value"], rel=0.05) and k["std_error"] < 0.001 * k["value"]
    assert any(f["code"] == "floor" and "floor 0.98 %" in f["message"] for f in last["findings"])
    assert last["remaining"]["s.k"]["averages"] is None


def test_two_directions_one_after_the_other(bench, follow):
    """Two files fall into a folder, shaken in x and in y; both together hold the matrices."""
    k, c = np.array([[90e3, 8e3], [-5e3, 60e3]]), np.array([[8.0, 1.0], [0.5, 6.0]])
    (bench / "rig.yaml").write_text(
        RIG.split("channels")[0]
        + "channels:\n"
        + "".join(f"  f{d}: {{quantity: force, unit: N, role: input, dof: {d}}}\n" for d in "xy")
        + "".join(f"  {d}: {{quantity: displacement, unit: um, role: output, dof: {d}}}\n" for d in "xy")
    )
    fit = "  r: {model: rotor-2dof, mass: 0.5 kg, band: 30-110 Hz}\n"
    (bench / "pipeline.yaml").write_text(PIPELINE.split("  s:")[0] + fit)
    rng, folder = np.random.default_rng(12), bench / "falling"
    folder.mkdir()
    for direction, name in enumerate("xy"):
        frequency = np.fft.rfftfreq(N, 1 / RATE)
        lines = (frequency >= 20) & (frequency <= 150)
        force = np.zeros((frequency.size, 2), complex)
        force[lines, direction] = np.exp(2j * np.pi * rng.random(lines.sum())) * N / 20
        w = 2 * np.pi * frequency[:, None, None]
        motion = np.linalg.solve(k + 1j * w * c - w**2 * MASS * np.eye(2), force[..., None])[..., 0]
        clean = np.fft.irfft(np.concatenate([force, motion * 1e6], axis=1), N, axis=0)
        rows = np.tile(clean, (9, 1))
        rows += rng.standard_normal(rows.shape) * [0.05, 0.05, 0.5, 0.5]
        header = "fx,fy,x,y\n"
        text = header + "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in rows)
        (folder / f"{name}.csv").write_text(text)
    time.sleep(1.1)
    followed = follow(folder)
    last, first = followed[-1], followed[7]
    assert last["averages"] == 16
    # By the first direction alone c_yy is known through the coupling only.
    one, both = (np.ptp(update["parameters"]["r.c_yy"]["ci95"]) for update in (first, last))
    assert both < one / 3
    truth = {
        f"{letter}_{a}{b}": m[i, j]
        for letter, m in (("k", k), ("c", c))
        for i, a in enumerate("xy")
        for j, b in enumerate("xy")
    }
    within = [
        abs(last["parameters"][f"r.{name}"]["value"] - value)
        / ((last["parameters"][f"r.{name}"]["ci95"][1] - last["parameters"][f"r.{name}"]["ci95"][0]) / 2)
        for name, value in truth.items()
    ]
    # Of eight intervals of 95 % one may miss, but not by far.
    assert max(within) < 1.6 and sum(share > 1 for share in within) <= 1


def test_forces_on_lines_of_their_own_are_named_as_in_a_run():
    """Odd lines by one shaker, even ones by the other: the fault was that no force exceeds its noise."""
    rng, lines = np.random.default_rng(3), np.arange(N // 2 + 1)
    spectra = [np.where((lines % 2 == odd) & (lines > 20) & (lines < 150), N / 20, 0.0) for odd in (0, 1)]
    forces = [np.fft.irfft(s * np.exp(6.28j * rng.random(s.size)), N) for s in spectra]
    moved = [np.fft.irfft(np.fft.rfft(f) / (STIFFNESS - lines**2.0), N) for f in forces]
    periods = np.tile(np.stack([*forces, *moved], axis=1), (5, 1))
    channels = tuple(
        Channel(name, "force" if name[0] == "f" else "displacement", role, name[1])
        for name, role in (("fx", "input"), ("fy", "input"), ("dx", "output"), ("dy", "output"))
    )
    record = Recording(
        channels, periods + rng.standard_normal(periods.shape) * [0.02, 0.02, 1e-8, 1e-8], RATE, "zipper"
    )
    frf = FrfSettings("periodic", period=1.0, skip=1, band=(20, 150))
    with pytest.raises(DataError) as of_run:
        measure([record], frf)
    with pytest.raises(DataError, match="no line is excited by all forces independently") as of_live:
        Bench(channels, RATE, frf, [FitSettings("rotor-2dof", mass=0.5, name="r")]).add(record.samples)
    assert str(of_live.value) == str(of_run.value)


def test_directions_that_are_shaken_by_turns():
    """Period by period in x and y: of five averages two are of one direction, and none of them is judged by
    what one alone would tell.
    """
    rig = RIGS["rotor"]
    bench = Bench(rig.channels, TURNS_RATE, rig.settings, [rig.fit], [Goal.of("r.c_xx.expanded<=5%")])
    for samples_of_one in rig.samples(np.random.default_rng(3), 0.05, SOUND):
        (update,) = bench.add(samples_of_one)
        if update.stop:
            break
    assert not any("left out" in event for earlier in bench.updates for event in earlier.events)
    planned = update.standings["r.c_xx"].parameter
    assert planned.ci95[0] < rig.truth < planned.ci95[1] and update.averages >= 6
    # Ended by hand it is wider, 3.03 standard errors of many degrees of freedom (Wang and Ramdas 2023).
    low, high = bench.manual_intervals()["r.c_xx"]
    assert (low + high) / 2 == pytest.approx(planned.value) and high - low > 6.06 * planned.std_error


def test_a_block_that_ends_before_the_response_makes_a_floor():
    """e^(-zeta w T) = 0.2 % of the motion is left after 2.5 s of 65 Hz and 0.6 %: the transform of one pole
    is 1 - e^(sT) times its own, at any phase of e^(sT), so that c may be wrong by as much.
    """
    rng, rate, n = np.random.default_rng(2), 500.0, 3000
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
    pulse = np.exp(-((w * 0.004) ** 2) / 2 - 0.3j * w)
    mass, damping = 2e7 / (2 * np.pi * 65) ** 2, 2 * 0.006 * 2e7 / (2 * np.pi * 65)
    hit = np.fft.irfft([pulse, pulse / (2e7 + 1j * w * damping - w**2 * mass)], n, axis=1).T
    settings = FrfSettings("impact", band=(50, 80), block=2.5, impact=ImpactSettings(trigger=0.2))
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    fit = FitSettings("sdof", band=(60, 70), name="s")
    test = Bench(channels, rate, settings, [fit], [Goal.of("s.c.expanded<=0.1%")])
    noise = 0.01 * np.abs(hit).max(axis=0) * (0, 1)
    *_, last = [u for _ in range(3) for u in test.add(hit + noise * rng.standard_normal((n, 2)))]
    left = np.exp(-0.006 * 2 * np.pi * 65 * 2.5 * (1 - settings.impact.pretrigger))
    assert last.standings["s.c"].floor == pytest.approx(1.96 / np.sqrt(2) * left * damping, rel=0.1)
    assert "rings on" in next(f.message for f in last.findings if f.code == "floor")


@pytest.mark.long
def test_intervals_of_a_test_ended_by_hand_hold_whenever_it_ends():
    """40 tests of 15 averages, ended where they look worst: by the intervals for it the true stiffness or
    damping is left in no more than 5 % (6 tests, the binomial quantile at 0.1 %), by those of a test of known
    length in more of them.
    """
    rig, by_hand, as_planned = RIGS["periods"], 0, 0
    for seed in range(40):
        bench = Bench(rig.channels, TURNS_RATE, rig.settings, [rig.fit])
        assert bench.manual_intervals() == {}
        left = np.zeros(2, bool)
        for one in islice(rig.samples(np.random.default_rng([7, seed]), 0.05, SOUND), 15):
            (update,) = bench.add(one)
            for name, (low, high) in bench.manual_intervals().items():
                true, planned = TRUTH[name.removeprefix("s.")], update.standings[name].parameter
                assert (low + high) / 2 == pytest.approx(planned.value, rel=1e-9)
                assert high - low > planned.ci95[1] - planned.ci95[0]
                outside = not low <= true <= high, not planned.ci95[0] <= true <= planned.ci95[1]
                left |= outside
        by_hand, as_planned = by_hand + left[0], as_planned + left[1]
    assert by_hand <= 6 < as_planned


@pytest.mark.parametrize("seed", [1, 2])
def test_what_another_direction_would_save_is_what_it_saves(seed):
    """A rotor shaken ten times in x, whose damping in y is wanted: the periods in y that are forecast are
    those that then reach the goal, and fewer than would be needed in x.
    """
    rig = RIGS["rotor"]
    bench = Bench(rig.channels, TURNS_RATE, rig.settings, [rig.fit], [Goal.of("r.c_yy.expanded<=9%")])

    def periods(axis, seed):
        drawn = rig.samples(np.random.default_rng(seed), 0.4, SOUND)
        return (one for number, one in enumerate(drawn) if number % 2 == axis)

    (*_, last) = (
        update for _, one in zip(range(10), periods(0, seed), strict=False) for update in bench.add(one)
    )
    forecast = last.standings["r.c_yy"].remaining
    assert forecast.others.forces == ("fy",) and forecast.others.more < forecast.expected - 10
    assert last.as_json()["remaining"]["r.c_yy"]["by_turns"] == forecast.others.more
    more = next(n for n, one in enumerate(periods(1, seed + 9), 1) if bench.add(one)[-1].stop)
    assert more == pytest.approx(forecast.others.more, rel=0.2)


UNREPORTED = ("--set", "report.formats=[]")
CUTS = [8 * N + 400, 15 * N + 910, 23 * N + 700]


def test_recordings_begin_anywhere_in_the_period(bench, follow):
    """A stream of 24 periods cut within periods, as by kills or by a logger, its last piece shorter than an
    average takes: every whole period but the skipped ones counts, and the run leaves out that piece alone.
    """
    (bench / "pipeline.yaml").write_text(PIPELINE.replace("40-90 Hz}", "40-90 Hz, repeats: pool}"))
    folder = bench / "falling"
    folder.mkdir()
    for number, piece in enumerate(np.split(samples(24), CUTS)):
        write_csv(folder / f"{number}.csv", piece)
    time.sleep(1.1)
    lines = follow(folder, "-o", str(bench / "out"), "--set", "report.formats=[md]")
    assert lines[-1]["averages"] == 7 + 6 + 6 and not lines[-1]["findings"]
    assert not any("left out" in event for line in lines for event in line["events"])
    (fit,) = json.loads((bench / "out" / "identification.json").read_text())["fits"]
    for parameter in fit["parameters"][:3]:
        followed = lines[-1]["parameters"][f"s.{parameter['name']}"]
        # The run divides by the noisy forces of three recordings: H is low by their share of noise, a fifth
        # of a standard error, beside what both smooth otherwise.
        assert abs(followed["value"] - parameter["value"]) < 0.5 * parameter["std_error"]
        assert followed["std_error"] == pytest.approx(parameter["std_error"], rel=0.1)
    report = (bench / "out" / "report.md").read_text()
    assert "recording '3' is left out: it is shorter than one average takes (2 s)" in report


@pytest.mark.parametrize("seed", [0, 6])
def test_periods_of_recordings_count_as_if_their_phase_were_known(seed):
    """The same periods, each rolled to where its period begins, give the same values within a fiftieth of
    their standard errors.
    """
    pieces = np.split(samples(24, seed) * [1, 1e-6], CUTS)
    starts = [0, *CUTS]
    known = [
        np.roll(piece[n * N : (n + 1) * N], start % N, axis=0)
        for piece, start in zip(pieces, starts, strict=True)
        for n in range(SKIPPED, len(piece) // N)
    ]
    channels = tuple(
        Channel(name, quantity, role, "y")
        for name, quantity, role in (("f", "force", "input"), ("y", "displacement", "output"))
    )
    last = []
    for parts, skip in ((pieces, SKIPPED), ([np.concatenate(known)], 0)):
        frf = FrfSettings("periodic", period=1.0, skip=skip, band=(20, 150))
        bench = Bench(channels, RATE, frf, [FitSettings("sdof", band=(40, 90), name="s")])
        for part in parts:
            bench.restart()
            bench.add(part)
        last.append(bench.updates[-1].standings)
    for name, standing in last[1].items():
        error = standing.parameter.std_error
        assert abs(last[0][name].parameter.value - standing.parameter.value) < 0.02 * error
        assert last[0][name].parameter.std_error == pytest.approx(error, rel=0.02)


@pytest.mark.parametrize("excluded", [(), ("49-51 Hz",)])
def test_noise_of_a_hammer_is_taken_off_as_in_a_run(rng, excluded):
    """Noise of 1 % of the peak over 1.9 s is (1 - 1/6) n s^2 / |U|^2 of H, 1.3 %: live and run say the same H
    of the same samples, and it is the true one within 2.5 standard errors of the median line.
    """
    n, hits, rate = 4000, 6, 2000.0
    force, w = np.zeros(hits * n + 400), 2 * np.pi * np.fft.rfftfreq(4 * hits * n, 1 / rate)
    for hit in range(hits):
        force[100 + hit * n + hit :][:9] = 100 * np.sin(np.pi * np.arange(9) / 8)
    h = 1 / (4e5 + 300j * w - 10 * w**2)
    moved = np.fft.irfft(np.fft.rfft(force, 4 * hits * n) * h, 4 * hits * n)[: force.size]
    noise = np.array([1.0, 1e-4 * np.max(np.abs(moved))]) * rng.normal(size=(force.size, 2))
    channels = (Channel("f", "force", "input", "x"), Channel("y", "displacement", "output", "x"))
    record = Recording(channels, np.column_stack([force, moved]) + noise, rate, "hits")
    frf = FrfSettings("impact", block=1.9, band=(10, 60), exclude=excluded)
    bench = Bench(channels, rate, frf, [FitSettings("sdof", name="s", mass=10.0)])
    bench.add(record.samples)
    ran, live = measure([record], frf), bench.fits[0].response()
    np.testing.assert_allclose(live.matrix, ran.matrix, rtol=1e-9)
    share = round(1.9 * rate) * 1.0**2 / np.abs(np.fft.rfft(force[:n]))[20] ** 2
    error = np.sqrt(np.pi / 2 * share / (2 * hits * live.n_frequency))
    assert 2.5 * error < (1 - 1 / hits) * share
    exact = 1 / (4e5 + 300j * (w := 2 * np.pi * live.frequency) - 10 * w**2)
    assert np.median((live.matrix[:, 0, 0] / exact).real) == pytest.approx(1, abs=2.5 * error)
    said = [
        next(f for f in of if f.code == "force-noise").message
        for of in (bench.updates[-1].findings, ran.findings)
    ]
    assert all("taken off" in message for message in said)


def noisy_hits(seed: int, hits: int, n: int, rate: float) -> np.ndarray:
    """Force [N] and displacement [m] (n_sample, 2) of *hits* every *n* samples at *rate* [Hz] on 10 kg, 400
    kN/m and 300 N.s/m, with noise of 1 N and of .2 % of the largest displacement.
    """
    rng, force = np.random.default_rng(seed), np.zeros(hits * n + 400)
    w = 2 * np.pi * np.fft.rfftfreq(4 * hits * n, 1 / rate)
    for hit in range(hits):
        begin = 100 + hit * n + int(rng.integers(0, 50))
        force[begin : begin + 9] = 100 * rng.uniform(0.7, 1.3) * np.sin(np.pi * np.arange(9) / 8)
    spectrum = np.fft.rfft(force, 4 * hits * n) / (4e5 + 300j * w - 10 * w**2)
    moved = np.fft.irfft(spectrum, 4 * hits * n)[: force.size]
    noise = np.array([1.0, 2e-3 * np.max(np.abs(moved))]) * rng.normal(size=(force.size, 2))
    return np.column_stack([force, moved]) + noise


@pytest.mark.parametrize("highest", [60, pytest.param(300, marks=pytest.mark.long)])
def test_noise_of_a_hammer_within_its_window_is_counted_as_in_a_run(highest):
    """White noise of 1 % of the peak within a window of 30 ms is one error of neighbouring lines: k of 12
    records scatters by what is stated (5.6 times that, and every sixth hit left out, by lines alone), with
    the value and the error of a run of the same hits. In a band of more errors than a run tells as well.
    """
    n, hits, rate = 4400, 8, 2000.0
    channels = (Channel("f", "force", "input", "x"), Channel("y", "displacement", "output", "x"))
    frf = FrfSettings("impact", block=2.0, band=(10, highest), impact=ImpactSettings(force_window=0.03))
    settings, off, reduced = FitSettings("sdof", name="s", mass=10.0, repeats="pool"), [], []
    for seed in range(12):
        record = Recording(channels, noisy_hits(seed, hits, n, rate), rate, "hits")
        bench = Bench(channels, rate, frf, [settings])
        bench.add(record.samples)
        (ran,), last = identify(measure([record], frf), settings), bench.updates[-1]
        said = {finding.code: finding.message for finding in last.findings}
        assert bench.averages == hits and not {"bad-averages", "changes", "model-mismatch"} & said.keys()
        assert "intervals count that" in said["force-noise"]
        k, of_run = last.standings["s.k"].parameter, ran.parameter("k")
        if highest == 60:
            assert k.value == pytest.approx(of_run.value, abs=0.2 * of_run.full_error)
            assert k.std_error == pytest.approx(of_run.full_error, rel=0.1)
        off.append((k.value - 4e5) / k.std_error)
        reduced.append(bench.fits[0].now.reduced)
    # A standard deviation of 12 values errs by 21 %, the mean chi-square by 3 %.
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.mean(reduced) == pytest.approx(1.0, abs=0.1)


def test_noise_of_a_hammer_within_its_window_is_no_floor_of_whole_recordings():
    """Hits under an exponential window are followed by fits of all samples, whose budget holds the noise of
    the force in its window as an error of all lines. No number is stated: nothing is left of it by many hits.
    """
    n, hits, rate = 4400, 12, 2000.0
    channels = (Channel("f", "force", "input", "x"), Channel("y", "displacement", "output", "x"))
    settings = ImpactSettings(force_window=0.03, decay=0.3)
    frf = FrfSettings("impact", block=1.0, band=(10, 60), impact=settings)
    goals = [Goal.of("s.k.expanded<=0.5%")]
    fits = WholeFits(channels, rate, frf, [FitSettings("sdof", name="s", mass=10.0)], goals)
    try:
        fits.add(noisy_hits(4, hits, n, rate))
        (update,) = fits.look() or fits.updates[-1:]
    finally:
        fits.close()
    k = update.standings["s.k"]
    assert k.parameter.interval.systematic > 3 * k.parameter.interval.noise
    assert k.floor == pytest.approx(1.96 * k.parameter.interval.discrepancy, rel=1e-4)
    assert k.floor < 0.2 * k.half and not k.held_up


@pytest.mark.long
def test_it_stops_by_the_width_and_never_by_the_value(bench, follow, labpipe):
    write_csv(bench / "test.csv", samples(60, noise=2.5))
    lines = follow(bench / "test.csv", "--until", "s.c.expanded<=1.5%")
    assert lines[-1]["stop"] and not lines[-2]["stop"]
    c = lines[-1]["parameters"]["s.c"]
    assert (c["ci95"][1] - c["ci95"][0]) / 2 <= 0.015 * c["value"]
    halfway = lines[len(lines) // 2]
    left = lines[-1]["averages"] - halfway["averages"]
    assert halfway["remaining"]["s.c"]["low"] <= left <= halfway["remaining"]["s.c"]["high"]
    refused = labpipe("live", bench / "pipeline.yaml", "x.csv", "--until", "s.k>=70 kN/m")
    assert refused.code == 2 and "a test ends by the width" in refused.err


@pytest.mark.parametrize(
    ("rule", "word"),
    [
        ("s.q.expanded<=1%", "no coefficient 'q'"),
        ("t.k.expanded<=1%", "no fit 't'"),
        ("s.k.expanded<=1 mm", "wrong dimension"),
    ],
)
def test_a_rule_on_what_there_is_not_is_refused(bench, labpipe, rule, word):
    write_csv(bench / "test.csv", samples(6))
    refused = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", "--idle", "0.3", "--until", rule)
    assert refused.code == 2 and word in refused.err


def test_goals_are_on_intervals_of_95_per_cent(bench, labpipe):
    write_csv(bench / "test.csv", samples(6))
    asked = ("--set", "identify.s.coverage=99 %", "--idle", "0.3", "--until")
    refused = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", *asked, "k.expanded<=1%")
    assert refused.code == 2 and "identify.s: coverage 99 % is not followed" in refused.err
    ended = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", *asked, "k.std_error<=1%")
    assert ended.code == 0


def test_a_run_that_the_virtual_rig_does_not_have_is_refused(root, labpipe):
    simulated = ("--simulate", root / "configs/virtual-hmb.yaml", "--run", "pedestl")
    refused = labpipe("live", root / "pipelines/pedestal.yaml", *simulated)
    assert refused.code == 2 and "no run 'pedestl'; did you mean 'pedestal'?" in refused.err


@pytest.mark.parametrize(("option", "value"), [("--run", "pedestal"), ("--speed", "2"), ("--seed", "3")])
def test_options_of_a_virtual_rig_are_refused_without_one(bench, labpipe, option, value):
    refused = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", option, value)
    assert refused.code == 2 and f"{option}: is of a virtual rig" in refused.err


def test_a_test_that_ends_before_its_goal_fails(bench, follow):
    write_csv(bench / "test.csv", samples(6))
    follow(bench / "test.csv", "--until", "k.expanded<=1e-4%", code=1)


def test_frames_on_standard_input(piped):
    head = b'{"sample_rate": 1000, "channels": ["y", "spare", "f"], "dtype": "<f4"}\n'
    rows = samples(8)
    frames = np.stack([rows[:, 1], 0 * rows[:, 0], rows[:, 0]], axis=1).astype("<f4").tobytes()
    ran = piped(head + frames, "--json")
    assert ran.code == 0 and not ran.err
    last = json.loads(ran.out.splitlines()[-1])
    assert last["averages"] == 7
    low, high = last["parameters"]["s.k"]["ci95"]
    assert low < STIFFNESS < high


def test_frames_keep_the_rate_of_their_header(bench, piped):
    """Of a rig file without a rate the run at the end had none, and was refused."""
    rig = (bench / "rig.yaml").read_text()
    assert "sample_rate: 1 kHz\n" in rig
    (bench / "rig.yaml").write_text(rig.replace("sample_rate: 1 kHz\n", ""))
    head = b'{"sample_rate": 1000, "channels": ["y", "f"]}\n'
    ran = piped(head + samples(8)[:, ::-1].astype("<f8").tobytes(), "-o", str(bench / "out"))
    assert ran.code == 0 and not ran.err
    assert open_table(bench / "out" / "recording.parquet").sample_rate == 1000
    (fit,) = json.loads((bench / "out" / "identification.json").read_text())["fits"]
    assert fit["parameters"][0]["ci95"][0] < STIFFNESS < fit["parameters"][0]["ci95"][1]


def test_frames_of_a_channel_named_twice_are_refused(piped):
    """The first of the two was taken for it."""
    ran = piped(b'{"sample_rate": 1000, "channels": ["f", "y", "f"]}\n' + bytes(24))
    assert ran.code == 2 and "the header names a channel twice" in ran.err


@pytest.mark.long
def test_frames_without_a_header_are_refused(piped):
    ran = piped(b"1,2,3\n4,5,6\n")
    assert ran.code == 2 and "begins with no header" in ran.err


def test_a_bad_period_is_left_out_and_named_and_a_change_is_no_end(bench, follow):
    rows = samples(30)
    rows[9 * N : 10 * N, 1] += 40 * np.random.default_rng(1).standard_normal(N)
    write_csv(bench / "test.csv", rows)
    lines = follow(bench / "test.csv")
    left_out = [event for line in lines for event in line["events"] if "left out" in event]
    assert len(left_out) == 1 and "period 9" in left_out[0]
    moved = np.concatenate([samples(15), samples(30, stiffness=1.004 * STIFFNESS)])
    write_csv(bench / "moved.csv", moved)
    lines = follow(bench / "moved.csv", "--until", "s.c.expanded<=0.2%", code=1)
    assert {f["code"] for line in lines for f in line["findings"]} & {"changes", "bad-averages"}


def test_a_bad_first_period_is_left_out_before_the_stop(bench, follow):
    """The first period that counts has a gain that is wrong by 5 %; no other was there to hold it against."""
    rows = samples(40)
    rows[N : 2 * N, 1] *= 1.05
    write_csv(bench / "test.csv", rows)
    lines = follow(bench / "test.csv", "--until", "s.c.expanded<=0.6%")
    left_out = [event for line in lines for event in line["events"] if "left out" in event]
    assert left_out == ["period 1 is left out: it does not agree with the averages after it"]
    k, last = lines[-1]["parameters"]["s.k"], lines[-1]
    assert last["stop"] and k["ci95"][0] < STIFFNESS < k["ci95"][1]


def test_sources_that_grow_give_what_was_written(tmp_path):
    """Written piece by piece by another hand, with a line that is cut off in the middle."""
    rows = samples(1)[:300]
    text = GrowingText(tmp_path / "a.csv", ["f", "y"])
    assert text.read().shape == (0, 2)
    content = ("f,y\n" + "".join(f"{f:.17g},{y:.17g}\n" for f, y in rows)).encode()
    cuts = [0, 3, 40, 1111, 5000, len(content)]
    got = []
    for begin, end in pairwise(cuts):
        with (tmp_path / "a.csv").open("ab") as stream:
            stream.write(content[begin:end])
        got.append(text.read())
    np.testing.assert_array_equal(np.concatenate(got), rows)

    tdms = GrowingTdms(tmp_path / "a.tdms", ["f", "y"])
    got = [tdms.read()]
    for begin in range(0, 300, 100):
        with TdmsWriter(tmp_path / "a.tdms", "a" if begin else "w") as writer:
            part = rows[begin : begin + 100]
            properties = {"wf_increment": 1 / RATE}
            channels = [
                ChannelObject("g", name, part[:, n].copy(), properties) for n, name in enumerate("fy")
            ]
            writer.write_segment([RootObject(), *channels])
        got.append(tdms.read())
    np.testing.assert_array_equal(np.concatenate(got), rows)
    assert tdms.sample_rate == RATE

    hdf5 = GrowingHdf5(tmp_path / "a.h5", ["f", "y"])
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        sets = [file.create_dataset(name, (0,), maxshape=(None,), dtype="f8", chunks=(64,)) for name in "fy"]
        file.swmr_mode = True
        got = []
        for begin in range(0, 300, 100):
            for n, dataset in enumerate(sets):
                dataset.resize((begin + 100,))
                dataset[begin:] = rows[begin : begin + 100, n]
                dataset.flush()
            got.append(hdf5.read())
    np.testing.assert_array_equal(np.concatenate(got), rows)

    wavfile.write(tmp_path / "a.wav", int(RATE), (rows / 1000).astype(np.float32))
    whole = (tmp_path / "a.wav").read_bytes()
    wav, got = GrowingWav(tmp_path / "b.wav", ["1", "2"]), []
    for end in (500, 1700, len(whole)):
        (tmp_path / "b.wav").write_bytes(whole[:end])
        got.append(wav.read())
    np.testing.assert_allclose(np.concatenate(got), rows / 1000, rtol=1e-6)


def unfinished_mdf(path: Path, rows: np.ndarray) -> tuple[bytes, bytes]:
    """The beginning and the records (t, f, y) of an MDF file as a logger writes it: marked as unfinished, no
    samples counted and no length of its data stated, which stand at the end (ASAM MDF 4.1, unfinalised).
    """
    t = np.arange(len(rows)) / RATE
    with MDF(version="4.10") as file:
        file.append([Signal(rows[:, n].copy(), t, name=name) for n, name in enumerate("fy")])
        file.save(path, overwrite=True, compression=0)
    whole = bytearray(path.read_bytes())
    data, group, channels = (whole.index(name) for name in (b"##DT", b"##DG", b"##CG"))
    (length,) = struct.unpack_from("<Q", whole, data + 8)
    records = bytes(whole[data + 24 : data + length])
    whole += bytes(-len(whole) % 8)
    struct.pack_into("<Q", whole, group + 24 + 16, len(whole))
    struct.pack_into("<Q", whole, channels + 24 + 56, 0)
    whole[:8] = b"UnFinMF "
    struct.pack_into("<H", whole, 60, 0x1 | 0x4)
    return bytes(whole) + struct.pack("<4sIQQ", b"##DT", 0, 24, 0), records


def test_an_mdf_file_is_followed_before_it_is_finished(tmp_path):
    """Records of 24 bytes, the last cut off; then the logger begins the file anew."""
    rows, path = samples(1)[:300], tmp_path / "a.mf4"
    head, records = unfinished_mdf(path, rows)
    mdf, got = GrowingMdf(path, ["f", "y"]), []
    for n_byte in (0, 24, 24 * 100 + 7, 24 * 100 + 7, 24 * 300):
        path.write_bytes(head + records[:n_byte])
        got.append(mdf.read())
        assert not mdf.restarted
    assert [part.shape[0] for part in got] == [0, 0, 100, 0, 200]
    np.testing.assert_array_equal(np.concatenate(got), rows)
    path.write_bytes(head + records[: 24 * 50])
    np.testing.assert_array_equal(mdf.read(), rows[:50])
    assert mdf.restarted
    with pytest.raises(DataError, match="no column 'q'"):
        GrowingMdf(path, ["q"]).read()


# Another process: it writes rows (n, 2) piece by piece as a TDMS or HDF5 file, the bytes of an MDF file, or
# text whose last line is cut off in between.
WRITER = """
import sys, time
import numpy as np
kind, path = sys.argv[1:3]
rows = np.fromfile(sys.argv[3], np.uint8) if kind == "mf4" else np.load(sys.argv[3])
pieces = np.array_split(rows, 20)
if kind == "h5":
    import h5py
    file = h5py.File(path, "w", libver="latest")
    sets = [file.create_dataset(n, (0,), maxshape=(None,), dtype="f8", chunks=(512,)) for n in "fy"]
    file.swmr_mode = True
for number, piece in enumerate(pieces):
    if kind == "tdms":
        from nptdms import ChannelObject, RootObject, TdmsWriter
        with TdmsWriter(path, "a" if number else "w") as writer:
            inc = {"wf_increment": 1e-3}
            parts = [ChannelObject("g", n, piece[:, c].copy(), inc) for c, n in enumerate("fy")]
            writer.write_segment([RootObject(), *parts])
    elif kind == "h5":
        for c, dataset in enumerate(sets):
            begin = dataset.shape[0]
            dataset.resize((begin + len(piece),))
            dataset[begin:] = piece[:, c]
            dataset.flush()
    elif kind == "mf4":
        with open(path, "ab") as stream:
            stream.write(piece.tobytes())
    elif kind == "csv":
        text = ("" if number else "f,y\\n") + "".join(f"{f:.17g},{y:.17g}\\n" for f, y in piece)
        for part in (text[:-7], text[-7:]):
            with open(path, "a") as stream:
                stream.write(part)
            time.sleep(0.02)
    time.sleep(0.1)
"""


@pytest.mark.long
@pytest.mark.parametrize("kind", ["csv", "tdms", "h5", "mf4"])
def test_a_file_that_another_process_writes_meanwhile(bench, kind, follow):
    """Followed while it grows, and again once it is whole: the same last line."""
    np.save(bench / "rows.npy", samples(12))
    path = bench / f"test.{kind}"
    if kind == "mf4":
        (bench / "rows.npy").write_bytes(b"".join(unfinished_mdf(path, samples(12))))
        path.unlink()
    command = [sys.executable, "-m", "labpipe", "live", str(bench / "pipeline.yaml"), str(path), "--json"]
    command += ["--idle", "3"]
    with subprocess.Popen([sys.executable, "-c", WRITER, kind, str(path), str(bench / "rows.npy")]) as writer:
        growing = subprocess.run(command, capture_output=True, check=True).stdout
    assert writer.returncode == 0
    last = json.loads(growing.splitlines()[-1])
    assert last["averages"] == 11 and last == follow(path)[-1]
    low, high = last["parameters"]["s.k"]["ci95"]
    assert low < STIFFNESS < high


def test_a_logger_that_begins_its_file_anew_begins_another_record(tmp_path):
    rows = samples(1)[:100]
    write_csv(tmp_path / "a.csv", rows)
    text = GrowingText(tmp_path / "a.csv", ["f", "y"])
    assert text.read().shape[0] == 100 and not text.restarted
    write_csv(tmp_path / "a.csv", rows[:20])
    assert text.read().shape[0] == 20 and text.restarted


def test_a_folder_gives_whole_files_in_the_order_of_their_names(tmp_path):
    folder = Folder(tmp_path, ["f", "y"], settle=0.0)
    rows = samples(1)[:60]
    for number in range(2):
        part = rows[30 * number : 30 * number + 30]
        pq.write_table(pa.table({"f": part[:, 0], "y": part[:, 1]}), tmp_path / f"{number}.parquet")
    got, begun = [], []
    for _ in range(4):
        got.append(folder.read())
        begun.append(folder.restarted)
    np.testing.assert_array_equal(np.concatenate(got), rows)
    assert sum(begun) == 1 and [path.name for path in folder.files] == ["0.parquet", "1.parquet"]


def test_missing_samples_of_a_clock_begin_the_averages_anew(bench, follow):
    rig = RIG.replace("sample_rate: 1 kHz", 'time: "t [s]"')
    (bench / "rig.yaml").write_text(rig)
    rows = samples(12)
    t = np.arange(rows.shape[0]) / RATE
    kept = np.ones(t.size, bool)
    kept[5 * N + 100 : 5 * N + 350] = False
    text = "".join(f"{a:.4f},{f:.9g},{y:.9g}\n" for a, (f, y) in zip(t[kept], rows[kept], strict=True))
    (bench / "test.csv").write_text("t [s],f,y\n" + text)
    lines = follow(bench / "test.csv")
    gaps = [finding for finding in lines[-1]["findings"] if finding["code"] == "gap"]
    assert len(gaps) == 1 and "250 samples" in gaps[0]["message"]
    low, high = lines[-1]["parameters"]["s.k"]["ci95"]
    assert low < STIFFNESS < high


def test_a_goal_is_set_for_every_band(bench, follow):
    """A narrow band about the resonance tells the damping, one far above it does not: neither stands for
    both.
    """
    write_csv(bench / "test.csv", samples(12))
    bands = PIPELINE.replace("band: 40-90 Hz", "bands: [110-120 Hz, 40-90 Hz]")
    (bench / "pipeline.yaml").write_text(bands)
    last = follow(bench / "test.csv", "--until", "s.c.expanded<=5%", code=1)[-1]
    wide, narrow = (last["parameters"][f"s[{centre} Hz].c"]["ci95"] for centre in (115, 65))
    assert wide[1] - wide[0] > 0.1 * DAMPING > narrow[1] - narrow[0]
    assert not last["stop"]


def test_an_excitation_that_is_not_followed_is_looked_at_as_a_whole(bench, follow):
    rng = np.random.default_rng(8)
    force = rng.standard_normal(60 * N)
    w = 2 * np.pi * np.fft.rfftfreq(force.size, 1 / RATE)
    motion = np.fft.irfft(np.fft.rfft(force) / (STIFFNESS - w**2 * MASS + 1j * w * DAMPING), force.size) * 1e6
    write_csv(bench / "test.csv", np.stack([force, motion + 0.3 * rng.standard_normal(force.size)], axis=1))
    text = PIPELINE.replace("excitation: periodic, period: 1 s, skip: 1", "excitation: random, block: 2 s")
    (bench / "pipeline.yaml").write_text(text)
    lines = follow(bench / "test.csv", "--until", "s.k.expanded<=0.001%", code=1)
    assert lines[-1]["averages"] > 50
    low, high = lines[-1]["parameters"]["s.k"]["ci95"]
    assert low < STIFFNESS < high
    # Before the first average it says what it cannot do.
    assert lines[0]["averages"] == 0 and not lines[0]["parameters"]
    (said,) = [finding["message"] for finding in lines[0]["findings"] if finding["code"] == "not-followed"]
    assert "random data are known by all samples together" in said and "after 15 % more" in said


@pytest.mark.long
def test_decays_that_fall_into_a_folder_are_repeats(bench, follow):
    """A mode of 30 Hz, released twelve times; the file that is written meanwhile counts once it is whole."""
    f_n, zeta = 30.0, 0.01
    (bench / "rig.yaml").write_text(RIG.replace("  f: {quantity: force, unit: N, role: input, dof: y}\n", ""))
    ring = "  ring: {model: decay, modes: 1}\n"
    (bench / "pipeline.yaml").write_text(f"rig: rig.yaml\nfrf: {{excitation: decay}}\nidentify:\n{ring}")
    rng, folder, t = np.random.default_rng(6), bench / "falling", np.arange(3 * N) / RATE
    folder.mkdir()
    for number in range(12):
        w, phase = 2 * np.pi * f_n * np.sqrt(1 - zeta**2), rng.uniform(0, 6)
        y = 50 * np.exp(-zeta * 2 * np.pi * f_n * t) * np.cos(w * t + phase)
        y += 0.5 * rng.standard_normal(t.size)
        (folder / f"{number:02}.csv").write_text("y\n" + "".join(f"{value:.9g}\n" for value in y))
    time.sleep(1.1)
    lines = follow(folder, "--until", "zeta_1.expanded<=2%", "-o", str(bench / "out"), *UNREPORTED)
    assert lines[-1]["stop"] and 10 <= lines[-1]["averages"] <= 12
    assert [line["averages"] for line in lines[1:4]] == [1, 2, 3]
    low, high = lines[-1]["parameters"]["ring.zeta_1"]["ci95"]
    assert low < zeta < high and (high - low) / 2 <= 0.02 * zeta
    # The run at the end takes the same decays.
    fit = json.loads((bench / "out" / "identification.json").read_text())["fits"][0]
    by_run = {p["name"]: p["value"] for p in fit["parameters"]}
    assert by_run["zeta_1"] == pytest.approx(lines[-1]["parameters"]["ring.zeta_1"]["value"], rel=1e-6)


def write_hits(path: Path, n_hit: int, share: float = 0.0) -> None:
    """Hits of 2 s on six times the damping, with noise of both channels; on a *share* more of the stiffness
    every second time.
    """
    push = np.zeros(2 * N)
    push[100:104] = [20.0, 50.0, 50.0, 20.0]
    w = 2 * np.pi * np.fft.rfftfreq(push.size, 1 / RATE)
    hits = []
    for number in range(n_hit):
        flexible = 1 / (STIFFNESS * (1 + share * (number % 2)) - w**2 * MASS + 6j * w * DAMPING)
        hits.append(np.stack([push, np.fft.irfft(np.fft.rfft(push) * flexible, push.size) * 1e6], axis=1))
    rows = np.concatenate(hits)
    write_csv(path, rows + np.random.default_rng(2).standard_normal(rows.shape) * [0.02, 0.2])


def test_a_modal_fit_of_hits_and_a_goal_that_names_no_fit(bench, follow):
    """`zeta_1` is not a coefficient of the fit that is followed, so the goal waits for the modal one."""
    write_hits(bench / "test.csv", 11)
    fits = "  s: {model: sdof, input: f, output: y, band: 40-90 Hz}\n"
    fits += "  m: {model: modal, band: 50-80 Hz, repeats: pool}\n"
    frf = "frf: {excitation: impact, block: 2 s, band: 20-150 Hz}\n"
    (bench / "pipeline.yaml").write_text(f"rig: rig.yaml\n{frf}identify:\n{fits}")
    lines = follow(bench / "test.csv", "--until", "zeta_1.expanded<=1%")
    assert lines[-1]["stop"]
    # Where the ten averages of a fit of all samples are all that is missing, it is looked at with the tenth.
    assert lines[-1]["averages"] == 10
    zeta = 6 * DAMPING / (2 * np.sqrt(STIFFNESS * MASS))
    low, high = lines[-1]["parameters"]["m.zeta_1"]["ci95"]
    assert low < zeta < high
    (said,) = [f["message"] for f in lines[0]["findings"] if f["code"] == "not-followed"]
    assert said.startswith("m cannot be followed") and "after 15 % more" in said
    # A coefficient of the followed fit is waited for there alone.
    followed = follow(bench / "test.csv", "--until", "c.expanded<=1%")
    assert "s.c" in followed[-1]["parameters"] and "m.zeta_1" not in followed[-1]["parameters"]


@pytest.mark.parametrize(("key", "is_said"), [("", True), (", repeats: pool", False)])
def test_intervals_of_hits_say_that_a_run_adds_their_scatter(bench, labpipe, key, is_said):
    """A run that takes each hit for a repeat states the part between hits, one that pools them does not."""
    write_hits(bench / "test.csv", 7)
    fits = f"  s: {{model: sdof, input: f, output: y, band: 40-90 Hz{key}}}\n"
    frf = "frf: {excitation: impact, block: 2 s, band: 20-150 Hz}\n"
    (bench / "pipeline.yaml").write_text(f"rig: rig.yaml\n{frf}identify:\n{fits}")
    output = ["-o", bench / "out", *UNREPORTED]
    said = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", "--idle", "0.2", *output).out
    assert ("s: labpipe run takes each hit for a repeat" in said) is is_said
    (fit,) = json.loads((bench / "out" / "identification.json").read_text())["fits"]
    assert (fit["parameters"][0]["interval"]["repeats"] > 0) is is_said
    lines = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", "--idle", "0.2", "--json").out
    named = [json.loads(line)["without_scatter_of_hits"] for line in lines.splitlines()]
    assert named and all(fits == (["s"] if is_said else []) for fits in named)


def test_scatter_of_hits_that_noise_cannot_be_is_held(bench, follow):
    """Hits by turns on the stiffness of the rig and on 1 % more, in closed form: the mean of both is held;
    noise alone would not know it.
    """
    width = {}
    for share in (0.0, 0.01):
        write_hits(bench / "test.csv", 8, share)
        (bench / "pipeline.yaml").write_text(
            "rig: rig.yaml\nfrf: {excitation: impact, block: 2 s, band: 20-150 Hz}\n"
            "identify:\n  s: {model: sdof, input: f, output: y, band: 40-90 Hz}\n"
        )
        low, high = follow(bench / "test.csv")[-1]["parameters"]["s.k"]["ci95"]
        assert low < (1 + share / 2) * STIFFNESS < high
        width[share] = high - low
    # t_7 of a scatter of half a per cent over the root of eight.
    assert width[0.01] > 2 * 1.9 * 0.005 * STIFFNESS / np.sqrt(7) > 3 * width[0.0]


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ("damping: hysteretic", "`damping: hysteretic` is not linear"),
        ("estimator: ls", "`estimator: ml` alone"),
        ("bands: [40-65 Hz, 65-90 Hz]", "several bands"),
    ],
)
def test_a_fit_that_cannot_be_followed_ends_no_test(bench, follow, keys, reason):
    """It is made of all samples, and the recording is evaluated at the end."""
    write_csv(bench / "test.csv", samples(12))
    text = PIPELINE.replace("band: 40-90 Hz}", f"{'' if 'bands' in keys else 'band: 40-90 Hz, '}{keys}}}")
    (bench / "pipeline.yaml").write_text(text + "  m: {model: sdof, input: f, output: y, band: 40-90 Hz}\n")
    lines = follow(bench / "test.csv", "-o", str(bench / "out"), *UNREPORTED)
    (said,) = [f["message"] for f in lines[0]["findings"] if f["code"] == "not-followed"]
    assert said.startswith("s cannot be followed") and reason in said and "once the test has ended" in said
    assert "m.k" in lines[-1]["parameters"] and "s.k" not in lines[-1]["parameters"]
    fits = json.loads((bench / "out" / "identification.json").read_text())["fits"]
    assert {fit["name"] for fit in fits} == {"s", "m"}
    waited = follow(bench / "test.csv", "--until", "s.k.expanded<=0.0001%,m.k.expanded<=0.0001%", code=1)
    assert waited[-1]["parameters"].keys() >= {"s.k", "m.k"} or "bands" in keys


@pytest.mark.long
def test_a_full_disk_ends_neither_the_test_nor_what_was_kept(bench):
    """No file may become larger than 200 kB: of 12 s of 24 bytes 8.3 s are kept, and all averages are
    followed; the run at the end is of those that were kept.
    """
    head = b'{"sample_rate": 1000, "channels": ["f", "y", "spare"], "dtype": "<f8"}\n'
    rows = np.pad(samples(12), ((0, 0), (0, 1)))
    command = [sys.executable, "-m", "labpipe", "live", str(bench / "pipeline.yaml"), "-", "--json"]
    ran = subprocess.run(
        [*command, "-o", str(bench / "out"), "--set", "report.formats=[md]"],
        input=head + rows.astype("<f8").tobytes(),
        capture_output=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY)),
    )
    assert ran.returncode == 0 and not ran.stderr
    lines = [json.loads(line) for line in ran.stdout.splitlines()]
    (said,) = {f["message"] for line in lines for f in line["findings"] if f["code"] == "disk-full"}
    assert lines[-1]["averages"] == 11 and "file too large" in said
    kept = int(said.split()[-2])
    assert (
        pq.read_metadata(bench / "out" / "recording.parquet").num_rows == kept == (200_000 - len(head)) // 24
    )
    (course,) = json.loads((bench / "out" / "identification.json").read_text())["courses"]
    assert course["averages"] == kept // N - SKIPPED == 7


@pytest.mark.parametrize("rates", [[2 * RATE], [RATE, 2 * RATE]])
def test_samples_at_another_rate_are_no_part_of_the_test(bench, rates):
    """Frequencies would be half of what they are: by the rig file, or by the file before in a folder."""
    pieces = [(rate, samples(6)) for rate in rates]

    class Source:
        sample_rate, restarted = None, False

        def read(self) -> np.ndarray | None:
            self.sample_rate, rows = pieces.pop(0)
            return rows

    pipeline = load_for_stream(bench / "pipeline.yaml", ())
    rig = replace(pipeline.rig, sample_rate=None) if len(rates) > 1 else pipeline.rig
    with pytest.raises(DataError, match="samples come at 2000 Hz, 1000 Hz by the rig file or what"):
        list(Session(pipeline, rig, Source()).updates())


def test_samples_that_come_faster_than_they_are_followed(bench, monkeypatch):
    """Each second of samples takes three seconds to follow: the picture is late by 8 s in the
    end, and every sample is followed.
    """
    pieces, clock = np.split(samples(6), 6), [0.0]

    class Source:
        sample_rate, restarted = RATE, False

        def read(self) -> np.ndarray | None:
            clock[0] += 3.0
            return pieces.pop(0) if pieces else None

    monkeypatch.setattr("labpipe.methods.live.session.time", SimpleNamespace(monotonic=lambda: clock[0]))
    pipeline = load_for_stream(bench / "pipeline.yaml", ())
    updates = list(Session(pipeline, pipeline.rig, Source()).updates())
    said = [finding.message for finding in updates[2].findings if finding.code == "behind"]
    assert said == ["the picture is 8 s behind the samples; none is lost"]
    assert updates[-1].averages == 5


def test_the_page_shows_responses_with_their_bands_and_coherences(bench):
    """White noise of 0.5 um on lines of some 10 um: coherence by the closed form 1 / (1 + noise / motion)."""
    write_csv(bench / "test.csv", samples(20))
    pipeline = load_for_stream(bench / "pipeline.yaml", ())
    session = Session(pipeline, pipeline.rig, open_source(bench / "test.csv", ["f", "y"]), idle=0.2)
    *_, last = session.updates()
    _, response, fitted = (figure.graphic.panels for figure in course(session, last).sections[1].blocks)
    shown = response[1].series[0]
    w = 2 * np.pi * np.asarray(shown.x)
    h = 1 / (STIFFNESS + 1j * w * DAMPING - w**2 * MASS)
    # A line of a period of N samples with noise of the rms s has the complex variance 4 s^2 / N.
    noise = 4 * (0.5e-6**2 + np.abs(h) ** 2 * 0.05**2) / N
    force = 0.1
    np.testing.assert_allclose(shown.y, 1 / (1 + noise / np.abs(h * force) ** 2), atol=0.01)
    # Below its band, shown from zero on, lie 95 % of residuals.
    residual = fitted[2].series[0]
    assert 0.85 < np.mean(residual.y <= residual.high) < 1
    curve = fitted[0].series[1]
    at = STIFFNESS + 2j * np.pi * curve.x * DAMPING - (2 * np.pi * curve.x) ** 2 * MASS
    np.testing.assert_allclose(curve.y, 1e6 / np.abs(at), rtol=0.05)


@pytest.mark.long
def test_a_pause_and_a_logger_that_begins_anew(bench):
    """A logger writes eight periods, pauses, begins its file anew, pauses again and goes on: the averages of
    both files count, less one that is skipped of each.
    """
    rows = samples(16)
    write_csv(bench / "test.csv", rows[: 8 * N])
    command = [sys.executable, "-m", "labpipe", "live", str(bench / "pipeline.yaml"), str(bench / "test.csv")]
    with subprocess.Popen([*command, "--json", "--idle", "60"], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        first = [json.loads(child.stdout.readline()) for _ in range(7)]
        time.sleep(0.5)
        write_csv(bench / "new.csv", rows[8 * N : 10 * N])
        (bench / "new.csv").replace(bench / "test.csv")
        second = [json.loads(child.stdout.readline())]
        time.sleep(0.5)
        with (bench / "test.csv").open("a") as stream:
            stream.write("".join(f"{f:.9g},{y:.9g}\n" for f, y in rows[10 * N :]))
        second += [json.loads(child.stdout.readline()) for _ in range(6)]
        child.send_signal(signal.SIGINT)
    assert child.returncode == 0
    assert [line["averages"] for line in first] == list(range(1, 8))
    assert [line["averages"] for line in second] == list(range(8, 15))
    low, high = second[-1]["parameters"]["s.k"]["ci95"]
    assert low < STIFFNESS < high


def test_the_page_is_for_who_has_its_token_and_tells_what_is_new():
    import urllib.error
    import urllib.request

    page = Page()
    try:
        page.show(Document("Bench", "", (Section("State", (Paragraph("3 of 4 goals"),)),), to_sign=False))
        state = page.address.replace("/?", "/state?")
        with urllib.request.urlopen(state, timeout=5) as answer:
            assert b"3 of 4 goals" in answer.read()
        for address in (state.split("?")[0], state[:-3] + "xyz"):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(address, timeout=5)
        foreign = urllib.request.Request(state, headers={"Host": "example.org:80"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign, timeout=5)
        posted = urllib.request.Request(state, data=b"x=1", method="POST")
        with pytest.raises(urllib.error.HTTPError, match="501"):
            urllib.request.urlopen(posted, timeout=5)
        with urllib.request.urlopen(page.address.replace("/?", "/events?"), timeout=5) as news:
            threading.Timer(0.2, page.show, [Document("Bench", "", (), to_sign=False)]).start()
            assert news.readline() == b"data: new\n"
    finally:
        page.close()


@pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux")
def test_on_a_terminal_the_table_is_drawn_in_place(bench):
    """A terminal of 100 columns, read back as it stands."""
    write_csv(bench / "test.csv", samples(12))
    tmux = ["tmux", "-L", f"labpipe-{os.getpid()}"]
    command = f"{sys.executable} -m labpipe live pipeline.yaml test.csv --idle 0.3 --until s.c.expanded<=5%"
    shell = f"{command.replace('<', chr(92) + '<')}; echo ended $?; sleep 60"
    environment = {**os.environ, "LC_ALL": "C.UTF-8"}
    subprocess.run(
        [*tmux, "new-session", "-d", "-x", "100", "-y", "30", shell], check=True, cwd=bench, env=environment
    )
    try:
        shown = ""
        for _ in range(150):
            time.sleep(0.2)
            shown = subprocess.run(
                [*tmux, "capture-pane", "-p"], capture_output=True, text=True, check=True
            ).stdout
            if "ended" in shown:
                break
        assert "ended 0" in shown and shown.count("value and 95 % interval") == 1
        assert "Enough:" in shown and "s.c" in shown and "reached" in shown and "±" in shown
    finally:
        subprocess.run([*tmux, "kill-server"], check=False)


def killed_and_taken_up(folder: Path, rows: np.ndarray, n_read: int) -> tuple[list[bytes], list[bytes]]:
    """The lines of `labpipe live` on frames of which it is killed when it has kept *n_read*, at once for 0;
    those of the same command on the frames that it had not read.
    """
    head = b'{"sample_rate": 1000, "channels": ["f", "y"], "dtype": "<f8"}\n'
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "labpipe", "live", str(folder / "pipeline.yaml"), "-", "--json"]
    command += ["-o", str(out), "--set", "report.formats=[md]"]
    frames = out / "frames" / "0001.frames"
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None and child.stdout is not None
        # Lines that nobody reads would end in a full pipe.
        lines: list[bytes] = []
        reader = threading.Thread(target=lambda: lines.extend(child.stdout or ()))
        reader.start()
        if n_read:
            child.stdin.write(head)
            for piece in np.array_split(rows[:n_read], 50):
                child.stdin.write(piece.astype("<f8").tobytes())
            # Nothing waits to be written once the process is killed.
            child.stdin.flush()
            while not frames.exists() or frames.stat().st_size < len(head) + 16 * n_read:
                assert child.poll() is None
                time.sleep(0.01)
        child.kill()
        reader.join()
    rest = rows[n_read:].astype("<f8").tobytes()
    ran = subprocess.run(command, input=head + rest, capture_output=True, check=True)
    return lines, ran.stdout.splitlines(keepends=True)


@pytest.mark.long
def test_frames_that_were_read_outlast_a_kill(bench):
    """Nothing that was used is lost: the process that takes the test up gives the same lines again, goes on
    with the others as another recording, and all that came is in the recordings at the end.
    """
    rows = samples(40)
    for n_read in (24 * N + 300, len(rows)):
        before, lines = killed_and_taken_up(bench, rows, n_read)
        # The last line may have been cut off.
        assert lines[: max(len(before) - 1, 0)] == before[:-1]
        files = sorted((bench / "out").glob("recording*.parquet"))
        stored = np.concatenate([np.stack([c.to_numpy() for c in pq.read_table(f)], axis=1) for f in files])
        np.testing.assert_array_equal(stored, rows)
        parts = [n // N - SKIPPED for n in (n_read, len(rows) - n_read)]
        last = json.loads(lines[-1])
        assert last["averages"] == sum(max(part, 0) for part in parts) and not last["findings"]
        assert not (bench / "out" / "frames").exists()


@pytest.mark.parametrize(
    ("rows", "options", "what"),
    [
        (
            samples(5) * [1, 0],
            (),
            "identify.s: y is zero at every line of the band; is the sensor connected?",
        ),
        (samples(3), ("--set", "frf.skip=9"), "the source ended before it held enough samples"),
        (samples(2), ("--idle", "nan"), "'--idle': a number above zero is needed"),
        (samples(2), ("--speed", "inf"), "'--speed': a number above zero is needed"),
        (samples(5, noise=0.0), (), "identify.s: averages are equal to the last digit"),
        (samples(5), ("--until", "k.expanded<=-1%"), "--until: 'k.expanded<=-1%': no interval is so narrow"),
        (samples(5), ("--until", "k.expanded<=0 N/m"), "no interval is so narrow; a width above zero"),
    ],
    ids=["no motion", "no average", "no time", "no speed", "no noise", "negative goal", "zero goal"],
)
def test_what_no_average_can_tell_ends_with_a_message(bench, labpipe, rows, options, what):
    write_csv(bench / "test.csv", rows)
    ended = labpipe("live", bench / "pipeline.yaml", bench / "test.csv", "--idle", "0.1", *options)
    assert ended.code == 2 and what in ended.err
