"""Smooth fields over load and speed with a Gaussian process prior, and the film's family times such fields.

g_i(W, Omega), i one of the eight coefficients, are independent with mean zero and the covariance

    k = s^2 exp(-((W - W') / l_W)^2 / 2 - ((Omega - Omega') / l_Omega)^2 / 2)

(Rasmussen and Williams 2006, eq. 5.1). Between the places of the data they are g_i = b(W, Omega) z_i, z of unit variance a priori, b from
the eigenvectors of k over these places; the remaining variance elsewhere is *unexplained*.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.rigs.film_family import PARAMETERS, FilmFamily, as_matrices
from labpipe.rotors.threshold import CoefficientsAtSpeed

# Eigenvalues of the covariance below this part of the largest are left to the unexplained variance.
LEAST_EIGENVALUE = 1e-7


@dataclass(frozen=True)
class SquaredExponential:
    """*size* s [-], *load* l_W [N] and *speed* l_Omega [rad/s]."""

    size: float
    load: float
    speed: float

    def covariance(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """k (n_first, n_second) [-] between places (n, 2) of load [N] and speed [rad/s]. Equation (run-field)."""
        difference = (first[:, None, :] - second[None, :, :]) / np.array([self.load, self.speed])
        return np.asarray(self.size**2 * np.exp(-0.5 * np.sum(difference**2, axis=-1)))


@dataclass(frozen=True)
class SmoothField:
    """Fields of one *kernel* on the *places* (n_place, 2) [N, rad/s] of the data; *weights* (n_place, n_mode): U / sqrt(eigenvalue)."""

    kernel: SquaredExponential
    places: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, kernel: SquaredExponential, places: FloatArray) -> SmoothField:
        """The field of a *kernel* on the *places* (n_place, 2) [N, rad/s] of the data."""
        sizes, vectors = np.linalg.eigh(kernel.covariance(places, places))
        significant = sizes > LEAST_EIGENVALUE * sizes[-1]
        return cls(kernel, places, vectors[:, significant] / np.sqrt(sizes[significant]))

    @property
    def n_mode(self) -> int:
        return int(self.weights.shape[1])

    def basis(self, places: FloatArray) -> FloatArray:
        """b (n_point, n_mode) [-] at places (n_point, 2) [N, rad/s]. Equation (run-field-basis)."""
        return np.asarray(self.kernel.covariance(places, self.places) @ self.weights)

    def unexplained(self, places: FloatArray) -> FloatArray:
        """Covariance (n_point, n_point) [-] of a field beyond its basis, at places (n_point, 2) [N, rad/s]."""
        basis = self.basis(places)
        return np.asarray(self.kernel.covariance(places, places) - basis @ basis.T)


@dataclass(frozen=True)
class ProcessFamily:
    """The coefficients of a *family* times exp(g_i); parameters: the family's twelve, then z (8, n_mode) row by row."""

    family: FilmFamily
    field: SmoothField

    @property
    def n_parameter(self) -> int:
        return len(PARAMETERS) + 8 * self.field.n_mode

    def factors(self, values: FloatArray, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """exp(g), (n_point, 8) [-]."""
        basis = self.field.basis(places_of(load, speed))
        return np.asarray(np.exp(basis @ values[len(PARAMETERS) :].reshape(8, -1).T))

    def coefficients(self, values: FloatArray, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight COEFFICIENTS (n_point, 8) [N/m, N s/m]; FitError outside the bearing's table."""
        return self.family.coefficients(values[: len(PARAMETERS)], load, speed) * self.factors(values, load, speed)

    def coefficients_and_slopes(self, values: FloatArray, load: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`coefficients` [N/m, N s/m] and their derivatives by all parameters, (n_point, 8, n_parameter)."""
        film_eight, by_family = self.family.coefficients_and_slopes(values[: len(PARAMETERS)], load, speed)
        factors = self.factors(values, load, speed)
        eight = film_eight * factors
        by_field = np.einsum("pi,ij,pm->pijm", eight, np.eye(8), self.field.basis(places_of(load, speed)))
        return eight, np.concatenate([by_family * factors[..., None], by_field.reshape(*eight.shape, -1)], axis=-1)

    def at_load(self, values: FloatArray, load: float) -> CoefficientsAtSpeed:
        """K [N/m] and C [N s/m], (n_speed, 2, 2), as a function of speed [rad/s]."""
        return lambda speed: as_matrices(self.coefficients(values, load, speed))


def places_of(load: FloatArray | float, speed: FloatArray) -> FloatArray:
    """Places (n_point, 2) of loads [N] and speeds [rad/s]."""
    return np.stack(np.broadcast_arrays(np.asarray(load, np.float64), np.asarray(speed, np.float64)), axis=-1).reshape(-1, 2)
