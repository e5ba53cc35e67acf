"""Reduced rotor: the free rotor is solved once per speed between chosen nodes, bearings are added as a low-rank update.

With b the bearing dofs, Z_b = K + j w C of all bearings and R the receptance of the free rotor,
H = R - R_:b (I + Z_b R_bb)^-1 Z_b R_b: (Woodbury), matrices of two rows per bearing instead of four per node.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.rotors.assembly import RotorMatrices, free_rotor
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
        b = self._bearing_dofs(supports)
        loaded = _bearing_forces(supports, self.omega, self.receptance[:, b], b)
        return ReducedRotor(self.nodes, self.omega, self.receptance - self.receptance[:, :, b] @ loaded)

    def paths(self, supports: Sequence[Support], output: int, force: int) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """H_of (n_line, 2, 2), H_ob (n_line, 2, 2 n_bearing) and H_bf (n_line, 2 n_bearing, 2) [m/N] of this rotor with bearings added.

        From forces at the node *force* or at the bearings b to displacements at the node *output* or at the bearings, in the order of
        *supports*: what a response and its derivatives by the bearings need, without the rest.
        """
        b, o, f = self._bearing_dofs(supports), self.dofs(output), self.dofs(force)
        n, rows, columns = len(b), [*b, *(dof for dof in o if dof not in b)], [*b, *(dof for dof in f if dof not in b)]
        free = self.receptance[:, np.array(rows)[:, None], columns]
        added = free - free[:, :, :n] @ _bearing_forces(supports, self.omega, free[:, :n], list(range(n)))
        from_b, of_f = added[:, [rows.index(dof) for dof in o]], [columns.index(dof) for dof in f]
        return from_b[:, :, of_f], from_b[:, :, :n], added[:, :n][:, :, of_f]

    def _bearing_dofs(self, supports: Iterable[Support]) -> list[int]:
        return [dof for support in supports for dof in self.dofs(support.node)]


def _bearing_forces(supports: Sequence[Support], omega: FloatArray, rows: ComplexArray, at: list[int]) -> ComplexArray:
    """(I + Z_b R_bb)^-1 Z_b R_b: [1] of the free rotor's *rows* R_b: (n_line, n, n_column) [m/N], R_bb in columns *at*; same shape."""
    loaded = np.empty_like(rows)
    for number, support in enumerate(supports):
        place = slice(2 * number, 2 * number + 2)
        loaded[:, place] = support_stiffness(support, omega) @ rows[:, place]
    return solved(np.eye(len(at)) + loaded[:, :, at], loaded)


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
    wanted = [rotor.dofs(node) for node in nodes]
    kept = sorted(first // 4 for first, _ in wanted)
    stiffness = condensed_stiffness(free_rotor(rotor), omega, speed, kept)
    dofs = [4 * kept.index(first // 4) + direction for first, _ in wanted for direction in (0, 1)]
    forces = np.eye(4 * len(kept))[:, dofs]
    return ReducedRotor(nodes, omega, solved(stiffness, np.broadcast_to(forces, (omega.size, *forces.shape)))[:, dofs])


def condensed_stiffness(matrices: RotorMatrices, omega: FloatArray, speed: float, kept: Sequence[int]) -> ComplexArray:
    """Dynamic stiffness (n_line, 4 n_kept, 4 n_kept) [N/m] of nodes *kept* (from 0, rising) without forces on the others.

    *omega* (n_line,) and *speed* in [rad/s]. An element joins two neighbours, so that one node i after the other is eliminated,
    Z_ab - Z_ai Z_ii^-1 Z_ib between its neighbours a, b: the cost is in proportion to the number of nodes, not to its cube.
    Equation (rotor-eliminated).
    """
    chain = list(range(matrices.mass.shape[0] // 4))
    pairs = [(row, column) for row in chain for column in chain[max(row - 1, 0) : row + 2]]
    z = {pair: dynamic_stiffness(matrices.between(*pair), omega, speed) for pair in pairs}
    for node in [node for node in chain if node not in kept]:
        place = chain.index(node)
        neighbours = [*chain[max(place - 1, 0) : place], *chain[place + 1 : place + 2]]
        for b in neighbours:
            moved = solved(z[node, node], z[node, b])
            for a in neighbours:
                z[a, b] = z.get((a, b), 0) - z[a, node] @ moved
        chain.remove(node)
    condensed = np.zeros((omega.size, 4 * len(kept), 4 * len(kept)), np.complex128)
    for (row, column), block in z.items():
        if row in kept and column in kept:
            first, second = 4 * chain.index(row), 4 * chain.index(column)
            condensed[:, first : first + 4, second : second + 4] = block
    return condensed
