"""Reduced rotor: the free rotor is solved once per speed between chosen nodes, bearings are added as a low-rank update.

With b the bearing dofs, Z_b = K + j w C of all bearings and R the receptance of the free rotor,
H = R - R_:b (I + Z_b R_bb)^-1 Z_b R_b: (Woodbury), matrices of two rows per bearing instead of four per node.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.rotors.assembly import free_rotor
from labpipe.rotors.parts import Rotor, Support
from labpipe.rotors.response import dynamic_stiffness, solved


@dataclass(frozen=True)
class ReducedRotor:
    """Receptance of a rotor between y and z of chosen *nodes*, at one spin speed.

    omega (n_line,) [rad/s]; receptance (n_line, 2 n_node, 2 n_node) [m/N], y and z of every node in turn.
    """

    nodes: tuple[int, ...]
    omega: FloatArray
    receptance: ComplexArray

    def dofs(self, node: int) -> list[int]:
        """Indices of y and z of a node; ConfigError for a node outside the reduced rotor."""
        if node not in self.nodes:
            nodes = ", ".join(str(number) for number in self.nodes)
            raise ConfigError(f"node {node} is not in the reduced rotor (nodes {nodes})")
        first = 2 * self.nodes.index(node)
        return [first, first + 1]

    def response(self, output: int, force: int) -> ComplexArray:
        """H [m/N], (n_line, 2, 2), from forces in y and z at one node to displacements at another."""
        return self.receptance[:, self.dofs(output)][:, :, self.dofs(force)]

    def on(self, supports: Iterable[Support]) -> ReducedRotor:
        """This rotor with bearings added at nodes of the reduced rotor; ConfigError for another node. Equation (rotor-woodbury)."""
        supports = list(supports)
        dofs = [dof for support in supports for dof in self.dofs(support.node)]
        z = np.zeros((self.omega.size, len(dofs), len(dofs)), np.complex128)
        for number, support in enumerate(supports):
            place = slice(2 * number, 2 * number + 2)
            z[:, place, place] = support_stiffness(support, self.omega)
        rows = self.receptance[:, dofs]
        loaded_rows = solved(np.eye(len(dofs)) + z @ rows[:, :, dofs], z @ rows)
        return ReducedRotor(self.nodes, self.omega, self.receptance - self.receptance[:, :, dofs] @ loaded_rows)


def support_stiffness(support: Support, omega: FloatArray) -> ComplexArray:
    """Z = K + j w C of a bearing, (n_line, 2, 2) [N/m]."""
    z: ComplexArray = support.stiffness + 1j * omega[:, None, None] * support.damping
    return z


def reduced_rotor(rotor: Rotor, nodes: Iterable[int], frequency: FloatArray, speed: float) -> ReducedRotor:
    """The free rotor between *nodes* at *frequency* (n_line,) [Hz], all above zero, and a spin *speed* [rad/s]."""
    nodes = tuple(dict.fromkeys(nodes))
    omega = 2 * np.pi * np.asarray(frequency, np.float64)
    if not np.all(omega > 0):
        raise ConfigError("a free rotor has no receptance at 0 Hz", hint="keep lines above 0 Hz")
    dofs = [dof for node in nodes for dof in rotor.dofs(node)]
    forces = np.eye(4 * rotor.n_node)[:, dofs]
    z = dynamic_stiffness(free_rotor(rotor), omega, speed)
    receptance = solved(z, np.broadcast_to(forces, (omega.size, *forces.shape)))[:, dofs]
    return ReducedRotor(nodes, omega, receptance)
