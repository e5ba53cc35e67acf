"""Poles, argument principle and sensitivity: closed forms, each against the other, and the printed loop of
both signs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.methods.magnetic_bearing.loop import ControlLoop, controller, loop_stiffness
from labpipe.methods.magnetic_bearing.stability import (
    Suspended,
    closed_loop_poles,
    pade,
    sensitivity,
    sensitivity_peak,
    unstable_poles,
    zone_of,
)

# Half of the levitated rotor's 0.13 kg; the negative stiffness leaves 1694 N/m at rest.
RIG = Suspended(ControlLoop(), 33106.0, 0.065)
IDEAL = ControlLoop(derivative_time=0.0, lag=0.0, lag_time=0.0, delay=0.0, bandwidth=1e12)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_pade_is_the_delay_at_low_frequency(order: int) -> None:
    """Error of order (w tau)^(2n+1); all-pass at every frequency."""
    ahead, behind = pade(75e-6, order)
    s = 2j * np.pi * 500.0
    assert ahead(s) / behind(s) == pytest.approx(np.exp(-s * 75e-6), rel=0.25 ** (2 * order + 1))
    assert abs(ahead(9e5j) / behind(9e5j)) == pytest.approx(1.0, rel=1e-9)


def test_first_order_pade_is_the_textbook_one() -> None:
    ahead, behind = pade(2.0, 1)
    np.testing.assert_allclose([ahead.coef, behind.coef], [[1.0, -1.0], [1.0, 1.0]])


def test_ideal_loop_has_the_poles_of_a_spring_and_damper() -> None:
    """m s^2 + K k_d s + K k_p - k_n = 0: quadratic formula."""
    plant = Suspended(IDEAL, 33106.0, 0.065)
    b, c = 46400 * 6.5e-4 / 0.065, (46400 - 33106.0) / 0.065
    exact = -b / 2 + 1j * np.sqrt(c - b**2 / 4)
    slow = [pole for pole in closed_loop_poles(plant) if abs(pole) < 1e6]
    np.testing.assert_allclose(sorted(slow, key=lambda pole: pole.imag), [np.conj(exact), exact], rtol=1e-6)


def test_poles_are_zeros_of_the_exact_characteristic_function() -> None:
    """K G(s) - k_n + m s^2 with the exact delay, at the poles below 1 kHz, against its largest term."""
    for pole in closed_loop_poles(RIG):
        if abs(pole) > 2 * np.pi * 1000:
            continue
        force = loop_stiffness(RIG.loop) * complex(controller(RIG.loop, np.array([pole / 1j]))[0])
        assert abs(force - RIG.negative_stiffness + RIG.mass * pole**2) < 1e-6 * RIG.negative_stiffness


@pytest.mark.parametrize("proportional", [0.5, 1.0, 6.0])
@pytest.mark.parametrize(("lag", "delay"), [(0.0, 0.0), (0.25, 75e-6), (-0.25, 1e-3), (0.25, 4e-3)])
def test_argument_principle_counts_the_poles(proportional: float, lag: float, delay: float) -> None:
    """Pade poles against the exact delay's turn: too soft, stable and delayed loops.

    No setting lies on the border.
    """
    plant = replace(RIG, loop=replace(RIG.loop, proportional=proportional, lag=lag, delay=delay))
    assert unstable_poles(plant) == np.sum(closed_loop_poles(plant).real > 0)


def test_printed_loop_is_stable_with_the_lag_subtracted_only() -> None:
    assert unstable_poles(RIG) == 0
    printed = replace(RIG, loop=replace(RIG.loop, lag=0.25), negative_stiffness=46400 * 1.25 - 1694)
    assert unstable_poles(printed) == 2


def test_sensitivity_at_rest_is_the_ratio_of_stiffnesses() -> None:
    """S(0) = -k_n / (K G(0) - k_n): a bearing that is soft at rest is sensitive there, 33106 / 1694 =
    19.54.
    """
    peak = sensitivity_peak(RIG)
    assert (peak.value, peak.frequency, peak.zone) == (pytest.approx(33106 / 1694, rel=1e-9), 0.0, "D")
    assert abs(sensitivity(RIG, np.array([2 * np.pi * 1e6]))[0]) == pytest.approx(1.0, rel=1e-3)


def test_peak_of_an_ideal_loop_is_the_one_of_its_closed_form() -> None:
    """S = (s^2 - n) / (s^2 + 2 z w0 s + w0^2) by a search over a million lines."""
    plant = Suspended(replace(IDEAL, proportional=3.0, derivative=1e-3), 33106.0, 0.065)
    w = 2 * np.pi * np.linspace(1.0, 2000.0, 1_000_001)
    size = np.abs((-(w**2) - 33106 / 0.065) / (-(w**2) + 1j * w * 46.4 / 0.065 + (3 * 46400 - 33106) / 0.065))
    peak = sensitivity_peak(plant)
    assert peak.value == pytest.approx(size.max(), rel=1e-5)
    assert peak.frequency == pytest.approx(w[size.argmax()] / 2 / np.pi, rel=2e-3)


@pytest.mark.parametrize(
    ("peak", "zone"), [(1.2, "A"), (2.999, "A"), (3.0, "B"), (4.0, "C"), (5.0, "D"), (40.0, "D")]
)
def test_zones_of_the_standard(peak: float, zone: str) -> None:
    assert zone_of(peak) == zone
