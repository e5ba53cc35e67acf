"""What is not an injection, and what is too weak to be one: from raw files of a rig of its own with k_i =
120 N/A and k_s = -420 kN/m.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.methods.magnetic_bearing.recorded_axis import Axis, fit_pipeline, written

RANDOM = Axis(random=True, periods=40)
PERIODIC = Axis(lines=np.unique(np.round(np.geomspace(4, 400, 120))).astype(int))
SIDE_BY_SIDE = "{{excitation: {kind}, {length}: 500 ms, band: 6-800 Hz, result: spectra{more}}}"
FRF = "{{excitation: {kind}, {length}: 500 ms, band: 6-800 Hz, reference: e}}"
MAGNET, SDOF = "{model: magnet}", "{model: sdof, mass: 6.5 kg}"
# Current as force, by the true force per current.
FORCE = "{i: {quantity: force, sensitivity: 0.0083333333333333 A/N}}"


@pytest.fixture
def fitted(labpipe_without_report, tmp_path: Path):
    """How the command ended, and the fit as a dictionary; None where there is none."""

    def run(axis: Axis, columns: dict[str, np.ndarray], frf: str, fit: str, channels: str = "{}"):
        kind = (
            {"kind": "random", "length": "block"} if axis.random else {"kind": "periodic", "length": "period"}
        )
        written(tmp_path, axis, columns)
        file = fit_pipeline(tmp_path, frf.format(**kind, more=""), fit, channels)
        ended = labpipe_without_report("run", file, "-o", tmp_path / "out")
        result = tmp_path / "out/identification.json"
        return ended, json.loads(result.read_text())["fits"][0] if ended.code != 2 else None

    return run


def codes(fit: dict) -> list[str]:
    return [finding["code"] for finding in fit["warnings"]]


@pytest.mark.long
def test_a_command_beside_the_injection_is_no_drive(fitted) -> None:
    """Both have the role reference; which of them comes from outside only the user knows."""
    columns = RANDOM.record(np.random.default_rng(2))
    ended, _ = fitted(RANDOM, columns, SIDE_BY_SIDE, MAGNET)
    assert (
        ended.code == 2 and "name what is injected from outside" in ended.err and "reference: e" in ended.err
    )
    ended, fit = fitted(RANDOM, columns, SIDE_BY_SIDE.replace("spectra", "spectra, reference: e"), MAGNET)
    k_i = fit["parameters"][0]
    assert ended.code == 0 and k_i["ci95"][0] < 120 < k_i["ci95"][1]
    pushed = RANDOM.other(disturbance=10.0)
    ended, fit = fitted(
        pushed,
        pushed.record(np.random.default_rng(2)),
        SIDE_BY_SIDE.replace("spectra", "spectra, reference: u"),
        MAGNET,
    )
    assert ended.code == 1 and "feedback" in codes(fit)


@pytest.mark.parametrize(
    ("axis", "rms", "frf", "fit", "channels"),
    [(RANDOM, 2e-4, SIDE_BY_SIDE, MAGNET, "{}"), (PERIODIC, 1e-3, FRF, SDOF, FORCE)],
)
def test_an_injection_far_too_weak_is_refused(
    fitted, axis: Axis, rms: float, frf: str, fit: str, channels: str
) -> None:
    weak = axis.other(rms=rms)
    more = frf.replace("spectra", "spectra, reference: e") if axis.random else frf
    ended, _ = fitted(weak, weak.record(np.random.default_rng(4)), more, fit, channels)
    assert ended.code == 2 and "noise" in ended.err and "level" in ended.err


def test_a_negative_force_per_current_is_a_warning(fitted) -> None:
    columns = PERIODIC.record(np.random.default_rng(3))
    ended, fit = fitted(PERIODIC, {**columns, "i": -columns["i"]}, SIDE_BY_SIDE, MAGNET)
    assert ended.code == 0 and "unphysical" in codes(fit)
    ended, fit = fitted(PERIODIC, columns, SIDE_BY_SIDE, MAGNET)
    assert ended.code == 0 and not codes(fit)


@pytest.mark.parametrize(("frf", "fit", "channels"), [(SIDE_BY_SIDE, MAGNET, "{}"), (FRF, SDOF, FORCE)])
def test_a_clipped_current_is_said_of_every_fit(fitted, frf: str, fit: str, channels: str) -> None:
    columns = PERIODIC.record(np.random.default_rng(3))
    _, found = fitted(PERIODIC, {**columns, "i": np.clip(columns["i"], -0.4, 0.4)}, frf, fit, channels)
    assert "clipped" in codes(found)


def test_a_hum_on_a_line_of_the_multisine_is_named(fitted) -> None:
    """50 Hz of 3 N on the rotor, which repeats with every period of 500 ms: k is 90 standard errors off.

    The interval holds -420 kN/m all the same; left out as the message says, the fit is good.
    """
    lines = np.union1d(PERIODIC.lines, [25])
    axis = PERIODIC.other(lines=lines, disturbance=0.2, probe=1e-8)
    time = np.arange(round(axis.period * axis.periods * axis.rate)) / axis.rate
    columns = axis.record(np.random.default_rng(6), 3.0 * np.cos(2 * np.pi * 50 * time + 1.0))
    _, fit = fitted(axis, columns, FRF, SDOF, FORCE)
    (said,) = [finding["message"] for finding in fit["warnings"] if finding["code"] == "model-mismatch"]
    assert "the line at 50 Hz alone" in said and "exclude: [49.99-50.01 Hz]" in said
    _, fit = fitted(
        axis, columns, FRF.replace("reference", "exclude: [49.99-50.01 Hz], reference"), SDOF, FORCE
    )
    stiffness = next(one for one in fit["parameters"] if one["name"] == "k")
    assert "model-mismatch" not in codes(fit) and stiffness["ci95"][0] < -420e3 < stiffness["ci95"][1]


def late(columns: dict[str, np.ndarray], name: str, samples: int) -> dict[str, np.ndarray]:
    """A channel that was recorded later than the others."""
    return {**columns, name: np.roll(columns[name], samples)}


@pytest.mark.parametrize("samples", [20, 80])
def test_a_late_reference_is_no_feedback(fitted, samples: int) -> None:
    """An injection recorded 5 or 20 ms late: the lag is named to a sample beside the 0.2 ms of delay and
    amplifier, and the stiffness is right.
    """
    columns = late(RANDOM.record(np.random.default_rng(2)), "e", samples)
    ended, fit = fitted(RANDOM, columns, FRF, SDOF, FORCE)
    lag = float(ended.out.partition("reference-lag: the reference e lags by ")[2].split(" ")[0])
    assert abs(lag - samples / 4) <= 0.45 and "feedback" not in codes(fit)
    stiffness = next(one for one in fit["parameters"] if one["name"] == "k")
    assert ended.code == 0 and stiffness["ci95"][0] < -420e3 < stiffness["ci95"][1]


def test_a_stated_delay_is_no_lag(fitted) -> None:
    columns = late(RANDOM.record(np.random.default_rng(2)), "e", 20)
    stated = FORCE[:-1] + ", e: {delay: 5 ms}}"
    ended, fit = fitted(RANDOM, columns, FRF, SDOF, stated)
    assert ended.code == 0 and "reference-lag" not in ended.out and "feedback" not in codes(fit)


def test_a_command_that_lags_stays_feedback(fitted) -> None:
    """The command holds the motion, whenever it is recorded."""
    pushed = RANDOM.other(disturbance=10.0)
    columns = late(pushed.record(np.random.default_rng(2)), "u", 20)
    ended, fit = fitted(pushed, columns, FRF.replace("reference: e", "reference: u"), SDOF, FORCE)
    assert ended.code == 1 and "feedback" in codes(fit) and "reference-lag" not in ended.out


@pytest.mark.parametrize(("samples", "axis"), [(4, PERIODIC), (-2, PERIODIC), (4, RANDOM)])
def test_a_reading_that_is_late_in_a_loop_is_named(fitted, samples: int, axis: Axis) -> None:
    """1 ms late, .5 ms early: the delay within four of its standard errors, and with it k = -420 kN/m and no
    damping. Without it the damping was -1565, 766 and -5274 N s/m.
    """
    columns = late(axis.record(np.random.default_rng(1)), "x", samples)
    _, fit = fitted(axis, columns, FRF, SDOF, FORCE)
    (said,) = [finding["message"] for finding in fit["warnings"] if finding["code"] == "delay"]
    assert f"x against i is {'late' if samples > 0 else 'early'} by " in said
    value, error, unit = re.search(r"by ([\d.]+) \+- ([\d.]+) (ms|us)", said).groups()
    scale = 1.0 if unit == "ms" else 1e-3
    assert abs(scale * float(value) - abs(samples) / 4) < 4 * scale * float(error) < 0.01
    stiffness, damping = re.search(r"k = (-[\d.]+) \+- [\d.]+ kN/m, c = (-?[\d.]+) \+-", said).groups()
    assert abs(float(stiffness) + 420) < 2 and abs(float(damping)) < 8


@pytest.mark.parametrize(("samples", "axis"), [(4, PERIODIC), (-2, PERIODIC), (4, RANDOM)])
def test_a_reading_that_is_late_is_named_by_the_magnet(fitted, samples: int, axis: Axis) -> None:
    """1 ms late, .5 ms early: with the delay k_i = 120 N/A and k_s = -420 kN/m. Without it the fit of
    periods gave 79 N/A, that of blocks 47 N/A.
    """
    columns = late(axis.record(np.random.default_rng(1)), "x", samples)
    frf = SIDE_BY_SIDE.replace("spectra", "spectra, reference: e") if axis.random else SIDE_BY_SIDE
    _, fit = fitted(axis, columns, frf, MAGNET)
    (said,) = [finding["message"] for finding in fit["warnings"] if finding["code"] == "delay"]
    value, error, unit = re.search(r"x against i is \w+ by ([\d.]+) \+- ([\d.]+) (ms|us)", said).groups()
    scale = 1.0 if unit == "ms" else 1e-3
    assert abs(scale * float(value) - abs(samples) / 4) < 4 * scale * float(error) < 0.01
    assert ("late" if samples > 0 else "early") in said.partition(" by ")[0]
    force, stiffness = re.search(r"k_i = ([\d.]+) \+- [\d.]+ N/A, k_s = (-[\d.]+) \+-", said).groups()
    assert abs(float(force) - 120) < 0.5 and abs(float(stiffness) + 420) < 2


@pytest.mark.parametrize(
    ("stated", "frf", "fit", "channels"),
    [("6.3 kg", SIDE_BY_SIDE, MAGNET, "{}"), ("6.5 kg", FRF, SDOF, FORCE)],
    ids=["magnet", "sdof"],
)
def test_nothing_else_is_taken_for_a_delay(fitted, stated: str, frf: str, fit: str, channels: str) -> None:
    """A sound record, and a mass 3 % off, which leaves a residual as well."""
    columns = PERIODIC.record(np.random.default_rng(1))
    fit = f"{fit[:-1].partition(', mass')[0]}, mass: {stated}}}"
    _, found = fitted(PERIODIC, columns, frf, fit, channels)
    assert "delay" not in codes(found)


def test_a_weak_injection_that_leaves_more_than_noise_is_not_accepted(fitted) -> None:
    """4 mA: just above what is refused (3 of 15 draws are), chi-square 1.33 of p = .002. With 20 mA the same
    record is accepted.
    """
    for rms, code in ((4e-3, 1), (2e-2, 0)):
        axis = PERIODIC.other(rms=rms)
        ended, fit = fitted(axis, axis.record(np.random.default_rng(0)), FRF, SDOF, FORCE)
        assert ended.code == code and ("weak-injection" in codes(fit)) is bool(code)
