"""Covariance of a closed loop's FRF that does not know the error of its own line, since it is the weight of that line in a fit.

With G = Y / U and w = Y - G U the estimated variance S_ww / |U|^2 of a line is small where noise made |U| large. In a loop the noise of U
is that of w fed back, so weights by it prefer errors of one sign: E(w U*) = C_wu brings the bias of an open-loop estimator back, over the
number of averages. Therefore G is taken from the neighbours of the line, and U as what is most likely if that G is right.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.spectra.matrices import hermitian
from labpipe.spectra.uncertainty import covariance_of_periodic

# Neighbours on either side that tell the FRF of a line.
SIDE = 5
FEWEST = 4


def covariance_by_neighbours(
    frequency: FloatArray, matrix: ComplexArray, vectors: ComplexArray, noise: Sequence[ComplexArray], gap: int = 0
) -> ComplexArray:
    """cov vec G (n_line, n, n) [unit^2 of H] of G = *matrix* (n_line, n_output, n_input) at *frequency* (n_line,) [Hz].

    *vectors* (n_line, n_input + n_output, n_run) [SI], forces first, with G = Y pinv(U); *noise*: their covariance in every run, (n_line,
    n_channel, n_channel) [SI]. *gap*: neighbours next to the line that share its noise, which are left out. Equation (frf-neighbours).
    """
    there = _from_neighbours(frequency, matrix, gap)
    n_output, n_input = matrix.shape[1:]
    residual_of = np.concatenate([-there, np.broadcast_to(np.eye(n_output), (frequency.size, n_output, n_output))], axis=2)
    forces = np.empty((frequency.size, n_input, len(noise)), np.complex128)
    for run, of_run in enumerate(noise):
        crossed = of_run @ hermitian(residual_of)
        left = residual_of @ vectors[:, :, run : run + 1]
        update = crossed[:, :n_input] @ np.linalg.pinv(residual_of @ crossed, hermitian=True) @ left
        forces[:, :, run] = (vectors[:, :n_input, run : run + 1] - update)[:, :, 0]
    return covariance_of_periodic(there, _inverse(forces), np.stack(list(noise)))


def _inverse(forces: ComplexArray) -> ComplexArray:
    """pinv(U), each force relative to its size: they differ by orders of magnitude."""
    size = np.sqrt(np.mean(np.abs(forces) ** 2, axis=(0, 2)))
    return np.asarray(np.linalg.pinv(forces / size[:, None]) / size[None, None, :])


def _from_neighbours(frequency: FloatArray, matrix: ComplexArray, gap: int) -> ComplexArray:
    """G of every line by a straight line through its neighbours, without itself; its own where these are too few."""
    flat = matrix.reshape(frequency.size, -1)
    count, first, second = (np.zeros(frequency.size) for _ in range(3))
    total, moment = np.zeros_like(flat), np.zeros_like(flat)
    for distance in range(gap + 1, min(gap + SIDE, frequency.size - 1) + 1):
        for line, other in ((slice(distance, None), slice(None, -distance)), (slice(None, -distance), slice(distance, None))):
            away = frequency[other] - frequency[line]
            count[line] += 1
            first[line] += away
            second[line] += away**2
            total[line] += flat[other]
            moment[line] += away[:, None] * flat[other]
    enough = count >= FEWEST
    spread = np.where(enough, count * second - first**2, 1.0)[:, None]
    at_line = (second[:, None] * total - first[:, None] * moment) / spread
    return np.asarray(np.where(enough[:, None], at_line, flat)).reshape(matrix.shape)
