"""What a force spectrum tells about coefficients: the Fisher information per line and per second, with noise in all sensors.

Residual e = F - M_s A - D(theta) X. Noise densities S_F, S_X, S_A (one-sided) give its density
Lambda = (S_F^2 + M_s^2 S_A^2) I + S_X^2 D D^H, and T seconds with the mean-square force spectrum Phi = F F^H / 2 and X = H F tell
I_ij = 2 T sum_l Re tr[(E_i H)^H Lambda^-1 (E_j H) Phi_l]. That is the information of errors in variables with a deterministic input
(Pintelon and Schoukens 2012, System Identification, sec. 9.10), linear in the spectrum and in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.planner.model import PlannedModel


@dataclass(frozen=True)
class Noise:
    """One-sided densities of the sensors' white noise: force [N/sqrt(Hz)], displacement [m/sqrt(Hz)], acceleration [m/(s^2.sqrt(Hz))]."""

    force: float = 0.0
    displacement: float = 0.0
    acceleration: float = 0.0

    def __post_init__(self) -> None:
        if min(self.force, self.displacement, self.acceleration) < 0:
            raise ConfigError("a noise is negative", field="noise")
        if max(self.force, self.displacement) == 0:
            raise ConfigError(
                "no sensor has noise, any excitation would do", hint="state the noise of force and displacement", field="noise"
            )

    @classmethod
    def of_samples(cls, force: float, displacement: float, acceleration: float, sample_rate: float) -> Noise:
        """From standard deviations per sample [N, m, m/s^2] at *sample_rate* [Hz]: S = s sqrt(2 / f_s). Equation (plan-noise)."""
        factor = float(np.sqrt(2 / sample_rate))
        return cls(force * factor, displacement * factor, acceleration * factor)


def sensitivities(model: PlannedModel, noise: Noise, omega: FloatArray) -> ComplexArray:
    """L^-1 E_i H theta_i with L L^H = Lambda, (n_line, n_coefficient, n_dof, n_dof) [1/N.sqrt(Hz)], at omega (n_line,) [rad/s].

    A relative change of coefficient i changes the residual of a force u by that times u, in units of the residual's noise.
    Equation (plan-sensitivity).
    """
    stiffness = model.stiffness(omega)
    plain = noise.force**2 + (model.stator_mass * noise.acceleration) ** 2
    density = plain * np.eye(model.n_dof) + noise.displacement**2 * stiffness @ stiffness.conj().swapaxes(-1, -2)
    whitener = np.linalg.inv(np.linalg.cholesky(density))
    return np.asarray(whitener[:, None] @ model.elements_at(omega) @ model.receptance(omega)[:, None] * model.scales[:, None, None])


def vector_information(sensitivity: ComplexArray, forces: ComplexArray) -> FloatArray:
    """Information per second of force amplitudes *forces* (n_line, n_dof) [N], (n_line, n_coefficient, n_coefficient) [1/s].

    sensitivity (n_line, n_coefficient, n_dof, n_dof) [1/N.sqrt(Hz)]; of relative coefficients. Equation (plan-vector).
    """
    change = np.einsum("lnij,lj->lni", sensitivity, forces)
    return np.asarray(np.einsum("lni,lmi->lnm", change.conj(), change).real)


def spectrum_information(sensitivity: ComplexArray, spectrum: ComplexArray) -> FloatArray:
    """Information per second of Hermitian mean-square spectra (n_line, n_dof, n_dof) [N^2], (n_line, n_coefficient, n_coefficient) [1/s].

    sensitivity (n_line, n_coefficient, n_dof, n_dof) [1/N.sqrt(Hz)]: 2 Re tr(G_i^H G_j Phi) of relative coefficients.
    Equation (plan-spectrum).
    """
    return np.asarray(2 * np.einsum("lnki,lmkj,lji->lnm", sensitivity.conj(), sensitivity, spectrum).real)


def relative_errors(information: FloatArray) -> FloatArray:
    """Smallest standard errors sqrt((I^-1)_ii) (n_coefficient,) [1]; infinite where the information (n, n) [1] is singular.

    Rows are scaled to unit diagonal before the inverse; a coefficient without information, or a condition beyond 1e13, is not determined.
    Equation (plan-errors).
    """
    diagonal = np.diagonal(information)
    if np.any(diagonal <= 0):
        return np.full(diagonal.size, np.inf)
    root = np.sqrt(diagonal)
    scaled = information / np.outer(root, root)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1e-13 * values[-1]:
        return np.full(diagonal.size, np.inf)
    return np.asarray(np.sqrt(np.sum(vectors**2 / values, axis=1)) / root)
