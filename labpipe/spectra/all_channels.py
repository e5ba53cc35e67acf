"""Recordings -> spectra of all channels side by side, with their covariance: none of them is taken as free of
noise. That of periods is pooled over runs that agree, and over neighbouring lines: weights by few degrees of
freedom lose efficiency.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import special

from labpipe.arrays import BoolArray, ComplexArray
from labpipe.errors import DataError, SettingError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.spectra import ChannelSpectra
from labpipe.spectra.bands import settings_findings
from labpipe.spectra.channel_layout import ChannelLayout, find_channel_layout
from labpipe.spectra.channels import in_time
from labpipe.spectra.covariance import SAME_ERRORS, SAME_SHARE
from labpipe.spectra.matrices import without_rounding
from labpipe.spectra.period_average import LineSpectrum, excited_lines, smoothed_noise
from labpipe.spectra.periodic import period_average
from labpipe.spectra.ports import check_rate, source_findings, without_short
from labpipe.spectra.quality import AliasingMonitor, aliasing_findings
from labpipe.spectra.random_lines import MeasuredLines, random_lines, snr_findings
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.synchronous import lines_of_shaft, without_shaft

# Degrees of freedom below which the loss of efficiency exceeds a tenth.
ENOUGH_DOF = 13.0
# Degrees of freedom beyond which more of them would gain less than a twentieth.
PLENTY_DOF = 60.0


def periodic_lines(
    sources: Sequence[SampleSource], settings: FrfSettings, layout: ChannelLayout
) -> MeasuredLines:
    """The averages over periods of every recording, one run each, at the lines where any force acts in any of
    them. DataError for a single period, and where no force exceeds its noise.
    """
    both = [_average(source, settings, layout, number) for number, source in enumerate(sources)]
    averaged = [spectrum for spectrum, _ in both]
    n_period = min(spectrum.n_period for spectrum in averaged)
    if n_period < 2:
        what = "one period is left, so the noise of the channels is unknown"
        raise DataError(what, hint="record at least 2 after the transient ones")
    spectra = [_sum(spectrum, layout) for spectrum in _pool(averaged, settings.smooth)]
    excited = np.zeros((spectra[0].frequency.size, len(spectra), len(layout.channels)), bool)
    for run, spectrum in enumerate(spectra):
        for column in layout.inputs:
            if np.any(np.abs(spectrum.mean[:, column]) > 0):
                excited[:, run, column] = excited_lines(spectrum, [column])
    lines = np.any(excited, axis=(1, 2))
    if not np.any(lines):
        what = "no line of the forces exceeds its noise"
        raise DataError(what, hint="check `period` and `band`, or raise the level")
    vectors = np.stack([spectrum.mean[lines] for spectrum in spectra], axis=1)
    covariance = np.stack(
        [spectrum.noise[lines] for spectrum in spectra if spectrum.noise is not None], axis=1
    )
    findings, weak = snr_findings(vectors, covariance, layout.channels, excited[lines])
    return MeasuredLines(
        frequency=spectra[0].frequency[lines],
        vectors=vectors,
        covariance=covariance,
        runs=tuple(source.name or f"run {number}" for number, source in enumerate(sources, 1)),
        dof=min(spectrum.select(lines).dof for spectrum in spectra),
        findings=(*(finding for _, unsettled in both for finding in unsettled), *findings),
        weak=weak,
        acting=np.any(excited[lines], axis=2),
    )


def _average(
    source: SampleSource, settings: FrfSettings, layout: ChannelLayout, number: int
) -> tuple[LineSpectrum, tuple[Finding, ...]]:
    spectrum, _, findings = period_average(source, settings)
    mean = layout.pick(number, spectrum.mean, 1)
    noise = None if spectrum.noise is None else layout.pick(number, spectrum.noise, 2)
    return replace(spectrum, mean=mean, noise=noise), findings


def _sum(spectrum: LineSpectrum, layout: ChannelLayout) -> LineSpectrum:
    transform = layout.transform(spectrum.frequency)
    assert spectrum.noise is not None
    noise = transform @ spectrum.noise @ transform.conj().swapaxes(1, 2)
    mean = np.einsum("lcr,lr->lc", transform, spectrum.mean)
    return replace(spectrum, mean=mean, noise=noise)


def _pool(spectra: Sequence[LineSpectrum], smooth: int) -> list[LineSpectrum]:
    """The spectra with noise averaged over runs that share it and over lines, as many as are needed."""
    single = [s.noise * s.n_period for s in spectra if s.noise is not None]
    dofs = [spectrum.dof for spectrum in spectra]
    if len(spectra) > 1 and shared_noise(single, dofs):
        there = np.array([np.any(np.einsum("lcc->lc", noise).real > 0, axis=0) for noise in single])
        # A run that lacks a channel holds zeros for its noise.
        weights = np.all(there[:, None] == there, axis=2) * np.array(dofs)
        single = [np.tensordot(of_run, single, axes=1) / of_run.sum() for of_run in weights]
        dof = float(weights.sum(axis=1).min())
    else:
        dof = min(dofs)
    # Noise that the loop shapes is not the same on lines far apart: no more of them than weights need.
    half_width = min(smooth, max(int(np.ceil((PLENTY_DOF / dof - 1) / 2)), 0))
    while smooth and (2 * half_width + 1) * dof < ENOUGH_DOF:
        half_width += 1
    return [
        smoothed_noise(
            replace(s, noise=noise / s.n_period, line_dof=np.full(s.frequency.size, dof)),
            half_width,
            with_inverse=True,
        )
        for s, noise in zip(spectra, single, strict=True)
    ]


def shared_noise(noises: Sequence[ComplexArray], dofs: Sequence[float]) -> bool:
    """Whether runs have the same noise: *noises* (n_line, n_channel, n_channel) [SI] of one period, *dofs*
    of each. The mean over lines of log(S_1 / S_2) of every channel has, for equal noise, the mean and
    variance of the logarithm of an F-distributed number. Equation (spec-pooled-runs).
    """
    powers = [np.einsum("lcc->lc", noise).real for noise in noises]
    for power, dof in zip(powers[1:], dofs[1:], strict=True):
        both: BoolArray = np.all((power > 0) & (powers[0] > 0), axis=0)
        if not np.any(both):
            return False
        ratio = np.mean(np.log(power[:, both] / powers[0][:, both]), axis=0)
        ratio = ratio - (special.psi(dof) - np.log(dof)) + (special.psi(dofs[0]) - np.log(dofs[0]))
        error = np.sqrt((special.polygamma(1, dof) + special.polygamma(1, dofs[0])) / power.shape[0])
        if np.any((np.abs(ratio) > SAME_SHARE) & (np.abs(ratio) > SAME_ERRORS * error)):
            return False
    return True


EXCITATIONS: dict[str, Callable[[Sequence[SampleSource], FrfSettings, ChannelLayout], MeasuredLines]] = {
    "periodic": periodic_lines,
    "random": random_lines,
}


def channel_spectra(
    sources: Sequence[SampleSource],
    settings: FrfSettings,
    *,
    name: str = "",
    conditions: dict[str, Any] | None = None,
) -> ChannelSpectra:
    """The complex amplitudes of all channels of a test, run by run, with their covariance. A line stays
    where any force acts in any run. DataError for recordings that do not fit together, are too short, hold
    NaN or no force, ConfigError for an excitation other than periodic and random.
    """
    check_rate(sources)
    if settings.excitation not in EXCITATIONS:
        what = f"excitation {settings.excitation} gives no spectra side by side"
        raise SettingError("excitation", what, "known: periodic, random")
    if settings.excitation == "random":
        sources = in_time(sources)
    sources, short = without_short(sources, settings)
    layout = find_channel_layout(sources)
    cleaned, settings, shaft = without_shaft(sources, settings)
    monitors = [AliasingMonitor(source) for source in cleaned]
    lines = EXCITATIONS[settings.excitation](monitors, settings, layout)
    outputs = {channel.name for channel in layout.recorded if channel.role == "output"}
    aliasing = aliasing_findings(monitors, settings.band, outputs - lines.weak)
    acting = np.ones((lines.frequency.size, len(sources)), bool) if lines.acting is None else lines.acting
    excited = [lines.frequency[of_run] for of_run in acting.T]
    of_bands = settings_findings(lines.frequency, settings)
    shaft = (*shaft, *of_bands, *lines_of_shaft(sources, settings, excited))
    findings = (*source_findings(monitors), *short, *shaft, *aliasing, *lines.findings)
    return ChannelSpectra(
        frequency=lines.frequency,
        vectors=lines.vectors,
        covariance=without_rounding(np.array(lines.covariance)),
        channels=layout.channels,
        runs=lines.runs,
        covariance_dof=lines.dof,
        line_correlation=lines.line_correlation,
        blocks=lines.blocks,
        factors=layout.factors(),
        name=name,
        findings=findings,
        conditions=dict(conditions or {}),
    )
