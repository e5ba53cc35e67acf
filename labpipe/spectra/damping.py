"""Correction of a frequency response for the damping that an exponential window adds."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray

# Half width of the local rational fit [lines].
HALF_WIDTH = 4


def without_added_damping(frequency: FloatArray, matrix: ComplexArray, decay: float) -> ComplexArray:
    """H(j w) from the windowed H(j w + s), s = 1/decay, (n_frequency, n_output, n_input) [unit of H].

    frequency (n_frequency,) [Hz] evenly spaced, *decay* [s]. Around every line H is approximated by (a0 + a1 x + a2 x^2) / (1 + b1 x),
    x = j (w' - w) / dw, on 4 lines to either side (local rational method: McKelvey and Guerin 2012), and evaluated at x = -s/dw. A
    single mode is one pole and therefore exact; s is below the line spacing for all windows that fall to 0.2 % or more within the
    block. Fewer than 5 lines are returned unchanged.
    """
    n_line = frequency.size
    if n_line <= 4:
        return matrix
    spacing = 2 * np.pi * (frequency[-1] - frequency[0]) / (n_line - 1)
    width = min(2 * HALF_WIDTH + 1, n_line)
    first = np.clip(np.arange(n_line) - width // 2, 0, n_line - width)
    lines = first[:, None] + np.arange(width)
    x = 1j * (lines - np.arange(n_line)[:, None])
    flat = matrix.reshape(n_line, -1)
    size = np.max(np.abs(flat), axis=0)
    neighbours = flat[lines] / np.where(size > 0, size, 1.0)
    powers = np.broadcast_to(x[:, :, None, None] ** np.arange(3), (*neighbours.shape, 3))
    equations = np.concatenate([powers, -(x[:, :, None] * neighbours)[:, :, :, None]], axis=3).swapaxes(1, 2)
    # Minimum-norm solution where the equations are rank deficient: a constant H has no pole.
    solution = np.einsum("fekl,fel->fek", np.linalg.pinv(equations, rcond=1e-9), neighbours.swapaxes(1, 2))
    shift = -1 / (decay * spacing)
    value = (solution[:, :, 0] + solution[:, :, 1] * shift + solution[:, :, 2] * shift**2) / (1 + solution[:, :, 3] * shift)
    return (value * np.where(size > 0, size, 1.0)).reshape(matrix.shape)


def covariance_without_damping(before: ComplexArray, after: ComplexArray, covariance: ComplexArray) -> ComplexArray:
    """Covariance of the response without added damping, (n_frequency, n, n) [unit of H^2]: dH = (H/H_w)^2 dH_w.

    The window adds a known term to 1/H. before, after (n_frequency, n_output, n_input) [unit of H]: H_w and H; covariance
    (n_frequency, n, n) of H_w, n = n_output * n_input.
    """
    ratio = np.divide(after, before, out=np.ones(before.shape, np.complex128), where=before != 0)
    gain = ratio.reshape(before.shape[0], -1) ** 2
    return covariance * gain[:, :, None] * gain[:, None, :].conj()
