"""The result of one excitation's evaluation, common to periodic, random, impact, stepped-sine and sweep excitation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.factored_covariance import FactoredCovariance
from labpipe.records.finding import Finding
from labpipe.records.response import Blocks
from labpipe.spectra.bands import lines_in
from labpipe.spectra.ports import Layout
from labpipe.spectra.settings import FrfSettings

# Share of lines with low signal-to-noise ratio above which a warning is given.
POOR_SHARE = 0.1
# Share of a response's power that the forces explain.
LOW_COHERENCE = 0.9


@dataclass(frozen=True, kw_only=True)
class Parts:
    """FRF matrix (n_line, n_output, n_input) [output unit / N], covariance and quality on the measured lines.

    frequency (n_line,) [Hz]; covariance (n_line, n, n) of vec(H), n = n_output * n_input, or its factors; coherences and snr [1] as in
    FrequencyResponse; line_correlation and line_gains (n_line, n_neighbour, n_output, n_input) likewise, change, open_loop and blocks.
    """

    frequency: FloatArray
    matrix: ComplexArray
    covariance: ComplexArray | FactoredCovariance | None
    averages: float
    dof: float
    findings: tuple[Finding, ...] = ()
    coherence: FloatArray | None = None
    multiple_coherence: FloatArray | None = None
    partial_coherence: FloatArray | None = None
    snr: FloatArray | None = None
    line_correlation: tuple[complex, ...] = ()
    line_gains: ComplexArray | None = None
    blocks: Blocks | None = None
    change: ComplexArray | None = None
    open_loop: ComplexArray | None = None


def lines_left(frequency: FloatArray, settings: FrfSettings) -> BoolArray:
    """Lines (n_line,) [Hz] in the settings' band and outside its excluded bands, as a mask (n_line,); DataError when none is left."""
    chosen = lines_in(frequency, settings.band, settings.exclude)
    if not np.any(chosen):
        raise DataError("no line of the band is left", hint="`exclude` and `mask` cover them all")
    return chosen


def coherence_findings(multiple: FloatArray, power: FloatArray, layout: Layout) -> tuple[Finding, ...]:
    """Warnings for outputs of whose *power* (n_frequency, n_output) [unit^2/Hz] much is noise, by the *multiple* coherence (same shape).

    Lines of low coherence alone are no fault: every response has some, beside its resonances and at antiresonances.
    """
    total = np.sum(power, axis=0)
    noise = np.divide(np.sum((1 - multiple) * power, axis=0), total, out=np.zeros_like(total), where=total > 0)
    return tuple(
        Finding("low-coherence", f"response {port.label}: {100 * share:.0f} % of its power in the band is not explained by the forces")
        for port, share in zip(layout.outputs, noise, strict=True)
        if share > 1 - LOW_COHERENCE
    )
