"""Recordings -> spectra of all channels side by side, with their covariance: none of them is taken as free of noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from labpipe.errors import ConfigError
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.recording import SampleSource
from labpipe.spectra.aliasing import AliasingMonitor, aliasing_findings
from labpipe.spectra.channel_layout import ChannelLayout, find_channel_layout
from labpipe.spectra.masks import mask_findings, masked_bands
from labpipe.spectra.matrices import without_rounding
from labpipe.spectra.measured_lines import MeasuredLines
from labpipe.spectra.periodic_lines import periodic_lines
from labpipe.spectra.ports import check_rates, source_findings
from labpipe.spectra.random_lines import random_lines
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.without_shaft import lines_of_shaft, without_shaft

EXCITATIONS: dict[str, Callable[[Sequence[SampleSource], FrfSettings, ChannelLayout], MeasuredLines]] = {
    "periodic": periodic_lines,
    "random": random_lines,
}


def channel_spectra(
    sources: Sequence[SampleSource], settings: FrfSettings, *, name: str = "", conditions: dict[str, Any] | None = None
) -> ChannelSpectra:
    """The complex amplitudes of all channels of a test, run by run, with their covariance.

    A run is a recording of periodic excitation, or the part of random recordings that is due to one of their drives. A line stays where
    any force acts in any run; a run need not excite every direction. Raises DataError for recordings that do not fit together, are too
    short, hold NaN or no force, ConfigError for an excitation other than periodic and random.
    """
    check_rates(sources)
    if settings.excitation not in EXCITATIONS:
        raise ConfigError(
            f"excitation {settings.excitation} gives no spectra side by side", hint="known: periodic, random", field="excitation"
        )
    layout = find_channel_layout(sources)
    bands = masked_bands(sources, settings)
    settings = dataclasses.replace(settings, exclude=(*settings.exclude, *bands))
    cleaned, settings, shaft = without_shaft(sources, settings)
    monitors = [AliasingMonitor(source) for source in cleaned]
    lines = EXCITATIONS[settings.excitation](monitors, settings, layout)
    outputs = {channel.name for channel in layout.recorded if channel.role == "output"}
    aliasing = aliasing_findings(monitors, settings.band, outputs - lines.weak)
    shaft = (*shaft, *lines_of_shaft(sources, settings, lines.frequency))
    findings = (*source_findings(monitors), *mask_findings(bands), *shaft, *aliasing, *lines.findings)
    return ChannelSpectra(
        frequency=lines.frequency,
        vectors=lines.vectors,
        covariance=without_rounding(np.array(lines.covariance)),
        channels=layout.channels,
        runs=lines.runs,
        covariance_dof=lines.dof,
        line_correlation=lines.line_correlation,
        factors=layout.factors(),
        name=name,
        findings=findings,
        conditions=dict(conditions or {}),
    )
