"""Theoretical transfer matrix of a shaft that bends between its bearing and the place of excitation and measurement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.rolling_shaft import RigidShaft
from labpipe.errors import ConfigError, FitError

RADIAL = (0, 1)


def in_series(stiffness: NDArray[np.inexact], bending: float) -> ComplexArray:
    """K_total = (K^-1 + S)^-1, S = diag(1, 1, 0, 0, 0) / k_s: the bending shaft k_s [N/m] in series in x and y, (..., 5, 5).

    By Woodbury's identity K - K E (E^T K E + k_s)^-1 E^T K, so that K may be singular. An uncoupled radial coefficient becomes
    k k_s / (k + k_s), the series formula. Infinite k_s has no effect. ConfigError for k_s not above zero. Equation (roll-series-matrix).
    """
    if not bending > 0:
        raise ConfigError(f"the bending stiffness of the shaft is {bending:g} N/m", hint="it must be above zero")
    whole = np.asarray(stiffness, np.complex128)
    if np.isinf(bending):
        return whole
    columns = whole[..., :, RADIAL]
    inner = columns[..., RADIAL, :] + bending * np.eye(len(RADIAL))
    total: ComplexArray = whole - columns @ np.linalg.solve(inner, whole[..., RADIAL, :])
    return total


def bent_transfer_matrix(shaft: RigidShaft, stiffness: FloatArray, frequency: FloatArray, beta: float, bending: float) -> ComplexArray:
    """Receptance H(w) = (-w^2 M + K_total(w))^-1, (n_frequency, 5, 5) [m/N, rad/N, rad/(N m)].

    The bearing's (1 + j w beta) K, *beta* [s], in series with the bending shaft [N/m], which has no losses; *frequency* [Hz].
    FitError where the dynamic stiffness is singular.
    """
    w = 2 * np.pi * np.asarray(frequency, np.float64)[:, None, None]
    dynamic = in_series((1 + 1j * w * beta) * stiffness, bending) - w**2 * np.diag(shaft.inertias)
    try:
        receptance: ComplexArray = np.linalg.inv(dynamic)
    except np.linalg.LinAlgError:
        raise FitError("the dynamic stiffness is singular at a line", hint="give a damping factor, or leave out 0 Hz") from None
    return receptance
