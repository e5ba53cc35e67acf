"""Random excitation: averaged cross-spectral matrix of all channels in one pass over the recording (Welch's method)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.spectra.products import segment_products
from labpipe.spectra.settings import DETRENDS
from labpipe.spectra.windows import effective_averages, line_correlation


@dataclass(frozen=True)
class CrossSpectra:
    """Averaged cross-spectral density matrix S_ab = E[X_a X_b*] of all channels.

    frequency (n_frequency,) [Hz]; matrix (n_frequency, n_channel, n_channel) complex, one-sided [unit_a unit_b / Hz], or its columns of
    some channels b;
    n_block: blocks averaged; averages: effective number of independent blocks (window, overlap);
    line_correlation: correlation of the FRF's noise between neighbouring lines, see windows.line_correlation.
    """

    frequency: FloatArray
    matrix: ComplexArray
    n_block: int
    averages: float
    line_correlation: tuple[complex, ...] = ()


class WelchAverage:
    """Running sum of the cross-spectral matrix, fed with blocks of any length; segments are transformed a few at a time."""

    def __init__(self, window: FloatArray, step: int, n_channel: int, lines: slice = slice(1, None), detrend: str = "constant") -> None:
        """*window* (n_sample,) [1], *step* samples from segment to segment; *lines* of the DFT, neighbours above 0 Hz.

        *detrend*: trend subtracted from every segment before the window: its mean (constant), a straight line (linear), or none.
        """
        self._step, self._window = step, window
        self._lines = range(window.size // 2 + 1)[lines]
        self._basis = trend_basis(detrend, window.size)
        trend = _significant_lines(fft.rfft(window * self._basis, axis=1)[:, lines])
        self._products = segment_products(window, step, self._lines, n_channel, trend)
        self._rest: list[FloatArray] = []

    def add(self, block: FloatArray) -> None:
        """Add the next samples (n, n_channel) [unit of the channel]."""
        n, block = self._window.size, np.ascontiguousarray(block, np.float64)
        n_rest = sum(piece.shape[0] for piece in self._rest)
        if n_rest + block.shape[0] < n:
            self._rest.append(block.copy())
            return
        begin = 0
        if n_rest:
            # Segments that begin before the block are cut from a joint copy; the block itself, long as a rule, is not copied.
            seam = np.concatenate([*self._rest, block[: n - 1]])
            begin = self._add_segments(seam, -(-n_rest // self._step)) - n_rest
        consumed = begin + self._add_segments(block[begin:], block.shape[0]) if begin >= 0 else begin
        self._rest = [block[consumed:].copy()] if consumed >= 0 else [seam[n_rest + consumed :].copy()]

    def _add_segments(self, samples: FloatArray, most: int) -> int:
        """Taper all complete segments of samples (n, n_channel), at most *most*; returns where the next one begins."""
        n = self._window.size
        n_segment = min(most, max(0, (samples.shape[0] - n) // self._step + 1))
        if n_segment:
            segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[:: self._step][:n_segment].swapaxes(1, 2)
            trend = self._trend_of(samples, segments)
        first = 0
        while first < n_segment:
            chunk = slice(first, min(n_segment, first + self._products.room))
            self._products.put(segments[chunk], trend[chunk])
            first = chunk.stop
        return n_segment * self._step

    def _trend_of(self, samples: FloatArray, segments: FloatArray) -> FloatArray:
        """The trend's coefficients (n_segment, n_row, n_channel); *segments* begin with *samples*.

        A mean is that of whole steps, where they fit, so that every sample is summed once, however blocks overlap.
        """
        n, step = self._window.size, self._step
        if self._basis.shape[0] != 1 or n % step:
            return self._basis @ segments
        n_step = segments.shape[0] - 1 + n // step
        sums = self._basis[:, :step] @ samples[: n_step * step].reshape(n_step, step, -1)
        return np.lib.stride_tricks.sliding_window_view(sums, n // step, axis=0).sum(axis=3)

    def spectra(self, sample_rate: float, columns: Sequence[int] | None = None) -> CrossSpectra:
        """The averaged matrix at the selected lines, of all channels b or of *columns*; DataError when no block was complete.

        Equation (spec-welch).
        """
        self._products.flush()
        n_block = self._products.n_block
        if n_block == 0:
            have, need = sum(piece.shape[0] for piece in self._rest) / sample_rate, self._window.size / sample_rate
            raise DataError(f"the recording is {have:g} s long, too short for one block of {need:g} s", hint="shorten `block`")
        matrix = self._products.matrix(columns, float(2 / (sample_rate * np.sum(self._window**2) * n_block)))
        frequency = np.array(self._lines) * (sample_rate / self._window.size)
        averages = effective_averages(self._window, self._step, n_block)
        return CrossSpectra(frequency, matrix, n_block, averages, line_correlation(self._window, self._step, n_block))


def trend_basis(detrend: str, n_sample: int) -> FloatArray:
    """Orthonormal rows (n_row, n_sample) [1] that span the trend: none, constant, or linear; ConfigError for another name."""
    if detrend not in DETRENDS:
        raise ConfigError(f"unknown trend '{detrend}'", hint=f"known: {', '.join(DETRENDS)}")
    rows = [np.ones(n_sample), np.arange(n_sample) - (n_sample - 1) / 2][: {"none": 0, "constant": 1, "linear": 2}[detrend]]
    return np.array([row / np.linalg.norm(row) for row in rows]).reshape(len(rows), n_sample)


def _significant_lines(trend: ComplexArray) -> ComplexArray:
    """The first lines (n_row, n_line) up to the last one above rounding: a row's largest possible amplitude is sqrt(n_sample)."""
    size = np.sqrt(2 * trend.shape[1])
    above = np.flatnonzero(np.any(np.abs(trend) > np.finfo(float).eps * size, axis=0))
    return trend[:, : above[-1] + 1 if above.size else 0]
