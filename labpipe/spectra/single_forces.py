"""FRF matrix by H1 of recordings in each of which one force acts alone: a roving hammer, a shaker that moves.

S_uu is then diagonal and nothing couples the columns of H, so all that is held grows with their number and
not with its square.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, handed_over
from labpipe.records.finding import Finding
from labpipe.records.response import BlockCovariance
from labpipe.spectra.covariance import pooled_residual
from labpipe.spectra.matrices import hermitian, without_rounding
from labpipe.spectra.ports import Layout, Parts, coherence_findings
from labpipe.spectra.quality import check_power, coherence_by_power, multiple_coherence, partial_coherence
from labpipe.spectra.welch import CrossSpectra


def parts_of_single_forces(
    spectra: Sequence[CrossSpectra], chosen: BoolArray, layout: Layout, half_width: int = 0
) -> Parts:
    """The FRF H = S_yu / S_uu column by column at the *chosen* lines (n_line,); spectra weighted by their
    numbers of blocks.

    The noise of the responses, S_yy - H S_uy, is common to all columns, and averaged over *half_width* lines
    around. DataError for a force without power.
    """
    power, s_yu, s_yy = _summed(spectra, chosen, layout)
    check_power(power)
    response = s_yu / power[:, None, :]
    averages, n_input = sum(spectrum.averages for spectrum in spectra), power.shape[1]
    multiple = multiple_coherence(response, s_yu, s_yy)
    enough = averages > n_input + 1
    findings = (
        coherence_findings(multiple, np.einsum("foo->fo", s_yy).real, layout)
        if enough
        else no_average_finding(averages)
    )
    residual = without_rounding(s_yy - response @ hermitian(s_yu)) if enough else s_yy
    return Parts(
        frequency=spectra[0].frequency[chosen],
        matrix=response,
        covariance=_covariance(pooled_residual(residual, response, half_width), power * (averages - n_input))
        if enough
        else None,
        averages=averages,
        dof=averages - n_input if enough else np.inf,
        findings=findings,
        coherence=coherence_by_power(power, s_yu, s_yy),
        multiple_coherence=multiple,
        partial_coherence=partial_coherence(1 / power, response, s_yu, s_yy),
        line_correlation=spectra[0].line_correlation,
    )


def _summed(
    spectra: Sequence[CrossSpectra], chosen: BoolArray, layout: Layout
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """S_uu (n_line, n_input) [N^2/Hz], S_yu (n_line, n_output, n_input) and S_yy (n_line, n_output, n_output)
    over all recordings.
    """
    n_line, n_input, n_output = int(np.count_nonzero(chosen)), len(layout.inputs), len(layout.outputs)
    power = np.zeros((n_line, n_input))
    s_yu, s_yy = (
        np.zeros((n_line, n_output, n_input), np.complex128),
        np.zeros((n_line, n_output, n_output), np.complex128),
    )
    n_block = sum(spectrum.n_block for spectrum in spectra)
    for spectrum, inputs, outputs in zip(spectra, layout.input_columns, layout.output_columns, strict=True):
        ((force, column),) = [(number, column) for number, column in enumerate(inputs) if column >= 0]
        matrix, rows, share = spectrum.matrix[chosen], list(outputs), spectrum.n_block / n_block
        power[:, force] += share * matrix[:, column, column].real
        s_yu[:, :, force] += share * matrix[:, rows, column]
        s_yy += share * matrix[:, rows][:, :, rows]
    return power, s_yu, s_yy


def _covariance(residual: ComplexArray, power: FloatArray) -> BlockCovariance:
    """cov(H_oi, H_pi) = S_rr[o, p] / power_i, a block for every force.

    *power* (n_line, n_input) [N^2/Hz] times degrees of freedom.
    """
    n_output, n_input = residual.shape[1], power.shape[1]
    elements = np.arange(n_output * n_input).reshape(n_output, n_input).T
    blocks = residual[:, None] / power[:, :, None, None]
    return BlockCovariance(elements, handed_over(blocks))


def no_average_finding(averages: float) -> tuple[Finding, ...]:
    """The warning of too few *averages* for the noise of the FRF."""
    message = (
        f"{averages:.2g} effective averages are too few to estimate the noise of the FRF; record "
        "longer or shorten `block`"
    )
    return (Finding("no-covariance", message),)
