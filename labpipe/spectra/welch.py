"""Random excitation: averaged cross-spectral matrix of all channels in one pass over the recording (Welch's method)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.spectra.settings import DETRENDS
from labpipe.spectra.windows import effective_averages, line_correlation

# Segments transformed together [samples, segments]: enough to keep the overhead small, few enough to stay in the cache and, for
# very long blocks, in memory. Products of small matrices are fastest with about this many segments.
CACHED_SAMPLES = 1 << 18
MOST_SAMPLES = 1 << 22
SEGMENTS_AT_ONCE = 18


@dataclass(frozen=True)
class CrossSpectra:
    """Averaged cross-spectral density matrix S_ab = E[X_a X_b*] of all channels.

    frequency (n_frequency,) [Hz]; matrix (n_frequency, n_channel, n_channel) complex, one-sided [unit_a unit_b / Hz];
    n_block: blocks averaged; averages: effective number of independent blocks (window, overlap);
    line_correlation: correlation of the FRF's noise between neighbouring lines, see windows.line_correlation.
    """

    frequency: FloatArray
    matrix: ComplexArray
    n_block: int
    averages: float
    line_correlation: tuple[complex, ...] = ()


class WelchAverage:
    """Running sum of the cross-spectral matrix, fed with blocks of any length; one FFT per channel and segment.

    Segments are windowed into a buffer that is transformed when it is full, and their trend is subtracted in the frequency domain:
    FFT(w (x - sum_p c_p b_p)) = FFT(w x) - sum_p c_p FFT(w b_p), where FFT(w b_p) has few lines that differ from zero.
    """

    def __init__(self, window: FloatArray, step: int, n_channel: int, lines: slice = slice(1, None), detrend: str = "constant") -> None:
        """*window* (n_sample,) [1], *step* samples from segment to segment; *lines* of the DFT, neighbours above 0 Hz.

        *detrend*: trend subtracted from every segment before the window: its mean (constant), a straight line (linear), or none.
        """
        n = window.size
        self._step = step
        self._line_numbers = np.arange(n // 2 + 1)[lines]
        self._first = int(self._line_numbers[0])
        self._window = window
        self._taper = np.repeat(window, n_channel).reshape(n, n_channel)
        self._basis = trend_basis(detrend, n)
        self._trend = _significant_lines(fft.rfft(window * self._basis, axis=1)[:, lines])
        n_together = max(SEGMENTS_AT_ONCE, CACHED_SAMPLES // (n * n_channel))
        n_together = max(1, min(n_together, MOST_SAMPLES // (n * n_channel)))
        self._tapered = np.empty((n_together, n, n_channel))
        self._coefficients = np.empty((n_together, self._basis.shape[0], n_channel))
        self._n_waiting = 0
        self._gram = _Gram(self._line_numbers.size, n_channel)
        self._rest: list[FloatArray] = []
        self.n_block = 0

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
            segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[:: self._step].swapaxes(1, 2)
        first = 0
        while first < n_segment:
            chunk = segments[first : min(n_segment, first + self._tapered.shape[0] - self._n_waiting)]
            place = slice(self._n_waiting, self._n_waiting + chunk.shape[0])
            np.multiply(chunk, self._taper, out=self._tapered[place])
            self._coefficients[place] = self._trend_of(samples[first * self._step :], chunk)
            self._n_waiting += chunk.shape[0]
            first += chunk.shape[0]
            if self._n_waiting == self._tapered.shape[0]:
                self._transform()
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

    def _transform(self) -> None:
        """Add the spectra of the waiting segments to the sums."""
        if not self._n_waiting:
            return
        amplitude = fft.rfft(self._tapered[: self._n_waiting], axis=1)
        disturbed = slice(self._first, self._first + self._trend.shape[1])
        for number, trend in enumerate(self._trend):
            amplitude[:, disturbed] -= trend[None, :, None] * self._coefficients[: self._n_waiting, number, None, :]
        self._gram.add(amplitude, self._first)
        self.n_block += self._n_waiting
        self._n_waiting = 0

    def spectra(self, sample_rate: float) -> CrossSpectra:
        """The averaged matrix at the selected lines; DataError when no block was complete."""
        self._transform()
        if self.n_block == 0:
            have, need = sum(piece.shape[0] for piece in self._rest) / sample_rate, self._window.size / sample_rate
            raise DataError(f"the recording is {have:g} s long, too short for one block of {need:g} s", hint="shorten `block`")
        matrix = self._gram.matrix()
        matrix *= 2 / (sample_rate * np.sum(self._window**2) * self.n_block)
        frequency = self._line_numbers * (sample_rate / self._window.size)
        averages = effective_averages(self._window, self._step, self.n_block)
        return CrossSpectra(frequency, matrix, self.n_block, averages, line_correlation(self._window, self._step, self.n_block))


class _Gram:
    """Running sums of X_a X_b* over segments, as products of real matrices [re_0 im_0 re_1 im_1 ...] line by line."""

    def __init__(self, n_line: int, n_channel: int) -> None:
        self._sum = np.zeros((n_line, 2 * n_channel, 2 * n_channel + 1))
        self._product = np.empty_like(self._sum)

    def add(self, amplitude: ComplexArray, first: int) -> None:
        """Add the lines from *first* on of amplitudes (n_segment, n_line_in_all, n_channel)."""
        n_segment, n_row = amplitude.shape[0], 2 * amplitude.shape[2]
        n_line = self._sum.shape[0]
        flat = amplitude.reshape(n_segment, -1).view(np.float64)[:, (first - 1) * n_row :]
        current = flat[:, n_row : (n_line + 1) * n_row].reshape(n_segment, n_line, n_row)
        # One column more than needed, the last one of the line before: BLAS multiplies a small matrix with its own transpose
        # at half the speed of two that differ.
        wide = np.lib.stride_tricks.sliding_window_view(flat, n_row + 1, axis=1)[:, n_row - 1 :: n_row][:, :n_line]
        np.matmul(current.transpose(1, 2, 0), wide.swapaxes(0, 1), out=self._product)
        self._sum += self._product

    def matrix(self) -> ComplexArray:
        """sum X_a X_b*, (n_line, n_channel, n_channel), Hermitian to the last digit."""
        n_line, n_row, _ = self._sum.shape
        n = n_row // 2
        parts = self._sum[:, :, 1:].reshape(n_line, n, 2, n, 2)
        matrix = np.empty((n_line, n, n), np.complex128)
        matrix.real = parts[:, :, 0, :, 0] + parts[:, :, 1, :, 1]
        matrix.imag = parts[:, :, 1, :, 0] - parts[:, :, 0, :, 1]
        upper = np.triu_indices(n, 1)
        matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]].conj()
        np.einsum("faa->fa", matrix).imag = 0.0
        return matrix


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
