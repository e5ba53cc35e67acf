"""What a measurement contributes to a frequency response, whatever the excitation was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.spectra.bands import lines_in
from labpipe.spectra.ports import Layout
from labpipe.spectra.settings import FrfSettings

# Share of the lines that may be poor before it is worth a warning.
POOR_SHARE = 0.1
LOW_COHERENCE = 0.9


@dataclass(frozen=True)
class Parts:
    """Matrix, covariance and quality of a measurement on its lines; the fields are those of FrequencyResponse."""

    frequency: FloatArray
    matrix: ComplexArray
    covariance: ComplexArray | None
    averages: float
    dof: float
    findings: tuple[Finding, ...] = ()
    coherence: FloatArray | None = None
    multiple_coherence: FloatArray | None = None
    partial_coherence: FloatArray | None = None
    snr: FloatArray | None = None
    line_correlation: tuple[float, ...] = ()


def lines_left(frequency: FloatArray, settings: FrfSettings) -> BoolArray:
    """The lines of the settings' band outside its gaps; DataError when none is left."""
    chosen = lines_in(frequency, settings.band, settings.exclude)
    if not np.any(chosen):
        raise DataError("no line of the band is left", hint="`exclude` and `mask` take them all")
    return chosen


def coherence_findings(multiple: FloatArray, layout: Layout) -> tuple[Finding, ...]:
    """A warning for every response (n_frequency, n_output) that the forces explain poorly at many lines."""
    return tuple(
        Finding(
            "low-coherence",
            f"response {port.label}: the coherence is below {LOW_COHERENCE:g} at {100 * share:.0f} % of the lines",
        )
        for port, share in zip(layout.outputs, np.mean(multiple < LOW_COHERENCE, axis=0), strict=True)
        if share > POOR_SHARE
    )
