"""Settings of ball-bearing and roller-bearing files, and the Hertzian contact behind their stiffness
constant.

K. L. Johnson, Contact Mechanics (1985), eqs. 4.26-4.32; T. A. Harris, Rolling Bearing Analysis (2001),
chapters 2 and 6.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from scipy import special

from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rolling_bearing.loads import DOFS, LOADS, RigidShaft, RollingBearing
from labpipe.records.settings import Settings, choice, integer, quantity, section, setting, text


@dataclass(frozen=True)
class ContactMaterial:
    """An elastic material: Young's modulus E [Pa] and Poisson's ratio."""

    youngs_modulus: float = 206e9
    poissons_ratio: float = 0.3

    def __post_init__(self) -> None:
        if not (0 < self.youngs_modulus < np.inf and -1 < self.poissons_ratio <= 0.5):
            what = "a material needs Young's modulus above zero and Poisson's ratio between -1 and 0.5"
            raise ConfigError(what)

    @property
    def compliance(self) -> float:
        """(1 - nu^2) / E [1/Pa]."""
        return (1 - self.poissons_ratio**2) / self.youngs_modulus


STEEL = ContactMaterial()


@dataclass(frozen=True)
class BallGeometry:
    """Balls between two grooves: ball diameter D, pitch diameter d [m], conformities f = groove radius / D,
    contact angle a0 [rad].

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
                what = f"{name} must lie above 0.5 (a groove as narrow as the ball) and below 2"
                raise SettingError(name, what, "0.52 is usual")

    @property
    def groove_distance(self) -> float:
        """A0 = (f_i + f_o - 1) D [m]: distance of the groove centres at zero contact load. Equation
        (roll-groove-distance).
        """
        return (self.inner_conformity + self.outer_conformity - 1) * self.ball_diameter

    @property
    def groove_centre_radius(self) -> float:
        """r = d/2 + (f_i - 1/2) D cos a0 [m]: radius on which the inner groove's centres lie. Equation
        (roll-groove-radius).
        """
        return self.pitch_diameter / 2 + (self.inner_conformity - 0.5) * self.ball_diameter * float(
            np.cos(self.contact_angle)
        )

    @lru_cache(maxsize=64)  # noqa: B019 (frozen and small; a sweep uses one geometry thousands of times)
    def stiffness_constant(self, rings: ContactMaterial = STEEL, balls: ContactMaterial = STEEL) -> float:
        """K_n [N/m^1.5] of inner and outer contact in series: K_n = (K_i^(-2/3) + K_o^(-2/3))^(-3/2).
        Equation (roll-ball-constant).
        """
        contacts = (
            self._contact(1, self.inner_conformity, rings, balls),
            self._contact(-1, self.outer_conformity, rings, balls),
        )
        return series_constant(contacts, 3 / 2)

    def _contact(self, side: int, conformity: float, rings: ContactMaterial, balls: ContactMaterial) -> float:
        """Contact, *side* +1 inner, -1 outer: 2/D (1 + gamma/(1 - gamma)) along rolling, 2/D - 1/r across."""
        gamma = side * self.ball_diameter * float(np.cos(self.contact_angle)) / self.pitch_diameter
        along = 2 / self.ball_diameter * (1 + gamma / (1 - gamma))
        return point_contact(along, (2 - 1 / conformity) / self.ball_diameter, rings, balls)


def point_contact(
    along: float, across: float, first: ContactMaterial = STEEL, second: ContactMaterial = STEEL
) -> float:
    """K of Q = K delta^1.5 [N/m^1.5] for two bodies whose summed principal curvatures are *along* and
    *across* [1/m]. With k = b/a of the contact ellipse, K and E the complete elliptic integrals of modulus
    sqrt(1 - k^2), rho their summed curvatures: delta = 3 k K / (2 pi E*) (pi E* rho / (3 k E))^(1/3) Q^(2/3),
    1/E* = sum (1 - nu^2)/E. Raises ConfigError for other bodies. Equation (roll-point-contact).
    """
    if not (along > 0 and across > 0):
        hint = "both summed curvatures must be positive"
        raise ConfigError("the bodies do not touch in a point", hint=hint)
    modulus = 1 / (first.compliance + second.compliance)
    k = ellipse_ratio(min(along, across) / max(along, across))
    first_kind, second_kind = float(special.ellipk(1 - k**2)), float(special.ellipe(1 - k**2))
    size = (np.pi * modulus * (along + across) / (3 * k * second_kind)) ** (1 / 3)
    return float((3 * k * first_kind / (2 * np.pi * modulus) * size) ** (-3 / 2))


def ellipse_ratio(curvature_ratio: float) -> float:
    """k = b/a of the contact ellipse from the ratio A/B <= 1 of the curvatures: A/B = R_D(0, k^2, 1) / R_D(0,
    1, k^2) (Carlson). Equation (roll-ellipse).
    """
    if curvature_ratio >= 1:
        return 1.0

    def mismatch(log_k: float) -> float:
        square = np.exp(2 * log_k)
        return float(
            np.log(special.elliprd(0, square, 1) / special.elliprd(0, 1, square)) - np.log(curvature_ratio)
        )

    return float(np.exp(scipy.optimize.brentq(mismatch, -18.0, 0.0, xtol=1e-14)))


def line_contact(length: float) -> float:
    """K of Q = K delta^(10/9) [N/m^(10/9)] for a steel roller of the *length* l [m] on one track: delta =
    3.84e-5 Q^0.9 / l^0.8 in N, mm.

    Palmgren's measured formula, Harris eq. 6.53; it holds for steel only. Equation (roll-line-contact).
    """
    if not length > 0:
        raise ConfigError(f"the roller length must be above zero, found {length:g}")
    return float(((1e3 * length) ** 0.8 * 1e3 / 3.84e-5) ** (10 / 9))


def roller_stiffness_constant(length: float) -> float:
    """K_n [N/m^(10/9)] of a steel roller of the *length* [m] between two tracks."""
    contact = line_contact(length)
    return series_constant((contact, contact), 10 / 9)


def series_constant(constants: tuple[float, ...], exponent: float) -> float:
    """K_n of contacts that carry the same load and add their deflections: K_n = (sum K^(-1/n))^(-n). Equation
    (roll-series).
    """
    return float(sum(constant ** (-1 / exponent) for constant in constants) ** -exponent)


BALL, ROLLER = "ball-bearing", "roller-bearing"
LOAD_OF_DOF = dict(zip(DOFS, LOADS, strict=True))


@dataclass(frozen=True)
class Loads(Settings):
    """Loads of the shaft on the inner ring."""

    x: float | None = quantity("radial load in x", "N", None)
    y: float | None = quantity("radial load in y", "N", None)
    z: float | None = quantity("axial load", "N", None)
    mx: float | None = quantity("moment about x", "N.m", None)
    my: float | None = quantity("moment about y", "N.m", None)


@dataclass(frozen=True)
class Displacements(Settings):
    """Fixed displacements of the inner ring, in place of the load in their direction."""

    x: float | None = quantity("radial displacement in x", "m", None)
    y: float | None = quantity("radial displacement in y", "m", None)
    z: float | None = quantity("axial displacement", "m", None)
    bx: float | None = quantity("tilt about x", "rad", None)
    by: float | None = quantity("tilt about y", "rad", None)


@dataclass(frozen=True, kw_only=True)
class BallGeometrySettings(Settings):
    """Balls and grooves, from which Hertz's theory gives the stiffness constant."""

    ball_diameter: float = quantity("ball diameter D", "m")
    pitch_diameter: float = quantity("diameter of the circle of ball centres", "m")
    inner_conformity: float = quantity("inner groove radius / ball diameter", "1", 0.52)
    outer_conformity: float = quantity("outer groove radius / ball diameter", "1", 0.52)
    youngs_modulus: float = quantity("Young's modulus of the rings", "Pa", STEEL.youngs_modulus)
    poissons_ratio: float = quantity("Poisson's ratio of the rings", "1", STEEL.poissons_ratio)
    ball_youngs_modulus: float | None = quantity(
        "Young's modulus of the balls; default: the rings'", "Pa", None
    )
    ball_poissons_ratio: float | None = quantity(
        "Poisson's ratio of the balls; default: the rings'", "1", None
    )

    @property
    def rings(self) -> ContactMaterial:
        return ContactMaterial(self.youngs_modulus, self.poissons_ratio)

    @property
    def balls(self) -> ContactMaterial:
        modulus, ratio = self.ball_youngs_modulus, self.ball_poissons_ratio
        return ContactMaterial(
            self.rings.youngs_modulus if modulus is None else modulus,
            self.rings.poissons_ratio if ratio is None else ratio,
        )

    def __post_init__(self) -> None:
        self.at(0.0)
        assert self.rings and self.balls

    def at(self, contact_angle: float) -> BallGeometry:
        """The geometry at a contact angle [rad]; ConfigError where it is impossible."""
        return BallGeometry(
            self.ball_diameter,
            self.pitch_diameter,
            self.inner_conformity,
            self.outer_conformity,
            contact_angle,
        )


@dataclass(frozen=True)
class ShaftSettings(Settings):
    """A rigid shaft whose centre of mass is at the bearing's centre, for natural frequencies and the
    theoretical transfer matrix.
    """

    mass: float = quantity("mass of the shaft", "kg")
    inertia_x: float = quantity("moment of inertia about x", "kg.m^2")
    inertia_y: float | None = quantity("moment of inertia about y; default: as about x", "kg.m^2", None)
    band: tuple[float, float] = setting("band", "frequencies of the transfer matrix", "Hz", (5.0, 3000.0))
    lines: int = integer("frequency lines in the band", 1200)

    def __post_init__(self) -> None:
        if self.lines < 2:
            raise ConfigError("lines must be at least 2")
        assert self.body

    @property
    def body(self) -> RigidShaft:
        return RigidShaft(
            self.mass, self.inertia_x, self.inertia_x if self.inertia_y is None else self.inertia_y
        )


@dataclass(frozen=True, kw_only=True)
class RollingSettings(Settings, ABC):
    """Settings common to ball and roller bearings."""

    kind: str = choice("which kind of bearing", (BALL, ROLLER))
    elements: int = integer("number of rolling elements")
    name: str = text("name of the bearing")
    contact_angle: float = quantity("unloaded contact angle", "rad", 0.0)
    clearance: float = quantity(
        "radial clearance, half of ISO 5753's, which is diametral; negative: interference", "m", 0.0
    )
    cage_angle: float = quantity("angle of the first element from x", "rad", 0.0)
    damping_factor: float = quantity("beta of the stiffness-proportional damping C = beta K", "s", 0.0)
    pitch_radius: float | None = quantity("radius of the groove centres (balls) or roller centres", "m", None)
    loads: Loads = section("loads; zero by default", Loads, Loads())
    displacements: Displacements = section("fixed displacements", Displacements, Displacements())

    shaft: ShaftSettings | None = section("a rigid shaft on the bearing", ShaftSettings, None)

    def __post_init__(self) -> None:
        for dof, load in LOAD_OF_DOF.items():
            if getattr(self.displacements, dof) is not None and getattr(self.loads, load) is not None:
                what = f"displacements.{dof} and loads.{load} are both given"
                raise SettingError("displacements", what, "one follows from the other: give one")
        self.require_not_negative("damping_factor")
        self.bearing()

    @property
    def fixed_dofs(self) -> tuple[str, ...]:
        return tuple(dof for dof in LOAD_OF_DOF if getattr(self.displacements, dof) is not None)

    @abstractmethod
    def bearing(self) -> RollingBearing:
        """The bearing; ConfigError for missing or impossible values."""

    @abstractmethod
    def hertz_constant(self) -> float | None:
        """K_n from geometry [N/m^n], None without geometry."""


@dataclass(frozen=True, kw_only=True)
class BallBearingSettings(RollingSettings):
    """A ball bearing: its constants, or the geometry they follow from. An explicit constant takes
    precedence.
    """

    stiffness_constant: float | None = quantity("K_n of Q = K_n delta^1.5", "N/m^1.5", None)
    groove_distance: float | None = quantity("unloaded distance A0 of the groove centres", "m", None)
    geometry: BallGeometrySettings | None = section("balls and grooves", BallGeometrySettings, None)

    def __post_init__(self) -> None:
        super().__post_init__()
        gap = np.sin(np.pi / self.elements)
        if self.geometry and self.geometry.ball_diameter > self.geometry.pitch_diameter * gap:
            balls = f"{self.elements} balls of {1e3 * self.geometry.ball_diameter:g} mm"
            raise SettingError("geometry", f"{balls} do not fit on the pitch circle")

    def bearing(self) -> RollingBearing:
        shape = None if self.geometry is None else self.geometry.at(self.contact_angle)
        return RollingBearing(
            self.elements,
            require_value("stiffness_constant", self.stiffness_constant, self.hertz_constant()),
            require_value(
                "pitch_radius", self.pitch_radius, None if shape is None else shape.groove_centre_radius
            ),
            self.contact_angle,
            self.clearance,
            require_value(
                "groove_distance", self.groove_distance, None if shape is None else shape.groove_distance
            ),
        )

    def hertz_constant(self) -> float | None:
        if self.geometry is None:
            return None
        return self.geometry.at(self.contact_angle).stiffness_constant(
            self.geometry.rings, self.geometry.balls
        )


@dataclass(frozen=True, kw_only=True)
class RollerBearingSettings(RollingSettings):
    """A roller bearing. Tilts (and z at contact angle 0) are fixed at zero where neither load nor
    displacement is given.
    """

    stiffness_constant: float | None = quantity("K_n of Q = K_n delta^(10/9)", "N/m^(10/9)", None)
    roller_length: float | None = quantity("effective length of a steel roller", "m", None)

    @property
    def fixed_dofs(self) -> tuple[str, ...]:
        unsupported = ("bx", "by") if self.contact_angle else ("z", "bx", "by")
        silent = [dof for dof in unsupported if getattr(self.loads, LOAD_OF_DOF[dof]) is None]
        explicit = super().fixed_dofs
        return tuple(dof for dof in LOAD_OF_DOF if dof in explicit or dof in silent)

    def bearing(self) -> RollingBearing:
        derived = self.hertz_constant()
        constant = require_value("stiffness_constant", self.stiffness_constant, derived, "roller_length")
        radius = require_value("pitch_radius", self.pitch_radius, None)
        return RollingBearing(self.elements, constant, radius, self.contact_angle, self.clearance)

    def hertz_constant(self) -> float | None:
        return None if self.roller_length is None else roller_stiffness_constant(self.roller_length)


def require_value(
    name: str, explicit: float | None, derived: float | None, source: str = "geometry"
) -> float:
    """The explicit value, else the derived one; ConfigError where there is neither."""
    amount = derived if explicit is None else explicit
    if amount is None:
        hint = f"give it, or {source} from which it follows" if name != "pitch_radius" else ""
        raise SettingError(name, f"{name}: is missing", hint)
    return amount
