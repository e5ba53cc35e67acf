"""Modes, stability and steady vibration of a rotor on its bearings, and its reduction to chosen nodes.

With b the bearing dofs, Z_b = K + j w C of all bearings and R the receptance of the free rotor, H = R - R_:b
(I + Z_b R_bb)^-1 Z_b R_b: (Woodbury), matrices of two rows per bearing instead of four per node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.methods.rotor.shaft import NodeSupport, Rotor, RotorMatrices, free_rotor, supported_rotor
from labpipe.spectra.convert import FROM_DIRECTIONAL

# Growth rates [1/s] below this are rounding errors, of undamped modes for example.
GROWTH_TOLERANCE = 1e-3
# Least imaginary part over modulus of an oscillating eigenvalue: rounding splits double real roots by this
# much.
LEAST_OSCILLATION = 1e-3

SupportsAtSpeed = Callable[[float], Iterable[NodeSupport]]


@dataclass(frozen=True)
class WhirlModes:
    """Oscillating modes at one spin speed [rad/s], in ascending order of damped frequency.

    eigenvalues (n_mode,) [1/s] with positive imaginary part; shapes (n_mode, n_node, 2), y and z, largest
    deflection 1.
    """

    speed: float
    eigenvalues: ComplexArray
    shapes: ComplexArray

    @property
    def damping_ratio(self) -> FloatArray:
        """zeta = -Re(lambda) / |lambda| [-], (n_mode,); negative for an unstable mode. Equation
        (rotor-damping-ratio).
        """
        return -self.eigenvalues.real / np.abs(self.eigenvalues)

    @property
    def whirl(self) -> FloatArray:
        """Whirl direction over all nodes, (n_mode,) [-]: -1 circular backward, 0 straight line, +1 circular
        forward. Equation (rotor-whirl).
        """
        forward, backward = (np.sum(np.abs(self.shapes @ [1, turn]) ** 2, axis=1) for turn in (1j, -1j))
        return (forward - backward) / (forward + backward)


def eigenvalues(matrices: RotorMatrices, speed: float) -> tuple[ComplexArray, ComplexArray]:
    """All eigenvalues (2 n_dof,) [1/s] and displacement shapes (n_dof, 2 n_dof) of M q'' + (C + Omega G) q' +
    K q = 0. Equation (rotor-eigenvalues).
    """
    n = matrices.mass.shape[0]
    inverse = linalg.cho_factor(matrices.mass)
    upper = np.concatenate([np.zeros((n, n)), np.eye(n)], axis=1)
    lower = -linalg.cho_solve(inverse, np.concatenate([matrices.stiffness, matrices.at_speed(speed)], axis=1))
    roots, vectors = linalg.eig(np.concatenate([upper, lower]))
    return roots, vectors[:n]


def modes(rotor: Rotor, supports: Iterable[NodeSupport], speed: float) -> WhirlModes:
    """The oscillating modes of a rotor at a spin *speed* [rad/s]."""
    roots, vectors = eigenvalues(supported_rotor(rotor, supports), speed)
    oscillating = np.flatnonzero(roots.imag > LEAST_OSCILLATION * np.abs(roots))
    oscillating = oscillating[np.argsort(roots[oscillating].imag)]
    shapes = np.stack([vectors[0::4, oscillating], vectors[1::4, oscillating]], axis=-1).swapaxes(0, 1)
    flat = shapes.reshape(oscillating.size, -1)
    largest = flat[np.arange(oscillating.size), np.argmax(np.abs(flat), axis=1)]
    return WhirlModes(speed, roots[oscillating], shapes / largest[:, None, None])


def growth_rate(rotor: Rotor, supports: Iterable[NodeSupport], speed: float) -> float:
    """Largest real part of the eigenvalues [1/s]; positive means unstable. Equation (rotor-onset)."""
    roots, _ = eigenvalues(supported_rotor(rotor, supports), speed)
    return float(np.max(roots.real))


def onset_speed(rotor: Rotor, supports: SupportsAtSpeed, speeds: Iterable[float]) -> float | None:
    """Onset speed of instability [rad/s], between the first pair of *speeds* around it; None for a rotor
    stable at all of them. FitError for a rotor unstable at the first speed.
    """

    def excess(speed: float) -> float:
        return growth_rate(rotor, supports(speed), speed) - GROWTH_TOLERANCE

    speeds = list(speeds)
    return first_onset(excess, speeds, map(excess, speeds), 1e-3)


def first_onset(
    excess: Callable[[float], float], speeds: Iterable[float], values: Iterable[float], tolerance: float
) -> float | None:
    """Where an *excess* of speed becomes positive [rad/s], between the first pair of *speeds* around it,
    whose *values* of it are given; None where none is positive. FitError where the first one is.
    """
    stable = None
    for speed, value in zip(speeds, values, strict=True):
        if value > 0:
            if stable is None:
                what = f"the rotor is unstable already at {speed * 30 / np.pi:.0f} rpm"
                raise FitError(what, hint="start the search at a lower speed")
            return float(scipy.optimize.brentq(excess, stable, speed, xtol=tolerance))
        stable = speed
    return None


def dynamic_stiffness(matrices: RotorMatrices, omega: FloatArray, speed: float | FloatArray) -> ComplexArray:
    """Z(w) = K - w^2 M + j w (C + Omega G), (n_line, n_dof, n_dof) [N/m]; *omega* (n_line,) and *speed* in
    [rad/s]. Equation (rotor-dynamic-stiffness).
    """
    w = np.asarray(omega, np.float64)[:, None, None]
    spin = np.broadcast_to(speed, np.shape(omega))[:, None, None]
    static = matrices.stiffness - w**2 * matrices.mass
    return static + 1j * w * (matrices.damping + spin * matrices.gyroscopic)


def solve(stiffness: ComplexArray, forces: ComplexArray | FloatArray) -> ComplexArray:
    """Displacements (..., n_dof, n_force) [m] under *forces* [N], same shape; FitError at an undamped
    resonance. *stiffness*: dynamic stiffness (..., n_dof, n_dof) [N/m].
    """
    try:
        return np.linalg.solve(stiffness, forces)
    except np.linalg.LinAlgError:
        hint = "move the line or add damping"
        raise FitError("the rotor has a resonance without damping on a line", hint=hint) from None


def unbalance_response(
    rotor: Rotor,
    supports: Iterable[NodeSupport],
    speed: FloatArray,
    unbalance: Mapping[int, complex],
    outputs: list[int],
) -> ComplexArray:
    """Displacements [m], 0-to-peak phasors, (n_speed, n_output), at spin *speed* (n_speed,) [rad/s].
    *unbalance* [kg m] by node, its angle from the y axis at time zero: F_y = u Omega^2, F_z = -j u Omega^2,
    so that the force rotates from y to z. The bearings do not change with speed. Equation (rotor-unbalance).
    """
    speed = np.asarray(speed, np.float64)
    matrices = supported_rotor(rotor, supports)
    forces = np.zeros((speed.size, matrices.mass.shape[0], 1), np.complex128)
    for node, amount in unbalance.items():
        forces[:, rotor.dofs(node), 0] += np.outer(amount * speed**2, [1, -1j])
    return solve(dynamic_stiffness(matrices, speed, speed), forces)[:, outputs, 0]


def forward_backward_motion(displacements: ComplexArray) -> ComplexArray:
    """[f, b] = A^-1 [y, z] of phasors (..., 2) in y and z [m]: radii of the forward and the backward circle
    of an orbit, 0-to-peak. Equation (rotor-orbit).
    """
    return displacements @ np.linalg.inv(FROM_DIRECTIONAL).T


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

    def on(self, supports: Iterable[NodeSupport]) -> ReducedRotor:
        """This rotor with bearings added at nodes of the reduced rotor; ConfigError for another node.
        Equation (rotor-woodbury).
        """
        supports = list(supports)
        b = self._bearing_dofs(supports)
        loaded = _bearing_forces(supports, self.omega, self.receptance[:, b], b)
        return ReducedRotor(self.nodes, self.omega, self.receptance - self.receptance[:, :, b] @ loaded)

    def paths(
        self, supports: Sequence[NodeSupport], output: int, force: int
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """H_of (n_line, 2, 2), H_ob (n_line, 2, 2 n_bearing) and H_bf (n_line, 2 n_bearing, 2) [m/N] of this
        rotor with bearings added. From forces at the node *force* or at the bearings b to displacements at
        the node *output* or at the bearings, in the order of *supports*: what a response and its derivatives
        by the bearings need, without the rest.
        """
        b, o, f = self._bearing_dofs(supports), self.dofs(output), self.dofs(force)
        n, rows, columns = (
            len(b),
            [*b, *(dof for dof in o if dof not in b)],
            [*b, *(dof for dof in f if dof not in b)],
        )
        free = self.receptance[:, np.array(rows)[:, None], columns]
        added = free - free[:, :, :n] @ _bearing_forces(supports, self.omega, free[:, :n], list(range(n)))
        from_b, of_f = added[:, [rows.index(dof) for dof in o]], [columns.index(dof) for dof in f]
        return from_b[:, :, of_f], from_b[:, :, :n], added[:, :n][:, :, of_f]

    def _bearing_dofs(self, supports: Iterable[NodeSupport]) -> list[int]:
        return [dof for support in supports for dof in self.dofs(support.node)]


def _bearing_forces(
    supports: Sequence[NodeSupport], omega: FloatArray, rows: ComplexArray, at: list[int]
) -> ComplexArray:
    """(I + Z_b R_bb)^-1 Z_b R_b: [1] of the free rotor's *rows* R_b: (n_line, n, n_column) [m/N], R_bb in
    columns *at*; same shape.
    """
    loaded = np.empty_like(rows)
    for number, support in enumerate(supports):
        place = slice(2 * number, 2 * number + 2)
        loaded[:, place] = (support.stiffness + 1j * omega[:, None, None] * support.damping) @ rows[:, place]
    return solve(np.eye(len(at)) + loaded[:, :, at], loaded)


def reduced_rotor(rotor: Rotor, nodes: Iterable[int], frequency: FloatArray, speed: float) -> ReducedRotor:
    """The free rotor between *nodes* at *frequency* (n_line,) [Hz], all above zero, and a spin *speed*
    [rad/s].
    """
    nodes = tuple(dict.fromkeys(nodes))
    omega = 2 * np.pi * np.asarray(frequency, np.float64)
    if not np.all(omega > 0):
        raise ConfigError("a free rotor has no receptance at 0 Hz", hint="keep lines above 0 Hz")
    wanted = [rotor.dofs(node) for node in nodes]
    kept = sorted(first // 4 for first, _ in wanted)
    stiffness = condensed_stiffness(free_rotor(rotor), omega, speed, kept)
    dofs = [4 * kept.index(first // 4) + direction for first, _ in wanted for direction in (0, 1)]
    forces = np.eye(4 * len(kept))[:, dofs]
    return ReducedRotor(
        nodes, omega, solve(stiffness, np.broadcast_to(forces, (omega.size, *forces.shape)))[:, dofs]
    )


def condensed_stiffness(
    matrices: RotorMatrices, omega: FloatArray, speed: float, kept: Sequence[int]
) -> ComplexArray:
    """Dynamic stiffness (n_line, 4 n_kept, 4 n_kept) [N/m] of nodes *kept* (from 0, rising) without forces on
    the others. *omega* (n_line,) and *speed* in [rad/s]. An element joins two neighbours, so that one node i
    after the other is eliminated, Z_ab - Z_ai Z_ii^-1 Z_ib between its neighbours a, b: the cost is in
    proportion to the number of nodes, not to its cube. Equation (rotor-eliminated).
    """
    chain = list(range(matrices.mass.shape[0] // 4))
    pairs = [(row, column) for row in chain for column in chain[max(row - 1, 0) : row + 2]]
    z = {pair: dynamic_stiffness(matrices.between(*pair), omega, speed) for pair in pairs}
    for node in [node for node in chain if node not in kept]:
        place = chain.index(node)
        neighbours = [*chain[max(place - 1, 0) : place], *chain[place + 1 : place + 2]]
        for b in neighbours:
            moved = solve(z[node, node], z[node, b])
            for a in neighbours:
                z[a, b] = z.get((a, b), 0) - z[a, node] @ moved
        chain.remove(node)
    condensed = np.zeros((omega.size, 4 * len(kept), 4 * len(kept)), np.complex128)
    for (row, column), block in z.items():
        if row in kept and column in kept:
            first, second = 4 * chain.index(row), 4 * chain.index(column)
            condensed[:, first : first + 4, second : second + 4] = block
    return condensed
