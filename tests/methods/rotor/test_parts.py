"""Shaft elements, discs and sleeves: dimensions to mass and inertia, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.rotor.shaft import (
    ALUMINIUM,
    STEEL,
    Disc,
    Material,
    NodeSupport,
    Rotor,
    ShaftElement,
    Sleeve,
)


def test_tube_by_hand() -> None:
    tube = ShaftElement(0.1, 0.04, inner_diameter=0.03)
    np.testing.assert_allclose(tube.area, np.pi / 4 * 7e-4)
    np.testing.assert_allclose(tube.second_moment, np.pi / 64 * (2.56e-6 - 8.1e-7))


def test_shear_coefficients_known_from_tables() -> None:
    """Cowper (1966), nu = .3: solid .8864, thin tube 2 (1 + nu) / (4 + 3 nu) = .5306."""
    np.testing.assert_allclose(ShaftElement(0.1, 0.02).shear_coefficient, 0.8864, atol=1e-4)
    np.testing.assert_allclose(
        ShaftElement(0.1, 0.02, inner_diameter=0.02 * (1 - 1e-9)).shear_coefficient, 2.6 / 4.9, atol=1e-6
    )


def test_disc_of_dimensions_by_hand() -> None:
    """2700 * pi/4 * (25^2 - 12^2) mm2 * 20 mm = 20.40 g; I_p = m/8 (D^2 + d^2)."""
    disc = Disc.of_dimensions(1, 0.012, 0.025, 0.02, ALUMINIUM)
    np.testing.assert_allclose(disc.mass, 0.020400, rtol=1e-4)
    np.testing.assert_allclose(disc.polar_inertia, disc.mass * (0.025**2 + 0.012**2) / 8)
    np.testing.assert_allclose(disc.transverse_inertia, disc.polar_inertia / 2 + disc.mass * 0.02**2 / 12)


def test_a_sleeve_is_a_tube_around_its_element() -> None:
    tube = Sleeve(1, 0.04, ALUMINIUM).tube(ShaftElement(0.1, 0.03))
    assert (tube.inner_diameter, tube.outer_diameter, tube.length, tube.material) == (
        0.03,
        0.04,
        0.1,
        ALUMINIUM,
    )


def test_dofs_of_nodes_numbered_from_one() -> None:
    rotor = Rotor((ShaftElement(0.1, 0.02),))
    assert rotor.dofs(1) == [0, 1]
    assert rotor.dofs(2) == [4, 5]
    with pytest.raises(ConfigError, match="node 3, the rotor has nodes 1 to 2"):
        rotor.dofs(3)


SHAFT = (ShaftElement(0.1, 0.02),)


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: Material(0.0, 2e11, 8e10), "density of a material"),
        (lambda: ShaftElement(-0.1, 0.02), "length of a shaft element"),
        (lambda: ShaftElement(0.1, 0.02, inner_diameter=0.02), "bore"),
        (lambda: ShaftElement(0.1, 40e-9), "0.1 m length has a diameter of 4e-08 m"),
        (lambda: Disc(1, 0.0, 1.0, 1.0), "mass of a disc"),
        (lambda: Disc(1, 1.0, -1.0, 1.0), "negative moment"),
        (lambda: Disc.of_dimensions(2, 0.05, 0.04, 0.01, STEEL), "disc on node 2 has a bore"),
        (lambda: NodeSupport(1, np.eye(3), np.eye(2)), "2 x 2"),
        (lambda: NodeSupport(1, np.eye(2), np.full((2, 2), np.nan)), "2 x 2 finite"),
        (lambda: Rotor(()), "at least one shaft element"),
        (lambda: Rotor(SHAFT, alpha=-1.0), "cannot be negative"),
        (lambda: Rotor(SHAFT, (Disc(3, 1.0, 1.0, 1.0),)), "disc sits on node 3"),
        (lambda: Rotor(SHAFT, sleeves=(Sleeve(2, 0.04),)), "sleeve sits on element 2"),
        (lambda: Rotor(SHAFT, sleeves=(Sleeve(1, 0.01),)), "bore"),
    ],
)
def test_parts_that_cannot_be_are_refused(build, said: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match=said):
        build()
