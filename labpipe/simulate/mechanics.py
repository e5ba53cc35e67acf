"""Truth of the virtual rig: dynamic stiffness over frequency, and its exact periodic steady state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from labpipe.signals.excitation import Multisine
from labpipe.simulate.settings import Levitation, VirtualRig

Complex = NDArray[np.complexfloating]

# Two force directions are tested on coefficients that differ in every place, as a fluid-film bearing's do.
COUPLED_STIFFNESS = np.array([[180e3, 25e3], [-18e3, 210e3]])
COUPLED_DAMPING = np.array([[120.0, 15.0], [-10.0, 150.0]])


def levitation_stiffness(levitation: Levitation, omega: NDArray[np.floating]) -> Complex:
    """k(w) + j w c(w) of all bearings together [N/m], (n_line,)."""
    relative: Complex = 1j * omega / (2 * np.pi * levitation.corner)
    one = levitation.static + levitation.dynamic * relative / (1 + relative)
    return levitation.bearings * one


def one_direction(rig: VirtualRig, omega: NDArray[np.floating], levitated: bool) -> Complex:
    """Dynamic stiffness k + j w c - w^2 m of pedestal alone or with the levitated rotor, (n_line,) [N/m]."""
    mass = rig.rotor_mass if levitated else rig.pedestal_mass
    stiffness: Complex = rig.pedestal_stiffness + 1j * omega * rig.pedestal_damping - omega**2 * mass
    return stiffness + levitation_stiffness(rig.levitation, omega) if levitated else stiffness


def axial(rig: VirtualRig, omega: NDArray[np.floating]) -> Complex:
    """Axial dynamic stiffness, (n_line,) [N/m]."""
    stiffness: Complex = rig.axial_stiffness + 1j * omega * rig.axial_damping - omega**2 * rig.axial_mass
    return stiffness


def coupled(rig: VirtualRig, omega: NDArray[np.floating]) -> Complex:
    """Dynamic stiffness matrix of the cross-coupled support, (n_line, 2, 2) [N/m]."""
    w = omega[:, None, None]
    matrix: Complex = COUPLED_STIFFNESS + 1j * w * COUPLED_DAMPING - w**2 * rig.rotor_mass * np.eye(2)
    return matrix


def line_frequencies(force: Multisine) -> NDArray[np.floating]:
    """Angular frequencies of the excited lines [rad/s], (n_line,)."""
    return 2 * np.pi * force.spacing * force.lines


def steady_state(force: Multisine, receptance: Complex, n_sample: int, periods: int) -> NDArray[np.floating]:
    """Displacement (n_sample * periods,) [m] under the multisine, exact line by line: X_k = H(w_k) F_k."""
    amplitude = force.rms * np.sqrt(2 / force.lines.size)
    spectrum = np.zeros(n_sample // 2 + 1, np.complex128)
    spectrum[force.lines] = receptance * amplitude * np.exp(1j * force.phases) * (n_sample / 2)
    return np.tile(fft.irfft(spectrum, n_sample), periods)


def free_decay(displacement: NDArray[np.floating], sample_rate: float, frequency: float, damping_ratio: float) -> NDArray[np.floating]:
    """The transient that makes the motion start at rest: -x(0) e^{-zeta w t} cos(w t), (n_sample,) [m]."""
    t = np.arange(displacement.size) / sample_rate
    omega = 2 * np.pi * frequency
    decay: NDArray[np.floating] = -displacement[0] * np.exp(-damping_ratio * omega * t) * np.cos(omega * t)
    return decay
