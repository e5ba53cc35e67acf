"""Onset speed of a rigid rotor on two equal journal bearings against Lund's closed form; short-bearing and finite-film coefficients.

Lund's threshold for one journal with half the mass m: k_e = (k_yy c_zz + k_zz c_yy - k_yz c_zy - k_zy c_yz) / (c_yy + c_zz),
whirl frequency w^2 = ((k_yy - k_e)(k_zz - k_e) - k_yz k_zy) / (c_yy c_zz - c_yz c_zy), unstable when m > k_e / w^2. Frame of the bearings.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq

from labpipe.bearings.journal import JournalBearing, journal_equilibrium
from labpipe.bearings.journal_mesh import FilmMesh
from labpipe.bearings.journal_short import short_bearing_coefficients
from labpipe.rotors.assembly import bearing_loads, free_rotor
from labpipe.rotors.modes import growth_rate, onset_speed
from labpipe.rotors.parts import Disc, Material, Rotor, ShaftElement, Support

STIFF = Material(7800.0, 1e16, 4e15)
ROTOR = Rotor((ShaftElement(0.2, 0.05, STIFF), ShaftElement(0.2, 0.05, STIFF)), (Disc(2, 20.0, 0.05, 0.08),))
BEARING = JournalBearing(diameter=0.05, length=0.0125, clearance=80e-6, viscosity=0.02)
Coefficients = Callable[[float], tuple[np.ndarray, np.ndarray]]


def weight() -> float:
    return -float(bearing_loads(ROTOR, [1, 3])[0, 1])


def short(speed: float) -> tuple[np.ndarray, np.ndarray]:
    return short_bearing_coefficients(BEARING, weight(), speed)


def finite(speed: float) -> tuple[np.ndarray, np.ndarray]:
    equilibrium = journal_equilibrium(BEARING, (0.0, -weight()), speed, FilmMesh(120, 12))
    return equilibrium.stiffness, equilibrium.damping


def lund_margin(coefficients: Coefficients, speed: float, mass: float) -> float:
    """m w^2 / k_e - 1: positive means unstable."""
    k, c = coefficients(speed)
    k_e = (k[0, 0] * c[1, 1] + k[1, 1] * c[0, 0] - k[0, 1] * c[1, 0] - k[1, 0] * c[0, 1]) / (c[0, 0] + c[1, 1])
    whirl = ((k[0, 0] - k_e) * (k[1, 1] - k_e) - k[0, 1] * k[1, 0]) / (c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0])
    return float(mass * whirl / k_e - 1)


@pytest.mark.parametrize("coefficients", [short, finite])
def test_onset_speed_is_lunds(coefficients: Coefficients) -> None:
    """Within .05 %; the conical mode of this rotor is the more stable one."""
    shift = np.tile([1.0, 0, 0, 0], ROTOR.n_node)
    mass = float(shift @ free_rotor(ROTOR).mass @ shift) / 2
    expected = brentq(lambda speed: lund_margin(coefficients, speed, mass), 100, 2000)

    def supports(speed: float) -> list[Support]:
        k, c = coefficients(speed)
        return [Support(1, k, c), Support(3, k, c)]

    found = onset_speed(ROTOR, supports, np.linspace(100, 2000, 12))
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=5e-4)
    assert growth_rate(ROTOR, supports(0.95 * found), 0.95 * found) < 0
