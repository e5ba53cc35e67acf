"""Rotors of Timoshenko shaft elements, discs, sleeves and supports: their matrices M q'' + (C + Omega G) q' +
K q = F.

Nodes are numbered from 1, as in rig descriptions.

Axes: x along the shaft, y horizontal, z up, spin from y to z. Every node has y, z and the rotations about y
and z.

One bending plane has w and its rotation at both ends, (w1, r1, w2, r2); with xi = x / l and the shear
parameter Phi the deflection is N(xi) and the rotation of the cross-section D(xi) times these four.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError


def _refuse_unless_positive(what: str, part: object, names: tuple[str, ...]) -> None:
    for name in names:
        if not 0 < getattr(part, name) < np.inf:
            raise ConfigError(
                f"the {name.replace('_', ' ')} of a {what} is positive, not {getattr(part, name):g}"
            )


def _refuse_bore(what: str, inner: float, outer: float) -> None:
    if not 0 <= inner < outer:
        raise ConfigError(f"the {what} has a bore of {inner:g} m in a diameter of {outer:g} m")


@dataclass(frozen=True)
class Material:
    """density [kg/m3], elastic and shear modulus [Pa]; Poisson's ratio enters the shear coefficient only. Two
    of different names may have the same numbers and be uncertain by themselves.
    """

    density: float
    elastic_modulus: float
    shear_modulus: float
    poisson: float = 0.3
    name: str = ""

    def __post_init__(self) -> None:
        _refuse_unless_positive("material", self, ("density", "elastic_modulus", "shear_modulus"))
        if not -1 < self.poisson <= 0.5:
            raise ConfigError(f"Poisson's ratio lies between -1 and 0.5, not at {self.poisson:g}")


# Largest length over diameter of an element: beyond it no digits of its stiffness are left.
SLENDEREST = 1e5

STEEL = Material(7800.0, 2.1e11, 0.796e11, name="steel")
ALUMINIUM = Material(2700.0, 0.7e11, 0.27e11, name="aluminium")


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
        if self.length > SLENDEREST * self.outer_diameter:
            what = f"a shaft element of {self.length:g} m length has a diameter of {self.outer_diameter:g} m"
            raise ConfigError(what, hint="check lengths and diameters")

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
        """kappa of a circular tube (Cowper 1966); 6 (1 + nu) / (7 + 6 nu) for a solid shaft. Equation
        (rotor-cowper).
        """
        nu, bore = self.material.poisson, (self.inner_diameter / self.outer_diameter) ** 2
        return 6 * (1 + nu) * (1 + bore) ** 2 / ((7 + 6 * nu) * (1 + bore) ** 2 + (20 + 12 * nu) * bore)

    @property
    def shear_parameter(self) -> float:
        """Phi = 12 E I / (kappa G A l^2): zero for a slender (Euler-Bernoulli) element. Equation
        (rotor-shear).
        """
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
    def of_dimensions(
        cls, node: int, inner_diameter: float, outer_diameter: float, length: float, material: Material
    ) -> Disc:
        """A hollow cylinder: m = rho pi/4 (D^2 - d^2) l, I_p = m/8 (D^2 + d^2), I_t = I_p/2 + m l^2/12.
        Equation (rotor-disc).
        """
        _refuse_bore(f"disc on node {node}", inner_diameter, outer_diameter)
        mass = material.density * np.pi / 4 * (outer_diameter**2 - inner_diameter**2) * length
        polar = mass / 8 * (outer_diameter**2 + inner_diameter**2)
        return cls(node, mass, polar / 2 + mass * length**2 / 12, polar)


@dataclass(frozen=True)
class Sleeve:
    """A ring over the whole length of shaft element *element* (from 1) that adds mass and inertia, and makes
    the element *stiffening* times as stiff.
    """

    element: int
    outer_diameter: float
    material: Material = STEEL
    stiffening: float = 1.0

    def __post_init__(self) -> None:
        _refuse_unless_positive("sleeve", self, ("stiffening",))

    def tube(self, shaft: ShaftElement) -> ShaftElement:
        """The ring as a tube around its shaft element."""
        return ShaftElement(shaft.length, self.outer_diameter, self.material, shaft.outer_diameter)


@dataclass(frozen=True)
class NodeSupport:
    """A bearing on a node: stiffness [N/m] and damping [N s/m], (2, 2) in y and z, `k_yz` = force in y per
    displacement in z.
    """

    node: int
    stiffness: FloatArray
    damping: FloatArray

    def __post_init__(self) -> None:
        for matrix in (self.stiffness, self.damping):
            if np.shape(matrix) != (2, 2) or not np.all(np.isfinite(matrix)):
                raise ConfigError(f"the bearing on node {self.node} needs 2 x 2 finite coefficients")


@dataclass(frozen=True)
class Rotor:
    """Shaft elements from left to right, discs, sleeves, and the shaft's proportional damping C = alpha M +
    beta K, [1/s] and [s]. ConfigError for a disc on a node, or a sleeve on an element, that does not exist.
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
            raise ConfigError(
                "proportional damping cannot be negative", hint="give alpha and beta of zero or more"
            )
        for disc in self.discs:
            self.check_node(disc.node, "a disc")
        n = len(self.elements)
        for sleeve in self.sleeves:
            if not 1 <= sleeve.element <= n:
                raise ConfigError(
                    f"a sleeve sits on element {sleeve.element}, the rotor has elements 1 to {n}"
                )
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


# Plane 1: y and the rotation about z. Plane 2: z and the rotation about y, which is minus the slope of z.
PLANE_Y = np.array([0, 3, 4, 7])
PLANE_Z = np.array([1, 2, 5, 6])
SIGNS_Z = np.array([1.0, -1.0, 1.0, -1.0])
# Exact for the polynomials of sixth degree under the integrals.
GAUSS_POINTS, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)


def shape_functions(element: ShaftElement, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """N(xi) and D(xi), (4, n_point) each: deflection [m] and rotation [rad] per end displacement and
    rotation. Equation (rotor-shapes).
    """
    l, phi = element.length, element.shear_parameter
    deflection = np.stack(
        [
            1 - 3 * xi**2 + 2 * xi**3 + phi * (1 - xi),
            l * (xi - 2 * xi**2 + xi**3 + phi / 2 * (xi - xi**2)),
            3 * xi**2 - 2 * xi**3 + phi * xi,
            l * (xi**3 - xi**2 + phi / 2 * (xi**2 - xi)),
        ]
    )
    bend = 6 * (xi**2 - xi) / l
    rotation = np.stack([bend, 1 - 4 * xi + 3 * xi**2 + phi * (1 - xi), -bend, 3 * xi**2 - 2 * xi + phi * xi])
    return deflection / (1 + phi), rotation / (1 + phi)


def plane_stiffness(element: ShaftElement) -> FloatArray:
    """Bending and shear stiffness of one plane, (4, 4) [N/m, N, N m]. Equation (rotor-stiffness)."""
    l, phi = element.length, element.shear_parameter
    near, far = (4 + phi) * l**2, (2 - phi) * l**2
    matrix = np.array(
        [
            [12, 6 * l, -12, 6 * l],
            [6 * l, near, -6 * l, far],
            [-12, -6 * l, 12, -6 * l],
            [6 * l, far, -6 * l, near],
        ]
    )
    return element.material.elastic_modulus * element.second_moment / (l**3 * (1 + phi)) * matrix


def plane_inertia(element: ShaftElement, ring: ShaftElement | None = None) -> tuple[FloatArray, FloatArray]:
    """Translational mass rho A l int N N' and rotary inertia rho I l int D D' of one plane, (4, 4) each [kg,
    kg m, kg m^2]. *ring*: cross-section of a sleeve that follows the deflection of *element*; by default the
    element's cross-section. Equation (rotor-inertia).
    """
    tube = ring or element
    deflection, rotation = shape_functions(element, (GAUSS_POINTS + 1) / 2)
    density = tube.material.density * element.length * GAUSS_WEIGHTS / 2
    return (deflection * (density * tube.area)) @ deflection.T, (
        rotation * (density * tube.second_moment)
    ) @ rotation.T


def inertia_matrices(
    element: ShaftElement, ring: ShaftElement | None = None
) -> tuple[FloatArray, FloatArray]:
    """M and G of an element or its sleeve, (8, 8) [kg, kg m, kg m^2], in the order y, z, rotation about y,
    about z, left end, right end. G is multiplied by the spin speed: a rotation rate about z turns the angular
    momentum towards y, 2 rho I per length. Equation (rotor-gyroscopic).
    """
    translation, rotary = plane_inertia(element, ring)
    return expand_to_both_planes(translation + rotary), across_planes(2 * rotary)


def expand_to_both_planes(plane: FloatArray) -> FloatArray:
    """A symmetric matrix of one plane (4, 4) applied to both planes, (8, 8) [same unit]."""
    both = np.zeros((8, 8))
    both[np.ix_(PLANE_Y, PLANE_Y)] = plane
    both[np.ix_(PLANE_Z, PLANE_Z)] = plane * np.outer(SIGNS_Z, SIGNS_Z)
    return both


def across_planes(plane: FloatArray) -> FloatArray:
    """A matrix of one plane (4, 4) by which z acts on y, and minus its transpose y on z, (8, 8) [same
    unit].
    """
    across = np.zeros((8, 8))
    across[np.ix_(PLANE_Y, PLANE_Z)] = plane * SIGNS_Z
    across[np.ix_(PLANE_Z, PLANE_Y)] = -(plane * SIGNS_Z).T
    return across


STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class RotorMatrices:
    """Mass M [kg], damping C [N s/m], gyroscopic G, stiffness K [N/m], (n_dof, n_dof), four dofs per node: y,
    z, rotations about y, z.
    """

    mass: FloatArray
    damping: FloatArray
    gyroscopic: FloatArray
    stiffness: FloatArray

    def at_speed(self, speed: float) -> FloatArray:
        """C + Omega G, (n_dof, n_dof) [N s/m]; *speed* [rad/s]."""
        return self.damping + speed * self.gyroscopic

    def between(self, first: int, second: int) -> RotorMatrices:
        """The blocks (4, 4) of two nodes, counted from 0, in the same units."""
        rows, columns = slice(4 * first, 4 * first + 4), slice(4 * second, 4 * second + 4)
        return RotorMatrices(
            *(whole[rows, columns] for whole in (self.mass, self.damping, self.gyroscopic, self.stiffness))
        )


@lru_cache(maxsize=8)
def free_rotor(rotor: Rotor) -> RotorMatrices:
    """The rotor without supports; damping alpha M + beta K of the shaft alone, without discs and sleeves.
    Equation (rotor-motion).
    """
    mass, stiffness, gyroscopic = (np.zeros((4 * rotor.n_node, 4 * rotor.n_node)) for _ in range(3))
    for number, element in enumerate(rotor.elements):
        _add(number, (mass, gyroscopic), inertia_matrices(element))
        factor = np.prod([sleeve.stiffening for sleeve in rotor.sleeves if sleeve.element == number + 1])
        _add(number, (stiffness,), (factor * expand_to_both_planes(plane_stiffness(element)),))
    damping = rotor.alpha * mass + rotor.beta * stiffness
    for sleeve in rotor.sleeves:
        element = rotor.elements[sleeve.element - 1]
        _add(sleeve.element - 1, (mass, gyroscopic), inertia_matrices(element, sleeve.tube(element)))
    for disc in rotor.discs:
        y, z, about_y, about_z = range(4 * disc.node - 4, 4 * disc.node)
        diagonal = [y, z, about_y, about_z]
        mass[diagonal, diagonal] += [disc.mass] * 2 + [disc.transverse_inertia] * 2
        gyroscopic[about_y, about_z] += disc.polar_inertia
        gyroscopic[about_z, about_y] -= disc.polar_inertia
    # The rotor at the next speed has the same ones.
    for matrix in (mass, damping, gyroscopic, stiffness):
        matrix.flags.writeable = False
    return RotorMatrices(mass, damping, gyroscopic, stiffness)


def _add(number: int, wholes: tuple[FloatArray, ...], parts: tuple[FloatArray, ...]) -> None:
    dofs = slice(4 * number, 4 * number + 8)
    for whole, part in zip(wholes, parts, strict=True):
        whole[dofs, dofs] += part


def supported_rotor(rotor: Rotor, supports: Iterable[NodeSupport]) -> RotorMatrices:
    """The rotor on its bearings. ConfigError for a bearing on a node that does not exist."""
    free = free_rotor(rotor)
    damping, stiffness = free.damping.copy(), free.stiffness.copy()
    for support in supports:
        dofs = np.ix_(rotor.dofs(support.node), rotor.dofs(support.node))
        stiffness[dofs] += support.stiffness
        damping[dofs] += support.damping
    return RotorMatrices(free.mass, damping, free.gyroscopic, stiffness)


def bearing_loads(
    rotor: Rotor,
    nodes: Iterable[int],
    forces: Mapping[int, tuple[float, float]] | None = None,
    gravity: float = STANDARD_GRAVITY,
) -> FloatArray:
    """Static load of the rotor on rigid bearings at *nodes*, (n_bearing, 2) [N] in y and z: weight along -z
    and *forces* by node. More than two bearings share the load by the shaft's stiffness. ConfigError for
    fewer than two bearings. Equation (rotor-loads).
    """
    nodes = list(nodes)
    if len(set(nodes)) < 2:
        raise ConfigError("a rotor rests on at least two bearings at different nodes")
    free = free_rotor(rotor)
    n_dof = free.mass.shape[0]
    pull = np.zeros(n_dof)
    pull[1::4] = -gravity
    applied = free.mass @ pull
    for node, force in (forces or {}).items():
        applied[rotor.dofs(node)] += force
    fixed_dofs = [dof for node in nodes for dof in rotor.dofs(node)]
    # Rigid supports as constraints, scaled by the stiffness so that both kinds of equations have one
    # magnitude.
    scale = float(np.max(np.abs(free.stiffness)))
    constraints = scale * np.eye(n_dof)[fixed_dofs]
    system = np.block(
        [[free.stiffness, constraints.T], [constraints, np.zeros((len(fixed_dofs), len(fixed_dofs)))]]
    )
    try:
        solution = np.linalg.solve(system, np.concatenate([applied, np.zeros(len(fixed_dofs))]))
    except np.linalg.LinAlgError:
        what = "the stiffnesses of the shaft's elements differ beyond all digits"
        raise ConfigError(what, hint="check lengths and diameters") from None
    return (scale * solution[n_dof:]).reshape(-1, 2)
