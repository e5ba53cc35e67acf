"""Weights of FRFs whose covariance is one matrix over the responses times one over the forces, as that of H1 is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray

# Share of the standard deviations by which a covariance may differ from such a product: rounding of its making.
ROUNDING = 1e-12
# Numbers of a covariance that are looked at together: a part of the cache.
CACHED_NUMBERS = 1 << 16


@dataclass(frozen=True)
class ProductWeights:
    """W_o and W_i of every line; the FRFs H become uncorrelated as W_o H W_i^T, which is W_o (x) W_i times vec(H), row-major.

    *outputs* W_o (n_line, n_output, n_output) and *inputs* W_i (n_line, n_input, n_input); their product [N/m].
    Equation (est-product-weights).
    """

    outputs: ComplexArray
    inputs: ComplexArray

    def at(self, lines: slice) -> ProductWeights:
        """The weights of some *lines*."""
        return ProductWeights(self.outputs[lines], self.inputs[lines])

    def whitened(self, values: ComplexArray) -> ComplexArray:
        """FRFs (..., n_line, n_output, n_input) [m/N] without correlation and of variance 1, the same shape [1]."""
        white: ComplexArray = self.outputs @ values @ self.inputs.swapaxes(1, 2)
        return white

    def whitened_columns(self, by_line: ComplexArray) -> ComplexArray:
        """Terms (n_line, n_output, n_input, n_term) [m/N per unit of the term] likewise, (n_line, n_output * n_input, n_term)."""
        n_line, n_output, _, n_term = by_line.shape
        across = (self.outputs @ by_line.reshape(n_line, n_output, -1)).reshape(by_line.shape)
        white: ComplexArray = (self.inputs[:, None] @ across).reshape(n_line, -1, n_term)
        return white


def correlation_factors(covariance: ComplexArray, deviations: FloatArray) -> tuple[ComplexArray, ComplexArray] | None:
    """R_o (n_line, n_output, n_output) and R_i (n_line, n_input, n_input) [1] whose product is the correlation of vec(H), row-major.

    Of a *covariance* (n_line, n, n) [m^2/N^2] and the *deviations* (n_line, n_output, n_input) [m/N] on its diagonal; None where it is no
    such product. A few lines at a time: of many FRFs the covariance is large.
    """
    n_line, n_output, n_input = deviations.shape
    by_axes = covariance.reshape(n_line, n_output, n_input, n_output, n_input)
    outputs = by_axes[:, :, 0, :, 0] / (deviations[:, :, None, 0] * deviations[:, None, :, 0])
    inputs = by_axes[:, 0, :, 0, :] / (deviations[:, 0, :, None] * deviations[:, 0, None, :])
    n_chunk = max(16, CACHED_NUMBERS // (n_output * n_input) ** 2)
    for start in range(0, n_line, n_chunk):
        lines = slice(start, start + n_chunk)
        difference = outputs[lines, :, None, :, None] * inputs[lines, None, :, None, :]
        difference -= by_axes[lines] / (deviations[lines, :, :, None, None] * deviations[lines, None, None])
        if np.max(np.abs(difference), initial=0.0) > ROUNDING:
            return None
    return outputs, inputs


def deviation_factors(deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """s_o (n_line, n_output) [m/N] and s_i (n_line, n_input) [1] of standard deviations s_o s_i (n_line, n_output, n_input) [m/N]."""
    return deviations[:, :, 0], deviations[:, 0] / deviations[:, 0, :1]
