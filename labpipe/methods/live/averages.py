"""A stream of samples cut into averages: periods of a multisine, or hits of a hammer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import Channel
from labpipe.spectra.bands import line_range
from labpipe.spectra.impact import force_window, judged_hit
from labpipe.spectra.period_average import samples_per_period
from labpipe.spectra.settings import FrfSettings

# A first hit stands out of the noise before it by so many times its rms.
FIRST_HIT = 20.0
# Hits below this share of the usual one tell little.
WEAK = 0.1


@dataclass(frozen=True)
class Average:
    """One period or hit: *amplitude* (n_line, n_channel) [unit of each channel] on the cutter's lines.

    *start*: its first sample in the stream; *number* from 1; *fault*: why it is left out, '' where it is
    good; *peaks* (n_channel,) [SI]: largest sizes, by which levels are shown.
    """

    number: int
    start: int
    amplitude: ComplexArray
    peaks: FloatArray
    fault: str = ""


class Cutter:
    """Cuts calibrated blocks into averages; *frequency* (n_line,) [Hz] of their lines."""

    frequency: FloatArray
    n_sample: int

    def __init__(
        self, channels: tuple[Channel, ...], sample_rate: float, n_sample: int, lines: slice
    ) -> None:
        self.channels, self.sample_rate, self.n_sample, self._lines = channels, sample_rate, n_sample, lines
        self.frequency = np.arange(lines.start, lines.stop) * (sample_rate / n_sample)
        self._rest = np.empty((0, len(channels)))
        # Sample of the stream at which the rest begins.
        self._begin = 0
        self._number = 0

    def add(self, block: FloatArray) -> Iterator[Average]:
        """The averages that the next samples (n, n_channel) [SI] complete."""
        self._rest = np.concatenate([self._rest, block])
        yield from self._complete()

    def restart(self) -> None:
        """The samples that follow belong to another recording: what is not complete is lost."""
        self._begin += self._rest.shape[0]
        self._rest = self._rest[:0]

    def _complete(self) -> Iterator[Average]:
        raise NotImplementedError

    def _missing(self, samples: FloatArray) -> str:
        """The fault of samples that are no numbers, '' where all are."""
        there = np.isfinite(samples).all(axis=0)
        return "" if there.all() else f"no number in channel '{self.channels[int(np.argmin(there))].name}'"

    def _transformed(self, samples: FloatArray) -> ComplexArray:
        whole = fft.rfft(samples.T, axis=1)
        return np.asarray(whole[:, self._lines].T * (2 / self.n_sample))


class PeriodCutter(Cutter):
    """Whole periods, the transient ones dropped at the start of each recording."""

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.period is not None
        n_sample = samples_per_period(settings.period, sample_rate)
        super().__init__(channels, sample_rate, n_sample, line_range(n_sample, sample_rate, settings.band))
        self._skip = self._left = settings.skip

    def restart(self) -> None:
        super().restart()
        self._left = self._skip

    def _complete(self) -> Iterator[Average]:
        while self._rest.shape[0] >= self.n_sample:
            period, start = self._rest[: self.n_sample], self._begin
            self._rest, self._begin = self._rest[self.n_sample :], self._begin + self.n_sample
            if self._left:
                self._left -= 1
                continue
            self._number += 1
            fault = self._missing(period)
            moved = period - np.nan_to_num(period.mean(axis=0))
            peaks = np.max(np.abs(moved), axis=0)
            yield Average(self._number, start, self._transformed(np.nan_to_num(moved)), peaks, fault)


class HitCutter(Cutter):
    """Hits of one hammer, found as they come: by the noise before the first, then by the hits so far."""

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.block is not None
        n_sample = round(settings.block * sample_rate)
        super().__init__(channels, sample_rate, n_sample, line_range(n_sample, sample_rate, settings.band))
        forces = [number for number, channel in enumerate(channels) if channel.role == "input"]
        if len(forces) != 1:
            raise DataError(
                f"hits need one force, the rig has {len(forces)}", hint="one hammer per recording"
            )
        self._force, self._impact = forces[0], settings.impact
        self._before = round(self._impact.pretrigger * n_sample)
        self._search = 0
        self._sizes: list[float] = []
        self._noise = self._zero = np.nan

    def restart(self) -> None:
        super().restart()
        self._search = self._begin

    def _level(self) -> float:
        """The size of the force at which a hit begins, [N]."""
        usual = self._impact.trigger * max(self._sizes) if self._sizes else 0.0
        return max(usual, FIRST_HIT * self._noise)

    def _complete(self) -> Iterator[Average]:
        if np.isnan(self._noise):
            if self._rest.shape[0] < max(self._before, 16):
                return
            quiet = self._rest[: max(self._before, 16), self._force]
            self._zero = float(np.median(quiet))
            # Of a recording that begins within a hit the median is still the rest position.
            self._noise = float(1.4826 * np.median(np.abs(quiet - self._zero)))
            largest = float(np.max(np.abs(self._rest[:, self._force] - self._zero)))
            if self._noise == 0.0 and largest == 0.0:
                self._noise = np.nan
                return
            self._noise = self._noise or 1e-6 * largest
        while True:
            at = self._search - self._begin
            size = np.abs(self._rest[at:, self._force] - self._zero)
            above = np.flatnonzero(size >= self._level())
            if not above.size:
                self._search = self._begin + self._rest.shape[0]
                break
            trigger = self._search + int(above[0])
            start = max(trigger - self._before, self._begin)
            if start + self.n_sample > self._begin + self._rest.shape[0]:
                self._search = trigger
                break
            first = start - self._begin
            yield self._hit(start, self._rest[first : first + self.n_sample], trigger - start)
            self._search = start + self.n_sample
        keep = max(min(self._search - self._before - self._begin, self._rest.shape[0]), 0)
        self._rest, self._begin = self._rest[keep:], self._begin + keep

    def _hit(self, start: int, samples: FloatArray, trigger: int) -> Average:
        self._number += 1
        hit = judged_hit(self._number, start, np.nan_to_num(samples), trigger, self._force, self._impact)
        what, _, column = hit.fault.rpartition(" ")
        fault = f"{what} '{self.channels[int(column) - 1].name}'" if column.isdigit() else hit.fault
        fault = self._missing(samples) or fault
        size = float(np.max(np.abs(hit.samples[:, self._force])))
        if not fault and self._sizes and size < WEAK * float(np.median(self._sizes)):
            fault = f"weak: {100 * size / float(np.median(self._sizes)):.0f} % of the usual force"
        if not fault:
            self._sizes.append(size)
        windowed = hit.samples.copy()
        if self._impact.force_window is not None:
            length = self._impact.force_window * self.sample_rate
            windowed[:, self._force] *= force_window(self.n_sample, trigger, length)
        peaks = np.max(np.abs(hit.samples), axis=0)
        return Average(self._number, start, self._transformed(windowed), peaks, fault)


CUTTERS = {"periodic": PeriodCutter, "impact": HitCutter}
