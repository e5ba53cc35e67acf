"""First look at an unknown recording: kind of excitation and its band, envelopes and spectra of channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import FloatArray, IntArray
from labpipe.records.recording import Envelope, Spectrum

# Least correlation of two periods of a periodic signal; that of noise is far below.
ALIKE = 0.9
# Hits: least peak over rms, share of the peak below which a force rests, and least share of samples that do.
HIT_CREST, AT_REST, RESTING = 8.0, 0.01, 0.7
# Share of the longest time between hits within which a second one is a bounce of the first.
BOUNCE = 0.05
# Samples before a hit's first tenth of its peak.
AHEAD = 10
# Least power of an excited line relative to the strongest one: -30 dB.
EXCITED = 1e-3
# A random recording is cut into about this many blocks, so that its averages number some thirty with 50 %
# overlap.
BLOCKS = 16


@dataclass(frozen=True)
class Excitation:
    """The kind of a force; length: samples of a period (periodic) or of a block (random, impact). Band with
    power [Hz].
    """

    kind: str
    length: int
    band: tuple[float, float]
    repeats: int


def look(force: FloatArray, sample_rate: float) -> Excitation:
    """The kind of a force (n_sample,) [any unit] sampled at *sample_rate* [Hz]."""
    force = force - np.median(force)
    hits = hit_starts(force)
    if hits.size:
        gaps = np.diff([*hits, force.size])
        # A bounce of the hammer follows at once; `frf` names it as a double hit.
        hits = hits[np.append(True, gaps[:-1] > BOUNCE * gaps.max())]
        gaps = np.diff([*hits, force.size])
        # Two digits of what the next hit leaves: what still rings at the end of a block leaks.
        room = int(min([*0.95 * gaps[:-1], gaps[-1]]))
        length = room - room % 10 ** max(len(str(room)) - 2, 0)
        # A window would take off a hit in the first samples, where a trigger leaves it; rest may drift.
        pushes = np.where(np.abs(force) < AT_REST * np.max(np.abs(force)), 0.0, force)
        begins = np.minimum(np.maximum(hits - AHEAD, 0), force.size - length)
        pushes = np.array([pushes[begin : begin + length] for begin in begins])
        return Excitation("impact", length, _band(pushes, sample_rate), int(hits.size))
    force = force - np.mean(force)
    period = find_period(force)
    if period:
        whole = force[: force.size // period * period].reshape(-1, period)
        lines = _excited_lines(np.abs(fft.rfft(whole.mean(axis=0))) ** 2) * sample_rate / period
        return Excitation("periodic", period, (float(lines[0]), float(lines[-1])), len(whole))
    length = round_down(max(force.size // BLOCKS, 2))
    n = max(force.size // BLOCKS, 8)
    blocks = force[: force.size // n * n].reshape(-1, n) * np.hanning(n)
    return Excitation("random", length, _band(blocks, sample_rate), force.size // length)


def find_period(signal: FloatArray) -> int:
    """The period of a signal (n_sample,) [any unit] in samples, at least two of them in it; 0 for none."""
    n = signal.size
    if n < 8 or not np.any(signal):
        return 0
    spectrum = fft.rfft(signal, fft.next_fast_len(2 * n, real=True))
    product = fft.irfft(np.abs(spectrum) ** 2, fft.next_fast_len(2 * n, real=True))[: n // 2 + 1]
    power = np.concatenate([[0.0], np.cumsum(signal**2)])
    lags = np.arange(product.size)
    correlation = product / np.sqrt(
        np.maximum(power[n - lags] * (power[n] - power[lags]), np.finfo(float).tiny)
    )
    # A slow signal also correlates with itself at short lags: lags count from the first low correlation on.
    uncorrelated = np.flatnonzero(correlation < 0.5)
    if not uncorrelated.size:
        return 0
    later = correlation[uncorrelated[0] :]
    peaks = (
        np.flatnonzero((later[1:-1] >= ALIKE) & (later[1:-1] >= later[:-2]) & (later[1:-1] >= later[2:])) + 1
    )
    if not peaks.size:
        return 0
    # Noise lowers the correlation at all multiples of the period equally; the period is the shortest lag
    # close to the maximum, as are its multiples: those of 1638 samples are not where 1638.4 repeat.
    least = later[peaks].max() - (1 - ALIKE) / 2
    near = [int(lag) for lag in uncorrelated[0] + peaks[later[peaks] >= least]]
    return next((lag for lag in near if np.min(correlation[::lag]) >= least), near[0])


def hit_starts(force: FloatArray) -> IntArray:
    """Samples at which hammer hits begin, (n_hit,). None where the force (n_sample,) [N] is not near zero
    most of the time.
    """
    peak, rms = float(np.max(np.abs(force))), float(np.sqrt(np.mean(force**2)))
    if not 0 < rms < np.inf or peak < HIT_CREST * rms or np.mean(np.abs(force) < AT_REST * peak) < RESTING:
        return np.empty(0, np.intp)
    above = np.flatnonzero(np.abs(force) > 0.1 * peak)
    return above[np.concatenate([[True], np.diff(above) > force.size // 1000 + 10])]


def round_down(samples: int) -> int:
    """The largest 1, 2 or 5 times a power of ten that is not above *samples*."""
    decade = 10 ** (len(str(samples)) - 1)
    return max(step * decade for step in (1, 2, 5) if step * decade <= samples)


def _excited_lines(power: FloatArray) -> IntArray:
    above_zero = np.append(0.0, power[1:])
    return np.flatnonzero(above_zero > EXCITED * above_zero.max())


def _band(blocks: FloatArray, sample_rate: float) -> tuple[float, float]:
    power = np.mean(np.abs(fft.rfft(blocks, axis=1)) ** 2, axis=0)
    lines = _excited_lines(power) * sample_rate / blocks.shape[1]
    if not lines.size:
        # A force that does not vary, or holds no number, has power nowhere.
        return 0.0, 0.4 * sample_rate
    return float(lines[0]), float(min(lines[-1], 0.4 * sample_rate))


STRETCHES = 1024
# Samples of one block of the spectrum.
BLOCK = 4096


class EnvelopeTrack:
    """Minima and maxima over intervals of equal length."""

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
            self._low, self._high = _extremes(self._low, 2)[0], _extremes(self._high, 2)[1]
            self._step *= 2
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
    return np.fmin.reduce(stretches, axis=1), np.fmax.reduce(stretches, axis=1)


class SpectrumTrack:
    """Mean power spectrum over blocks without overlap (Hann window, mean subtracted). Blocks with missing
    numbers are skipped.
    """

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
            rows = joined[number * self._block : (number + 1) * self._block]
            complete = np.isfinite(rows).all(axis=0)
            self._power[:, complete] += _density(rows[:, complete])
            self._count += complete
        self._rest = joined[whole * self._block :]

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
    """One-sided power density per cycle and sample of rows (n, n_channel): its sum over n lines / n is the
    mean square.
    """
    n = rows.shape[0]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
    power = np.abs(fft.rfft((rows - rows.mean(axis=0)) * window[:, None], axis=0)) ** 2 / np.sum(window**2)
    power[1 : (n + 1) // 2] *= 2
    return power
