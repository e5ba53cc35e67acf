"""Rigid shaft on one rolling bearing: natural frequencies and the theoretical transfer matrix of its five coordinates.

M q'' + C q' + K q = f, q = (x, y, z, bx, by) at the bearing's centre, which is the shaft's centre of mass; C = beta K.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.rolling import DOFS
from labpipe.errors import ConfigError, FitError
from labpipe.records.response import FrequencyResponse, Port


@dataclass(frozen=True)
class RigidShaft:
    """A rigid shaft: mass m [kg], moments of inertia about x and y [kg m^2]."""

    mass: float
    inertia_x: float
    inertia_y: float

    def __post_init__(self) -> None:
        for name in ("mass", "inertia_x", "inertia_y"):
            if not 0 < getattr(self, name) < np.inf:
                raise ConfigError(f"the shaft's {name} must be above zero")

    @property
    def inertias(self) -> FloatArray:
        """Diagonal of M = diag(m, m, m, Jx, Jy), (5,) [kg, kg m^2]."""
        return np.array([self.mass, self.mass, self.mass, self.inertia_x, self.inertia_y])


@dataclass(frozen=True)
class Modes:
    """Undamped modes in ascending order: frequency (5,) [Hz]; shape (5, 5), columns with phi^T M phi = 1.

    share (5, 5): share of dof i (row) of the modal mass of mode r (column), M_ii phi_ir^2; rows and columns sum to one.
    """

    frequency: FloatArray
    shape: FloatArray
    share: FloatArray

    def damping_ratio(self, beta: float) -> FloatArray:
        """zeta_r = beta w_r / 2 of Rayleigh damping C = beta K, beta [s]; (5,)."""
        return np.pi * beta * self.frequency

    def main_mode(self, dof: str) -> int:
        """The mode with the largest share of the dof's inertia: its peak in the direct transfer function."""
        return int(np.argmax(self.share[DOFS.index(dof)]))


def modes(shaft: RigidShaft, stiffness: FloatArray) -> Modes:
    """Eigenvalues of K phi = w^2 M phi; *stiffness* (5, 5) [N/m, N/rad, N m/rad], a dof without stiffness gives 0 Hz.

    Raises FitError for a stiffness that is not positive semidefinite (beyond rounding): such an equilibrium is unstable.
    Equation (roll-modes).
    """
    scale = 1 / np.sqrt(shaft.inertias)
    squares, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2 * np.outer(scale, scale))
    if squares[0] < -1e-9 * squares[-1]:
        raise FitError("the stiffness matrix has a negative eigenvalue", hint="the shaft does not rest there")
    frequency = np.sqrt(np.maximum(squares, 0.0)) / (2 * np.pi)
    return Modes(frequency, scale[:, None] * vectors, vectors**2)


def transfer_matrix(shaft: RigidShaft, stiffness: FloatArray, frequency: FloatArray, beta: float) -> ComplexArray:
    """Receptance H(w) = (-w^2 M + j w beta K + K)^-1, (n_frequency, 5, 5) [m/N, rad/N, rad/(N m)]; *frequency* [Hz], *beta* [s].

    *stiffness* (5, 5) [N/m, N/rad, N m/rad]. FitError where the dynamic stiffness is singular: at 0 Hz with a dof without stiffness, or on
    an undamped resonance. Equation (roll-transfer).
    """
    w = 2 * np.pi * np.asarray(frequency, np.float64)[:, None, None]
    dynamic: ComplexArray = -(w**2) * np.diag(shaft.inertias) + (1 + 1j * w * beta) * stiffness
    try:
        receptance: ComplexArray = np.linalg.inv(dynamic)
    except np.linalg.LinAlgError:
        raise FitError("the dynamic stiffness is singular at a line", hint="give a damping factor, or leave out 0 Hz") from None
    return receptance


def theoretical_response(
    shaft: RigidShaft, stiffness: FloatArray, frequency: FloatArray, beta: float, name: str = "theory"
) -> FrequencyResponse:
    """The transfer matrix as a frequency response, for comparison with a measured one or for a fit.

    *stiffness* (5, 5) [N/m, N/rad, N m/rad], *frequency* (n_frequency,) [Hz], *beta* [s]. Raises as transfer_matrix does.
    """
    ports = tuple(Port(dof, dof, dof) for dof in DOFS)
    return FrequencyResponse(frequency, transfer_matrix(shaft, stiffness, frequency, beta), ports, ports, form="receptance", name=name)


def sdof_stiffness(shaft: RigidShaft, stiffness: FloatArray, known_inertia: bool = False) -> FloatArray:
    """Stiffness from a one-dof fit at each dof's main peak, lightly damped: k_i = w_r^2 / phi_ir^2, (5,) [N/m, N m/rad].

    With *known_inertia* the fit's mass is M_ii instead of the modal 1/phi_ir^2: k_i = M_ii w_r^2. Neither equals K_ii: at the peak the
    coupled dofs move as well, M_ii w_r^2 = K_ii + sum_j K_ij phi_jr / phi_ir, which makes the lower mode of a coupled pair appear softer
    and the upper one stiffer. A measured fit is therefore to be compared with the fit of the theoretical curve, not with K_ii.
    Equation (roll-sdof).
    """
    shaft_modes = modes(shaft, stiffness)
    main = [shaft_modes.main_mode(dof) for dof in DOFS]
    squares = (2 * np.pi * shaft_modes.frequency[main]) ** 2
    apparent: FloatArray = squares * shaft.inertias
    return apparent if known_inertia else apparent / shaft_modes.share[range(len(DOFS)), main]
