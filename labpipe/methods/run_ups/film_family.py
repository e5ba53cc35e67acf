"""The physical family of journal coefficients over load and speed: the Reynolds solution with a dozen
parameters.

All twelve are natural logarithms, zero for the rotor file's own bearing. With Omega_0, W_0 reference speed
and load

    mu(Omega, W) = mu_0 exp(a) (Omega / Omega_0)^b (W / W_0)^d,   c = c_0 exp(g),
    K_ij = W / c  k_ij(S) exp(f_ij),   C_ij = W / (c Omega)  c_ij(S) exp(f'_ij),   S from mu and c.

A larger clearance with more viscosity (mu / c^2 kept) only lowers all eight coefficients alike: clearance,
viscosity and the common factor are not identifiable separately by any run-up. Priors determine such
combinations (`PRIOR`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.journal_bearing.curve import JournalCurve, journal_curve, sommerfeld_number
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed

COEFFICIENTS = ("k_xx", "k_xy", "k_yx", "k_yy", "c_xx", "c_xy", "c_yx", "c_yy")
PARAMETERS = (
    "viscosity",
    "viscosity_speed",
    "viscosity_load",
    "clearance",
    *(f"factor_{name}" for name in COEFFICIENTS),
)
# Prior standard deviations of the logarithms.
PRIOR = np.array([0.5, 0.3, 0.3, 0.1, *[0.1] * 8])
# Bound of a logarithm; at the bound the rotor file describes another bearing.
BOUND = np.array([1.5, 1.0, 1.0, 0.4, *[0.5] * 8])


@dataclass(frozen=True)
class FilmFamily:
    """The family about a *bearing*; *speed* [rad/s] and *load* [N] are the references of the slopes."""

    bearing: JournalBearing
    speed: float
    load: float

    @property
    def curve(self) -> JournalCurve:
        return journal_curve(self.bearing.length / self.bearing.diameter, self.bearing.groove_width)

    def sommerfeld(self, values: FloatArray, load: FloatArray, speed: FloatArray) -> FloatArray:
        """S (n_point,) of the parameters *values* (12,) at loads [N] and speeds [rad/s], (n_point,)."""
        a, b, d, g = values[:4]
        change = a + b * np.log(speed / self.speed) + d * np.log(load / self.load) - 2 * g
        return sommerfeld_number(self.bearing, load, speed) * np.exp(change)

    def coefficients(self, values: FloatArray, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight COEFFICIENTS (n_point, 8) [N/m, N s/m]; FitError outside the bearing's table.

        Equation (run-family).
        """
        load, speed = np.broadcast_arrays(np.asarray(load, np.float64), np.asarray(speed, np.float64))
        curve_values = self.curve.coefficients(self.sommerfeld(values, load, speed))
        return self._joined(curve_values.stiffness, curve_values.damping) * self._scale(values, load, speed)

    def coefficients_and_slopes(
        self, values: FloatArray, load: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`coefficients` [N/m, N s/m] and their derivatives by PARAMETERS, (n_point, 8, 12)."""
        curve_values = self.curve.coefficients(self.sommerfeld(values, load, speed))
        scale = self._scale(values, load, speed)
        eight = self._joined(curve_values.stiffness, curve_values.damping) * scale
        by_place = self._joined(curve_values.stiffness_slope, curve_values.damping_slope) * scale
        slopes = np.zeros((*eight.shape, len(PARAMETERS)))
        slopes[..., 0] = by_place
        slopes[..., 1] = by_place * np.log(speed / self.speed)[:, None]
        slopes[..., 2] = by_place * np.log(load / self.load)[:, None]
        slopes[..., 3] = -2 * by_place - eight
        numbers = np.arange(8)
        slopes[:, numbers, 4 + numbers] = eight
        return eight, slopes

    def at_load(self, values: FloatArray, load: float) -> CoefficientsAtSpeed:
        """K [N/m] and C [N s/m], (n_speed, 2, 2), as a function of speed [rad/s]."""
        return lambda speed: as_matrices(self.coefficients(values, load, speed))

    def _scale(self, values: FloatArray, load: FloatArray, speed: FloatArray) -> FloatArray:
        per_length = load / (self.bearing.clearance * np.exp(values[3]))
        both = np.stack([per_length] * 4 + [per_length / speed] * 4, axis=-1)
        return both * np.exp(values[4:])

    @staticmethod
    def _joined(stiffness: FloatArray, damping: FloatArray) -> FloatArray:
        return np.concatenate(
            [stiffness.reshape(*stiffness.shape[:-2], 4), damping.reshape(*damping.shape[:-2], 4)], axis=-1
        )


def as_matrices(coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """K [N/m] and C [N s/m], (..., 2, 2) each, from eight COEFFICIENTS (..., 8)."""
    split = coefficients.reshape(*coefficients.shape[:-1], 2, 2, 2)
    return split[..., 0, :, :], split[..., 1, :, :]


def as_eight(stiffness: FloatArray, damping: FloatArray) -> FloatArray:
    """The eight COEFFICIENTS (..., 8) from K [N/m] and C [N s/m], (..., 2, 2)."""
    return FilmFamily._joined(np.asarray(stiffness), np.asarray(damping))


def carried_beyond(eight: Callable[[FloatArray], FloatArray], low: float, high: float) -> CoefficientsAtSpeed:
    """K and C over speed from coefficients (n_speed, 8) [N/m, N s/m] that are given from *low* to *high*
    [rad/s].

    Outside, K and Omega C stay constant, as those of a film at one Sommerfeld number.
    """

    def coefficients(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        speed = np.asarray(speed, np.float64)
        within = np.clip(speed, low, high)
        stiffness, damping = as_matrices(eight(within))
        return stiffness, damping * (within / speed)[..., None, None]

    return coefficients


def coefficient_errors(estimate: FloatArray, true: FloatArray) -> FloatArray:
    """rms error of *estimate* over the points, relative to the rms of the true coefficient, (8,) [-], of
    (n_point, 8) each.
    """
    return np.sqrt(np.mean((estimate - true) ** 2, axis=0) / np.mean(true**2, axis=0))
