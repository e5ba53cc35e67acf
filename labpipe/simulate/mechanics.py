"""Truth of the virtual rig: dynamic stiffness over frequency, and its exact periodic steady state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_loop import dynamic_stiffness, inferred_negative_stiffness
from labpipe.signals.excitation import Multisine
from labpipe.simulate.magnetic_settings import Levitation, VirtualMagneticRig

# Two force directions are tested on coefficients that differ in every place, as a fluid-film bearing's do.
COUPLED_STIFFNESS = np.array([[180e3, 25e3], [-18e3, 210e3]])
COUPLED_DAMPING = np.array([[120.0, 15.0], [-10.0, 150.0]])


# Periods that are averaged; transient periods come before them.
PERIODS = 5


@dataclass(frozen=True)
class Timing:
    """Sampling of a periodic run: *sample_rate* [Hz], line *spacing* [Hz], number of *transient* periods."""

    sample_rate: float
    spacing: float
    transient: int

    @property
    def n_sample(self) -> int:
        """Samples of one period."""
        return round(self.sample_rate / self.spacing)

    @property
    def periods(self) -> int:
        return self.transient + PERIODS


def relaxation(levitation: Levitation, omega: FloatArray) -> ComplexArray:
    """k(w) + j w c(w) = k_0 + k_1 j w tau / (1 + j w tau) of one bearing at *omega* [rad/s], (n_line,) [N/m]. Equation (sim-relaxation)."""
    relative: ComplexArray = 1j * omega / (2 * np.pi * levitation.corner)
    return levitation.static + levitation.dynamic * relative / (1 + relative)


def control_loop(levitation: Levitation, omega: FloatArray) -> ComplexArray:
    """k(w) + j w c(w) = K G(jw) - k_n of one bearing under position control at *omega* [rad/s], (n_line,) [N/m].

    Lim et al. (2009), eq. 7 and table 1; the negative stiffness k_n is what leaves the static stiffness k_0 at rest.
    """
    return dynamic_stiffness(levitation.loop, negative_stiffness(levitation), omega)


def negative_stiffness(levitation: Levitation) -> float:
    """Pull of the bias field per displacement, k_n = K G(0) - k_0 of one bearing [N/m]."""
    return inferred_negative_stiffness(levitation.loop, levitation.static)


LEVITATION_LAWS: dict[str, Callable[[Levitation, FloatArray], ComplexArray]] = {
    "relaxation": relaxation,
    "control-loop": control_loop,
}


def levitation_stiffness(levitation: Levitation, omega: FloatArray) -> ComplexArray:
    """k(w) + j w c(w) of all bearings together at *omega* [rad/s], (n_line,) [N/m]."""
    return levitation.bearings * LEVITATION_LAWS[levitation.law](levitation, omega)


def one_dof(mass: float, stiffness: float, damping: float, omega: FloatArray) -> ComplexArray:
    """Dynamic stiffness k - w^2 m + j w c at *omega* [rad/s], (n_line,) [N/m]. Equation (sim-one-dof)."""
    dynamic: ComplexArray = stiffness - omega**2 * mass + 1j * omega * damping
    return dynamic


def levitated(rig: VirtualMagneticRig, omega: FloatArray) -> ComplexArray:
    """Dynamic stiffness of pedestal and levitated rotor in one direction at *omega* [rad/s], (n_line,) [N/m]. Equation (sim-levitated)."""
    pedestal = one_dof(rig.rotor_mass, rig.pedestal_stiffness, rig.pedestal_damping, omega)
    return pedestal + levitation_stiffness(rig.levitation, omega)


def coupled(rig: VirtualMagneticRig, omega: FloatArray) -> ComplexArray:
    """Dynamic stiffness matrix of the cross-coupled support, (n_line, 2, 2) [N/m]."""
    w = omega[:, None, None]
    matrix: ComplexArray = COUPLED_STIFFNESS + 1j * w * COUPLED_DAMPING - w**2 * rig.rotor_mass * np.eye(2)
    return matrix


def line_frequencies(force: Multisine) -> FloatArray:
    """Angular frequencies of the excited lines [rad/s], (n_line,)."""
    return 2 * np.pi * force.spacing * force.lines


def line_amplitude(force: Multisine) -> float:
    """Amplitude of each line of a flat multisine, rms sqrt(2 / n_line) [N]. Equation (sim-line-amplitude)."""
    return float(force.rms * np.sqrt(2 / force.lines.size))


def steady_state(force: Multisine, receptance: ComplexArray, n_sample: int, periods: int) -> FloatArray:
    """Displacement (n_sample periods,) [m] under the multisine, exact line by line: X_k = H(w_k) F_k; *receptance* (n_line,) [m/N].

    Equation (sim-steady).
    """
    spectrum = np.zeros(n_sample // 2 + 1, np.complex128)
    spectrum[force.lines] = receptance * line_amplitude(force) * np.exp(1j * force.phases) * (n_sample / 2)
    return np.tile(fft.irfft(spectrum, n_sample), periods)


def free_decay(displacement: FloatArray, sample_rate: float, frequency: float, damping_ratio: float) -> FloatArray:
    """The transient that makes the motion start at rest: -x(0) e^{-zeta w t} cos(w t), (n_sample,) [m]. Equation (sim-transient)."""
    t = np.arange(displacement.size) / sample_rate
    omega = 2 * np.pi * frequency
    decay: FloatArray = -displacement[0] * np.exp(-damping_ratio * omega * t) * np.cos(omega * t)
    return decay
