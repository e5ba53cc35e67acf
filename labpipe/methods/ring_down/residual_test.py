"""Whether what a fit of free decays leaves is white noise, and if not, of what kind it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, f_tail
from labpipe.methods.ring_down.likelihood import Decayed, Piece, Solved

LAGS = 32
# Rows of a piece for each lag: the residual lacks what its parameters took, which must stay small against a
# lag.
ROWS_PER_LAG = 8
# Singular value of the columns of a test below which one of them is a sum of the others.
DEPENDENT = 1e-6


@dataclass(frozen=True)
class Judged:
    """Chances of such a residual in white noise [1], and the frequency [Hz] at which most of it is left.

    amplitude: by terms that follow the amplitude of each mode (damping or frequency that depend on it).
    white: by likeness of neighbouring samples, and by the strongest line, the lesser times two. ending: mean
    square of the residual in the last third of the decays over that in the first third.
    """

    amplitude: float
    white: float
    strongest: float
    ending: float


def judged(pieces: Sequence[Piece], fitted: Decayed, rate: float) -> Judged:
    """The residuals of all *pieces* at *rate* [Hz] together."""
    rows = [(piece, solved) for piece, solved in zip(pieces, fitted.pieces, strict=True)]
    residuals = [(piece, piece.series(solved.residual)) for piece, solved in rows]
    line, strongest = _strongest_line(residuals, rate)
    return Judged(
        _next_terms(rows, fitted.poles),
        min(1.0, 2 * min(portmanteau([part for _, part in residuals], _real(pieces)), line)),
        strongest,
        _ending([part for _, part in residuals]),
    )


def _ending(residuals: Sequence[ComplexArray]) -> float:
    thirds = [
        [float(np.mean(np.abs(part) ** 2)) for part in np.array_split(series / np.std(series, axis=0), 3)]
        for series in residuals
    ]
    first, last = (sum(one[place] for one in thirds) for place in (0, 2))
    return last / first if first > 0 else 1.0


def _real(pieces: Sequence[Piece]) -> bool:
    return all(piece.lines is None for piece in pieces)


def _next_terms(rows: Sequence[tuple[Piece, Solved]], poles: ComplexArray) -> float:
    """F-test of |E| E and |E|^2 E, E = e^(lambda t), the first terms of a damping or frequency over
    amplitude; exact for white noise.
    """
    explained, left, numerator, denominator = 0.0, 0.0, 0, 0
    for piece, solved in rows:
        course = np.exp(piece.time[:, None] * poles)
        terms = np.concatenate([course * np.abs(course) ** power for power in (1, 2)], axis=1)
        columns = piece.project(np.concatenate([terms.real, terms.imag], axis=1))
        basis = np.concatenate([solved.range_, _orthonormal(solved.tangent)], axis=1)
        fresh = _orthonormal(columns - basis @ (basis.T @ columns), np.linalg.norm(columns, axis=0))
        scaled = solved.residual / np.sqrt(np.mean(solved.residual**2, axis=0))
        power = float(np.sum((fresh.T @ scaled) ** 2))
        explained += power
        left += float(np.sum(scaled**2)) - power
        numerator += fresh.shape[1] * scaled.shape[1]
        denominator += (piece.rows.shape[0] - basis.shape[1] - fresh.shape[1]) * scaled.shape[1]
    if numerator == 0 or denominator <= 0 or left <= 0:
        return 1.0
    return f_tail((explained / numerator) / (left / denominator), numerator, denominator)


def _orthonormal(columns: FloatArray, sizes: FloatArray | None = None) -> FloatArray:
    """Orthonormal columns of the same range; those that are nothing against *sizes* (n,) are left out."""
    scale = np.linalg.norm(columns, axis=0) if sizes is None else sizes
    vectors, singular, _ = np.linalg.svd(columns / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return np.asarray(vectors[:, singular > DEPENDENT])


def portmanteau(residuals: Sequence[ComplexArray], real: bool) -> float:
    """Chance [1] of so much likeness of neighbours in white noise, of series (n, n_output) [any unit]; *real*
    or complex ones.

    Q = n (n + 2) sum |r_d|^2 / (n - d) over lags d is chi-square with one degree of freedom per lag (Ljung
    and Box 1978), of complex circular series 2 Q with two. Equation (decay-portmanteau).
    """
    statistic, dof = 0.0, 0
    for series in residuals:
        n = series.shape[0]
        lags = min(LAGS, n // ROWS_PER_LAG)
        for column in series.T:
            power = fft.fft(column, 2 * n)
            likeness = fft.ifft(np.abs(power) ** 2)[: lags + 1]
            ratios = np.abs(likeness[1:] / likeness[0].real) ** 2
            statistic += float(n * (n + 2) * np.sum(ratios / (n - np.arange(1, lags + 1))))
            dof += lags
    return chi2_tail(statistic, dof) if real else chi2_tail(2 * statistic, 2 * dof)


def _strongest_line(residuals: Sequence[tuple[Piece, ComplexArray]], rate: float) -> tuple[float, float]:
    """Chance of so strong a line among all, and its frequency [Hz] (Fisher 1929: (1 - g)^(m - 1) m at
    most).
    """
    chance, frequency, n_series = 1.0, 0.0, 0
    for piece, series in residuals:
        n = piece.time.size
        lines = np.arange(1, (n + 1) // 2) if piece.lines is None else piece.lines
        power = np.abs(fft.fft(series, axis=0)) ** 2
        power = power[1 : lines.size + 1] if piece.lines is None else power
        for column in power.T:
            n_series += 1
            share = float(np.max(column) / np.sum(column))
            p_value = min(1.0, lines.size * (1 - share) ** (lines.size - 1))
            if p_value < chance or frequency == 0.0:
                chance, frequency = min(chance, p_value), float(lines[np.argmax(column)] * rate / n)
    return min(1.0, chance * n_series), frequency
