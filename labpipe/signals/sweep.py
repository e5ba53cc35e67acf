"""Swept sines as test signals: linear or logarithmic, up, down, or one after the other, with pauses in which the rig comes to rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError

LAWS = ("linear", "logarithmic")
DIRECTIONS = ("up", "down", "up-down")
# Share of a sweep over which its amplitude rises at the start and falls at the end.
FADE = 0.01


@dataclass(frozen=True)
class Sweep:
    """A designed sweep: *band* low and high [Hz], *duration* and *pause* after it [s], rms amplitude while it runs, *law*, *direction*."""

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
        """*count* sweeps with their pauses sampled at *sample_rate* [Hz], (n_sample,) [unit of rms]; up-down goes up first, then down.

        ConfigError when the sampling rate is too low for the band.
        """
        if 2 * self.band[1] >= sample_rate:
            raise ConfigError(f"a sweep up to {self.band[1]:g} Hz needs more than {2 * self.band[1]:g} Hz of sampling rate")
        n_sample = round(self.duration * sample_rate)
        time = np.arange(n_sample) / sample_rate
        size = np.sqrt(2) * self.rms * _fade(time / self.duration)
        quiet = np.zeros(round(self.pause * sample_rate))
        falls = [self.direction == "down" or (self.direction == "up-down" and number % 2 == 1) for number in range(count)]
        return np.concatenate([part for fall in falls for part in (size * np.sin(self.phase(time, fall)), quiet)])

    def phase(self, time: FloatArray, falling: bool = False) -> FloatArray:
        """2 pi times the integral of the frequency [rad] at *time* (n,) [s] after the start of one sweep.

        Linear f = f_1 + (f_2 - f_1) t / T; logarithmic f = f_1 (f_2 / f_1)^(t / T) (Farina 2000, eq. 5). Equation (spec-sweep).
        """
        first, last = self.band[::-1] if falling else self.band
        if self.law == "linear":
            return np.asarray(2 * np.pi * (first * time + (last - first) * time**2 / (2 * self.duration)))
        growth = np.log(last / first) / self.duration
        return np.asarray(2 * np.pi * first * np.expm1(growth * time) / growth)


def _fade(place: FloatArray) -> FloatArray:
    """Amplitude [1] at a *place* (n,) [1] of the sweep: half a cosine at either end."""
    edge = np.minimum(np.minimum(place, 1 - place) / FADE, 1.0)
    return np.asarray(np.sin(np.pi / 2 * edge) ** 2)
