"""What either excitation gives of all channels side by side, and how far noise covers it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel
from labpipe.spectra.parts import POOR_SHARE

LOW_SNR = 10.0


@dataclass(frozen=True, kw_only=True)
class MeasuredLines:
    """frequency (n_line,) [Hz], vectors (n_line, n_run, n_channel) and covariance (n_line, n_run, n_channel, n_channel) [SI], as in
    ChannelSpectra; dof: complex degrees of freedom of the covariance; weak: outputs that are mostly noise.
    """

    frequency: FloatArray
    vectors: ComplexArray
    covariance: ComplexArray
    runs: tuple[str, ...]
    dof: float
    line_correlation: tuple[complex, ...] = ()
    findings: tuple[Finding, ...] = ()
    weak: set[str] = field(default_factory=set)


def snr_findings(
    vectors: ComplexArray, covariance: ComplexArray, channels: Sequence[Channel], excited: BoolArray
) -> tuple[tuple[Finding, ...], set[str]]:
    """Warnings where noise is large, and the names of the outputs among them; *vectors* and *covariance* [SI] as in MeasuredLines.

    Of forces line by line where they act, *excited* (n_line, n_run, n_channel), of responses in power over band and runs.
    """
    size = np.abs(vectors)
    noise = np.sqrt(np.maximum(np.einsum("lrcc->lrc", covariance).real, 0.0))
    findings: list[Finding] = []
    weak: set[str] = set()
    for number, channel in enumerate(channels):
        acting = excited[:, :, number]
        if channel.role == "input" and np.any(acting):
            share = float(np.mean((size < LOW_SNR * noise)[:, :, number][acting]))
            if share > POOR_SHARE:
                what = f"channel {channel.name}: the signal is less than {LOW_SNR:g} times its noise at {100 * share:.0f} % of its lines"
                findings.append(Finding("low-snr", what))
        if channel.role == "output" and np.sum(noise[:, :, number] ** 2) * LOW_SNR**2 > np.sum(size[:, :, number] ** 2):
            what = f"channel {channel.name}: the signal is less than {LOW_SNR:g} times its noise, in power over the band"
            findings.append(Finding("low-snr", what))
            weak.add(channel.name)
    return tuple(findings), weak
