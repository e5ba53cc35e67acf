"""The virtual levitated rig against closed forms, scipy's discretisation, and a plain loop from step to
step.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.levitated_loop import (
    BendingMode,
    Injection,
    LevitatedNoise,
    LevitatedRig,
    LongRotor,
    SampledPid,
    levitated_loop,
    mechanics,
    rotor_receptance,
)
from labpipe.methods.magnetic_bearing.levitated_rig import truth
from labpipe.methods.magnetic_bearing.sampled_loop import linear_states
from labpipe.project.simulate import load_virtual_rig
from labpipe.simulate.virtual_rigs import recordings

CONFIGS = Path(__file__).parents[3] / "configs"
SILENT = LevitatedNoise(0.0, 0.0, 0.0, 0.0, 0.0)
LONG = LongRotor(0.03, (-0.12, 0.1), (-0.15, 0.125), polar_inertia=0.008)
BENT = replace(LONG, bending=BendingMode(180.0, (-0.2, -0.1), (-0.3, -0.2), damping_ratio=0.02))


def shipped(**changes: object) -> LevitatedRig:
    """The shipped rig without noise, in a second of steady multisine."""
    rig = load_virtual_rig(CONFIGS / "virtual-levitated.yaml")
    assert isinstance(rig, LevitatedRig)
    return replace(
        rig, noise=SILENT, injection=replace(rig.injection, periods=1, band=(5.0, 300.0)), **changes
    )  # type: ignore[arg-type]


def one_axis(**changes: object) -> LevitatedRig:
    return shipped(axes="x", cross_stiffness=0.0, **changes)


def lines(rig: LevitatedRig, run: str) -> dict[str, np.ndarray]:
    """Amplitudes of all channels at 5-300 Hz by a plain DFT of one second."""
    (recording,) = recordings(rig, 1, [run])
    amplitude = np.fft.rfft(recording.samples, axis=0)[5:301]
    return {channel.name: amplitude[:, number] for number, channel in enumerate(recording.channels)}


def test_a_mass_moves_by_its_current_as_its_equation_of_motion_says() -> None:
    """X / I = k_i / (-w^2 m + j w c - k_s), by hand.

    What the sampled record of a held current leaves is below 5e-4.
    """
    of = lines(one_axis(), "multisine-x")
    jw = 2j * np.pi * np.arange(5, 301)
    np.testing.assert_allclose(of["x"] / of["i_x"], 80 / (jw**2 * 4 + jw * 100 - 2e5), rtol=5e-4)


@pytest.mark.parametrize("rotor", [None, LONG, BENT])
def test_two_axes_move_by_all_their_currents(rotor: LongRotor | None) -> None:
    """Y = H k_i I with H from the matrices, over as many experiments as there are axes.

    The bending mode turns the sensors' phase.
    """
    control = SampledPid(proportional=6e3, derivative=15.0, integral=2e4) if rotor else shipped().control
    rig = shipped(rotor=rotor, control=control, cross_stiffness=0.0 if rotor else 2e4, speed=0.0)
    runs = [lines(rig, f"multisine-{label}") for label in rig.labels]
    current, motion = (
        np.stack([np.stack([run[p + label] for label in rig.labels], 1) for run in runs], 2)
        for p in ("i_", "")
    )
    expected = rotor_receptance(rig, np.arange(5.0, 301.0)) * rig.force_per_current @ current
    assert np.max(np.abs(motion - expected)) < 1e-3 * np.max(np.abs(motion))
    small = np.linalg.norm(motion - expected, axis=(1, 2)) / np.linalg.norm(motion, axis=(1, 2))
    assert np.max(small) < 5e-3


def test_poles_are_zeros_of_the_return_difference() -> None:
    """det(I + z^-2 C(z) P(z)) = 0 at every pole, with scipy's zero-order hold of the plant.

    The poles lie in the left half plane.
    """
    rig = one_axis()
    slope = np.array([[0, 1, 0], [2e5 / 4, -100 / 4, 80 / 4], [0, 0, -2 * np.pi * 2000]])
    a, b, c, _, _ = signal.cont2discrete(
        (slope, np.array([[0], [0], [2 * np.pi * 2000]]), np.array([[1, 0, 0]]), 0), 1e-4
    )
    loop = levitated_loop(rig)
    assert np.all(loop.poles.real < 0)
    z = np.exp(loop.poles / 1e4)
    for one in z[np.abs(z) > 0.2]:
        fast = 2e4 * (one - 1) / (one + 1)
        pid = 5e3 + 12 * fast / (1 + 2e-4 * fast) + 2e4 / fast
        # The plant of scipy takes the output of the same instant, one interval of delay more is the
        # controller's.
        plant = (c @ np.linalg.inv(one * np.eye(3) - a) @ b)[0, 0] / one
        assert abs(1 + pid * plant) < 1e-6 * abs(pid * plant)


def test_pieces_of_a_loop_are_the_loop(rng: np.random.Generator) -> None:
    """linear_states against its plain twin."""
    step, driven = np.diag([0.99, 0.5]) + 0.1 * rng.standard_normal((2, 2)), rng.standard_normal((1300, 2))
    step /= 1.05 * np.max(np.abs(np.linalg.eigvals(step)))
    state, expected = np.zeros(2), []
    for now in driven:
        expected.append(state)
        state = step @ state + now
    np.testing.assert_allclose(linear_states(step, driven), expected, atol=1e-12 * np.max(np.abs(expected)))


def test_a_free_rotor_nutates_forward_at_its_inertia_ratio() -> None:
    """Free in space it nutates at W J_p / J_t in the sense of rotation: b = cos, a = sin of slopes in x and
    y.
    """
    of = mechanics(shipped(rotor=LONG, damping=0.0, cross_stiffness=0.0, speed=100.0))
    forward = np.array([0, 0, 1, -1j])
    rate = 2j * np.pi * 100.0 * 0.008 / 0.03
    np.testing.assert_allclose((rate**2 * of.mass + rate * of.damping) @ forward, 0, atol=1e-9)


def test_a_shaker_meets_the_levitated_rotor() -> None:
    """Its force is measured outside of the loop: a soft spring at rest is what the controller makes of it,
    k_i P - k_s.
    """
    rig = one_axis(shaker=1.0)
    rig = replace(
        rig, injection=replace(rig.injection, duration=20.0), control=replace(rig.control, integral=0.0)
    )
    (recording,) = recordings(rig, 1, ["shaker"])
    assert [channel.role for channel in recording.channels] == ["reference", "output", "input"]
    blocks = recording.samples.reshape(20, 2000, 3) * np.hanning(2000)[:, None]
    spectra = np.fft.rfft(blocks, axis=1)[:, 8:12]
    stiffness = np.sum(np.abs(spectra[..., 2]) ** 2, 0) / np.sum(spectra[..., 1] * spectra[..., 2].conj(), 0)
    np.testing.assert_allclose(stiffness.real, 4e5 - 2e5, rtol=0.1)


def test_what_turns_is_seen_once_a_turn() -> None:
    """Reading less P I, P = k_i / (-w^2 m + j w c - k_s), is the runout, or the motion under the unbalance u
    w^2.

    By hand, to the 1.3e-3 of the logger's filter.
    """
    for change, moved in (({"runout": (1e-6,)}, 0.0), ({"unbalance": 4e-6}, 4e-6)):
        rig = one_axis(speed=100.0, **change)
        (run,) = recordings(rig, 1, ["rest"])
        assert [channel.name for channel in run.channels] == ["i_x", "x", "n"]
        current, reading, pulses = 2 * np.fft.rfft(run.samples[-2000:], axis=0)[100] / 2000
        jw = 200j * np.pi
        receptance = 1 / (jw**2 * 4 + jw * 100 - 2e5)
        left = abs(reading - receptance * 80 * current)
        assert left == pytest.approx(abs(receptance) * moved * abs(jw) ** 2 if moved else 1e-6, rel=2e-3)
        assert abs(pulses) > 1


def test_runs_are_named_and_depend_on_nothing_else() -> None:
    rig = shipped(force_recorded=True, output_recorded=True)
    rig = replace(rig, noise=LevitatedNoise(), injection=replace(rig.injection, duration=0.5))
    (alone,) = recordings(rig, 3, ["random-y"])
    again = recordings(rig, 3, ["rest", "random-y"])[1]
    np.testing.assert_array_equal(alone.samples, again.samples)
    assert [channel.name for channel in alone.channels] == [
        "f_x",
        "f_y",
        "x",
        "y",
        "u_x",
        "u_y",
        "r_x",
        "r_y",
    ]
    assert np.std(alone.samples[:, 6]) == 0 < np.std(alone.samples[:, 7])


def test_the_truth_holds_what_a_fit_looks_for() -> None:
    known = truth(shipped(rotor=BENT))
    assert known["axes"] == ["ax", "ay", "bx", "by"]
    assert np.shape(known["mass_matrix"]) == (6, 6) and np.shape(known["at_sensors"]) == (4, 6)
    assert (known["k_i"], known["k_s"], known["negative_stiffness"]) == (80.0, -2e5, 2e5)


def test_what_cannot_float_is_refused() -> None:
    with pytest.raises(ConfigError, match="unstable"):
        recordings(one_axis(control=SampledPid(proportional=2e3, derivative=12.0)), 1, ["rest"])
    with pytest.raises(ConfigError, match="divides that of the controller"):
        one_axis(sample_rate=3000.0)
    with pytest.raises(ConfigError, match="need both axes"):
        shipped(axes="x")
    for injection, run, said in (
        (Injection(duration=0.2, band=(5.01, 5.02)), "random-x", "no line of a whole recording"),
        (Injection(duration=1e-5), "rest", "holds no sample"),
    ):
        with pytest.raises(ConfigError, match=said):
            recordings(replace(one_axis(), injection=injection), 1, [run])
    with pytest.raises(ConfigError, match="no places"):
        one_axis(unbalance_place=0.1)
    with pytest.raises(ConfigError, match="damping_ratio must not be negative"):
        replace(BENT.bending, damping_ratio=-0.01)
    with pytest.raises(ConfigError, match="disturbance must not be negative"):
        LevitatedNoise(disturbance=-1.0)
    with pytest.raises(ConfigError, match="2 x 2"):
        shipped(control=replace(shipped().control, mixing=((1.0,),)))
    with pytest.raises(ConfigError, match="two different places"):
        LongRotor(0.03, (0.1, 0.1), (0.1, 0.2))
