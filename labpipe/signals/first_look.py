"""Classification of an unknown force: periodic, impact or random, and its band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import FloatArray, IntArray

# Least correlation of two periods of a periodic signal; that of noise is far below.
ALIKE = 0.9
# Hits: least peak over rms, and least share of samples below a hundredth of the peak.
HIT_CREST, RESTING = 8.0, 0.7
# Least power of an excited line relative to the strongest one: -30 dB.
EXCITED = 1e-3
# A random recording is cut into about this many blocks, so that its averages number some thirty with 50 % overlap.
BLOCKS = 16


@dataclass(frozen=True)
class Excitation:
    """The kind of a force; length: samples of a period (periodic) or of a block (random, impact); band with power [Hz]."""

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
        length = round_down(int(min(gaps)))
        return Excitation("impact", length, _band(force, sample_rate), int(hits.size))
    force = force - np.mean(force)
    period = find_period(force)
    if period:
        return Excitation("periodic", period, _line_band(force, period, sample_rate), force.size // period)
    length = round_down(max(force.size // BLOCKS, 2))
    return Excitation("random", length, _band(force, sample_rate), force.size // length)


def find_period(signal: FloatArray) -> int:
    """The period of a signal (n_sample,) [any unit] in samples, with at least two periods in the signal; 0 when it is not periodic.

    A lag L counts when the correlation of x[n] and x[n + L] over all n exceeds ALIKE and is a local maximum.
    """
    n = signal.size
    if n < 8 or not np.any(signal):
        return 0
    spectrum = fft.rfft(signal, fft.next_fast_len(2 * n, real=True))
    product = fft.irfft(np.abs(spectrum) ** 2, fft.next_fast_len(2 * n, real=True))[: n // 2 + 1]
    power = np.concatenate([[0.0], np.cumsum(signal**2)])
    lags = np.arange(product.size)
    correlation = product / np.sqrt(np.maximum(power[n - lags] * (power[n] - power[lags]), np.finfo(float).tiny))
    # A slow signal also correlates with itself at short lags: lags count from the first low correlation on.
    uncorrelated = np.flatnonzero(correlation < 0.5)
    if not uncorrelated.size:
        return 0
    later = correlation[uncorrelated[0] :]
    peaks = np.flatnonzero((later[1:-1] >= ALIKE) & (later[1:-1] >= later[:-2]) & (later[1:-1] >= later[2:])) + 1
    if not peaks.size:
        return 0
    # Noise lowers the correlation at all multiples of the period equally; the period is the shortest lag close to the maximum.
    near = peaks[later[peaks] >= later[peaks].max() - (1 - ALIKE) / 2]
    return int(uncorrelated[0] + near[0])


def hit_starts(force: FloatArray) -> IntArray:
    """Samples at which hammer hits begin, (n_hit,); none where the force (n_sample,) [N] is not near zero most of the time."""
    peak, rms = float(np.max(np.abs(force))), float(np.sqrt(np.mean(force**2)))
    if rms == 0 or peak < HIT_CREST * rms or np.mean(np.abs(force) < 0.01 * peak) < RESTING:
        return np.empty(0, np.intp)
    above = np.flatnonzero(np.abs(force) > 0.1 * peak)
    return above[np.concatenate([[True], np.diff(above) > force.size // 1000 + 10])]


def round_down(samples: int) -> int:
    """The largest 1, 2 or 5 times a power of ten that is not above *samples*."""
    decade = 10 ** (len(str(samples)) - 1)
    return max(step * decade for step in (1, 2, 5) if step * decade <= samples)


def _line_band(force: FloatArray, period: int, sample_rate: float) -> tuple[float, float]:
    """The first and the last line [Hz] with power of a periodic force."""
    whole = force[: force.size // period * period].reshape(-1, period).mean(axis=0)
    power = np.abs(fft.rfft(whole)) ** 2
    power[0] = 0.0
    lines = np.flatnonzero(power > EXCITED * power.max()) * sample_rate / period
    return float(lines[0]), float(lines[-1])


def _band(force: FloatArray, sample_rate: float) -> tuple[float, float]:
    """The band [Hz] with power of a force that is not periodic, from the mean spectrum of its blocks."""
    length = max(force.size // BLOCKS, 8)
    blocks = force[: force.size // length * length].reshape(-1, length)
    power = np.mean(np.abs(fft.rfft(blocks * np.hanning(length), axis=1)) ** 2, axis=0)
    power[0] = 0.0
    lines = np.flatnonzero(power > EXCITED * power.max()) * sample_rate / length
    if not lines.size:
        # A force that does not vary, or holds no number, has power nowhere.
        return 0.0, 0.4 * sample_rate
    return float(lines[0]), float(min(lines[-1], 0.4 * sample_rate))
