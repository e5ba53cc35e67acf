"""Effective stiffness and damping of a forward circular orbit, and the frequency at which that damping changes sign.

On x = r cos wt, y = r sin wt the force along and against the motion is that of H_f = (H_xx + H_yy - j (H_xy - H_yx)) / 2:
K_eff = Re H_f, C_eff = Im H_f / w; of K, C and M: C_eff = (C_xx + C_yy) / 2 - (K_xy - K_yx - w^2 (M_xy - M_yx)) / (2 w).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.dynamic_stiffness.forms import StiffnessModel
from labpipe.dynamic_stiffness.whirl import LIMIT

# Frequencies at which a change of sign is looked for: from this share of the lowest line to that of the highest.
SHARES = (0.05, 1.5)
N_FREQUENCY = 4000


@dataclass(frozen=True)
class Course:
    """K_eff [N/m] and C_eff [N.s/m] (n_line,) at omega (n_line,) [rad/s], with standard errors of the same shape and unit."""

    omega: FloatArray
    stiffness: FloatArray
    stiffness_error: FloatArray
    damping: FloatArray
    damping_error: FloatArray


def forward(stiffness: ComplexArray, sense: float = 1.0) -> ComplexArray:
    """H_f (...,) [N/m] of H (..., 2, 2); *sense*: 1 for a shaft that turns from x to y, -1 against it. Equation (ds-forward)."""
    direct = stiffness[..., 0, 0] + stiffness[..., 1, 1]
    return np.asarray((direct - 1j * sense * (stiffness[..., 0, 1] - stiffness[..., 1, 0])) / 2)


def effective(model: StiffnessModel, values: FloatArray, covariance: FloatArray, omega: FloatArray, sense: float = 1.0) -> Course:
    """The course at omega (n_line,) [rad/s] of values (n_parameter,) with their covariance (n_parameter, n_parameter) [parameter units].

    Equation (ds-effective).
    """
    h = forward(model.stiffness(values, omega), sense)
    slopes = forward(model.jacobian(values, omega), sense)
    errors = [np.sqrt(np.maximum(np.sum(part * (covariance @ part), axis=0), 0.0)) for part in (slopes.real, slopes.imag)]
    return Course(omega, h.real, errors[0], h.imag / omega, errors[1] / omega)


@dataclass(frozen=True)
class Crossover:
    """Frequency w [rad/s] above which damping is positive, its slopes (n_parameter,) [per parameter unit] and 95 % interval (Fieller)."""

    omega: float
    slopes: FloatArray
    interval: tuple[float, float]


def crossover(model: StiffnessModel, values: FloatArray, covariance: FloatArray, band: FloatArray, sense: float = 1.0) -> Crossover | None:
    """The highest frequency at which C_eff turns from negative to positive; None where it does not; *band* omega (n_line,) [rad/s]."""
    omega = np.geomspace(SHARES[0] * band[0], SHARES[1] * band[-1], N_FREQUENCY)
    course = effective(model, values, covariance, omega, sense)
    signs = np.sign(course.damping)
    turns = np.flatnonzero((signs[:-1] < 0) & (signs[1:] >= 0))
    if not turns.size:
        return None
    at = int(turns[-1])
    frequency = _zero(omega, course.damping, at)
    slopes = forward(model.jacobian(values, np.array([frequency])), sense).imag[:, 0] / frequency
    along = float((course.damping[at + 1] - course.damping[at]) / (omega[at + 1] - omega[at]))
    upper, lower = course.damping + LIMIT * course.damping_error, course.damping - LIMIT * course.damping_error
    below = np.flatnonzero(upper[: at + 1] < 0)
    above = np.flatnonzero(lower[at + 1 :] > 0)
    low = _zero(omega, upper, int(below[-1])) if below.size else -np.inf
    high = _zero(omega, lower, at + int(above[0])) if above.size else np.inf
    return Crossover(frequency, -slopes / along, (low, high))


def _zero(omega: FloatArray, values: FloatArray, at: int) -> float:
    """Where the straight line from point *at* to the next is zero."""
    step = values[at + 1] - values[at]
    return float(omega[at] - values[at] * (omega[at + 1] - omega[at]) / step) if step else float(omega[at])
