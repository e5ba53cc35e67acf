"""The rig of Mendes et al. (2017) on healthy bearings at 50 Hz: static loads and modes of an independent
calculation.

Frame: y horizontal, z up, spin y to z. Loads 35.42 and 58.86 N follow from the source's tables (its text
prints 35.38 and 58.82 N); modes 82.57 82.71 Hz (zeta .0455 .0496) and 25.20 25.48 Hz (.226 .346) from an
independent calculation; they are damped frequencies.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.journal_bearing.bearing import JournalBearing, journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import modes
from labpipe.methods.rotor.shaft import (
    ALUMINIUM,
    Disc,
    NodeSupport,
    Rotor,
    ShaftElement,
    Sleeve,
    bearing_loads,
)

SPEED = 2 * np.pi * 50


@pytest.fixture(scope="module")
def rotor() -> Rotor:
    diameters = [12, 12, 31, 31, 12, 12, 12, 12, 30, 30, 12, 12, 31, 31, 12]
    lengths = [60, 60, 10, 10, 55, 55, 55, 55, 40, 40, 50, 50, 10, 10, 30]
    shaft = tuple(
        ShaftElement(length * 1e-3, diameter * 1e-3)
        for length, diameter in zip(lengths, diameters, strict=True)
    )
    coupling = Disc.of_dimensions(1, 12e-3, 25e-3, 20e-3, ALUMINIUM)
    return Rotor(shaft, (coupling,), (Sleeve(9, 40e-3), Sleeve(10, 40e-3)), beta=1.6e-4)


def test_static_loads(rotor: Rotor) -> None:
    loads = bearing_loads(rotor, [4, 14], {10: (0.0, -80.0)})
    np.testing.assert_allclose(loads[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(loads[:, 1], [-35.42, -58.86], atol=0.05)


def test_modes_on_healthy_bearings(rotor: Rotor) -> None:
    """On a fine film, frequencies within .05 Hz, damping ratios within 2 %.

    The shipped rig itself is in the validation manual.
    """
    bearing = JournalBearing(diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044)
    supports = []
    for node, load in zip((4, 14), bearing_loads(rotor, [4, 14], {10: (0.0, -80.0)}), strict=True):
        equilibrium = journal_equilibrium(bearing, (float(load[0]), float(load[1])), SPEED, FilmMesh(480, 60))
        supports.append(NodeSupport(node, equilibrium.stiffness, equilibrium.damping))
    found = modes(rotor, supports, SPEED)
    frequency, ratio = found.eigenvalues.imag / (2 * np.pi), found.damping_ratio
    oscillating = (frequency > 10) & (frequency < 100) & (ratio < 0.5)
    np.testing.assert_allclose(frequency[oscillating], [25.20, 25.48, 82.57, 82.71], atol=0.05)
    np.testing.assert_allclose(ratio[oscillating], [0.226, 0.346, 0.0455, 0.0496], rtol=0.02)
