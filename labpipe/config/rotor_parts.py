"""What the entries of a rotor file hold: shaft elements, discs, sleeves, loads, unbalances, materials, damping."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting
from labpipe.rotors.parts import Disc, Material

MOST_COPIES = 1000


@dataclass(frozen=True)
class RotorSettings(Settings):
    """The plain entries of a rotor file (its lists are read by themselves)."""

    speed: float = setting("value", "speed of the shaft, in Hz or rpm", unit="Hz")
    name: str = setting("text", "name of the rotor, as the report shows it", default="")
    description: str = setting("text", "what a reader should know of the rotor", default="")
    force: int = setting("integer", "node on which the rig is excited", default=1)
    response: int = setting("integer", "node at which displacements are measured", default=1)


@dataclass(frozen=True)
class MaterialSettings(Settings):
    """One entry below ``materials:``."""

    density: float = setting("value", "density", unit="kg/m^3")
    elastic_modulus: float = setting("value", "Young's modulus", unit="Pa")
    shear_modulus: float = setting("value", "shear modulus", unit="Pa")
    poisson: float = setting("value", "Poisson's ratio, for the shear coefficient", unit="1", default=0.3)


@dataclass(frozen=True)
class ElementSettings(Settings):
    """One entry of ``elements:``, from left to right."""

    length: float = setting("value", "length", unit="m")
    diameter: float = setting("value", "outer diameter", unit="m")
    inner_diameter: float = setting("value", "bore", unit="m", default=0.0)
    material: str = setting("text", "steel, aluminium or one of materials", default="steel")
    count: int = setting("integer", "equal elements in a row", default=1)

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST_COPIES:
            raise ConfigError(f"count: from 1 to {MOST_COPIES}, not {self.count}")


@dataclass(frozen=True, kw_only=True)
class DiscSettings(Settings):
    """One entry of ``discs:``, by its dimensions and material or by its mass and moments of inertia."""

    node: int = setting("integer", "node it sits on")
    outer_diameter: float | None = setting("value", "outer diameter", unit="m", default=None)
    inner_diameter: float = setting("value", "bore", unit="m", default=0.0)
    length: float | None = setting("value", "length along the shaft", unit="m", default=None)
    material: str = setting("text", "steel, aluminium or one of materials", default="steel")
    mass: float | None = setting("value", "mass, instead of dimensions", unit="kg", default=None)
    polar_inertia: float | None = setting("value", "moment of inertia about the shaft", unit="kg.m^2", default=None)
    transverse_inertia: float | None = setting("value", "moment of inertia about a diameter", unit="kg.m^2", default=None)

    def __post_init__(self) -> None:
        if (self.mass is None) == (self.outer_diameter is None):
            raise ConfigError("one of mass and outer_diameter is needed", hint="a disc is given by its mass, or by its dimensions")
        if self.outer_diameter is not None and self.length is None:
            raise ConfigError("length: is missing", hint="a disc of dimensions needs its length along the shaft")
        if self.mass is not None and None in (self.polar_inertia, self.transverse_inertia):
            raise ConfigError("polar_inertia and transverse_inertia are needed with mass")

    def disc(self, material: Material) -> Disc:
        if self.mass is not None:
            return Disc(self.node, self.mass, self.transverse_inertia or 0.0, self.polar_inertia or 0.0)
        return Disc.of_dimensions(self.node, self.inner_diameter, self.outer_diameter or 0.0, self.length or 0.0, material)


@dataclass(frozen=True)
class SleeveSettings(Settings):
    """One entry of ``sleeves:``: a ring that adds mass and inertia along an element, no stiffness."""

    element: int = setting("integer", "number of the element it surrounds, from 1")
    outer_diameter: float = setting("value", "outer diameter", unit="m")
    material: str = setting("text", "steel, aluminium or one of materials", default="steel")


@dataclass(frozen=True)
class DampingSettings(Settings):
    """Proportional damping of the shaft, C = alpha M + beta K."""

    alpha: float = setting("value", "part of the mass matrix", unit="1/s", default=0.0)
    beta: float = setting("value", "part of the stiffness matrix", unit="s", default=0.0)


@dataclass(frozen=True)
class LoadSettings(Settings):
    """One entry of ``loads:``: a constant force beside the weight."""

    node: int = setting("integer", "node it acts on")
    y: float = setting("value", "horizontal force", unit="N", default=0.0)
    z: float = setting("value", "vertical force, positive up", unit="N", default=0.0)


@dataclass(frozen=True)
class UnbalanceSettings(Settings):
    """One entry of ``unbalances:``."""

    node: int = setting("integer", "node it sits on")
    size: float = setting("value", "mass times eccentricity", unit="kg.m")
    phase: float = setting("value", "phase from the keyphasor, with the spin", unit="rad", default=0.0)
