"""Stability of a pinned rotor on one bearing whose coefficients change with speed: growth rates, critical and threshold speed.

Modes without motion of the journal (the anti-phase modes of a symmetric rotor) are undamped by the bearing and not considered; the
rotor is unstable if one of the other modes grows faster than GROWTH_TOLERANCE.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.rotors.modes import GROWTH_TOLERANCE
from labpipe.rotors.pinned import PinnedRotor

# Least share of the journal in a mode's squared deflections.
LEAST_PARTICIPATION = 1e-8
# To which a speed of resonance is found [rad/s].
RESONANCE_TOLERANCE = 1e-4

# K [N/m] and C [N s/m], (n_speed, 2, 2) each, at speeds (n_speed,) [rad/s].
CoefficientsAtSpeed = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class LeastStable:
    """The least stable mode with motion of the journal: eigenvalue [1/s], and derivatives (2, 2) of its real part by K_kl and C_kl."""

    eigenvalue: complex
    by_stiffness: FloatArray
    by_damping: FloatArray

    @property
    def growth(self) -> float:
        """Real part [1/s]: positive means unstable."""
        return self.eigenvalue.real


@dataclass(frozen=True)
class Stability:
    """A pinned *rotor* and the node of its *bearing*; *inverse_mass* (n_dof, n_dof) [1/kg] is stored for repeated eigenvalue problems."""

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
        n, place = self.rotor.n_dof, self.rotor.dofs(self.bearing)
        speed = np.atleast_1d(np.asarray(speed, np.float64))
        matrices = self.rotor.matrices
        k: FloatArray = np.repeat(matrices.stiffness[None], speed.size, axis=0)
        c: FloatArray = matrices.damping + speed[:, None, None] * matrices.gyroscopic
        rows = np.ix_(range(speed.size), place, place)
        k[rows] += stiffness
        c[rows] += damping
        system = np.zeros((speed.size, 2 * n, 2 * n))
        system[:, :n, n:] = np.eye(n)
        system[:, n:, :n], system[:, n:, n:] = -self.inverse_mass @ k, -self.inverse_mass @ c
        return system

    def growth(self, speed: FloatArray, stiffness: FloatArray, damping: FloatArray) -> FloatArray:
        """Largest growth rate [1/s] of modes with motion of the journal, (n_speed,); arguments as in `system`."""
        eigen = np.linalg.eig(self.system(speed, stiffness, damping))
        moving = self.moving(np.asarray(eigen.eigenvectors, np.complex128))
        return np.max(np.where(moving, eigen.eigenvalues.real, -np.inf), axis=-1)

    def eigenvalues(self, speed: FloatArray, stiffness: FloatArray, damping: FloatArray) -> ComplexArray:
        """All eigenvalues [1/s], (n_speed, 2 n_dof); arguments as in `system`."""
        return np.asarray(np.linalg.eigvals(self.system(speed, stiffness, damping)), np.complex128)

    def least_stable(self, speed: float, stiffness: FloatArray, damping: FloatArray) -> LeastStable:
        """The least stable mode at one *speed* [rad/s], with the derivatives (2, 2) of its growth rate by the bearing's coefficients.

        d lambda = y^T (dA) x / (y^T x) with left and right eigenvectors y, x of A. Equation (rotor-least-stable).
        """
        system = self.system(np.array([speed]), stiffness, damping)[0]
        roots, left_vectors, right_vectors = linalg.eig(system, left=True, right=True)
        chosen = int(np.argmax(np.where(self.moving(right_vectors) & (roots.imag >= 0), roots.real, -np.inf)))
        n, place = self.rotor.n_dof, self.rotor.dofs(self.bearing)
        y, x = left_vectors[:, chosen].conj(), right_vectors[:, chosen]
        force_factor = (y[n:] @ self.inverse_mass[:, place]) / (y @ x)
        slopes = -np.outer(force_factor, x[place])
        return LeastStable(complex(roots[chosen]), slopes.real, (slopes * roots[chosen]).real)

    def moving(self, vectors: ComplexArray) -> BoolArray:
        """Modes (..., n_mode) with motion of the journal; *vectors* (..., 2 n_dof, n_mode) [any unit]."""
        n = self.rotor.n_dof
        squares = np.abs(vectors[..., :n, :]) ** 2
        whole = squares[..., 0::4, :].sum(axis=-2) + squares[..., 1::4, :].sum(axis=-2)
        share = squares[..., self.rotor.dofs(self.bearing), :].sum(axis=-2) / np.maximum(whole, 1e-300)
        moving: BoolArray = share > LEAST_PARTICIPATION
        return moving


def threshold_speed(
    stability: Stability, coefficients: CoefficientsAtSpeed, speeds: Iterable[float], tolerance: float = 1e-4
) -> float | None:
    """Threshold speed of instability [rad/s], between the first pair of *speeds* around it; None for a rotor stable at all of them.

    FitError for a rotor unstable at the first speed.
    """
    speed = np.asarray(list(speeds), np.float64)
    unstable = stability.growth(speed, *coefficients(speed)) > GROWTH_TOLERANCE
    if unstable[0]:
        raise FitError(f"the rotor is unstable already at {speed[0] * 30 / np.pi:.0f} rpm", hint="start the search at a lower speed")
    if not np.any(unstable):
        return None
    first = int(np.argmax(unstable))

    def excess(speed: float) -> float:
        place = np.array([speed])
        return float(stability.growth(place, *coefficients(place))[0]) - GROWTH_TOLERANCE

    return float(optimize.brentq(excess, speed[first - 1], speed[first], xtol=tolerance))


def refuse_unstable(stability: Stability, coefficients: CoefficientsAtSpeed, speed: FloatArray) -> None:
    """FitError naming the first of the speeds (n_speed,) [rad/s] at which the rotor is unstable and has no steady amplitude."""
    speed = np.asarray(speed, np.float64)
    growth = stability.growth(speed, *coefficients(speed))
    if np.any(growth > GROWTH_TOLERANCE):
        first = int(np.argmax(growth > GROWTH_TOLERANCE))
        rpm = speed[first] * 30 / np.pi
        raise FitError(
            f"at {rpm:.0f} rpm the rotor is unstable (growth rate {growth[first]:.3g} 1/s): there is no steady amplitude",
            hint="keep to speeds below the threshold of instability",
        )


def resonance_speed(stability: Stability, coefficients: CoefficientsAtSpeed, speeds: Iterable[float]) -> float | None:
    """The first speed [rad/s] equal to the imaginary part of a damped mode with motion of the journal; None when there is none.

    The critical speed by eigenvalues: lightly damped modes only (damping ratio below one half), forward or backward.
    """
    speed = np.asarray(list(speeds), np.float64)
    frequencies = [_damped_frequencies(stability, coefficients, value) for value in speed]
    # Number of modes below 1x at every speed: it grows where a mode is crossed.
    below = [int(np.sum(modes < value)) for modes, value in zip(frequencies, speed, strict=True)]
    for n in range(1, speed.size):
        if below[n] > below[n - 1]:
            return _crossing(stability, coefficients, (float(speed[n - 1]), float(speed[n])), below[n - 1])
    return None


def _crossing(stability: Stability, coefficients: CoefficientsAtSpeed, between: tuple[float, float], below: int) -> float:
    """The speed [rad/s] *between* two at which the number of modes below 1x rises above *below*."""
    low, high = between
    if _detuning(stability, coefficients, low) < 0 < _detuning(stability, coefficients, high):
        return float(optimize.brentq(lambda value: _detuning(stability, coefficients, value), low, high, xtol=RESONANCE_TOLERANCE))
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


def _detuning(stability: Stability, coefficients: CoefficientsAtSpeed, speed: float) -> float:
    """Speed minus the imaginary part of the nearest mode [rad/s]."""
    frequencies = _damped_frequencies(stability, coefficients, speed)
    return float(speed - frequencies[np.argmin(np.abs(frequencies - speed))])
