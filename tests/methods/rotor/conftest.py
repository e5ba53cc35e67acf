"""Rotors that the tests share."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.rotor.shaft import ALUMINIUM, Disc, NodeSupport, Rotor, ShaftElement, Sleeve

MILLIMETRE = 1e-3


@pytest.fixture(scope="session")
def overhung() -> Rotor:
    """A stepped shaft with an overhung disc; our own numbers."""
    shaft = tuple(ShaftElement(0.1, diameter) for diameter in (0.02, 0.03, 0.03, 0.02))
    return Rotor(shaft, (Disc(5, 4.0, 0.02, 0.035), Disc(3, 2.0, 0.004, 0.007)), alpha=0.0, beta=2e-5)


@pytest.fixture(scope="session")
def oil_films() -> tuple[NodeSupport, ...]:
    """Two bearings with cross-coupled stiffness, stable; our own numbers."""
    stiffness = np.array([[2e6, 1e5], [-3e5, 3e6]])
    damping = np.array([[900.0, -100.0], [-100.0, 1400.0]])
    return NodeSupport(1, stiffness, damping), NodeSupport(4, 1.5 * stiffness, damping)


@pytest.fixture(scope="session")
def mendes_rotor() -> Rotor:
    """The rotor of Mendes et al. (2017), tables 1 and 2.

    The two steel rings of the actuator's journal as sleeves on elements 9 and 10.
    """
    table = {
        1: (12, 60),
        2: (12, 60),
        3: (31, 10),
        4: (31, 10),
        9: (30, 40),
        10: (30, 40),
        11: (12, 50),
        12: (12, 50),
    }
    table |= {13: (31, 10), 14: (31, 10), 15: (12, 30)} | dict.fromkeys(range(5, 9), (12, 55))
    shaft = tuple(ShaftElement(table[n][1] * MILLIMETRE, table[n][0] * MILLIMETRE) for n in range(1, 16))
    coupling = Disc.of_dimensions(1, 12 * MILLIMETRE, 25 * MILLIMETRE, 20 * MILLIMETRE, ALUMINIUM)
    return Rotor(shaft, (coupling,), (Sleeve(9, 40 * MILLIMETRE), Sleeve(10, 40 * MILLIMETRE)), beta=1.6e-4)
