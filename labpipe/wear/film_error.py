"""Error of a wear identification by the finite cells of its oil films, as a part of the covariance and of the intervals.

Noise is not the only doubt: where the film divides, coefficients bend sharply over the depth, and the cells round the bend. The change
of the coefficients from half the cells moves the estimate; a third of it is the standard deviation of the mesh's own error. Films err
independently: a mesh that suits one may not suit the other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.wear.misfit import Misfit
from labpipe.wear.profile import Interval


def film_covariance(misfit: Misfit, parameters: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (n, n) [1] of the scaled *parameters* (n,) at a refined minimum by the mesh of the films; zero where there is no film.

    Sum over the films of b b^T with b = -covariance J^T dr, dr the change of the residual by the film's error; *covariance* (n, n) [1]:
    that of the noise. Equation (wear-film).
    """
    residual, jacobian = misfit.residual(parameters), misfit.jacobian(parameters)
    total = np.zeros_like(covariance)
    for model in misfit.model.with_mesh_error(parameters):
        change = replace(misfit, model=model, _last=None).residual(parameters) - residual
        shift = covariance @ (jacobian.T @ change)
        total += np.outer(shift, shift)
    return total


def widened(interval: Interval, best: float, distance: float, low: float, high: float) -> Interval:
    """A profile interval about *best* with each half-width w replaced by sqrt(w^2 + *distance*^2), within *low* and *high*; all scaled."""
    first, last = best - np.hypot(best - interval.low, distance), best + np.hypot(interval.high - best, distance)
    return Interval(
        float(interval.low if interval.open_low else max(first, low)),
        float(interval.high if interval.open_high else min(last, high)),
        interval.open_low or bool(first <= low),
        interval.open_high or bool(last >= high),
    )


def widened_region(outline: FloatArray, best: FloatArray, noise: FloatArray, film: FloatArray) -> FloatArray:
    """An outline (n, 2) about *best* (2,) for the covariance *noise* (2, 2), stretched to noise and *film* (2, 2); all scaled [1]."""
    stretch = np.linalg.cholesky(noise + film) @ np.linalg.inv(np.linalg.cholesky(noise))
    stretched: FloatArray = best + (outline - best) @ stretch.T
    return stretched
