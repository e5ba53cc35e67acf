"""Runout and unbalance beside a periodic excitation: harmonics of the shaft, fitted to what is left after the mean over periods.

x(t) = p(t) + Re sum_h X_h e^{j h theta(t)} with p periodic and free is linear; without the mean over the periods of both sides the
normal equations hold X_h alone, so the excitation does not disturb them, however strong it is. A harmonic that is itself periodic with the
excitation, on one of its lines, is not left in the remainder: it cannot be told from the response there, and the line is dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import fft

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.spectra.periodic import samples_per_period
from labpipe.spectra.reading import checked_blocks
from labpipe.spectra.settings import FrfSettings, ShaftLines
from labpipe.spectra.shaft import ShaftMotion, shaft_motion, steady
from labpipe.spectra.synchronous import WithoutSynchronous, is_cleaned, shaft_turns

# A harmonic of which less than the larger share is left after the mean over periods lies on a line, and that line is dropped. It is fitted
# all the same, since it leaks into neighbouring lines, down to the smaller share: what leaks of its error falls as the share does.
LEAST_LEFT, LEAST_FITTED = 0.5, 1e-4
# A force acts on a line above this share of its strongest line.
ACTING = 1e-3
# Instants of tacho pulses are uncertain by this much [samples] where they are steps between two samples.
PULSE_ERROR = 0.35
MOST_DEGREES = 8
# Gain in the logarithm of the likelihood that noise alone does not give a speed, with some twenty amplitudes beside it.
BETTER = 30.0


@dataclass(frozen=True)
class Cleaned:
    """A recording without its synchronous part, bands [Hz] of lines that are dropped since a harmonic lies on them, and what was found."""

    source: SampleSource
    bands: tuple[tuple[float, float], ...]
    findings: tuple[Finding, ...]


def without_runout(source: SampleSource, settings: FrfSettings) -> Cleaned:
    """The recording without the harmonics of `remove`; ConfigError and DataError as for the period, the tacho, and a single period.

    Equation (spec-runout).
    """
    lines = settings.remove
    assert lines is not None and settings.period is not None
    n_sample = samples_per_period(settings.period, source.sample_rate)
    n_period = source.n_sample // n_sample - settings.skip
    if n_period < 2:
        hint = "record at least 2 periods after the transient ones, or leave the lines out with `mask`"
        raise DataError(f"recording '{source.name}' has {max(n_period, 0)} period(s), too few to tell the shaft from it", hint=hint)
    given = shaft_motion(source, lines)
    motion = _refined(source, given, lines, settings, n_sample) if lines.tacho is None else smooth_motion(given, source.sample_rate)
    fitted = _fit(source, motion, lines.harmonics, n_sample, settings.skip, n_period)
    amplitude = fitted.amplitudes * [is_cleaned(channel) for channel in source.channels]
    low, high = motion.speed_range
    on_lines = {order: round(order * (low + high) / 2 * settings.period) / settings.period for order in fitted.on_lines}
    bands = tuple((line - 0.4 / settings.period, line + 0.4 / settings.period) for line in on_lines.values())
    findings = tuple(
        _dropped(source, order, line, (low + high) / 2)
        for order, line in on_lines.items()
        if fitted.acting[min(round(line * settings.period), fitted.acting.size - 1)]
    )
    return Cleaned(WithoutSynchronous(source, motion, amplitude), bands, findings)


def _dropped(source: SampleSource, order: int, line: float, speed: float) -> Finding:
    message = (
        f"{source.name}: the excited line {line:g} Hz lies on {order}x of the shaft's {speed:.6g} Hz, so its runout cannot be told "
        "from the response there; the line is left out"
    )
    return Finding("shaft-line", message)


def smooth_motion(motion: ShaftMotion, sample_rate: float) -> ShaftMotion:
    """The shaft's motion without the scatter of pulse instants: the polynomial of lowest degree that follows the counts within it."""
    times, counts = motion.times, motion.revolutions
    allowed = PULSE_ERROR / sample_rate * float(np.mean(motion.speeds))
    for degree in range(1, min(MOST_DEGREES, times.size - 2) + 1):
        course = np.polynomial.Chebyshev.fit(times, counts, degree)
        if np.sqrt(np.mean((course(times) - counts) ** 2)) <= allowed:
            return ShaftMotion(times, course(times))
    return motion


@dataclass(frozen=True)
class _Fitted:
    """amplitudes (n_harmonic, n_channel) [SI units of the channels] and the harmonics on_lines; acting (n_line,): where a force acts, from
    0 Hz; power (n_channel,): left after the mean over periods; likelihood: logarithm of that of the outputs over that of noise alone.
    """

    amplitudes: ComplexArray
    on_lines: tuple[int, ...]
    acting: BoolArray
    power: FloatArray
    likelihood: float


def _fit(source: SampleSource, motion: ShaftMotion, n_harmonic: int, n_sample: int, first: int, n_period: int) -> _Fitted:
    """Least squares over *n_period* periods from the period *first* on."""
    n_column = 2 * n_harmonic
    gram, right = np.zeros((n_column, n_column)), np.zeros((n_column, len(source.channels)))
    sum_turns, sum_samples = np.zeros((n_sample, n_column)), np.zeros((n_sample, len(source.channels)))
    power = np.zeros(len(source.channels))
    for number, period in enumerate(_periods(source, n_sample)):
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
    return _Fitted(
        solution[:n_harmonic] + 1j * solution[n_harmonic:],
        tuple(int(number) + 1 for number in np.flatnonzero(shares < LEAST_LEFT)),
        np.any(size > ACTING * np.max(size, axis=0, initial=0.0), axis=1),
        power,
        -0.5 * n_sample * n_period * float(np.sum(np.log(unexplained))),
    )


def _periods(source: SampleSource, n_sample: int) -> Iterator[FloatArray]:
    """The whole periods of a recording, (n_sample, n_channel) [SI]."""
    rest: FloatArray = np.empty((0, len(source.channels)))
    for block in checked_blocks(source):
        samples = np.concatenate([rest, block]) if rest.size else block
        n_whole = samples.shape[0] // n_sample
        yield from (samples[number * n_sample : (number + 1) * n_sample] for number in range(n_whole))
        rest = samples[n_whole * n_sample :]


def _refined(source: SampleSource, motion: ShaftMotion, lines: ShaftLines, settings: FrfSettings, n_sample: int) -> ShaftMotion:
    """A given speed made exact: 1x of the outputs keeps its phase from the first half of the periods to the second.

    With fewer than four periods, and where another speed is not clearly more likely, the given one is kept.
    """
    n_period = source.n_sample // n_sample - settings.skip
    half = n_period // 2
    if half < 2:
        return motion
    assert lines.speed is not None and settings.period is not None
    duration = source.n_sample / source.sample_rate
    outputs = [number for number, channel in enumerate(source.channels) if channel.role == "output"]
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
