"""Averaged cross-spectral matrix of all channels in one pass over the recording (Welch's method).

Sums over segments of X_a X_b*, the cross-products of all channels at every line. Segments are tapered and
transformed as they come, channels side by side; a few dozen of them together are the small matrices
(n_channel, n_segment) of every line that BLAS multiplies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.processes import in_threads
from labpipe.spectra.settings import DETRENDS
from labpipe.spectra.windows import effective_averages, line_correlation

# Measured on blocks of 1024 to 100,000 samples: samples of all channels that are transformed together, and
# complex numbers of products or of factors, that stay in the cache.
CACHED_SAMPLES, CACHED_NUMBERS = 1 << 16, 1 << 15
# Segments whose products are summed at once, which reads and writes the sums once: this many and two for
# every channel, but no more complex amplitudes than MOST_AMPLITUDES.
SEGMENTS_AT_ONCE, MOST_AMPLITUDES = 16, 12 << 20


class SegmentProducts:
    """Running sums of X_a X_b* over tapered segments w x whose trend sum_p c_p b_p is taken out after the
    transform.

    FFT(w (x - sum_p c_p b_p)) = FFT(w x) - sum_p c_p FFT(w b_p), where FFT(w b_p) has few lines that differ
    from zero. Equation (spec-trend).
    """

    def __init__(
        self, window: FloatArray, step: int, lines: range, n_channel: int, trend: ComplexArray
    ) -> None:
        """*window* (n,) [1]; *step* [samples] from segment to segment; *lines* of the DFT that are summed,
        neighbours above 0; *trend* (n_row, n_disturbed): FFT(w b_p) from there.
        """
        self._step, self._lines, self._trend = step, slice(lines[0], lines[-1] + 1), trend
        # Of every channel, so that a segment is one long row.
        self._taper = np.repeat(window, n_channel).reshape(window.size, n_channel)
        room = min(SEGMENTS_AT_ONCE + 2 * n_channel, MOST_AMPLITUDES // (len(lines) * n_channel))
        self._amplitude = np.empty((max(1, room), len(lines), n_channel), np.complex128)
        self._sum = np.zeros((len(lines), n_channel, n_channel), np.complex128)
        self._n_waiting = 0
        self.n_block = 0

    @property
    def room(self) -> int:
        """Segments that can still be put in before their products are added."""
        return self._amplitude.shape[0] - self._n_waiting

    def put(self, samples: FloatArray, coefficients: FloatArray) -> None:
        """Put in at most *room* segments, which begin at every step of samples (n_sample, n_channel), with
        their trends (n_segment, n_row, n_channel) [channel unit].
        """
        n_segment, n = coefficients.shape[0], self._taper.shape[0]
        segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[:: self._step].swapaxes(1, 2)
        place = self._amplitude[self._n_waiting : self._n_waiting + n_segment]
        n_together = max(1, CACHED_SAMPLES // self._taper.size)

        def transform(starts: Sequence[int]) -> None:
            tapered = np.empty((n_together, *self._taper.shape))
            for start in starts:
                some = slice(start, min(start + n_together, n_segment))
                rows = np.multiply(segments[some], self._taper, out=tapered[: some.stop - start])
                place[some] = fft.rfft(rows, axis=1)[:, self._lines]
                place[some, : self._trend.shape[1]] -= self._trend.T @ coefficients[some]

        self._share(transform, range(0, n_segment, n_together))
        self._n_waiting += n_segment
        if self.room == 0:
            self.flush()

    def flush(self) -> None:
        """Add what is waiting to the sums."""
        waiting = self._amplitude[: self._n_waiting]
        n_chunk = max(1, CACHED_NUMBERS // max(1, waiting[:, 0].size))

        def multiply(starts: Sequence[int]) -> None:
            for start in starts:
                left = waiting[:, start : start + n_chunk]
                self._sum[start : start + n_chunk] += left.transpose(1, 2, 0) @ left.conj().swapaxes(0, 1)

        self._share(multiply, range(0, self._sum.shape[0], n_chunk))
        self.n_block += self._n_waiting
        self._n_waiting = 0

    def _share(self, work: Callable[[Sequence[int]], None], parts: Sequence[int]) -> None:
        """Do *work* on the parts, on two threads for long segments: short ones cost less than the second."""
        if self._taper.size > CACHED_SAMPLES:
            in_threads(work, parts)
        else:
            work(parts)

    def matrix(self, columns: Sequence[int] | None = None, scale: float = 1.0) -> ComplexArray:
        """*scale* sum X_a X_b* so far, (n_line, n_channel, n_channel) [unit], Hermitian to the last digit.

        Of all b, or of *columns*. A few lines at a time, which stay in the cache; lines are last in memory.
        """
        n_line, n = self._sum.shape[:2]
        chosen = range(n) if columns is None else columns
        matrix = np.empty((n, len(chosen), n_line), np.complex128)
        n_chunk = max(1, CACHED_NUMBERS // n**2)

        def turn(starts: Sequence[int]) -> None:
            for start in starts:
                lines = slice(start, start + n_chunk)
                sums = self._sum[lines] * scale
                # X_a X_b* and (X_b X_a*)* differ by rounding: of each pair that of the later channel's row.
                for number, column in enumerate(chosen):
                    matrix[column:, number, lines] = sums[:, column:, column].T
                    matrix[column, number, lines].imag = 0.0
                    np.conjugate(sums[:, column, :column].T, out=matrix[:column, number, lines])

        in_threads(turn, range(0, n_line, n_chunk))
        return matrix.transpose(2, 0, 1)


@dataclass(frozen=True)
class CrossSpectra:
    """Averaged cross-spectral density matrix S_ab = E[X_a X_b*] of all channels.

    frequency (n_frequency,) [Hz]; matrix (n_frequency, n_channel, n_channel) complex, one-sided [unit_a
    unit_b / Hz], or its columns of some channels b; n_block: blocks averaged; averages: effective number of
    independent blocks (window, overlap); line_correlation: correlation of the FRF's noise between
    neighbouring lines, see windows.line_correlation.
    """

    frequency: FloatArray
    matrix: ComplexArray
    n_block: int
    averages: float
    line_correlation: tuple[complex, ...] = ()


class WelchAverage:
    """Running sum of the cross-spectral matrix, fed with blocks of any length.

    Segments are transformed a few at a time.
    """

    def __init__(
        self,
        window: FloatArray,
        step: int,
        n_channel: int,
        lines: slice = slice(1, None),
        detrend: str = "constant",
    ) -> None:
        """*window* (n_sample,) [1], *step* samples from segment to segment; *lines* of the DFT, neighbours
        above 0 Hz.

        *detrend*: trend subtracted from every segment before the window: its mean (constant), a straight line
        (linear), or none.
        """
        self._step, self._window = step, window
        self._lines = range(window.size // 2 + 1)[lines]
        self._basis = trend_basis(detrend, window.size)
        trend = _significant_lines(fft.rfft(window * self._basis, axis=1)[:, lines])
        self._products = SegmentProducts(window, step, self._lines, n_channel, trend)
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
        """Taper all complete segments of samples (n, n_channel), at most *most*.

        Returns where the next one begins.
        """
        n = self._window.size
        n_segment = min(most, max(0, (samples.shape[0] - n) // self._step + 1))
        if n_segment:
            trend = self._trend_of(samples, n_segment)
        first = 0
        while first < n_segment:
            chunk = slice(first, min(n_segment, first + self._products.room))
            self._products.put(samples[first * self._step :], trend[chunk])
            first = chunk.stop
        return n_segment * self._step

    def _trend_of(self, samples: FloatArray, n_segment: int) -> FloatArray:
        """The coefficients (n_segment, n_row, n_channel) of the trends of the first segments of *samples*.

        A mean is that of whole steps, where they fit, so that every sample is summed once, however blocks
        overlap.
        """
        n, step = self._window.size, self._step
        if self._basis.shape[0] != 1 or n % step:
            segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[::step][:n_segment]
            return self._basis @ segments.swapaxes(1, 2)
        n_step = n_segment - 1 + n // step
        sums = self._basis[:, :step] @ samples[: n_step * step].reshape(n_step, step, -1)
        return np.lib.stride_tricks.sliding_window_view(sums, n // step, axis=0).sum(axis=3)

    def spectra(self, sample_rate: float, columns: Sequence[int] | None = None) -> CrossSpectra:
        """The averaged matrix at the selected lines, of all channels b or of *columns*; DataError when no
        block was complete.

        Equation (spec-welch).
        """
        self._products.flush()
        n_block = self._products.n_block
        if n_block == 0:
            have, need = (
                sum(piece.shape[0] for piece in self._rest) / sample_rate,
                self._window.size / sample_rate,
            )
            raise DataError(
                f"the recording is {have:g} s long, too short for one block of {need:g} s",
                hint="shorten `block`",
            )
        matrix = self._products.matrix(columns, float(2 / (sample_rate * np.sum(self._window**2) * n_block)))
        frequency = np.array(self._lines) * (sample_rate / self._window.size)
        averages = effective_averages(self._window, self._step, n_block)
        return CrossSpectra(
            frequency, matrix, n_block, averages, line_correlation(self._window, self._step, n_block)
        )


def trend_basis(detrend: str, n_sample: int) -> FloatArray:
    """Orthonormal rows (n_row, n_sample) [1] that span the trend: none, constant, or linear.

    ConfigError for another name.
    """
    if detrend not in DETRENDS:
        raise ConfigError(f"unknown trend '{detrend}'", hint=f"known: {', '.join(DETRENDS)}")
    rows = [np.ones(n_sample), np.arange(n_sample) - (n_sample - 1) / 2][
        : {"none": 0, "constant": 1, "linear": 2}[detrend]
    ]
    return np.array([row / np.linalg.norm(row) for row in rows]).reshape(len(rows), n_sample)


def _significant_lines(trend: ComplexArray) -> ComplexArray:
    """The first lines (n_row, n_line) up to the last one above rounding: a row's largest possible amplitude
    is sqrt(n_sample).
    """
    size = np.sqrt(2 * trend.shape[1])
    above = np.flatnonzero(np.any(np.abs(trend) > np.finfo(float).eps * size, axis=0))
    return trend[:, : above[-1] + 1 if above.size else 0]
