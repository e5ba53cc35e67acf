"""Periodic excitation: average of whole periods line by line, noise from the scatter between periods, and
whether motion has died away when the first of them begins.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError, DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.channels import columns_of

# Level of the F-test by which a line's noise exceeds that of its neighbours, as at the speed of a shaft.
OUTLIER_LEVEL = 1e-3
# Standard deviation of a line as a share of the channel's strongest line below which it is rounding.
ROUNDING = 1e-12
# Lines to either side over which noise is averaged that a creeping rest position is compared with.
SEEN_BESIDE = 5


@dataclass(frozen=True)
class LineSpectrum:
    """Fourier amplitudes X = 2/N sum x exp(-j w t) of all channels averaged over periods, with their noise.
    frequency (n_line,) [Hz]; mean (n_line, n_channel) [unit of the channel]; noise (n_line, n_channel,
    n_channel): covariance E[e e^H] of the mean, None with a single period; line_dof (n_line,): complex
    degrees of freedom of each line of the noise.
    """

    frequency: FloatArray
    mean: ComplexArray
    noise: ComplexArray | None
    n_period: int
    line_dof: FloatArray

    @property
    def dof(self) -> float:
        """Complex degrees of freedom of the lines together: 1 / mean(1 / nu_k), since what weights that are
        estimated cost goes with 1 / nu_k.
        """
        return float(1 / np.mean(1 / self.line_dof)) if self.line_dof.size else 0.0

    def select(self, lines: BoolArray) -> LineSpectrum:
        """The spectrum at the lines of the mask *lines* (n_line,). Mean and noise keep their units [unit of
        the channel].
        """
        noise = None if self.noise is None else self.noise[lines]
        return LineSpectrum(
            self.frequency[lines], self.mean[lines], noise, self.n_period, self.line_dof[lines]
        )


# Most periods that are taken as one where they hold a whole number of samples together.
MOST_TOGETHER = 20


def samples_per_period(period: float, sample_rate: float) -> int:
    """Samples in a period [s]; ConfigError unless their number is whole."""
    exact = period * sample_rate
    n_sample = round(exact)
    if n_sample < 2 or abs(exact - n_sample) > 1e-6 * exact:
        whole = (n for n in range(2, MOST_TOGETHER + 1) if abs(n * exact - round(n * exact)) <= 1e-6 * exact)
        together = next(whole, 0) if n_sample >= 2 else 0
        hint = f"the nearest period that does is {max(n_sample, 2) / sample_rate:.9g} s"
        if together:
            hint = f"{together} of them do: period: {together * period:.9g} s"
        what = f"a period of {period:g} s holds {exact:.6g} samples at {sample_rate:g} Hz, not a whole number"
        raise ConfigError(what, hint=hint)
    return n_sample


@dataclass(frozen=True)
class RestMotion:
    """How the rest position creeps over the periods: its rise *slope* and its bend per period and period
    squared, (n_period, n_channel) [unit of the channel]; both are zero for channels that do not creep.
    """

    slope: FloatArray
    bend: FloatArray

    @classmethod
    def of(cls, levels: FloatArray) -> RestMotion:
        """From the means of two periods or more, *levels* (n_period, n_channel) [unit of the channel]. The
        parabola through the means of a period and of its neighbours; before the second and after the last
        but one that of their neighbour. Equation (spec-creep).
        """
        if len(levels) == 2:
            slope = np.repeat(np.diff(levels, axis=0), 2, axis=0)
            return cls(slope, np.zeros_like(slope))
        slope = np.pad((levels[2:] - levels[:-2]) / 2, ((1, 1), (0, 0)), mode="edge")
        bend = np.pad(np.diff(levels, 2, axis=0) / 2, ((1, 1), (0, 0)), mode="edge")
        slope[0] -= 2 * bend[0]
        slope[-1] += 2 * bend[-1]
        return cls(slope, bend)

    def within(self, number: int, n_sample: int) -> FloatArray:
        """Its course less its mean in period *number*, (n_sample, n_channel) [unit of the channel]."""
        time = (np.arange(n_sample)[:, None] - (n_sample - 1) / 2) / n_sample
        course: FloatArray = self.slope[number] * time + self.bend[number] * (time**2 - np.mean(time**2))
        return course

    def find_seen(self, spectrum: LineSpectrum, n_sample: int, numbers: IntArray) -> BoolArray:
        """Channels (n_channel,) with a line on which it shifts the mean by more than its standard
        deviation, or a single period by more than that of a period (twice that of two periods, which tell
        it poorly). *numbers* (n_line,) of the spectrum's lines in a period of *n_sample*.
        """
        if spectrum.noise is None:
            return np.zeros(self.slope.shape[1], bool)
        every = np.ones(spectrum.frequency.size, bool)
        power = neighbourhood_mean(np.einsum("fii->fi", spectrum.noise).real, every, SEEN_BESIDE)
        sawtooth = 1 / (n_sample * np.sin(np.pi * numbers / n_sample))[:, None]
        steady = np.abs(self.slope.mean(axis=0)) * sawtooth
        single = np.sqrt(np.mean(self.slope**2, axis=0)) * sawtooth
        rounding = ROUNDING * np.max(np.abs(spectrum.mean), axis=0, initial=0.0)
        size = np.sqrt(power) * (1 + 1 / (spectrum.n_period - 1))
        over = (steady > size) | (single > np.sqrt(spectrum.n_period) * size)
        return np.any(over & (single > rounding), axis=0)


# A rig that starts from rest answers with its steady motion less a free one. The squares of the differences
# of neighbouring periods then fall exponentially to the level of noise; in groups of lines, since free motion
# stands on a few, beside a resonance.

# A jump: the square of a difference over the usual one, and over the signal's.
FAR_BEYOND, LEAST_JUMP = 100.0, 1e-3
# Groups of lines, the least lines of one, and the differences from which on something can be told.
GROUPS, GROUP_LINES, FEWEST = 16, 4, 4
# Chance of a finding on a sound record, and degrees of freedom of the expected scatter beside what is seen.
CHANCE, EXPECTED_DOF = 1e-4, 4.0
# Logarithm by which squares that fall evenly must do so in all: less is slow noise.
LEAST_FALL = 3.0
# Free motion below this share of the signal's power is of no account.
NEGLIGIBLE = 1e-10
# What is left in the mean of all periods, in power, over that of its noise, once enough periods are skipped.
SETTLED = 0.01


class Differences:
    """Squares of the differences of neighbouring periods by groups of lines and channels, fed period by
    period.
    """

    def __init__(self, n_line: int) -> None:
        self.starts = np.unique(
            np.linspace(0, n_line, max(min(GROUPS, n_line // GROUP_LINES), 1), endpoint=False).astype(int)
        )
        self._sizes = np.diff(np.append(self.starts, n_line))
        self._before: ComplexArray | None = None
        self._signal: FloatArray = np.zeros(0)
        self._squares: list[FloatArray] = []

    def add(self, amplitude: ComplexArray) -> None:
        """Add the spectrum (n_line, n_channel) [unit of the channel] of the next period."""
        if self._before is None:
            self._signal = self._by_group(amplitude)
        else:
            self._squares.append(self._by_group(amplitude - self._before))
        self._before = amplitude

    def _by_group(self, amplitude: ComplexArray) -> FloatArray:
        return np.add.reduceat(np.abs(amplitude) ** 2, self.starts, axis=0)

    def further(self, columns: Sequence[int]) -> dict[int, tuple[int, float]]:
        """Of the channels *columns* that have not settled: how many more periods to skip, and the decay of
        the motion per period [1]. By logarithms of the squares, against Student's t: the first one over the
        later half, and their slope. Equation (spec-settling).
        """
        if len(self._squares) < FEWEST or not columns:
            return {}
        squares = np.array(self._squares)[:, :, columns]
        tiny = np.maximum(NEGLIGIBLE * self._signal[:, columns], np.finfo(float).tiny)
        logs = np.log(np.maximum(squares, tiny))
        unsettled: dict[int, tuple[int, float]] = {}
        for group, number in zip(*np.nonzero(self._falling(logs) & (squares[0] > tiny)), strict=True):
            course = np.exp(logs[:, group, number])
            half = len(course) - len(course) // 2
            level = float(np.exp(logs[half:, group, number].mean()))
            above = np.maximum(course[:half] - level, 0.0)
            # The sum of a geometric series without its first term, over all of it.
            decay = float(np.clip(above[1:].sum() / above.sum(), 1e-6, 0.99))
            noise = float(course.min()) / self._sizes[group]
            more = int(np.ceil(np.log(above[0] / (noise * SETTLED) * len(course)) / -np.log(decay)))
            unsettled[columns[number]] = max(
                unsettled.get(columns[number], (0, 0.0)), (max(more, 1), float(np.sqrt(decay)))
            )
        return unsettled

    def jumps(self) -> dict[int, tuple[int, float]]:
        """Channels whose periods change at once: the number of the period there after the transient ones, and
        by what share of the signal [1].
        """
        if len(self._squares) < FEWEST:
            return {}
        squares, signal = np.sum(self._squares, axis=1), self._signal.sum(axis=0)
        far = np.maximum(FAR_BEYOND * np.median(squares, axis=0), LEAST_JUMP * signal)
        largest = np.argmax(squares, axis=0)
        return {
            int(n): (int(largest[n]) + 1, float(np.sqrt(squares[largest[n], n] / signal[n])))
            for n in np.flatnonzero((squares.max(axis=0) > far) & (signal > 0))
        }

    def _falling(self, logs: FloatArray) -> BoolArray:
        """Whether the first of *logs* (n_difference, n_group, n_channel) is far above others, or all fall."""
        n, half = len(logs), len(logs) - len(logs) // 2
        scatter = EXPECTED_DOF / self._sizes[:, None]
        late = logs[half:]
        dof = n - half - 1 + EXPECTED_DOF
        spread = (np.sum((late - late.mean(axis=0)) ** 2, axis=0) + scatter) / dof
        first = (logs[0] - late.mean(axis=0)) / np.sqrt(spread * (1 + 1 / len(late))) > -special.stdtrit(
            dof, CHANCE / logs[0].size
        )
        time = np.arange(n) - (n - 1) / 2
        slope = np.tensordot(time, logs, 1) / np.sum(time**2)
        rest = logs - logs.mean(axis=0) - time[:, None, None] * slope
        dof = n - 2 + EXPECTED_DOF
        spread = (np.sum(rest**2, axis=0) + scatter) / dof
        even = -slope * np.sqrt(np.sum(time**2) / spread) > -special.stdtrit(dof, CHANCE / logs[0].size)
        falls = first | (even & (-slope * n > LEAST_FALL))
        return falls & np.all(logs[0] > logs[1:half], axis=0)


def is_unsettled(findings: Iterable[Finding]) -> bool:
    """Whether motion had not died away, so that the scatter of the periods is not noise."""
    return any(finding.code == "not-settled" for finding in findings)


def settling_finding(
    differences: Differences, channels: Sequence[Channel], name: str, skip: int
) -> tuple[Finding, ...]:
    """A warning where the responses of the recording *name* have not settled after *skip* periods."""
    further = differences.further(columns_of(channels, "output"))
    if not further:
        return ()
    more, decay = max(further.values())
    names = ", ".join(channels[number].name for number in further)
    what = (
        f"recording '{name}': the motion of {names} has not died away after `skip: {skip}`: the first "
        f"periods approach the rest of them exponentially, by a factor of {decay:.2g} per period. Damping "
        f"above all is off by more than its errors: `skip: {skip + more}`, or let the force run that much "
        "longer before the record begins"
    )
    return (Finding("not-settled", what),)


def jump_finding(average: PeriodAverage, source: SampleSource, skip: int) -> tuple[Finding, ...]:
    """A warning where periods of the recording *source* change at once after *skip* transient ones."""
    channels, jumps = source.channels, average.differences.jumps()
    if not jumps:
        return ()
    column = max(jumps, key=lambda number: jumps[number][1])
    number, share = jumps[column]
    names = ", ".join(channels[number].name for number in jumps)
    cause = "a connector, a range that cuts off, or a knock"
    if any(channels[number].role == "input" for number in jumps):
        cause = "samples were lost, or what drives the force began anew"
    what = (
        f"recording '{source.name}': the periods of {names} change at once near "
        f"{(skip + number) * average.n_sample / source.sample_rate:.4g} s, {channels[column].name} by "
        f"{share:.2g} times its signal: {cause}. The mean is over what was before and after; evaluate "
        "these parts as recordings of their own: `{file: ..., start: ..., end: ...}`"
    )
    return (Finding("jump", what),)


# Periods that are added to the lines of the whole record together.
TOGETHER = 16
# Lines of the whole record to either side of one of a period that are compared with the scatter, the least
# periods for it, and the chance by which a channel of independent periods fails.
NEAREST, LEAST_PERIODS, BY_CHANCE = 2, 8, 1e-3
# What a channel's noise has beyond those before it, in power, from which on it is not rounding, and what
# keeps less from being zero.
LEAST_OWN, RIDGE = 1e-9, 1e-12
# Lines to either side whose noise is taken then: of so many between two lines of a period one, and at most.
ONE_OF, MOST_BESIDE = 4, 8


class PeriodCut:
    """Cuts samples that come in blocks into whole periods of *n_sample* samples."""

    def __init__(self, n_sample: int) -> None:
        self._n_sample = n_sample
        self._rest: FloatArray = np.empty((0, 0))

    def periods(self, block: FloatArray) -> Iterator[FloatArray]:
        """The periods (n_sample, n_channel) that the next *block* (n, n_channel) completes [unit of both]."""
        samples = np.concatenate([self._rest, block]) if self._rest.size else block
        n_whole = samples.shape[0] // self._n_sample
        yield from (samples[n * self._n_sample : (n + 1) * self._n_sample] for n in range(n_whole))
        self._rest = samples[n_whole * self._n_sample :].copy()


class PeriodAverage:
    """Running mean and scatter of the Fourier amplitudes over whole periods, fed with blocks of any length.
    Equation (spec-period).
    """

    def __init__(
        self,
        n_sample: int,
        n_channel: int,
        skip: int,
        lines: slice = slice(1, None),
        creep: RestMotion | None = None,
        n_due: int = 0,
        n_beside: int = 0,
    ) -> None:
        """*n_sample* samples per period, *skip* transient periods. *lines* of the DFT, by default all above 0
        Hz; *creep* is subtracted. Of *n_due* periods after the transient ones the noise may be that of
        *n_beside* lines of the whole record to either side.
        """
        self.n_sample, self._cut = n_sample, PeriodCut(n_sample)
        self._lines = lines
        self._line_numbers = np.arange(n_sample // 2 + 1)[lines]
        self._skip = skip
        n_line = self._line_numbers.size
        self._mean = np.zeros((n_line, n_channel), np.complex128)
        self._scatter = np.zeros((n_line, n_channel, n_channel), np.complex128)
        self.differences = Differences(n_line)
        self.n_period = 0
        self._creep = creep
        self._levels: list[FloatArray] = []
        self._n_due, self._n_beside = n_due, n_beside
        n_turn = 2 * (n_beside or (NEAREST if n_due >= LEAST_PERIODS else 0))
        self._beside = np.zeros((n_turn, n_line, n_channel), np.complex128)
        self._waiting = np.empty((TOGETHER * (n_due >= LEAST_PERIODS), n_line, n_channel), np.complex128)

    def add(self, block: FloatArray) -> None:
        """Add the next block (n, n_channel) [unit of the channel]."""
        for period in self._cut.periods(block):
            self._add_period(period)

    def _add_period(self, period: FloatArray) -> None:
        if self._skip > 0:
            self._skip -= 1
            return
        # A slow drift of the mean is not noise of the lines; a large mean would cost digits.
        level = period.mean(axis=0)
        self._levels.append(level)
        whole = period - self._levels[0]
        period = period - level
        if self._creep is not None:
            whole = period = period - self._creep.within(self.n_period, self.n_sample)
        amplitude = fft.rfft(period.T, axis=1)[:, self._lines].T * (2 / self.n_sample)
        if self._n_beside:
            self._add_beside(whole)
        elif len(self._beside):
            self._add_nearest(amplitude)
        self.n_period += 1
        self.differences.add(amplitude)
        before = amplitude - self._mean
        self._mean += before / self.n_period
        after = amplitude - self._mean
        self._scatter += before[:, :, None] * after[:, None, :].conj()

    def _add_nearest(self, amplitude: ComplexArray) -> None:
        """Add the next period's *amplitude* (n_line, n_channel) [unit of the channel], turned by exp(-2 pi j
        m p / P), to the sums of the nearest m, TOGETHER periods at a time.
        """
        number, place = self.n_period, self.n_period % TOGETHER
        self._waiting[place] = amplitude
        if place == TOGETHER - 1 or number == self._n_due - 1:
            numbers = np.arange(number - place, number + 1)
            turns = np.exp(-2j * np.pi / self._n_due * np.outer(_both(NEAREST), numbers))
            self._beside += np.tensordot(turns, self._waiting[: place + 1], 1)

    def _add_beside(self, period: FloatArray) -> None:
        """Add the next *period* (n, n_channel) [unit of the channel] to the lines of the whole record."""
        n = self.n_sample
        time = self.n_period / self._n_due + np.arange(n) / (n * self._n_due)
        for number in range(self._n_beside):
            turned = fft.fft(period.T * np.exp(-2j * np.pi * (number + 1) * time), axis=1).T * (2 / n)
            self._beside[2 * number] += turned[self._line_numbers]
            self._beside[2 * number + 1] += turned[-self._line_numbers].conj()

    def lines_beside(self) -> int:
        """Lines of the whole record to either side of every line that give the noise of the mean better than
        the scatter; 0 where the periods scatter as independent ones do. Slow noise, of a mode that little
        damps or beyond the lines, does not: its parts in neighbouring periods belong together. Equation
        (spec-beside).
        """
        n, near = self.n_period, len(self._beside)
        if n != self._n_due or not near:
            return 0
        size = np.sqrt(np.einsum("laa->la", self._scatter).real)
        rounding = ROUNDING * np.sqrt(n) * np.max(np.abs(self._mean), axis=0, initial=0.0)
        noisy = np.all(size > rounding, axis=0)
        if not np.any(noisy):
            return 0
        # What a channel has beyond those before it: what they share may hide that it is slow.
        size, unit = size[:, noisy], np.eye(int(np.sum(noisy)))
        scatter = self._scatter[:, noisy][:, :, noisy] / (size[:, :, None] * size[:, None, :])
        # A force that is a mass times an acceleration has nothing of its own but rounding.
        ridge = RIDGE + rounding[noisy] / size
        factor = np.linalg.cholesky((scatter if len(unit) < n else unit[None]) + ridge[:, None] * unit)
        beside = (self._beside[..., noisy] / size).transpose(1, 2, 0)
        share = np.sum(np.abs(np.linalg.solve(factor, beside)) ** 2, axis=2) / n
        # Of independent periods the share of so many of n - 1 lines has a beta distribution.
        has_own = np.einsum("laa->la", factor).real ** 2 > LEAST_OWN + 4 * ridge
        excess = np.where(has_own, share - near / (n - 1), 0.0)
        excess *= (n - 1) * np.sqrt(n / (near * (n - 1 - near)))
        # A response that drifts has more there, not less.
        for starts in (np.zeros(1, int), self.differences.starts):
            lines = np.diff(np.append(starts, len(excess)))
            far = np.min(np.add.reduceat(excess, starts) / np.sqrt(lines)[:, None])
            if far < special.ndtri(BY_CHANCE / len(starts)):
                break
        else:
            return 0
        return min(max(NEAREST, n // ONE_OF), MOST_BESIDE)

    def creep(self, spectrum: LineSpectrum) -> RestMotion | None:
        """How the rest position moves, in channels where that is *seen* beside the noise of the *spectrum*;
        None where it is in none.
        """
        if self.n_period < 2:
            return None
        motion = RestMotion.of(np.array(self._levels))
        seen = motion.find_seen(spectrum, self.n_sample, self._line_numbers)
        return RestMotion(motion.slope * seen, motion.bend * seen) if np.any(seen) else None

    def spectrum(self, sample_rate: float) -> LineSpectrum:
        """The averaged lines, their noise by the scatter of the periods or by the lines beside; DataError
        when no period is left after the transient ones. Equation (spec-period-noise).
        """
        n = self.n_period
        if n == 0:
            raise DataError(
                "the recording is too short for one period after the transient ones",
                hint=f"a period is {self.n_sample / sample_rate:g} s; shorten `skip` or `period`, or "
                "record longer",
            )
        frequency = self._line_numbers * (sample_rate / self.n_sample)
        noise, dof = None if n == 1 else self._scatter / (n * (n - 1)), n - 1.0
        if self._n_beside and n == self._n_due:
            beside, dof = self._beside / n, float(len(self._beside))
            noise = beside.transpose(1, 2, 0) @ beside.transpose(1, 0, 2).conj() / dof
        return LineSpectrum(frequency, self._mean.copy(), noise, n, np.full(frequency.size, dof))


def _both(most: int) -> IntArray:
    """1, -1, 2, -2 ... to *most* and its negative."""
    return np.outer(np.arange(1, most + 1), [1, -1]).ravel()


def smoothed_noise(spectrum: LineSpectrum, half_width: int, with_inverse: bool = False) -> LineSpectrum:
    """The spectrum with its noise averaged over neighbouring lines: S_s(k) = mean of S over k-h ... k+h. A
    line whose noise in any channel exceeds that of its neighbours (F-test at 0.1 %) is not averaged; of
    fewer periods than channels its own noise has no inverse, and *with_inverse* what exceeds its
    neighbours' raises theirs. Equation (spec-smoothed-noise).
    """
    if spectrum.noise is None or half_width == 0:
        return spectrum
    power = np.einsum("fii->fi", spectrum.noise).real
    # What rounding leaves of a signal that repeats to the last digit goes with the signal.
    size = np.max(np.abs(spectrum.mean), axis=0, initial=0.0)
    power = np.where(power > (ROUNDING * size) ** 2, power, 0.0)
    broadband = _broadband_lines(power, float(np.min(spectrum.line_dof)), half_width)
    smooth = neighbourhood_mean(spectrum.noise, broadband, half_width)
    noise_of_line = spectrum.noise
    without_inverse = with_inverse and np.min(spectrum.line_dof) < noise_of_line.shape[-1]
    if without_inverse:
        power, around = (np.einsum("fii->fi", noise).real for noise in (noise_of_line, smooth))
        raised = np.sqrt(np.maximum(np.divide(power, around, out=np.ones_like(power), where=around > 0), 1))
        noise_of_line = np.where(
            np.all((around > 0) | (power == 0), axis=1)[:, None, None],
            smooth * raised[:, :, None] * raised[:, None],
            noise_of_line,
        )
    noise = np.where(broadband[:, None, None], smooth, noise_of_line)
    count = _neighbourhood_count(broadband, half_width, centre=True)
    line_dof = spectrum.line_dof * np.where(broadband | without_inverse, count, 1.0)
    return LineSpectrum(spectrum.frequency, spectrum.mean, noise, spectrum.n_period, line_dof)


def _broadband_lines(power: FloatArray, dof: float, half_width: int) -> BoolArray:
    """Lines with the noise of their neighbours, by F-tests without outliers, which hide weaker ones."""
    broadband = np.ones(power.shape[0], bool)
    while True:
        neighbours = neighbourhood_mean(power, broadband, half_width, centre=False)
        count = _neighbourhood_count(broadband, half_width, centre=False)
        limit = special.fdtri(2 * dof, 2 * dof * count, 1 - OUTLIER_LEVEL)
        # A line without remaining neighbours cannot be tested.
        outliers = np.any((power > limit[:, None] * neighbours) & (neighbours > 0), axis=1) & broadband
        if not np.any(outliers):
            return broadband
        broadband &= ~outliers


def _neighbourhood_sum(values: NDArray[Any], half_width: int, centre: bool) -> NDArray[Any]:
    """Sum over k-h ... k+h, term by term: running sums would lose small noise behind one huge line."""
    total = values.copy() if centre else np.zeros_like(values)
    for shift in range(1, min(half_width, values.shape[0] - 1) + 1):
        total[shift:] += values[:-shift]
        total[:-shift] += values[shift:]
    return total


def _neighbourhood_count(chosen: BoolArray, half_width: int, centre: bool) -> FloatArray:
    return np.maximum(_neighbourhood_sum(chosen.astype(np.float64), half_width, centre), 1)


def neighbourhood_mean(
    values: NDArray[Any], chosen: BoolArray, half_width: int, centre: bool = True
) -> NDArray[Any]:
    """Mean of *values* (n_line, ...) [any unit] over the *chosen* lines (n_line,) k-h ... k+h, with or
    without line k itself.
    """
    shape = (-1,) + (1,) * (values.ndim - 1)
    total = _neighbourhood_sum(np.where(chosen.reshape(shape), values, 0), half_width, centre)
    mean: NDArray[Any] = total / _neighbourhood_count(chosen, half_width, centre).reshape(shape)
    return mean


# Shares of a force's noise, and of its strongest line, above which it acts.
ABOVE_NOISE, FLOOR = 5.0, 1e-3


def excited_lines(spectrum: LineSpectrum, inputs: list[int]) -> BoolArray:
    """Lines (n_line,) at which a force acts. With smoothed noise an empty line passes with probability
    exp(-25). Equation (spec-excited).
    """
    force = np.abs(spectrum.mean[:, inputs])
    excited = force > FLOOR * np.max(force, axis=0)
    if spectrum.noise is not None:
        std = np.sqrt(np.einsum("fii->fi", spectrum.noise).real[:, inputs])
        excited &= force > ABOVE_NOISE * std
    return np.any(excited, axis=1)
