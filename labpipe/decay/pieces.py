"""Decays as equations: all samples of a decay, or the DFT lines of a band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.records.free_decay import FreeDecay
from labpipe.spectra.bands import lines_in

# Smooth terms along the lines of a band, which carry what modes outside it add.
SMOOTH_TERMS = 3


@dataclass(frozen=True)
class Piece:
    """One decay whose rows carry white noise: *rows* (n_row, n_output) [unit of the outputs].

    Without a band a row is a sample, and the *nuisance* (n_row, n) [1] is the offset. With a band the rows are the real and imaginary
    parts of its DFT *lines* (n_line,): white noise is white there as well, and a mode outside the band adds C (1 - z^n) / (1 - z e^-jw)
    [unit], which is smooth in it. time (n_sample,) [s].
    """

    time: FloatArray
    rows: FloatArray
    lines: IntArray | None
    nuisance: FloatArray

    def project(self, columns: FloatArray) -> FloatArray:
        """The rows (n_row, n) of functions of time (n_sample, n) [any unit]: orthonormal, so that noise keeps its size."""
        return _rows(columns, self.lines)

    def series(self, rows: FloatArray) -> ComplexArray:
        """Rows (n_row, n) [any unit] as a series (n, n) in time: the samples, or the band as a complex baseband."""
        if self.lines is None:
            return rows.astype(np.complex128)
        half = self.lines.size
        return np.asarray(fft.ifft(rows[:half] + 1j * rows[half:], axis=0) * np.sqrt(half))


def _rows(columns: FloatArray, lines: IntArray | None) -> FloatArray:
    if lines is None:
        return columns
    spectrum = fft.rfft(columns, axis=0)[lines] * np.sqrt(2 / columns.shape[0])
    return np.concatenate([spectrum.real, spectrum.imag])


def pieces_of(decays: Sequence[FreeDecay], columns: Sequence[int], rate: float, band: tuple[float, float] | None) -> tuple[Piece, ...]:
    """The pieces of the decays' outputs *columns* at *rate* [Hz] in a *band* [Hz]; FitError where the band holds too few lines."""
    return tuple(_piece(decay.samples[:, list(columns)], rate, band) for decay in decays)


def _piece(samples: FloatArray, rate: float, band: tuple[float, float] | None) -> Piece:
    n = samples.shape[0]
    time = np.arange(n) / rate
    if band is None:
        return Piece(time, samples, None, np.ones((n, 1)))
    frequency = fft.rfftfreq(n, 1 / rate)
    lines = np.flatnonzero(lines_in(frequency, band) & (frequency > 0) & (frequency < rate / 2))
    if lines.size < 4 * SMOOTH_TERMS:
        what = f"{lines.size} lines of a decay of {n / rate:g} s lie in the band {band[0]:g}-{band[1]:g} Hz"
        raise FitError(what, hint=f"widen the band to {4 * SMOOTH_TERMS} lines or more")
    return Piece(time, _rows(samples, lines), lines, _smooth_terms(lines.size))


def _smooth_terms(n_line: int) -> FloatArray:
    """Real and imaginary polynomials along the lines, (2 n_line, 2 SMOOTH_TERMS) [1]."""
    powers = np.polynomial.legendre.legvander(np.linspace(-1, 1, n_line), SMOOTH_TERMS - 1)
    empty = np.zeros_like(powers)
    return np.block([[powers, empty], [empty, powers]])


def shortened(piece: Piece, n_sample: int, band: tuple[float, float] | None) -> Piece:
    """The first samples of a piece without a band; with one the whole piece, whose lines belong to its length."""
    if band is not None or n_sample >= piece.time.size:
        return piece
    return Piece(piece.time[:n_sample], piece.rows[:n_sample], None, piece.nuisance[:n_sample])
