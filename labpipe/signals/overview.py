"""Envelope and spectrum of channels, fed block by block with constant memory."""

from __future__ import annotations

import numpy as np
from scipy import fft

from labpipe.arrays import FloatArray
from labpipe.records.overview import Envelope, Spectrum

# Intervals of an envelope: between half of this and this, enough for the width of a page.
STRETCHES = 1024
# Samples of one block of the spectrum.
BLOCK = 4096


class EnvelopeTrack:
    """Minima and maxima over intervals of equal length; pairs of intervals are merged when there are too many."""

    def __init__(self, n_channel: int, stretches: int = STRETCHES) -> None:
        self._most = stretches + stretches % 2
        self._step = 1
        self._low: FloatArray = np.empty((0, n_channel))
        self._high: FloatArray = np.empty((0, n_channel))
        self._rest: FloatArray = np.empty((0, n_channel))

    def add(self, block: FloatArray) -> None:
        """Add the next block (n, n_channel) [unit of the channel]."""
        pending = np.concatenate([self._rest, block])
        while True:
            whole = min(pending.shape[0] // self._step, self._most - self._low.shape[0])
            low, high = _extremes(pending[: whole * self._step], self._step)
            self._low, self._high = np.concatenate([self._low, low]), np.concatenate([self._high, high])
            pending = pending[whole * self._step :]
            if self._low.shape[0] < self._most:
                break
            # The number of intervals is even here, so that they merge in pairs.
            self._low, self._high, self._step = _extremes(self._low, 2)[0], _extremes(self._high, 2)[1], 2 * self._step
        self._rest = pending

    def envelopes(self) -> tuple[Envelope, ...]:
        """The envelope of every channel; samples after the last complete interval form one of their own."""
        low, high = self._low, self._high
        if self._rest.shape[0]:
            ends = _extremes(self._rest, self._rest.shape[0])
            low, high = np.concatenate([low, ends[0]]), np.concatenate([high, ends[1]])
        return tuple(Envelope(self._step, low[:, n], high[:, n]) for n in range(low.shape[1]))


def _extremes(rows: FloatArray, step: int) -> tuple[FloatArray, FloatArray]:
    """(smallest, largest) of every *step* rows, missing numbers passed over."""
    stretches = rows.reshape(-1, step, rows.shape[1])
    low, high = np.fmin.reduce(stretches, axis=1), np.fmax.reduce(stretches, axis=1)
    return low, high


class SpectrumTrack:
    """Mean power spectrum over blocks without overlap (Hann window, mean subtracted); blocks with missing numbers are skipped."""

    def __init__(self, n_channel: int, block: int = BLOCK) -> None:
        self._block = block
        self._rest: FloatArray = np.empty((0, n_channel))
        self._power = np.zeros((block // 2 + 1, n_channel))
        self._count = np.zeros(n_channel, int)

    def add(self, block: FloatArray) -> None:
        """Add the next block (n, n_channel) [unit of the channel]."""
        joined = np.concatenate([self._rest, block])
        whole = joined.shape[0] // self._block
        for number in range(whole):
            self._take(joined[number * self._block : (number + 1) * self._block])
        self._rest = joined[whole * self._block :]

    def _take(self, rows: FloatArray) -> None:
        complete = np.isfinite(rows).all(axis=0)
        self._power[:, complete] += _density(rows[:, complete])
        self._count += complete

    def spectra(self, sample_rate: float | None) -> tuple[Spectrum, ...]:
        """The spectrum of every channel; for a recording shorter than a block, that of all its samples."""
        rate = sample_rate or 1.0
        if not self._count.any() and self._rest.shape[0] > 1:
            complete = np.isfinite(self._rest).all(axis=0)
            power = np.where(complete, _density(np.where(complete, self._rest, 0.0)), 0.0)
            frequency, count = fft.rfftfreq(self._rest.shape[0], 1 / rate), complete.astype(int)
        else:
            power, count, frequency = self._power, self._count, fft.rfftfreq(self._block, 1 / rate)
        density = np.sqrt(power / np.maximum(count, 1) / rate)
        # Without the line at 0 Hz, since the mean is subtracted.
        return tuple(Spectrum(frequency[1:], density[1:, n], int(count[n])) for n in range(density.shape[1]))


def _density(rows: FloatArray) -> FloatArray:
    """One-sided power density per cycle and sample of rows (n, n_channel): its sum over n lines / n is the mean square."""
    n = rows.shape[0]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
    power = np.abs(fft.rfft((rows - rows.mean(axis=0)) * window[:, None], axis=0)) ** 2 / np.sum(window**2)
    power[1 : (n + 1) // 2] *= 2
    density: FloatArray = power
    return density
