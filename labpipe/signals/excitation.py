"""Periodic test signals: sums of harmonics with equal amplitudes and chosen phases. PHASES by name.

A multisine is x(t) = sum_k A cos(2 pi f_k t + phi_k) with lines f_k in a band; it is periodic in 1 / spacing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import ConfigError
from labpipe.signals.least_peak import peaks

# The search for phases looks at peaks between samples: the grid is this many times finer than the highest line needs.
OVERSAMPLING = 16
OPTIMISING_STEPS = 400


@dataclass(frozen=True)
class Multisine:
    """A designed test signal: *lines* [multiples of spacing], *phases* [rad] (n_line,), spacing [Hz], rms amplitude."""

    lines: IntArray
    phases: FloatArray
    spacing: float
    rms: float

    @property
    def crest_factor(self) -> float:
        """Peak over rms of one period, peaks between samples included."""
        return float(peaks(self.lines, np.exp(1j * self.phases)[:, None])[0] / np.sqrt(self.lines.size / 2))

    def samples(self, sample_rate: float, periods: int) -> FloatArray:
        """*periods* periods sampled at *sample_rate* [Hz], (n_sample,) [unit of rms].

        ConfigError when a period holds no whole number of samples, or the sampling rate is too low for the highest line.
        Equation (spec-multisine).
        """
        exact = sample_rate / self.spacing
        n_sample = round(exact)
        if abs(exact - n_sample) > 1e-9 * exact:
            near = n_sample * self.spacing
            hint = f"the nearest sampling rate is {near:g} Hz"
            raise ConfigError(f"a period of {1 / self.spacing:g} s holds {exact:g} samples, not a whole number", hint=hint)
        if 2 * int(self.lines[-1]) >= n_sample:
            highest = self.lines[-1] * self.spacing
            raise ConfigError(f"lines up to {highest:g} Hz need more than {2 * highest:g} Hz of sampling rate")
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
    """A multisine with lines every *spacing* [Hz] in *band* [Hz]; ConfigError for an empty band or unknown phases.

    *odd_only* keeps the odd multiples of the spacing: even lines then show even distortion. *leave_out* removes one line, drawn
    with *seed*, from every group of that many: these show odd distortion (Pintelon and Schoukens, System Identification, sec. 4.3.2).
    """
    if leave_out == 1 or leave_out < 0:
        raise ConfigError(f"leaving one of {leave_out} lines out leaves none", hint="one of 3 or 4 is usual; 0 keeps all")
    if spacing <= 0 or rms <= 0:
        raise ConfigError("spacing and level must be positive")
    first, last = int(np.ceil(band[0] / spacing - 1e-9)), int(np.floor(band[1] / spacing + 1e-9))
    lines = np.arange(max(first, 1), last + 1)
    if odd_only:
        lines = lines[lines % 2 == 1]
    if leave_out:
        lines = np.delete(lines, _left_out(lines.size, leave_out, seed))
    if not lines.size:
        raise ConfigError(f"no line every {spacing:g} Hz lies in {band[0]:g}-{band[1]:g} Hz", hint="widen the band or narrow the spacing")
    if phases not in PHASES:
        raise ConfigError(f"unknown phases '{phases}'", hint=f"known: {', '.join(PHASES)}")
    return Multisine(lines, PHASES[phases](lines, seed), spacing, rms)


def _left_out(n_line: int, group: int, seed: int) -> IntArray:
    """Indices of one line in every complete group of *group* lines; the first and the last line stay, so that the band is kept."""
    starts = np.arange(1, n_line - group, group)
    return np.asarray(starts + np.random.default_rng(seed).integers(0, group, starts.size))


def crest_factor(signal: FloatArray) -> float:
    """Crest factor max |x| / rms [1] of a signal (n_sample,). Equation (spec-crest)."""
    return float(np.max(np.abs(signal)) / np.sqrt(np.mean(signal**2)))


def schroeder_phases(lines: IntArray, seed: int = 0) -> FloatArray:  # noqa: ARG001 (one signature for the table)
    """phi_n = -pi n (n - 1) / N [rad], (n_line,), for the n-th of N lines of a flat spectrum (Schroeder 1970).

    Equation (spec-schroeder).
    """
    n = np.arange(1, lines.size + 1)
    return -np.pi * n * (n - 1) / lines.size


def random_phases(lines: IntArray, seed: int = 0) -> FloatArray:
    """Uniformly distributed phases, (n_line,) [rad]."""
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, lines.size)


def optimised_phases(lines: IntArray, seed: int = 0) -> FloatArray:  # noqa: ARG001
    """Phases of low crest factor, (n_line,) [rad], by alternate clipping (Van der Ouderaa, Schoukens and Renneboog 1988).

    From Schroeder's phases each step clips the peaks, keeps the phases of the clipped signal and restores the amplitudes; the clipping
    level rises from step to step. The best step is returned, so the result is never worse than the start.
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
    spectrum = np.zeros(n_sample // 2 + 1, np.complex128)
    spectrum[lines] = np.exp(1j * phases) * (n_sample / 2)
    return fft.irfft(spectrum, n_sample)
