"""Recordings of hammer hits -> FRF matrix averaged over the good hits, with coherence and covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import Blocks, FactoredCovariance, variance_of
from labpipe.records.uncertain import MatrixError, Uncertainty
from labpipe.spectra import damping, windows
from labpipe.spectra.bands import block_samples, line_range
from labpipe.spectra.channels import READ_SAMPLES, checked_blocks, columns_of
from labpipe.spectra.covariance import correct_covariance
from labpipe.spectra.ports import Layout, Parts, left_out, parts_at_lines, select_lines
from labpipe.spectra.random import parts_of_spectra
from labpipe.spectra.settings import FrfSettings, ImpactSettings
from labpipe.spectra.synchronous import ToneSearch, steady_tone
from labpipe.spectra.welch import CrossSpectra

# Equal consecutive samples at the end of the range that count as an overload of the converter.
CLIPPED_RUN = 3
# Share of the double-hit level below which the contact has ended.
ENDED = 0.5
# Samples before a hit that tell the offset of its block.
LEAST_BEFORE = 4


@dataclass(frozen=True)
class Hit:
    """One hit: *start* of its block [samples from the recording's start], samples (n_sample, n_channel)
    without offset [SI]. *trigger*: sample of the block at which the force rises; *fault*: reason for
    rejection, empty for an accepted hit.
    """

    number: int
    start: int
    trigger: int
    samples: FloatArray
    fault: str = ""


class HitSearch:
    """Blocks of *n_sample* samples with a hit, in a recording of *n_channel* channels as it comes: a hit
    begins where |force| in column *force* rises, its block *before* samples earlier, at sample *latest* at
    the latest.
    """

    def __init__(
        self, force: int, n_sample: int, before: int, n_channel: int, latest: float = np.inf
    ) -> None:
        self._force, self._n_sample, self._before, self._latest = force, n_sample, before, latest
        # *window* begins at sample *_begin*; the search for triggers goes on at sample *_search*.
        self.window = np.empty((0, n_channel))
        self._begin = self._search = 0

    def add(self, block: FloatArray) -> None:
        """The next samples (n, n_channel) [SI]."""
        self.window = np.concatenate([self.window, block])

    def restart(self) -> None:
        """The samples that follow belong to another recording: a block that is not complete is lost."""
        self._search = self._begin = self._begin + self.window.shape[0]
        self.window = self.window[:0]

    def hits(self, zero: float, level: Callable[[], float]) -> Iterator[tuple[int, int, FloatArray]]:
        """First sample, trigger within the block and samples (n_sample, n_channel) [SI] of every block that
        is complete; its force differs from *zero* [N] by the *level* [N] that holds at this moment.
        """
        while True:
            force = self.window[self._search - self._begin :, self._force]
            above = np.flatnonzero(np.abs(force - zero) >= level())
            if not above.size:
                self._search = self._begin + self.window.shape[0]
                break
            trigger = self._search + int(above[0])
            start = int(min(max(trigger - self._before, self._begin), self._latest))
            first = start - self._begin
            if first + self._n_sample > self.window.shape[0]:
                self._search = trigger
                break
            yield start, trigger - start, self.window[first : first + self._n_sample]
            self._search = start + self._n_sample
        last = min(self._search - self._before, self._latest, self._begin + self.window.shape[0])
        keep = int(max(last, self._begin))
        self.window, self._begin = self.window[keep - self._begin :], keep


def find_hits(
    source: SampleSource, force: int, n_sample: int, settings: ImpactSettings, first_number: int = 1
) -> Iterator[Hit]:
    """The hits of a recording in order of time, accepted or rejected; *force* is the hammer's column,
    *n_sample* the block length. A hit begins where |force| exceeds the trigger, a share of the largest
    force in the recording, both relative to the zero level (the median of the first block); its block
    begins earlier by the pretrigger, or where the recording begins if it holds one block only, as an
    analyser stores it. DataError for a sample that is not a number or a force that does not vary.
    """
    rest = np.median(next(iter(source.blocks(READ_SAMPLES))), axis=0)
    level = settings.trigger * max(
        float(np.max(np.abs(block[:, force] - rest[force]))) for block in checked_blocks(source)
    )
    before = round(settings.pretrigger * n_sample)
    latest = source.n_sample - n_sample if source.n_sample - n_sample <= before else source.n_sample
    search, number = HitSearch(force, n_sample, before, len(source.channels), latest), first_number
    for block in checked_blocks(source):
        search.add(block)
        for start, trigger, samples in search.hits(rest[force], lambda: level):
            yield judged_hit(number, start, samples, trigger, source.channels, settings, rest)
            number += 1


def judged_hit(
    number: int,
    start: int,
    raw: FloatArray,
    trigger: int,
    channels: Sequence[Channel],
    settings: ImpactSettings,
    rest: FloatArray,
) -> Hit:
    """The hit in a block of samples *raw* (n_sample, n_channel) [SI], with the reason to leave it out.
    *trigger*: sample at which the force rises; what comes before tells the offset, or, of less than
    LEAST_BEFORE samples, the levels *rest* (n_channel,) of the recording.
    """
    samples = raw - (np.median(raw[:trigger], axis=0) if trigger >= LEAST_BEFORE else rest)
    force = columns_of(channels, "input")[0]
    members = {term.channel for channel in channels if channel.role != "reference" for term in channel.terms}
    # A tacho stands at both ends of its range, and no FRF is made of it.
    measured = [channel.role != "reference" or channel.name in members for channel in channels]
    clipped = np.flatnonzero(find_overloaded(samples) & measured)
    fault = ""
    if number in settings.reject:
        fault = "left out by hand"
    elif clipped.size:
        fault = f"overload of channel '{channels[clipped[0]].name}'"
    elif is_double(samples[:, force], settings.double_hit):
        fault = "double hit"
    return Hit(number, start, trigger, samples, fault)


def find_overloaded(samples: FloatArray) -> BoolArray:
    """Channels (n_channel,) of samples (n_sample, n_channel) [SI] with several equal consecutive samples at
    the largest or smallest value. Only values beyond half the peak count, so that the zero level is no
    overload.
    """
    peak = np.max(np.abs(samples), axis=0)
    clipped = np.zeros(samples.shape[1], bool)
    for end in (samples.max(axis=0), samples.min(axis=0)):
        at_end = (samples == end) & (np.abs(end) > peak / 2)
        run = np.lib.stride_tricks.sliding_window_view(at_end, CLIPPED_RUN, axis=0).all(axis=2)
        clipped |= run.any(axis=0)
    return clipped


def is_double(force: FloatArray, share: float) -> bool:
    """True for a double hit: |force| (n_sample,) [N] falls below half of *share* of its peak and rises above
    *share* again.
    """
    size = np.abs(force) / np.max(np.abs(force))
    above = np.flatnonzero(size >= share)
    gaps = np.flatnonzero(np.diff(above) > 1)
    return any(size[above[gap] : above[gap + 1]].min() < ENDED * share for gap in gaps)


def noise_power(hit: Hit, force: int, lines: slice) -> FloatArray:
    """|X|^2 per sample (n_line,) [SI^2] of the force's noise at these *lines*, by the second half of what
    follows the hit, under a Hann window, which keeps hum in its lines.
    """
    n_sample = len(hit.samples)
    rest = hit.samples[(n_sample + hit.trigger) // 2 :, force]
    at = np.arange(lines.start, lines.stop) * rest.size // n_sample
    window = np.hanning(rest.size)
    return np.asarray(np.abs(scipy.fft.rfft(window * (rest - np.mean(rest)))[at]) ** 2 / np.sum(window**2))


def check_single_force(source: SampleSource) -> int:
    """The column of the hammer; DataError when the recording has not exactly one force."""
    forces = columns_of(source.channels, "input")
    if len(forces) != 1:
        names = ", ".join(source.channels[number].name for number in forces)
        what = f"recording '{source.name}' of hits has {len(forces)} forces ({names})"
        raise DataError(what, hint="one hammer per recording")
    return forces[0]


WINDOW = "give `impact: {force_window: ...}`"
TAKEN_OFF = "that is taken off, as far as the noise is steady"
AFTER_HITS, IN_WINDOW = "after its hits makes H low by", "within its window moves H by"
SHORTEN = "shorten `force_window` to a little more than the contact"
COUNTED = f"intervals count that; {SHORTEN}"
# Standard errors of a gain common to all lines by which noise of the force may move it without a word.
MOST_COMMON = 0.5
# Lines to either side over which noise of the force is alike, the largest share of it that is taken off, and
# the least part of the noise of H that is that of the responses.
AROUND, MOST_NOISE, LEAST_PART = 16, 0.9, 1e-6
# Relative standard deviation of an FRF below which its scatter is rounding.
ROUNDING = 1e-10
# The response has decayed when the rms of its last tenth is below this share of that of its largest tenth.
DIED_AWAY = 0.05
# Share of the largest tenth from which the last one, less the noise, is what a block cuts off.
FAINT = 1e-4
# Power at the end over that before the first hit, of some twenty samples, up to which it is noise.
AS_NOISE = 2.5
# Share at which the advised block ends, and the fall of ln(rms) within a block that tells its length.
AT_REST, SEEN_TO_FALL = 5e-4, 0.2


def impact_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF averaged over all accepted hits of the recordings; DataError when a recording has none."""
    averages: list[_HitAverage] = []
    number = 1
    for source in sources:
        average = _HitAverage(source, settings)
        for hit in find_hits(source, average.force, average.n_sample, settings.impact, number):
            average.add(hit)
            number = hit.number + 1
        averages.append(average)
    findings = [finding for average in averages for finding in average.findings]
    why = "it holds no hit whose block is complete"
    pairs = zip(sources, averages, strict=True)
    findings += [left_out(source, why) for source, average in pairs if not average.n_found]
    averages, layout = _with_hits(averages, layout)
    raw = _average(averages, settings, layout)
    findings += [finding for average in averages for finding in average.end_findings()]
    parts, chosen = _on_lines(raw, averages, settings, layout), select_lines(raw.frequency, settings)
    errors = [error[chosen] for error in _force_errors(averages, layout, settings.impact)]
    if settings.impact.force_window is not None:
        parts = _with_window_noise(parts, raw, averages, settings, layout, errors)
    # The power of the force is in no product of H2.
    elif settings.estimator != "H2":
        low = settings.estimator == "H1"
        parts = without_force_noise(parts, errors, layout, AFTER_HITS, WINDOW, taken_off=low)
    length, after = averages[0].n_sample / sources[0].sample_rate, max(hits.after_hit() for hits in averages)
    blocks = Blocks(length, "boxcar", 0.0, 1, settings.estimator, after_hit=after) if after else None
    return replace(parts, blocks=blocks, findings=(*findings, *parts.findings))


def _with_window_noise(
    parts: Parts,
    raw: Parts,
    averages: Sequence[_HitAverage],
    settings: FrfSettings,
    layout: Layout,
    errors: Sequence[FloatArray],
) -> Parts:
    """The parts where noise of a force within its window, by its *errors* as in without_force_noise, moves H:
    the hits aligned, and what their mean noise may be as errors that lines have in common. *raw*: at all
    lines, before the damping of a window is taken out.
    """
    courses = force_courses(averages, layout)
    hint = COUNTED if courses else SHORTEN
    named = without_force_noise(parts, errors, layout, IN_WINDOW, hint, taken_off=False)
    if len(named.findings) == len(parts.findings) or not courses:
        return named
    ports = zip(averages, layout.acting, layout.output_columns, strict=True)
    of_hits = [average.align(raw, force, outputs) for average, force, outputs in ports]
    aligned = _average(of_hits, settings, layout)
    raw = replace(raw, matrix=aligned.matrix, covariance=aligned.covariance)
    parts, chosen = _on_lines(raw, averages, settings, layout), select_lines(raw.frequency, settings)
    common, names = [], ", ".join(average.name for average in averages)
    for force, course in courses.items():
        for number, column in enumerate(course[chosen].T, 1):
            change = np.zeros_like(parts.matrix)
            change[:, :, force] = parts.matrix[:, :, force] * column[:, None]
            source = f"noise of the force {layout.inputs[force].label} in its window, {names}, {number}"
            common.append(MatrixError(Uncertainty(source, 1.0, "1"), change, by_repeat=True))
    return replace(parts, errors=tuple(common), findings=named.findings)


def _average(averages: Sequence[_HitAverage], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF at all lines of the averages, with its noise averaged over lines where hits are few."""
    spectra = [average.spectra() for average in averages]
    shared = float(1 + 2 * sum(abs(averages[0].line_correlation()) ** 2))
    # The correction for the window's damping needs all neighbouring lines, so band and excluded bands are
    # chosen afterwards.
    parts = parts_of_spectra(spectra, replace(settings, band=None, exclude=()), layout, shared)
    covariance = parts.covariance
    if isinstance(covariance, FactoredCovariance):
        covariance = covariance.whole()
    return replace(parts, covariance=covariance)


def _on_lines(parts: Parts, averages: Sequence[_HitAverage], settings: FrfSettings, layout: Layout) -> Parts:
    """The parts with every hit alone, without the damping of a window, at the lines of the settings."""
    if len(averages) == 1:
        parts = averages[0].with_hits(parts, layout)
    if settings.damping_window is not None:
        parts = damping.parts_without_window(parts, settings.damping_window, averages[0].line_correlation())
    return parts_at_lines(parts, select_lines(parts.frequency, settings))


def force_courses(averages: Sequence[_HitAverage], layout: Layout) -> dict[int, ComplexArray]:
    """By the number of a force, dH / H (n_line, n) [1] of the mean over its hits by n independent errors of
    one standard deviation: those of its noise within the window, of which lines nearer than the inverse of
    its length share most. Empty where there are too many. Equation (frf-force-courses).
    """
    courses: dict[int, ComplexArray] = {}
    for average, force in zip(averages, layout.acting, strict=True):
        of_force = [a for a, other in zip(averages, layout.acting, strict=True) if other == force]
        if (shapes := average.window_shapes()) is None:
            return {}
        power = sum(a.force_noise()[1] for a in of_force)
        towards = np.sum([a.from_triggers()[:, :, a.force].sum(axis=0) for a in of_force], axis=0)
        size = np.abs(towards) * np.sqrt(np.maximum(power, np.finfo(float).tiny))
        courses[force] = -shapes * (towards.conj() / np.maximum(size, np.finfo(float).tiny))[:, None]
    return courses


def _force_errors(
    averages: Sequence[_HitAverage], layout: Layout, settings: ImpactSettings
) -> Iterator[FloatArray]:
    for force in layout.acting:
        of_force = [a for a, other in zip(averages, layout.acting, strict=True) if other == force]
        n = sum(average.n_hit for average in of_force)
        noise, power = (sum(parts) for parts in zip(*(a.force_noise() for a in of_force), strict=True))
        yield force_error(noise, power, n, windowed=settings.force_window is not None)


def force_error(noise: FloatArray, power: FloatArray, n_hit: int, *, windowed: bool) -> FloatArray:
    """Relative error (n_line,) [1] of the mean force of *n_hit* hits by its noise that is alike at many
    lines; *noise* and *power* (n_line,) [N^2 s^2 per spacing^2] summed over them.

    The share of the noise in the power of the force, by which H1 of n hits is low but for 1/n of it; under a
    force window the standard deviation of what this leaves, which lines nearer than its inverse share.
    """
    share = np.minimum(noise / np.maximum(power, np.finfo(float).tiny), MOST_NOISE)
    return np.asarray(np.sqrt(share / (2 * n_hit)) if windowed else share * (1 - 1 / n_hit))


def noise_around(noise: FloatArray, n_hit: int) -> FloatArray:
    """Power of noise (n_line,) [any unit] summed over *n_hit* hits, by the median of neighbouring lines,
    which hum in a few lines leaves as it is, over that of as many exponential values: 2 |N|^2 is like
    chi-square.
    """
    around = scipy.ndimage.median_filter(noise, 2 * AROUND + 1, mode="nearest")
    n = max(n_hit, 1)
    return np.asarray(around * (n / float(scipy.special.gammaincinv(n, 0.5))))


def without_force_noise(
    parts: Parts, errors: Sequence[FloatArray], layout: Layout, what: str, hint: str, *, taken_off: bool
) -> Parts:
    """A warning of the forces whose noise moves H, alike at all lines, by more than MOST_COMMON standard
    errors of a gain common to all lines; *what* it does, and the *hint*. *errors* of each recording's force,
    relative, (n_line,) [1] each. With the relative variance v of a line: sum(error / v) sqrt(2 / sum(1 / v)).
    *taken_off*: H is low by the errors, and is H / (1 - error); of one force the noise of every channel is
    told, since lines at which noise makes H low weigh too much by their measured covariance. Equation
    (frf-force-noise).
    """
    variance = variance_of(parts.covariance)
    if variance is None:
        return parts
    size = np.maximum(np.abs(parts.matrix) ** 2, np.finfo(float).tiny)
    least = np.maximum(ROUNDING**2 * size, np.finfo(float).tiny)
    precision = size / np.maximum(variance.reshape(size.shape), least)
    factor, snr, moving = np.ones((len(size), 1, size.shape[2]), np.complex128), parts.snr, {}
    hint = f"{TAKEN_OFF}; {hint}" if taken_off else hint
    for force in dict.fromkeys(layout.acting):
        of_force = [error for error, number in zip(errors, layout.acting, strict=True) if number == force]
        error, weights = np.mean(of_force, axis=0), precision[:, :, force]
        total = np.maximum(np.sum(weights, axis=0), np.finfo(float).tiny)
        common = float(np.max(error @ weights * np.sqrt(2 / total), initial=0.0))
        if common > MOST_COMMON:
            moving[layout.inputs[force].label] = error, common
            factor[:, 0, force] = 1 / (1 - error) if taken_off else 1
            if taken_off and len(layout.inputs) == 1:
                # Relative variances, of which that of the force is error / (n - 1).
                of_force, of_h = error[:, None] / (parts.averages - 1), 1 / weights
                relative = [of_force, np.maximum(of_h - of_force, LEAST_PART * of_h)]
                snr = 1 / np.sqrt(np.maximum(np.concatenate(relative, axis=1), np.finfo(float).tiny))
    every = np.broadcast_to(factor, size.shape)
    named = f"noise of the force{'s' if len(moving) > 1 else ''} {', '.join(moving)} {what}"
    return replace(
        parts,
        matrix=parts.matrix * factor,
        covariance=correct_covariance(parts.covariance, every),
        snr=snr,
        findings=(*parts.findings, *([force_noise(named, list(moving.values()), hint)] if moving else [])),
    )


def force_noise(what: str, sizes: Sequence[tuple[FloatArray, float]], hint: str) -> Finding:
    """The warning of errors of H (n_line, ...) [1] alike at all lines, each with the standard errors that it
    is of a gain common to all lines.
    """
    errors, common = zip(*sizes, strict=True)
    medians = ", ".join(f"{100 * np.median(error):.2g} %" for error in errors)
    gains = ", ".join(f"{size:.2g}" for size in common)
    size = f"{medians} (median over the lines), {gains} standard errors"
    return Finding("force-noise", f"{what} {size} of a gain that all lines have in common; {hint}")


def _with_hits(averages: list[_HitAverage], layout: Layout) -> tuple[list[_HitAverage], Layout]:
    """The recordings with a good hit, and their layout; all where a force would be left without any."""
    kept = [number for number, average in enumerate(averages) if average.n_hit]
    driven = {n for number in kept for n, column in enumerate(layout.input_columns[number]) if column >= 0}
    if len(driven) < len(layout.inputs):
        return averages, layout
    inputs, outputs = (
        tuple(columns[number] for number in kept) for columns in (layout.input_columns, layout.output_columns)
    )
    layout = replace(layout, input_columns=inputs, output_columns=outputs)
    return [averages[number] for number in kept], layout


class _HitAverage:
    """Sums of X_a X_b* over the accepted hits of one recording, and findings on the rejected ones."""

    def __init__(self, source: SampleSource, settings: FrfSettings) -> None:
        assert settings.block is not None
        self._source, self._settings = source, settings
        self.force, self.name = check_single_force(source), source.name
        # Two samples in every tenth, to see whether the response dies away.
        self.n_sample = block_samples(source, settings.block, 20)
        self._lines = line_range(self.n_sample, source.sample_rate, settings.band)
        # That under which the blocks stand: of `decay`, or applied by the analyser.
        self._exponential: FloatArray = np.ones(self.n_sample)
        if settings.damping_window is not None:
            self._exponential = windows.exponential_window(
                self.n_sample, settings.damping_window * source.sample_rate
            )
            # Neighbours of the band's edges, by which its lines are corrected for the window's damping.
            self._lines = slice(
                max(1, self._lines.start - damping.HALF_WIDTH),
                min(self.n_sample // 2 + 1, self._lines.stop + damping.HALF_WIDTH),
            )
        n_channel = len(source.channels)
        n_line = int(self._lines.stop - self._lines.start)
        self._sum = np.zeros((n_line, n_channel, n_channel), np.complex128)
        self.n_hit = self.n_found = 0
        # Power of the force's noise at the lines, summed over the hits.
        self._noise = np.zeros(n_line)
        self._origins: list[float] = []
        # Of each hit alone: number, peak force [N], trigger, amplitudes (n_line, n_channel).
        self._alone: list[tuple[int, float, int, ComplexArray]] = []
        # Responses that ring on, with the longest block [s] in which one would die away, 0 where unknown.
        self.slow: dict[str, float] = {}
        self._outputs = columns_of(source.channels, "output")
        # Power of every channel at the end of each hit's block, less that before it, over its largest.
        self._left: list[FloatArray] = []
        self._tones = ToneSearch(self.n_sample, len(self._outputs))
        # Power of every channel (n_channel,) before the first hit.
        self._quiet: FloatArray | None = None
        self.findings: list[Finding] = []

    def add(self, hit: Hit) -> None:
        self.n_found += 1
        if hit.fault:
            at = hit.start / self._source.sample_rate
            message = f"hit {hit.number} ('{self._source.name}', {at:.3f} s) is left out: {hit.fault}"
            self.findings.append(note("hit-rejected", message))
            return
        samples, length = hit.samples.copy(), self._settings.impact.force_window
        window: FloatArray = np.ones(self.n_sample)
        if length is not None:
            window = windows.force_window(self.n_sample, hit.trigger, length * self._source.sample_rate)
        samples[:, self.force] *= window
        if self._settings.impact.decay is not None:
            samples *= self._exponential[:, None]
        self._note_end(samples, hit)
        spectrum = scipy.fft.rfft(samples, axis=0)
        self._tones.add(hit.samples[:, self._outputs], spectrum[:, self.force])
        amplitude = spectrum[self._lines]
        self._sum += amplitude[:, :, None] * amplitude[:, None, :].conj()
        self.n_hit += 1
        power = noise_power(hit, self.force, self._lines)
        self._noise += power * np.sum((window * self._exponential) ** 2)
        peak = float(np.max(np.abs(hit.samples[:, self.force])))
        self._alone.append((hit.number, peak, hit.trigger, amplitude))
        self._origins.append(float(np.average(np.arange(self.n_sample), weights=samples[:, self.force] ** 2)))

    def force_noise(self) -> tuple[FloatArray, FloatArray]:
        """|N|^2 and |F + N|^2 (n_line,) [N^2 s^2 per spacing^2] of the force and its noise, over all hits."""
        return noise_around(self._noise, self.n_hit), self._sum[:, self.force, self.force].real

    def _note_end(self, samples: FloatArray, hit: Hit) -> None:
        """Keep what is left of the responses at the end, and those of which it is more than the noise before
        the first *hit*.
        """
        tenths = np.array([np.sqrt(np.mean(part**2, axis=0)) for part in np.array_split(samples, 10)])
        largest, number = tenths.max(axis=0) + np.sqrt(np.finfo(float).tiny), tenths.argmax(axis=0)
        length = samples.shape[0] / self._source.sample_rate
        # A hit begins before its trigger.
        before = np.mean(hit.samples[: max(hit.trigger // 2, 1)] ** 2, axis=0)
        self._left.append((tenths[-1] / largest) ** 2 - before / largest**2)
        self._quiet = before if self._quiet is None else self._quiet
        noise = AS_NOISE * self._quiet * np.mean(self._exponential[-len(samples) // 10 :] ** 2)
        left = np.sqrt(np.maximum(tenths[-1] ** 2 - noise, 0.0))
        for column in self._outputs:
            share, name = left[column] / largest[column], self._source.channels[column].name
            if share > DIED_AWAY:
                # exp(-t / tau) from the largest tenth to the last one.
                passed, fallen = length * (9 - number[column]) / 10, -np.log(share)
                needed = length + passed * (-np.log(AT_REST) / fallen - 1) if fallen > SEEN_TO_FALL else 0.0
                self.slow[name] = max(needed, self.slow.get(name, 0.0))

    def spectra(self) -> CrossSpectra:
        """The average over the accepted hits; DataError when there is none."""
        if not self.n_hit:
            reason = "no hit whose block is complete"
            if self.n_found:
                reason = f"{self.n_found} hit(s) found, none of them good"
            what = [f"recording '{self._source.name}': {reason}", *(f.message for f in self.findings[:1])]
            hint = "record again without that; `impact` says what is left out"
            raise DataError("; ".join(what), hint=hint)
        spacing = self._source.sample_rate / self.n_sample
        frequency = np.arange(self._lines.start, self._lines.stop) * spacing
        return CrossSpectra(frequency, self._sum * (1.0 / self.n_hit), self.n_hit, float(self.n_hit))

    def with_hits(self, parts: Parts, layout: Layout) -> Parts:
        """The parts with the FRFs of every hit alone, where there are two or more of one force, each with all
        responses. Not under an exponential window, whose lines share their noise: errors of one hit would
        come out too small.
        """
        if self._settings.damping_window is not None:
            return parts
        columns = list(layout.output_columns[0])
        forces = np.array([amplitude[:, self.force] for *_, amplitude in self._alone])
        if len(self._alone) < 2 or len(layout.inputs) != 1 or min(columns) < 0 or not np.all(forces):
            return parts
        numbers, peaks, _, amplitudes = zip(*self._alone, strict=True)
        alone = np.stack(amplitudes, axis=1)
        hits: ComplexArray = alone[:, :, columns, None] / alone[:, :, self.force, None, None]
        return replace(parts, hits=hits, hit_numbers=numbers, hit_peaks=peaks)

    def window_shapes(self) -> ComplexArray | None:
        """The *window_shapes* of the force's noise in a hit [N s per spacing]."""
        assert self._settings.impact.force_window is not None
        length, trigger = self._settings.impact.force_window * self._source.sample_rate, self._alone[0][2]
        window = windows.force_window(self.n_sample, trigger, length) * self._exponential
        shapes = windows.window_shapes(window, trigger, np.arange(self._lines.start, self._lines.stop))
        return None if shapes is None else np.sqrt(self.force_noise()[0] / self.n_hit)[:, None] * shapes

    def from_triggers(self) -> ComplexArray:
        """Amplitudes (n_hit, n_line, n_channel) of every hit, counted from its trigger."""
        numbers = np.arange(self._lines.start, self._lines.stop)
        triggers = np.array([trigger for _, _, trigger, _ in self._alone])
        amplitudes = np.array([amplitude for *_, amplitude in self._alone])
        return np.asarray(amplitudes * windows.phase_factors(numbers, -triggers, self.n_sample).T[:, :, None])

    def align(self, parts: Parts, force: int, outputs: Sequence[int]) -> _HitAverage:
        """The average with every hit's force less what its responses, beside those of all hits, say of noise
        within its window: what is left between hits is noise of the responses. *parts*: the FRF of all hits;
        *outputs*: columns of the responses.
        """
        other, shapes, here = copy(self), self.window_shapes(), np.array(outputs) >= 0
        variance = variance_of(parts.covariance)
        assert variance is not None and shapes is not None
        noise = variance.reshape(parts.matrix.shape)[:, here, force] * self.force_noise()[1][:, None]
        response = parts.matrix[:, here, force]
        if self._settings.estimator == "H1":
            error = force_error(*self.force_noise(), self.n_hit, windowed=False)
            response = response / (1 - error)[:, None]
        hits = self.from_triggers()
        rows = np.array(outputs)[here]
        motion, of_hits = hits[:, :, rows], hits[:, :, self.force]
        hits[:, :, rows], hits[:, :, self.force] = windows.without_window_noise(
            motion, of_hits, response, noise, shapes
        )
        other._sum = np.einsum("hla,hlb->lab", hits, hits.conj())
        return other

    def after_hit(self) -> float:
        """Share of the blocks after the hits, where responses are seen to ring on at their end; else 0."""
        if self._settings.damping_window is not None or not self.n_hit:
            return 0.0
        # Where noise alone makes it seem so, nothing that counts is cut off.
        left = np.mean(self._left, axis=0)[self._outputs]
        return float(1 - np.mean(self._origins) / self.n_sample) if np.any(left > FAINT**2) else 0.0

    def end_findings(self) -> list[Finding]:
        """The warnings of tones that no hit makes, and of other responses that ring on at the block's end."""
        findings, slow = [], dict(self.slow)
        for number, (frequency, amplitude, is_most) in self._tones.tones().items():
            channel = self._source.channels[self._outputs[number]]
            if is_most:
                slow.pop(channel.name, None)
            frequency *= self._source.sample_rate
            findings.append(steady_tone(self.name, channel, frequency, amplitude))
        if slow:
            to = f" to about {max(slow.values()):.2g} s" if any(slow.values()) else ""
            message = f"the response {', '.join(sorted(slow))} has not died away at the end of the block; "
            findings.append(Finding("not-died-away", f"{message}lengthen `block`{to}, or give `decay`"))
        return findings

    def line_correlation(self) -> ComplexArray:
        """Correlation of the noise of lines 1, 2, ... apart, (n_distance,) [1]. Empty without an exponential
        window.
        """
        if self._settings.damping_window is None:
            return np.empty(0, np.complex128)
        return windows.exponential_correlation(self._exponential, float(np.mean(self._origins)))
