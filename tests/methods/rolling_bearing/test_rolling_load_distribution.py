"""How a load spreads over the elements: the constants of Stribeck and Sjovall as manufacturers print them.

Source: NSK, Technical Report E728g, section 5.1: Q_max = 4.37 F_r / (Z cos a) for balls and 4.08 F_r / (Z cos
a) for rollers when half of the circumference is loaded (epsilon = 0.5), which needs F_a = 1.216 F_r tan a
(balls) or 1.260 F_r tan a (rollers) in a bearing with a contact angle; Q = F_a / (Z sin a) for a purely axial
load. Frame: rings parallel (tilts held). The printed constants are integrals over many elements at a fixed
contact angle; the load zone's edge gives epsilon. The constants themselves and Harris's integrals are rows of
the validation manual (tests/validation/rolling.py); 1.260 belongs to an exponent of 1.1, where this model's
10/9 gives 1.2573.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from labpipe.methods.rolling_bearing.equilibrium import Equilibrium, equilibrium
from labpipe.methods.rolling_bearing.loads import RollingBearing
from tests.methods.rolling_bearing.displaced_rings import load_vector

PARALLEL = ("bx", "by")
ANGLE = math.radians(25)
# A groove distance that is very large against the deflection keeps the balls' contact angle, as the printed
# constants assume.
BALLS = RollingBearing(60, 1e10, 0.1, ANGLE, groove_distance=0.05)
ROLLERS = RollingBearing(60, 1e9, 0.1, ANGLE)


def half_loaded(bearing: RollingBearing) -> Equilibrium:
    """dx cos a = dz sin a: delta = dx cos a (1 + cos psi) is epsilon = 1; dz = 0 is epsilon = 0.5."""
    return equilibrium(bearing, displacements=[1e-5, 0, 0, 0, 0], fixed_dofs=("x", "y", "z", *PARALLEL))


@pytest.mark.parametrize("bearing", [BALLS, ROLLERS], ids=["point contact", "line contact"])
def test_the_loads_that_were_found_bring_the_displacement_back(bearing: RollingBearing) -> None:
    """Forces instead of displacements: the same load zone from F_a = 1.216 (1.260) F_r tan a."""
    there = half_loaded(bearing)
    back = equilibrium(bearing, there.load, fixed_dofs=PARALLEL)
    np.testing.assert_allclose(back.displacement, there.displacement, atol=1e-12)


@pytest.mark.parametrize(
    ("bearing", "greatest"), [(BALLS, 4.37), (ROLLERS, 4.08)], ids=["point contact", "line contact"]
)
def test_radial_bearing_without_clearance(bearing: RollingBearing, greatest: float) -> None:
    """Contact angle 0, no clearance: half of the circumference carries a radial load."""
    radial = RollingBearing(60, bearing.stiffness_constant, 0.1, groove_distance=bearing.groove_distance)
    state = equilibrium(radial, load_vector(x=1000.0), fixed_dofs=("z", *PARALLEL))
    assert state.contacts.load.max() == pytest.approx(greatest * 1000 / 60, abs=0.006 * 1000 / 60)


@pytest.mark.parametrize("bearing", [BALLS, ROLLERS], ids=["point contact", "line contact"])
def test_axial_load_is_shared_alike(bearing: RollingBearing) -> None:
    state = equilibrium(bearing, load_vector(z=6000.0), fixed_dofs=PARALLEL)
    np.testing.assert_allclose(state.contacts.load, 6000 / (60 * np.sin(state.contact_angle)), rtol=1e-9)


def test_clearance_narrows_the_load_zone_and_raises_its_peak() -> None:
    """epsilon = (1 - clearance / displacement) / 2: the edge of the zone lies where dx cos psi =
    clearance.
    """
    rollers = RollingBearing(60, 1e9, 0.1, clearance=1e-5)
    state = equilibrium(rollers, load_vector(x=1000.0), fixed_dofs=("z", *PARALLEL))
    dx = state.displacement[0, 0]
    inside = np.cos(state.angles[0]) > 1e-5 / dx
    np.testing.assert_array_equal(state.contacts.load[0] > 0, inside)
    tight = equilibrium(RollingBearing(60, 1e9, 0.1), load_vector(x=1000.0), fixed_dofs=("z", *PARALLEL))
    assert state.contacts.load.max() > 1.1 * tight.contacts.load.max() and np.sum(inside) < 30
