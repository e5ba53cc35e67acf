"""The sampled loop against its twin in the frequency domain, and against a loop written out sample by
sample.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.loop import ControlLoop, dynamic_stiffness, inferred_negative_stiffness
from labpipe.methods.magnetic_bearing.sampled_loop import Suspended, sampled_loop, straight
from labpipe.methods.magnetic_bearing.stability import sensitivity
from labpipe.methods.magnetic_bearing.transfer import ControllerBlock, CrossControl
from tests.methods.magnetic_bearing.certified import loop_response

LOOP = ControlLoop()
PULL = inferred_negative_stiffness(LOOP, 1694.0)
RIG = Suspended(LOOP, PULL, 0.92, 2, 134.5e3, 3.682)
ROTOR = Suspended(LOOP, PULL, 0.065)
OMEGA = 2 * np.pi * np.array([2.0, 20.0, 50.0, 100.0, 150.0, 250.0])


@pytest.mark.parametrize(
    "loop",
    [
        LOOP,
        replace(LOOP, delay=60e-6),
        replace(LOOP, delay=25e-6),
        replace(LOOP, delay=130e-6),
        replace(LOOP, sensor_bandwidth=2e3),
    ],
)
def test_stiffness_and_damping_are_those_of_the_frequency_domain(loop: ControlLoop) -> None:
    """K_eq + j w C_eq from the receptance in time.

    The bilinear PID departs by (w T)^2 / 12 = 5e-4 at 250 Hz.
    """
    motion = 1 / loop_response(sampled_loop(replace(RIG, loop=loop)), OMEGA)[:, 0, 0]
    if loop.sensor_bandwidth is not None:
        motion /= 1 + 1j * OMEGA * loop.corners[1]  # the reading lags behind the motion
    bearing = (motion - 134.5e3 - 3.682j * OMEGA + 0.92 * OMEGA**2) / 2
    np.testing.assert_allclose(bearing, dynamic_stiffness(loop, PULL, OMEGA), rtol=1.5e-3)


def test_the_sensitivity_is_that_of_the_frequency_domain() -> None:
    omega = 2 * np.pi * np.array([10.0, 50.0, 100.0, 200.0, 500.0])
    _, before, after = loop_response(sampled_loop(ROTOR), omega)[:, :3, 2].T
    np.testing.assert_allclose(after, sensitivity(Suspended(LOOP, PULL, 0.065), omega), rtol=1e-3)
    np.testing.assert_allclose(after - before, 1.0, rtol=1e-9)


def test_matrices_do_what_the_block_diagram_does(rng: np.random.Generator) -> None:
    """PID, one interval of computing and the hold written out.

    The motion by 200 Euler-Cromer steps per interval, hence 1 %.
    """
    force, noise = rng.normal(size=120), 1e-6 * rng.normal(size=120)
    inputs = np.stack([force[:-1], force[1:], noise[:-1], np.zeros(119)], axis=1)[:, None]
    ours = sampled_loop(ROTOR).run(inputs)[:, 0, 0]
    x = v = current = waiting = derivative = lag = last = 0.0
    interval, fine, plain = 5e-5, 5e-5 / 200, []
    for number in range(119):
        reading = x + noise[number]
        plain.append(reading)
        volts = 8000.0 * reading
        derivative = ((2e-4 - interval) * derivative + 2 * 6.5e-4 * (volts - last)) / (2e-4 + interval)
        lag = ((2 * 0.0318 - interval) * lag - 0.25 * interval * (volts + last)) / (2 * 0.0318 + interval)
        held, waiting, last = waiting, 1.0 * volts + derivative + lag, volts
        for part in range(200):
            pushed = force[number] + (force[number + 1] - force[number]) * (part + 0.5) / 200
            current += fine * 2 * np.pi * 1000 * (held - current)
            v += fine * (pushed - 5.8 * current + PULL * x) / 0.065
            x += fine * v
    np.testing.assert_allclose(ours, plain, atol=0.01 * np.max(np.abs(plain)))


@pytest.mark.parametrize("delay", [25e-6, 75e-6, 230e-6])
def test_two_directions_without_a_cross_term_have_the_poles_of_one_twice(delay: float) -> None:
    """Of the loop of one direction, whose matrices are compared with the block diagram.

    Up to four samples wait for their turn.
    """
    pid = ControllerBlock(form="pid", proportional=0.75, derivative=6.5e-4, derivative_time=1e-4)
    loops = [ControlLoop(delay=delay, controller=(pid,), cross=cross) for cross in (None, CrossControl())]
    one, both = (np.linalg.eigvals(sampled_loop(replace(ROTOR, loop=loop)).a) for loop in loops)
    assert both.size == 2 * one.size
    # What waits makes poles at z = 0 of higher order, which rounding spreads: the polynomials are compared.
    np.testing.assert_allclose(np.poly(both), np.polymul(np.poly(one), np.poly(one)), atol=1e-9)


def test_stability_is_that_of_the_poles() -> None:
    """The printed sign of the lag leaves the rotor alone unstable, in time as well."""
    largest = []
    for loop in (LOOP, replace(LOOP, lag=0.25)):
        rotor = Suspended(loop, inferred_negative_stiffness(loop, 1694.0), 0.065)
        largest.append(np.max(np.abs(np.linalg.eigvals(sampled_loop(rotor).a))))
    assert largest[0] < 1 < largest[1]


def test_a_straight_force_has_sinc_squared_of_its_lines() -> None:
    t = np.arange(4000) / 4000  # 400 samples of 4 Hz.. every 10th is a sample
    wave = np.cos(2 * np.pi * 40 * t)
    lines = np.interp(np.arange(4000), np.arange(0, 4001, 10), np.append(wave[::10], wave[0]))
    ratio = np.fft.rfft(lines)[40].real / np.fft.rfft(wave)[40].real
    assert ratio == pytest.approx(straight(np.array([2 * np.pi * 40]), 400.0)[0], rel=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"delay": 10e-6}, "shorter than half a sampling interval"), ({"derivative_time": 0.0}, "above zero")],
)
def test_what_cannot_be_sampled_is_said(change: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sampled_loop(replace(ROTOR, loop=replace(LOOP, **change)))
