"""Where the frequency of a force stays constant or runs steadily, and how fast a resonance is swept."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.spectra.damping import HalfPower, half_power

# Fewest periods of one frequency that count as a dwell.
LEAST_PERIODS = 5
# A zero crossing counts once the force has been below this share of its local peak.
HYSTERESIS = 0.3
# Share of the force's power below the frequency that sets how long its local peak is looked for.
LOW_SHARE = 0.005
# Standard errors within which a crossing lies where the periods of the dwell before put it.
WITHIN = 6.0
# Most by which a straight line through the samples of a sine misses its crossing [periods], times the square
# of the samples per period: all that the crossings of a force without noise scatter by.
BENT = 0.3
# Scatter of the crossings [periods] above which the force is not a sine; least that is believed.
MOST_SCATTER, LEAST_SCATTER = 0.05, 1e-6
# Standard errors of the curvature of the phase by which a frequency runs on instead of staying.
CURVED = 4.0


@dataclass(frozen=True)
class Dwell:
    """Samples *start* ... *stop* (not included), first and last zero crossing, of a sine of about *frequency*
    [periods per sample].
    """

    start: int
    stop: int
    frequency: float


def find_dwells(force: FloatArray) -> list[Dwell]:
    """The dwells in a force (n_sample,) [N], in their order in time. The phase of the force, known at its
    zero crossings, is a broken line over time: every straight piece of LEAST_PERIODS periods or more is a
    dwell. DataError for a force that is not a sine, without dwells, or whose frequency runs on.
    """
    times = rising_crossings(force - np.mean(force))
    if times.size <= LEAST_PERIODS:
        raise DataError(f"the force has {times.size} periods, too few for a dwell", hint=_HINT)
    # Standard deviation of a crossing [periods], from the second differences: those of a step are few.
    bend = np.diff(times, 2) / (0.5 * (times[2:] - times[:-2]))
    scatter = max(float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6)), LEAST_SCATTER)
    if scatter > MOST_SCATTER:
        raise DataError(f"the force is not a sine: its periods scatter by {100 * scatter:.0f} %", hint=_HINT)
    pieces = [
        piece
        for piece in _refine(times, _straight_pieces(times, scatter))
        if piece[1] - piece[0] > LEAST_PERIODS
    ]
    if not pieces:
        raise DataError(f"the force stays at no frequency for {LEAST_PERIODS} periods", hint=_HINT)
    curved = [_is_curved(times[first:last]) for first, last in pieces]
    if np.mean(curved) > 0.5:
        what = "the frequency of the force keeps changing: a sweep, not dwells"
        raise DataError(what, hint="excitation: stepped-sine needs constant frequencies")
    dwells = []
    for first, last in pieces:
        begin, end = times[first], times[last - 1]
        dwells.append(Dwell(int(np.ceil(begin)), int(end), float((last - 1 - first) / (end - begin))))
    return dwells


_HINT = "stepped-sine: one frequency after another, each kept; is it another excitation?"


def rising_crossings(force: FloatArray) -> FloatArray:
    """Times [samples] at which a *force* (n_sample,) [N] of mean zero rises through zero, between samples by
    a straight line.
    """
    power = np.abs(np.fft.rfft(force)) ** 2
    lowest = int(np.searchsorted(np.cumsum(power), LOW_SHARE * power.sum()))
    longest_period = max(3, int(1.5 * force.size / max(lowest, 1)))
    peak = scipy.ndimage.maximum_filter1d(np.abs(force), longest_period)
    low, high = force < -HYSTERESIS * peak, force > HYSTERESIS * peak
    marks = np.flatnonzero(low | high)
    rises = np.flatnonzero(low[marks[:-1]] & high[marks[1:]])
    return _roots(force, marks[rises], marks[rises + 1])


def _roots(force: FloatArray, before: IntArray, after: IntArray) -> FloatArray:
    """Roots [samples] of straight lines through the samples from *before* to *after* (n,)."""
    if not before.size:
        return np.empty(0)
    size = after - before + 1
    begins = np.cumsum(size) - size
    number = np.arange(int(np.sum(size))) - np.repeat(begins, size)
    values = force[number + np.repeat(before, size)]
    centre = (size - 1) / 2
    level = np.add.reduceat(values, begins) / size
    slope = np.add.reduceat((number - np.repeat(centre, size)) * values, begins) * 12 / (size * (size**2 - 1))
    return before + centre - level / slope


def _straight_pieces(times: FloatArray, scatter: float) -> list[tuple[int, int]]:
    pieces, first = [], 0
    line = _Line()
    for number, time in enumerate(times):
        at = number - first
        if at >= 3 and abs(time - line.at(at)) > line.spread(at) * max(
            WITHIN * scatter * line.slope, 2 * BENT / line.slope
        ):
            pieces.append((first, number))
            first, line = number, _Line()
        line.add(float(number - first), time)
    return [*pieces, (first, times.size)]


class _Line:
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


def _refine(times: FloatArray, pieces: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The *pieces* up to where the next one's line fits better: a step shows periods later."""
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
        cost = np.concatenate([[0.0], np.cumsum(error_before)]) + np.concatenate(
            [np.cumsum(error_after[::-1])[::-1], [0.0]]
        )
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
    """The column of the input with the largest variance, of *samples* (n_sample, n_channel) [unit of the
    channel].
    """
    return int(columns[np.argmax(np.var(samples[:, columns], axis=0))])


# Fewest periods of a sweep, and the least ratio of its highest to its lowest frequency.
LEAST_SWEPT_PERIODS, LEAST_SPAN = 10, 1.05
# Largest ratio of two neighbouring periods in a sweep: beyond it, another one begins, or noise.
LARGEST_STEP = 1.4
# A frequency that turns back by this share of the logarithm of the whole span begins another sweep.
TURNED = 0.1
# Periods whose median gives the frequency at an end of a sweep.
AT_END = 5
# Share of a force's largest amplitude below which a sweep is another shaker's.
LEAST_LEVEL = 0.05
# Share of a force's power above its sweeps from which on it is taken out before they are looked for: from a
# factor above the highest frequency at which the power, averaged over a part of the lines, is so many times
# the quantile that stands for noise.
QUIET, BEYOND, AVERAGED, STANDS_OUT, FLOOR = 0.05, 1.25, 100, 2.0, 0.3
# Slope over a few periods, as a share of the whole's, below which a frequency steps; fewest such pieces.
STEPPED, LEAST_WINDOWS = 0.5, 10
# A sweep may begin so many periods, or such a share of its length, before its first clear zero crossing.
MARGIN, MARGIN_SHARE = 2.0, 0.02
# Share of the longest sweep's length below which a run is none: a restart looks like a short sweep back.
LEAST_LENGTH = 0.1
# A piece goes on with a sweep that it does not turn back from by more than this, both on one law (median).
BACK, OFF_LAW = 0.9, 0.06
# A sweep reaches on in steps of so many periods, while this share of the power lies within a factor of its
# frequency.
REACH_PERIODS, REACH_SHARE, REACH_SPAN = 12.0, 0.6, 1.15
# What runs on a straight line over time, and back to the frequency.
LAWS: dict[str, tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]] = {
    "linear": (np.asarray, np.asarray),
    "logarithmic": (np.log, np.exp),
}
_SWEEP_HINT = "sweep: a sine whose frequency runs steadily up or down; is it another excitation?"


@dataclass(frozen=True)
class FoundSweep:
    """Samples *start* ... *stop* (not included) of a sweep from *first* to *last* [periods per sample]; *law*
    linear or logarithmic. growth: |df/dt| [periods per sample^2] of a linear, |d ln f / dt| [1 per sample] of
    a logarithmic one; level: its rms [unit of the force]; steps: whether its frequency stays and jumps
    instead of running.
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
        """|df/dt| [periods per sample^2] at a *frequency* [periods per sample]: constant (linear), or in
        proportion to it.
        """
        return self.growth * (1.0 if self.law == "linear" else frequency)

    def frequency_at(self, sample: float) -> float:
        """The frequency [periods per sample] at a *sample*, that of the nearer end before and after."""
        passed = min(max((sample - self.start) / (self.stop - self.start), 0.0), 1.0)
        if self.law == "linear":
            return self.first + passed * (self.last - self.first)
        return self.first * (self.last / self.first) ** passed


def find_sweeps(force: FloatArray) -> list[FoundSweep]:
    """The sweeps in a force (n_sample,) [N], in their order in time. DataError for a force without, or with
    dwells in their place.
    """
    force = _remove_noise_above(force - np.mean(force))
    times = rising_crossings(force)
    # In noise a line through few samples can put a crossing ahead of the one before.
    times = times[np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0]
    pieces = [piece for run in _runs(times) for piece in _one_way(times[run[0] : run[1]], run[0])]
    runs = _continue([times[first:last] for first, last in pieces if last - first > LEAST_SWEPT_PERIODS])
    sweeps = [_sweep(force, run) for run in runs]
    sweeps = [sweep for sweep in sweeps if sweep.high > LEAST_SPAN * sweep.low]
    # As far as the force follows their law, beyond its last clear crossings.
    before, after = [0, *(s.stop for s in sweeps)], [*(s.start for s in sweeps[1:]), force.size]
    reach = zip(sweeps, before, after, strict=False)
    sweeps = [_extend(_extend(sweep, force, low, -1), force, high, 1) for sweep, low, high in reach]
    if not sweeps:
        raise DataError("the force holds no sweep", hint=_SWEEP_HINT)
    loudest, longest = max(sweep.level for sweep in sweeps), max(sweep.stop - sweep.start for sweep in sweeps)
    sweeps = [
        sweep
        for sweep in sweeps
        if sweep.level > LEAST_LEVEL * loudest and sweep.stop - sweep.start > LEAST_LENGTH * longest
    ]
    if all(sweep.steps for sweep in sweeps):
        what = "the frequency of the force stays and steps: dwells, not a sweep"
        raise DataError(what, hint="excitation: stepped-sine")
    return sweeps


def _remove_noise_above(force: FloatArray) -> FloatArray:
    """The *force* (n_sample,) [N] of mean zero up to where its power stands out of what is alike at all
    frequencies, if that beyond is more than QUIET of it: such noise tears the crossings of a sine apart.
    """
    spectrum = np.fft.rfft(force)
    power = np.abs(spectrum) ** 2
    level = scipy.ndimage.uniform_filter1d(power, max(power.size // AVERAGED, AVERAGED // 4))
    top = np.flatnonzero(level > STANDS_OUT * np.quantile(level, FLOOR))
    beyond = int(BEYOND * top[-1]) if top.size else power.size
    if power[beyond:].sum() <= QUIET * power.sum():
        return force
    spectrum[beyond:] = 0
    return np.fft.irfft(spectrum, force.size)


def _runs(times: FloatArray) -> list[tuple[int, int]]:
    if times.size < 3:
        return []
    step = np.abs(np.diff(np.log(np.diff(times))))
    # A distance that fits neither to the one before nor to the one after belongs to no run.
    breaks = np.flatnonzero(step > np.log(LARGEST_STEP)) + 1
    edges = [0, *breaks.tolist(), times.size - 1]
    return [
        (first, last + 1) for first, last in itertools.pairwise(edges) if last - first > LEAST_SWEPT_PERIODS
    ]


def _one_way(times: FloatArray, offset: int) -> list[tuple[int, int]]:
    padded = np.pad(-np.log(np.diff(times)), AT_END // 2, mode="edge")
    level = np.median(np.lib.stride_tricks.sliding_window_view(padded, AT_END), axis=1)
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


def _continue(pieces: Sequence[FloatArray]) -> list[list[FloatArray]]:
    """Pieces of crossings of one sweep together: where its force all but vanishes crossings are lost."""
    runs: list[list[FloatArray]] = []
    for piece in pieces:
        # A few crossings near a resonance may belong to nothing, and what comes behind them to the sweep.
        run = next((run for run in reversed(runs) if _goes_on(run, piece)), None)
        if run is None:
            runs.append([piece])
        else:
            run.append(piece)
    ends = [(run[0][0], run[-1][-1]) for run in runs]
    return [
        run
        for run, (start, stop) in zip(runs, ends, strict=True)
        if not any(first < start and stop < last for first, last in ends)
    ]


def _goes_on(run: Sequence[FloatArray], piece: FloatArray) -> bool:
    """Whether a piece lies on the law of the run ahead of it, the same way, after a gap shorter than both."""
    (before, low), (after, high) = _course(run), _course([piece])
    further = float(np.median(high[:AT_END]) / np.median(low[-AT_END:]))
    further = further if np.median(low[-AT_END:]) > np.median(low[:AT_END]) else 1 / further
    if further < BACK or piece[0] - run[-1][-1] > np.ptp(before) + np.ptp(piece):
        return False
    times = np.concatenate([before, after])
    for there, back in LAWS.values():
        line = np.polyfit(times, there(np.concatenate([low, high])), 1)
        curves = ((before, low), (after, high))
        if all(np.median(np.abs(back(np.polyval(line, t)) / f - 1)) < OFF_LAW for t, f in curves):
            return True
    return False


def _course(run: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    middle = np.concatenate([(times[1:] + times[:-1]) / 2 for times in run])
    return middle, np.concatenate([1 / np.diff(times) for times in run])


def _extend(sweep: FoundSweep, force: FloatArray, edge: int, sign: int) -> FoundSweep:
    """The sweep towards *edge* [samples] in steps of some periods, after it (*sign* 1) or before it (-1)."""
    end, frequency = (sweep.stop, sweep.last) if sign > 0 else (sweep.start, sweep.first)
    rises = (1.0 if sweep.last > sweep.first else -1.0) * sign
    while True:
        width = int(REACH_PERIODS / frequency)
        growth = sweep.growth * width
        further = frequency + rises * growth if sweep.law == "linear" else frequency * np.exp(rises * growth)
        window = force[end : end + width] if sign > 0 else force[end - width : end]
        inside = (edge - end) * sign >= width and 0 < further < 0.5
        if not inside or not _follows(window, frequency, further, sweep.level):
            break
        end, frequency = end + sign * width, further
    if sign > 0:
        return replace(sweep, stop=end, last=frequency)
    return replace(sweep, start=end, first=frequency)


def _follows(window: FloatArray, low: float, high: float, level: float) -> bool:
    """Whether a *window* has its power between two frequencies, and more than noise beside the *level*."""
    power = np.abs(np.fft.rfft(window * np.hanning(window.size))) ** 2
    frequency = np.fft.rfftfreq(window.size)
    near = (frequency > min(low, high) / REACH_SPAN) & (frequency < max(low, high) * REACH_SPAN)
    return bool(
        power[near].sum() > REACH_SHARE * power.sum() and np.sqrt(np.mean(window**2)) > LEAST_LEVEL * level
    )


def _sweep(force: FloatArray, run: Sequence[FloatArray]) -> FoundSweep:
    times = np.concatenate(run)
    middle, frequency = _course(run)
    lines = {law: np.polyfit(middle, there(frequency), 1) for law, (there, _) in LAWS.items()}
    curves = {law: LAWS[law][1](np.polyval(line, middle)) for law, line in lines.items()}
    law = min(curves, key=lambda name: float(np.std(curves[name] - frequency)))
    first, last = float(np.median(frequency[:AT_END])), float(np.median(frequency[-AT_END:]))
    start, stop = int(times[0]), int(np.ceil(times[-1]))
    level = float(np.sqrt(np.mean(force[start:stop] ** 2)))
    growth, steps = abs(float(lines[law][0])), _stays(frequency, middle, curves[law])
    return FoundSweep(start, stop, first, last, law, growth, level, steps)


def _stays(frequency: FloatArray, middle: FloatArray, law: FloatArray) -> bool:
    """Whether a *frequency* (n,) [periods per sample] at times *middle* (n,) [samples] keeps its value and
    jumps where its *law* (n,) runs. The slope over a few periods, over that of the law: its median is 1 for a
    sweep, 0 for a stepped sine, whatever the noise.
    """
    width = AT_END
    while frequency.size // width >= LEAST_WINDOWS:
        windows = [
            values[: frequency.size // width * width].reshape(-1, width)
            for values in (frequency, middle, law)
        ]
        f, t, expected = (window - window.mean(axis=1, keepdims=True) for window in windows)
        ratio = np.sum(f * t, axis=1) / np.sum(expected * t, axis=1)
        centre = float(np.median(ratio))
        error = 1.4826 * 1.2533 * float(np.median(np.abs(ratio - centre))) / np.sqrt(ratio.size)
        if centre + 3 * error < STEPPED:
            return True
        width *= 2
    return False


def loudest_sweeps(sweeps: Sequence[Sequence[FoundSweep]]) -> list[FoundSweep]:
    """Of the *sweeps* of each force of a recording, by time: where several forces have one at the same time,
    that of the loudest.
    """
    ranked = sorted((sweep for members in sweeps for sweep in members), key=lambda sweep: -sweep.level)
    chosen: list[FoundSweep] = []
    for sweep in ranked:
        if all(
            min(sweep.stop, other.stop) - max(sweep.start, other.start) < 0.5 * (sweep.stop - sweep.start)
            for other in chosen
        ):
            chosen.append(sweep)
    return sorted(chosen, key=lambda sweep: sweep.start)


def cuts(sweeps: list[FoundSweep], n_sample: int) -> list[tuple[int, int]]:
    """Ranges (start, stop) [samples] of a record of *n_sample*: every sweep with all that follows up to the
    next one.
    """
    ends = [0, *(sweep.stop for sweep in sweeps)]
    starts = []
    for sweep, before in zip(sweeps, ends, strict=False):
        margin = max(MARGIN / sweep.first, MARGIN_SHARE * (sweep.stop - sweep.start))
        early = sweep.start - int(np.ceil(margin))
        # Without a pause the cut lies between the last crossing of one sweep and the first of the next.
        starts.append(max(early, 0 if before == 0 else (before + sweep.start + 1) // 2))
    return list(zip(starts, [*starts[1:], n_sample], strict=True))


# Lines in the half-power width that show a resonance at all; those that tell its leakage from its response:
# with half as many the damping was off by up to half its standard error.
FEWEST_LINES, LEAKING_LINES = 4.0, 8.0
# Coherence, the median of so many lines to either side, below which the highest line of an FRF is not a peak.
CLEAR_PEAK, CLEAR_LINES = 0.98, 5


def largest_rate(frequency: float, damping_ratio: float) -> float:
    """Sweep rate [Hz/s] up to which a resonance at *frequency* [Hz] reaches its steady amplitude: 216 f_n^2
    zeta^2 Hz/min. ISO 7626-2 for a linear sweep, as in Ewins, Modal Testing, sec. 3.7; its 310 f_n zeta^2
    octaves/min of a logarithmic sweep are the same rate at f_n. Equation (frf-sweep-rate).
    """
    return 216.0 / 60 * frequency**2 * damping_ratio**2


def rate_findings(
    frequency: FloatArray,
    matrix: ComplexArray,
    sweeps: Sequence[FoundSweep],
    rate: float,
    n_sample: int,
    coherence: FloatArray,
    *,
    leaking: bool,
) -> tuple[Finding, ...]:
    """The highest resonance of each FRF that is swept faster than ISO 7626-2 allows: the one that is most so.
    A note where the record holds all that rings; a warning where the lines are too coarse for the resonance,
    or, when *leaking*, for its leakage. frequency (n_line,) [Hz], matrix (n_line, n_output, n_input) [any
    unit]; *rate* of sampling [Hz]; *n_sample* of a block; *coherence* (n_line, n_output) [1]: a peak of noise
    is none.
    """
    peaks = _peaks(frequency, matrix, coherence)
    if not peaks:
        return ()
    allowed = [largest_rate(p.frequency, p.damping_ratio) for p in peaks]
    fastest = [max(sweep.rate_at(p.frequency / rate) * rate**2 for sweep in sweeps) for p in peaks]
    excess = np.array(fastest) / allowed
    worst = int(np.argmax(excess))
    peak = peaks[worst]
    if excess[worst] <= 1:
        return ()
    width = peak.high - peak.low
    lines, enough = width * n_sample / rate, LEAKING_LINES if leaking else FEWEST_LINES
    message = (
        f"the resonance at {peak.frequency:.4g} Hz, {width:.3g} Hz wide (half power), is swept at "
        f"{fastest[worst]:.3g} Hz/s, {excess[worst]:.3g} times the rate of ISO 7626-2 "
        f"({allowed[worst]:.3g} Hz/s): it does not reach its steady amplitude"
    )
    if lines >= enough:
        why = "ringing that the record lacks is estimated" if leaking else "record holds all that rings"
        return (note("sweep-rate", f"{message}; the FRF does not suffer, since the {why}"),)
    needed = (
        f"{lines:.2g} lines in its width are too few, {enough:.3g} would do: sweep slower, or record "
        "until the response is at rest"
    )
    return (Finding("sweep-rate", f"{message}; {needed}"),)


def _peaks(frequency: FloatArray, matrix: ComplexArray, coherence: FloatArray) -> list[HalfPower]:
    peaks = []
    band = float(frequency[0]), float(frequency[-1])
    for output, explained in enumerate(coherence.T):
        for column in matrix[:, output].T:
            peak = int(np.argmax(np.abs(column)))
            if np.median(explained[max(peak - CLEAR_LINES, 0) : peak + CLEAR_LINES + 1]) < CLEAR_PEAK:
                continue
            try:
                peaks.append(half_power(frequency, column, band))
            except (DataError, np.linalg.LinAlgError):
                continue
    return [peak for peak in peaks if peak.damping_ratio > 0]
