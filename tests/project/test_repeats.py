"""Recordings of one test as a pipeline meets them: repeats without a new key, pooled where a test says so."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

import labpipe
from labpipe.cli.main import run_command
from labpipe.errors import ConfigError, LabpipeError
from labpipe.project.pipeline_file import load_pipeline
from labpipe.records.identification import Fit

RATE, PERIOD, PERIODS = 500, 1000, 6
RIG = """
name: r
sample_rate: 500 Hz
channels:
  f: {quantity: force, unit: N, role: input, dof: x}
  y: {quantity: displacement, unit: m, role: output, dof: x}
"""
PIPELINE = """
rig: rig.yaml
tests: [{name: t, recordings: "r*.csv"KEYS}]
frf: {excitation: periodic, period: 2 s, skip: 2}
identify: {peak: {model: sdof, band: 30-50 HzFIT}}
"""
F_N, ZETA = 40.0, 0.02


@functools.cache
def record(f_n: float, seed: int) -> str:
    """A mode of 1 kg under a periodic force, by the exact response of its lines, with noise of 1 %."""
    rng = np.random.default_rng(seed)
    force = np.fft.irfft(np.exp(2j * np.pi * rng.random(PERIOD // 2 + 1)), PERIOD) * np.sqrt(PERIOD)
    w, w_n = 2 * np.pi * np.fft.rfftfreq(PERIOD, 1 / RATE), 2 * np.pi * f_n
    motion = np.fft.irfft(np.fft.rfft(force) / (w_n**2 - w**2 + 2j * ZETA * w_n * w), PERIOD)
    f, y = (np.tile(signal.detrend(part, type="constant"), PERIODS) for part in (force, motion))
    y = y + 0.01 * np.std(y) * rng.normal(size=y.size)
    return "f,y\n" + "".join(f"{force:.12g},{moved:.12g}\n" for force, moved in zip(f, y, strict=True))


# How far the frequency of each recording is off [Hz]; two days differ by more than runs of one day.
RUNS = {f"r{number}": moved for number, moved in enumerate((-0.02, 0.05, -0.04, 0.03, 0.0))}
DAYS = {
    f"r-{day}{run}": at + off
    for day, at in (("mon", -0.1), ("tue", 0.0), ("wed", 0.14))
    for run, off in enumerate((-0.01, 0.0, 0.01))
}


def identified(folder: Path, keys: str = "", fit: str = "", runs: Mapping[str, float] = RUNS) -> Fit:
    (folder / "rig.yaml").write_text(RIG)
    (folder / "p.yaml").write_text(PIPELINE.replace("KEYS", keys).replace("FIT", fit))
    for number, (name, moved) in enumerate(runs.items()):
        (folder / f"{name}.csv").write_text(record(F_N + moved, number))
    (fit,) = labpipe.run(folder / "p.yaml", folder / "out").fits
    return fit


def test_recordings_of_one_test_are_repeats(tmp_path: Path) -> None:
    """Frequencies are known: their mean is 40.004 Hz, their standard deviation 0.036 Hz."""
    f_n = identified(tmp_path).parameter("f_n")
    assert f_n.repeats is not None and f_n.repeats.n == f_n.repeats.used == 5
    assert f_n.value == pytest.approx(40.004, abs=0.005)
    assert f_n.repeats.spread == pytest.approx(0.036, rel=0.5)
    assert f_n.ci95[0] < F_N < f_n.ci95[1]


def test_a_test_may_pool_them(tmp_path: Path) -> None:
    fit = identified(tmp_path, ", repeats: pool")
    assert fit.parameter("f_n").repeats is None


@pytest.mark.long
def test_days_are_the_repeats_where_they_are_named(tmp_path: Path) -> None:
    """Three days of three runs: the interval is Student's of three means, 4.30 / sqrt(3) of their standard
    deviation .121 Hz. Nine runs in their order, without the days named, are seen to come in steps, and their
    interval is three times as wide and more.
    """
    (tmp_path / "days").mkdir()
    plain = identified(tmp_path, runs=DAYS).parameter("f_n")
    fit = identified(tmp_path / "days", fit=", repeat_groups: [r-mon*, r-tue*, r-wed*]", runs=DAYS)
    f_n = fit.parameter("f_n")
    assert f_n.repeats.used == 9 and f_n.repeats.groups == 3
    assert f_n.value == pytest.approx(F_N + 0.04 / 3, abs=0.004)
    width, forgetful = (p.ci95[1] - p.ci95[0] for p in (f_n, plain))
    assert width / 2 == pytest.approx(4.30 / np.sqrt(3) * 0.1206, rel=0.35) and forgetful > 3 * width
    assert any("in the groups r-mon*, r-tue*, r-wed*" in text for text in fit.notes)


@pytest.mark.parametrize(
    ("fit", "what"),
    [
        (", repeat_groups: [r-mon*, r-tue*]", "'r-wed0' matches none of them"),
        (", repeat_groups: [r-*, r-mon*]", r"'r-mon0' matches 'r-\*' and 'r-mon\*'"),
        (", repeat_groups: [r-*, other*]", r"all are of the group 'r-\*'"),
        (", repeat_groups: [r-*]", "one group does not show"),
        (", repeats: pool, repeat_groups: [r-mon*, r-tue*]", "needs every recording fitted alone"),
    ],
)
def test_groups_that_cannot_be_are_refused(tmp_path: Path, fit: str, what: str) -> None:
    days = [name for name in DAYS if name.endswith("0")]
    with pytest.raises(LabpipeError, match=what):
        identified(tmp_path, fit=fit, runs=dict.fromkeys(days, 0.0))


def test_another_word_is_refused_at_its_line(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "p.yaml").write_text(PIPELINE.replace("KEYS", ", repeats: some").replace("FIT", ""))
    (tmp_path / "r1.csv").write_text("f,y\n1,2\n")
    with pytest.raises(ConfigError, match=r"p\.yaml:3:.*unknown 'some'"):
        load_pipeline(tmp_path / "p.yaml")


def test_a_copy_of_a_recording_is_no_repeat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It would halve the variance of what it says, as twice the same file would; also stage by stage."""
    identified(tmp_path, runs=dict(list(RUNS.items())[:2]))
    (tmp_path / "r0 (copy).csv").write_bytes((tmp_path / "r0.csv").read_bytes())
    copied = "r0.csv: holds the same bytes as 'r0 (copy).csv'"
    with pytest.raises(LabpipeError, match=re.escape(copied)):
        labpipe.run(tmp_path / "p.yaml", tmp_path / "out")
    files = [str(tmp_path / f"r0{name}.csv") for name in ("", " (copy)")]
    staged = str(tmp_path / "staged")
    assert run_command(["ingest", *files, "--rig", str(tmp_path / "rig.yaml"), "-o", staged]) == 0
    stored = [str(path) for path in sorted((tmp_path / "staged").rglob("*.recording.parquet"))]
    assert run_command(["frf", *stored, "-c", str(tmp_path / "p.yaml"), "-o", staged]) == 2
    assert copied in capsys.readouterr().err
