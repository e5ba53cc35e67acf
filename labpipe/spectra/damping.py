"""The damping that an exponential window adds to a frequency response, and how it is taken out again."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray

# Lines to either side that a local rational function is fitted to.
HALF_WIDTH = 4


def without_added_damping(frequency: FloatArray, matrix: ComplexArray, decay: float) -> ComplexArray:
    """H(j w) from the windowed H(j w + s), s = 1/decay, (n_frequency, n_output, n_input); frequency [Hz] evenly spaced, decay [s].

    Around every line H is taken for (a0 + a1 x + a2 x^2) / (1 + b1 x), x = j (w' - w) / dw, on 4 lines to either side (the local
    rational method: McKelvey and Guerin 2012), and evaluated at x = -s/dw. A mode is one pole, so it is met exactly; s is below a
    line's spacing for all windows that fall to 0.2 % or more within the block. Fewer than 5 lines are returned as they are.
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
    around = flat[lines] / np.where(size > 0, size, 1.0)
    powers = np.broadcast_to(x[:, :, None, None] ** np.arange(3), (*around.shape, 3))
    equations = np.concatenate([powers, -(x[:, :, None] * around)[:, :, :, None]], axis=3).swapaxes(1, 2)
    # The least norm where the fit is exact with less: a constant H has no pole of its own.
    solution = np.einsum("fekl,fel->fek", np.linalg.pinv(equations, rcond=1e-9), around.swapaxes(1, 2))
    at = -1 / (decay * spacing)
    value = (solution[:, :, 0] + solution[:, :, 1] * at + solution[:, :, 2] * at**2) / (1 + solution[:, :, 3] * at)
    return (value * np.where(size > 0, size, 1.0)).reshape(matrix.shape)


def covariance_without_damping(before: ComplexArray, after: ComplexArray, covariance: ComplexArray) -> ComplexArray:
    """cov of the undamped response, (n_frequency, n, n): dH = (H/H_w)^2 dH_w, since the window adds a known part to 1/H."""
    ratio = np.divide(after, before, out=np.ones(before.shape, np.complex128), where=before != 0)
    gain = ratio.reshape(before.shape[0], -1) ** 2
    return covariance * gain[:, :, None] * gain[:, None, :].conj()
