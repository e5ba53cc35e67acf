"""A rotor between pinned ends with one bearing: condensation, growth rates, critical and threshold speeds.

Pins fix y and z of their nodes; the rotations there carry no disc and are condensed statically, so that three
stations between two pins have twelve degrees of freedom. With b the bearing's two and i the others, at a
speed Omega

    x_i = Z_ii^-1 (f_i - Z_ib x_b),   (D + K_b + j Omega C_b) x_b = g,   D = Z_bb - Z_bi Z_ii^-1 Z_ib,   g =
    f_b - Z_bi Z_ii^-1 f_i.

Modes without motion of the journal (the anti-phase modes of a symmetric rotor) are undamped by the bearing
and not considered; the rotor is unstable if one of the other modes grows faster than GROWTH_TOLERANCE.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError
from labpipe.methods.rotor.response import GROWTH_TOLERANCE, dynamic_stiffness, first_onset, solve
from labpipe.methods.rotor.shaft import Rotor, RotorMatrices, free_rotor


@dataclass(frozen=True)
class PinnedRotor:
    """The matrices (n_dof, n_dof) of the *stations*, node numbers in order; four dofs each: y, z, rotations
    about y and z.
    """

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


def pinned_rotor(rotor: Rotor, pins: tuple[int, ...]) -> PinnedRotor:
    """The rotor between pins; ConfigError for fewer than two, a pin on a node that does not exist, or a disc
    on a pin. Equation (rotor-pinned).
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
    static_shape = np.linalg.solve(
        free.stiffness[np.ix_(condensed, condensed)], free.stiffness[np.ix_(condensed, free_dofs)]
    )
    shape = np.zeros((4 * rotor.n_node, free_dofs.size))
    shape[free_dofs] = np.eye(free_dofs.size)
    shape[condensed] = -static_shape
    parts = (
        shape.T @ matrix @ shape for matrix in (free.mass, free.damping, free.gyroscopic, free.stiffness)
    )
    return PinnedRotor(stations, RotorMatrices(*parts))


@dataclass(frozen=True)
class CondensedRotor:
    """A pinned rotor condensed to its bearing, at every *speed* (n_speed,) [rad/s] under known synchronous
    forces.

    at_bearing D (n_speed, 2, 2) [N/m]; force g (n_speed, 2) [N]; fixed_journal (n_speed, n_output) [m]:
    motion of the outputs with a fixed journal; per_journal (n_speed, n_output, 2): their motion per motion of
    the journal. Phasors, 0-to-peak.
    """

    speed: FloatArray
    at_bearing: ComplexArray
    force: ComplexArray
    fixed_journal: ComplexArray
    per_journal: ComplexArray

    def at(self, chosen: IntArray | BoolArray) -> CondensedRotor:
        """The rotor at the speeds *chosen*, an index array (n,) or a mask (n_speed,)."""
        return CondensedRotor(*(getattr(self, part.name)[chosen] for part in fields(self)))

    def journal(self, stiffness: FloatArray, damping: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Motion of the journal x_b (..., n_speed, 2) [m] and the compliance (D + K + j Omega C)^-1 (...,
        n_speed, 2, 2) [m/N]. Equation (rotor-journal).
        """
        compliance = inverse(self.at_bearing + stiffness + 1j * self.speed[:, None, None] * damping)
        return (compliance @ self.force[..., None])[..., 0], compliance

    def response(self, stiffness: FloatArray, damping: FloatArray) -> ComplexArray:
        """Phasors of the outputs (..., n_speed, n_output) [m] under K [N/m] and C [N s/m], (..., n_speed, 2,
        2).
        """
        motion, _ = self.journal(stiffness, damping)
        return self.fixed_journal + (self.per_journal @ motion[..., None])[..., 0]

    def response_and_slopes(
        self, stiffness: FloatArray, damping: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """`response`, and its derivatives (n_speed, n_output, 8) by K_xx K_xy K_yx K_yy [m^2/N], C_xx C_xy
        C_yx C_yy [m^2/(N s)].

        d x_b / d K_kl = -(compliance column k) x_b[l], and j Omega times that for C_kl. Equation
        (rotor-journal-slopes).
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
    return adjugate / (a * d - b * c)[..., None, None]


def unbalance_forces(rotor: PinnedRotor, unbalance: Mapping[int, complex], speed: FloatArray) -> ComplexArray:
    """F_y = u Omega^2, F_z = -j u Omega^2, rotating from y to z, (n_speed, n_dof) [N]. *unbalance* [kg m] by
    node.
    """
    forces = np.zeros((np.size(speed), rotor.n_dof), np.complex128)
    for node, amount in unbalance.items():
        forces[:, rotor.dofs(node)] += np.outer(amount * np.asarray(speed) ** 2, [1, -1j])
    return forces


def condensed_rotor(
    rotor: PinnedRotor,
    bearing: int,
    speed: FloatArray,
    forces: ComplexArray,
    outputs: tuple[int, ...],
    spin: FloatArray | None = None,
) -> CondensedRotor:
    """The rotor at frequencies *speed* (n_speed,) [rad/s] under *forces* (n_speed, n_dof) [N], condensed to
    the node *bearing*.

    outputs: nodes whose y and z are outputs; *spin* [rad/s] of the shaft, where it differs from the frequency
    (zero at rest). Equation (rotor-condensed).
    """
    speed = np.asarray(speed, np.float64)
    z = dynamic_stiffness(rotor.matrices, speed, speed if spin is None else spin)
    bearing_dofs = rotor.dofs(bearing)
    free = [dof for dof in range(rotor.n_dof) if dof not in bearing_dofs]
    sides = np.concatenate([forces[:, free, None], -z[:, free][:, :, bearing_dofs]], axis=-1)
    motion = np.zeros((speed.size, rotor.n_dof, 3), np.complex128)
    motion[:, free] = solve(z[:, free][:, :, free], sides)
    motion[:, bearing_dofs, 1:] = np.eye(2)
    to_bearing = z[:, bearing_dofs]
    dofs = [dof for node in outputs for dof in rotor.dofs(node)]
    at_bearing, per_journal = to_bearing @ motion[:, :, 1:], motion[:, dofs, 1:]
    force = forces[:, bearing_dofs] - (to_bearing @ motion[:, :, :1])[..., 0]
    return CondensedRotor(speed, at_bearing, force, motion[:, dofs, 0], per_journal)


# Least share of the journal in a mode's squared deflections.
LEAST_PARTICIPATION = 1e-8
# To which a speed of resonance is found [rad/s].
RESONANCE_TOLERANCE = 1e-4

# K [N/m] and C [N s/m], (n_speed, 2, 2) each, at speeds (n_speed,) [rad/s].
CoefficientsAtSpeed = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class LeastStable:
    """The least stable mode with motion of the journal: eigenvalue [1/s], and derivatives (2, 2) of its real
    part by K_kl and C_kl; by_speed: by the spin speed through the gyroscopic matrix alone, [1/s per rad/s].
    """

    eigenvalue: complex
    by_stiffness: FloatArray
    by_damping: FloatArray
    by_speed: float

    @property
    def growth(self) -> float:
        """Real part [1/s]: positive means unstable."""
        return self.eigenvalue.real


@dataclass(frozen=True)
class Stability:
    """A pinned *rotor* and the node of its *bearing*; inverse_mass (n_dof, n_dof) [1/kg] is stored for
    repeated eigenvalue problems.
    """

    rotor: PinnedRotor
    bearing: int
    inverse_mass: FloatArray

    @classmethod
    def of(cls, rotor: PinnedRotor, bearing: int) -> Stability:
        """The stability problem of a rotor with its bearing on the node *bearing*."""
        return cls(rotor, bearing, np.linalg.inv(rotor.matrices.mass))

    def system(self, speed: FloatArray, stiffness: FloatArray, damping: FloatArray) -> FloatArray:
        """System matrix A of y' = A y, y = (q, q'), (n_speed, 2 n_dof, 2 n_dof) [SI], with gyroscopic terms.
        *speed* (n_speed,) [rad/s], *stiffness* [N/m] and *damping* [N s/m] (n_speed, 2, 2) of the bearing.
        """
        n, first = self.rotor.n_dof, self.rotor.dofs(self.bearing)[0]
        speed = np.atleast_1d(np.asarray(speed, np.float64))
        stiff, damped, turning = self._accelerations
        system = np.zeros((speed.size, 2 * n, 2 * n))
        system[:, :n, n:] = np.eye(n)
        system[:, n:, :n], system[:, n:, n:] = stiff, damped + speed[:, None, None] * turning
        of_bearing = self.inverse_mass[:, first : first + 2]
        system[:, n:, first : first + 2] -= of_bearing @ stiffness
        system[:, n:, n + first : n + first + 2] -= of_bearing @ damping
        return system

    @cached_property
    def _accelerations(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """-M^-1 K, -M^-1 C and -M^-1 G of the rotor without its bearing, (n_dof, n_dof) each."""
        matrices = self.rotor.matrices
        stiff, damped, turning = (
            -self.inverse_mass @ part for part in (matrices.stiffness, matrices.damping, matrices.gyroscopic)
        )
        return stiff, damped, turning

    def growth(self, speed: FloatArray, stiffness: FloatArray, damping: FloatArray) -> FloatArray:
        """Largest growth rate [1/s] of modes with motion of the journal, (n_speed,). Arguments as in
        `system`.
        """
        eigen = np.linalg.eig(self.system(speed, stiffness, damping))
        moving = self.moving(np.asarray(eigen.eigenvectors, np.complex128))
        return np.max(np.where(moving, eigen.eigenvalues.real, -np.inf), axis=-1)

    def least_stable(self, speed: float, stiffness: FloatArray, damping: FloatArray) -> LeastStable:
        """The least stable mode at one *speed* [rad/s], with the derivatives (2, 2) of its growth rate by the
        bearing's coefficients.

        d lambda = y^T (dA) x / (y^T x) with left and right eigenvectors y, x of A. Equation
        (rotor-least-stable).
        """
        roots, vectors = np.linalg.eig(self.system(np.array([speed]), stiffness, damping)[0])
        chosen = int(np.argmax(np.where(self.moving(vectors) & (roots.imag >= 0), roots.real, -np.inf)))
        n, place = self.rotor.n_dof, self.rotor.dofs(self.bearing)
        # Rows of the inverse of the right eigenvectors are the left ones, y^T x = 1.
        y, x = np.linalg.solve(vectors.T, np.eye(2 * n)[chosen]), vectors[:, chosen]
        forces = y[n:] @ self.inverse_mass
        slopes = -np.outer(forces[place], x[place])
        turned = -forces @ self.rotor.matrices.gyroscopic @ x[n:]
        root = complex(roots[chosen])
        return LeastStable(root, slopes.real, (slopes * root).real, float(turned.real))

    def moving(self, vectors: ComplexArray) -> BoolArray:
        """Modes (..., n_mode) with motion of the journal; *vectors* (..., 2 n_dof, n_mode) [any unit]."""
        squares = np.abs(vectors[..., : self.rotor.n_dof, :]) ** 2
        whole = squares[..., 0::4, :].sum(axis=-2) + squares[..., 1::4, :].sum(axis=-2)
        share = squares[..., self.rotor.dofs(self.bearing), :].sum(axis=-2) / np.maximum(whole, 1e-300)
        return share > LEAST_PARTICIPATION


def threshold_speed(
    stability: Stability, coefficients: CoefficientsAtSpeed, speeds: Iterable[float]
) -> float | None:
    """Threshold speed of instability [rad/s], between the first pair of *speeds* around it; None for a rotor
    stable at all of them. FitError for a rotor unstable at the first speed.
    """
    places = np.asarray(list(speeds), np.float64)

    def excess(speed: FloatArray) -> FloatArray:
        return stability.growth(speed, *coefficients(speed)) - GROWTH_TOLERANCE

    return first_onset(lambda speed: float(excess(np.array([speed]))[0]), places, excess(places), 1e-4)


def resonance_speed(
    stability: Stability, coefficients: CoefficientsAtSpeed, speeds: Iterable[float]
) -> float | None:
    """The first speed [rad/s] equal to the imaginary part of a damped mode with motion of the journal; None
    when there is none. The critical speed by eigenvalues: lightly damped modes only (damping ratio below one
    half), forward or backward.
    """
    speed = np.asarray(list(speeds), np.float64)
    frequencies = [_damped_frequencies(stability, coefficients, value) for value in speed]
    # Number of modes below 1x at every speed: it grows where a mode is crossed.
    below = [int(np.sum(modes < value)) for modes, value in zip(frequencies, speed, strict=True)]
    for n in range(1, speed.size):
        if below[n] > below[n - 1]:
            return _crossing(stability, coefficients, (float(speed[n - 1]), float(speed[n])), below[n - 1])
    return None


def _crossing(
    stability: Stability, coefficients: CoefficientsAtSpeed, between: tuple[float, float], below: int
) -> float:
    low, high = between

    def detuning(speed: float) -> float:
        """Speed minus the imaginary part of the nearest mode [rad/s]."""
        frequencies = _damped_frequencies(stability, coefficients, speed)
        return float(speed - frequencies[np.argmin(np.abs(frequencies - speed))])

    if detuning(low) < 0 < detuning(high):
        return float(scipy.optimize.brentq(detuning, low, high, xtol=RESONANCE_TOLERANCE))
    # Another mode is nearer to an end than the one that is crossed: only their number tells.
    while high - low > RESONANCE_TOLERANCE:
        middle = (low + high) / 2
        if np.sum(_damped_frequencies(stability, coefficients, middle) < middle) > below:
            high = middle
        else:
            low = middle
    return high


def _damped_frequencies(stability: Stability, coefficients: CoefficientsAtSpeed, speed: float) -> FloatArray:
    """Imaginary parts (n_mode,) [rad/s] of the lightly damped modes with motion of the journal, ascending."""
    place = np.array([speed])
    roots, vectors = np.linalg.eig(stability.system(place, *coefficients(place))[0])
    lightly_damped = stability.moving(vectors) & (roots.imag > 0) & (-roots.real < 0.5 * np.abs(roots))
    return np.sort(roots[lightly_damped].imag)
