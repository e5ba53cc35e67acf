"""System matrices of a rotor and static loads on its bearings: M q'' + (C + Omega G) q' + K q = F."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.rotors.elements import in_both_planes, inertia_matrices, plane_stiffness
from labpipe.rotors.parts import Rotor, Support

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class RotorMatrices:
    """Mass M [kg], damping C [N s/m], gyroscopic G, stiffness K [N/m], (n_dof, n_dof), four dofs per node: y, z, rotations about y, z."""

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
        return RotorMatrices(*(whole[rows, columns] for whole in (self.mass, self.damping, self.gyroscopic, self.stiffness)))


@lru_cache(maxsize=8)
def free_rotor(rotor: Rotor) -> RotorMatrices:
    """The rotor without supports; damping alpha M + beta K of the shaft alone, without discs and sleeves. Equation (rotor-motion)."""
    mass, stiffness, gyroscopic = (np.zeros((4 * rotor.n_node, 4 * rotor.n_node)) for _ in range(3))
    for number, element in enumerate(rotor.elements):
        _add(number, (mass, gyroscopic), inertia_matrices(element))
        _add(number, (stiffness,), (in_both_planes(plane_stiffness(element)),))
    damping = rotor.alpha * mass + rotor.beta * stiffness
    for sleeve in rotor.sleeves:
        element = rotor.elements[sleeve.element - 1]
        _add(sleeve.element - 1, (mass, gyroscopic), inertia_matrices(element, sleeve.tube(element)))
    for disc in rotor.discs:
        y, z, about_y, about_z = range(4 * disc.node - 4, 4 * disc.node)
        mass[[y, z, about_y, about_z], [y, z, about_y, about_z]] += [disc.mass] * 2 + [disc.transverse_inertia] * 2
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


def supported_rotor(rotor: Rotor, supports: Iterable[Support]) -> RotorMatrices:
    """The rotor on its bearings. ConfigError for a bearing on a node that does not exist."""
    free = free_rotor(rotor)
    damping, stiffness = free.damping.copy(), free.stiffness.copy()
    for support in supports:
        dofs = np.ix_(rotor.dofs(support.node), rotor.dofs(support.node))
        stiffness[dofs] += support.stiffness
        damping[dofs] += support.damping
    return RotorMatrices(free.mass, damping, free.gyroscopic, stiffness)


def bearing_loads(
    rotor: Rotor, nodes: Iterable[int], forces: Mapping[int, tuple[float, float]] | None = None, gravity: float = STANDARD_GRAVITY
) -> FloatArray:
    """Static load of the rotor on rigid bearings at *nodes*, (n_bearing, 2) [N] in y and z: weight along -z and *forces* by node.

    More than two bearings share the load by the shaft's stiffness. ConfigError for fewer than two bearings. Equation (rotor-loads).
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
    # Rigid supports as constraints, scaled by the stiffness so that both kinds of equations have one magnitude.
    scale = float(np.max(np.abs(free.stiffness)))
    constraints = scale * np.eye(n_dof)[fixed_dofs]
    system = np.block([[free.stiffness, constraints.T], [constraints, np.zeros((len(fixed_dofs), len(fixed_dofs)))]])
    solution = np.linalg.solve(system, np.concatenate([applied, np.zeros(len(fixed_dofs))]))
    return (scale * solution[n_dof:]).reshape(-1, 2)
