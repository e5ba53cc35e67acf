"""Short bearings: the printed closed forms against derivatives of the closed-form force.

The finite film against them is a part of the validation manual (tests/validation/journal.py).

Frame: y horizontal, z up, load -z, spin y to z. The closed forms are Ocvirk's, from Friswell et al., Dynamics
of Rotating Machines (2010).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec

from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing.bearing import (
    JournalBearing,
    short_bearing_coefficients,
    short_bearing_equilibrium,
    short_bearing_load,
)

SPEED = 300.0
# L / D = .025
SHORT = JournalBearing(diameter=30e-3, length=0.75e-3, clearance=90e-6, viscosity=0.1)


def short_force(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Force by quadrature of the parabolic pressure -L^3 mu / h^3 (Omega/2 h' + dh/dt) where it is positive,
    on the half it starts with.
    """
    y, z = position
    first = np.arctan2(z, y) - np.pi

    def pressure_force(theta: float) -> np.ndarray:
        h = SHORT.clearance - y * np.cos(theta) - z * np.sin(theta)
        slope = y * np.sin(theta) - z * np.cos(theta)
        rate = -velocity[0] * np.cos(theta) - velocity[1] * np.sin(theta)
        line_load = -SHORT.viscosity * SHORT.length**3 / h**3 * (SPEED / 2 * slope + rate)
        return -line_load * SHORT.diameter / 2 * np.array([np.cos(theta), np.sin(theta)])

    force, _ = quad_vec(pressure_force, first, first + np.pi, epsabs=0, epsrel=1e-11)
    return force


@pytest.mark.parametrize("eccentricity", [0.1, 0.4, 0.7])
def test_closed_form_is_the_integral_of_the_parabolic_pressure(eccentricity: float) -> None:
    load = short_bearing_load(SHORT, eccentricity, SPEED)
    ratio, attitude = short_bearing_equilibrium(SHORT, load, SPEED)
    np.testing.assert_allclose(ratio, eccentricity, rtol=1e-9)
    position = ratio * SHORT.clearance * np.array([np.sin(attitude), -np.cos(attitude)])
    np.testing.assert_allclose(short_force(position, np.zeros(2)), [0, load], atol=1e-8 * load)
    stiffness, damping = short_bearing_coefficients(SHORT, load, SPEED)
    step = 1e-4 * SHORT.clearance
    for axis in range(2):
        move = step * np.eye(2)[axis]
        column = -(short_force(position + move, np.zeros(2)) - short_force(position - move, np.zeros(2))) / (
            2 * step
        )
        np.testing.assert_allclose(stiffness[:, axis], column, atol=1e-5 * np.abs(stiffness).max())
        column = -(short_force(position, move) - short_force(position, -move)) / (2 * step)
        np.testing.assert_allclose(damping[:, axis], column, atol=1e-5 * np.abs(damping).max())


def test_no_load_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs a load"):
        short_bearing_equilibrium(SHORT, 0.0, SPEED)
