"""Recordings of a periodic excitation -> FRF matrix with the covariance from the scatter between periods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.spectra.bands import line_range
from labpipe.spectra.feedback import feedback_of_periods
from labpipe.spectra.halves import cut_at, rest_of_mean
from labpipe.spectra.independence import force_inverse
from labpipe.spectra.joint import check_references, open_loop_note
from labpipe.spectra.neighbours import covariance_by_neighbours
from labpipe.spectra.parts import POOR_SHARE, Parts, lines_left
from labpipe.spectra.periodic import LineSpectrum, PeriodAverage, excited_lines, samples_per_period, smoothed_noise
from labpipe.spectra.ports import Layout
from labpipe.spectra.reading import checked_blocks
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.uncertainty import covariance_of_periodic

LOW_SNR = 10.0


def periodic_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF H = Y pinv(U) of the period averages of all recordings, at the lines where every force acts.

    DataError when no line of a force exceeds its noise, or when the forces are not independent. Equation (frf-periodic).
    """
    assert settings.period is not None
    averaged = [_period_average(source, settings) for source in sources]
    single = [spectrum for spectrum, _ in averaged]
    spectra = [smoothed_noise(spectrum, settings.smooth) for spectrum in single]
    acting = _acting(spectra, layout)
    lines = np.all(acting, axis=1)
    if settings.reference and np.any(lines):
        lines = _injected(spectra, sources, settings)
    if not np.any(lines):
        _refuse_lines(acting)
    spectra = [spectrum.select(lines) for spectrum in spectra]
    n_input = len(layout.inputs)
    mean = np.stack([layout.padded(e, spectrum.mean, 1) for e, spectrum in enumerate(spectra)], axis=2)
    forces, responses = mean[:, :n_input], mean[:, n_input:]
    inverse = force_inverse(forces, layout)
    matrix = responses @ inverse
    noises = [layout.padded(e, s.noise, 2) for e, s in enumerate(spectra) if s.noise is not None]
    covariance = None
    if len(noises) == len(spectra) and settings.reference:
        covariance = covariance_by_neighbours(spectra[0].frequency, matrix, mean, noises)
    elif len(noises) == len(spectra):
        covariance = covariance_of_periodic(matrix, inverse, np.stack(noises))
    snr = None if covariance is None else _signal_to_noise(mean, np.stack(noises))
    findings = _no_covariance_finding(spectra[0].n_period) if covariance is None else _snr_findings(snr, mean, layout)
    open_loop = None if covariance is None or not settings.reference else _open_loop(spectra, mean, noises, n_input)
    if open_loop is not None and covariance is not None:
        findings = (*findings, open_loop_note(spectra[0].frequency, matrix, covariance, open_loop))
    else:
        findings = (*findings, *feedback_of_periods([spectrum.select(lines) for spectrum in single], matrix, layout))
    averages = float(min(spectrum.n_period for spectrum in spectra))
    dof = min(spectrum.dof for spectrum in spectra) if covariance is not None else np.inf
    return Parts(
        frequency=spectra[0].frequency,
        matrix=matrix,
        covariance=covariance,
        averages=averages,
        dof=dof,
        findings=findings,
        snr=snr,
        change=_change(spectra, [half for _, half in averaged], lines, layout),
        open_loop=open_loop,
    )


def _injected(spectra: Sequence[LineSpectrum], sources: Sequence[SampleSource], settings: FrfSettings) -> BoolArray:
    """Lines (n_line,) at which a reference acts in every recording: what else repeats is a disturbance that the loop answers.

    Not where a force exceeds its noise: to choose lines by the force's noise prefers errors of one sign. DataError for a reference without
    lines.
    """
    check_references(sources, settings)
    injected = np.ones(spectra[0].frequency.size, bool)
    for spectrum, source in zip(spectra, sources, strict=True):
        columns = [number for number, channel in enumerate(source.channels) if channel.name in settings.reference]
        columns = [column for column in columns if np.any(spectrum.mean[:, column] != 0)]
        lines = excited_lines(spectrum, columns) if columns else np.zeros_like(injected)
        if not np.any(lines):
            what = f"recording '{source.name}': no line of the reference {', '.join(settings.reference)} exceeds its noise"
            raise DataError(what, hint="is it what is injected into this loop, and `period` its period?")
        injected &= lines
    if not np.any(injected):
        raise DataError("no line is excited by a reference in all recordings", hint="inject the same lines into every axis, one by one")
    return injected


def _open_loop(spectra: Sequence[LineSpectrum], mean: ComplexArray, noises: Sequence[ComplexArray], n_input: int) -> ComplexArray:
    """H1 = S_yu S_uu^-1 of all periods as if the loop were open, (n_line, n_output, n_input); *mean* (n_line, n_channel, n_recording)."""
    power = mean @ mean.conj().swapaxes(1, 2)
    power = power + np.sum([spectrum.n_period * noise for spectrum, noise in zip(spectra, noises, strict=True)], axis=0)
    return np.asarray(power[:, n_input:, :n_input] @ np.linalg.pinv(power[:, :n_input, :n_input], hermitian=True))


def _change(
    spectra: Sequence[LineSpectrum], halves: Sequence[LineSpectrum | None], lines: BoolArray, layout: Layout
) -> ComplexArray | None:
    """H of the second half of the periods less that of the first, (n_line, n_output, n_input) [output unit / N]."""
    first = [half.select(lines) for half in halves if half is not None]
    if len(first) < len(spectra):
        return None
    rest = [rest_of_mean(s.mean, s.n_period, half.mean, half.n_period) for s, half in zip(spectra, first, strict=True)]
    before, after = (
        np.stack([layout.padded(e, mean, 1) for e, mean in enumerate(means)], axis=2) for means in ([half.mean for half in first], rest)
    )
    n_input = len(layout.inputs)
    old, new = (mean[:, n_input:] @ force_inverse(mean[:, :n_input], layout) for mean in (before, after))
    return new - old


def _refuse_lines(acting: BoolArray) -> None:
    """DataError: silent forces, or forces whose lines are interleaved (zipper)."""
    if acting.shape[1] > 1 and np.all(np.any(acting, axis=0)):
        what = "no line is excited by all forces independently: their lines are interleaved"
        raise DataError(what, hint="use frf: {result: spectra} with model: dynamic-stiffness")
    raise DataError("no line of the force exceeds its noise", hint="check `period` and `band`, or raise the level")


def _acting(spectra: Sequence[LineSpectrum], layout: Layout) -> BoolArray:
    """Whether every force acts in one of the recordings, (n_line, n_input); a line counts where all do, hum in a single one does not."""
    acting = np.zeros((spectra[0].frequency.size, len(layout.inputs)), bool)
    for spectrum, columns in zip(spectra, layout.input_columns, strict=True):
        for number, column in enumerate(columns):
            if column >= 0:
                acting[:, number] |= excited_lines(spectrum, [column])
    return acting


def _period_average(source: SampleSource, settings: FrfSettings) -> tuple[LineSpectrum, LineSpectrum | None]:
    """The averaged lines of one recording in the band, and those of the first half of its periods."""
    assert settings.period is not None
    n_sample = samples_per_period(settings.period, source.sample_rate)
    lines = line_range(n_sample, source.sample_rate, settings.band, source.n_sample)
    average = PeriodAverage(n_sample, len(source.channels), settings.skip, lines)
    half: LineSpectrum | None = None
    n_half = (source.n_sample // n_sample - settings.skip) // 2
    for block, ends_half in cut_at(checked_blocks(source), (settings.skip + n_half) * n_sample):
        average.add(block)
        if ends_half and n_half > 0:
            half = average.spectrum(source.sample_rate)
    spectrum = average.spectrum(source.sample_rate)
    chosen = lines_left(spectrum.frequency, settings)
    return spectrum.select(chosen), None if half is None else half.select(chosen)


def _signal_to_noise(mean: ComplexArray, noise: ComplexArray) -> FloatArray:
    """|mean| / std of the mean per line and channel, the largest over the recordings, (n_line, n_channel)."""
    std = np.sqrt(np.einsum("eljj->lje", noise).real)
    ratio = np.divide(np.abs(mean), std, out=np.full(std.shape, np.inf), where=std > 0)
    ratio[np.abs(mean) == 0] = 0.0
    return np.minimum(np.max(ratio, axis=2), 1e12)


def _no_covariance_finding(n_period: int) -> tuple[Finding, ...]:
    message = f"{n_period} period is left, so the noise of the FRF is unknown; record at least 2 periods after the transient ones"
    return (Finding("no-covariance", message),)


def _snr_findings(snr: FloatArray | None, mean: ComplexArray, layout: Layout) -> tuple[Finding, ...]:
    """Forces line by line, since their noise makes H too small there; responses by their power over the band, as lines weigh by noise."""
    assert snr is not None
    n_input = len(layout.inputs)
    poor = np.mean(snr[:, :n_input] < LOW_SNR, axis=0)
    forces = (
        Finding("low-snr", f"channel {port.label}: the signal is less than {LOW_SNR:g} times its noise at {100 * share:.0f} % of the lines")
        for port, share in zip(layout.inputs, poor, strict=True)
        if share > POOR_SHARE
    )
    size = np.max(np.abs(mean[:, n_input:]), axis=2)
    noise = np.divide(size, snr[:, n_input:], out=np.zeros_like(size), where=size > 0)
    weak = np.sum(noise**2, axis=0) * LOW_SNR**2 > np.sum(size**2, axis=0)
    responses = (
        Finding("low-snr", f"channel {port.label}: the signal is less than {LOW_SNR:g} times its noise, in power over the band")
        for port, is_weak in zip(layout.outputs, weak, strict=True)
        if is_weak
    )
    return (*forces, *responses)
