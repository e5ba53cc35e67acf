"""Random excitation: one pass over the recording gives the averaged cross-spectral matrix of all channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from labpipe.errors import ConfigError, DataError

# Segments transformed together: enough to keep numpy's overhead small, few enough to stay in the cache.
SEGMENTS_AT_ONCE = 16


@dataclass(frozen=True)
class CrossSpectra:
    """Averaged cross-spectral density matrix S_ab = E[X_a X_b*] of all channels.

    frequency (n_frequency,) [Hz]; matrix (n_frequency, n_channel, n_channel) complex, one-sided [unit_a unit_b / Hz];
    n_block: blocks averaged; averages: the number of independent blocks that would average as well (window, overlap).
    """

    frequency: NDArray[np.floating]
    matrix: NDArray[np.complexfloating]
    n_block: int
    averages: float


def window_values(name: str, n_sample: int) -> NDArray[np.floating]:
    """The periodic (DFT-even) window of that name; ConfigError when scipy does not know it."""
    try:
        values: NDArray[np.floating] = signal.get_window(name, n_sample, fftbins=True)
    except ValueError:
        raise ConfigError(f"unknown window '{name}'", hint="for example hann, hamming, blackman, flattop, boxcar") from None
    return values


def effective_averages(window: NDArray[np.floating], step: int, n_block: int) -> float:
    """n_e = K / (1 + 2 sum_k (1 - k/K) rho_k), rho_k = (sum w(n) w(n + k step) / sum w^2)^2 (Welch 1967).

    Overlapping blocks are correlated and average less than their number.
    """
    n = window.size
    shifts = np.arange(step, n, step)
    rho = np.array([np.dot(window[:-shift], window[shift:]) for shift in shifts]) ** 2 / np.dot(window, window) ** 2
    k = np.arange(1, shifts.size + 1)
    return float(n_block / (1 + 2 * np.sum(np.maximum(1 - k / n_block, 0) * rho)))


class WelchAverage:
    """Running sum of the cross-spectral matrix, fed block by block in any size; one FFT per channel and segment."""

    def __init__(self, window: NDArray[np.floating], step: int, n_channel: int, lines: slice = slice(1, None)) -> None:
        """*window* (n_sample,), *step* samples from block to block; *lines* of the DFT that are kept, all above 0 Hz unless given."""
        self._window = window
        self._step = step
        self._line_numbers = np.arange(window.size // 2 + 1)[lines]
        self._lines = lines
        self._rest = np.empty((n_channel, 0))
        self._sum = np.zeros((n_channel, n_channel, self._line_numbers.size), np.complex128)
        # Fresh temporaries of this size cost more time than the transforms: they are kept and filled again.
        self._tapered = np.empty((n_channel, SEGMENTS_AT_ONCE, window.size))
        self._product = np.empty((SEGMENTS_AT_ONCE, self._line_numbers.size), np.complex128)
        self.n_block = 0

    def add(self, block: NDArray[np.floating]) -> None:
        """Take samples (n, n_channel) that follow the ones before."""
        samples = np.concatenate([self._rest, block.T], axis=1)
        n_segment = max(0, (samples.shape[1] - self._window.size) // self._step + 1)
        if n_segment:
            segments = np.lib.stride_tricks.sliding_window_view(samples, self._window.size, axis=1)[:, :: self._step]
            for start in range(0, n_segment, SEGMENTS_AT_ONCE):
                self._add_segments(segments[:, start : start + SEGMENTS_AT_ONCE])
        self._rest = samples[:, n_segment * self._step :].copy()

    def _add_segments(self, segments: NDArray[np.floating]) -> None:
        """Segments (n_channel, n_segment, n_sample), each freed of its mean and windowed."""
        n_segment = segments.shape[1]
        tapered = np.subtract(segments, segments.mean(axis=2, keepdims=True), out=self._tapered[:, :n_segment])
        tapered *= self._window
        spectra = fft.rfft(tapered, axis=2)[:, :, self._lines]
        conjugate = spectra.conj()
        for a in range(spectra.shape[0]):
            for b in range(a, spectra.shape[0]):
                self._sum[a, b] += np.multiply(spectra[a], conjugate[b], out=self._product[:n_segment]).sum(axis=0)
        self.n_block += n_segment

    def spectra(self, sample_rate: float) -> CrossSpectra:
        """The averaged matrix on the kept lines; DataError when not one block was complete."""
        if self.n_block == 0:
            have, need = self._rest.shape[1] / sample_rate, self._window.size / sample_rate
            raise DataError(f"the recording is {have:g} s long, too short for one block of {need:g} s", hint="shorten `block`")
        density = 2 / (sample_rate * np.sum(self._window**2) * self.n_block)
        matrix = np.moveaxis(self._sum, 2, 0) * density
        lower = np.tril_indices(matrix.shape[1], -1)
        matrix[:, lower[0], lower[1]] = matrix[:, lower[1], lower[0]].conj()
        frequency = self._line_numbers * (sample_rate / self._window.size)
        return CrossSpectra(frequency, matrix, self.n_block, effective_averages(self._window, self._step, self.n_block))
