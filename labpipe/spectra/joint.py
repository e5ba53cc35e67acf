"""Closed loops: the FRF by the joint input-output method, from what a reference injected from outside makes
of forces and responses (Ljung, System Identification, 1999, chapter 13), with a covariance that does not know
the error of its own line. docs/pages/theory/response.md says why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.records.response import Blocks
from labpipe.spectra.covariance import covariance_of_periodic
from labpipe.spectra.matrices import hermitian
from labpipe.spectra.ports import POOR_SHARE, Layout, Parts, select_lines
from labpipe.spectra.random import blocks_of, change_of_random, shares_of, welch_average
from labpipe.spectra.random_lines import (
    check_injection,
    check_recorded,
    due_to_drives,
    lower_of_drives,
    noise_by_drive,
)
from labpipe.spectra.settings import FrfSettings

# Neighbours on either side that tell the FRF of a line.
SIDE = 5
FEWEST = 4
# Standard errors by which a line lies beside that of its neighbours where it counts by itself.
BENT = 5.0


def covariance_by_neighbours(
    frequency: FloatArray,
    matrix: ComplexArray,
    vectors: ComplexArray,
    noise: Sequence[ComplexArray],
    gap: int = 0,
) -> ComplexArray:
    """cov vec G (n_line, n, n) [unit^2 of H] of G = *matrix* (n_line, n_output, n_input) at *frequency*
    (n_line,) [Hz]. *vectors* (n_line, n_input + n_output, n_run) [SI], forces first, with G = Y pinv(U);
    *noise*: their covariance in every run, (n_line, n_channel, n_channel) [SI]. *gap*: neighbours next to the
    line that share its noise, which are left out. A line far beside what its neighbours say counts by
    itself. Equation (frf-neighbours).
    """
    there = _from_neighbours(frequency, matrix, gap)
    covariance = _covariance_of(there, vectors, noise)
    variance = np.einsum("lii->li", covariance).real.reshape(matrix.shape)
    # Of a sharp resonance a straight line tells less than the line's own noise leaves.
    bent = np.any(np.abs(matrix - there) ** 2 > BENT**2 * variance, axis=(1, 2))
    if not np.any(bent):
        return covariance
    return _covariance_of(np.where(bent[:, None, None], matrix, there), vectors, noise)


def _covariance_of(there: ComplexArray, vectors: ComplexArray, noise: Sequence[ComplexArray]) -> ComplexArray:
    n_line, n_output, n_input = there.shape
    residual_of = np.concatenate(
        [-there, np.broadcast_to(np.eye(n_output), (n_line, n_output, n_output))], axis=2
    )
    forces = np.empty((n_line, n_input, len(noise)), np.complex128)
    for run, of_run in enumerate(noise):
        crossed = of_run @ hermitian(residual_of)
        left = residual_of @ vectors[:, :, run : run + 1]
        update = crossed[:, :n_input] @ np.linalg.pinv(residual_of @ crossed, hermitian=True) @ left
        forces[:, :, run] = (vectors[:, :n_input, run : run + 1] - update)[:, :, 0]
    # Forces differ by orders of magnitude.
    size = np.sqrt(np.mean(np.abs(forces) ** 2, axis=(0, 2)))
    inverse = np.linalg.pinv(forces / size[:, None]) / size
    return covariance_of_periodic(there, inverse, np.stack(list(noise)))


def _from_neighbours(frequency: FloatArray, matrix: ComplexArray, gap: int) -> ComplexArray:
    """G of every line by a straight line through its neighbours, its own where these are too few."""
    flat = matrix.reshape(frequency.size, -1)
    count, first, second = (np.zeros(frequency.size) for _ in range(3))
    total, moment = np.zeros_like(flat), np.zeros_like(flat)
    for distance in range(gap + 1, min(gap + SIDE, frequency.size - 1) + 1):
        for line, other in (
            (slice(distance, None), slice(None, -distance)),
            (slice(None, -distance), slice(distance, None)),
        ):
            away = frequency[other] - frequency[line]
            count[line] += 1
            first[line] += away
            second[line] += away**2
            total[line] += flat[other]
            moment[line] += away[:, None] * flat[other]
    enough = count >= FEWEST
    spread = np.where(enough, count * second - first**2, 1.0)[:, None]
    at_line = (second[:, None] * total - first[:, None] * moment) / spread
    return np.where(enough[:, None], at_line, flat).reshape(matrix.shape)


ESTIMATOR = "joint"
# A force's part due to the references, over its standard deviation, below which a ratio to it is not normal.
LOW_SNR = 5.0
# Lines next to one that share its noise by the window (0.44 of it, of a Hann window; 0.03 two lines away).
GAP = 1


def is_joint(blocks: Blocks) -> bool:
    """Whether blocks were averaged by the joint method, as of a closed loop."""
    return blocks.estimator == ESTIMATOR


@dataclass(frozen=True)
class JointEstimate:
    """G (n_line, n_output, n_input) [output unit / N], and what it is made of. columns (n_line, n_input +
    n_output, n_reference) [unit/Hz^0.5]: the parts due to the references, forces first; noise (n_line, n, n)
    [unit^2/Hz]: of the part due to one reference, forces first; strength (n_line,) [1]: of the force that
    they move least, over its standard deviation.
    """

    matrix: ComplexArray
    columns: ComplexArray
    noise: ComplexArray
    strength: FloatArray


def joint_estimate(
    spectra: ComplexArray, references: Sequence[str], n_input: int, averages: float
) -> JointEstimate:
    """G of averaged *spectra* (n_line, n, n) [unit^2/Hz], *references* first, then *n_input* forces, then
    responses. With more references than forces, least squares over them. DataError for references that are
    silent or follow from each other. Equation (frf-joint).
    """
    n = len(references)
    lower = lower_of_drives(spectra[:, :n, :n], references, "reference")
    columns, residual = due_to_drives(spectra[:, n:, n:], spectra[:, n:, :n], lower, averages)
    forces, noise = columns[:, :n_input], residual / averages
    size = np.sqrt(np.einsum("lii->li", spectra[:, n : n + n_input, n : n + n_input]).real)
    inverse = np.linalg.pinv(forces / size[:, :, None]) / size[:, None, :]
    moved = forces @ hermitian(forces)
    noisy = moved + noise[:, :n_input, :n_input] + np.finfo(float).tiny * np.eye(n_input)
    white: ComplexArray = np.linalg.inv(np.linalg.cholesky(noisy))
    share = np.clip(np.linalg.eigvalsh(white @ moved @ hermitian(white))[:, 0], 0.0, 1.0)
    strength = np.sqrt(share / np.maximum(1 - share, np.finfo(float).eps))
    return JointEstimate(columns[:, n_input:] @ inverse, columns, noise, strength)


def joint_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF of random data under the references of the settings, with H1 beside it. ConfigError for
    references that are none, DataError for too few of them, and for such as do not move the forces.
    """
    references, n_input = settings.reference, len(layout.inputs)
    whole = _with_references(sources, settings, layout)
    halved = [welch_average(source, settings) for source in sources]
    spectra = [spectrum for spectrum, _ in halved]
    chosen, n = select_lines(spectra[0].frequency, settings), len(references)
    frequency = spectra[0].frequency[chosen]
    averages = sum(spectrum.averages for spectrum in spectra)
    if averages <= n + 2:
        hint = "record longer, or shorten `block`"
        what = f"{averages:.2g} effective averages are too few for the noise of an FRF by references"
        raise DataError(what, hint=hint)
    parts = [part[chosen] for part in shares_of(spectra, whole)]
    matrix = np.asarray(sum(parts))
    estimate = joint_estimate(matrix, references, n_input, averages)
    findings = _strength_findings(estimate, frequency, settings, layout)
    of_parts = [part.averages for part in spectra]
    noise, dof = noise_by_drive(averages * estimate.noise, matrix, parts, of_parts, n)
    noise = [of_drive / averages for of_drive in noise]
    covariance = covariance_by_neighbours(frequency, estimate.matrix, estimate.columns, noise, GAP)
    open_loop = open_loop_estimate(matrix[:, n:, n:], n_input)

    def response_of(part: ComplexArray) -> ComplexArray:
        return joint_estimate(part, references, n_input, averages / 2).matrix

    return Parts(
        frequency=frequency,
        matrix=estimate.matrix,
        covariance=covariance,
        averages=averages,
        dof=dof,
        findings=(*findings, open_loop_note(frequency, estimate.matrix, covariance, open_loop)),
        line_correlation=spectra[0].line_correlation,
        blocks=blocks_of(spectra, settings, ESTIMATOR, layout.derivatives),
        change=change_of_random(halved, whole, chosen, response_of, n + 2),
        open_loop=open_loop,
    )


def check_references(sources: Sequence[SampleSource], settings: FrfSettings) -> None:
    """ConfigError unless the references are channels of the recordings outside of the FRF, DataError for a
    recording without any.
    """
    check_recorded(settings.reference, sources)
    for source in sources:
        if not {channel.name for channel in source.channels} & set(settings.reference):
            listed = ", ".join(settings.reference)
            raise DataError(f"recording '{source.name}' has none of the references {listed}")


def _with_references(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Layout:
    check_references(sources, settings)
    if len(settings.reference) < len(layout.inputs):
        forces = ", ".join(port.label for port in layout.inputs)
        what = (
            f"{len(layout.inputs)} forces ({forces}) need as many references, named: "
            f"{', '.join(settings.reference)}"
        )
        raise DataError(
            what, hint="inject independent signals into every axis, and name all of them under `reference`"
        )
    columns = []
    for source, forces_of in zip(sources, layout.input_columns, strict=True):
        names = [channel.name for channel in source.channels]
        columns.append(
            (*(names.index(name) if name in names else -1 for name in settings.reference), *forces_of)
        )
    return replace(layout, input_columns=tuple(columns))


def _strength_findings(
    estimate: JointEstimate, frequency: FloatArray, settings: FrfSettings, layout: Layout
) -> tuple[Finding, ...]:
    named, weak = ", ".join(settings.reference), estimate.strength < LOW_SNR
    forces = ", ".join(port.label for port in layout.inputs)
    check_injection(estimate.strength, frequency, settings.reference, [port.label for port in layout.inputs])
    if np.mean(weak) <= POOR_SHARE:
        return ()
    what = (
        f"the part of the force {forces} that is due to the reference {named} is less than {LOW_SNR:g} "
        "times its noise at "
        f"{100 * np.mean(weak):.0f} % of the lines: the FRF is uncertain there beyond its covariance"
    )
    return (Finding("low-snr", what),)


def open_loop_estimate(spectra: ComplexArray, n_input: int) -> ComplexArray:
    """H1 = S_yu S_uu^-1 (n_line, n_output, n_input) [output unit / N] as if the loop were open, of *spectra*
    (n_line, n, n) [unit^2/Hz], *n_input* forces first.
    """
    inverse = np.linalg.pinv(spectra[:, :n_input, :n_input], hermitian=True)
    estimate: ComplexArray = spectra[:, n_input:, :n_input] @ inverse
    return estimate


def open_loop_note(
    frequency: FloatArray, matrix: ComplexArray, covariance: ComplexArray, open_loop: ComplexArray
) -> Finding:
    """How far H1, *open_loop*, is from the FRF *matrix* (n_line, n_output, n_input) [unit of H] at
    *frequency* (n_line,) [Hz], in words. *covariance* (n_line, n, n) [unit^2 of H] of the FRF.
    """
    size = np.linalg.norm(matrix, axis=(1, 2))
    apart = np.linalg.norm(open_loop - matrix, axis=(1, 2)) / size
    error = np.sqrt(np.einsum("lii->l", covariance).real) / size
    worst = int(np.argmax(np.where(apart > 2 * error, apart, 0.0)))
    far = (
        f", most at {frequency[worst]:.4g} Hz: {100 * apart[worst]:.3g} %"
        if apart[worst] > 2 * error[worst]
        else ""
    )
    message = (
        "the FRF is taken from what the reference makes of force and response. H1, which takes the force as "
        f"given from outside, differs from it by {100 * np.median(apart):.2g} % of |H| (median over the "
        f"lines; the FRF's standard error is {100 * np.median(error):.2g} %){far}: that is its bias, and "
        "noise"
    )
    return note("closed-loop", message)
