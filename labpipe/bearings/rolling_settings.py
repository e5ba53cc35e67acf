"""Settings of ball-bearing and roller-bearing files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from labpipe.bearings.hertz import STEEL, BallGeometry, Material, roller_stiffness_constant
from labpipe.bearings.rolling import RollingBearing
from labpipe.bearings.rolling_shaft import RigidShaft
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting

BALL, ROLLER = "ball-bearing", "roller-bearing"
LOAD_OF_DOF = {"x": "x", "y": "y", "z": "z", "bx": "mx", "by": "my"}


@dataclass(frozen=True)
class Loads(Settings):
    """Loads of the shaft on the inner ring."""

    x: float | None = setting("value", "radial load in x", unit="N", default=None)
    y: float | None = setting("value", "radial load in y", unit="N", default=None)
    z: float | None = setting("value", "axial load", unit="N", default=None)
    mx: float | None = setting("value", "moment about x", unit="N.m", default=None)
    my: float | None = setting("value", "moment about y", unit="N.m", default=None)


@dataclass(frozen=True)
class Displacements(Settings):
    """Fixed displacements of the inner ring, in place of the load in their direction."""

    x: float | None = setting("value", "radial displacement in x", unit="m", default=None)
    y: float | None = setting("value", "radial displacement in y", unit="m", default=None)
    z: float | None = setting("value", "axial displacement", unit="m", default=None)
    bx: float | None = setting("value", "tilt about x", unit="rad", default=None)
    by: float | None = setting("value", "tilt about y", unit="rad", default=None)


@dataclass(frozen=True, kw_only=True)
class BallGeometrySettings(Settings):
    """Balls and grooves, from which Hertz's theory gives the stiffness constant."""

    ball_diameter: float = setting("value", "ball diameter D", unit="m")
    pitch_diameter: float = setting("value", "diameter of the circle of ball centres", unit="m")
    inner_conformity: float = setting("value", "inner groove radius / ball diameter", unit="1", default=0.52)
    outer_conformity: float = setting("value", "outer groove radius / ball diameter", unit="1", default=0.52)
    youngs_modulus: float = setting("value", "Young's modulus of the rings", unit="Pa", default=STEEL.youngs_modulus)
    poissons_ratio: float = setting("value", "Poisson's ratio of the rings", unit="1", default=STEEL.poissons_ratio)
    ball_youngs_modulus: float | None = setting("value", "Young's modulus of the balls; default: the rings'", unit="Pa", default=None)
    ball_poissons_ratio: float | None = setting("value", "Poisson's ratio of the balls; default: the rings'", unit="1", default=None)

    @property
    def rings(self) -> Material:
        return Material(self.youngs_modulus, self.poissons_ratio)

    @property
    def balls(self) -> Material:
        modulus, ratio = self.ball_youngs_modulus, self.ball_poissons_ratio
        return Material(self.rings.youngs_modulus if modulus is None else modulus, self.rings.poissons_ratio if ratio is None else ratio)

    def __post_init__(self) -> None:
        self.at(0.0)
        assert self.rings and self.balls

    def at(self, contact_angle: float) -> BallGeometry:
        """The geometry at a contact angle [rad]; ConfigError where it is impossible."""
        return BallGeometry(self.ball_diameter, self.pitch_diameter, self.inner_conformity, self.outer_conformity, contact_angle)


@dataclass(frozen=True)
class ShaftSettings(Settings):
    """A rigid shaft whose centre of mass is at the bearing's centre, for natural frequencies and the theoretical transfer matrix."""

    mass: float = setting("value", "mass of the shaft", unit="kg")
    inertia_x: float = setting("value", "moment of inertia about x", unit="kg.m^2")
    inertia_y: float | None = setting("value", "moment of inertia about y; default: as about x", unit="kg.m^2", default=None)
    band: tuple[float, float] = setting("band", "frequencies of the transfer matrix", unit="Hz", default=(5.0, 3000.0))
    lines: int = setting("integer", "frequency lines in the band", default=1200)

    def __post_init__(self) -> None:
        if self.lines < 2:
            raise ConfigError("lines must be at least 2")
        assert self.body

    @property
    def body(self) -> RigidShaft:
        return RigidShaft(self.mass, self.inertia_x, self.inertia_x if self.inertia_y is None else self.inertia_y)


@dataclass(frozen=True, kw_only=True)
class RollingSettings(Settings, ABC):
    """Settings common to ball and roller bearings."""

    kind: str = setting("choice", "which kind of bearing", choices=(BALL, ROLLER))
    elements: int = setting("integer", "number of rolling elements")
    name: str = setting("text", "name of the bearing", default="")
    contact_angle: float = setting("value", "unloaded contact angle", unit="rad", default=0.0)
    clearance: float = setting("value", "radial clearance, half the diametral one; negative: interference", unit="m", default=0.0)
    cage_angle: float = setting("value", "angle of the first element from x", unit="rad", default=0.0)
    damping_factor: float = setting("value", "beta of the stiffness-proportional damping C = beta K", unit="s", default=0.0)
    pitch_radius: float | None = setting("value", "radius of the groove centres (balls) or roller centres", unit="m", default=None)
    loads: Loads = setting("section", "loads; zero by default", section=Loads, default=Loads())
    displacements: Displacements = setting("section", "fixed displacements", section=Displacements, default=Displacements())

    shaft: ShaftSettings | None = setting("section", "a rigid shaft on the bearing", section=ShaftSettings, default=None)

    def __post_init__(self) -> None:
        for dof, load in LOAD_OF_DOF.items():
            if getattr(self.displacements, dof) is not None and getattr(self.loads, load) is not None:
                raise ConfigError(f"displacements.{dof} and loads.{load} are both given", hint="one follows from the other: give one")
        if self.damping_factor < 0:
            raise ConfigError("damping_factor is negative")
        self.bearing()

    @property
    def fixed_dofs(self) -> tuple[str, ...]:
        """The dofs with given displacement."""
        return tuple(dof for dof in LOAD_OF_DOF if getattr(self.displacements, dof) is not None)

    @abstractmethod
    def bearing(self) -> RollingBearing:
        """The bearing; ConfigError for missing or impossible values."""

    @abstractmethod
    def hertz_constant(self) -> float | None:
        """K_n from geometry [N/m^n], None without geometry."""


@dataclass(frozen=True, kw_only=True)
class BallBearingSettings(RollingSettings):
    """A ball bearing: its constants, or the geometry they follow from; an explicit constant takes precedence."""

    stiffness_constant: float | None = setting("value", "K_n of Q = K_n delta^1.5", unit="N/m^1.5", default=None)
    groove_distance: float | None = setting("value", "unloaded distance A0 of the groove centres", unit="m", default=None)
    geometry: BallGeometrySettings | None = setting("section", "balls and grooves", section=BallGeometrySettings, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.geometry and self.geometry.ball_diameter > self.geometry.pitch_diameter * np.sin(np.pi / self.elements):
            raise ConfigError(f"{self.elements} balls of {1e3 * self.geometry.ball_diameter:g} mm do not fit on the pitch circle")

    def bearing(self) -> RollingBearing:
        shape = None if self.geometry is None else self.geometry.at(self.contact_angle)
        return RollingBearing(
            self.elements,
            needed("stiffness_constant", self.stiffness_constant, self.hertz_constant()),
            needed("pitch_radius", self.pitch_radius, None if shape is None else shape.groove_centre_radius),
            self.contact_angle,
            self.clearance,
            needed("groove_distance", self.groove_distance, None if shape is None else shape.groove_distance),
        )

    def hertz_constant(self) -> float | None:
        if self.geometry is None:
            return None
        return self.geometry.at(self.contact_angle).stiffness_constant(self.geometry.rings, self.geometry.balls)


@dataclass(frozen=True, kw_only=True)
class RollerBearingSettings(RollingSettings):
    """A roller bearing; tilts (and z at contact angle 0) are fixed at zero where neither load nor displacement is given."""

    stiffness_constant: float | None = setting("value", "K_n of Q = K_n delta^(10/9)", unit="N/m^(10/9)", default=None)
    roller_length: float | None = setting("value", "effective length of a steel roller", unit="m", default=None)

    @property
    def fixed_dofs(self) -> tuple[str, ...]:
        unsupported = ("bx", "by") if self.contact_angle else ("z", "bx", "by")
        silent = [dof for dof in unsupported if getattr(self.loads, LOAD_OF_DOF[dof]) is None]
        explicit = super().fixed_dofs
        return tuple(dof for dof in LOAD_OF_DOF if dof in explicit or dof in silent)

    def bearing(self) -> RollingBearing:
        constant = needed("stiffness_constant", self.stiffness_constant, self.hertz_constant(), "roller_length")
        return RollingBearing(self.elements, constant, needed("pitch_radius", self.pitch_radius, None), self.contact_angle, self.clearance)

    def hertz_constant(self) -> float | None:
        return None if self.roller_length is None else roller_stiffness_constant(self.roller_length)


def needed(name: str, explicit: float | None, derived: float | None, source: str = "geometry") -> float:
    """The explicit value, else the derived one; ConfigError where there is neither."""
    amount = derived if explicit is None else explicit
    if amount is None:
        raise ConfigError(f"{name}: is missing", hint=f"give it, or {source} from which it follows" if name != "pitch_radius" else "")
    return amount
