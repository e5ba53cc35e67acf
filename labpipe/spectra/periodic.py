"""Recordings of a periodic excitation -> FRF matrix: scatter between periods as covariance, phase
realisations, nonlinear distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import itemgetter
from typing import Any

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse, diagonal_covariance
from labpipe.spectra import joint
from labpipe.spectra.bands import line_range
from labpipe.spectra.channels import checked_blocks, columns_of
from labpipe.spectra.covariance import covariance_of_periodic, joined_response, noise_shape
from labpipe.spectra.feedback import feedback_of_periods
from labpipe.spectra.matrices import hermitian
from labpipe.spectra.period_average import (
    LineSpectrum,
    PeriodAverage,
    RestMotion,
    excited_lines,
    is_unsettled,
    jump_finding,
    neighbourhood_mean,
    samples_per_period,
    settling_finding,
    smoothed_noise,
)
from labpipe.spectra.ports import POOR_SHARE, Layout, Parts, select_lines
from labpipe.spectra.quality import force_inverse, multiple_coherence, signal_to_noise
from labpipe.spectra.random import cut_at
from labpipe.spectra.random_lines import LOW_SNR, check_injection, low_snr
from labpipe.spectra.settings import FrfSettings


def no_line(acting: BoolArray, names: Sequence[str] = ()) -> DataError:
    """The fault of forces, by their *names*, that act, by *acting* (n_line, n_force), on no line together."""
    if acting.shape[1] > 1 and np.all(np.any(acting, axis=0)):
        what = "no line is excited by all forces independently: their lines are interleaved"
        return DataError(what, hint="use frf: {result: spectra} with model: dynamic-stiffness")
    silent = "".join(f" {name}" for name, acts in zip(names, acting.T, strict=False) if not np.any(acts))
    hint = "check `period` and `band`, or raise the level; a channel that drives nothing is a `reference`"
    return DataError(f"no line of the force{silent} exceeds its noise", hint=hint)


# Share of the responses' scatter between periods that follows the forces' from which on these are no noise,
# and the least periods over the forces: of independent ones 1 / (n - 1) follows a force by chance.
FOLLOWS, PERIODS_PER_FORCE = 0.5, 4


def _check_repeated(spectra: Sequence[LineSpectrum], sources: Sequence[SampleSource], period: float) -> None:
    """DataError where a force differs from period to period and moves the responses: it is no noise that
    would hide its lines.
    """
    for spectrum, source in zip(spectra, sources, strict=True):
        forces, outputs = (columns_of(source.channels, role) for role in ("input", "output"))
        if spectrum.noise is None or spectrum.n_period <= PERIODS_PER_FORCE * len(forces):
            continue
        s_yu, s_yy = (spectrum.noise[:, outputs][:, :, side] for side in (forces, outputs))
        h1 = s_yu @ np.linalg.pinv(spectrum.noise[:, forces][:, :, forces], hermitian=True)
        power = np.einsum("foo->fo", s_yy).real
        share = np.average(multiple_coherence(h1, s_yu, s_yy), axis=0, weights=power)
        if np.max(share) > FOLLOWS:
            names = ", ".join(source.channels[column].name for column in forces)
            what = (
                f"recording '{source.name}': {names} differs from period to period, and the responses with "
                f"it: its phases change from block to block, or it does not repeat every {period:g} s"
            )
            hint = (
                "of random phases give every block in which motion is steady as a recording of its own, "
                "{file: ..., start: ..., end: ...}, with `realisations: true`; a force without a period is "
                "`excitation: random`"
            )
            raise DataError(what, hint=hint)


def periodic_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF H = Y pinv(U) of the period averages of all recordings, at the lines where every force acts.
    DataError when no line of a force exceeds its noise, or when the forces are not independent. Equation
    (frf-periodic).
    """
    assert settings.period is not None
    averaged = [period_average(source, settings) for source in sources]
    single = _with_noise([spectrum for spectrum, _, _ in averaged], sources)
    of_motion = tuple(finding for *_, findings in averaged for finding in findings)
    unsettled = is_unsettled(of_motion)
    spectra = [smoothed_noise(spectrum, settings.smooth) for spectrum in single]
    acting = _acting(spectra, layout)
    lines = np.all(acting, axis=1)
    if settings.reference and np.any(lines):
        lines = _injected_lines(spectra, sources, settings)
    if not np.any(lines):
        _check_repeated(single, sources, settings.period)
        raise no_line(acting, [port.label for port in layout.inputs])
    n_input = len(layout.inputs)
    mean = np.stack([layout.pad(e, s.mean[lines], 1) for e, s in enumerate(spectra)], axis=2)
    inverse = force_inverse(mean[:, :n_input], layout)
    half_width = 0 if settings.reference else settings.smooth
    spectra = _smoothed_by_response(single, spectra, lines, mean[:, n_input:] @ inverse, layout, half_width)
    frequency = spectra[0].frequency
    noises = [layout.pad(e, s.noise, 2) for e, s in enumerate(spectra) if s.noise is not None]
    noise = np.stack(noises) if len(noises) == len(spectra) else None
    matrix = joined_response(mean, inverse, noise)
    covariance = snr = open_loop = None
    if noise is None:
        message = (
            f"{spectra[0].n_period} period is left, so the noise of the FRF is unknown; record at least 2 "
            "periods after the transient ones"
        )
        findings = [Finding("no-covariance", message)]
    else:
        snr = signal_to_noise(mean, noise)
        findings = list(_snr_findings(snr, mean, layout, not unsettled))
    if settings.reference and noise is not None and snr is not None:
        for number, port in enumerate(layout.inputs):
            check_injection(snr[:, number], frequency, settings.reference, [port.label])
        covariance = joint.covariance_by_neighbours(frequency, matrix, mean, noises)
        power = np.tensordot([spectrum.n_period for spectrum in spectra], noise, axes=1)
        open_loop = joint.open_loop_estimate(mean @ hermitian(mean) + power, n_input)
        findings.append(joint.open_loop_note(frequency, matrix, covariance, open_loop))
    else:
        covariance = None if noise is None else covariance_of_periodic(matrix, inverse, noise)
        findings += feedback_of_periods([s.select(lines) for s in single], matrix, inverse, layout)
        findings += () if unsettled else _left_out_notes(single, lines, matrix, layout, settings.period)
    return Parts(
        frequency=frequency,
        matrix=matrix,
        covariance=covariance,
        averages=float(min(spectrum.n_period for spectrum in spectra)),
        dof=np.inf if noise is None else min(spectrum.dof for spectrum in spectra),
        findings=(*of_motion, *findings),
        snr=snr,
        change=None if unsettled else _change(spectra, [half for _, half, _ in averaged], lines, layout),
        open_loop=open_loop,
    )


def _smoothed_by_response(
    single: Sequence[LineSpectrum],
    smoothed: Sequence[LineSpectrum],
    lines: BoolArray,
    response: ComplexArray,
    layout: Layout,
    half_width: int,
) -> list[LineSpectrum]:
    """The *smoothed* spectra at *lines*. Where the noise of outputs grows with their *response* (n_line,
    n_output, n_input) [unit/N], as what a rig answers to besides the forces does, and this is likelier, that
    of the *single* lines is averaged over neighbours relative to a + b |H|^2.
    """
    spectra = []
    for one, spectrum, columns in zip(single, smoothed, layout.output_columns, strict=True):
        if one.noise is not None and half_width > 0:
            variance = np.einsum("laa->la", one.noise).real
            shape, of_line = np.ones_like(variance), 1 / float(np.min(one.line_dof))
            courses = noise_shape(variance[lines][:, columns], response, of_line, half_width)
            for column, course in zip(columns, courses.T, strict=True):
                shape[:, column] = np.interp(one.frequency, one.frequency[lines], course)
            if np.any(shape != 1):
                scale = np.sqrt(shape[:, :, None] * shape[:, None, :])
                spectrum = smoothed_noise(replace(one, noise=one.noise / scale), half_width)
                assert spectrum.noise is not None
                spectrum = replace(spectrum, noise=spectrum.noise * scale)
        spectra.append(spectrum.select(lines))
    return spectra


def _with_noise(spectra: Sequence[LineSpectrum], sources: Sequence[SampleSource]) -> list[LineSpectrum]:
    """The spectra, of single periods with the noise of a period in other recordings of the same channels."""
    names = [[channel.name for channel in source.channels] for source in sources]
    completed = []
    for spectrum, here in zip(spectra, names, strict=True):
        others = [
            (s, s.noise) for s, n in zip(spectra, names, strict=True) if n == here and s.noise is not None
        ]
        if spectrum.noise is None and others:
            dof = np.array([other.line_dof for other, _ in others])
            scatter = [d[:, None, None] * s.n_period * n for d, (s, n) in zip(dof, others, strict=True)]
            dof = dof.sum(axis=0)
            noise = np.sum(scatter, axis=0) / dof[:, None, None]
            spectrum = replace(spectrum, noise=noise, line_dof=dof)
        completed.append(spectrum)
    return completed


def _injected_lines(
    spectra: Sequence[LineSpectrum], sources: Sequence[SampleSource], settings: FrfSettings
) -> BoolArray:
    """Lines (n_line,) at which a reference acts in every recording: what else repeats is a disturbance that
    the loop answers. Not where a force exceeds its noise: to choose lines by the force's noise prefers errors
    of one sign. DataError for a reference without lines.
    """
    joint.check_references(sources, settings)
    injected = np.ones(spectra[0].frequency.size, bool)
    for spectrum, source in zip(spectra, sources, strict=True):
        columns = [
            number
            for number, channel in enumerate(source.channels)
            if channel.name in settings.reference and np.any(spectrum.mean[:, number] != 0)
        ]
        lines = excited_lines(spectrum, columns) if columns else np.zeros_like(injected)
        if not np.any(lines):
            named = ", ".join(settings.reference)
            what = f"recording '{source.name}': no line of the reference {named} exceeds its noise"
            raise DataError(what, hint="is it what is injected into this loop, and `period` its period?")
        injected &= lines
    if not np.any(injected):
        what = "no line is excited by a reference in all recordings"
        raise DataError(what, hint="inject the same lines into every axis, one by one")
    return injected


def _change(
    spectra: Sequence[LineSpectrum], halves: Sequence[LineSpectrum | None], lines: BoolArray, layout: Layout
) -> ComplexArray | None:
    first = [half.select(lines) for half in halves if half is not None]
    if len(first) < len(spectra):
        return None
    rest = [
        (s.mean * s.n_period - half.mean * half.n_period) / (s.n_period - half.n_period)
        for s, half in zip(spectra, first, strict=True)
    ]
    before, after = (
        np.stack([layout.pad(e, mean, 1) for e, mean in enumerate(means)], axis=2)
        for means in ([half.mean for half in first], rest)
    )
    n_input = len(layout.inputs)
    old, new = (mean[:, n_input:] @ force_inverse(mean[:, :n_input], layout) for mean in (before, after))
    return new - old


def _acting(spectra: Sequence[LineSpectrum], layout: Layout) -> BoolArray:
    """Whether every force acts in one of the recordings (n_line, n_input), not hum in one alone."""
    acting = np.zeros((spectra[0].frequency.size, len(layout.inputs)), bool)
    for spectrum, columns in zip(spectra, layout.input_columns, strict=True):
        for number, column in enumerate(columns):
            if column >= 0:
                acting[:, number] |= excited_lines(spectrum, [column])
    return acting


def period_average(
    source: SampleSource, settings: FrfSettings
) -> tuple[LineSpectrum, LineSpectrum | None, tuple[Finding, ...]]:
    """The averaged lines of one recording in the band, those of the first half of its periods, and
    findings: motion that had not settled, a rest position that creeps, periods that change at once.
    """
    assert settings.period is not None
    n_sample = samples_per_period(settings.period, source.sample_rate)
    average, spectrum, half = _average(source, settings, n_sample)
    findings = settling_finding(average.differences, source.channels, source.name, settings.skip)
    jumps = () if findings else jump_finding(average, source, settings.skip)
    creep = None if findings else average.creep(spectrum)
    if creep is not None:
        average, spectrum, half = _average(source, settings, n_sample, creep)
        findings = (_creep_note(creep, source),)
    n_beside = 0 if is_unsettled(findings) else average.lines_beside()
    if n_beside:
        _, spectrum, half = _average(source, settings, n_sample, creep, n_beside)
        findings = (*findings, _beside_note(source, settings.period))
    chosen = select_lines(spectrum.frequency, settings)
    return spectrum.select(chosen), None if half is None else half.select(chosen), (*findings, *jumps)


def _average(
    source: SampleSource,
    settings: FrfSettings,
    n_sample: int,
    creep: RestMotion | None = None,
    n_beside: int = 0,
) -> tuple[PeriodAverage, LineSpectrum, LineSpectrum | None]:
    lines = line_range(n_sample, source.sample_rate, settings.band, source.n_sample)
    n_due = max(source.n_sample // n_sample - settings.skip, 0)
    average = PeriodAverage(n_sample, len(source.channels), settings.skip, lines, creep, n_due, n_beside)
    half: LineSpectrum | None = None
    n_half = n_due // 2
    for block, ends_half in cut_at(checked_blocks(source), (settings.skip + n_half) * n_sample):
        average.add(block)
        if ends_half and n_half > 0:
            half = average.spectrum(source.sample_rate)
    return average, average.spectrum(source.sample_rate), half


def _creep_note(creep: RestMotion, source: SampleSource) -> Finding:
    sizes = np.sqrt(np.mean(creep.slope**2, axis=0))
    moved = "; ".join(
        f"{channel.name} by {size:.3g} {channel.unit} from period to period"
        for channel, size in zip(source.channels, sizes, strict=True)
        if size > 0
    )
    message = (
        f"recording '{source.name}': the rest position creeps: {moved} (r.m.s.). A straight line and a "
        "parabola through the means of neighbouring periods are subtracted, as `detrend` does from random "
        "data; what bends within a period stays. Fix what creeps, or give it a spring to a place of rest"
    )
    return note("rest-moves", message)


def _beside_note(source: SampleSource, period: float) -> Finding:
    message = (
        f"recording '{source.name}': the noise of a period goes on in the next one, as that of a lightly "
        "damped mode does, so that its scatter says too little at a resonance and too much beside it: the "
        f"noise of the mean is that between the lines, which stand {1 / period:.3g} Hz apart"
    )
    return note("noise-between-lines", message)


def _snr_findings(snr: FloatArray, mean: ComplexArray, layout: Layout, settled: bool) -> tuple[Finding, ...]:
    """Forces line by line, since their noise makes H too small there; responses by their power over the band,
    as lines weigh by noise. Not responses that have not *settled*: their scatter is not noise.
    """
    n_input = len(layout.inputs)
    poor = np.mean(snr[:, :n_input] < LOW_SNR, axis=0)
    size = np.max(np.abs(mean[:, n_input:]), axis=2)
    noise = np.divide(size, snr[:, n_input:], out=np.zeros_like(size), where=size > 0)
    weak = np.sum(noise**2, axis=0) * LOW_SNR**2 > np.sum(size**2, axis=0)
    forces = (
        low_snr(port.label, f" at {100 * share:.0f} % of the lines")
        for port, share in zip(layout.inputs, poor, strict=True)
        if share > POOR_SHARE
    )
    responses = (
        low_snr(port.label, ", in power over the band")
        for port, is_weak in zip(layout.outputs, weak, strict=True)
        if is_weak and settled
    )
    return (*forces, *responses)


@dataclass(frozen=True)
class Distortion:
    """Levels of an FRF (n_frequency, n_output, n_input) [its unit], deviations those of one realisation.
    gain: best linear approximation, the mean of the realisations; total: standard deviation between
    realisations of the phases; noise: that from the scatter between periods; nonlinear: the excess of total
    over noise.
    """

    gain: ComplexArray
    total: FloatArray
    noise: FloatArray

    @property
    def nonlinear(self) -> FloatArray:
        """sqrt(total^2 - noise^2), (n_frequency, n_output, n_input) [unit of the FRF]; least 0. Equation
        (frf-distortion).
        """
        return np.sqrt(np.maximum(self.total**2 - self.noise**2, 0.0))


def robust_distortion(realisations: Sequence[FrequencyResponse], single: bool = False) -> Distortion:
    """Distortion from FRFs of one rig under several random-phase realisations of one excitation. The robust
    method (Pintelon and Schoukens, System Identification, 2nd ed., sec. 4.3.1). DataError for fewer than two
    realisations, different lines, or FRFs of *single* periods unless their unknown noise is to count as 0.
    """
    if len(realisations) < 2:
        what = "distortion needs at least two realisations of the phases"
        raise DataError(what, hint="record with other phases")
    first = realisations[0]
    for other in realisations:
        if other.frequency.shape != first.frequency.shape or np.any(other.frequency != first.frequency):
            raise DataError(f"'{other.name}' has other lines than '{first.name}'")
        if other.variance is None and not single:
            what = f"'{other.name}' has no covariance, so its noise level is unknown"
            raise DataError(what, hint="record several periods")
    total = np.var([response.matrix for response in realisations], axis=0, ddof=1)
    noise = np.zeros(total.shape) if single else np.sqrt(_mean_of(realisations, "variance"))
    return Distortion(_mean_of(realisations, "matrix"), np.sqrt(total), noise)


# A kind of lines that the force leaves out is looked at from so many on; what moves there is named from this
# share of the response and with this probability by chance on.
LEAST_LEFT_OUT, LEAST_SHARE, BY_CHANCE = 4, 1e-3, 1e-5
MEANINGS = {
    "odd": "stiffness or friction that changes with the motion alike both ways, or hum",
    "even": "what differs between one way and the other, or hum",
    "": "nonlinear behaviour, or hum",
}


@dataclass(frozen=True)
class LeftOutLines:
    """What moves at lines that the force leaves out, beyond the answer H U to what is left of it there:
    *frequency* (n,) [Hz], *level* |Y - H U| and its *noise* as a standard deviation (n,) [unit of the
    channel], *dof* (n,) complex degrees of freedom of the noise.
    """

    frequency: FloatArray
    level: FloatArray
    noise: FloatArray
    dof: FloatArray

    @property
    def distortion(self) -> float:
        """Root mean square of the level after subtraction of the noise power; 0 where the noise is stronger.
        Equation (frf-detection).
        """
        return max(float(np.mean(self.level**2 - self.noise**2)), 0.0) ** 0.5

    @property
    def chance(self) -> float:
        """Probability that noise alone has such levels, by those of the lines, (1 + |Y|^2 / (nu s^2))^-nu: of
        all together (Fisher's sum), or of the least of them, as hum is in one.
        """
        if not np.all(self.noise > 0):
            return 0.0 if np.any(self.level > 0) else 1.0
        logarithms = self.dof * np.log1p(self.level**2 / self.noise**2 / self.dof)
        n = self.dof.size
        of_all, of_one = chi2_tail(2 * np.sum(logarithms), 2 * n), n * np.exp(-np.max(logarithms))
        return float(min(2 * of_all, 2 * of_one, 1.0))


def left_out_lines(
    spectrum: LineSpectrum, acting: BoolArray, matrix: ComplexArray, output: int, period: float
) -> dict[str, LeftOutLines]:
    """The lines within the band of those where a force is *acting* (n_line,) at which none does, by kind:
    "odd" and "even" where forces act at odd multiples of 1 / *period* [s] alone, else "". Of nonlinearity of
    even and odd order (Pintelon and Schoukens, sec. 4.3.2: the fast method). *spectrum*: forces first, then
    outputs; *matrix* (n_line, n_output, n_input): H at all lines. Kinds of fewer than four lines are left
    out.
    """
    first, last = np.flatnonzero(acting)[[0, -1]]
    silent = ~acting
    silent[:first] = silent[last + 1 :] = False
    is_odd = np.round(spectrum.frequency * period).astype(np.int64) % 2 == 1
    kinds = {"odd": silent & is_odd, "even": silent & ~is_odd} if np.all(is_odd[acting]) else {"": silent}
    chosen = [*range(matrix.shape[2]), matrix.shape[2] + output]
    by_kind = {}
    for kind, lines in kinds.items():
        if lines.sum() >= LEAST_LEFT_OUT and spectrum.noise is not None:
            row = np.concatenate([-matrix[lines, output], np.ones((lines.sum(), 1))], axis=1)
            rest = np.einsum("lc,lc->l", row, spectrum.mean[lines][:, chosen])
            noise = spectrum.noise[lines][:, chosen][:, :, chosen]
            std = np.sqrt(np.maximum(np.einsum("lc,lcd,ld->l", row, noise, row.conj()).real, 0.0))
            by_kind[kind] = LeftOutLines(
                spectrum.frequency[lines], np.abs(rest), std, spectrum.line_dof[lines]
            )
    return by_kind


def _left_out_notes(
    spectra: Sequence[LineSpectrum], lines: BoolArray, matrix: ComplexArray, layout: Layout, period: float
) -> tuple[Finding, ...]:
    largest: dict[tuple[str, str], tuple[float, float]] = {}
    frequency = spectra[0].frequency
    whole = (
        np.apply_along_axis(lambda column: np.interp(frequency, frequency[lines], column), 0, matrix)
        if lines.sum() > 1
        else None
    )
    for number, spectrum in enumerate(spectra):
        columns = [column for column in layout.input_columns[number] if column >= 0]
        acting = lines | excited_lines(spectrum, columns)
        if whole is None or spectrum.noise is None or np.all(acting):
            continue
        mean = layout.pad(number, spectrum.mean, 1)
        ordered = replace(spectrum, mean=mean, noise=layout.pad(number, spectrum.noise, 2))
        for output, port in enumerate(layout.outputs):
            size = float(np.sqrt(np.mean(np.abs(mean[lines, len(layout.inputs) + output]) ** 2)))
            for kind, silent in left_out_lines(ordered, acting, whole, output, period).items():
                share = silent.distortion / size if size else 0.0
                before = largest.get((port.label, kind), (LEAST_SHARE, 0.0))
                if share > before[0] and silent.chance < BY_CHANCE:
                    largest[port.label, kind] = share, float(silent.frequency[np.argmax(silent.level)])
    return tuple(
        note(
            "lines-left-out",
            f"channel {label}: at {kind or 'the'} lines that the force leaves out it moves by "
            f"{100 * share:.2g} % of what it does at the others (r.m.s.), most at {at:.4g} Hz: "
            f"{MEANINGS[kind]}",
        )
        for (label, kind), (share, at) in largest.items()
    )


# Share of the lines of a realisation that the others must have; what a response has at every line.
MOST_COMMON = 0.5
BY_LINE = (
    "frequency", "matrix", "covariance", "coherence", "multiple_coherence", "partial_coherence", "change",
    "open_loop", "snr",
)  # fmt: skip


def realisations(sources: Sequence[SampleSource]) -> list[list[SampleSource]]:
    """The recordings of the first realisation, of the second, ...: for every set of forces in order, as many
    as it has forces. DataError unless every set of forces has the same number of realisations, at least two.
    """
    series: dict[tuple[tuple[str, str], ...], list[SampleSource]] = {}
    for source in sources:
        forces = tuple((channel.name, channel.dof) for channel in source.channels if channel.role == "input")
        series.setdefault(forces, []).append(source)
    counts = {divmod(len(members), max(len(forces), 1)) for forces, members in series.items()}
    number, rest = min(counts)
    if len(counts) > 1 or number < 2 or rest:
        hint = "as many recordings of every force direction, two or more; leave `realisations` out for one"
        raise DataError(f"{len(sources)} recording(s) do not form realisations of one measurement", hint=hint)
    # Of every set of forces as many recordings as it has forces, one realisation after the other.
    sizes = [len(members) // number for members in series.values()]
    pairs = list(zip(series.values(), sizes, strict=True))
    return [
        [source for members, size in pairs for source in members[n * size : (n + 1) * size]]
        for n in range(number)
    ]


def at_common_lines(responses: Sequence[FrequencyResponse]) -> list[FrequencyResponse]:
    """The *responses* at the lines that all have: at weak ones a force stands out of its noise in some
    realisations alone. DataError where most lines of any are not common.
    """
    common: FloatArray = reduce(np.intersect1d, [response.frequency for response in responses])
    parts = []
    for number, other in enumerate(responses, start=1):
        if common.size < MOST_COMMON * other.n_frequency:
            what = (
                f"of {other.n_frequency} lines of realisation {number} only {common.size} are in all others"
            )
            raise DataError(what, hint="realisations differ in their phases alone")
        lines = np.isin(other.frequency, common)
        values = {name: getattr(other, name) for name in BY_LINE}
        chosen = {name: value[lines] for name, value in values.items() if value is not None}
        errors = tuple(error.turn(itemgetter(lines)) for error in other.errors)
        parts.append(other if np.all(lines) else replace(other, **chosen, errors=errors))
    return parts


def robust_mean(responses: Sequence[FrequencyResponse], half_width: int) -> FrequencyResponse:
    """The mean response with its distortion; covariance of noise plus nonlinear scatter, each divided by
    the number M of realisations. Of single periods, whose noise is unknown, the scatter is that of both, and
    no distortion is told. Raises as robust_distortion does. Equation (frf-robust).
    """
    responses = at_common_lines(responses)
    first, m = responses[0], len(responses)
    is_single = any(response.covariance is None for response in responses)
    levels = robust_distortion(responses, is_single)
    every = np.ones(first.n_frequency, bool)
    excess = neighbourhood_mean(levels.total**2 - levels.noise**2, every, half_width)
    distortion = np.sqrt(np.maximum(excess, 0.0))
    size = np.sqrt(np.mean(np.abs(levels.gain) ** 2))
    excess_size, noise = (
        100 * float(np.sqrt(np.mean(level**2)) / size) for level in (distortion, levels.noise)
    )
    message = f"{m} realisations of the phases: nonlinearity scatters the FRF by {excess_size:.2g} % (rms), "
    message += f"noise by {noise:.2g} % in each"
    of_noise = 0.0 if is_single else _mean_of(responses, "covariance")
    if is_single:
        message = (
            f"{m} realisations of the phases, of a single period each: nonlinearity and noise together "
            f"scatter the FRF by {excess_size:.2g} % (rms); two periods of each would tell them apart"
        )
    return replace(
        first,
        matrix=levels.gain,
        covariance=(of_noise + diagonal_covariance(distortion**2)) / m,
        distortion=None if is_single else distortion / np.sqrt(m),
        # A resonance that follows the phases moves all its lines together, which no variance of a line says.
        repeats=np.stack([response.matrix for response in responses]),
        repeat_names=tuple(f"realisation {number}" for number in range(1, m + 1)),
        repeats_are="realisations",
        # All were measured through the same sums.
        errors=tuple(
            replace(of_one[0], change=np.mean([error.change for error in of_one], axis=0), parts=())
            for of_one in zip(*(response.errors for response in responses), strict=True)
        ),
        change=_mean_of(responses, "change"),
        open_loop=_mean_of(responses, "open_loop"),
        snr=_mean_of(responses, "snr"),
        averages=sum(response.averages for response in responses),
        covariance_dof=min(
            sum(response.covariance_dof for response in responses), (m - 1) * (2 * half_width + 1.0)
        ),
        findings=(
            *dict.fromkeys(
                f for response in responses for f in response.findings if f.code != "no-covariance"
            ),
            note("distortion", message),
        ),
    )


def _mean_of(responses: Sequence[FrequencyResponse], name: str) -> Any:
    parts = [getattr(response, name) for response in responses]
    return None if any(part is None for part in parts) else np.mean(parts, axis=0)
