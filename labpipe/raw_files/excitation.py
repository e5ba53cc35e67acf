"""Test signals: sums of harmonics with equal amplitudes and chosen phases (PHASES by name), and swept sines.

A multisine is x(t) = sum_k A cos(2 pi f_k t + phi_k) with lines f_k in a band; it is periodic in 1 / spacing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError

# The search for phases looks at peaks between samples: the grid is this many times finer than the highest
# line needs.
OVERSAMPLING = 16
OPTIMISING_STEPS = 400


@dataclass(frozen=True)
class Multisine:
    """A designed test signal: *lines* [multiples of spacing], *phases* [rad] (n_line,), spacing [Hz], rms
    amplitude.
    """

    lines: IntArray
    phases: FloatArray
    spacing: float
    rms: float

    @property
    def crest_factor(self) -> float:
        """Peak over rms of one period, peaks between samples included."""
        return float(peaks(self.lines, np.exp(1j * self.phases)[:, None])[0] / np.sqrt(self.lines.size / 2))

    def samples(self, sample_rate: float, periods: int) -> FloatArray:
        """*periods* periods sampled at *sample_rate* [Hz], (n_sample,) [unit of rms]. ConfigError when a
        period holds no whole number of samples, or the sampling rate is too low for the highest line.
        Equation (spec-multisine).
        """
        exact = sample_rate / self.spacing
        n_sample = round(exact)
        if abs(exact - n_sample) > 1e-9 * exact:
            near = n_sample * self.spacing
            hint = f"the nearest sampling rate is {near:g} Hz"
            what = f"a period of {1 / self.spacing:g} s holds {exact:g} samples, not a whole number"
            raise ConfigError(what, hint=hint)
        if 2 * int(self.lines[-1]) >= n_sample:
            highest = self.lines[-1] * self.spacing
            what = f"lines up to {highest:g} Hz need more than {2 * highest:g} Hz of sampling rate"
            raise ConfigError(what)
        period = _period(self.lines, self.phases, n_sample)
        return np.tile(period * self.rms * np.sqrt(2 / self.lines.size), periods)


def design_multisine(
    band: tuple[float, float],
    spacing: float,
    rms: float,
    *,
    phases: str = "schroeder",
    odd_only: bool = False,
    leave_out: int = 0,
    seed: int = 0,
) -> Multisine:
    """A multisine with lines every *spacing* [Hz] in *band* [Hz]; ConfigError for an empty band or unknown
    phases. *odd_only* keeps the odd multiples of the spacing: even lines then show even distortion.
    *leave_out* removes one line, drawn with *seed*, from every group of that many: these show odd distortion
    (Pintelon and Schoukens, System Identification, sec. 4.3.2).
    """
    if leave_out == 1 or leave_out < 0:
        what = f"leaving one of {leave_out} lines out leaves none"
        raise ConfigError(what, hint="one of 3 or 4 is usual; 0 keeps all")
    if spacing <= 0 or rms <= 0:
        raise ConfigError("spacing and level must be positive")
    if phases not in PHASES:
        raise ConfigError(f"unknown phases '{phases}'", hint=f"known: {', '.join(PHASES)}")
    first, last = int(np.ceil(band[0] / spacing - 1e-9)), int(np.floor(band[1] / spacing + 1e-9))
    lines = np.arange(max(first, 1), last + 1)
    if odd_only:
        lines = lines[lines % 2 == 1]
    if leave_out:
        # The first and the last line stay, so that the band is kept.
        starts = np.arange(1, lines.size - leave_out, leave_out)
        lines = np.delete(lines, starts + np.random.default_rng(seed).integers(0, leave_out, starts.size))
    if not lines.size:
        what = f"no line every {spacing:g} Hz lies in {band[0]:g}-{band[1]:g} Hz"
        raise ConfigError(what, hint="widen the band or narrow the spacing")
    return Multisine(lines, PHASES[phases](lines, seed), spacing, rms)


def crest_factor(signal: FloatArray) -> float:
    """Crest factor max |x| / rms [1] of a signal (n_sample,). Equation (spec-crest)."""
    return float(np.max(np.abs(signal)) / np.sqrt(np.mean(signal**2)))


def schroeder_phases(
    lines: IntArray,
    seed: int = 0,  # noqa: ARG001 (one signature for the table)
) -> FloatArray:
    """phi_n = -pi n (n - 1) / N [rad], (n_line,), for the n-th of N lines of a flat spectrum (Schroeder
    1970). Equation (spec-schroeder).
    """
    n = np.arange(1, lines.size + 1)
    return -np.pi * n * (n - 1) / lines.size


def random_phases(lines: IntArray, seed: int = 0) -> FloatArray:
    """Uniformly distributed phases, (n_line,) [rad]."""
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, lines.size)


def optimised_phases(lines: IntArray, seed: int = 0) -> FloatArray:  # noqa: ARG001
    """Phases of low crest factor, (n_line,) [rad], by alternate clipping (Van der Ouderaa, Schoukens and
    Renneboog 1988). From Schroeder's phases each step clips the peaks, keeps the phases of the clipped
    signal and restores the amplitudes; the clipping level rises from step to step.
    """
    n_sample = OVERSAMPLING * int(lines[-1]) * 2
    phases = schroeder_phases(lines)
    best, least = phases, np.inf
    for step in range(OPTIMISING_STEPS):
        period = _period(lines, phases, n_sample)
        crest = crest_factor(period)
        if crest < least:
            best, least = phases, crest
        level = np.max(np.abs(period)) * (0.80 + 0.19 * step / OPTIMISING_STEPS)
        phases = np.angle(fft.rfft(np.clip(period, -level, level))[lines])
    return best


PHASES: dict[str, Callable[[IntArray, int], FloatArray]] = {
    "schroeder": schroeder_phases,
    "random": random_phases,
    "optimised": optimised_phases,
}


def _period(lines: IntArray, phases: FloatArray, n_sample: int) -> FloatArray:
    """One period of sum cos(2 pi k t + phi_k) on n_sample points."""
    return _signals(lines, np.exp(1j * phases)[:, None], n_sample)[0]


LAWS = ("linear", "logarithmic")
DIRECTIONS = ("up", "down", "up-down")
# Share of a sweep over which its amplitude rises at the start and falls at the end.
FADE = 0.01


@dataclass(frozen=True)
class Sweep:
    """A designed sweep: *band* low and high [Hz], *duration* and *pause* after it [s], rms amplitude while it
    runs, *law*, *direction*.
    """

    band: tuple[float, float]
    duration: float
    rms: float
    law: str = "linear"
    direction: str = "up"
    pause: float = 0.0

    def __post_init__(self) -> None:
        low, high = self.band
        if not 0 < low < high:
            raise ConfigError(f"a sweep needs a band above 0 Hz, not {low:g}-{high:g} Hz")
        if self.duration <= 0 or self.rms <= 0 or self.pause < 0:
            raise ConfigError("length and level of a sweep must be positive, its pause not negative")
        for name, value, names in (("law", self.law, LAWS), ("direction", self.direction, DIRECTIONS)):
            if value not in names:
                raise ConfigError(f"unknown {name} '{value}'", hint=f"known: {', '.join(names)}")

    def samples(self, sample_rate: float, count: int) -> FloatArray:
        """*count* sweeps with their pauses sampled at *sample_rate* [Hz], (n_sample,) [unit of rms]; up-down
        goes up first, then down. ConfigError when the sampling rate is too low for the band.
        """
        if 2 * self.band[1] >= sample_rate:
            raise ConfigError(
                f"a sweep up to {self.band[1]:g} Hz needs more than {2 * self.band[1]:g} Hz of sampling rate"
            )
        n_sample = round(self.duration * sample_rate)
        time = np.arange(n_sample) / sample_rate
        # Half a cosine at either end.
        place = time / self.duration
        edge = np.minimum(np.minimum(place, 1 - place) / FADE, 1.0)
        size = np.sqrt(2) * self.rms * np.sin(np.pi / 2 * edge) ** 2
        quiet = np.zeros(round(self.pause * sample_rate))
        falls = {"up": (False,), "down": (True,), "up-down": (False, True)}[self.direction]
        sweeps = [np.append(size * np.sin(self.phase(time, fall)), quiet) for fall in falls]
        return np.concatenate([sweeps[number % len(sweeps)] for number in range(count)])

    def phase(self, time: FloatArray, falling: bool = False) -> FloatArray:
        """2 pi times the integral of the frequency [rad] at *time* (n,) [s] after the start of one sweep.
        Linear f = f_1 + (f_2 - f_1) t / T; logarithmic f = f_1 (f_2 / f_1)^(t / T) (Farina 2000, eq. 5).
        Equation (spec-sweep).
        """
        first, last = self.band[::-1] if falling else self.band
        if self.law == "linear":
            return 2 * np.pi * (first * time + (last - first) * time**2 / (2 * self.duration))
        growth = np.log(last / first) / self.duration
        return 2 * np.pi * first * np.expm1(growth * time) / growth


# The peak of a sum of sines is taken between this many samples per period of the highest line.
STATED = 192


def peaks(lines: IntArray, amplitudes: ComplexArray) -> FloatArray:
    """Largest |s_c(t)|, (n_signal,) [unit of amplitudes], of amplitudes (n_line, n_signal) [any unit] at
    lines (n_line,) [multiples]. Of all times, whatever the sampling rate: never below the true one, and above
    it by 0.013 % at most. Equation (plan-highest).
    """
    signals = one_period(lines, amplitudes, STATED)
    # Around its peak S a sum of sines up to line k is at least S cos(2 pi k (t - t_S)), and a sample is no
    # farther than half a step.
    between = np.cos(np.pi * int(lines.max()) / signals.shape[1])
    return np.abs(signals).max(axis=1) / between


def one_period(lines: IntArray, amplitudes: ComplexArray, oversampling: int) -> FloatArray:
    """Signals over a period, (n_signal, n_sample) [unit of amplitudes], with *oversampling* samples or more
    per period of the highest line. Arguments as of `peaks`.
    """
    return _signals(lines, amplitudes, int(fft.next_fast_len(oversampling * int(lines.max()), real=True)))


def _signals(lines: IntArray, amplitudes: ComplexArray, n_sample: int) -> FloatArray:
    spectrum = np.zeros((amplitudes.shape[1], n_sample // 2 + 1), np.complex128)
    spectrum[:, lines] = amplitudes.T * (n_sample / 2)
    return fft.irfft(spectrum, n_sample, axis=1)
