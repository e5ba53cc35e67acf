"""Several decays as repeats: from the raw file to the mean, its interval and what is said."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labpipe.methods.ring_down.fit import DecaySettings
from tests.conftest import Command

RATE, LENGTH = 512.0, 2.0


def struck(
    frequencies: Sequence[float], ratios: Sequence[float], sizes: Sequence[float], seed: int = 1
) -> np.ndarray:
    """A recording of hits in closed form: after each y = A e^(-zeta w t) sin(w_d t), with white noise of a
    hundredth.
    """
    time = np.arange(round(LENGTH * RATE)) / RATE
    parts = [np.zeros(100)]
    for frequency, ratio, size in zip(frequencies, ratios, sizes, strict=True):
        omega = 2 * np.pi * frequency
        parts.append(size * np.exp(-ratio * omega * time) * np.sin(omega * np.sqrt(1 - ratio**2) * time))
    motion = 1e-4 * np.concatenate(parts)
    return motion + 1e-6 * np.random.default_rng(seed).normal(size=motion.size)


def run(folder: Path, labpipe: Command, motion: np.ndarray, more: str = "") -> dict[str, Any]:
    """The fit of a recording in a CSV file by a pipeline."""
    np.savetxt(folder / "run.csv", motion, header="y", comments="", fmt="%.9g")
    channel = "channels: {y: {quantity: displacement, unit: m, role: output, dof: y}}"
    (folder / "rig.yaml").write_text(f"name: mass\nsample_rate: {RATE:g} Hz\n{channel}\nmass: 2 kg\n")
    fit = f"ring: {{model: decay, modes: 1, mass: 2 kg{more}}}"
    path = folder / "p.yaml"
    rest = "frf: {excitation: decay}\nreport: {formats: [html]}\n"
    path.write_text(f"title: hits\nrig: rig.yaml\nrecordings: run.csv\nidentify:\n  {fit}\n{rest}")
    ended = labpipe("run", path, "-o", folder / "out")
    assert ended.code == 0, ended.err
    entry: dict[str, Any] = json.loads((folder / "out" / "identification.json").read_text())["fits"][0]
    return entry


def named(fit: dict[str, Any]) -> dict[str, Any]:
    return {parameter["name"]: parameter for parameter in fit["parameters"]}


def test_mountings_are_the_repeats_where_they_are_named(tmp_path: Path, labpipe: Command) -> None:
    """Two mountings 0.2 Hz apart, four decays each: the mean is that of the mountings, and two means tell an
    interval of more than their distance.
    """
    for number, (name, f_n) in enumerate((("one", 39.9), ("two", 40.1))):
        np.savetxt(
            tmp_path / f"{name}.csv",
            struck([f_n] * 4, [0.005] * 4, [1.0] * 4, number),
            header="y",
            comments="",
        )
    channel = "channels: {y: {quantity: displacement, unit: m, role: output, dof: y}}"
    (tmp_path / "rig.yaml").write_text(f"name: mass\nsample_rate: {RATE:g} Hz\n{channel}\n")
    fit = "ring: {model: decay, modes: 1, repeat_groups: [one, two]}"
    (tmp_path / "p.yaml").write_text(
        f"rig: rig.yaml\nrecordings: [one.csv, two.csv]\nidentify: {{{fit}}}\nfrf: {{excitation: decay}}\n"
        "report: {formats: []}\n"
    )
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (entry,) = json.loads((tmp_path / "out" / "identification.json").read_text())["fits"]
    f = named(entry)["f_n_1"]
    assert f["value"] == pytest.approx(np.sqrt(39.9 * 40.1), abs=0.01)
    assert (f["repeats"]["used"], f["repeats"]["groups"]) == (8, 2)
    assert 0.2 < f["ci95"][1] - f["ci95"][0] < 4
    assert any("in the groups one, two" in text for text in entry["notes"])


@pytest.mark.long
def test_twenty_one_decays_of_a_frequency_that_scatters(
    tmp_path: Path, labpipe: Command, rng: np.random.Generator
) -> None:
    """The mean of what each decay was made with; an interval of Student's size, not that of the noise.

    One fit of all has the interval of what its stretches scatter by, which is wider.
    """
    frequencies, ratios = 40 * np.exp(0.002 * rng.normal(size=21)), 0.005 * np.exp(0.1 * rng.normal(size=21))
    motion = struck(frequencies, ratios, np.full(21, 1.0))
    fit = run(tmp_path, labpipe, motion)
    parameters = named(fit)
    f, zeta, k = parameters["f_n_1"], parameters["zeta_1"], parameters["k"]
    np.testing.assert_allclose(f["repeats"]["values"], frequencies, rtol=2e-4)
    assert (f["repeats"]["n"], f["repeats"]["used"], f["repeats"]["covariate"]) == (21, 21, "")
    assert f["value"] == pytest.approx(np.exp(np.mean(np.log(frequencies))), rel=2e-5)
    assert zeta["value"] == pytest.approx(np.exp(np.mean(np.log(ratios))), rel=0.01)
    expected = 2.09 * np.std(frequencies, ddof=1) / np.sqrt(21)
    assert (f["ci95"][1] - f["ci95"][0]) / 2 == pytest.approx(expected, rel=0.15)
    assert f["ci95"][0] < 40 < f["ci95"][1] and zeta["ci95"][0] < 0.005 < zeta["ci95"][1]
    assert f["repeats"]["spread"] == pytest.approx(np.std(frequencies, ddof=1), rel=0.2)
    assert f["std_error"] < 0.1 * expected
    assert f["interval"]["discrepancy"] == f["interval"]["systematic"] == 0
    assert np.hypot(f["interval"]["noise"], f["interval"]["repeats"]) == pytest.approx(
        f["std_error_inflated"]
    )
    # k = m (2 pi f)^2: twice the relative interval.
    assert k["value"] == pytest.approx(2 * (2 * np.pi * f["value"]) ** 2, rel=1e-9)
    assert np.log(k["ci95"][1] / k["value"]) == pytest.approx(2 * np.log(f["ci95"][1] / f["value"]), rel=1e-6)
    assert any("means over 21 decays" in note for note in fit["notes"])
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert (
        "21 repeats whose means the values are. Line and shade" in page
        and ("hold the scatter between repeats") in page
    )
    assert "The residual is not noise" not in page
    (tmp_path / "pool").mkdir()
    pooled = named(run(tmp_path / "pool", labpipe, motion, ", repeats: pool"))
    lower, upper = pooled["f_n_1"]["ci95"]
    assert pooled["f_n_1"]["repeats"] is None and lower < 40 < upper and upper - lower > 2 * expected


@pytest.mark.parametrize(("at", "top"), [(5, 40.1), pytest.param(8, 41.1, marks=pytest.mark.long)])
def test_a_decay_that_stands_out_is_named(
    at: int, top: float, tmp_path: Path, labpipe: Command, rng: np.random.Generator
) -> None:
    """The last one may as well be of another state, which the interval holds."""
    frequencies = 40 * np.exp(2e-4 * rng.normal(size=9))
    frequencies[at] = 41.0
    fit = run(tmp_path, labpipe, struck(frequencies, np.full(9, 0.005), np.ones(9)))
    f = named(fit)["f_n_1"]
    assert (f["repeats"]["n"], f["repeats"]["used"]) == (9, 8) and f["ci95"][0] < 40 < f["value"] + 0.1
    assert top - 0.1 < f["ci95"][1] < top and f["value"] < 40.1
    left_out = [remark["message"] for remark in fit["remarks"] if remark["code"] == "repeat-left-out"]
    assert len(left_out) == 1 and left_out[0].startswith(f"decay {at + 1} ('run'") and "41" in left_out[0]
    assert any("means over 8 of 9 decays" in note for note in fit["notes"])


def test_a_frequency_that_follows_the_amplitude_is_stated_at_one(
    tmp_path: Path, labpipe: Command, rng: np.random.Generator
) -> None:
    """f = 40 (1 - .004 (a - .65)): at the middle amplitude of the decays, with less than their scatter."""
    sizes = rng.permutation(np.linspace(0.3, 1.0, 12))
    frequencies = 40 * (1 - 0.004 * (sizes - 0.65)) * np.exp(1e-4 * rng.normal(size=12))
    f = named(run(tmp_path, labpipe, struck(frequencies, np.full(12, 0.005), sizes)))["f_n_1"]
    assert f["repeats"]["covariate"] == "amplitude"
    at = f["repeats"]["at"] / 1e-4
    assert at == pytest.approx(np.median(sizes), rel=0.05)
    assert f["ci95"][0] < 40 * (1 - 0.004 * (at - 0.65)) < f["ci95"][1]
    assert f["ci95"][1] - f["ci95"][0] < 0.5 * np.ptp(frequencies) / np.sqrt(12)


def test_repeats_are_one_of_two_words(tmp_path: Path, labpipe: Command) -> None:
    with pytest.raises(AssertionError, match="some"):
        run(tmp_path, labpipe, struck([40.0, 40.0], [0.005, 0.005], [1.0, 1.0]), ", repeats: some")
    assert DecaySettings().repeats == "each"
