"""Whether what a fit leaves is noise: the residual of a missing mode is alike on neighbouring lines, that of noise is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail

LAGS = 8
# Lines whose residuals tell the noise of the one in their middle.
AROUND = 31


@dataclass(frozen=True)
class LineNoise:
    """The noise along the lines: correlation (n,) [1] with the next lines that a window gives it, and 1 + 2 sum of their squares."""

    correlation: tuple[complex, ...] = ()

    @property
    def shared_power(self) -> float:
        return 1.0 + 2 * sum(abs(value) ** 2 for value in self.correlation)


def whiteness(residual: ComplexArray, noise: LineNoise) -> float:
    """Probability [1] of so much likeness of neighbouring lines in noise: the least p-value of the elements, times their number.

    residual (n_line, n_output, n_input): r_d = sum e_k+d conj(e_k) / sum |e|^2 of circular white noise has the variance 1 / n_line, so
    that 2 n_line sum |r_d|^2 over d = 1 ... 8 is chi-square with 16 degrees of freedom (portmanteau test of Box and Pierce 1970, complex
    form). Each line counts relative to the noise around it, which need not be the same everywhere. Equation (modal-whiteness).
    """
    n_line = residual.shape[0]
    flat = _even(residual.reshape(n_line, -1))
    power = np.sum(np.abs(flat) ** 2, axis=0)
    lags = range(1, min(LAGS, n_line - 1) + 1)
    expected = [*noise.correlation, *([0.0] * LAGS)]
    likeness = [np.sum(flat[d:] * flat[:-d].conj(), axis=0) / power - expected[d - 1] for d in lags]
    statistic = 2 * n_line / noise.shared_power * np.sum(np.abs(likeness) ** 2, axis=0)
    least = chi2_tail(float(np.max(statistic)), 2 * len(lags))
    return min(1.0, least * statistic.size)


def _even(flat: ComplexArray) -> ComplexArray:
    """Residuals (n_line, n) relative to the root mean square of the AROUND lines about each."""
    kernel = np.ones(min(AROUND, flat.shape[0]))
    counts = np.convolve(np.ones(flat.shape[0]), kernel, mode="same")
    around = np.stack([np.convolve(column, kernel, mode="same") for column in (np.abs(flat) ** 2).T], axis=1) / counts[:, None]
    return np.asarray(flat / np.sqrt(np.maximum(around, np.finfo(float).tiny)))


def loudest_line(residual: ComplexArray, noise: FloatArray, width: int) -> int:
    """The line around which the residual (n_line, n_output, n_input) [unit of the FRF] is largest over *width* lines.

    It is taken relative to its noise (n_output, n_input) [square of the FRF's unit].

    The sum is coherent: noise cancels, what is alike on neighbouring lines does not.
    """
    scaled = (residual / np.sqrt(noise)).reshape(residual.shape[0], -1)
    kernel = np.ones(max(width, 1))
    summed = np.stack([np.convolve(column, kernel, mode="same") for column in scaled.T])
    return int(np.argmax(np.sum(np.abs(summed) ** 2, axis=0)))
