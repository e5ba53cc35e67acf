"""Local rational method: around a line the FRF has a pole of its own, so that sharp resonances leave nothing in the residual.

A(r) Y(k + r) = B(r) U(k + r) + T(r) + V, A = 1 + a r, B and T polynomials (McKelvey and Guérin 2012, 16th IFAC Symposium on System
Identification, "Non-parametric frequency response estimation using a local rational model"; here linear in its coefficients).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.spectra.local_polynomial import freedom
from labpipe.spectra.matrices import hermitian

# Lines solved together, so that memory does not depend on the record; share of a column's power below which it is noise of rounding.
LINES_AT_ONCE, ROUNDING = 2048, 1e-13


@dataclass(frozen=True)
class LocalNoise:
    """What a local rational FRF leaves of every line: noise (n_line, n_output, n_output) [output unit^2] of one block.

    leakage (n_line, n_block, n_output) [output unit], its variance over that of the noise *spread* (n_line, n_block, n_output) [1]; *dof*
    complex degrees of freedom of the noise of a line, *width* the number of lines they come from.
    """

    noise: ComplexArray
    leakage: ComplexArray
    spread: FloatArray
    dof: int
    width: int


def noise_freedom(n_block: int, n_input: int, degree: int, half_width: int) -> int:
    """Complex degrees of freedom of the residual of one output: as of local polynomials, less one for the pole."""
    return freedom(n_block, n_input, degree, half_width) - 1


def local_noise(forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int) -> LocalNoise:
    """Noise and leakage of *responses* (n_block, n_line, n_output) [output unit] to *forces* (n_block, n_line, n_input) [N].

    Both are transforms without window. Every output has its own pole, which all blocks share as they share B; each block has its own
    leakage T, of which T(0) is the value at the line. The first and the last half_width lines are left out. Equation (frf-local-rational).
    """
    n_line = forces.shape[1] - 2 * half_width
    parts: list[tuple[ComplexArray, ComplexArray, FloatArray]] = []
    for first in range(0, n_line, LINES_AT_ONCE):
        around = slice(first, first + min(LINES_AT_ONCE, n_line - first) + 2 * half_width)
        parts.append(_around_lines(forces[:, around], responses[:, around], degree, half_width))
    noise: ComplexArray = np.concatenate([part[0] for part in parts])
    leakage: ComplexArray = np.concatenate([part[1] for part in parts])
    spread: FloatArray = np.concatenate([part[2] for part in parts])
    dof = noise_freedom(forces.shape[0], forces.shape[2], degree, half_width)
    return LocalNoise(noise / dof, leakage, spread, dof, 2 * half_width + 1)


def _around_lines(
    forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Sums of the residual's products (n_line, n_output, n_output), leakage and spread (n_line, n_block, n_output)."""
    n_block, _, n_output = responses.shape
    width = 2 * half_width + 1
    offsets = np.arange(-half_width, half_width + 1) / half_width
    powers = offsets[:, None] ** np.arange(degree + 1)
    smooth = np.linalg.qr(powers)[0]
    u, y = _windows(forces, width), _windows(responses, width)
    of_forces = (u[..., None, :] * powers[:, :, None]).reshape(*u.shape[:3], -1)
    residuals, leakage, spread = [], [], []
    for output in range(n_output):
        # The output's own column takes the pole: -a r Y on the right side.
        columns = np.concatenate([of_forces, (y[..., output] * offsets)[..., None]], axis=3)
        residual, leaked, variance = _solved(columns, y[..., output], smooth, half_width)
        residuals.append(residual.reshape(residual.shape[0], n_block * width))
        leakage.append(leaked)
        spread.append(variance)
    joined = np.stack(residuals, axis=1)
    return joined @ hermitian(joined), np.stack(leakage, axis=2), np.stack(spread, axis=2)


def _solved(columns: ComplexArray, y: ComplexArray, smooth: FloatArray, middle: int) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Least squares of *y* (n_line, n_block, width) by *columns* (n_line, n_block, width, n) and polynomials *smooth* (width, degree + 1).

    Gives residual (n_line, n_block, width), and leakage (n_line, n_block) in the middle of the window with its variance over the noise's.
    """
    n_line, n_block, width, n = columns.shape
    scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=(1, 2), keepdims=True))
    columns = columns / np.where(scale > 0, scale, 1.0)
    at_middle = smooth @ smooth[middle]
    of_columns, of_y = np.einsum("t,lbtc->lbc", at_middle, columns), np.einsum("t,lbt->lb", at_middle, y)
    columns, rest = _without(columns, smooth), _without(y[..., None], smooth)
    rows = columns.reshape(n_line, n_block * width, n)
    inverse = np.linalg.pinv(hermitian(rows) @ rows, rcond=ROUNDING, hermitian=True)
    factors = inverse @ (hermitian(rows) @ rest.reshape(n_line, -1, 1))
    residual = rest - (rows @ factors).reshape(rest.shape)
    spread = np.dot(at_middle, at_middle) + np.einsum("lbp,lpq,lbq->lb", of_columns, inverse, of_columns.conj()).real
    return residual[..., 0], of_y - (of_columns @ factors)[..., 0], spread


def _windows(spectra: ComplexArray, width: int) -> ComplexArray:
    """The lines around every line, (n_line, n_block, width, n_channel)."""
    return np.lib.stride_tricks.sliding_window_view(spectra, width, axis=1).transpose(1, 0, 3, 2)


def _without(columns: ComplexArray, smooth: FloatArray) -> ComplexArray:
    """Columns (n_line, n_block, width, n) without what polynomials (width, degree + 1) explain, n the last axis."""
    return columns - np.einsum("rs,ts,lbtc->lbrc", smooth, smooth, columns, optimize=True)
