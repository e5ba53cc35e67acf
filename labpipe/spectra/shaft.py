"""Rotation of a shaft during a recording: from a given speed or from tacho pulses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.spectra.channels import READ_SAMPLES
from labpipe.spectra.settings import ShaftLines

# Hysteresis of the pulse detection, as shares of the tacho's range: below the lower level, then above the
# upper one.
LOW_SHARE, HIGH_SHARE = 0.4, 0.6

# Revolutions over which the speed is averaged.
STRETCH = 10

# Of pulses that noise makes, neighbouring intervals differ by more than this share of their sum in the median
# (white noise .28, noise within an octave .1), the more pulses are counted as one revolution the less, as the
# square root. From rest under a constant torque eight revolutions differ by .06.
IRREGULAR = 0.1
FEWEST_JUDGED = 8

# Turns to either side, two at least, that an interval is held against: beyond so many times both it is of
# pulses that are missing, at most so many or a turn's; two that are together no longer than that, one of them
# shorter than these, are of one too many. Share of the pulses up to which such faults are told.
NEIGHBOURS, LONGER, SHORTER, MOST_FAULTS = 5, 1.5, 0.75, 0.1
# Turns that tell the places of marks, and standard errors of these beyond which they are uneven.
FEWEST_TURNS, UNEVEN = 10, 6.0


@dataclass(frozen=True)
class ShaftMotion:
    """Revolutions (n,) [1] counted at times (n,) [s], both ascending. Constant speed between them and beyond
    the ends. findings: on pulses that are missing or too many; std_error (n,) [1] of the revolutions, None
    where it is not known.
    """

    times: FloatArray
    revolutions: FloatArray
    findings: tuple[Finding, ...] = ()
    std_error: FloatArray | None = None

    def angle(self, time: FloatArray) -> FloatArray:
        """Shaft angle at *time* [s], same shape [rad], zero at the first pulse (or at the start for a given
        speed). Equation (spec-angle).
        """
        inner = np.interp(time, self.times, self.revolutions)
        first, last = self.speeds[[0, -1]]
        before = np.minimum(time - self.times[0], 0.0) * first
        after = np.maximum(time - self.times[-1], 0.0) * last
        angle: FloatArray = 2 * np.pi * (inner + before + after)
        return angle

    @property
    def speeds(self) -> FloatArray:
        """Speeds between consecutive counts, (n - 1,) [Hz]."""
        speeds: FloatArray = np.diff(self.revolutions) / np.diff(self.times)
        return speeds

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed [Hz] over STRETCH revolutions: single pulse times are only accurate to a
        sample.
        """
        ends = np.linspace(
            self.revolutions[0], self.revolutions[-1], max(2, int(np.ptp(self.revolutions) / STRETCH) + 1)
        )
        speeds = np.diff(ends) / np.diff(np.interp(ends, self.revolutions, self.times))
        return float(speeds.min()), float(speeds.max())


def steady(speed: float, duration: float) -> ShaftMotion:
    """A shaft at constant *speed* [Hz] for *duration* [s]."""
    return ShaftMotion(np.array([0.0, duration]), np.array([0.0, speed * duration]))


def shaft_motion(source: SampleSource, lines: ShaftLines) -> ShaftMotion:
    """The shaft's motion in a recording: pulses that are missing or too many are told by their neighbours,
    uneven marks by all turns. DataError when the tacho channel is missing, has fewer than two pulses, pulses
    as irregular as noise makes them, or more faults than can be told.
    """
    if lines.tacho is None:
        assert lines.speed is not None
        return steady(lines.speed, source.n_sample / source.sample_rate)
    pulses = tacho_pulses(source, lines.tacho)
    tacho, hint = f"the tacho '{lines.tacho}' of '{source.name}'", "check the channel and its range"
    if pulses.size < 2:
        raise DataError(f"{tacho} shows {pulses.size} pulse(s), 2 are needed", hint=hint)
    by_turn = pulses[:: lines.pulses]
    if (
        by_turn.size > FEWEST_JUDGED
        and min(_irregularity(pulses), _irregularity(by_turn) * np.sqrt(lines.pulses)) > IRREGULAR
    ):
        raise DataError(
            f"{tacho} shows no regular pulses but noise, as of a shaft that stands still", hint=hint
        )
    times, counts = _count(pulses, lines.pulses)
    extra, missing = pulses.size - times.size, int(counts[-1]) + 1 - times.size
    if not (extra or missing):
        return ShaftMotion(times, _revolutions(times, counts, lines.pulses))
    faults = f"{missing} of {int(counts[-1]) + 1} pulses are missing, {extra} are too many"
    if extra + missing > MOST_FAULTS * counts[-1]:
        raise DataError(
            f"{tacho}: {faults}, more than neighbours can tell", hint="sample faster, or see to its level"
        )
    what = f"{tacho}: {faults}; by the intervals beside them they are counted right"
    return ShaftMotion(times, _revolutions(times, counts, lines.pulses), (Finding("tacho-pulses", what),))


def _count(times: FloatArray, per_turn: int) -> tuple[FloatArray, IntArray]:
    """Of pulses at *times* (n_pulse,) [s] those that are not too many (n,), and their numbers (n,) among them
    and those that are missing, by the intervals of the turns beside them.
    """
    most = max(NEIGHBOURS, per_turn)
    while times.size > FEWEST_JUDGED:
        intervals = np.diff(times)
        before, after = _medians_beside(intervals, per_turn)
        # Of every pulse but the ends: the intervals on both sides of it, against those beside these.
        sides = np.array([before[:-1], after[1:]])
        pair = intervals[:-1] + intervals[1:]
        short = np.minimum(intervals[:-1], intervals[1:]) < SHORTER * sides.min(axis=0)
        pair[~(short & (pair < LONGER * sides.max(axis=0)))] = np.inf
        # Of neighbours that between the nearest two: the first pulse of some that bounce stays.
        near = np.lib.stride_tricks.sliding_window_view(np.pad(pair, 1, constant_values=np.inf), 3)
        extra = 1 + np.flatnonzero(np.isfinite(pair) & (near.argmin(axis=1) == 1))
        if not extra.size:
            whole = np.round(2 * intervals / (before + after))
            several = (intervals > LONGER * np.maximum(before, after)) & (whole <= 1 + most)
            steps = np.where(several, whole, 1).astype(np.intp)
            return times, np.append(0, np.cumsum(steps))
        times = np.delete(times, extra)
    return times, np.arange(times.size)


def _medians_beside(intervals: FloatArray, per_turn: int) -> FloatArray:
    """Medians of those of the same mark in NEIGHBOURS turns before and after each of the *intervals* (n,)
    [s], (2, n); NaN of fewer than two.
    """
    steps = per_turn * np.arange(1, NEIGHBOURS + 1)
    places = np.arange(intervals.size) + steps[-1] + np.array([-steps, steps])[..., None]
    turns = np.pad(intervals, steps[-1], constant_values=np.nan)[places]
    few = np.sum(np.isfinite(turns), axis=1) < 2
    medians = np.nanmedian(np.where(few[:, None], 0.0, turns), axis=1)
    return np.where(few, np.nan, medians)


def _revolutions(times: FloatArray, counts: IntArray, per_turn: int) -> FloatArray:
    """Revolutions (n,) [1] at *times* (n,) [s] by the *counts* (n,) of marks, *per_turn* in one: evenly, but
    where these are not even at the median place that all turns show between the pulses of the first.
    """
    turns, mark = counts / per_turn, counts % per_turn
    first = mark == 0
    if per_turn == 1 or np.sum(first) < FEWEST_TURNS:
        return turns
    # A run that finds all fresh loads none of it.
    import scipy

    course = scipy.interpolate.CubicSpline(times[first], turns[first])
    within = times < times[first][-1]
    places, errors = np.zeros((2, per_turn))
    for number in range(1, per_turn):
        off = (course(times) - turns)[within & (mark == number)]
        places[number] = np.median(off)
        errors[number] = np.median(np.abs(off - places[number])) / np.sqrt(off.size)
    uneven = np.any(np.abs(places) > UNEVEN * errors)
    return turns + places[mark] * uneven


def _irregularity(times: FloatArray) -> float:
    """Median difference of neighbouring intervals over their sum [1], of *times* (n,) [s]."""
    intervals = np.diff(times)
    return float(np.median(np.abs(np.diff(intervals)) / (intervals[1:] + intervals[:-1])))


def at_rest(source: SampleSource, lines: ShaftLines) -> bool:
    """Whether a recording has the tacho that is named and this shows fewer than two pulses, or noise: the
    shaft does not turn.
    """
    if lines.tacho is None or lines.tacho not in [channel.name for channel in source.channels]:
        return False
    try:
        shaft_motion(source, lines)
    except DataError:
        return True
    return False


def tacho_pulses(source: SampleSource, channel: str) -> FloatArray:
    """Times (n_pulse,) [s] at which the tacho rises through the middle of its range, interpolated linearly
    between samples. With hysteresis: a rise counts after the signal has been in the lower and then in the
    upper part. DataError for a missing channel or one that does not vary.
    """
    names = [record.name for record in source.channels]
    if channel not in names:
        what = f"recording '{source.name}' has no channel '{channel}'"
        raise DataError(what, hint=f"channels: {', '.join(names)}")
    column = names.index(channel)
    low, high = np.inf, -np.inf
    for block in source.blocks(READ_SAMPLES):
        low, high = min(low, float(block[:, column].min())), max(high, float(block[:, column].max()))
    if not high > low:
        raise DataError(f"the tacho '{channel}' of '{source.name}' does not vary")
    counter = _PulseCounter(low, high)
    for block in source.blocks(READ_SAMPLES):
        counter.add(block[:, column])
    return np.array(counter.positions) / source.sample_rate


class _PulseCounter:
    """Rises through the middle of a range [samples from the start], fed block by block."""

    def __init__(self, low: float, high: float) -> None:
        span = high - low
        self._low, self._middle, self._high = low + LOW_SHARE * span, low + span / 2, low + HIGH_SHARE * span
        self._last = np.empty(0)
        self._armed = False
        self._crossing = np.nan
        self._n_sample = 0
        self.positions: list[float] = []

    def add(self, column: FloatArray) -> None:
        samples = np.concatenate([self._last, column])
        start = self._n_sample - self._last.size
        rises = np.flatnonzero((samples[:-1] < self._middle) & (samples[1:] >= self._middle))
        crossings = start + rises + (self._middle - samples[rises]) / (samples[rises + 1] - samples[rises])
        level = np.where(samples >= self._high, 1, np.where(samples <= self._low, -1, 0))
        for sample in np.flatnonzero(np.diff(level, prepend=0) != 0):
            if level[sample] < 0:
                self._armed = True
            elif level[sample] > 0 and self._armed:
                self._armed = False
                before = np.searchsorted(rises, sample) - 1
                self.positions.append(float(crossings[before] if before >= 0 else self._crossing))
        self._crossing = float(crossings[-1]) if crossings.size else self._crossing
        self._last = samples[-1:].copy()
        self._n_sample += column.size
