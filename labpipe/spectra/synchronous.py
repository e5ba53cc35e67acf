"""The part of a recording that is synchronous with the shaft: runout and unbalance, harmonics of the shaft
that are fitted and subtracted; beside a periodic excitation to what is left after the mean over periods.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.display import plain_text
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.bands import mask_findings, masked_bands
from labpipe.spectra.channels import FORCE, READ_SAMPLES, DerivedRecording, checked_blocks, columns_of
from labpipe.spectra.period_average import PeriodCut, samples_per_period
from labpipe.spectra.ports import ORDER_OF
from labpipe.spectra.settings import FrfSettings, ShaftLines
from labpipe.spectra.shaft import STRETCH, ShaftMotion, at_rest, shaft_motion, steady
from labpipe.spectra.windows import hann


class WithoutSynchronous(DerivedRecording):
    """A recording minus its synchronous part; satisfies SampleSource. amplitude (n_harmonic, n_channel)
    complex, 0-to-peak [SI].
    """

    def __init__(self, source: SampleSource, motion: ShaftMotion, amplitude: ComplexArray) -> None:
        super().__init__(source)
        self.motion, self.amplitude = motion, amplitude

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Those of the source, and notes on the subtracted amplitudes of every channel, 0-to-peak."""
        low, high = self.motion.speed_range
        speed = f"{low:.6g} Hz" if high - low < 1e-9 * high else f"{low:.6g}-{high:.6g} Hz"
        removed = [
            note(
                "synchronous-removed",
                f"channel {channel.name}: the part synchronous with {speed} was taken out, "
                + ", ".join(
                    f"{order}x {plain_text(abs(value), channel.unit, 3)}"
                    for order, value in enumerate(amplitudes, 1)
                )
                + " 0-to-peak",
            )
            for channel, amplitudes in zip(self.channels, self.amplitude.T, strict=True)
            if is_cleaned(channel)
        ]
        return (*self.source.findings, *self.motion.findings, *removed)

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, (n, n_channel) [SI]: x - Re sum_h X_h exp(j h
        theta).
        """
        start = 0
        for block in self.source.blocks(n_sample):
            turns = shaft_turns(self.motion, start, block.shape[0], self.sample_rate, self.amplitude.shape[0])
            yield block - turns.real @ self.amplitude.real + turns.imag @ self.amplitude.imag
            start += block.shape[0]


def without_synchronous(
    source: SampleSource, lines: ShaftLines, quiet: BoolArray | None = None
) -> WithoutSynchronous:
    """The recording minus the first harmonics of the shaft speed, with amplitudes fitted to the whole
    recording, or to its *quiet* samples (n_sample,). The least-squares fit of the first `harmonics`; of all
    multiples it is time-synchronous averaging (McFadden 1987). DataError for fewer than two revolutions.
    Equation (spec-synchronous).
    """
    motion = _motion(source, lines)
    if lines.tacho is not None:
        motion = smooth_motion(motion, source.sample_rate)
    duration = source.n_sample / source.sample_rate
    turned = np.diff(motion.angle(np.array([0.0, duration])))[0] / (2 * np.pi)
    if turned < 2:
        what = f"recording '{source.name}' is shorter than two revolutions"
        raise DataError(what, hint="give the speed in Hz or rpm")
    if quiet is not None and np.mean(quiet) * turned < 2:
        what = f"the hits of '{source.name}' leave less than two revolutions of the shaft between them"
        raise DataError(what, hint="hit less often, or shorten `block`")
    amplitude = _harmonics(source, motion, lines.harmonics, quiet)
    if lines.speed is not None:
        refined = steady(_refine_speed(source, lines.speed, quiet), duration)
        better = _harmonics(source, refined, lines.harmonics, quiet)
        # Without 1x in the responses the refinement follows noise; then the given speed fits better.
        if np.sum(_shares(source, better)) > np.sum(_shares(source, amplitude)):
            motion, amplitude = refined, better
    cleaned = amplitude * [is_cleaned(channel) for channel in source.channels]
    return WithoutSynchronous(source, motion, cleaned)


def _motion(source: SampleSource, lines: ShaftLines) -> ShaftMotion:
    motion = shaft_motion(source, lines)
    top = lines.harmonics * motion.speed_range[1]
    if top < source.sample_rate / 2:
        return motion
    what = f"{lines.harmonics}x of the shaft of '{source.name}' is {top:.4g} Hz"
    raise DataError(f"{what}, not below half its sampling rate", hint="lower `harmonics`")


def is_cleaned(channel: Channel) -> bool:
    """Whether a channel's synchronous part is taken out: not that of the tacho and of other references that
    are no force or motion.
    """
    return channel.role != "reference" or channel.quantity == FORCE or channel.quantity in ORDER_OF


def _shares(source: SampleSource, amplitude: ComplexArray) -> FloatArray:
    outputs = columns_of(source.channels, "output")
    power = next(iter(source.blocks(READ_SAMPLES)))[:, outputs].var(axis=0)
    return np.sum(np.abs(amplitude[:, outputs]) ** 2, axis=0) / np.where(power > 0, power, 1.0)


def shaft_turns(
    motion: ShaftMotion, start: int, n_sample: int, sample_rate: float, n_harmonic: int
) -> ComplexArray:
    """exp(j h theta) of h = 1 ... n_harmonic, (n_sample, n_harmonic) [1], from sample *start* on at
    *sample_rate* [Hz].
    """
    angle = motion.angle((start + np.arange(n_sample)) / sample_rate)
    return np.exp(1j * angle[:, None] * np.arange(1, n_harmonic + 1))


def between_hits(source: SampleSource, settings: FrfSettings) -> BoolArray:
    """Samples (n_sample,) that lie outside the hits of a recording: a hit lasts from AHEAD of a block before
    the force exceeds the trigger to RINGING of a block behind.
    """
    assert settings.block is not None
    forces = columns_of(source.channels, "input")
    record = np.concatenate([block[:, forces] for block in checked_blocks(source)])
    push = np.max(np.abs(record - np.median(record, axis=0)), axis=1)
    before, after = (round(share * settings.block * source.sample_rate) for share in (AHEAD, RINGING))
    quiet = np.ones(push.size, bool)
    for place in np.flatnonzero(push >= settings.impact.trigger * np.max(push)):
        quiet[max(place - before, 0) : place + after] = False
    return quiet


class ToneSearch:
    """Tones in responses that no hit makes, as of a shaft that turns: what the second and the last quarter of
    blocks of *n_sample* samples hold in equal parts, and what does not follow the force.
    """

    def __init__(self, n_sample: int, n_response: int) -> None:
        self._window = hann(n_sample // 4)
        n_line = n_sample // 8 + 1
        # Lines of a quarter among those of the block.
        self._places = np.arange(n_line) * n_sample // self._window.size
        self._power, self._fourth = np.zeros((2, n_line, n_response)), np.zeros((n_line, n_response))
        self._crossed = np.zeros((2, n_line, n_response), np.complex128)
        self._force, self.n_hit = np.zeros(n_line), 0

    def add(self, responses: FloatArray, force: ComplexArray) -> None:
        """A block (n_sample, n_response) [SI] and the DFT (n_sample // 2 + 1,) [SI] of its force."""
        n = self._window.size
        quarters = np.stack([responses[n : 2 * n], responses[-n:]])
        quarters = (quarters - np.mean(quarters, axis=1, keepdims=True)) * self._window[:, None]
        spectra, acting = fft.rfft(quarters, axis=1), force[self._places]
        self._power += np.abs(spectra) ** 2
        self._fourth += np.abs(spectra[1]) ** 4
        self._crossed += spectra * acting.conj()[:, None]
        self._force += np.abs(acting) ** 2
        self.n_hit += 1

    def tones(self) -> dict[int, tuple[float, float, bool]]:
        """Frequency [cycles per sample] and amplitude [SI] by the response's number, and whether the tone is
        most of what is left at the end of the blocks. Equation (spec-tone).
        """
        if self.n_hit < LEAST_HITS or self._window.size < LEAST_QUARTER:
            return {}
        force = np.maximum(self._force, np.finfo(float).tiny)[:, None]
        left = np.maximum(self._power - np.abs(self._crossed) ** 2 / force, 0.0)
        tones = {}
        for number, (early, late) in enumerate(np.moveaxis(left, 2, 0)):
            line = 3 + int(np.argmax(late[3:-3]))
            around = np.s_[line - 2 : line + 3]
            total, power = float(np.sum(late[around])), self._power[1, :, number]
            is_steady = total / ALIKE < np.sum(early[around]) < total * ALIKE
            # Of a mode that noise shakes it is 2 in the mean.
            is_constant = self.n_hit * self._fourth[line, number] < CONSTANT * power[line] ** 2
            is_line = late[line] > max(STANDING * late[line - 3], STANDING * late[line + 3], power[line] / 2)
            if not (is_steady and is_constant and is_line and 2 * total > np.sum(late)):
                continue
            peak = late[around]
            side = 1 if peak[3] > peak[1] else -1
            ratio = np.sqrt(peak[2 + side] / peak[2])
            frequency = (line + side * (2 * ratio - 1) / (ratio + 1)) / self._window.size
            scale = self.n_hit * self._window.size * np.sum(self._window**2)
            is_most = bool(2 * total > np.sum(power))
            tones[number] = (float(frequency), float(2 * np.sqrt(total / scale)), is_most)
        return tones


def steady_tone(name: str, channel: Channel, frequency: float, amplitude: float) -> Finding:
    """The warning of a tone [Hz] in a *channel* of a recording by its *amplitude* [SI]."""
    tone = f"{frequency:.4g} Hz"
    message = (
        f"{name}: response {channel.name} holds {tone} of {plain_text(amplitude, channel.unit, 3)} that no "
        f"hit makes (a turning shaft, or hum), and it leaks into all lines; `remove: {{speed: {tone}, "
        "harmonics: 2}` takes it out"
    )
    return Finding("steady-tone", message)


def _harmonics(
    source: SampleSource, motion: ShaftMotion, n_harmonic: int, quiet: BoolArray | None
) -> ComplexArray:
    """Least squares of x = c + Re sum_h X_h exp(j h theta), (n_harmonic, n_channel)."""
    n = 2 * n_harmonic + 1
    normal, right = np.zeros((n, n)), np.zeros((n, len(source.channels)))
    start = 0
    for block in checked_blocks(source):
        turns = shaft_turns(motion, start, block.shape[0], source.sample_rate, n_harmonic)
        columns = np.column_stack([np.ones(block.shape[0]), turns.real, -turns.imag])
        if quiet is not None:
            columns *= quiet[start : start + block.shape[0], None]
        normal += columns.T @ columns
        right += columns.T @ block
        start += block.shape[0]
    solution = np.linalg.solve(normal, right)
    return solution[1 : n_harmonic + 1] + 1j * solution[n_harmonic + 1 :]


def _refine_speed(source: SampleSource, speed: float, quiet: BoolArray | None) -> float:
    """The speed [Hz] near *speed* by the turn of 1x over stretches, each time over longer ones."""
    longest = min(READ_SAMPLES, source.n_sample // 2)
    stretch = max(1, round(STRETCH / speed * source.sample_rate))
    while True:
        stretch = min(stretch, longest)
        speed = _refine(source, speed, stretch, quiet)
        if stretch == longest:
            return speed
        stretch *= LONGER


def _refine(source: SampleSource, speed: float, stretch: int, quiet: BoolArray | None) -> float:
    """The speed [Hz] near *speed* at which 1x keeps its phase, outputs weighted by their power."""
    motion = steady(speed, source.n_sample / source.sample_rate)
    window = hann(stretch)
    outputs = columns_of(source.channels, "output")
    amplitudes, rest, start = [], np.empty((0, len(outputs))), 0
    for block in source.blocks(READ_SAMPLES):
        samples = np.concatenate([rest, block[:, outputs]])
        n_whole = samples.shape[0] // stretch
        turns = shaft_turns(motion, start, n_whole * stretch, source.sample_rate, 1).conj()
        pieces = samples[: n_whole * stretch].reshape(n_whole, stretch, len(outputs))
        weights = np.ones((n_whole, stretch, 1))
        if quiet is not None:
            weights[...] = quiet[start : start + n_whole * stretch].reshape(weights.shape)
        mean = (
            np.sum(weights * pieces, axis=1, keepdims=True) / np.maximum(np.sum(weights, axis=1), 1)[:, None]
        )
        pieces = weights * (pieces - mean)
        amplitudes.append(np.einsum("s,ks,ksc->kc", window, turns.reshape(n_whole, stretch), pieces))
        rest, start = samples[n_whole * stretch :], start + n_whole * stretch
    joined = np.concatenate(amplitudes)
    size = np.linalg.norm(joined, axis=0)
    joined = joined / np.where(size > 0, size, 1.0)
    turn = np.angle(np.sum(joined[1:] * joined[:-1].conj()))
    return speed + float(turn) / (2 * np.pi * stretch / source.sample_rate)


# Fewest hits, and samples of a quarter of a block, that tell a tone; factor within which a tone has the power
# of another quarter; power of a tone over that three lines away; mean fourth power of its amplitude over the
# square of the mean power, below which it is constant from hit to hit.
LEAST_HITS, LEAST_QUARTER, ALIKE, STANDING, CONSTANT = 4, 64, 2.0, 30.0, 1.2
# Factor by which the stretches grow that refine a speed; share of a block ahead of a hit that belongs to it,
# and behind that its response rings.
LONGER, AHEAD, RINGING = 4, 0.02, 0.75
# A harmonic of which less than the larger share is left after the mean over periods lies on a line, which is
# dropped. It is fitted all the same, down to the smaller share, since it leaks into neighbouring lines.
LEAST_LEFT, LEAST_FITTED = 0.5, 1e-4
# A force acts on a line above this share of its strongest line.
ACTING = 1e-3
# Instants of tacho pulses are uncertain by this much [samples] where they are steps between two samples.
PULSE_ERROR = 0.35
# Polynomials that follow the pulses, those beyond that tell the noise of smooth courses; lowest speed over
# the mean one that a weight is made of; variance over that of white noise; steps of the course to a pulse.
MOST_DEGREES, FOLLOWING, SLOWEST, WHITE, BETWEEN = 24, 24, 0.1, 1.2, 8
# Gain in the logarithm of the likelihood that noise alone does not give a speed.
BETTER = 30.0


@dataclass(frozen=True)
class Cleaned:
    """A recording without its synchronous part, bands [Hz] of lines that are dropped since a harmonic lies on
    them, and what was found.
    """

    source: SampleSource
    bands: tuple[tuple[float, float], ...]
    findings: tuple[Finding, ...]


def without_runout(source: SampleSource, settings: FrfSettings) -> Cleaned:
    """The recording without the harmonics of `remove`; ConfigError and DataError as for the period, the
    tacho, and a single period. Equation (spec-runout).
    """
    lines = settings.remove
    assert lines is not None and settings.period is not None
    n_sample = samples_per_period(settings.period, source.sample_rate)
    n_period = source.n_sample // n_sample - settings.skip
    if n_period < 2:
        hint = "record at least 2 periods after the transient ones, or leave the lines out with `mask`"
        raise DataError(
            f"recording '{source.name}' has {max(n_period, 0)} period(s), too few to tell the shaft from it",
            hint=hint,
        )
    given = _motion(source, lines)
    motion = (
        _refine_given_speed(source, given, lines, settings, n_sample)
        if lines.tacho is None
        else smooth_motion(given, source.sample_rate)
    )
    fitted = _fit(source, motion, lines.harmonics, n_sample, settings.skip, n_period)
    amplitude = fitted.amplitudes * [is_cleaned(channel) for channel in source.channels]
    low, high = motion.speed_range
    on_lines = {
        order: round(order * (low + high) / 2 * settings.period) / settings.period
        for order in fitted.on_lines
    }
    bands = tuple((line - 0.4 / settings.period, line + 0.4 / settings.period) for line in on_lines.values())
    findings = tuple(
        Finding(
            "shaft-line",
            f"{source.name}: the excited line {line:g} Hz lies on {order}x of the shaft's "
            f"{(low + high) / 2:.6g} Hz, so its runout cannot be told from the response there; the line is "
            "left out",
        )
        for order, line in on_lines.items()
        if fitted.acting[min(round(line * settings.period), fitted.acting.size - 1)]
    )
    return Cleaned(WithoutSynchronous(source, motion, amplitude), bands, findings)


def smooth_motion(motion: ShaftMotion, sample_rate: float) -> ShaftMotion:
    """The shaft's motion without the scatter of pulse instants: the polynomial that follows them, where they
    scatter about it by less than a sample, or as white noise does. Its standard error is by the power that
    the next FOLLOWING polynomials find in what it leaves, and its degree the one where that is least.
    """
    times, counts = motion.times, motion.revolutions
    following = min(FOLLOWING, times.size // 3)
    most = min(MOST_DEGREES, times.size - 2 - following)
    if most < 1:
        return motion
    # Instants are uncertain alike, counts by that times the speed.
    speed = np.polynomial.Chebyshev.fit(times, counts, min(most, 8)).deriv()(times)
    speed = np.maximum(speed, SLOWEST * float(np.mean(motion.speeds)))
    basis, triangle = np.linalg.qr(_chebyshev(times, times, most + following) / speed[:, None])
    shares = basis.T @ (counts / speed)
    power = [np.mean(shares[degree + 1 : degree + 1 + following] ** 2) for degree in range(most + 1)]
    n = 1 + min(range(1, most + 1), key=lambda degree: (degree + 1) * power[degree])
    left = counts / speed - basis[:, :n] @ shares[:n]
    # Second differences of white noise have six times its variance.
    white = WHITE * np.mean(np.diff(left, 2) ** 2) / 6
    if np.sum(left**2) / (times.size - n) > max((PULSE_ERROR / sample_rate) ** 2, white):
        return motion
    fine = np.interp(np.arange(0, times.size - 1 + 1 / BETWEEN, 1 / BETWEEN), np.arange(times.size), times)
    course = np.linalg.solve(triangle[:n, :n].T, _chebyshev(fine, times, n - 1).T)
    error = np.sqrt(power[n - 1]) * np.linalg.norm(course, axis=0)
    return replace(motion, times=fine, revolutions=shares[:n] @ course, std_error=error)


def _chebyshev(time: FloatArray, times: FloatArray, degree: int) -> FloatArray:
    place = np.polynomial.polyutils.mapdomain(time, times[[0, -1]], [-1.0, 1.0])
    return np.asarray(np.polynomial.chebyshev.chebvander(place, degree))


@dataclass(frozen=True)
class _FittedHarmonics:
    """amplitudes (n_harmonic, n_channel) [SI units of the channels] and the harmonics on_lines; acting
    (n_line,): where a force acts, from 0 Hz; power (n_channel,): left after the mean over periods;
    likelihood: logarithm of that of the outputs over that of noise alone.
    """

    amplitudes: ComplexArray
    on_lines: tuple[int, ...]
    acting: BoolArray
    power: FloatArray
    likelihood: float


def _fit(
    source: SampleSource, motion: ShaftMotion, n_harmonic: int, n_sample: int, first: int, n_period: int
) -> _FittedHarmonics:
    n_column = 2 * n_harmonic
    gram, right = np.zeros((n_column, n_column)), np.zeros((n_column, len(source.channels)))
    sum_turns, sum_samples = np.zeros((n_sample, n_column)), np.zeros((n_sample, len(source.channels)))
    power = np.zeros(len(source.channels))
    cut = PeriodCut(n_sample)
    periods = (period for block in checked_blocks(source) for period in cut.periods(block))
    for number, period in enumerate(periods):
        if not first <= number < first + n_period:
            continue
        turned = shaft_turns(motion, number * n_sample, n_sample, source.sample_rate, n_harmonic)
        columns = np.concatenate([turned.real, -turned.imag], axis=1)
        gram += columns.T @ columns
        right += columns.T @ period
        power += np.sum(period**2, axis=0)
        sum_turns += columns
        sum_samples += period
    left = gram - sum_turns.T @ sum_turns / n_period
    right -= sum_turns.T @ sum_samples / n_period
    power -= np.sum(sum_samples**2, axis=0) / n_period
    shares = np.diag(left) / np.diag(gram)
    shares = (shares[:n_harmonic] + shares[n_harmonic:]) / 2
    kept = np.tile(shares > LEAST_FITTED, 2)
    solution = np.zeros_like(right)
    solution[kept] = np.linalg.solve(left[np.ix_(kept, kept)], right[kept])
    forces = [number for number, channel in enumerate(source.channels) if channel.quantity == "force"]
    size = np.abs(fft.rfft(sum_samples[:, forces], axis=0))
    size[0] = 0.0
    power = np.where(power > 0, power, 1.0)
    outputs = [channel.role == "output" for channel in source.channels]
    unexplained = np.maximum(1 - (np.sum(solution * right, axis=0) / power)[outputs], np.finfo(float).eps)
    return _FittedHarmonics(
        solution[:n_harmonic] + 1j * solution[n_harmonic:],
        tuple(int(number) + 1 for number in np.flatnonzero(shares < LEAST_LEFT)),
        np.any(size > ACTING * np.max(size, axis=0, initial=0.0), axis=1),
        power,
        -0.5 * n_sample * n_period * float(np.sum(np.log(unexplained))),
    )


def _refine_given_speed(
    source: SampleSource, motion: ShaftMotion, lines: ShaftLines, settings: FrfSettings, n_sample: int
) -> ShaftMotion:
    """A given speed made exact: 1x of the outputs keeps its phase from the first half of the periods to the
    second. With fewer than four periods, and where another speed is not clearly more likely, the given one is
    kept.
    """
    n_period = source.n_sample // n_sample - settings.skip
    half = n_period // 2
    if half < 2:
        return motion
    assert lines.speed is not None and settings.period is not None
    duration = source.n_sample / source.sample_rate
    outputs = columns_of(source.channels, "output")
    best = motion
    most = _fit(source, motion, lines.harmonics, n_sample, settings.skip, n_period).likelihood
    # On a line nothing is left of 1x; from a quarter of a turn to either side a speed beside it is found.
    for offset in (0.0, -0.25, 0.25):
        speed = lines.speed + offset / (half * settings.period)
        for _ in range(2):
            trial = steady(speed, duration)
            early, late = (_fit(source, trial, 1, n_sample, settings.skip + n * half, half) for n in (0, 1))
            # A channel weighs by its share of 1x in what the mean over periods leaves.
            turn = np.angle(np.sum((late.amplitudes * early.amplitudes.conj() / early.power)[0, outputs]))
            speed += float(turn) / (2 * np.pi * half * settings.period)
        trial = steady(speed, duration)
        likelihood = _fit(source, trial, lines.harmonics, n_sample, settings.skip, n_period).likelihood
        if likelihood > most + BETTER:
            best, most = trial, likelihood
    return best


# A shaft turns steadily where its fastest is at most this many times its slowest.
STEADY = 1.2


def without_shaft(
    sources: Sequence[SampleSource], settings: FrfSettings
) -> tuple[list[SampleSource], FrfSettings, tuple[Finding, ...]]:
    """The recordings, each without its synchronous part where `remove` is given, and the settings without the
    lines that it falls on, or that `mask` leaves out.
    """
    remove, (masked, of_tacho) = settings.remove, masked_bands(sources, settings)
    settings = _without_lines(settings, masked, sources[0].sample_rate / 2)
    if remove is None:
        return list(sources), settings, (*mask_findings(masked, settings.band), *of_tacho)
    resting = [at_rest(source, remove) for source in sources]
    findings = [
        note(
            "synchronous-removed",
            f"{source.name}: the tacho {remove.tacho} shows no revolution, nothing was taken out",
        )
        for source, rests in zip(sources, resting, strict=True)
        if rests
    ]
    cleaned: list[SampleSource] = []
    bands: dict[tuple[float, float], None] = {}
    for source, rests in zip(sources, resting, strict=True):
        if rests:
            cleaned.append(source)
        elif settings.excitation != "periodic":
            quiet = between_hits(source, settings) if settings.excitation == "impact" else None
            cleaned.append(without_synchronous(source, remove, quiet))
        else:
            without = without_runout(source, settings)
            cleaned.append(without.source)
            bands |= dict.fromkeys(without.bands)
            findings.extend(without.findings)
    settings = _without_lines(settings, bands, sources[0].sample_rate / 2)
    return cleaned, settings, (*mask_findings(masked, settings.band), *of_tacho, *findings)


def _without_lines(settings: FrfSettings, bands: Iterable[tuple[float, float]], most: float) -> FrfSettings:
    # Lines of the shaft may lie anywhere, what is excluded lies in the band.
    least, most = settings.band or (0.0, most)
    inside = (gap for gap in bands if gap[0] <= most and gap[1] >= least)
    return replace(settings, exclude=(*settings.exclude, *inside))


def lines_of_shaft(
    sources: Sequence[SampleSource], settings: FrfSettings, excited: Sequence[FloatArray]
) -> tuple[Finding, ...]:
    """Warnings for lines on which a force acts in a recording, *excited* (n_line,) [Hz] of each, that lie on
    1x or 2x of the shaft by a tacho that no setting names. The tacho is taken to give a pulse per revolution.
    """
    if settings.excitation != "periodic" or settings.mask is not None or settings.remove is not None:
        return ()
    findings = []
    for source, frequency in zip(sources, excited, strict=True):
        tacho = next((channel.name for channel in source.channels if channel.quantity == "tacho"), None)
        if tacho is None or at_rest(source, ShaftLines(tacho=tacho)):
            continue
        motion = shaft_motion(source, ShaftLines(tacho=tacho))
        low, high = smooth_motion(motion, source.sample_rate).speed_range
        if high > STEADY * low:
            continue
        width = source.sample_rate / source.n_sample
        for order in (1, 2):
            hit = frequency[(frequency > order * low - width) & (frequency < order * high + width)]
            if hit.size:
                named = ", ".join(f"{line:g} Hz" for line in hit[:3])
                message = (
                    f"{source.name}: the excited line {named} lies on {order}x of the shaft's "
                    f"{np.mean([low, high]):.6g} Hz by {tacho}, so its runout counts as response there; "
                    f"remove: {{tacho: {tacho}, harmonics: 2}} takes it out and drops the line"
                )
                findings.append(Finding("shaft-line", message))
    return tuple(findings)
