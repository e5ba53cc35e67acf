"""Parts of a rotor: shaft elements, discs, sleeves and supports. Nodes are numbered from 1, as in rig descriptions.

Axes: x along the shaft, y horizontal, z up, spin from y to z. Every node has y, z and the rotations about y and z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError


def _refuse_unless_positive(what: str, part: object, names: tuple[str, ...]) -> None:
    for name in names:
        if not 0 < getattr(part, name) < np.inf:
            raise ConfigError(f"the {name.replace('_', ' ')} of a {what} is positive, not {getattr(part, name):g}")


def _refuse_bore(what: str, inner: float, outer: float) -> None:
    if not 0 <= inner < outer:
        raise ConfigError(f"the {what} has a bore of {inner:g} m in a diameter of {outer:g} m")


@dataclass(frozen=True)
class Material:
    """density [kg/m3], elastic and shear modulus [Pa]; Poisson's ratio enters the shear coefficient only."""

    density: float
    elastic_modulus: float
    shear_modulus: float
    poisson: float = 0.3

    def __post_init__(self) -> None:
        _refuse_unless_positive("material", self, ("density", "elastic_modulus", "shear_modulus"))


STEEL = Material(7800.0, 2.1e11, 0.796e11)
ALUMINIUM = Material(2700.0, 0.7e11, 0.27e11)


@dataclass(frozen=True)
class ShaftElement:
    """A cylindrical piece of shaft between two nodes: diameters and length [m]."""

    length: float
    outer_diameter: float
    material: Material = STEEL
    inner_diameter: float = 0.0

    def __post_init__(self) -> None:
        _refuse_unless_positive("shaft element", self, ("length", "outer_diameter"))
        _refuse_bore("shaft element", self.inner_diameter, self.outer_diameter)

    @property
    def area(self) -> float:
        """Cross-section [m2]."""
        return np.pi / 4 * (self.outer_diameter**2 - self.inner_diameter**2)

    @property
    def second_moment(self) -> float:
        """Second moment of area about a diameter [m4]."""
        return np.pi / 64 * (self.outer_diameter**4 - self.inner_diameter**4)

    @property
    def shear_coefficient(self) -> float:
        """kappa of a circular tube (Cowper 1966); 6 (1 + nu) / (7 + 6 nu) for a solid shaft. Equation (rotor-cowper)."""
        nu, bore = self.material.poisson, (self.inner_diameter / self.outer_diameter) ** 2
        return 6 * (1 + nu) * (1 + bore) ** 2 / ((7 + 6 * nu) * (1 + bore) ** 2 + (20 + 12 * nu) * bore)

    @property
    def shear_parameter(self) -> float:
        """Phi = 12 E I / (kappa G A l^2): zero for a slender (Euler-Bernoulli) element. Equation (rotor-shear)."""
        bending = 12 * self.material.elastic_modulus * self.second_moment
        return bending / (self.shear_coefficient * self.material.shear_modulus * self.area * self.length**2)


@dataclass(frozen=True)
class Disc:
    """A rigid disc on a node: mass [kg], transverse and polar moment of inertia [kg m2]."""

    node: int
    mass: float
    transverse_inertia: float
    polar_inertia: float

    def __post_init__(self) -> None:
        _refuse_unless_positive("disc", self, ("mass",))
        if min(self.transverse_inertia, self.polar_inertia) < 0:
            raise ConfigError(f"the disc on node {self.node} has a negative moment of inertia")

    @classmethod
    def of_dimensions(cls, node: int, inner_diameter: float, outer_diameter: float, length: float, material: Material) -> Disc:
        """A hollow cylinder: m = rho pi/4 (D^2 - d^2) l, I_p = m/8 (D^2 + d^2), I_t = I_p/2 + m l^2/12. Equation (rotor-disc)."""
        _refuse_bore(f"disc on node {node}", inner_diameter, outer_diameter)
        mass = material.density * np.pi / 4 * (outer_diameter**2 - inner_diameter**2) * length
        polar = mass / 8 * (outer_diameter**2 + inner_diameter**2)
        return cls(node, mass, polar / 2 + mass * length**2 / 12, polar)


@dataclass(frozen=True)
class Sleeve:
    """A ring over the whole length of shaft element *element* (from 1) that adds mass and inertia but no stiffness."""

    element: int
    outer_diameter: float
    material: Material = STEEL

    def tube(self, shaft: ShaftElement) -> ShaftElement:
        """The ring as a tube around its shaft element."""
        return ShaftElement(shaft.length, self.outer_diameter, self.material, shaft.outer_diameter)


@dataclass(frozen=True)
class Support:
    """A bearing on a node: stiffness [N/m] and damping [N s/m], (2, 2) in y and z, `k_yz` = force in y per displacement in z."""

    node: int
    stiffness: FloatArray
    damping: FloatArray

    def __post_init__(self) -> None:
        for matrix in (self.stiffness, self.damping):
            if np.shape(matrix) != (2, 2) or not np.all(np.isfinite(matrix)):
                raise ConfigError(f"the bearing on node {self.node} needs 2 x 2 finite coefficients")


@dataclass(frozen=True)
class Rotor:
    """Shaft elements from left to right, discs, sleeves, and the shaft's proportional damping C = alpha M + beta K, [1/s] and [s].

    ConfigError for a disc on a node, or a sleeve on an element, that does not exist.
    """

    elements: tuple[ShaftElement, ...]
    discs: tuple[Disc, ...] = ()
    sleeves: tuple[Sleeve, ...] = ()
    alpha: float = 0.0
    beta: float = 0.0

    def __post_init__(self) -> None:
        # Scripts give lists; the matrices of a rotor are found again by what it holds.
        for name in ("elements", "discs", "sleeves"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.elements:
            raise ConfigError("a rotor needs at least one shaft element")
        if min(self.alpha, self.beta) < 0:
            raise ConfigError("proportional damping cannot be negative", hint="give alpha and beta of zero or more")
        for disc in self.discs:
            self.check_node(disc.node, "a disc")
        for sleeve in self.sleeves:
            if not 1 <= sleeve.element <= len(self.elements):
                raise ConfigError(f"a sleeve sits on element {sleeve.element}, the rotor has elements 1 to {len(self.elements)}")
            sleeve.tube(self.elements[sleeve.element - 1])

    @property
    def n_node(self) -> int:
        return len(self.elements) + 1

    def check_node(self, node: int, what: str) -> None:
        """ConfigError unless the node exists."""
        if not 1 <= node <= self.n_node:
            raise ConfigError(f"{what} sits on node {node}, the rotor has nodes 1 to {self.n_node}")

    def dofs(self, node: int) -> list[int]:
        """Indices of the degrees of freedom y and z of a node; ConfigError for a node that does not exist."""
        self.check_node(node, "a degree of freedom")
        return [4 * (node - 1), 4 * (node - 1) + 1]
