"""Local polynomial and local rational methods: FRF and leakage around a line as smooth functions of
frequency, of the latter with a pole (McKelvey and Guérin 2012, 16th IFAC Symposium on System Identification;
here linear in its coefficients).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource
from labpipe.records.response import Blocks
from labpipe.spectra.bands import block_samples
from labpipe.spectra.channels import checked_blocks
from labpipe.spectra.covariance import covariance_of_parts, noise_levels
from labpipe.spectra.matrices import hermitian
from labpipe.spectra.ports import Layout, Parts, coherence_findings, select_lines
from labpipe.spectra.settings import FrfSettings

# Lines solved together, so that memory does not depend on the record, and lines from which the correlation is
# averaged.
LINES_AT_ONCE, CORRELATED = 2048, 4096


@dataclass(frozen=True)
class LocalFit:
    """FRF at the middle of every window: matrix (n_line, n_output, n_input) [output unit / N], covariance
    (n_line, n, n) of its vec. multiple_coherence (n_line, n_output) [1] of the lines in the window without
    their leakage; correlation (2 n,) [1] of the error with that of the next lines; condition (n_line,) [1]:
    of the equations of every line; dof: complex degrees of freedom of its noise.
    """

    matrix: ComplexArray
    covariance: ComplexArray
    multiple_coherence: FloatArray
    correlation: FloatArray
    condition: FloatArray
    dof: int


def freedom(n_block: int, n_input: int, degree: int, half_width: int) -> int:
    """Complex degrees of freedom of the residual: (2 n + 1 - (d + 1)) of every block, less (d + 1) of every
    force. Equation (frf-local-freedom).
    """
    return n_block * (2 * half_width - degree) - (degree + 1) * n_input


def local_polynomials(
    forces: ComplexArray,
    responses: ComplexArray,
    degree: int,
    half_width: int,
    recordings: IntArray | None = None,
) -> LocalFit:
    """Y(k + r) = (sum_s G_s r^s) U(k + r) + sum_s T_s r^s + V for r = -n ... n in every block: G common,
    leakage T of each block alone. forces (n_block, n_line, n_input) [N], responses (n_block, n_line,
    n_output) [output unit]: DFT without window; the first and the last half_width lines have no window of
    their own and are left out. H(k) = G_0; its covariance is that of least squares, S_vv[o, p] (A^-1)[i, j],
    S_vv from the residual, at the level that it has in each of the *recordings* (n_block,), numbers from 0
    on. Equation (frf-local-polynomial).
    """
    recorded = np.zeros(len(forces), np.int64) if recordings is None else recordings
    blocks_of = np.eye(recorded.max() + 1)[recorded]
    parts = [
        _window_fits(u, y, degree, half_width, blocks_of) for u, y in _pieces(forces, responses, half_width)
    ]
    matrix, noise, spread, left, freedoms, coherence, condition, weights = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    dof = freedom(forces.shape[0], forces.shape[2], degree, half_width)
    levels = noise_levels(left, freedoms.mean(axis=0) / (2 * half_width + 1))
    covariance = covariance_of_parts(noise, spread, levels)
    return LocalFit(matrix, covariance, coherence, _correlation(weights[:CORRELATED]), condition, dof)


def _pieces(
    forces: ComplexArray, responses: ComplexArray, half_width: int
) -> Iterator[tuple[ComplexArray, ComplexArray]]:
    """LINES_AT_ONCE lines of both at a time, with *half_width* more to either side."""
    n_line = forces.shape[1] - 2 * half_width
    for first in range(0, n_line, LINES_AT_ONCE):
        around = slice(first, min(first + LINES_AT_ONCE, n_line) + 2 * half_width)
        yield forces[:, around], responses[:, around]


def _windows(
    forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Around every line forces times powers of the distance, responses, a basis of those powers."""
    powers = (np.arange(-half_width, half_width + 1) / half_width)[:, None] ** np.arange(degree + 1)
    u, y = (
        np.lib.stride_tricks.sliding_window_view(s, 2 * half_width + 1, axis=1).transpose(1, 0, 3, 2)
        for s in (forces, responses)
    )
    columns = (u[..., None, :] * powers[:, :, None]).reshape(*u.shape[:3], -1)
    return columns, y, np.linalg.qr(powers)[0]


def _window_fits(
    forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int, blocks_of: FloatArray
) -> tuple[ComplexArray, ...]:
    """Matrix, noise, spread and power left by recording with its degrees of freedom, coherence, condition,
    weights (n_line, n_input, n_block, 2 n + 1).
    """
    n_block, _, n_input = forces.shape
    width = 2 * half_width + 1
    columns, y, smooth = _windows(forces, responses, degree, half_width)
    whole_size = np.sqrt(np.sum(np.abs(columns) ** 2, axis=(1, 2)))
    columns, y = _remove_columns(columns, smooth), _remove_columns(y, smooth)
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
    weights = gain.reshape(n_line, n_input, n_block, width)
    spread = np.einsum("libt,ljbt,be->leij", weights, weights.conj(), blocks_of, optimize=True)
    by_block = np.sum(np.abs(residual.reshape(n_line, n_block, width, -1)) ** 2, axis=2)
    # What a recording leaves is noise of all: least squares follows the one with most of the force.
    by = columns.reshape(n_line, n_block, width, -1)
    own = inverse[:, None] @ np.einsum("lbtj,lbtk,be->lejk", by.conj(), by, blocks_of, optimize=True)
    free, taken = blocks_of.sum(axis=0) * (width - degree - 1), np.einsum("lejj->le", own).real
    mixed = np.einsum("lejk,lfkj->lef", own, own).real + np.eye(free.size) * (free - 2 * taken)[:, None]
    freedoms = free - taken
    alone = np.linalg.solve(mixed, (by_block.swapaxes(1, 2) @ blocks_of).swapaxes(1, 2))
    by_recording = (alone * freedoms[:, :, None]).swapaxes(1, 2)
    left, whole = np.sum(np.abs(residual) ** 2, axis=1), np.sum(np.abs(y) ** 2, axis=1)
    coherence = 1 - np.divide(left, whole, out=np.ones_like(left), where=whole > 0)
    matrix = (gain @ y).swapaxes(1, 2)
    # Of a force that is smooth over the lines itself nothing but rounding is left beside the leakage.
    left_over = np.min(
        np.divide(scale[:, 0], whole_size, out=np.zeros_like(whole_size), where=whole_size > 0), axis=1
    )
    condition = np.maximum(np.linalg.cond(gram), 1 / np.maximum(left_over, 1e-150) ** 2)
    return matrix, noise, spread, by_recording, freedoms, coherence, condition, weights


def _remove_columns(columns: ComplexArray, smooth: FloatArray) -> ComplexArray:
    """Columns (n_line, n_block, width, n) without what the leakage's polynomials explain."""
    return columns - np.einsum("rs,ts,lbtc->lbrc", smooth, smooth, columns, optimize=True)


def _correlation(weights: ComplexArray) -> FloatArray:
    """Correlation (2 n,) of the errors of lines 1, 2, ... apart: of the noise that both windows hold."""
    width = weights.shape[3]
    size = np.sqrt(np.sum(np.abs(weights) ** 2, axis=(2, 3)))
    unit = weights / np.where(size > 0, size, 1.0)[:, :, None, None]
    shared = [
        np.mean(np.sum(unit[:-lag, :, :, lag:] * unit[lag:, :, :, : width - lag].conj(), axis=(2, 3)).real)
        if unit.shape[0] > lag
        else 0.0
        for lag in range(1, width)
    ]
    return np.array(shared)


# Share of a column's power below which it is noise of rounding.
ROUNDING = 1e-13


@dataclass(frozen=True)
class LocalNoise:
    """What a local rational FRF leaves of every line: noise (n_line, n_output, n_output) [output unit^2] of
    one block. leakage (n_line, n_block, n_output) [output unit], its variance over that of the noise *spread*
    (n_line, n_block, n_output) [1]; of_blocks (n_line, n_block, n_output) [output unit^2]: what each block
    leaves; *dof* complex degrees of freedom of the noise of a line, of which *free* (n_block,) are those of
    each block beside its leakage; *width* the number of lines they come from.
    """

    noise: ComplexArray
    leakage: ComplexArray
    spread: FloatArray
    of_blocks: FloatArray
    dof: float
    free: FloatArray
    width: int


def local_noise(
    forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int, filled: FloatArray
) -> LocalNoise:
    """Noise and leakage of *responses* (n_block, n_line, n_output) [output unit] to *forces* (n_block,
    n_line, n_input) [N]. Both are transforms without window. Every output has its own pole, which all blocks
    share as they share B; each block has its own leakage T, of which T(0) is the value at the line. The first
    and the last half_width lines are left out. *filled* (n_block,) [1]: share of a block before its zeros,
    which has this share of the noise of a whole one, and of its independent lines. Equation
    (frf-local-rational).
    """
    parts = [_around_lines(u, y, degree, half_width) for u, y in _pieces(forces, responses, half_width)]
    noise: ComplexArray
    noise, leakage, spread, of_blocks = (np.concatenate(part) for part in zip(*parts, strict=True))
    # Leakage takes noise at both ends of a block, of which zeros hold none. One is for the pole.
    width, taken = 2 * half_width + 1, degree + 1
    free = filled * width - np.maximum(taken / 2, taken - (1 - filled) * width / 2)
    dof = float(free.sum()) - taken * forces.shape[2] - 1
    return LocalNoise(noise / dof, leakage, spread, of_blocks, dof, free, width)


def _around_lines(
    forces: ComplexArray, responses: ComplexArray, degree: int, half_width: int
) -> tuple[ComplexArray, ComplexArray, FloatArray, FloatArray]:
    """Sums of the residual's products, leakage, spread, power left (n_line, n_block, n_output)."""
    n_output = responses.shape[2]
    of_forces, y, smooth = _windows(forces, responses, degree, half_width)
    offsets = np.arange(-half_width, half_width + 1) / half_width
    residuals, leakage, spread = [], [], []
    for output in range(n_output):
        # The output's own column takes the pole: -a r Y on the right side.
        columns = np.concatenate([of_forces, (y[..., output] * offsets)[..., None]], axis=3)
        residual, leaked, variance = _solve(columns, y[..., output], smooth, half_width)
        residuals.append(residual)
        leakage.append(leaked)
        spread.append(variance)
    stacked = np.stack(residuals, axis=1)
    joined, of_blocks = stacked.reshape(*stacked.shape[:2], -1), np.sum(np.abs(stacked) ** 2, axis=3)
    products = joined @ hermitian(joined)
    return products, np.stack(leakage, axis=2), np.stack(spread, axis=2), of_blocks.swapaxes(1, 2)


def _solve(
    columns: ComplexArray, y: ComplexArray, smooth: FloatArray, middle: int
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Residual of *y* (n_line, n_block, width), leakage in the *middle*, its variance over the noise's."""
    n_line, n_block, width, n = columns.shape
    scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=(1, 2), keepdims=True))
    columns = columns / np.where(scale > 0, scale, 1.0)
    at_middle = smooth @ smooth[middle]
    of_columns, of_y = np.einsum("t,lbtc->lbc", at_middle, columns), np.einsum("t,lbt->lb", at_middle, y)
    columns, rest = _remove_columns(columns, smooth), _remove_columns(y[..., None], smooth)
    rows = columns.reshape(n_line, n_block * width, n)
    inverse = np.linalg.pinv(hermitian(rows) @ rows, rcond=ROUNDING, hermitian=True)
    factors = inverse @ (hermitian(rows) @ rest.reshape(n_line, -1, 1))
    residual = rest - (rows @ factors).reshape(rest.shape)
    spread = (
        np.dot(at_middle, at_middle)
        + np.einsum("lbp,lpq,lbq->lb", of_columns, inverse, of_columns.conj()).real
    )
    return residual[..., 0], of_y - (of_columns @ factors)[..., 0], spread


# Degrees of freedom of the noise of a line that the half width is chosen for, and least that is accepted.
USUAL_DOF, LEAST_DOF = 8, 2
# Condition number of the equations of a line above which the forces are not rough enough to tell FRF and
# leakage apart.
WORST_CONDITION = 1e8


def local_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF from DFTs of neighbouring blocks without window. DataError for forces that cannot be told from
    leakage or from each other.
    """
    assert settings.block is not None
    rate = sources[0].sample_rate
    n_sample = block_samples(sources[0], settings.block, 8)
    padded = [layout.pad(e, _spectra(source, settings.block), 1) for e, source in enumerate(sources)]
    blocks, recordings = np.concatenate(padded), np.repeat(np.arange(len(padded)), [len(p) for p in padded])
    n_input = len(layout.inputs)
    half_width = settings.half_width or usual_half_width(blocks.shape[0], n_input, settings.degree)
    check_half_width(half_width, blocks.shape[0], n_input, settings.degree)
    frequency = np.arange(1, blocks.shape[1] + 1) * (rate / n_sample)
    inner = frequency[half_width:-half_width]
    if not inner.size:
        what = f"a block of {settings.block:g} s has fewer lines than the window of {2 * half_width + 1}"
        raise DataError(what, hint="lengthen `block`")
    chosen = np.flatnonzero(select_lines(inner, settings))
    first, last = int(chosen[0]), int(chosen[-1]) + 1
    around = slice(first, last + 2 * half_width)
    fitted = local_polynomials(
        blocks[:, around, :n_input], blocks[:, around, n_input:], settings.degree, half_width, recordings
    )
    lines = chosen - first
    if np.any(fitted.condition[lines] > WORST_CONDITION):
        what = (
            f"the force {', '.join(port.label for port in layout.inputs)} is too smooth over the lines, or "
            "too few recordings have it, to tell FRF and leakage apart"
        )
        raise DataError(what, hint="a random force in every direction, or leave `local` out")
    coherence = fitted.multiple_coherence[lines]
    power: FloatArray = np.mean(np.abs(blocks[:, half_width + chosen, n_input:]) ** 2, axis=0)
    return Parts(
        frequency=inner[chosen],
        matrix=fitted.matrix[lines],
        covariance=fitted.covariance[lines],
        # One value of the noise serves all lines of a window, as if each had this many averages.
        averages=1 + fitted.dof / (2 * half_width + 1),
        dof=float(fitted.dof),
        findings=coherence_findings(coherence, power, layout),
        coherence=coherence[:, :, None] if n_input == 1 else None,
        multiple_coherence=coherence,
        blocks=Blocks(
            settings.block,
            "none",
            0.0,
            blocks.shape[0],
            "H1",
            settings.degree,
            layout.derivatives,
            half_width=half_width,
        ),
        line_correlation=tuple(complex(value) for value in fitted.correlation),
    )


def usual_half_width(n_block: int, n_input: int, degree: int) -> int:
    """The least half width with USUAL_DOF degrees of freedom of the noise, and with more lines than a
    polynomial has coefficients.
    """
    return next(n for n in range(degree + 1, 10_000) if freedom(n_block, n_input, degree, n) >= USUAL_DOF)


def check_half_width(half_width: int, n_block: int, n_input: int, degree: int, n_pole: int = 0) -> None:
    """DataError for a half width that leaves the noise unknown, beside *n_pole* poles of the FRF."""
    if freedom(n_block, n_input, degree, half_width) - n_pole < LEAST_DOF:
        least = n_pole + usual_half_width(n_block, n_input, degree)
        what = f"half_width: {half_width} leaves the noise unknown"
        raise DataError(what, hint=f"{least} or more, or leave it out")


def _spectra(source: SampleSource, block: float) -> ComplexArray:
    """DFT of all whole blocks, (n_block, n_line, n_channel), above 0 Hz and below half the rate."""
    n_sample = block_samples(source, block)
    samples = np.concatenate(list(checked_blocks(source)))
    whole = samples[: source.n_sample // n_sample * n_sample].reshape(-1, n_sample, samples.shape[1])
    return fft.rfft(whole, axis=1)[:, 1 : (n_sample + 1) // 2]
