"""K_n from geometry: closed forms, an independent quadrature of Hertz's integrals, and the printed constant
of the 6208.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate

from labpipe.errors import ConfigError
from labpipe.methods.rolling_bearing.settings import (
    STEEL,
    BallGeometry,
    ContactMaterial,
    ellipse_ratio,
    line_contact,
    point_contact,
    roller_stiffness_constant,
    series_constant,
)


def test_two_spheres_in_closed_form() -> None:
    """Q = 4/3 E* sqrt(R) delta^1.5; the principal curvatures of a sphere on a plane are both 1/R."""
    modulus = 206e9 / (2 * (1 - 0.3**2))
    assert point_contact(1 / 5e-3, 1 / 5e-3) == pytest.approx(4 / 3 * modulus * math.sqrt(5e-3), rel=1e-12)


@pytest.mark.parametrize("k", [0.9, 0.3, 0.1, 0.03])
def test_ellipses_against_the_integrals_of_hertz(k: float) -> None:
    """Pressure on an ellipse b = k a: the potential's integrals over s from 0 to infinity (Johnson
    3.57-3.59), by quadrature.

    Displacement w = p0 a b / (2 E*) int (1 - x^2/(a^2+s) - y^2/(b^2+s)) ds / sqrt((a^2+s)(b^2+s) s); a = 1,
    E* = 1, p0 = 1.
    """

    def integral(weight) -> float:  # type: ignore[no-untyped-def]
        inner = integrate.quad(
            lambda t: 2 * weight(t**2) / math.sqrt((1 + t**2) * (k**2 + t**2)),
            0,
            np.inf,
            epsabs=0,
            epsrel=1e-11,
        )
        return inner[0]

    approach = k / 2 * integral(lambda s: 1.0)
    along, across = k * integral(lambda s: 1 / (1 + s)), k * integral(lambda s: 1 / (k**2 + s))
    load = 2 / 3 * math.pi * k
    unit = ContactMaterial(2 * (1 - 0.3**2), 0.3)
    assert ellipse_ratio(along / across) == pytest.approx(k, rel=1e-8)
    assert point_contact(along, across, unit, unit) == pytest.approx(load / approach**1.5, rel=1e-8)


def test_the_order_of_curvatures_and_bodies_does_not_matter() -> None:
    ceramic = ContactMaterial(310e9, 0.26)
    assert point_contact(300, 7, STEEL, ceramic) == pytest.approx(
        point_contact(7, 300, ceramic, STEEL), rel=1e-14
    )


def test_the_6208_from_its_geometry() -> None:
    """Ball 15/32 in, pitch 60 mm, conformities .5125 and .5375 give all three constants that Knaapen prints:
    A0 .5953 mm, r 30.1488 mm, K_n 1.10e10 N/m^1.5 (three digits).
    """
    geometry = BallGeometry(11.90625e-3, 60e-3, 0.5125, 0.5375)
    assert geometry.groove_distance == pytest.approx(5.953e-4, rel=1e-4)
    assert geometry.groove_centre_radius == pytest.approx(30.1488e-3, rel=1e-6)
    assert geometry.stiffness_constant() == pytest.approx(1.10e10, rel=5e-3)


def test_inner_and_outer_contact_add_their_deflections() -> None:
    geometry = BallGeometry(10e-3, 50e-3, contact_angle=math.radians(25))
    gamma = 10 / 50 * math.cos(math.radians(25))
    across = (2 - 1 / 0.52) / 10e-3
    inner, outer = (point_contact(2 / 10e-3 * (1 + g / (1 - g)), across) for g in (gamma, -gamma))
    deflection = (1 / inner) ** (2 / 3) + (1 / outer) ** (2 / 3)
    assert geometry.stiffness_constant() == pytest.approx(deflection**-1.5, rel=1e-12)


def test_stiffer_balls_and_size() -> None:
    """K scales with the modulus and with the square root of the size."""
    geometry, twice = BallGeometry(10e-3, 50e-3), BallGeometry(20e-3, 100e-3)
    assert twice.stiffness_constant() == pytest.approx(
        math.sqrt(2) * geometry.stiffness_constant(), rel=1e-12
    )
    double = ContactMaterial(412e9, 0.3)
    assert geometry.stiffness_constant(double, double) == pytest.approx(
        2 * geometry.stiffness_constant(), rel=1e-12
    )
    assert geometry.stiffness_constant(balls=ContactMaterial(310e9, 0.26)) > geometry.stiffness_constant()


def test_rollers_after_palmgren() -> None:
    """1000 N on a 10 mm roller: delta = 3.84e-5 * 1000^0.9 / 10^0.8 mm on one track, twice that between
    two.
    """
    delta = 3.84e-5 * 1000**0.9 / 10**0.8 * 1e-3
    assert line_contact(10e-3) * delta ** (10 / 9) == pytest.approx(1000, rel=1e-12)
    assert roller_stiffness_constant(10e-3) * (2 * delta) ** (10 / 9) == pytest.approx(1000, rel=1e-12)
    assert series_constant((3.0,), 1.5) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: BallGeometry(60e-3, 50e-3),
            "the ball diameter must lie between zero and the pitch diameter",
        ),
        (lambda: BallGeometry(10e-3, 50e-3, inner_conformity=0.5), "inner_conformity must lie above 0.5"),
        (lambda: ContactMaterial(-1.0), "Young's modulus above zero"),
        (lambda: point_contact(100, -1), "do not touch in a point"),
        (lambda: line_contact(0.0), "the roller length must be above zero"),
    ],
)
def test_impossible_bodies_are_refused(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match=message):
        make()
