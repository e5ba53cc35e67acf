"""Dwells of a stepped sine: where the frequency of a force stays constant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import DataError

# Fewest periods of one frequency that count as a dwell.
LEAST_PERIODS = 5
# A zero crossing counts once the force has been below this share of its local peak.
HYSTERESIS = 0.3
# Share of the force's power below the frequency that sets how long its local peak is looked for.
LOW_SHARE = 0.005
# A period belongs to the dwell while its crossing lies within so many standard errors of where the periods before put it.
WITHIN = 6.0
# Scatter of the crossings [periods] above which the force is no sine; least that is believed.
MOST_SCATTER, LEAST_SCATTER = 0.05, 1e-6
# Standard errors of the curvature of the phase by which a frequency runs on instead of staying.
CURVED = 4.0


@dataclass(frozen=True)
class Dwell:
    """Samples *start* ... *stop* (not included), first and last zero crossing, of a sine of about *frequency* [periods per sample]."""

    start: int
    stop: int
    frequency: float


def find_dwells(force: FloatArray) -> list[Dwell]:
    """The dwells in a force (n_sample,) [N], in their order in time.

    The phase of the force, known at its zero crossings, is a broken line over time: every straight piece of LEAST_PERIODS periods or
    more is a dwell. DataError for a force that is no sine, without dwells, or whose frequency runs on.
    """
    times = rising_crossings(force - np.mean(force))
    if times.size <= LEAST_PERIODS:
        raise DataError(f"the force has {times.size} periods, too few for a dwell", hint=_HINT)
    scatter = _scatter(times)
    if scatter > MOST_SCATTER:
        raise DataError(f"the force is no sine: its periods scatter by {100 * scatter:.0f} %", hint=_HINT)
    pieces = [piece for piece in _refined(times, _straight_pieces(times, scatter)) if piece[1] - piece[0] > LEAST_PERIODS]
    if not pieces:
        raise DataError(f"the force stays at no frequency for {LEAST_PERIODS} periods", hint=_HINT)
    curved = [_is_curved(times[first:last]) for first, last in pieces]
    if np.mean(curved) > 0.5:
        raise DataError(
            "the frequency of the force runs on: a sweep, no dwells", hint="excitation: stepped-sine needs constant frequencies"
        )
    return [
        Dwell(int(np.ceil(times[first])), int(times[last - 1]), float((last - 1 - first) / (times[last - 1] - times[first])))
        for first, last in pieces
    ]


_HINT = "stepped-sine: one frequency after another, each kept; is it another excitation?"


def rising_crossings(force: FloatArray) -> FloatArray:
    """Times [samples] at which a *force* (n_sample,) [N] of mean zero rises through zero, between samples by a straight line."""
    from scipy import ndimage

    peak = ndimage.maximum_filter1d(np.abs(force), _longest_period(force))
    low, high = force < -HYSTERESIS * peak, force > HYSTERESIS * peak
    marks = np.flatnonzero(low | high)
    rises = np.flatnonzero(low[marks[:-1]] & high[marks[1:]])
    return np.array([_crossing(force, int(marks[n]), int(marks[n + 1])) for n in rises])


def _longest_period(force: FloatArray) -> int:
    power = np.abs(np.fft.rfft(force)) ** 2
    lowest = int(np.searchsorted(np.cumsum(power), LOW_SHARE * power.sum()))
    return max(3, int(1.5 * force.size / max(lowest, 1)))


def _crossing(force: FloatArray, before: int, after: int) -> float:
    """Root of the straight line through the samples from *before* to *after*, or between the two of opposite sign if there are no more."""
    values = force[before : after + 1]
    number = np.arange(values.size)
    slope, level = np.polyfit(number, values, 1)
    return float(before - level / slope)


def _scatter(times: FloatArray) -> float:
    """Standard deviation of a crossing [periods], from the second differences: those of a step are few."""
    bend = np.diff(times, 2) / (0.5 * (times[2:] - times[:-2]))
    return max(float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6)), LEAST_SCATTER)


def _straight_pieces(times: FloatArray, scatter: float) -> list[tuple[int, int]]:
    """Ranges (first, end) of crossings on one straight line each, period by period."""
    pieces, first = [], 0
    line = _Line()
    for number, time in enumerate(times):
        if number - first >= 3 and abs(time - line.at(number - first)) > WITHIN * scatter * line.slope * line.spread(number - first):
            pieces.append((first, number))
            first, line = number, _Line()
        line.add(float(number - first), time)
    return [*pieces, (first, times.size)]


class _Line:
    """A straight line through points that come one by one."""

    def __init__(self) -> None:
        self._n, self._x, self._y, self._xx, self._xy = 0, 0.0, 0.0, 0.0, 0.0
        self.slope = 0.0

    def add(self, x: float, y: float) -> None:
        self._n += 1
        dx, dy = x - self._x, y - self._y
        self._x += dx / self._n
        self._y += dy / self._n
        self._xx += dx * (x - self._x)
        self._xy += dx * (y - self._y)
        self.slope = self._xy / self._xx if self._n > 1 else 0.0

    def at(self, x: float) -> float:
        return self._y + self.slope * (x - self._x)

    def spread(self, x: float) -> float:
        """Standard deviation of a point beside the line [1, of that of a point]."""
        return float(np.sqrt(1 + 1 / self._n + (x - self._x) ** 2 / self._xx))


def _refined(times: FloatArray, pieces: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The *pieces* with the crossing from which the next one's line fits better: a step shows only some periods after it."""
    long = [piece for piece in pieces if piece[1] - piece[0] > LEAST_PERIODS]
    ends = [list(piece) for piece in long]
    for number in range(len(long) - 1):
        (first, end), (start, last) = long[number], long[number + 1]
        if end != start:
            continue
        near = np.arange(first + (end - first) // 2, end)
        before = np.polynomial.Polynomial.fit(np.arange(first, near[0]), times[first : near[0]], 1)(near)
        middle = start + (last - start) // 2
        after = np.polynomial.Polynomial.fit(np.arange(middle, last), times[middle:last], 1)(near)
        error_before, error_after = (times[near] - before) ** 2, (times[near] - after) ** 2
        cost = np.concatenate([[0.0], np.cumsum(error_before)]) + np.concatenate([np.cumsum(error_after[::-1])[::-1], [0.0]])
        ends[number][1] = ends[number + 1][0] = int(near[0] + np.argmin(cost)) if near.size else end
    return [(first, end) for first, end in ends]


def _is_curved(times: FloatArray) -> bool:
    """Whether the phase over the last three quarters of the crossings (n,) [samples] bends significantly."""
    y = times[times.size // 4 :]
    x = np.linspace(-1, 1, y.size)
    design = np.polynomial.legendre.legvander(x, 2)
    if y.size <= 4:
        return False
    values = np.linalg.lstsq(design, y, rcond=None)[0]
    variance = np.sum((y - design @ values) ** 2) / (y.size - 3) * np.linalg.inv(design.T @ design)[2, 2]
    return bool(abs(values[2]) > CURVED * np.sqrt(variance))


def loudest(samples: FloatArray, columns: IntArray) -> int:
    """The column of the input with the largest variance, of *samples* (n_sample, n_channel) [unit of the channel]."""
    return int(columns[np.argmax(np.var(samples[:, columns], axis=0))])
