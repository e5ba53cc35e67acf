"""Runs of one force and one displacement: excitation, duration, Cramer-Rao errors of k and c. ONE_DOF by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.errors import ConfigError
from labpipe.registry import nearest
from labpipe.signals.excitation import Multisine, design_multisine
from labpipe.simulate import mechanics
from labpipe.simulate.magnetic_settings import VirtualMagneticRig
from labpipe.simulate.mechanics import PERIODS, Timing

# Forces [N rms] by which pedestal and rotor stay within 40 um.
PEDESTAL_FORCE, AXIAL_FORCE = 0.3, 0.3


@dataclass(frozen=True)
class OneDofRun:
    """Mass [kg] on spring [N/m] and damper [N.s/m] along *dof*, under a multisine."""

    force: Multisine
    timing: Timing
    dof: str
    mass: float
    stiffness: float
    damping: float

    @property
    def natural_frequency(self) -> float:
        """sqrt(k / m) / 2 pi [Hz]."""
        return float(np.sqrt(self.stiffness / self.mass)) / (2 * np.pi)

    @property
    def damping_ratio(self) -> float:
        """zeta = c / (2 m w_n)."""
        return self.damping / (2 * self.mass * float(np.sqrt(self.stiffness / self.mass)))

    @property
    def truth(self) -> dict[str, Any]:
        return {
            "mass": self.mass,
            "k": self.stiffness,
            "c": self.damping,
            "f_n": self.natural_frequency,
            "zeta": self.damping_ratio,
        }


def pedestal(rig: VirtualMagneticRig) -> OneDofRun:
    """The pedestal alone: 1-100 Hz every 0.5 Hz."""
    force = design_multisine((1.0, 100.0), 0.5, PEDESTAL_FORCE)
    return OneDofRun(force, Timing(1000.0, 0.5, 3), "y", rig.pedestal_mass, rig.pedestal_stiffness, rig.pedestal_damping)


def axial(rig: VirtualMagneticRig) -> OneDofRun:
    """The axial direction: 1-50 Hz every 0.5 Hz."""
    force = design_multisine((1.0, 50.0), 0.5, AXIAL_FORCE)
    return OneDofRun(force, Timing(500.0, 0.5, 1), "z", rig.axial_mass, rig.axial_stiffness, rig.axial_damping)


ONE_DOF: dict[str, Callable[[VirtualMagneticRig], OneDofRun]] = {"pedestal": pedestal, "axial": axial}


def expected_std_error(rig: VirtualMagneticRig, name: str, band: tuple[float, float]) -> dict[str, float]:
    """Cramer-Rao standard errors of k [N/m] and c [N.s/m] from the lines of run *name* within *band* [Hz], mass known.

    With both channels noisy, the residual Y - H F of a line has the variance s_y^2 + |H|^2 s_f^2, where s^2 = 4 sigma^2 / n over
    n averaged samples is the variance of a complex amplitude. Information: 2 sum Re(dH^* dH^T) |F|^2 / variance, with
    dH/dk = -H^2, dH/dc = -j w H^2. Holds while the noise of a line's force is small beside the force. ConfigError for a run that is
    not of one degree of freedom, a band without lines, or a rig without noise. Equation (sim-bound).
    """
    if name not in ONE_DOF:
        raise ConfigError(f"run '{name}' has no single k and c", hint=nearest(name, ONE_DOF))
    run = ONE_DOF[name](rig)
    frequency = run.force.spacing * run.force.lines
    omega = 2 * np.pi * frequency[(frequency >= band[0] - 1e-9) & (frequency <= band[1] + 1e-9)]
    if not omega.size:
        raise ConfigError(f"no line of run '{name}' lies in {band[0]:g}-{band[1]:g} Hz")
    if rig.noise.displacement == 0 and rig.noise.force == 0:
        raise ConfigError("a rig without noise has no standard errors")
    receptance = 1 / mechanics.one_dof(run.mass, run.stiffness, run.damping, omega)
    line_variance = 4 / (PERIODS * run.timing.n_sample)
    variance = line_variance * (rig.noise.displacement**2 + np.abs(receptance) ** 2 * rig.noise.force**2)
    amplitude = mechanics.line_amplitude(run.force)
    slopes = np.array([-(receptance**2), -1j * omega * receptance**2]) * amplitude / np.sqrt(variance)
    std_error = np.sqrt(np.diag(np.linalg.inv(2 * (slopes.conj() @ slopes.T).real)))
    return {"k": float(std_error[0]), "c": float(std_error[1])}
