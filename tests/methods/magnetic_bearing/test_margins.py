"""Margins by closed forms: a double integrator and an unstable plant under PD, the third-order loop of
textbooks, an ideal delay.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from labpipe.methods.magnetic_bearing.loop import ControlLoop, margins
from labpipe.methods.magnetic_bearing.sampled_loop import Suspended, sampled_loop
from labpipe.methods.magnetic_bearing.stability import SIGNALS, open_loop, sensitivity, unstable_poles
from labpipe.methods.magnetic_bearing.transfer import ControllerBlock
from tests.methods.magnetic_bearing.certified import loop_response

K_P, K_D, PULL = 9.0, 2.0, 4.0


def test_a_double_integrator_under_pd() -> None:
    """|L| = 1 at w^4 = k_p^2 + k_d^2 w^2; phase margin atan(k_d w / k_p).

    No gain makes it unstable, since Im L never vanishes.
    """
    found = margins(lambda w: (K_P + 1j * K_D * w) / (1j * np.maximum(w, 1e-9)) ** 2, 1e4)
    crossing = np.sqrt((K_D**2 + np.sqrt(K_D**4 + 4 * K_P**2)) / 2)
    assert found.phase == pytest.approx(np.arctan(K_D * crossing / K_P), rel=1e-9)
    assert found.delay == pytest.approx(found.phase / crossing, rel=1e-9)
    assert found.gain_lower == pytest.approx(0.0, abs=1e-12) and found.gain_upper == float("inf")


def test_an_unstable_plant_has_a_lower_gain_margin() -> None:
    """(k_p + k_d s) / (s^2 - a): stable while g k_p > a, so that the gain may fall to a / k_p."""
    found = margins(lambda w: (K_P + 1j * K_D * w) / (-(w**2) - PULL), 1e4)
    assert found.gain_lower == pytest.approx(PULL / K_P, rel=1e-12)
    assert found.gain_upper == float("inf")


@pytest.mark.parametrize("gain", [3.0, 10.0, 29.0])
def test_the_third_order_loop(gain: float) -> None:
    """K / (s (s + 1) (s + 5)): phase -180 deg at w = sqrt 5, where |L| = K / 30 (Ogata, Modern Control
    Engineering, sec. 7-7).
    """
    found = margins(lambda w: gain / ((1j * w + 1e-300) * (1j * w + 1) * (1j * w + 5)), 1e3)
    assert found.gain_upper == pytest.approx(30 / gain, rel=1e-9)


def test_the_disk_is_within_gain_and_phase() -> None:
    """Disk margin a: gains from (2 - a) / (2 + a) to its inverse are safe, and phases to 2 atan(a / 2)
    (Seiler et al. 2020).
    """

    def loop(w: np.ndarray) -> np.ndarray:
        return 10 / ((1j * w + 1e-300) * (1j * w + 1) * (1j * w + 5))

    found = margins(loop, 1e3)
    skew = optimize.minimize_scalar(lambda w: -abs(1 / (1 + loop(w)) - 0.5), bounds=(1, 3), method="bounded")
    assert found.disk == pytest.approx(-1 / skew.fun, rel=1e-9)
    assert (2 + found.disk) / (2 - found.disk) <= found.gain_upper
    assert 2 * np.arctan(found.disk / 2) <= found.phase
    assert 1 / found.peak >= found.disk / (1 + found.disk / 2) - 1e-9


PLANT = Suspended(ControlLoop(proportional=1.6, derivative=1.2e-3), 33106.0, 0.065)


def test_margins_of_a_levitated_mass_are_where_it_becomes_unstable() -> None:
    """The argument principle a per mille to either side of both gain margins, and of the delay margin."""
    found = margins(lambda w: open_loop(PLANT, w).loop, 20e3)
    loop = PLANT.loop
    for factor, unstable in (
        (found.gain_lower * 0.999, True),
        (found.gain_lower * 1.001, False),
        (found.gain_upper * 0.999, False),
        (found.gain_upper * 1.001, True),
    ):
        changed = ControlLoop(proportional=1.6, derivative=1.2e-3, amplifier=factor)
        assert (unstable_poles(Suspended(changed, 33106.0, 0.065)) > 0) == unstable
    for share, unstable in ((0.999, False), (1.001, True)):
        slow = ControlLoop(proportional=1.6, derivative=1.2e-3, delay=loop.delay + share * found.delay)
        assert (unstable_poles(Suspended(slow, 33106.0, 0.065)) > 0) == unstable


def test_the_open_loop_is_that_of_the_matrices() -> None:
    """Signals of the closed sampled loop: C, X and I apart against the step matrices that run in time."""
    omega = 2 * np.pi * np.array([10.0, 100.0, 400.0, 3000.0])
    matrices = loop_response(sampled_loop(Suspended(PLANT.loop, 33106.0, 0.065), 20e3), omega)[
        :, [1, 2, 3, 0, 4], 2
    ]
    signals = open_loop(PLANT, omega, 20e3).signals("input")
    np.testing.assert_allclose(np.stack([signals[name] for name in SIGNALS], axis=1), matrices, rtol=1e-9)
    np.testing.assert_allclose(open_loop(PLANT, omega).sensitivity, sensitivity(PLANT, omega), rtol=1e-12)


def test_an_injection_behind_the_controller_is_a_command_less() -> None:
    """r at the output: command S r; at the input: C S e."""
    omega = 2 * np.pi * np.array([10.0, 100.0])
    of = open_loop(PLANT, omega, 20e3)
    ahead, behind = of.signals("input"), of.signals("output")
    np.testing.assert_allclose(ahead["current"] / behind["current"], of.controller)
    np.testing.assert_allclose(behind["after"] - behind["before"], 1.0)


def test_a_filtered_record_has_no_images() -> None:
    """Of the sampled current the first image at 20 kHz - f is left out; both agree as f falls."""
    omega = 2 * np.pi * np.array([20.0, 1000.0])
    sampled, filtered = (open_loop(PLANT, omega, 20e3, kind) for kind in (False, True))
    difference = np.abs(filtered.current / sampled.current - 1)
    assert difference[0] < 1e-3 < difference[1] < 0.2
    np.testing.assert_allclose(filtered.loop, sampled.loop)


def test_a_gain_alone_is_sampled_without_memory() -> None:
    block = ControllerBlock(form="gain", gain=2.0)
    plant = Suspended(ControlLoop(controller=(block,)), 33106.0, 0.065)
    assert open_loop(plant, np.array([100.0]), 20e3).controller == pytest.approx([2.0])
