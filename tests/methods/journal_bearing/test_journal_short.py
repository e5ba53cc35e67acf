"""Short bearings: the printed closed forms against derivatives of the closed-form force.

The finite film against them is a part of the validation manual (tests/validation/journal.py).

Frame: y horizontal, z up, load -z, spin y to z. The closed forms are Ocvirk's, from Friswell et al., Dynamics
of Rotating Machines (2010).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec

from labpipe.methods.journal_bearing.bearing import JournalBearing, converged_equilibrium
from tests.methods.journal_bearing.short_bearing import (
    short_bearing_coefficients,
    short_bearing_equilibrium,
    short_bearing_load,
)
from tests.validation.peer_inputs import SHORT as SHORT_EXAMPLE
from tests.validation.peers import recorded

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


def test_closed_forms_are_those_of_another_program() -> None:
    """ROSS's of Friswell's example 5.5.1, as recorded; x is horizontal there as y is here."""
    theirs, given = recorded("ross")["short bearing"], dict(SHORT_EXAMPLE)
    load, speed = given.pop("load"), given.pop("rpm") * np.pi / 30
    stiffness, damping = short_bearing_coefficients(JournalBearing(**given), load, speed)
    for letter, ours in (("k", stiffness), ("c", damping)):
        expected = [theirs[f"{letter}{axes}"] for axes in ("xx", "xy", "yx", "yy")]
        np.testing.assert_allclose(ours.ravel(), expected, rtol=1e-6)
    eccentricity, _ = short_bearing_equilibrium(JournalBearing(**given), load, speed)
    np.testing.assert_allclose(eccentricity, theirs["eccentricity"], rtol=1e-6)


@pytest.mark.parametrize(("length", "load"), [(5e-3, 0.3), (2.5e-3, 0.04)])
def test_a_short_film_is_resolved_where_it_ends(length: float, load: float) -> None:
    """L / D = .1 and .05, hardly loaded: Ocvirk's coefficients but for .5 %, what the ends are worth."""
    bearing = JournalBearing(diameter=50e-3, length=length, clearance=60e-6, viscosity=0.03)
    film = converged_equilibrium(bearing, (0.0, -load), 120 * np.pi)
    for ours, closed in zip(
        (film.stiffness, film.damping), short_bearing_coefficients(bearing, load, 120 * np.pi), strict=True
    ):
        assert np.max(np.abs(ours - closed)) < 0.005 * np.max(np.abs(closed))
