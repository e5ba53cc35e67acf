"""Local polynomial method: around a line FRF and leakage are polynomials over the lines (Pintelon and Schoukens 2012, chapter 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.spectra.matrices import hermitian, without_rounding

# Lines solved together, so that memory does not depend on the record, and lines from which the correlation is averaged.
LINES_AT_ONCE, CORRELATED = 2048, 4096


@dataclass(frozen=True)
class LocalFit:
    """FRF at the middle of every window: matrix (n_line, n_output, n_input) [output unit / N], covariance (n_line, n, n) of its vec.

    multiple_coherence (n_line, n_output) [1] of the lines in the window without their leakage; correlation (2 n,) [1] of the error
    with that of the next lines; condition (n_line,) [1]: of the equations of every line; dof: complex degrees of freedom of its noise.
    """

    matrix: ComplexArray
    covariance: ComplexArray
    multiple_coherence: FloatArray
    correlation: FloatArray
    condition: FloatArray
    dof: int


def freedom(n_block: int, n_input: int, degree: int, half_width: int) -> int:
    """Complex degrees of freedom of the residual: (2 n + 1 - (d + 1)) of every block, less (d + 1) of every force.

    Equation (frf-local-freedom).
    """
    return n_block * (2 * half_width - degree) - (degree + 1) * n_input


def local_polynomials(forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int) -> LocalFit:
    """Y(k + r) = (sum_s G_s r^s) U(k + r) + sum_s T_s r^s + V for r = -n ... n in every block: G common, leakage T of each block alone.

    forces (n_block, n_line, n_input) [N], responses (n_block, n_line, n_output) [output unit]: DFT without window; the first and the last
    half_width lines have no window of their own and are left out. H(k) = G_0; its covariance is that of least squares,
    S_vv[o, p] (A^-1)[i, j], S_vv from the residual. Equation (frf-local-polynomial).
    """
    n_line = forces.shape[1] - 2 * half_width
    starts = range(0, n_line, LINES_AT_ONCE)
    parts = [
        _window_fits(
            forces[:, first : first + min(LINES_AT_ONCE, n_line - first) + 2 * half_width],
            responses[:, first : first + min(LINES_AT_ONCE, n_line - first) + 2 * half_width],
            degree,
            half_width,
        )
        for first in starts
    ]
    weights = np.concatenate([weight for *_, weight in parts])[:CORRELATED]
    return LocalFit(
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.concatenate([part[2] for part in parts]),
        _correlation(weights),
        np.concatenate([part[3] for part in parts]),
        freedom(forces.shape[0], forces.shape[2], degree, half_width),
    )


def _window_fits(
    forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int
) -> tuple[ComplexArray, ComplexArray, FloatArray, FloatArray, ComplexArray]:
    """Matrix, covariance, multiple coherence, condition, and weights (n_line, n_input, n_block, 2 n + 1) of the noise of every line."""
    n_block, _, n_input = forces.shape
    width = 2 * half_width + 1
    offsets = np.arange(-half_width, half_width + 1) / half_width
    powers = offsets[:, None] ** np.arange(degree + 1)
    smooth = np.linalg.qr(powers)[0]
    u, y = _windows(forces, width), _windows(responses, width)
    columns = (u[..., None, :] * powers[:, :, None]).reshape(*u.shape[:3], -1)
    whole_size = np.sqrt(np.sum(np.abs(columns) ** 2, axis=(1, 2)))
    columns, y = _without(columns, smooth), _without(y, smooth)
    n_line = columns.shape[0]
    columns, y = columns.reshape(n_line, n_block * width, -1), y.reshape(n_line, n_block * width, -1)
    scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=1, keepdims=True))
    columns = columns / np.where(scale > 0, scale, 1.0)
    gram = hermitian(columns) @ columns
    inverse = np.linalg.pinv(gram, hermitian=True)
    gain = inverse @ hermitian(columns)
    residual = y - columns @ (gain @ y)
    gain = gain[:, :n_input] / scale.swapaxes(1, 2)[:, :n_input]
    dof = freedom(n_block, n_input, degree, half_width)
    noise = (residual.swapaxes(1, 2) @ residual.conj()) / dof
    spread = gain @ hermitian(gain)
    n = n_input * y.shape[2]
    covariance = (noise[:, :, None, :, None] * spread[:, None, :, None, :]).reshape(n_line, n, n)
    left, whole = np.sum(np.abs(residual) ** 2, axis=1), np.sum(np.abs(y) ** 2, axis=1)
    coherence = 1 - np.divide(left, whole, out=np.ones_like(left), where=whole > 0)
    matrix = (gain @ y).swapaxes(1, 2)
    weights = gain.reshape(n_line, n_input, n_block, width)
    # Of a force that is smooth over the lines itself nothing but rounding is left beside the leakage.
    left_over = np.min(np.divide(scale[:, 0], whole_size, out=np.zeros_like(whole_size), where=whole_size > 0), axis=1)
    condition = np.maximum(np.linalg.cond(gram), 1 / np.maximum(left_over, 1e-150) ** 2)
    return matrix, without_rounding(covariance), coherence, condition, weights


def _windows(spectra: ComplexArray, width: int) -> ComplexArray:
    """The lines around every line, (n_line, n_block, width, n_channel)."""
    return np.lib.stride_tricks.sliding_window_view(spectra, width, axis=1).transpose(1, 0, 3, 2)


def _without(columns: ComplexArray, smooth: FloatArray) -> ComplexArray:
    """Columns (n_line, n_block, width, n) without what the leakage's polynomials (width, degree + 1) explain."""
    return columns - np.einsum("rs,ts,lbtc->lbrc", smooth, smooth, columns, optimize=True)


def _correlation(weights: ComplexArray) -> FloatArray:
    """Correlation (2 n,) of the errors of lines 1, 2, ... apart: the noise of the lines that both windows hold, averaged over the lines."""
    width = weights.shape[3]
    size = np.sqrt(np.sum(np.abs(weights) ** 2, axis=(2, 3)))
    unit = weights / np.where(size > 0, size, 1.0)[:, :, None, None]
    shared = [
        np.mean(np.sum(unit[:-lag, :, :, lag:] * unit[lag:, :, :, : width - lag].conj(), axis=(2, 3)).real) if unit.shape[0] > lag else 0.0
        for lag in range(1, width)
    ]
    return np.array(shared)
