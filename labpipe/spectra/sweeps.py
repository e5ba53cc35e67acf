"""Sweeps in a force: where its frequency runs steadily up or down, by which law, and where the record is cut between them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.spectra.dwells import rising_crossings

# Fewest periods that count as a sweep, and the least ratio of its highest to its lowest frequency.
LEAST_PERIODS, LEAST_SPAN = 10, 1.05
# Largest ratio of two neighbouring periods in a sweep: beyond it, another one begins, or noise.
LARGEST_STEP = 1.4
# A frequency that turns back by this share of the logarithm of the whole span begins another sweep.
TURNED = 0.1
# Periods whose median gives the frequency at an end of a sweep.
AT_END = 5
# Share of the largest amplitude of a force below which its sweep is none: another shaker's, seen by this force.
LEAST_LEVEL = 0.05
# Slope of the frequency over a few periods, as a share of that of the whole, below which it stays and steps; fewest such pieces.
STEPPED, LEAST_WINDOWS = 0.5, 10
# A sweep may begin so many periods, or such a share of its length, before its first clear zero crossing: its amplitude rises slowly.
MARGIN, MARGIN_SHARE = 2.0, 0.02
# Share of the length of the longest sweep below which a run is none: a restart looks like a short sweep back.
LEAST_LENGTH = 0.1
# What runs on a straight line over time, and back to the frequency.
LAWS: dict[str, tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]] = {
    "linear": (np.asarray, np.asarray),
    "logarithmic": (np.log, np.exp),
}
_HINT = "sweep: a sine whose frequency runs steadily up or down; is it another excitation?"


@dataclass(frozen=True)
class FoundSweep:
    """Samples *start* ... *stop* (not included) of a sweep from *first* to *last* [periods per sample]; *law* linear or logarithmic.

    growth: |df/dt| [periods per sample^2] of a linear, |d ln f / dt| [1 per sample] of a logarithmic one; level: its rms [unit of the
    force]; steps: whether its frequency stays and jumps instead of running.
    """

    start: int
    stop: int
    first: float
    last: float
    law: str
    growth: float
    level: float
    steps: bool = False

    @property
    def low(self) -> float:
        return min(self.first, self.last)

    @property
    def high(self) -> float:
        return max(self.first, self.last)

    def rate_at(self, frequency: float) -> float:
        """|df/dt| [periods per sample^2] at a *frequency* [periods per sample]: constant (linear), or in proportion to it."""
        return self.growth * (1.0 if self.law == "linear" else frequency)


def find_sweeps(force: FloatArray) -> list[FoundSweep]:
    """The sweeps in a force (n_sample,) [N], in their order in time; DataError for a force without, or with dwells in their place."""
    force = force - np.mean(force)
    times = rising_crossings(force)
    # In noise a line through few samples can put a crossing ahead of the one before.
    times = times[np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0]
    pieces = [piece for run in _runs(times) for piece in _one_way(times[run[0] : run[1]], run[0])]
    sweeps = [_sweep(force, times[first:last]) for first, last in pieces if last - first > LEAST_PERIODS]
    sweeps = [sweep for sweep in sweeps if sweep.high > LEAST_SPAN * sweep.low]
    if not sweeps:
        raise DataError("the force holds no sweep", hint=_HINT)
    loudest, longest = max(sweep.level for sweep in sweeps), max(sweep.stop - sweep.start for sweep in sweeps)
    sweeps = [sweep for sweep in sweeps if sweep.level > LEAST_LEVEL * loudest and sweep.stop - sweep.start > LEAST_LENGTH * longest]
    if all(sweep.steps for sweep in sweeps):
        raise DataError("the frequency of the force stays and steps: dwells, no sweep", hint="excitation: stepped-sine")
    return sweeps


def _runs(times: FloatArray) -> list[tuple[int, int]]:
    """Ranges (first, end) of crossings *times* (n,) [samples] whose distances change by little from one to the next."""
    if times.size < 3:
        return []
    step = np.abs(np.diff(np.log(np.diff(times))))
    # A distance that fits neither to the one before nor to the one after belongs to no run.
    breaks = np.flatnonzero(step > np.log(LARGEST_STEP)) + 1
    edges = [0, *breaks.tolist(), times.size - 1]
    return [(first, last + 1) for first, last in itertools.pairwise(edges) if last - first > LEAST_PERIODS]


def _one_way(times: FloatArray, offset: int) -> list[tuple[int, int]]:
    """The run of crossings *times* (n,) [samples] cut where its frequency turns, as ranges of the crossings of the whole record."""
    level = _smoothed(-np.log(np.diff(times)))
    wide = float(np.ptp(level))
    turns, extreme, sign = [], 0, 0.0
    for number, value in enumerate(level):
        change = value - level[extreme]
        if sign == 0.0:
            first = level[: number + 1]
            if np.ptp(first) > TURNED * wide:
                sign, extreme = (1.0, number) if np.argmax(first) > np.argmin(first) else (-1.0, number)
        elif sign * change >= 0:
            extreme = number
        elif -sign * change > TURNED * wide:
            turns.append(extreme)
            sign, extreme = -sign, number
    edges = [0, *turns, times.size - 1]
    return [(offset + first, offset + last + 1) for first, last in itertools.pairwise(edges)]


def _smoothed(values: FloatArray) -> FloatArray:
    """Running median (n,) of AT_END values (n,) [any unit]; those at the ends are repeated."""
    padded = np.pad(values, AT_END // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, AT_END), axis=1))


def _sweep(force: FloatArray, times: FloatArray) -> FoundSweep:
    """The sweep with zero crossings at *times* (n,) [samples] of a *force* (n_sample,) [N]."""
    frequency, middle = 1 / np.diff(times), (times[1:] + times[:-1]) / 2
    lines = {law: np.polyfit(middle, there(frequency), 1) for law, (there, _) in LAWS.items()}
    curves = {law: LAWS[law][1](np.polyval(line, middle)) for law, line in lines.items()}
    law = min(curves, key=lambda name: float(np.std(curves[name] - frequency)))
    first, last = float(np.median(frequency[:AT_END])), float(np.median(frequency[-AT_END:]))
    start, stop = int(times[0]), int(np.ceil(times[-1]))
    level = float(np.sqrt(np.mean(force[start:stop] ** 2)))
    return FoundSweep(start, stop, first, last, law, abs(float(lines[law][0])), level, _stays(frequency, middle, curves[law]))


def _stays(frequency: FloatArray, middle: FloatArray, law: FloatArray) -> bool:
    """Whether a *frequency* (n,) [periods per sample] at times *middle* (n,) [samples] keeps its value and jumps where its *law* (n,) runs.

    The slope over a few periods, over that of the law: its median is 1 for a sweep, 0 for a stepped sine, whatever the noise.
    """
    width = AT_END
    while frequency.size // width >= LEAST_WINDOWS:
        windows = [values[: frequency.size // width * width].reshape(-1, width) for values in (frequency, middle, law)]
        f, t, expected = (window - window.mean(axis=1, keepdims=True) for window in windows)
        ratio = np.sum(f * t, axis=1) / np.sum(expected * t, axis=1)
        centre = float(np.median(ratio))
        error = 1.4826 * 1.2533 * float(np.median(np.abs(ratio - centre))) / np.sqrt(ratio.size)
        if centre + 3 * error < STEPPED:
            return True
        width *= 2
    return False


def loudest_sweeps(sweeps: Sequence[Sequence[FoundSweep]]) -> list[FoundSweep]:
    """Of the *sweeps* of each force of a recording, by time: where several forces have one at the same time, that of the loudest."""
    ranked = sorted((sweep for members in sweeps for sweep in members), key=lambda sweep: -sweep.level)
    chosen: list[FoundSweep] = []
    for sweep in ranked:
        if all(min(sweep.stop, other.stop) - max(sweep.start, other.start) < 0.5 * (sweep.stop - sweep.start) for other in chosen):
            chosen.append(sweep)
    return sorted(chosen, key=lambda sweep: sweep.start)


def cuts(sweeps: list[FoundSweep], n_sample: int) -> list[tuple[int, int]]:
    """Ranges (start, stop) [samples] of a record of *n_sample*: every sweep with all that follows up to the next one."""
    ends = [0, *(sweep.stop for sweep in sweeps)]
    starts = []
    for sweep, before in zip(sweeps, ends, strict=False):
        early = sweep.start - int(np.ceil(max(MARGIN / sweep.first, MARGIN_SHARE * (sweep.stop - sweep.start))))
        # Without a pause the cut lies between the last crossing of one sweep and the first of the next.
        starts.append(max(early, 0 if before == 0 else (before + sweep.start + 1) // 2))
    return list(zip(starts, [*starts[1:], n_sample], strict=True))
