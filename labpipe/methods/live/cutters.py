"""How the samples of a running test are cut into averages: whole periods, and hits as they come."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.recording import Channel
from labpipe.spectra import impact, windows
from labpipe.spectra.bands import line_range
from labpipe.spectra.channels import Lags
from labpipe.spectra.period_average import samples_per_period
from labpipe.spectra.settings import FrfSettings

# Share of the cross spectrum of two forces that one delay explains where they are the same signal.
SAME_SIGNAL = 0.7
# Likeness of the proportions of two forces from which on they shake the same direction, and share of the
# largest one's amplitude with which a force acts.
SAME_FORCES, ACTS = 0.8, 0.1
# Least growth of the energy of a force that begins to shake its direction.
GROWN = 4.0
# A first hit stands out of the noise before it by so many times its rms.
FIRST_HIT = 20.0
# Hits below this share of the usual one tell little.
WEAK = 0.1


@dataclass(frozen=True)
class Average:
    """One period or hit: *amplitude* (n_line, n_channel) [units of channels] on the lines, its first sample
    *start*, *number* from 1, the *fault* for which it is left out, and its *peaks* (n_channel,) [SI]. *noise*
    (n_line,) [squared unit of the force] of the force in a hit; *direction*: number of that of its forces.
    """

    number: int
    start: int
    amplitude: ComplexArray
    peaks: FloatArray
    fault: str = ""
    noise: FloatArray | None = None
    direction: int = 0


class _Cutter:
    """Cuts calibrated blocks into averages; *frequency* (n_line,) [Hz] of their lines."""

    def __init__(
        self, channels: tuple[Channel, ...], sample_rate: float, n_sample: int, settings: FrfSettings
    ) -> None:
        self.channels, self.sample_rate, self.n_sample = channels, sample_rate, n_sample
        self._forces = [number for number, channel in enumerate(channels) if channel.role == "input"]
        self._lines = line_range(n_sample, sample_rate, settings.band)
        self.frequency = np.arange(self._lines.start, self._lines.stop) * (sample_rate / n_sample)
        self._number = 0
        # The force window of the first hit, and its trigger.
        self._window: tuple[FloatArray, int] | None = None

    def _average(
        self, start: int, samples: FloatArray, peaks: FloatArray, spectrum_of: FloatArray, fault: str
    ) -> Average:
        """The average of *samples* (n_sample, n_channel) [SI], by those of *spectrum_of*, ready for it."""
        there = np.isfinite(samples).all(axis=0)
        if not there.all():
            fault = f"no number in channel '{self.channels[int(np.argmin(there))].name}'"
        whole = fft.rfft(spectrum_of.T, axis=1)[:, self._lines].T * (2 / self.n_sample)
        return Average(self._number, start, np.asarray(whole), peaks, fault)

    def window_shapes(self, lines: IntArray) -> ComplexArray | None:
        """Amplitudes (n_line, n) [1] of white noise of the force under its window at *lines* of an average,
        relative to the root of its power; n of 0 where it has too many, None without a window.
        """
        if self._window is None:
            return None
        shapes = windows.window_shapes(*self._window, self._lines.start + lines)
        return np.empty((lines.size, 0), np.complex128) if shapes is None else shapes


class PeriodCutter(_Cutter):
    """Whole periods, the transient ones dropped at the start of each recording, and where another direction
    is shaken after several periods of one.
    """

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.period is not None
        super().__init__(channels, sample_rate, samples_per_period(settings.period, sample_rate), settings)
        self._skip = self._left = settings.skip
        self._rest, self._begin = np.empty((0, len(channels))), 0
        # Energies of the forces in the last period, and for how many the strongest has been the same.
        self._energies: FloatArray = np.zeros(len(self._forces))
        self._alike = 0
        # The first forces of each direction, and what turns those of the present recording to their phases.
        self._first: dict[int, ComplexArray] = {}
        self._turns: dict[int, ComplexArray] = {}

    def restart(self) -> None:
        """The samples that follow belong to another recording: what is not complete is lost."""
        self._begin, self._rest = self._begin + self._rest.shape[0], self._rest[:0]
        self._left, self._turns = self._skip, {}

    def add(self, block: FloatArray) -> Iterator[Average]:
        """The averages that the next samples (n, n_channel) [SI] complete."""
        self._rest = np.concatenate([self._rest, block])
        while self._rest.shape[0] >= self.n_sample:
            period, start = self._rest[: self.n_sample], self._begin
            self._rest, self._begin = self._rest[self.n_sample :], self._begin + self.n_sample
            moved = np.nan_to_num(period - np.nan_to_num(period.mean(axis=0)))
            if self._strongest_changes(np.sum(moved[:, self._forces] ** 2, axis=0)):
                self._left = self._skip
            if self._left:
                self._left -= 1
                continue
            self._number += 1
            yield self._turn(self._average(start, period, np.max(np.abs(moved), axis=0), moved, ""))

    def _strongest_changes(self, energies: FloatArray) -> bool:
        """Whether another force than in several periods before is the strongest now, and grew to be it; by
        their *energies* (n_force,) [squared SI].
        """
        strongest = int(np.argmax(energies))
        same = strongest == int(np.argmax(self._energies))
        turned = self._alike > 1 and not same and energies[strongest] > GROWN * self._energies[strongest]
        self._energies, self._alike = energies, self._alike + 1 if same else 1
        return bool(turned)

    def _direction(self, forces: ComplexArray) -> int:
        """The number of the direction whose *forces* (n_line, n_force) were in the same proportion to each
        other, line by line, at first; of hardly any force the nearest, of another proportion a new one.
        """
        likeness = {
            number: np.sum(np.abs(np.sum(first * forces.conj(), axis=1)))
            / max(np.linalg.norm(first, axis=1) @ np.linalg.norm(forces, axis=1), np.finfo(float).tiny)
            for number, first in self._first.items()
        }
        nearest = max(likeness, key=likeness.__getitem__, default=0)
        weak = any(np.linalg.norm(forces) < ACTS * np.linalg.norm(first) for first in self._first.values())
        return nearest if weak or likeness.get(nearest, 0.0) > SAME_FORCES else len(likeness)

    def _turn(self, average: Average) -> Average:
        """A period by its direction, turned to the phases that the forces of this had first: a recording that
        was begun anew begins elsewhere in the period. exp(-j w tau) by the delay tau of the cross-correlation
        of the forces; line by line where these are other phases.
        """
        forces = average.amplitude[:, self._forces]
        direction = self._direction(forces)
        if self._first.setdefault(direction, forces) is forces or not forces.any():
            self._turns[direction] = np.ones(len(forces), np.complex128)
        if direction not in self._turns:
            cross = np.sum(self._first[direction] * forces.conj(), axis=1)
            delay = np.argmax(fft.irfft(np.pad(cross, (self._lines.start, 0)), self.n_sample))
            w, size = 2 * np.pi * self.frequency / self.sample_rate, np.abs(cross)
            rest = np.angle(cross * np.exp(1j * w * delay))
            turn = np.exp(-1j * w * (delay - np.sum(size * w * rest) / np.sum(size * w**2)))
            alike = np.sum((cross * turn.conj()).real) > SAME_SIGNAL * np.sum(size)
            self._turns[direction] = turn if alike else np.exp(1j * np.angle(cross))
        turned = average.amplitude * self._turns[direction][:, None]
        return replace(average, amplitude=turned, direction=direction)


class HitCutter(_Cutter):
    """Hits of one hammer, sought as they come: by the noise before the first, then by the hits so far."""

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.block is not None
        # As in a run: of a late channel the block holds the hit, too.
        self._lags = Lags(channels, sample_rate)
        super().__init__(self._lags.channels, sample_rate, round(settings.block * sample_rate), settings)
        if len(self._forces) != 1:
            what = f"hits need one force, the rig has {len(self._forces)}"
            raise DataError(what, hint="one hammer per recording")
        self._force, self._impact = self._forces[0], settings.impact
        self._before = round(self._impact.pretrigger * self.n_sample)
        self._search = impact.HitSearch(self._force, self.n_sample, self._before, len(channels))
        self._sizes: list[float] = []
        self._noise, self._rest = 0.0, np.zeros(len(channels))

    def restart(self) -> None:
        self._search.restart()
        self._lags.restart()

    def _level(self) -> float:
        usual = self._impact.trigger * max(self._sizes) if self._sizes else 0.0
        return max(usual, FIRST_HIT * self._noise)

    def add(self, block: FloatArray) -> Iterator[Average]:
        """The averages that the next samples (n, n_channel) [SI] complete."""
        self._search.add(self._lags.add(block))
        if not self._noise and not self._is_quiet_known():
            return
        for start, trigger, samples in self._search.hits(self._rest[self._force], self._level):
            yield self._hit(start, samples, trigger)

    def _is_quiet_known(self) -> bool:
        """Whether the rest position of the force and the noise about it are known, by the first samples."""
        window, n = self._search.window, max(self._before, 16)
        if window.shape[0] < n:
            return False
        self._rest = np.nan_to_num(np.median(window[:n], axis=0))
        distance = np.abs(window[:, self._force] - self._rest[self._force])
        # Of a recording that begins within a hit the median is still the rest position.
        self._noise = float(1.4826 * np.median(distance[:n])) or 1e-6 * float(np.max(distance))
        return self._noise > 0.0

    def _hit(self, start: int, samples: FloatArray, trigger: int) -> Average:
        self._number += 1
        raw = np.nan_to_num(samples)
        hit = impact.judged_hit(self._number, start, raw, trigger, self.channels, self._impact, self._rest)
        fault = hit.fault
        size = float(np.max(np.abs(hit.samples[:, self._force])))
        usual = float(np.median(self._sizes)) if self._sizes else 0.0
        if not fault and size < WEAK * usual:
            fault = f"weak: {100 * size / usual:.0f} % of the usual force"
        if not fault and np.isfinite(samples).all():
            self._sizes.append(size)
        windowed, window = hit.samples.copy(), np.ones((self.n_sample, 1))
        if self._impact.force_window is not None:
            length = self._impact.force_window * self.sample_rate
            window[:, 0] = windows.force_window(self.n_sample, trigger, length)
            windowed[:, [self._force]] *= window
            self._window = self._window or (window[:, 0], trigger)
        noise = (
            impact.noise_power(hit, self._force, self._lines) * np.sum(window**2) * (2 / self.n_sample) ** 2
        )
        average = self._average(start, samples, np.max(np.abs(hit.samples), axis=0), windowed, fault)
        # Counted from its trigger, which is no matter for an FRF.
        numbers = np.arange(self._lines.start, self._lines.stop)
        turned = windows.phase_factors(numbers, np.array([-trigger]), self.n_sample)
        return replace(average, amplitude=average.amplitude * turned, noise=noise)


Cutter = PeriodCutter | HitCutter
CUTTERS: dict[str, type[Cutter]] = {"periodic": PeriodCutter, "impact": HitCutter}
