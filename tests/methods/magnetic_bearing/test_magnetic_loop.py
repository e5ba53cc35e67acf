"""The loop's stiffness and damping against a plain evaluation of its block diagram, and the shares of its
elements.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.loop import (
    ControlLoop,
    controller,
    dynamic_stiffness,
    inferred_negative_stiffness,
    loop_stiffness,
    stiffness_shares,
)

LOOP = ControlLoop(sensor_bandwidth=5000.0)
OMEGA = 2 * np.pi * np.array([2.0, 23.0, 150.0, 800.0])


def block_diagram(frequency: float) -> complex:
    """Written out with the numbers of Lim et al.

    (2009), table 1, the lag subtracted, a probe limited to 5 kHz.
    """
    s = 2j * math.pi * frequency
    pid = 1.0 + 6.5e-4 * s / (1 + 1e-4 * s) - 0.25 / (1 + 0.0318 * s)
    return pid * cmath.exp(-75e-6 * s) / (1 + s / (2 * math.pi * 1000)) / (1 + s / (2 * math.pi * 5000))


@pytest.mark.parametrize("frequency", [0.0, 2.0, 72.5, 250.0, 3000.0])
def test_controller_is_the_block_diagram(frequency: float) -> None:
    assert controller(LOOP, np.array([2 * np.pi * frequency]))[0] == pytest.approx(
        block_diagram(frequency), rel=1e-12
    )


def test_probe_without_a_limit_changes_nothing() -> None:
    wide = controller(replace(LOOP, sensor_bandwidth=1e12), OMEGA)
    np.testing.assert_allclose(controller(replace(LOOP, sensor_bandwidth=None), OMEGA), wide, rtol=1e-8)


def test_gain_of_the_printed_loop() -> None:
    """8 V/mm * 1 A/V * 5.8 N/A = 46.4 kN/m.

    G(0) = 0.75 leaves 34.8 kN/m, of which 33.106 kN/m are the bias field's for 1694 N/m.
    """
    assert loop_stiffness(LOOP) == pytest.approx(46400.0, rel=1e-12)
    assert inferred_negative_stiffness(LOOP, 1694.0) == pytest.approx(33106.0, rel=1e-12)
    assert dynamic_stiffness(LOOP, 33106.0, np.zeros(1))[0] == pytest.approx(1694.0, rel=1e-9)


def test_shares_sum_to_the_whole() -> None:
    shares = stiffness_shares(LOOP, 33106.0, OMEGA)
    assert list(shares) == ["proportional", "derivative", "lag", "delay", "amplifier", "sensor", "bias_field"]
    np.testing.assert_allclose(
        np.sum(list(shares.values()), axis=0), dynamic_stiffness(LOOP, 33106.0, OMEGA), rtol=1e-12
    )


def test_shares_have_their_closed_forms() -> None:
    """k_p K is a spring.

    Re of the derivative is K k_d T_d w^2 / (1 + (w T_d)^2), damping of the lag -K k_i T_i / (1 + (w T_i)^2).
    """
    shares = stiffness_shares(LOOP, 33106.0, OMEGA)
    np.testing.assert_allclose(shares["proportional"], 46400.0, rtol=1e-12)
    np.testing.assert_allclose(
        shares["derivative"].real, 46400 * 6.5e-4 * 1e-4 * OMEGA**2 / (1 + (1e-4 * OMEGA) ** 2), rtol=1e-12
    )
    np.testing.assert_allclose(
        shares["lag"].imag / OMEGA, 46400 * 0.25 * 0.0318 / (1 + (0.0318 * OMEGA) ** 2), rtol=1e-12
    )
    np.testing.assert_array_equal(shares["bias_field"], -33106.0)


def test_delay_takes_damping_away_from_a_spring() -> None:
    """e^{-jw tau} of a spring K k_p: damping -K k_p tau at low frequency."""
    spring = ControlLoop(derivative=0.0, lag=0.0, bandwidth=1e9)
    omega = np.array([1.0])
    assert dynamic_stiffness(spring, 0.0, omega)[0].imag == pytest.approx(-46400 * 75e-6, rel=1e-4)


@pytest.mark.parametrize("entry", ["derivative_time", "lag_time", "delay", "bandwidth", "sensor_bandwidth"])
def test_negative_times_and_bandwidths_are_refused(entry: str) -> None:
    with pytest.raises(ConfigError, match=f"^{entry} must"):
        replace(LOOP, **{entry: -1.0})
