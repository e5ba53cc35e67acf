"""A rotor between pinned ends with one bearing: few stations, and all other dofs condensed to the bearing once per speed.

Pins fix y and z of their nodes; the rotations there carry no disc and are condensed statically, so that three stations between two
pins have twelve degrees of freedom. With b the bearing's two and i the others, at a speed Omega

    x_i = Z_ii^-1 (f_i - Z_ib x_b),   (D + K_b + j Omega C_b) x_b = g,   D = Z_bb - Z_bi Z_ii^-1 Z_ib,   g = f_b - Z_bi Z_ii^-1 f_i.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError
from labpipe.rotors.assembly import RotorMatrices, free_rotor
from labpipe.rotors.parts import Rotor
from labpipe.rotors.response import dynamic_stiffness, solved


@dataclass(frozen=True)
class PinnedRotor:
    """The matrices (n_dof, n_dof) of the *stations*, node numbers in order; four dofs each: y, z, rotations about y and z."""

    stations: tuple[int, ...]
    matrices: RotorMatrices

    @property
    def n_dof(self) -> int:
        return 4 * len(self.stations)

    def dofs(self, node: int) -> list[int]:
        """Indices of y and z of a station; ConfigError for a pin."""
        if node not in self.stations:
            stations = ", ".join(str(station) for station in self.stations)
            raise ConfigError(f"node {node} is not between the pins", hint=f"stations: {stations}")
        first = 4 * self.stations.index(node)
        return [first, first + 1]

    def with_bearing(self, node: int, stiffness: FloatArray, damping: FloatArray) -> RotorMatrices:
        """The matrices with a bearing's K [N/m] and C [N s/m], (2, 2), on a station."""
        place = np.ix_(self.dofs(node), self.dofs(node))
        k, c = self.matrices.stiffness.copy(), self.matrices.damping.copy()
        k[place] += stiffness
        c[place] += damping
        return RotorMatrices(self.matrices.mass, c, self.matrices.gyroscopic, k)


def pinned_rotor(rotor: Rotor, pins: tuple[int, ...]) -> PinnedRotor:
    """The rotor between pins; ConfigError for fewer than two, a pin on a node that does not exist, or a disc on a pin.

    Equation (rotor-pinned).
    """
    if len(set(pins)) < 2:
        raise ConfigError("a rotor needs pins at two different nodes")
    for pin in pins:
        rotor.check_node(pin, "a pin")
        if any(disc.node == pin for disc in rotor.discs):
            raise ConfigError(f"a disc sits on the pin at node {pin}", hint="pins carry no disc")
    stations = tuple(node for node in range(1, rotor.n_node + 1) if node not in pins)
    if not stations:
        raise ConfigError("there is no node between the pins")
    free_dofs = np.concatenate([np.arange(4 * node - 4, 4 * node) for node in stations])
    condensed = np.concatenate([[4 * pin - 2, 4 * pin - 1] for pin in sorted(set(pins))])
    free = free_rotor(rotor)
    static_shape = np.linalg.solve(free.stiffness[np.ix_(condensed, condensed)], free.stiffness[np.ix_(condensed, free_dofs)])
    shape = np.zeros((4 * rotor.n_node, free_dofs.size))
    shape[free_dofs] = np.eye(free_dofs.size)
    shape[condensed] = -static_shape
    parts = (shape.T @ matrix @ shape for matrix in (free.mass, free.damping, free.gyroscopic, free.stiffness))
    return PinnedRotor(stations, RotorMatrices(*parts))


@dataclass(frozen=True)
class CondensedRotor:
    """A pinned rotor condensed to its bearing, at every *speed* (n_speed,) [rad/s] under known synchronous forces.

    at_bearing D (n_speed, 2, 2) [N/m]; force g (n_speed, 2) [N]; fixed_journal (n_speed, n_output) [m]: motion of the outputs with a
    fixed journal; per_journal (n_speed, n_output, 2): their motion per motion of the journal. Phasors, 0-to-peak.
    """

    speed: FloatArray
    at_bearing: ComplexArray
    force: ComplexArray
    fixed_journal: ComplexArray
    per_journal: ComplexArray

    def at(self, chosen: IntArray | BoolArray) -> CondensedRotor:
        """The rotor at the speeds *chosen*, an index array (n,) or a mask (n_speed,)."""
        return CondensedRotor(*(getattr(self, name)[chosen] for name in ("speed", "at_bearing", "force", "fixed_journal", "per_journal")))

    def journal(self, stiffness: FloatArray, damping: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Motion of the journal x_b (..., n_speed, 2) [m] and the compliance (D + K + j Omega C)^-1 (..., n_speed, 2, 2) [m/N].

        Equation (rotor-journal).
        """
        compliance = inverse(self.at_bearing + stiffness + 1j * self.speed[:, None, None] * damping)
        return (compliance @ self.force[..., None])[..., 0], compliance

    def response(self, stiffness: FloatArray, damping: FloatArray) -> ComplexArray:
        """Phasors of the outputs (..., n_speed, n_output) [m] under K [N/m] and C [N s/m], (..., n_speed, 2, 2)."""
        motion, _ = self.journal(stiffness, damping)
        return self.fixed_journal + (self.per_journal @ motion[..., None])[..., 0]

    def response_and_slopes(self, stiffness: FloatArray, damping: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """`response`, and its derivatives (n_speed, n_output, 8) by K_xx K_xy K_yx K_yy [m^2/N], C_xx C_xy C_yx C_yy [m^2/(N s)].

        d x_b / d K_kl = -(compliance column k) x_b[l], and j Omega times that for C_kl. Equation (rotor-journal-slopes).
        """
        motion, compliance = self.journal(stiffness, damping)
        by_force = self.per_journal @ compliance
        by_stiffness = -(by_force[..., :, None] * motion[..., None, None, :]).reshape(*by_force.shape[:-1], 4)
        slopes = np.concatenate([by_stiffness, 1j * self.speed[:, None, None] * by_stiffness], axis=-1)
        return self.fixed_journal + (self.per_journal @ motion[..., None])[..., 0], slopes


def inverse(matrix: ComplexArray) -> ComplexArray:
    """The inverses of 2 x 2 matrices (..., 2, 2) [any unit] in closed form."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    inverted: ComplexArray = adjugate / (a * d - b * c)[..., None, None]
    return inverted


def unbalance_forces(rotor: PinnedRotor, unbalance: Mapping[int, complex], speed: FloatArray) -> ComplexArray:
    """F_y = u Omega^2, F_z = -j u Omega^2, rotating from y to z, (n_speed, n_dof) [N]; *unbalance* [kg m] by node."""
    forces = np.zeros((np.size(speed), rotor.n_dof), np.complex128)
    for node, amount in unbalance.items():
        y, z = rotor.dofs(node)
        forces[:, y] += amount * np.asarray(speed) ** 2
        forces[:, z] += -1j * amount * np.asarray(speed) ** 2
    return forces


def condensed_rotor(
    rotor: PinnedRotor, bearing: int, speed: FloatArray, forces: ComplexArray, outputs: tuple[int, ...], spin: FloatArray | None = None
) -> CondensedRotor:
    """The rotor at frequencies *speed* (n_speed,) [rad/s] under *forces* (n_speed, n_dof) [N], condensed to the node *bearing*.

    outputs: nodes whose y and z are outputs; *spin* [rad/s] of the shaft, where it differs from the frequency (zero at rest).
    Equation (rotor-condensed).
    """
    speed = np.asarray(speed, np.float64)
    z = dynamic_stiffness(rotor.matrices, speed, speed if spin is None else spin)
    bearing_dofs = rotor.dofs(bearing)
    free = [dof for dof in range(rotor.n_dof) if dof not in bearing_dofs]
    sides = np.concatenate([forces[:, free, None], -z[:, free][:, :, bearing_dofs]], axis=-1)
    motion = np.zeros((speed.size, rotor.n_dof, 3), np.complex128)
    motion[:, free] = solved(z[:, free][:, :, free], sides)
    motion[:, bearing_dofs, 1:] = np.eye(2)
    to_bearing = z[:, bearing_dofs]
    dofs = [dof for node in outputs for dof in rotor.dofs(node)]
    at_bearing, per_journal = to_bearing @ motion[:, :, 1:], motion[:, dofs, 1:]
    force = forces[:, bearing_dofs] - (to_bearing @ motion[:, :, :1])[..., 0]
    return CondensedRotor(speed, at_bearing, force, motion[:, dofs, 0], per_journal)
