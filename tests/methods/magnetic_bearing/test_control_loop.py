"""The bearing under position control against a plain evaluation of its block diagram, and its stability."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.methods.magnetic_bearing import virtual_mechanics as mechanics
from labpipe.methods.magnetic_bearing.loop import ControlLoop
from labpipe.methods.magnetic_bearing.virtual_mechanics import (
    LAWS,
    Levitation,
    LevitationNoise,
    VirtualMagneticRig,
)
from labpipe.methods.magnetic_bearing.virtual_rig import simulate
from labpipe.project.simulate import load_virtual_rig

LOOP_RIG = VirtualMagneticRig("virtual-magnetic-rig", levitation=Levitation(law="control-loop"))
PRINTED = Levitation(law="control-loop", loop=ControlLoop(lag=0.25))
CONFIG = Path(__file__).parents[3] / "configs" / "virtual-hmb-loop.yaml"


def block_diagram(frequency: float) -> complex:
    """Probe 8 V/mm, PID of Lim et al.

    (2009) table 1 with the lag subtracted, 75 us, 1 A/V to 1 kHz, 5.8 N/A, 33106 N/m.
    """
    s = 2j * math.pi * frequency
    pid = 1.0 + 6.5e-4 * s / (1 + 1e-4 * s) - 0.25 / (1 + 0.0318 * s)
    current = 8000.0 * pid * cmath.exp(-75e-6 * s) / (1 + s / (2 * math.pi * 1000))
    return 5.8 * current - 33106.0


def half_turns(dynamic_stiffness: np.ndarray) -> float:
    """Turn of D(jw) from rest to high frequency, over pi.

    Argument principle: a mass on a support that has no unstable poles itself is stable if and only if D turns
    by +1.
    """
    angle = np.unwrap(np.angle(dynamic_stiffness))
    return float(angle[-1] - angle[0]) / np.pi


@pytest.mark.parametrize("law", LAWS)
def test_static_stiffness_is_the_published_one(law: str) -> None:
    at_rest = mechanics.levitation_stiffness(Levitation(law=law), np.array([0.0]))
    # 1694 N/m per bearing, Lim et al. (2009), section 2.2; two bearings.
    np.testing.assert_allclose(at_rest, [2 * 1694.0], rtol=1e-12)


@pytest.mark.parametrize("frequency", [2.0, 50.0, 72.5, 150.0, 250.0])
def test_stiffness_and_damping_are_those_of_the_block_diagram(frequency: float) -> None:
    ours = mechanics.levitation_stiffness(LOOP_RIG.levitation, np.array([2 * np.pi * frequency]))[0] / 2
    assert ours == pytest.approx(block_diagram(frequency), rel=1e-12)


# From block_diagram, rounded to the digits that configs/virtual-hmb-loop.yaml states.
@pytest.mark.parametrize(
    ("frequency", "k", "c"),
    [
        (2.0, 3.30e3, 340.0),
        (50.0, 14.07e3, 22.8),
        (72.5, 15.01e3, 20.7),
        (150.0, 20.38e3, 18.0),
        (250.0, 31.56e3, 15.1),
    ],
)
def test_the_shipped_rig_has_the_stated_coefficients(frequency: float, k: float, c: float) -> None:
    omega = 2 * np.pi * frequency
    stiffness = mechanics.levitation_stiffness(load_virtual_rig(CONFIG).levitation, np.array([omega]))[0] / 2
    assert stiffness.real == pytest.approx(k, rel=2e-3)
    assert stiffness.imag / omega == pytest.approx(c, rel=4e-3)


def test_damping_is_positive_and_stiffness_rises_in_the_band() -> None:
    stiffness = mechanics.levitation_stiffness(LOOP_RIG.levitation, 2 * np.pi * np.arange(1.0, 251.0))
    assert np.all(stiffness.imag > 0) and np.all(np.diff(stiffness.real) > 0)


def test_the_printed_sign_of_the_lag_takes_damping_away() -> None:
    omega = 2 * np.pi * np.array([2.0, 21.0, 22.0])
    damping = mechanics.levitation_stiffness(PRINTED, omega).imag / omega / 2
    assert damping[0] == pytest.approx(-301.1, rel=1e-3)  # block_diagram with +0.25
    assert damping[1] < 0 < damping[2]


@pytest.mark.parametrize(("levitation", "turn"), [(LOOP_RIG.levitation, 1.0), (PRINTED, -1.0)])
def test_the_rotor_alone_is_stable_with_the_lag_subtracted_only(levitation: Levitation, turn: float) -> None:
    omega = 2 * np.pi * np.geomspace(1e-4, 1e6, 200_001)
    alone = mechanics.levitation_stiffness(levitation, omega) - 0.13 * omega**2
    assert half_turns(alone) == pytest.approx(turn, abs=0.01)


@pytest.mark.parametrize("lag", [-0.25, 0.25])
def test_pedestal_and_rotor_are_stable_either_way(lag: float) -> None:
    rig = replace(LOOP_RIG, levitation=Levitation(law="control-loop", loop=ControlLoop(lag=lag)))
    assert half_turns(
        mechanics.levitated_stiffness(rig, 2 * np.pi * np.geomspace(1e-4, 1e6, 200_001))
    ) == pytest.approx(1.0, abs=0.01)


def test_the_recording_shows_the_stated_truth() -> None:
    (run,) = simulate(replace(LOOP_RIG, noise=LevitationNoise(0.0, 0.0, 0.0)), 1, ["radial-0rpm"])
    force, x, y = np.fft.rfft(run.recording.samples[-2000:], axis=0)[1:251].T
    omega = 2 * np.pi * np.array(run.truth["frequency_hz"])
    bearings = 2 * (np.array(run.truth["k_per_bearing"]) + 1j * omega * np.array(run.truth["c_per_bearing"]))
    total = 134.5e3 + 3.682j * omega - 0.92 * omega**2 + bearings
    # The last of six periods; what is left of the decay (exp(-0.2 * 2 pi 70 Hz * 5 s)) is below rounding.
    np.testing.assert_allclose(x / force, np.cos(np.pi / 4) / total, rtol=1e-10)
    np.testing.assert_array_equal(x, y)
    assert run.truth["negative_stiffness_per_bearing"] == pytest.approx(5.8 * 8000 * 0.75 - 1694)


def test_the_shipped_rig_s_rotor_stays_within_40_um() -> None:
    (run,) = simulate(
        replace(load_virtual_rig(CONFIG), noise=LevitationNoise(0.0, 0.0, 0.0)), 1, ["radial-8000rpm"]
    )
    assert np.max(np.abs(run.recording.samples[:, 1:])) < 40e-6
