"""Faults of the samples, block by block: clipping, missing numbers, constant channels, uneven time steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.quantities import LARGEST, SMALLEST
from labpipe.records.finding import Finding

# Equal consecutive samples that count as clipping; fewer occur by chance at a coarse resolution.
CLIPPED_RUN = 3
# Or this many times as many samples at the extreme as at each of the NEXT_VALUES next ones: where the signal
# leaves its extreme at once, as white noise does, no run is long. The slow turn of a sine holds 5 times as
# many.
CLIPPED_CROWD, NEXT_VALUES = 10, 15
# Runs in coarse steps, where each of the TURN_VALUES next values comes REPEATED times, say nothing of fewer
# than TURN times as many samples: a sine that turns d steps above its extreme has sqrt(1 + k/d) -
# sqrt(1 + (k - 1)/d) times as many at the k-th next value, for d = 1 the TURN-th part on the mean.
TURN, TURN_VALUES, REPEATED = 3, 3, 2
# Distance to the end of the range (share of the range) that counts as the end itself: unit conversion rounds.
AT_LIMIT = 1e-9


class EndValues:
    """Samples at the extreme of a channel, over block borders: in runs of at least CLIPPED_RUN, or all where
    they crowd there. *sign* +1 follows the maximum, -1 the minimum; a higher value starts afresh.
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
        """Whether a block whose numbers times the sign go up to *extreme* has any to be counted."""
        if self._values.size <= NEXT_VALUES or extreme >= self._reached:
            return True
        self._open = 0
        return False

    @property
    def _reached(self) -> float:
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
        begins, ends = (
            at_end[np.concatenate([[0], breaks + 1])],
            at_end[np.concatenate([breaks, [at_end.size - 1]])] + 1,
        )
        for begin, end in zip(begins, ends, strict=True):
            self._count_run(int(begin), int(end), self._open if begin == 0 else 0, start)
        last = int(ends[-1] - begins[-1]) + (self._open if begins[-1] == 0 else 0)
        self._open = last if ends[-1] == column.size else 0

    def _outermost(self, column: FloatArray) -> tuple[IntArray, FloatArray]:
        if self._values.size <= NEXT_VALUES:
            places = np.flatnonzero(np.isfinite(column))
            return places, self._sign * column[places]
        reached = self._reached
        places = np.flatnonzero(column >= reached if self._sign > 0 else column <= -reached)
        values = self._sign * column[places]
        finite = np.isfinite(values)
        return (places, values) if finite.all() else (places[finite], values[finite])

    def _count(self, outer: FloatArray) -> None:
        """Counts values that agree in single precision as one: computed numbers differ by rounding, no logger
        is finer.
        """
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

    def count_clipped(self) -> tuple[int, int]:
        """(clipped samples, first of them); none where the extreme is zero: there a window has set the force
        to zero, or nothing acted; nor where a signal is a step or a switch between two values, or the samples
        are the slow turn of one in few steps.
        """
        if self._extreme == 0 or self._values.size < 3:
            return 0, -1
        if self._counts.size > NEXT_VALUES and self._counts[-1] >= CLIPPED_CROWD * np.mean(self._counts[:-1]):
            return int(self._counts[-1]), self._first
        beside = self._counts[-1 - TURN_VALUES : -1]
        if beside.size == TURN_VALUES and beside.mean() >= max(REPEATED, self._counts[-1] / TURN):
            return 0, -1
        return self._in_runs, self._first_in_runs


class AtLimit:
    """Samples at or beyond a known end of the range: *sign* +1 the upper, -1 the lower one. A single one is
    clipped.
    """

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

    def count_clipped(self) -> tuple[int, int]:
        return self._count, self._first


# A time step may differ from the mean by this share, beside the rounding of printed times.
JITTER = 1e-3
# Time steps longer than this many last printed digits cannot hide a lost sample in the rounding of the times.
FINE = 3.0
# Share of the last printed digit by which mean and median step differ when the times have too few digits.
COARSE = 0.1
# Times may repeat or shorten a step where it is longer than this many last digits: a lost sample would still
# be seen.
LEAST = 0.75
# No recorder samples faster [Hz], none waits longer between two samples than as many seconds.
FASTEST = 1e12
# The same of a clock beside a stated rate; last printed digits that no rounding adds to a step; share of
# steps that are hardly any.
LONE, DOUBLED, HARDLY_ANY = 0.05, 1.5, 1e-4
# Samples of which the sums are made at once.
IN_CACHE = 1 << 13
# Times with more significant digits are exact enough.
MOST_DIGITS = 9


def check_amounts(names: Sequence[str], block: FloatArray, first: int) -> None:
    """DataError for the first number of a block (n, n_channel) [SI] from sample *first* on that no
    measurement gives: beyond LARGEST.
    """
    beyond = np.abs(block) > LARGEST
    # Infinities are missing numbers, which are reported as such.
    beyond &= np.isfinite(block)
    if not beyond.any():
        return
    sample, channel = (int(place) for place in np.argwhere(beyond)[0])
    what = (
        f"channel {names[channel]}: {block[sample, channel]:g} at sample {first + sample} is not a measured "
        "number"
    )
    raise DataError(what, hint="check the unit, the sensitivity and the column")


def _are_measured(low: FloatArray, high: FloatArray) -> bool:
    is_finite = np.isfinite(low).all() and np.isfinite(high).all()
    return bool(is_finite and max(-low.min(), high.max()) <= LARGEST)


class ChannelScreen:
    """Running levels and faults of the channels of a recording, fed with blocks (n, n_channel) that may hold
    NaN.
    """

    def __init__(
        self,
        names: Sequence[str],
        limits: Sequence[tuple[float, float] | None] | None = None,
        of_rotation: Collection[str] = (),
    ) -> None:
        """*limits* of the range of every channel, where known; channels *of_rotation* may not vary at all."""
        n = len(names)
        self._of_rotation = of_rotation
        self._names = list(names)
        self.minimum, self.maximum = np.full(n, np.inf), np.full(n, -np.inf)
        self._sum, self._squares, self._origin = np.zeros(n), np.zeros(n), np.full(n, np.nan)
        self.n_sample = 0
        self._n_missing = np.zeros(n, int)
        self._first_missing = np.full(n, -1)
        # Clipping at the lower and the upper end: by the known range, otherwise by repeated extreme values.
        self._ends: list[tuple[EndValues | AtLimit, ...]] = [
            tuple(EndValues(sign) if limit is None else AtLimit(sign, limit) for sign in (-1.0, 1.0))
            for limit in limits or [None] * n
        ]

    def add(self, block: FloatArray) -> None:
        """Add the next block (n, n_channel) [unit of the channel]."""
        if not block.shape[0]:
            return
        # Along a channel numbers lie side by side: reductions across rows of a few channels take eight times
        # as long.
        columns = np.ascontiguousarray(block.T)
        low, high = columns.min(axis=1), columns.max(axis=1)
        # A missing number makes both ends one, an infinity one of them: most blocks have neither, and are not
        # searched.
        if _are_measured(low, high):
            self._add_levels(columns)
        else:
            check_amounts(self._names, block, self.n_sample)
            missing = ~np.isfinite(columns)
            self._add_levels(columns, missing)
            self._n_missing += missing.sum(axis=1)
            fresh = (self._first_missing < 0) & missing.any(axis=1)
            self._first_missing[fresh] = self.n_sample + np.argmax(missing[fresh], axis=1)
            low = np.min(columns, axis=1, initial=np.inf, where=~missing)
            high = np.max(columns, axis=1, initial=-np.inf, where=~missing)
        self._add_ends(low, high, block.shape[0], columns.__getitem__)

    def add_between(
        self, low: FloatArray, high: FloatArray, n_sample: int, column_of: Callable[[int], FloatArray]
    ) -> bool:
        """Add the next *n_sample* samples by the least and largest number of each channel (n_channel,) [unit
        of the channel] alone; *column_of* gives those (n_sample,) of a channel that must be looked at. No
        levels are known then. False, and nothing added, for what `add` must take: missing samples, or beyond
        measure.
        """
        if not _are_measured(low, high):
            return False
        self._add_ends(low, high, n_sample, column_of)
        return True

    def _add_ends(
        self, low: FloatArray, high: FloatArray, n_sample: int, column_of: Callable[[int], FloatArray]
    ) -> None:
        self.minimum, self.maximum = np.minimum(self.minimum, low), np.maximum(self.maximum, high)
        for number, (lower, upper) in enumerate(self._ends):
            # Most blocks of a long record stay within what was there before, and are not searched.
            for end, extreme in ((lower, -low[number]), (upper, high[number])):
                if end.reaches(float(extreme)):
                    end.add(column_of(number), self.n_sample)
        self.n_sample += n_sample

    def _add_levels(self, columns: FloatArray, missing: BoolArray | None = None) -> None:
        """Sums about each channel's first number, so that a small signal on a large offset keeps its
        variance.
        """
        fresh = np.isnan(self._origin)
        if missing is None:
            self._origin[fresh] = columns[fresh, 0]
        else:
            fresh &= ~missing.all(axis=1)
            self._origin[fresh] = columns[fresh, np.argmin(missing, axis=1)[fresh]]
        for start in range(0, columns.shape[1], IN_CACHE):
            piece = slice(start, start + IN_CACHE)
            beside = columns[:, piece] - self._origin[:, None]
            if missing is not None:
                beside[missing[:, piece]] = 0.0
            self._sum += beside.sum(axis=1)
            self._squares += np.einsum("cn,cn->c", beside, beside)

    @property
    def mean(self) -> FloatArray:
        """Mean per channel over the samples that are numbers, (n_channel,) [unit of the channel]."""
        return self._sum / np.maximum(self.n_sample - self._n_missing, 1) + np.nan_to_num(self._origin)

    @property
    def rms(self) -> FloatArray:
        """Root mean square about the mean per channel, (n_channel,) [unit of the channel]."""
        n = np.maximum(self.n_sample - self._n_missing, 1)
        return np.sqrt(np.maximum(self._squares / n - (self._sum / n) ** 2, 0.0))

    def levels(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation [unit of the channel] of every channel by its name."""
        return {
            name: (float(mean), float(rms))
            for name, mean, rms in zip(self._names, self.mean, self.rms, strict=True)
        }

    def findings(self) -> tuple[Finding, ...]:
        """Warnings of gaps, constant channels and clipping, with the channel and the first sample."""
        faults: list[Finding] = []
        for number, name in enumerate(self._names):
            if self._n_missing[number]:
                what = f"{self._n_missing[number]} of {self.n_sample} samples are not numbers"
                first = self._first_missing[number]
                faults.append(Finding("gap", f"channel {name}: {what}, the first is sample {first}"))
            if self._n_missing[number] == self.n_sample:
                continue
            if not self.maximum[number] > self.minimum[number]:
                # The pulses or the speed of a shaft at rest.
                if name in self._of_rotation:
                    continue
                faults.append(Finding("constant", f"channel {name} does not vary at all"))
                continue
            largest = max(abs(self.minimum[number]), abs(self.maximum[number]))
            # Their squares vanish.
            if largest < SMALLEST:
                what = f"channel {name}: no number above {largest:g}, which nothing measures"
                raise DataError(what, hint="check the unit, the sensitivity and the column")
            faults.extend(self._clipping(number, name))
        return tuple(faults)

    def _clipping(self, number: int, name: str) -> list[Finding]:
        runs = [end.count_clipped() for end in self._ends[number]]
        count = sum(n for n, _ in runs)
        if not count:
            return []
        first = min(start for n, start in runs if n)
        share = 100 * count / self.n_sample
        # Not 1e+02.
        percent = f"{share:.0f}" if share >= 99.5 else f"{share:.2g}"
        message = (
            f"channel {name}: {count} samples ({percent} %) stand at the end of the range, the first is "
            f"sample {first}; the peaks are cut off and amplitudes come out too small"
        )
        return [Finding("clipped", message)]


class TimeAxisScreen:
    """Check of a time column [s] for equal, rising steps, fed block by block."""

    def __init__(self, column: str) -> None:
        self.column = column
        self._first = self._last = np.nan
        self._smallest, self._largest = (np.inf, -1), (-np.inf, -1)
        self._n_sample = 0
        self._resolution = np.inf
        self._digits = 1
        self._typical = np.nan

    def add(self, times: FloatArray) -> None:
        """Add the next times (n,) [s]; DataError at a missing time or one that does not rise."""
        if not times.size:
            return
        if not np.all(np.isfinite(times)):
            sample = self._n_sample + int(np.argmax(~np.isfinite(times)))
            raise DataError(f"the time column '{self.column}' has no number at sample {sample}")
        joined = times if self._n_sample == 0 else np.concatenate([[self._last], times])
        offset = max(self._n_sample - 1, 0)
        steps = np.diff(joined)
        if steps.size:
            if np.any(steps < 0):
                sample = offset + 1 + int(np.argmax(steps < 0))
                at = f"sample {sample} ({joined[sample - offset]:g} s)"
                raise DataError(f"the time column '{self.column}' does not rise at {at}")
            if np.isnan(self._typical):
                self._typical = float(np.median(steps))
            self._smallest = min(self._smallest, (float(steps.min()), offset + 1 + int(steps.argmin())))
            self._largest = max(self._largest, (float(steps.max()), offset + 1 + int(steps.argmax())))
        # The finest resolution of all blocks: a short block may hold round numbers only.
        self._resolution = min(self._resolution, _printed_resolution(times))
        self._digits = max(self._digits, _printed_digits(times))
        if self._n_sample == 0:
            self._first = float(times[0])
        self._last = float(times[-1])
        self._n_sample += times.size

    def sample_rate(self) -> float:
        """(n - 1) / (t_last - t_first) [Hz]. DataError when the steps are not equal within jitter and the
        rounding of the times.
        """
        if self._n_sample < 2:
            raise DataError(f"the time column '{self.column}' has fewer than two samples")
        step = (self._last - self._first) / (self._n_sample - 1)
        # Coarsely printed times make equal steps differ by one last digit (half a digit at either end). That
        # is not allowed for where a step is hardly longer than the digit and the median step equals the mean:
        # an unequal step is a lost sample then. Nor does a step shorter than usual hide one, or any step
        # where the first times, of more decimals, show how long steps are.
        largest = max(abs(self._first), abs(self._last))
        by_digits = 10.0 ** (math.floor(math.log10(largest)) + 1 - self._digits) if largest > 0 else 0.0
        resolution = max(self._resolution, by_digits if step > LEAST * by_digits else 0.0)
        off = step - self._typical
        clear = off < 0 or self._resolution < COARSE * resolution
        coarse = (
            step > FINE * resolution
            or abs(off) > COARSE * resolution
            or (clear and step > LEAST * resolution)
        )
        # Stored numbers are rounded as well: a date in seconds is accurate to 2e-7 s only, at either end of a
        # step.
        stored = float(np.spacing(largest))
        allowed = JITTER * step + stored + (resolution if coarse else 0.0)
        if self._smallest[0] <= 0 and not (coarse and step > LEAST * resolution):
            what = f"the time column '{self.column}' does not rise at sample {self._smallest[1]}"
            hint = "times of too few digits? give sample_rate in the rig file instead of time"
            raise DataError(what, hint=hint)
        for extreme, sample in (self._largest, self._smallest):
            if abs(extreme - step) > allowed:
                what = f"the time steps of column '{self.column}' are not equal"
                at, usual = f"{extreme:g} s at sample {sample}", self._typical or step
                whole = round(extreme / usual)
                # A sampling rate in place of such times would move all that follows.
                exact = abs(extreme - whole * usual) <= allowed + resolution
                if whole > 2 or (whole != 1 and exact and step > FINE * resolution):
                    lost = f"{whole - 1} sample(s) are lost" if whole else "a row stands twice"
                    hint = f"{lost} there; cut the recording, or record it again"
                    raise DataError(f"{what}: {at}, {usual:g} s elsewhere", hint=hint)
                hint = "a lost sample or coarse times; if the logger runs evenly, give sample_rate in the "
                raise DataError(
                    f"{what}: {at}, {step:g} s on average", hint=f"{hint}rig file instead of time"
                )
        if not 1 / FASTEST <= step <= FASTEST:
            what = f"the time steps of column '{self.column}' are {step:g} s"
            raise DataError(
                what, hint=f"rates lie between {1 / FASTEST:g} and {FASTEST:g} Hz: check the unit of the time"
            )
        rounded = self._largest[0] - self._smallest[0] > 0.5 * resolution
        return plain_rate(step, resolution / (self._n_sample - 1) if rounded else 0.0)


class LostSamples:
    """Samples that the times in *column* do not have, fed block by block, where a rate is stated beside them.
    Told by a clock without jitter alone, of which every step is the usual one or a whole multiple. Steps that
    its digits may have doubled count where there are hardly any.
    """

    def __init__(self, column: str) -> None:
        self.column, self._last, self._usual = column, np.nan, np.nan
        self._is_even, self._n_sample = True, 0
        # Lost samples, places, and the first sample after one with its time: of all steps, and of those that
        # digits cannot explain.
        self._gaps: list[list[Any]] = [[0, 0, None], [0, 0, None]]

    def add(self, times: FloatArray) -> None:
        """The next times (n,) [any unit]."""
        steps = np.diff(times, prepend=self._last)
        if not self._n_sample and times.size > 1:
            self._usual = steps[0] = float(np.median(steps[1:]))
        resolution = _printed_resolution(times) if np.all(np.isfinite(times)) and times.size else np.inf
        lost = np.round(steps / self._usual) - 1 if self._usual > 0 else np.full(steps.size, np.nan)
        beside = np.abs(steps - (lost + 1) * self._usual)
        # What is no number is not even.
        self._is_even &= bool(np.all((lost >= 0) & (beside <= LONE * self._usual + resolution)))
        for gap, least in zip(self._gaps, (0.0, DOUBLED * resolution), strict=True):
            places = np.flatnonzero((lost > 0) & (lost * self._usual >= least))
            if places.size:
                gap[2] = gap[2] or (self._n_sample + int(places[0]), float(times[places[0]]))
                gap[0], gap[1] = gap[0] + int(np.sum(lost[places])), gap[1] + places.size
        self._last, self._n_sample = (
            float(times[-1]) if times.size else self._last,
            self._n_sample + times.size,
        )

    def findings(self) -> tuple[Finding, ...]:
        """A warning of the samples that are lost, with the first place."""
        lost, places, first = self._gaps[0]
        if places - self._gaps[1][1] > 1 + HARDLY_ANY * self._n_sample:
            lost, _, first = self._gaps[1]
        if not self._is_even or not lost:
            return ()
        sample, at = first
        what = f"by the column '{self.column}' {lost} sample(s) are lost, the first before sample {sample}"
        hint = "cut the recording there: `sample_rate` takes what follows for earlier than it was"
        return (Finding("gap", f"{what} ({at:g}); {hint}"),)


def plain_rate(step: float, uncertainty: float) -> float:
    """The rate [Hz] of fewest digits, 12 at most, whose step [s] lies within *uncertainty* [s]: files of one
    logger have one rate then.
    """
    rates = (float(f"{1 / step:.{digits}g}") for digits in range(1, 12))
    return next((rate for rate in rates if abs(1 / rate - step) <= uncertainty), float(f"{1 / step:.12g}"))


def _printed_digits(times: FloatArray) -> int:
    """Significant digits with which all times are printed, up to MOST_DIGITS. More for numbers of full
    precision.
    """
    sizes = np.abs(times[times != 0])
    if not sizes.size:
        return 1
    exponent = np.floor(np.log10(sizes) * (1 + 1e-15))
    # A few numbers of full precision spare the search through all.
    for chosen in (slice(0, 16), slice(None)):
        for digits in range(1, MOST_DIGITS + 1):
            scaled = sizes[chosen] * 10.0 ** (digits - 1 - exponent[chosen])
            if np.all(np.abs(scaled - np.round(scaled)) <= 1e-12 * scaled):
                break
        else:
            return MOST_DIGITS + 8
    return digits


def _printed_resolution(times: FloatArray) -> float:
    """The last printed digit of the times: the largest power of ten, 1 at most, of which all are multiples.
    Never finer than the floating-point numbers: a date in seconds is accurate to 2e-7 s only.
    """
    spacing = float(np.spacing(np.max(np.abs(times))))
    for digits in range(12):
        scaled = times * 10.0**digits
        if (
            np.all(np.abs(scaled - np.round(scaled)) <= 4 * spacing * 10.0**digits)
            and spacing * 10.0**digits < COARSE
        ):
            return 10.0**-digits
    return 4 * spacing
