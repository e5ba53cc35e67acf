"""Recordings of a random excitation -> FRF matrix by the local polynomial method, with the covariance from the local residual."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource
from labpipe.records.response import Blocks
from labpipe.spectra.local_polynomial import freedom, local_polynomials
from labpipe.spectra.parts import Parts, coherence_findings, lines_left
from labpipe.spectra.ports import Layout
from labpipe.spectra.reading import checked_blocks
from labpipe.spectra.settings import FrfSettings

# Degrees of freedom of the noise of a line that the half width is chosen for, and least that is accepted.
USUAL_DOF, LEAST_DOF = 8, 2
# Condition number of the equations of a line above which the forces are not rough enough to tell FRF and leakage apart.
WORST_CONDITION = 1e8


def local_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF from DFTs of neighbouring blocks without window; DataError for forces that cannot be told from leakage or from each other."""
    assert settings.block is not None
    rate = sources[0].sample_rate
    n_sample = round(settings.block * rate)
    blocks = np.concatenate([layout.padded(number, _spectra(source, n_sample), 1) for number, source in enumerate(sources)])
    n_input = len(layout.inputs)
    half_width = settings.half_width or usual_half_width(blocks.shape[0], n_input, settings.degree)
    if freedom(blocks.shape[0], n_input, settings.degree, half_width) < LEAST_DOF:
        least = usual_half_width(blocks.shape[0], n_input, settings.degree)
        raise DataError(f"half_width: {half_width} leaves the noise unknown", hint=f"{least} or more, or leave it out")
    frequency = np.arange(1, blocks.shape[1] + 1) * (rate / n_sample)
    inner = frequency[half_width:-half_width]
    if not inner.size:
        raise DataError(f"a block of {settings.block:g} s has fewer lines than the window of {2 * half_width + 1}", hint="lengthen `block`")
    chosen = np.flatnonzero(lines_left(inner, settings))
    first, last = int(chosen[0]), int(chosen[-1]) + 1
    around = slice(first, last + 2 * half_width)
    fitted = local_polynomials(blocks[:, around, :n_input], blocks[:, around, n_input:], settings.degree, half_width)
    lines = chosen - first
    _check_condition(fitted.condition[lines], layout)
    coherence = fitted.multiple_coherence[lines]
    power: FloatArray = np.mean(np.abs(blocks[:, half_width + chosen, n_input:]) ** 2, axis=0)
    return Parts(
        frequency=inner[chosen],
        matrix=fitted.matrix[lines],
        covariance=fitted.covariance[lines],
        # One value of the noise serves all lines of a window, as if each had this many averages.
        averages=1 + fitted.dof / (2 * half_width + 1),
        dof=float(fitted.dof),
        findings=coherence_findings(coherence, power, layout),
        coherence=coherence[:, :, None] if n_input == 1 else None,
        multiple_coherence=coherence,
        blocks=Blocks(settings.block, "none", 0.0, blocks.shape[0], "H1", settings.degree, layout.derivatives),
        line_correlation=tuple(complex(value) for value in fitted.correlation),
    )


def usual_half_width(n_block: int, n_input: int, degree: int) -> int:
    """The least half width with USUAL_DOF degrees of freedom of the noise, and with more lines than a polynomial has coefficients."""
    return next(n for n in range(degree + 1, 10_000) if freedom(n_block, n_input, degree, n) >= USUAL_DOF)


def _spectra(source: SampleSource, n_sample: int) -> ComplexArray:
    """DFT of all whole blocks, (n_block, n_line, n_channel), lines from the first above 0 Hz to the last below half the rate."""
    if source.n_sample < n_sample or n_sample < 8:
        have = source.n_sample / source.sample_rate
        raise DataError(f"'{source.name}' is {have:g} s long, too short for one block of {n_sample / source.sample_rate:g} s")
    samples = np.concatenate(list(checked_blocks(source)))
    whole = samples[: source.n_sample // n_sample * n_sample].reshape(-1, n_sample, samples.shape[1])
    return np.asarray(fft.rfft(whole, axis=1)[:, 1 : (n_sample + 1) // 2])


def _check_condition(condition: FloatArray, layout: Layout) -> None:
    if np.any(condition > WORST_CONDITION):
        names = ", ".join(port.label for port in layout.inputs)
        what = f"the force {names} is too smooth over the lines, or too few recordings have it, to tell FRF and leakage apart"
        raise DataError(what, hint="a random force in every direction, or leave `local` out")
