"""Hertzian contact of balls and rollers with their raceways: stiffness constant K_n of Q = K_n delta^n from geometry and material.

K. L. Johnson, Contact Mechanics (1985), eqs. 4.26-4.32; T. A. Harris, Rolling Bearing Analysis (2001), chapters 2 and 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import optimize, special

from labpipe.errors import ConfigError


@dataclass(frozen=True)
class Material:
    """An elastic material: Young's modulus E [Pa] and Poisson's ratio."""

    youngs_modulus: float = 206e9
    poissons_ratio: float = 0.3

    def __post_init__(self) -> None:
        if not (0 < self.youngs_modulus < np.inf and -1 < self.poissons_ratio <= 0.5):
            raise ConfigError("a material needs Young's modulus above zero and Poisson's ratio between -1 and 0.5")

    @property
    def compliance(self) -> float:
        """(1 - nu^2) / E [1/Pa]."""
        return (1 - self.poissons_ratio**2) / self.youngs_modulus


STEEL = Material()


@dataclass(frozen=True)
class BallGeometry:
    """Balls between two grooves: ball diameter D, pitch diameter d [m], conformities f = groove radius / D, contact angle a0 [rad].

    Raises ConfigError where the groove is not wider than the ball, or the ball as large as the pitch circle.
    """

    ball_diameter: float
    pitch_diameter: float
    inner_conformity: float = 0.52
    outer_conformity: float = 0.52
    contact_angle: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.ball_diameter < self.pitch_diameter:
            raise ConfigError("the ball diameter must lie between zero and the pitch diameter")
        for name in ("inner_conformity", "outer_conformity"):
            if not 0.5 < getattr(self, name) < 2:
                raise ConfigError(f"{name} must lie above 0.5 (a groove as narrow as the ball) and below 2", hint="0.52 is usual")

    @property
    def groove_distance(self) -> float:
        """A0 = (f_i + f_o - 1) D [m]: distance of the groove centres at zero contact load. Equation (roll-groove-distance)."""
        return (self.inner_conformity + self.outer_conformity - 1) * self.ball_diameter

    @property
    def groove_centre_radius(self) -> float:
        """r = d/2 + (f_i - 1/2) D cos a0 [m]: radius on which the inner groove's centres lie. Equation (roll-groove-radius)."""
        return self.pitch_diameter / 2 + (self.inner_conformity - 0.5) * self.ball_diameter * float(np.cos(self.contact_angle))

    @lru_cache(maxsize=64)  # noqa: B019 (frozen and small; a sweep uses one geometry thousands of times)
    def stiffness_constant(self, rings: Material = STEEL, balls: Material = STEEL) -> float:
        """K_n [N/m^1.5] of inner and outer contact in series: K_n = (K_i^(-2/3) + K_o^(-2/3))^(-3/2). Equation (roll-ball-constant)."""
        contacts = (self._contact(1, self.inner_conformity, rings, balls), self._contact(-1, self.outer_conformity, rings, balls))
        return in_series(contacts, 3 / 2)

    def _contact(self, side: int, conformity: float, rings: Material, balls: Material) -> float:
        """One contact, *side* +1 inner (convex track), -1 outer: curvatures along rolling 2/D (1 + gamma/(1 - gamma)), across 2/D - 1/r."""
        gamma = side * self.ball_diameter * float(np.cos(self.contact_angle)) / self.pitch_diameter
        along = 2 / self.ball_diameter * (1 + gamma / (1 - gamma))
        across = (2 - 1 / conformity) / self.ball_diameter
        return point_contact(along, across, rings, balls)


def point_contact(along: float, across: float, first: Material = STEEL, second: Material = STEEL) -> float:
    """K of Q = K delta^1.5 [N/m^1.5] for two bodies whose summed principal curvatures are *along* and *across* [1/m].

    With k = b/a of the contact ellipse, K and E the complete elliptic integrals of modulus sqrt(1 - k^2), rho their summed curvatures:
    delta = 3 k K / (2 pi E*) (pi E* rho / (3 k E))^(1/3) Q^(2/3), 1/E* = sum (1 - nu^2)/E. Raises ConfigError for other bodies.
    Equation (roll-point-contact).
    """
    if not (along > 0 and across > 0):
        raise ConfigError("the bodies do not touch in a point", hint="both summed curvatures must be positive")
    modulus = 1 / (first.compliance + second.compliance)
    k = ellipse_ratio(min(along, across) / max(along, across))
    first_kind, second_kind = float(special.ellipk(1 - k**2)), float(special.ellipe(1 - k**2))
    per_load = 3 * k * first_kind / (2 * np.pi * modulus) * (np.pi * modulus * (along + across) / (3 * k * second_kind)) ** (1 / 3)
    return float(per_load ** (-3 / 2))


def ellipse_ratio(curvature_ratio: float) -> float:
    """k = b/a of the contact ellipse from the ratio A/B <= 1 of the curvatures: A/B = R_D(0, k^2, 1) / R_D(0, 1, k^2) (Carlson).

    Equation (roll-ellipse).
    """
    if curvature_ratio >= 1:
        return 1.0

    def mismatch(log_k: float) -> float:
        square = np.exp(2 * log_k)
        return float(np.log(special.elliprd(0, square, 1) / special.elliprd(0, 1, square)) - np.log(curvature_ratio))

    return float(np.exp(optimize.brentq(mismatch, -18.0, 0.0, xtol=1e-14)))


def line_contact(length: float) -> float:
    """K of Q = K delta^(10/9) [N/m^(10/9)] for a steel roller of the *length* l [m] on one track: delta = 3.84e-5 Q^0.9 / l^0.8 in N, mm.

    Palmgren's measured formula, Harris eq. 6.53; it holds for steel only. Equation (roll-line-contact).
    """
    if not length > 0:
        raise ConfigError(f"the roller length must be above zero, found {length:g}")
    return float(((1e3 * length) ** 0.8 * 1e3 / 3.84e-5) ** (10 / 9))


def roller_stiffness_constant(length: float) -> float:
    """K_n [N/m^(10/9)] of a steel roller of the *length* [m] between two tracks."""
    contact = line_contact(length)
    return in_series((contact, contact), 10 / 9)


def in_series(constants: tuple[float, ...], exponent: float) -> float:
    """K_n of contacts that carry the same load and add their deflections: K_n = (sum K^(-1/n))^(-n). Equation (roll-series)."""
    return float(sum(constant ** (-1 / exponent) for constant in constants) ** -exponent)
