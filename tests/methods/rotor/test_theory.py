"""labpipe rotor: peaks and margins in closed form, modes followed through a crossing, the command."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize

from labpipe.methods.rotor.response import WhirlModes, eigenvalues
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.shaft import supported_rotor
from labpipe.methods.rotor.theory import (
    drawn_decrements,
    follow,
    margin_above,
    margin_below,
    peaks,
    rotor_document,
    rotor_theory,
    sentences,
)

LAVAL = Path(__file__).parents[3] / "configs/rotors/laval.yaml"


def test_peak_and_amplification_of_one_mass():
    """|H| = 1 / |w0^2 - w^2 + 2 j zeta w0 w| peaks at w0 sqrt(1 - 2 zeta^2) and falls to .707 of the peak at
    w^2 = w0^2 (1 - 2 zeta^2 -+ 2 zeta sqrt(1 - zeta^2)).
    """
    w0, zeta = 100.0, 0.02
    speed = np.linspace(80, 120, 600)
    response = 1 / np.abs(w0**2 - speed**2 + 2j * zeta * w0 * speed)
    (critical,) = peaks(speed, response)
    top = w0 * np.sqrt(1 - 2 * zeta**2)
    low, high = (w0 * np.sqrt(1 - 2 * zeta**2 + s * 2 * zeta * np.sqrt(1 - zeta**2)) for s in (-1, 1))
    assert critical.speed == pytest.approx(top, rel=1e-7)
    assert critical.amplification == pytest.approx(top / (high - low), rel=1e-5)
    assert critical.amplitude == pytest.approx(1 / (2 * zeta * w0**2 * np.sqrt(1 - zeta**2)), rel=1e-7)
    there, asked = critical.margin(130.0)
    assert there == pytest.approx(100 * (130 - top) / 130) and asked == margin_below(critical.amplification)
    assert peaks(speed[:300], response[:300]) == []


@pytest.mark.parametrize("zeta", [1e-4, 1e-6])
def test_a_peak_that_is_sharper_than_the_speeds_is_found(zeta):
    """Half-power width 2 zeta, 1 / 50 and 1 / 5000 of the speeds' distance: the same closed form."""

    def response(speed):
        return 1 / np.abs(100.0**2 - speed**2 + 2j * zeta * 100.0 * speed)

    speed = np.linspace(80, 120.5, 80)
    (critical,) = peaks(speed, response(speed), 0, response)
    assert critical.amplification == pytest.approx(1 / (2 * zeta), rel=1e-4)
    assert critical.amplitude == pytest.approx(1 / (2 * zeta * 100.0**2), rel=1e-4)
    # Two of them, as of bearings that differ in y and z, stay apart; flat ones so near are one.
    assert not critical.is_like(replace(critical, speed=1.02 * critical.speed))
    flat = replace(critical, low=0.95 * critical.speed, high=1.05 * critical.speed)
    assert flat.is_like(replace(flat, speed=1.02 * flat.speed))


@pytest.mark.parametrize(
    ("amplification", "below", "above"),
    [(2.0, 0.0, 0.0), (4.0, 10.2, 20.2), (8.0, 17 * 5.5 / 6.5, 10 + 17 * 5.5 / 6.5), (25.0, 16.0, 26.0)],
)
def test_margins_of_the_formulas(amplification, below, above):
    """17 (1 - 1 / (AF - 1.5)) by hand: 17 x .6 for AF 4."""
    assert margin_below(amplification) == pytest.approx(below)
    assert margin_above(amplification) == pytest.approx(above)


def test_modes_are_followed_through_a_crossing():
    """Two modes whose frequencies cross while their shapes stay."""
    shapes = np.array([[[1, 0], [0.5, 0]], [[0, 1], [0, -0.5]]], complex)
    each = []
    for speed in np.linspace(0, 10, 11):
        roots = np.array([-1 + 1j * (100 + speed), -1 + 1j * (106 - speed / 2)])
        order = np.argsort(roots.imag)
        each.append(WhirlModes(speed, roots[order], shapes[order]))
    order = follow(each)
    first = [modes.eigenvalues[n].imag for modes, n in zip(each, order[:, 0], strict=True)]
    np.testing.assert_allclose(first, 100 + np.linspace(0, 10, 11))


def test_a_mode_that_begins_within_the_speeds_is_followed():
    """The second mode oscillates from the fourth speed on only."""
    shapes = np.array([[[1, 0], [0.5, 0]], [[0, 1], [0, -0.5]]], complex)
    roots = np.array([-1 + 100j, 1 + 150j])
    each = [WhirlModes(n, roots[: 1 + (n > 2)], shapes[: 1 + (n > 2)]) for n in range(6)]
    assert follow(each).T.tolist() == [[0] * 6, [-1] * 3 + [1] * 3]


def test_the_least_decrement_is_that_of_the_files_speed_and_of_oil_whirl():
    """Above its onset a rotor has a negative one, at 6000 rpm by the eigenvalues of the rotor on its films;
    oil whirl does not oscillate at the first speeds, and the last is far below 6000 rpm.
    """
    rig = load_rotor(LAVAL, ["speed=100 Hz"])
    roots = eigenvalues(supported_rotor(rig.rotor, rig.supports()), rig.omega)[0]
    worst = roots[np.argmax(roots.real)]
    theory = rotor_theory(replace(rig, unbalances=()), np.linspace(5.0, 60.0, 5))
    assert theory.least_decrement == pytest.approx(-2 * np.pi * worst.real / worst.imag) and worst.real > 0


def test_a_rotor_at_rest_has_peaks_and_no_margin(labpipe, tmp_path, monkeypatch):
    monkeypatch.setattr("labpipe.methods.rotor.theory.FINE", 150)
    (tmp_path / "rotor.yaml").write_text(STIFF.replace("3000 rpm", "0 rpm"))
    command = ("rotor", tmp_path / "rotor.yaml", "--speeds", "5-50 Hz", "--json", tmp_path / "r.json")
    ended = labpipe(*command)
    assert ended.code == 0 and "margin" not in ended.out and ", amplification " in ended.out
    (critical,) = json.loads((tmp_path / "r.json").read_text())["critical_speeds"]
    assert critical["margin_percent"] is None and critical["amplification"] > 2.5


def test_what_is_at_rest_has_no_peak():
    for at_rest in (0.0, 1e-170):
        assert peaks(np.linspace(1, 2, 9), np.full(9, at_rest)) == []
    rig = load_rotor(LAVAL)
    still = replace(rig, unbalances=tuple(replace(part, size=0.0) for part in rig.unbalances))
    theory = rotor_theory(still, np.linspace(80, 90, 3))
    assert theory.criticals == () and theory.amplitude is None


def test_rounding_is_no_peak(rng):
    """The middle of a symmetric rotor under a couple rests but for rounding, as numbers drawn at random do: a
    third of them are larger than their neighbours, and a closer look finds as many again.
    """
    looks = []

    def rounding(speed):
        looks.append(speed)
        return 1e-20 * rng.uniform(size=speed.size)

    speed = np.linspace(2.5, 100, 1500)
    assert peaks(speed, rounding(speed), 3, rounding) == [] and len(looks) == 1


STIFF = """name: a stiff rotor
speed: 3000 rpm
elements: [{length: 100 mm, diameter: 40 mm, count: 2}]
discs: [{node: 2, mass: 10 kg, polar_inertia: 0.01 kg.m^2, transverse_inertia: 0.006 kg.m^2}]
bearings:
  - {kind: linear-bearing, name: left, node: 1, k_yy: 200 kN/m, c: 100 N.s/m}
  - {kind: linear-bearing, name: right, node: 3, k_yy: 200 kN/m, c: 100 N.s/m}
unbalances: [{node: 2, size: 20 g.mm}]
"""


def test_what_the_command_says_of_a_stiff_rotor_is_that_of_one_mass(labpipe, tmp_path):
    """A shaft that hardly bends on two equal bearings: w = sqrt(2 k / m), zeta = c / sqrt(2 k m), a peak of
    u / m AF, AF = 1 / (2 zeta), and the margin of API 684 at that.
    """
    (tmp_path / "rotor.yaml").write_text(STIFF)
    ended = labpipe("rotor", tmp_path / "rotor.yaml", "--json", tmp_path / "r.json", "--steps", 8)
    assert ended.code == 0, ended.err
    mass = 10 + 7800 * np.pi / 4 * 0.04**2 * 0.2
    speed, zeta = np.sqrt(400e3 / mass) * 30 / np.pi, 100 / np.sqrt(400e3 * mass)
    head, _, backward, forward, *_, peak, least, stable = ended.out.splitlines()
    assert head == "a stiff rotor, 3000 rpm" and stable == "stable up to 6000 rpm"
    for line, whirl in ((backward, "backward"), (forward, "forward")):
        rpm, hz, decrement = map(float, re.findall(r"[\d.]+", line))
        assert (
            line.endswith(whirl)
            and rpm == pytest.approx(speed, rel=5e-3)
            and hz == pytest.approx(rpm / 60, rel=5e-4)
        )
        assert decrement == pytest.approx(2 * np.pi * zeta, rel=5e-3)
    rpm, size, node, amplification, operating, there, asked = map(float, re.findall(r"[\d.]+", peak))
    assert rpm == pytest.approx(speed, rel=5e-3) and (node, operating) == (2, 3000)
    assert size == pytest.approx(20 / mass / (2 * zeta), rel=0.01)
    assert amplification == pytest.approx(1 / (2 * zeta), rel=0.01) and peak.endswith("kept")
    assert there == pytest.approx(100 - rpm / 30, abs=0.06)
    assert asked == pytest.approx(17 * (1 - 1 / (amplification - 1.5)), abs=0.1)
    # Of the first bending of the shaft, which the bearings hardly calm.
    assert "at 3000 rpm: " in least and least.endswith("NOT above 0.1")
    speeds = json.loads((tmp_path / "r.json").read_text())["campbell"]["speed_hz"]
    assert (speeds[0], speeds[-1], len(speeds)) == (2.5, 100.0, 8)
    # With uncertain bearings the same peak, driven by the same unbalance though that is stated exactly. Their
    # 5 % and what running may change, 10 %, are 8 % of the sum of two, and half of that of the speed.
    uncertain = STIFF.replace("200 kN/m", "200 kN/m +- 5 %")
    (tmp_path / "rotor.yaml").write_text(uncertain)
    ended = labpipe("rotor", tmp_path / "rotor.yaml", "--json", tmp_path / "r.json")
    assert ended.code == 0 and ended.out.startswith("a stiff rotor, 3000 rpm, as declared\n")
    (critical,) = json.loads((tmp_path / "r.json").read_text())["criticals"]
    assert (60 * critical["speed"], 1e6 * critical["amplitude"]) == pytest.approx((rpm, size), rel=5e-3)
    low, high = critical["speed_interval"]
    error = np.hypot(0.05, 0.1) / np.sqrt(2) / 2
    assert np.log(high / low) / 2 == pytest.approx(1.96 * error, rel=0.25)


DAMPED = """
name: Shaft with one disc
speed: 4200 rpm
elements: [{length: 100 mm, diameter: 40 mm, count: 12, material: s}]
materials: {s: {density: 7850 kg/m^3, elastic_modulus: 205 GPa, shear_modulus: 79 GPa}}
discs: [{node: 5, mass: 12.3 kg, transverse_inertia: 0.06 kg.m^2, polar_inertia: 0.11 kg.m^2}]
bearings:
  - {kind: linear-bearing, name: left, node: 2, k_yy: 10 MN/m, c: 20 kN.s/m}
  - {kind: linear-bearing, name: right, node: 12, k_yy: 7 MN/m, c: 20 kN.s/m}
"""


def test_the_mode_of_the_least_decrement_is_named_and_overdamped_motion_is_not_drawn(tmp_path):
    """By a Timoshenko beam of another program: .0707 at 478.13 Hz, where the first modes have .137 and .153;
    overdamped motion of the bearings has decrements of hundreds, beside which nothing else was seen.
    """
    (tmp_path / "rotor.yaml").write_text(DAMPED)
    theory = rotor_theory(load_rotor(tmp_path / "rotor.yaml"), np.linspace(5.0, 120.0, 12))
    assert theory.least_decrement == pytest.approx(0.0707, abs=5e-5)
    assert theory.least_frequency == pytest.approx(478.13, rel=1e-3)
    assert "(mode of 478.1 Hz), NOT above 0.1" in " ".join(sentences(theory))
    assert np.nanmax(theory.log_decrement) > 100
    drawn = drawn_decrements(theory.log_decrement)
    assert np.nanmax(drawn) < 2 * np.pi and np.sum(np.isfinite(drawn[0])) >= 4


@pytest.mark.long
def test_a_rotor_on_films_by_theory(labpipe, tmp_path):
    ended = labpipe("rotor", LAVAL, "--json", tmp_path / "r.json", "-o", tmp_path / "r.html", "--steps", 16)
    assert ended.code == 0, ended.err
    entry = json.loads((tmp_path / "r.json").read_text())
    (critical,) = entry["critical_speeds"]
    # The mode that is excited, forward at 1x, is where its frequency is the speed; its damping tells the
    # amplification of a lightly damped peak, AF = pi / delta.
    forward = next(crossing for crossing in entry["crossings"] if crossing["whirl"] > 0.3)
    assert critical["speed_hz"] == pytest.approx(forward["speed_hz"], rel=5e-3)
    assert critical["amplification"] == pytest.approx(np.pi / forward["log_decrement"], rel=0.1)
    assert critical["required_margin_percent"] == 26.0 and "NOT kept" in ended.out
    assert "Campbell" in (tmp_path / "r.html").read_text()
    # The onset by the growth rate of the exact bearings.
    whole = rotor_theory(load_rotor(LAVAL), np.linspace(80, 90, 5))
    assert whole.onset == pytest.approx(entry["onset_speed_hz"], rel=2e-3)


def test_faults_of_speeds_are_said(labpipe):
    for speeds, words in (
        ("10-120 mm", "wrong dimension"),
        ("120-10 Hz", "is empty"),
        ("fast", "is not a band"),
    ):
        ended = labpipe("rotor", LAVAL, "--speeds", speeds)
        assert ended.code == 2 and words in ended.err


def test_a_peak_beside_a_dip_lies_where_the_response_is_largest():
    """Two modes whose responses cancel between them, on speeds half a per cent apart: top and half-power
    points are those of scipy's search on the response itself.
    """

    def amplitude(speed):
        modes = ((1.0, 41.0, 0.02), (0.9, 43.5, 0.004))
        return np.abs(sum(m * speed**2 / (f**2 - speed**2 + 2j * z * f * speed) for m, f, z in modes))

    def shortfall(speed):
        return -float(amplitude(speed))

    grid = np.geomspace(30.0, 60.0, int(np.log(2) / 0.005))
    found = peaks(grid, amplitude(grid), 0, amplitude)
    assert len(found) == 2
    for peak, bounds in zip(found, ((40.0, 42.0), (43.2, 43.8)), strict=True):
        top = optimize.minimize_scalar(shortfall, bounds=bounds, method="bounded", options={"xatol": 1e-10})
        assert peak.speed == pytest.approx(top.x, rel=1e-6) and peak.amplitude == pytest.approx(
            -top.fun, rel=1e-5
        )
        for end, side in ((peak.low, -3.0), (peak.high, 0.8)):
            level = -top.fun / np.sqrt(2)
            exact = optimize.brentq(lambda speed, level=level: amplitude(speed) - level, top.x, top.x + side)
            assert end == pytest.approx(exact, rel=1e-5)


def test_the_campbell_diagram_names_the_modes_that_reach_it():
    """Of modes at .5, 1.9 and 2.2 times the highest speed the last lies above the axis, which ends at 2."""
    theory = rotor_theory(load_rotor(LAVAL), np.linspace(5.0, 60.0, 5))
    ratios = np.array([0.5, 1.9, 2.2])
    frequency = theory.speed[-1] * np.tile(ratios, (theory.speed.size, 1))
    theory = replace(theory, frequency=frequency, log_decrement=0.1 + 0 * frequency, whirl=1 + 0 * frequency)
    (figure,) = (block for block in rotor_document(theory).sections[1].blocks[:1])
    campbell, damping = figure.graphic.panels
    for panel in (campbell, damping):
        assert [name for one in panel.series if (name := one.name).startswith("mode")] == ["mode 1", "mode 2"]
    assert campbell.y.high == 2 * theory.speed[-1]
