"""Recordings of a stepped sine -> FRF matrix at the frequencies of its dwells, with the covariance from the
scatter of blocks.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.spectra.channels import checked_blocks
from labpipe.spectra.covariance import ENOUGH_DOF, covariance_of_periodic, joined_response
from labpipe.spectra.period_average import neighbourhood_mean
from labpipe.spectra.ports import Layout, Parts, select_lines
from labpipe.spectra.quality import force_inverse, signal_to_noise
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.sweeps import Dwell, find_dwells, loudest

# Steps of Gauss and Newton for the frequency: the error shrinks by orders of magnitude with each.
STEPS = 6


def design(frequency: float, n_sample: int) -> FloatArray:
    """cos, -sin and 1 (n_sample, 3) [1] at a *frequency* [periods per sample], so that the first two factors
    are Re and Im of X.
    """
    phase = 2 * np.pi * frequency * np.arange(n_sample)
    return np.column_stack([np.cos(phase), -np.sin(phase), np.ones(n_sample)])


def amplitudes(samples: FloatArray, frequency: float) -> ComplexArray:
    """X (n_channel,) of x = Re(X exp(j 2 pi f n)) + offset by least squares in *samples* (n_sample,
    n_channel) [unit of the channel]. Equation (spec-sine).
    """
    factors = np.linalg.lstsq(design(frequency, samples.shape[0]), samples, rcond=None)[0]
    amplitude: ComplexArray = factors[0] + 1j * factors[1]
    return amplitude


def sine_frequency(signal: FloatArray, frequency: float) -> float:
    """Frequency [periods per sample] of a sine with offset in white noise, by least squares (n_sample,) [any
    unit] from a first guess. Its variance is the bound of Cramer and Rao, 6 s^2 / (pi^2 A^2 N^3) [periods^2
    per sample^2] for the amplitude A and the noise s (Rife and Boorstyn 1974, IEEE Trans. Inf. Theory 20, for
    large N).
    """
    n = signal.size
    time = np.arange(n) - (n - 1) / 2
    for _ in range(STEPS):
        phase = 2 * np.pi * frequency * time
        cos, sin = np.cos(phase), np.sin(phase)
        basis = np.column_stack([cos, sin, np.ones(n)])
        a, b, _ = np.linalg.lstsq(basis, signal, rcond=None)[0]
        slope = 2 * np.pi * time * (b * cos - a * sin)
        frequency += float(np.linalg.lstsq(np.column_stack([basis, slope]), signal, rcond=None)[0][3])
    return frequency


def block_amplitudes(samples: FloatArray, frequency: float, length: float, count: int) -> ComplexArray:
    """X (count, n_channel) [unit of the channel] in blocks of *length* samples one after the other, of
    *samples* (n_sample, n_channel). Their phase is that of the first sample of all.
    """
    edges = np.minimum(np.round(np.arange(count + 1) * length).astype(np.int64), samples.shape[0])
    sizes = np.diff(edges)
    values = np.empty((count, samples.shape[1]), np.complex128)
    for size in np.unique(sizes):
        which = np.flatnonzero(sizes == size)
        blocks = samples[edges[which] + np.arange(size)[:, None]]
        values[which] = amplitudes(blocks.reshape(size, -1), frequency).reshape(which.size, -1)
    return values * np.exp(-2j * np.pi * frequency * edges[:-1, None])


def frequency_variance(signal: FloatArray, frequency: float) -> float:
    """The bound of Cramer and Rao on the variance of sine_frequency [periods^2 per sample^2], of a *signal*
    (n_sample,) [any unit]. Equation (spec-sine-variance).
    """
    n = signal.size
    basis = design(frequency, n)
    factors = np.linalg.lstsq(basis, signal, rcond=None)[0]
    noise = float(np.sum((signal - basis @ factors) ** 2)) / max(n - 4, 1)
    return 6 * noise / (np.pi**2 * float(factors[0] ** 2 + factors[1] ** 2) * n**3)


# Bins of the time after a step, from zero to the end of the longest dwell, or to so many times what is seen
# of the transient where that is sooner.
N_BIN, FINE = 40, 4.0
# Standard errors by which the scatter in a bin exceeds that of noise while a transient is seen.
SEEN = 4.0
# Share of a standard error that the transient may leave in a result.
LEFT = 0.2
# Noise of a block, of its amplitude, below which a transient has settled.
LEAST_NOISE = 1e-4
# Where less than this share of a dwell is settled, its transient is modelled, from where it is so many times
# the noise of a block: modes that decay faster are gone there, and what remains shows its pole.
SETTLED_SHARE, CLEAR = 0.5, 10.0
# Relative error of the decay that all dwells show together, for a single dwell.
DECAY_ERROR = 0.3


@dataclass(frozen=True)
class DwellCourse:
    """Amplitudes of a dwell, block by block: *times* (n_block,) [s] after the step, *values* (n_block,
    n_channel) [unit of the channel].
    """

    times: FloatArray
    values: ComplexArray

    def deviation(self, part: int) -> FloatArray:
        """|X - its mean over the last *part*, a half or a quarter|^2 over the noise from differences there,
        less what noise gives, (n_block, n_channel) [1].
        """
        half = self.values[-max(-(-self.values.shape[0] // part), LEAST_BLOCKS) :]
        n = half.shape[0]
        noise = np.mean(np.abs(np.diff(half, axis=0)) ** 2, axis=0) / 2
        floor = LEAST_NOISE * np.mean(np.abs(half), axis=0)
        scale = np.maximum(noise, floor**2)
        early = np.arange(self.values.shape[0])[:, None] < self.values.shape[0] - n
        return np.asarray(
            np.abs(self.values - half.mean(axis=0)) ** 2 / scale - np.where(early, 1 + 1 / n, 1 - 1 / n)
        )


def settle_times(courses: Sequence[DwellCourse]) -> tuple[float, float, float]:
    """Time [s] after each step until the transient is below LEFT standard errors of every dwell's result,
    the earlier one at which it is CLEAR times the noise of a block, and the time constant of its decay; 0
    where none is seen: the excess over the noise is continued from where it is last seen. DataError when the
    transient outlasts the dwells, and without a dwell. Equation (frf-settle).
    """
    if not courses:
        what = f"no dwell has {2 * LEAST_BLOCKS} periods, so none shows its transient"
        raise DataError(what, hint="state `settle`")
    with contextlib.suppress(DataError):
        return _settling_times(courses, 2)
    # A transient that is seen beyond the middle may be over in the last quarter.
    return _settling_times(courses, 4)


def _settling_times(courses: Sequence[DwellCourse], part: int) -> tuple[float, float, float]:
    longest = reach = max(float(course.times[-1]) for course in courses)
    block = min(float(course.times[0]) for course in courses) * 2
    while True:
        edges = np.linspace(0, reach * (1 + 1e-9), N_BIN + 1)
        time, excess, error = _bin_means(courses, edges, part)
        seen = excess > SEEN * error
        last = int(np.argmin(seen)) if not np.all(seen) else seen.size
        if last == 0:
            return 0.0, 0.0, 0.0
        # A transient within the first bins of the longest dwell is told by finer ones.
        seen_to = float(edges[np.searchsorted(edges, time[last - 1], side="right")])
        if FINE * seen_to >= reach or reach <= N_BIN * block:
            break
        reach = max(FINE * seen_to, N_BIN * block)
    # A tenth beyond where the last part begins.
    if time[last - 1] > (1.1 - 1 / part) * longest:
        what = (
            f"the responses have not settled {time[last - 1]:.3g} s after a step, where the dwells last "
            f"{longest:.3g} s"
        )
        turning = "a tone beside the force, as of a turning shaft, never settles: `mask` the lines beside it"
        raise DataError(what, hint=f"longer dwells; or state `settle` ({turning})")
    tau = _time_constant(time[:last], excess[:last])
    settled, clear = seen_to, seen_to + 0.5 * tau * float(np.log(min(1.0, excess[last - 1] / CLEAR**2)))
    # The later a dwell is used, the fewer blocks are left, and the less is allowed.
    for _ in range(STEPS):
        wanted = min(transient_allowance(course, tau, settled) for course in courses)
        settled = seen_to + max(0.0, 0.5 * tau * float(np.log(excess[last - 1] / wanted)))
    return settled, max(0.0, clear), tau


def _bin_means(
    courses: Sequence[DwellCourse], edges: FloatArray, part: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    n_bin = edges.size - 1
    total, variance, when, count = np.zeros((4, n_bin))
    for course in courses:
        inside = course.times <= edges[-1]
        place = np.minimum(np.searchsorted(edges, course.times[inside], side="right") - 1, n_bin - 1)
        number = np.bincount(place, minlength=n_bin)
        deviation, at_least_one = course.deviation(part)[inside], np.maximum(number, 1)
        total += np.bincount(place, deviation.sum(axis=1), n_bin) / at_least_one
        # |noise|^2 of a block over its estimate from few others: F with 2 and about n degrees of freedom.
        of_block = deviation.shape[1] * (1.0 + 4.0 * part / inside.size)
        variance += np.where(number > 0, of_block / at_least_one, 0.0)
        when += np.bincount(place, course.times[inside], n_bin)
        count += number
    some = count > 0
    return when[some] / count[some], total[some], np.sqrt(variance[some])


def _time_constant(time: FloatArray, excess: FloatArray) -> float:
    """tau [s] of an excess exp(-2 t / tau) from its largest value on; at least a bin."""
    top = int(np.argmax(excess))
    shortest = float(time[-1]) / max(time.size, 1)
    if time.size - top < 2:
        return shortest
    slope = np.polyfit(time[top:], np.log(excess[top:]), 1)[0]
    return max(shortest, -2.0 / float(slope)) if slope < 0 else float(time[-1])


def transient_allowance(course: DwellCourse, tau: float, settled: float) -> float:
    """Largest (a / s)^2 at the time *settled* [s] that leaves LEFT standard errors in the mean of the n
    blocks after it, one at least.
    """
    n = max(1, int(np.sum(course.times > settled)))
    return float(LEFT**2 * n / max(1.0, tau / float(np.ptp(course.times[:2]))) ** 2)


def steady_part(
    blocks: ComplexArray, decay: float, shown: Sequence[int]
) -> tuple[ComplexArray, ComplexArray, float]:
    """Steady X (n_channel,) [unit of the channel] of *blocks* (n_block, n_channel) of whole periods beside
    one decaying motion, X_b = X + e^(-s b) (C cos(t b) + D sin(t b)) by least squares, its covariance
    (n_channel, n_channel), the pole's included, and the complex degrees of freedom. *decay* [1]: s of the
    dwells together, which a single one may miss by DECAY_ERROR. *shown*: channels that show the motion.
    Equation (frf-decaying).
    """
    count = blocks.shape[0]
    number = np.arange(count)
    scale = np.sqrt(np.mean(np.abs(np.diff(blocks[count // 2 :], axis=0)) ** 2, axis=0) / 2)
    scaled = (blocks / np.maximum(scale, np.finfo(float).eps * np.abs(blocks).max(axis=0)))[:, shown]
    target = np.hstack([scaled.real, scaled.imag])

    def basis(pole: FloatArray) -> FloatArray:
        # sin(t b) / t: the columns stay apart where the sine is at the pole.
        motions = np.cos(pole[1] * number), number * np.sinc(pole[1] * number / np.pi)
        return np.vstack([np.ones(count), np.exp(-pole[0] * number) * motions]).T

    def misfit(pole: FloatArray) -> FloatArray:
        columns = basis(pole)
        rest = target - columns @ (np.linalg.pinv(columns) @ target)
        return np.append(rest, np.log(pole[0] / decay) / DECAY_ERROR / 2**0.5)

    starts = [np.array([decay, swing]) for swing in np.linspace(0.02, 3.12, 32)]
    first = min(starts, key=lambda pole: float(np.sum(misfit(pole) ** 2)))
    bounds = [decay / 4, 0.0], [decay * 4, np.pi]
    best = scipy.optimize.least_squares(misfit, first, "3-point", bounds, ftol=1e-14, xtol=1e-14, gtol=1e-14)
    inverse = np.linalg.pinv(basis(best.x))
    factors = inverse @ blocks
    error = blocks - basis(best.x) @ factors
    dof = count - 4.0
    of_residual = np.einsum("na,nb->ab", error, error.conj()) / dof
    # What an error of the pole makes of X, by the variance of the scaled residual.
    step = 1e-5
    moved = [np.linalg.pinv(basis(best.x + change))[0] @ blocks for change in step * np.eye(2)]
    by_pole = (np.array(moved) - factors[0]).T / step
    of_pole = np.linalg.pinv(best.jac.T @ best.jac) * 2 * best.cost / (target.shape[1] * dof)
    noise = of_residual * float(inverse[0] @ inverse[0]) + by_pole @ of_pole @ by_pole.conj().T
    return factors[0], noise, dof


# Blocks into which a dwell is cut for its noise: at most, and at least.
MOST_BLOCKS, LEAST_BLOCKS = 32, 4
# Fewest samples of a block, so that three values are fitted to more.
LEAST_SAMPLES = 8
# Share of the dwells that may be left out since they are too short for the transient of all.
MOST_SHORT = 0.5
# Frequencies of two dwells are the same within this share of one over their length.
SAME_LINE = 0.05
# Share of the force's power that the sine explains in a dwell, and of the largest amplitude that it has.
SINE_SHARE, LEAST_LEVEL = 0.8, 0.01


@dataclass(frozen=True)
class EvaluatedDwell:
    """A dwell evaluated: *frequency* [Hz] and its variance [Hz^2], *duration* [s] of what is used, complex
    degrees of freedom *dof*. mean (n_channel,) [unit of the channel], its covariance *noise* (n_channel,
    n_channel) [unit^2].
    """

    frequency: float
    variance: float
    duration: float
    mean: ComplexArray
    noise: ComplexArray
    dof: float


def stepped_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF H = Y pinv(U) at the frequencies at which every recording dwells. DataError when a recording
    has no dwells, when one is too short, when the recordings have no frequency in common, or when the forces
    are not independent. Equation (frf-stepped).
    """
    measured = [
        _lines(source, settings, layout.input_columns[number], layout.output_columns[number])
        for number, source in enumerate(sources)
    ]
    common, n_alone = _common([lines for lines, _ in measured])
    frequency = np.array([np.mean([line.frequency for line in row]) for row in common])
    chosen = select_lines(frequency, settings)
    common = [row for row, is_chosen in zip(common, chosen, strict=True) if is_chosen]
    columns = list(zip(*common, strict=True))
    n_input = len(layout.inputs)
    mean = np.stack(
        [layout.pad(e, np.stack([line.mean for line in lines]), 1) for e, lines in enumerate(columns)], axis=2
    )
    dof = min(line.dof for row in common for line in row)
    half_width = min(settings.smooth, int(np.ceil((ENOUGH_DOF / dof - 1) / 2))) if dof < ENOUGH_DOF else 0
    noise = np.stack([layout.pad(e, _noise(lines, half_width), 2) for e, lines in enumerate(columns)])
    inverse = force_inverse(mean[:, :n_input], layout)
    matrix = joined_response(mean, inverse, noise)
    findings = [finding for _, of_source in measured for finding in of_source]
    if n_alone:
        what = f"{n_alone} dwell(s) are left out: not every recording has their frequency"
        findings.append(Finding("dwells-left-out", what))
    return Parts(
        frequency=frequency[chosen],
        matrix=matrix,
        covariance=covariance_of_periodic(matrix, inverse, noise)
        + _of_frequency(frequency[chosen], matrix, common),
        averages=dof + 1,
        dof=dof * min(2 * half_width + 1, len(common)),
        findings=tuple(findings),
        snr=signal_to_noise(mean, noise),
    )


def _of_frequency(
    frequency: FloatArray, matrix: ComplexArray, rows: Sequence[tuple[EvaluatedDwell, ...]]
) -> ComplexArray:
    """Covariance by the uncertainty of the frequency: g g^H var(f), g = dH/df (n_line, n)."""
    flat = matrix.reshape(frequency.size, -1)
    slope = np.zeros(flat.shape, np.complex128)
    if frequency.size > 1:
        slope[:] = np.gradient(flat, frequency, axis=0)
    variance = np.array([max(line.variance for line in row) for row in rows])
    return slope[:, :, None] * slope[:, None, :].conj() * variance[:, None, None]


def _noise(lines: Sequence[EvaluatedDwell], half_width: int) -> ComplexArray:
    duration = np.array([line.duration for line in lines])[:, None, None]
    noise = np.stack([line.noise for line in lines])
    if half_width == 0:
        return noise
    return neighbourhood_mean(noise * duration, np.ones(len(lines), bool), half_width) / duration


def _lines(
    source: SampleSource, settings: FrfSettings, input_columns: Sequence[int], output_columns: Sequence[int]
) -> tuple[list[EvaluatedDwell], list[Finding]]:
    samples = np.concatenate(list(checked_blocks(source)))
    rate = source.sample_rate
    force = loudest(samples, np.array([column for column in input_columns if column >= 0]))
    try:
        dwells = _loud_sines(samples[:, force], find_dwells(samples[:, force]))
        # The other forces are noise here, references know nothing of the steps.
        shown = [force, *output_columns]
        courses = _courses(samples[:, shown], dwells, rate)
        settling = (settings.settle, np.inf, 0.0) if settings.settle is not None else settle_times(courses)
    except DataError as error:
        raise DataError(f"'{source.name}': {error.what}", hint=error.hint) from None
    # The force alone gives the frequency.
    of_force = settling[0]
    with contextlib.suppress(DataError):
        of_force = min(settling[0], settle_times([DwellCourse(c.times, c.values[:, :1]) for c in courses])[0])
    lines, short = [], []
    for dwell in dwells:
        try:
            lines.append(_line(source, samples, dwell, (*settling, of_force, settings.skip), shown))
        except DataError as error:
            short.append(error)
    if len(short) > MOST_SHORT * len(dwells):
        raise short[0]
    groups: list[list[EvaluatedDwell]] = []
    for line in sorted(lines, key=lambda line: line.frequency):
        if groups and _same(groups[-1][0], line):
            groups[-1].append(line)
        else:
            groups.append([line])
    merged = [_average(group) for group in groups]
    used = sum(line.duration for line in lines) * rate / samples.shape[0]
    repeats = f" ({len(lines)} dwells)" if len(lines) > len(merged) else ""
    modelled = sum(_is_modelled((d.stop - d.start) / rate, *settling[:2]) for d in dwells)
    left_out = f"{settling[0]:.3g} s are left out after each step"
    if modelled:
        left_out += (
            f", of {modelled} short dwell(s) {settling[1]:.3g} s, the rest of their transient is modelled"
        )
    message = (
        f"'{source.name}': {len(merged)} frequencies{repeats}, "
        f"{merged[0].frequency:.6g}-{merged[-1].frequency:.6g} Hz; {left_out}; "
        f"{100 * used:.0f} % of the record is used"
    )
    findings = [note("dwells", message)]
    if short:
        what = "; ".join(error.what for error in short)
        findings.append(Finding("dwells-left-out", f"{len(short)} dwell(s) too short are left out: {what}"))
    return merged, findings


def _loud_sines(force: FloatArray, dwells: list[Dwell]) -> list[Dwell]:
    """Dwells in which a sine explains the force; pauses with hum are none."""
    sizes, shares = [], []
    for dwell in dwells:
        part = force[dwell.start : dwell.stop]
        size = float(np.abs(amplitudes(part[:, None], dwell.frequency)[0]))
        sizes.append(size)
        shares.append(size**2 / 2 / max(float(np.var(part)), np.finfo(float).tiny))
    kept = [
        dwell
        for dwell, size, share in zip(dwells, sizes, shares, strict=True)
        if share > SINE_SHARE and size > LEAST_LEVEL * max(sizes)
    ]
    if not kept:
        raise DataError("the force is not a sine in any of its dwells", hint="is it another excitation?")
    return kept


def _courses(samples: FloatArray, dwells: list[Dwell], rate: float) -> list[DwellCourse]:
    """Amplitudes from the step on, of dwells with periods enough; first the force that steps."""
    courses = []
    for dwell in dwells:
        part = samples[dwell.start : dwell.stop]
        # An error of the frequency would turn the amplitudes as a transient does; the force settles first.
        frequency = sine_frequency(part[part.shape[0] // 2 :, 0], dwell.frequency)
        length = max(1, int(np.ceil(LEAST_SAMPLES * frequency))) / frequency
        count = int(part.shape[0] / length) - 1
        if count >= 2 * LEAST_BLOCKS:
            values = block_amplitudes(part, frequency, length, count)
            courses.append(DwellCourse((np.arange(count) + 0.5) * length / rate, values))
    return courses


def _is_modelled(length: float, settle: float, clear: float) -> bool:
    """Whether too little of a dwell of this *length* is left by the times of settle_times [s]."""
    return clear < settle and settle > (1 - SETTLED_SHARE) * length


def _line(
    source: SampleSource,
    samples: FloatArray,
    dwell: Dwell,
    settling: tuple[float, float, float, float, int],
    shown: Sequence[int],
) -> EvaluatedDwell:
    """*settling*: the times of settle_times, that which the force takes [s], and periods dropped in any case.
    *shown*: the force that steps, first, and the channels that show what has settled.
    """
    rate, (settle, clear, tau, of_force, skip) = source.sample_rate, settling
    length = (dwell.stop - dwell.start) / rate
    if is_modelled := _is_modelled(length, settle, clear):
        settle, of_force = clear, min(of_force, SETTLED_SHARE * length)
    start, begin = (
        dwell.start + int(np.ceil(max(time * rate, skip / dwell.frequency))) for time in (settle, of_force)
    )
    # The last period may hold the beginning of the next step.
    n_period = int((dwell.stop - start) * dwell.frequency) - 1
    # Whole periods per block: as many as hold LEAST_SAMPLES, and so many that there are at most MOST_BLOCKS.
    per_block = max(int(np.ceil(LEAST_SAMPLES * dwell.frequency)), -(-n_period // MOST_BLOCKS), 1)
    count = n_period // per_block
    least = 3 * LEAST_BLOCKS if is_modelled else LEAST_BLOCKS
    if count < least:
        needed = (start - dwell.start + (least * per_block + 2) / dwell.frequency) / rate
        what = (
            f"the dwell of '{source.name}' at {dwell.frequency * rate:.6g} Hz lasts {length:.3g} s, "
            f"{needed:.3g} s are needed"
        )
        hint = "longer dwells, or state `settle`; a slow sweep has none"
        raise DataError(f"{what}: {settle:.3g} s for its transient, then periods", hint=hint)
    rough = samples[start : start + round(n_period / dwell.frequency)]
    period = round(1 / dwell.frequency)
    steady = samples[begin : dwell.stop - period, shown[0]]
    frequency = sine_frequency(steady, dwell.frequency)
    variance = frequency_variance(steady, frequency) * rate**2
    n_block = per_block / frequency
    blocks = block_amplitudes(rough, frequency, n_block, count)
    used = rough[: round(count * n_block)]
    if is_modelled:
        mean, noise, dof = steady_part(blocks, n_block / rate / tau, shown)
    else:
        mean, dof = amplitudes(used, frequency), count - 1.0
        error = blocks - blocks.mean(axis=0)
        noise = np.einsum("na,nb->ab", error, error.conj()) / (count * (count - 1))
    turn = np.exp(-1j * np.angle(mean[shown[0]]))
    return EvaluatedDwell(frequency * rate, variance, used.shape[0] / rate, mean * turn, noise, dof)


def _same(first: EvaluatedDwell, other: EvaluatedDwell) -> bool:
    return abs(first.frequency - other.frequency) < SAME_LINE / min(first.duration, other.duration)


def _average(group: list[EvaluatedDwell]) -> EvaluatedDwell:
    shares = np.array([line.duration for line in group]) / sum(line.duration for line in group)
    return EvaluatedDwell(
        frequency=float(shares @ [line.frequency for line in group]),
        variance=float(shares**2 @ [line.variance for line in group]),
        duration=sum(line.duration for line in group),
        mean=np.tensordot(shares, [line.mean for line in group], axes=1),
        noise=np.tensordot(shares**2, [line.noise for line in group], axes=1),
        dof=sum(line.dof for line in group),
    )


def _common(recordings: Sequence[list[EvaluatedDwell]]) -> tuple[list[tuple[EvaluatedDwell, ...]], int]:
    rows = []
    for line in recordings[0]:
        partners = [next((other for other in lines if _same(line, other)), None) for lines in recordings[1:]]
        row = (line, *(other for other in partners if other is not None))
        if len(row) == len(recordings):
            rows.append(row)
    if not rows:
        what = "the recordings dwell at no frequency in common"
        raise DataError(what, hint="the same steps in every force direction")
    return rows, sum(len(lines) for lines in recordings) - len(rows) * len(recordings)
