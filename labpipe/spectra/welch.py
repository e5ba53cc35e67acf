"""Averaged cross-spectral matrix of all channels in one pass over the recording (Welch's method)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.processes import by_turns, threads
from labpipe.spectra.settings import DETRENDS
from labpipe.spectra.windows import effective_averages, line_correlation

# Measured on blocks of 4096 to 100,000 samples: samples of a block that stay in the cache, channels together.
SAMPLES_OF_SHORT = 120_000
# Segments whose products are made together [samples, segments]: few enough to stay in the cache and, of very
# long blocks, in memory; two for a channel at least, since sums of n x n products are read and written once
# for all of them.
CACHED_SAMPLES, MOST_SAMPLES, SEGMENTS_AT_ONCE = 1 << 18, 1 << 24, 18
# Most channels, samples of a segment for each from which on rows are faster, and lines of a row in the cache.
MOST_IN_ROWS, ROWS_FROM, LONG_ROW = 4, 4096, 16_384
# Complex numbers of products that stay in the cache together with what they are made of.
CACHED_PRODUCTS = 1 << 15


class SegmentProducts:
    """Running sums of X_a X_b* over tapered segments w x whose trend sum_p c_p b_p is taken out after the
    transform. FFT(w (x - sum_p c_p b_p)) = FFT(w x) - sum_p c_p FFT(w b_p), where FFT(w b_p) has few lines
    that differ from zero. Equation (spec-trend).
    """

    def __init__(self, window: FloatArray, lines: range, n_channel: int, trend: ComplexArray) -> None:
        """*window* (n,) [1]; *lines* of the DFT that are summed, neighbours above 0; *trend* (n_row,
        n_disturbed): FFT(w b_p) from there.
        """
        self._n, self._lines, self._trend = window.size, lines, trend
        n = window.size * n_channel
        together = max(SEGMENTS_AT_ONCE, 2 * n_channel, CACHED_SAMPLES // n)
        self._room = max(1, min(together, MOST_SAMPLES // n))
        self._coefficients = np.empty((self._room, trend.shape[0], n_channel))
        self._n_waiting = self.n_block = 0
        # Short segments are transformed at once; of long ones each by a thread.
        is_short = n <= SAMPLES_OF_SHORT
        self._n_thread, self._together = (1, self._room) if is_short else (threads(), 1)
        self._taper = np.repeat(window, n_channel).reshape(self._n, n_channel)
        self._tapered = np.empty((self._n_thread, self._together, self._n, n_channel))
        self._amplitude = np.empty((self._room, len(lines), n_channel), np.complex128)
        self._sum = np.zeros((len(lines), n_channel, n_channel), np.complex128)

    @property
    def room(self) -> int:
        """Segments that can still be put in before the next transform."""
        return self._room - self._n_waiting

    def put(self, segments: FloatArray, coefficients: FloatArray) -> None:
        """Put in at most *room* segments (n_segment, n, n_channel) with their trends (n_segment, n_row,
        n_channel) [channel unit].
        """
        first = self._n_waiting

        def transform(starts: Sequence[int], thread: int) -> None:
            for start in starts:
                some = segments[start : start + self._together]
                tapered = np.multiply(some, self._taper, out=self._tapered[thread, : len(some)])
                transformed = fft.rfft(tapered, axis=1)[:, self._lines[0] : self._lines[-1] + 1]
                if len(some) == self._room:
                    self._amplitude = transformed
                else:
                    self._amplitude[first + start : first + start + len(some)] = transformed

        by_turns(transform, range(0, len(segments), self._together), self._n_thread)
        self._n_waiting += len(segments)
        self._coefficients[first : self._n_waiting] = coefficients
        if self.room == 0:
            self.flush()

    def flush(self) -> None:
        """Add what is waiting to the sums."""
        if not self._n_waiting:
            return
        kept = self._amplitude[: self._n_waiting]
        for number, trend in enumerate(self._trend):
            coefficients = self._coefficients[: self._n_waiting, number, None]
            kept[:, : trend.size] -= trend[None, :, None] * coefficients
        _add_matrices(kept.swapaxes(0, 1), self._sum, self._n_thread)
        self.n_block += self._n_waiting
        self._n_waiting = 0

    def matrix(self, columns: Sequence[int] | None = None, scale: float = 1.0) -> ComplexArray:
        """*scale* sum X_a X_b* so far, (n_line, n_channel, n_channel) [unit], Hermitian to the last digit. Of
        all b, or of *columns*. X_a X_b* and (X_b X_a*)* differ by rounding: of each pair that of the later
        channel's row. A few lines at a time, which stay in the cache; lines are last in memory.
        """
        n_line, n = self._sum.shape[:2]
        chosen = range(n) if columns is None else columns
        matrix = np.empty((n, len(chosen), n_line), np.complex128)
        n_chunk = max(1, CACHED_PRODUCTS // n**2)
        for start in range(0, n_line, n_chunk):
            lines = slice(start, start + n_chunk)
            part = self._sum[lines] * scale
            np.einsum("laa->la", part).imag[...] = 0.0
            for number, column in enumerate(chosen):
                matrix[column:, number, lines] = part[:, column:, column].T
                np.conjugate(part[:, column, :column].T, out=matrix[:column, number, lines])
        return matrix.transpose(2, 0, 1)


class RowProducts:
    """As SegmentProducts, of a few channels in long segments: each is added at once, by operations on rows of
    lines.
    """

    room = 1

    def __init__(self, window: FloatArray, lines: range, n_channel: int, trend: ComplexArray) -> None:
        self._window, self._lines, self._trend = window, lines, trend
        self._tapered = np.empty((n_channel, window.size))
        self._sum = np.zeros((n_channel, n_channel, len(lines)), np.complex128)
        self.n_block = 0

    def put(self, segments: FloatArray, coefficients: FloatArray) -> None:
        """Add a segment (1, n, n_channel) with its trends (1, n_row, n_channel) [channel unit]."""
        np.multiply(segments[0].T, self._window, out=self._tapered)
        amplitude = fft.rfft(self._tapered, axis=1)[:, self._lines[0] : self._lines[-1] + 1]
        for trend, values in zip(self._trend, coefficients[0], strict=True):
            amplitude[:, : trend.size] -= values[:, None] * trend
        for start in range(0, len(self._lines), LONG_ROW):
            lines = slice(start, start + LONG_ROW)
            part = amplitude[:, lines]
            conjugates = part.conj()
            for channel, row in enumerate(part):
                self._sum[channel, : channel + 1, lines] += row * conjugates[: channel + 1]
        self.n_block += 1

    def flush(self) -> None:
        """Nothing waits."""

    def matrix(self, columns: Sequence[int] | None = None, scale: float = 1.0) -> ComplexArray:
        """As of SegmentProducts, (n_line, n_channel, n_channel) [unit]."""
        matrix = self._sum * scale
        for row in range(len(matrix)):
            matrix[row, row].imag = 0.0
            np.conjugate(matrix[row, :row], out=matrix[:row, row])
        return (matrix if columns is None else matrix[:, list(columns)]).transpose(2, 0, 1)


def _add_matrices(amplitude: ComplexArray, sums: ComplexArray, n_thread: int = 1) -> None:
    """Add sum_k X_a X_b* of *amplitude* (n_line, n_segment, n), lines that stay in the cache together."""
    n_line, n = sums.shape[:2]
    n_chunk = max(1, CACHED_PRODUCTS // (n * (n + 2 * amplitude.shape[1])))

    def add(starts: Sequence[int], _: int) -> None:
        product = np.empty((n_chunk, n, n), np.complex128)
        for start in starts:
            chunk = slice(start, min(start + n_chunk, n_line))
            part = amplitude[chunk]
            sums[chunk] += np.matmul(part.swapaxes(1, 2), part.conj(), out=product[: chunk.stop - start])

    by_turns(add, range(0, n_line, n_chunk), n_thread)


@dataclass(frozen=True)
class CrossSpectra:
    """Averaged cross-spectral density matrix S_ab = E[X_a X_b*] of all channels. frequency (n_frequency,)
    [Hz]; matrix (n_frequency, n_channel, n_channel) complex, one-sided [unit_a unit_b / Hz], or its columns
    of some channels b; n_block: blocks averaged; averages: effective number of independent blocks (window,
    overlap); line_correlation: correlation of the FRF's noise between neighbouring lines, see
    windows.line_correlation.
    """

    frequency: FloatArray
    matrix: ComplexArray
    n_block: int
    averages: float
    line_correlation: tuple[complex, ...] = ()


class WelchAverage:
    """Running sum of the cross-spectral matrix, fed with blocks of any length."""

    def __init__(
        self,
        window: FloatArray,
        step: int,
        n_channel: int,
        lines: slice = slice(1, None),
        detrend: str = "constant",
    ) -> None:
        """*window* (n_sample,) [1], *step* samples from segment to segment; *lines* of the DFT, neighbours
        above 0 Hz. *detrend*: trend subtracted from every segment before the window: its mean (constant), a
        straight line (linear), or none.
        """
        self._step, self._window, self.n_sample = step, window, window.size
        self._lines = range(window.size // 2 + 1)[lines]
        self._basis = trend_basis(detrend, window.size)
        trend = fft.rfft(window * self._basis, axis=1)[:, lines]
        above = np.abs(trend) > np.finfo(float).eps * np.sqrt(2 * trend.shape[1])
        trend = trend[:, : np.max(np.flatnonzero(np.any(above, axis=0)), initial=-1) + 1]
        in_rows = n_channel <= MOST_IN_ROWS and window.size >= ROWS_FROM * n_channel
        way = RowProducts if in_rows else SegmentProducts
        self._products = way(window, self._lines, n_channel, trend)
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
            # Segments that begin before the block are cut from a joint copy; the block itself, long as a
            # rule, is not copied.
            seam = np.concatenate([*self._rest, block[: n - 1]])
            begin = self._add_segments(seam, -(-n_rest // self._step)) - n_rest
        consumed = begin + self._add_segments(block[begin:], block.shape[0]) if begin >= 0 else begin
        self._rest = [block[consumed:].copy()] if consumed >= 0 else [seam[n_rest + consumed :].copy()]

    def _add_segments(self, samples: FloatArray, most: int) -> int:
        """Taper complete segments of samples, at most *most*; returns where the next one begins."""
        n = self._window.size
        n_segment = min(most, max(0, (samples.shape[0] - n) // self._step + 1))
        if n_segment:
            segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[:: self._step][
                :n_segment
            ].swapaxes(1, 2)
            trend = self._trend_of(samples, segments)
        first = 0
        while first < n_segment:
            chunk = slice(first, min(n_segment, first + self._products.room))
            self._products.put(segments[chunk], trend[chunk])
            first = chunk.stop
        return n_segment * self._step

    def _trend_of(self, samples: FloatArray, segments: FloatArray) -> FloatArray:
        """The trend's coefficients (n_segment, n_row, n_channel); *segments* begin with *samples*. A mean is
        that of whole steps, where they fit, so that every sample is summed once, however blocks overlap.
        """
        n, step = self._window.size, self._step
        if self._basis.shape[0] != 1 or n % step:
            return self._basis @ segments
        n_step = segments.shape[0] - 1 + n // step
        sums = self._basis[:, :step] @ samples[: n_step * step].reshape(n_step, step, -1)
        return np.lib.stride_tricks.sliding_window_view(sums, n // step, axis=0).sum(axis=3)

    def spectra(self, sample_rate: float, columns: Sequence[int] | None = None) -> CrossSpectra:
        """The averaged matrix at the selected lines, of all channels b or of *columns*; DataError when no
        block was complete. Equation (spec-welch).
        """
        self._products.flush()
        n_block = self._products.n_block
        if n_block == 0:
            have = sum(piece.shape[0] for piece in self._rest) / sample_rate
            need = self._window.size / sample_rate
            what = f"the recording is {have:g} s long, too short for one block of {need:g} s"
            raise DataError(what, hint="shorten `block`")
        matrix = self._products.matrix(columns, float(2 / (sample_rate * np.sum(self._window**2) * n_block)))
        frequency = np.array(self._lines) * (sample_rate / self._window.size)
        averages = effective_averages(self._window, self._step, n_block)
        return CrossSpectra(
            frequency, matrix, n_block, averages, line_correlation(self._window, self._step, n_block)
        )


def trend_basis(detrend: str, n_sample: int) -> FloatArray:
    """Orthonormal rows (n_row, n_sample) [1] that span the trend: none, constant, or linear. ConfigError for
    another name.
    """
    if detrend not in DETRENDS:
        raise ConfigError(f"unknown trend '{detrend}'", hint=f"known: {', '.join(DETRENDS)}")
    rows = [np.ones(n_sample), np.arange(n_sample) - (n_sample - 1) / 2][
        : {"none": 0, "constant": 1, "linear": 2}[detrend]
    ]
    return np.array([row / np.linalg.norm(row) for row in rows]).reshape(len(rows), n_sample)
