"""Eigenvalues of a rotor on its bearings: modes, the Campbell diagram, stability and the onset speed of instability."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.rotors.assembly import RotorMatrices, supported_rotor
from labpipe.rotors.parts import Rotor, Support

# Growth rates [1/s] below this are rounding errors, of undamped modes for example.
GROWTH_TOLERANCE = 1e-3
# Least imaginary part over modulus of an oscillating eigenvalue: rounding splits double real roots by this much.
LEAST_OSCILLATION = 1e-3

# Bearings as a function of the spin speed [rad/s].
SupportsAtSpeed = Callable[[float], Iterable[Support]]


@dataclass(frozen=True)
class Modes:
    """Oscillating modes at one spin speed [rad/s], in ascending order of damped frequency.

    eigenvalues (n_mode,) [1/s] with positive imaginary part; shapes (n_mode, n_node, 2), y and z, largest deflection 1.
    """

    speed: float
    eigenvalues: ComplexArray
    shapes: ComplexArray

    @property
    def damped_frequency(self) -> FloatArray:
        """Damped natural frequency Im(lambda) / 2 pi [Hz], (n_mode,)."""
        return self.eigenvalues.imag / (2 * np.pi)

    @property
    def natural_frequency(self) -> FloatArray:
        """Undamped natural frequency |lambda| / 2 pi [Hz], (n_mode,)."""
        return np.abs(self.eigenvalues) / (2 * np.pi)

    @property
    def damping_ratio(self) -> FloatArray:
        """zeta = -Re(lambda) / |lambda| [-], (n_mode,); negative for an unstable mode. Equation (rotor-damping-ratio)."""
        return -self.eigenvalues.real / np.abs(self.eigenvalues)

    @property
    def whirl(self) -> FloatArray:
        """Whirl direction over all nodes, (n_mode,) [-]: -1 circular backward, 0 straight line, +1 circular forward.

        Equation (rotor-whirl).
        """
        forward, backward = (np.sum(np.abs(self.shapes @ [1, turn]) ** 2, axis=1) for turn in (1j, -1j))
        return (forward - backward) / (forward + backward)


def eigenvalues(matrices: RotorMatrices, speed: float) -> tuple[ComplexArray, ComplexArray]:
    """All eigenvalues (2 n_dof,) [1/s] and displacement shapes (n_dof, 2 n_dof) of M q'' + (C + Omega G) q' + K q = 0.

    Equation (rotor-eigenvalues).
    """
    n = matrices.mass.shape[0]
    inverse = linalg.cho_factor(matrices.mass)
    upper = np.concatenate([np.zeros((n, n)), np.eye(n)], axis=1)
    lower = -linalg.cho_solve(inverse, np.concatenate([matrices.stiffness, matrices.at_speed(speed)], axis=1))
    roots, vectors = linalg.eig(np.concatenate([upper, lower]))
    return roots, vectors[:n]


def modes(rotor: Rotor, supports: Iterable[Support], speed: float) -> Modes:
    """The oscillating modes of a rotor at a spin *speed* [rad/s]."""
    roots, vectors = eigenvalues(supported_rotor(rotor, supports), speed)
    oscillating = np.flatnonzero(roots.imag > LEAST_OSCILLATION * np.abs(roots))
    oscillating = oscillating[np.argsort(roots[oscillating].imag)]
    shapes = np.stack([vectors[0::4, oscillating], vectors[1::4, oscillating]], axis=-1).swapaxes(0, 1)
    flat = shapes.reshape(oscillating.size, -1)
    largest = flat[np.arange(oscillating.size), np.argmax(np.abs(flat), axis=1)]
    return Modes(speed, roots[oscillating], shapes / largest[:, None, None])


def campbell(rotor: Rotor, supports: SupportsAtSpeed, speeds: Iterable[float]) -> list[Modes]:
    """Modes at every spin speed [rad/s], for a Campbell diagram; *supports* gives the bearings at each speed."""
    return [modes(rotor, supports(speed), speed) for speed in speeds]


def growth_rate(rotor: Rotor, supports: Iterable[Support], speed: float) -> float:
    """Largest real part of the eigenvalues [1/s]; positive means unstable. Equation (rotor-onset)."""
    roots, _ = eigenvalues(supported_rotor(rotor, supports), speed)
    return float(np.max(roots.real))


def onset_speed(rotor: Rotor, supports: SupportsAtSpeed, speeds: Iterable[float], tolerance: float = 1e-3) -> float | None:
    """Onset speed of instability [rad/s], between the first pair of *speeds* around it; None for a rotor stable at all of them.

    FitError for a rotor unstable at the first speed.
    """

    def excess(speed: float) -> float:
        return growth_rate(rotor, supports(speed), speed) - GROWTH_TOLERANCE

    stable = None
    for speed in speeds:
        if excess(speed) > 0:
            if stable is None:
                raise FitError(f"the rotor is unstable already at {speed:g} rad/s", hint="start the search at a lower speed")
            return float(optimize.brentq(excess, stable, speed, xtol=tolerance))
        stable = speed
    return None
