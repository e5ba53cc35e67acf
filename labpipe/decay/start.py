"""Start values of a free decay: the matrix pencil of the decimated record, followed over longer and longer pieces of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.decay.likelihood import Decayed, maximum_likelihood
from labpipe.decay.pieces import Piece, shortened
from labpipe.errors import FitError
from labpipe.records.free_decay import FreeDecay

# Samples of the decimated record, series of them, and how many ranks beyond that of the modes are tried.
MOST_SAMPLES, MOST_SERIES = 600, 4
RANKS = (0, 1, 2, 4)
# Minima count as one when their -2 ln likelihood differs by less.
SAME = 1e-3
# The decimated rate over the highest frequency that stands out.
SAMPLES_PER_PERIOD = 4.0
# A line stands out when its power is this many times the median.
STANDS_OUT = 30.0
# Half length of the decimating filter in decimated samples; the ends of the record that it sees are dropped.
FILTER = 10


def most_likely(
    decays: Sequence[FreeDecay], columns: Sequence[int], pieces: Sequence[Piece], rate: float, band: tuple[float, float] | None, n_mode: int
) -> Decayed:
    """The most likely fit from all starts; FitError where none leads to *n_mode* modes."""
    strongest = sorted(decays, key=lambda decay: -float(np.max(np.var(decay.samples[:, list(columns)], axis=0))))
    series = [decay.samples[:, column] for decay in strongest for column in columns][:MOST_SERIES]
    thinned, slower = _decimated(series, rate, band, n_mode)
    fits: list[Decayed] = []
    for extra in RANKS:
        start = pencil_poles(thinned, slower, n_mode, 2 * (n_mode + extra), band)
        if start is None:
            continue
        try:
            fit = _followed(pieces, start, round(MOST_SAMPLES * rate / slower), band)
        except FitError:
            continue
        if fit.converged and any(other.converged and abs(other.misfit - fit.misfit) < SAME for other in fits):
            break
        fits.append(fit)
    if not fits:
        what = f"no {n_mode} decaying oscillation(s) stand out of the noise" + (f" in {band[0]:g}-{band[1]:g} Hz" if band else "")
        raise FitError(what, hint="fewer `modes`, another `band`, or a decay that begins earlier")
    return min(fits, key=lambda fit: (not fit.converged, fit.misfit))


def _followed(pieces: Sequence[Piece], poles: ComplexArray, n_sample: int, band: tuple[float, float] | None) -> Decayed:
    """The fit over pieces of doubling length, so that the phase of a long record is never lost by a whole turn."""
    longest = max(piece.time.size for piece in pieces)
    while band is None and n_sample < longest:
        poles = maximum_likelihood([shortened(piece, n_sample, band) for piece in pieces], poles).poles
        n_sample *= 2
    return maximum_likelihood(pieces, poles)


def pencil_poles(
    series: Sequence[FloatArray], rate: float, n_mode: int, rank: int, band: tuple[float, float] | None = None
) -> ComplexArray | None:
    """The *n_mode* strongest oscillating poles (n_mode,) [rad/s] of series (n_sample,) [any unit] at *rate* [Hz]; None without so many.

    Matrix pencil (Hua and Sarkar 1990) in the form of a shift-invariant subspace: the first *rank* left singular vectors of the Hankel
    matrix of all series. Equation (decay-pencil).
    """
    rows = min(samples.size for samples in series) // 3
    if rows <= rank + 1:
        raise FitError(f"the decay is {3 * rows} samples of its highest frequency long", hint="a longer decay, or a wider `band`")
    hankel = np.concatenate([np.lib.stride_tricks.sliding_window_view(samples, rows).T for samples in series], axis=1)
    vectors = np.linalg.eigh(hankel @ hankel.T)[1][:, -rank:]
    turns = np.linalg.eigvals(np.linalg.lstsq(vectors[:-1], vectors[1:], rcond=None)[0])
    turns = turns[(turns.imag > 1e-9) & (np.abs(turns) > 0)]
    poles = np.asarray(np.log(turns) * rate, np.complex128)
    low, high = band or (0.0, np.inf)
    poles = poles[(poles.imag > 2 * np.pi * low) & (poles.imag < 2 * np.pi * high) & (np.abs(poles.real) < poles.imag)]
    if poles.size < n_mode:
        return None
    return np.asarray(poles[np.argsort(-_energy(series, poles / rate))[:n_mode]])


def _energy(series: Sequence[FloatArray], steps: ComplexArray) -> FloatArray:
    """Energy (n_pole,) of every pole's part in all series."""
    energy = np.zeros(steps.size)
    for samples in series:
        course = np.exp(np.arange(samples.size)[:, None] * (np.minimum(steps.real, 0.0) + 1j * steps.imag))
        both = np.concatenate([course.real, course.imag], axis=1)
        factors = np.linalg.lstsq(both, samples, rcond=None)[0]
        sizes = np.hypot(factors[: steps.size], factors[steps.size :])
        energy += sizes**2 * np.sum(np.abs(course) ** 2, axis=0)
    return energy


def _decimated(series: Sequence[FloatArray], rate: float, band: tuple[float, float] | None, n_mode: int) -> tuple[list[FloatArray], float]:
    """The series without offset at the least rate [Hz] that shows their modes, at most MOST_SAMPLES of each."""
    centred = [_filtered(samples - np.mean(samples), rate, band) for samples in series]
    factor = max(1, int(rate / (SAMPLES_PER_PERIOD * _highest(centred[0], rate, band, n_mode))))
    if factor == 1:
        return [samples[:MOST_SAMPLES] for samples in centred], rate
    # Imported here, since scipy.signal brings scipy.stats along: half a second.
    from scipy import signal

    slow = [signal.resample_poly(samples, 1, factor) for samples in centred]
    inside = [samples[FILTER:-FILTER][:MOST_SAMPLES] if samples.size > 4 * FILTER else samples for samples in slow]
    return inside, rate / factor


def _filtered(samples: FloatArray, rate: float, band: tuple[float, float] | None) -> FloatArray:
    """The samples within a band, without the ends that the filter spoils; all of them without one."""
    if band is None:
        return samples
    frequency = fft.rfftfreq(samples.size, 1 / rate)
    edge = 0.2 * (band[1] - band[0])
    gain = np.clip(np.minimum(frequency - band[0] + edge, band[1] + edge - frequency) / edge, 0.0, 1.0)
    spoilt = min(int(rate / edge), samples.size // 4)
    whole: FloatArray = fft.irfft(fft.rfft(samples) * (3 - 2 * gain) * gain**2, samples.size)
    return whole[spoilt:-spoilt]


def _highest(samples: FloatArray, rate: float, band: tuple[float, float] | None, n_mode: int) -> float:
    """The highest frequency [Hz] that the start values need: of the band, or of the strongest lines."""
    if band is not None:
        return band[1]
    power = np.abs(fft.rfft(samples)) ** 2
    inner = power[1:-1]
    peaks = np.flatnonzero((inner >= power[:-2]) & (inner >= power[2:]) & (inner > STANDS_OUT * np.median(power))) + 1
    strongest = peaks[np.argsort(-power[peaks])][: 2 * n_mode]
    number = int(np.max(strongest)) if strongest.size else power.size - 1
    return 1.2 * max(number, 1) * rate / samples.size
