"""Samples at the ends of a channel's range, block by block: peaks that a logger has cut off."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray, IntArray

# Equal consecutive samples that count as clipping; fewer occur by chance at a coarse resolution.
CLIPPED_RUN = 3
# Or this many times as many samples at the extreme as at each of the NEXT_VALUES next ones: where the signal leaves its extreme at
# once, as white noise does, no run is long. The slow turn of a sine holds 5 times as many.
CLIPPED_CROWD, NEXT_VALUES = 10, 15
# Distance to the end of the range (share of the range) that counts as the end itself: unit conversion rounds.
AT_LIMIT = 1e-9


class EndValues:
    """Samples at the extreme of a channel, over block borders: those in runs of at least CLIPPED_RUN, or all where they crowd there.

    *sign* +1 follows the maximum, -1 the minimum. Only runs at the extreme so far are kept: a higher value starts afresh.
    """

    def __init__(self, sign: float) -> None:
        self._sign = sign
        self._extreme = -np.inf
        self._in_runs = 0
        self._first = self._first_in_runs = -1
        self._open = 0
        # The NEXT_VALUES + 1 outermost different values, ascending, and how many samples have each.
        self._values, self._counts = np.empty(0), np.empty(0, np.int64)

    def reaches(self, extreme: float) -> bool:
        """Whether a block whose numbers times the sign go up to *extreme* has any to be counted; a run ends where it has none."""
        if self._values.size <= NEXT_VALUES or extreme >= self._reached:
            return True
        self._open = 0
        return False

    @property
    def _reached(self) -> float:
        """From where on values, times the sign, are counted."""
        lowest = float(self._values[0])
        return lowest - AT_LIMIT * abs(lowest)

    def add(self, column: FloatArray, start: int) -> None:
        """Add a channel's next numbers (n,) [unit of the channel], of which the first is sample *start*."""
        places, values = self._outermost(column)
        if not values.size:
            self._open = 0
            return
        self._count(values)
        peak = float(values.max())
        if peak > self._extreme:
            self._extreme, self._in_runs, self._first, self._first_in_runs, self._open = peak, 0, -1, -1, 0
        at_end = places[values == self._extreme]
        if not at_end.size:
            self._open = 0
            return
        if self._first < 0:
            self._first = start + int(at_end[0])
        breaks = np.flatnonzero(np.diff(at_end) > 1)
        begins, ends = at_end[np.concatenate([[0], breaks + 1])], at_end[np.concatenate([breaks, [at_end.size - 1]])] + 1
        for begin, end in zip(begins, ends, strict=True):
            self._count_run(int(begin), int(end), self._open if begin == 0 else 0, start)
        last = int(ends[-1] - begins[-1]) + (self._open if begins[-1] == 0 else 0)
        self._open = last if ends[-1] == column.size else 0

    def _outermost(self, column: FloatArray) -> tuple[IntArray, FloatArray]:
        """Where the column (n,) reaches the outermost values so far, and its values there times the sign: few, after the first block."""
        if self._values.size <= NEXT_VALUES:
            places = np.flatnonzero(np.isfinite(column))
            return places, self._sign * column[places]
        reached = self._reached
        places = np.flatnonzero(column >= reached if self._sign > 0 else column <= -reached)
        values = self._sign * column[places]
        finite = np.isfinite(values)
        return (places, values) if finite.all() else (places[finite], values[finite])

    def _count(self, outer: FloatArray) -> None:
        """Counts values that agree in single precision as one: computed numbers differ by rounding, no logger is finer."""
        fresh, counts = np.unique(outer.astype(np.float32).astype(float), return_counts=True)
        joined, place = np.unique(np.concatenate([self._values, fresh]), return_inverse=True)
        total = np.bincount(place, np.concatenate([self._counts, counts]), joined.size).astype(np.int64)
        self._values, self._counts = joined[-NEXT_VALUES - 1 :], total[-NEXT_VALUES - 1 :]

    def _count_run(self, begin: int, end: int, carried: int, start: int) -> None:
        length = end - begin + carried
        if length < CLIPPED_RUN:
            return
        self._in_runs += length if carried < CLIPPED_RUN else end - begin
        if self._first_in_runs < 0:
            self._first_in_runs = start + begin - carried

    def clipped(self) -> tuple[int, int]:
        """(clipped samples, first of them); none where the extreme is zero: there a window has set the force to zero, or nothing acted."""
        if self._extreme == 0:
            return 0, -1
        if self._counts.size > NEXT_VALUES and self._counts[-1] >= CLIPPED_CROWD * np.mean(self._counts[:-1]):
            return int(self._counts[-1]), self._first
        return self._in_runs, self._first_in_runs


class AtLimit:
    """Samples at or beyond a known end of the range: *sign* +1 the upper, -1 the lower one. A single one is clipped."""

    def __init__(self, sign: float, limits: tuple[float, float]) -> None:
        low, high = limits
        self._sign = sign
        self._limit = (high if sign > 0 else -low) - AT_LIMIT * (high - low)
        self._count = 0
        self._first = -1

    def reaches(self, extreme: float) -> bool:
        """Whether numbers that go up to *extreme*, times the sign, are clipped."""
        return extreme >= self._limit

    def add(self, column: FloatArray, start: int) -> None:
        """Add a channel's next numbers (n,) [unit of the channel], of which the first is sample *start*."""
        beyond = np.isfinite(column) & (self._sign * column >= self._limit)
        if self._first < 0 and beyond.any():
            self._first = start + int(np.argmax(beyond))
        self._count += int(beyond.sum())

    def clipped(self) -> tuple[int, int]:
        """(clipped samples, first of them)."""
        return self._count, self._first


def both_ends(limits: tuple[float, float] | None) -> tuple[EndValues, EndValues] | tuple[AtLimit, AtLimit]:
    """Detectors of clipping at the lower and the upper end: by the known range, otherwise by repeated extreme values."""
    if limits is None:
        return EndValues(-1.0), EndValues(1.0)
    return AtLimit(-1.0, limits), AtLimit(1.0, limits)
