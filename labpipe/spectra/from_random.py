"""Recordings of a random excitation -> FRF matrix by Welch's averages, with coherence and covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import DataError
from labpipe.records.factored_covariance import FactoredCovariance
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.response import Blocks
from labpipe.spectra.bands import line_range
from labpipe.spectra.coherence import multiple_coherence, ordinary_coherence, partial_coherence
from labpipe.spectra.estimators import ESTIMATORS, INSTRUMENTS
from labpipe.spectra.from_local import local_parts
from labpipe.spectra.halves import Halved, acting_forces, change_of_random, cut_at, estimated_by, joined_spectra
from labpipe.spectra.independence import check_forces, check_responses
from labpipe.spectra.matrices import at_lines, definite_inverse, product
from labpipe.spectra.parts import Parts, coherence_findings, lines_left
from labpipe.spectra.ports import Layout
from labpipe.spectra.reading import checked_blocks
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.uncertainty import covariance_of_h1, covariance_of_random
from labpipe.spectra.welch import CrossSpectra, WelchAverage
from labpipe.spectra.windows import window_values


def random_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF from Welch averages of all recordings, or by local polynomials; DataError for recordings or forces that do not allow one."""
    if settings.local == "polynomial":
        return local_parts(sources, settings, layout)
    halved = [welch_average(source, settings, acting_forces(layout, number, settings.estimator)) for number, source in enumerate(sources)]
    spectra = [whole for whole, _ in halved]
    assert settings.block is not None
    n_block = sum(spectrum.n_block for spectrum in spectra)
    blocks = Blocks(settings.block, settings.window, settings.overlap, n_block, settings.estimator, derivatives=layout.derivatives)
    parts = parts_of_spectra(spectra, settings, layout)
    n_input, chosen = len(layout.inputs), lines_left(halved[0][0].frequency, settings)
    change = change_of_random(halved, layout, chosen, estimated_by(settings.estimator, n_input), n_input + 1)
    return replace(parts, blocks=blocks, change=change)


def parts_of_spectra(spectra: Sequence[CrossSpectra], settings: FrfSettings, layout: Layout, half_width: int = 0) -> Parts:
    """The FRF from the averaged spectra of every recording, weighted by their numbers of blocks; noise over *half_width* lines around.

    DataError when the forces, or the outputs an estimator inverts, are not independent.
    """
    chosen = lines_left(spectra[0].frequency, settings)
    n_input = len(layout.inputs)
    matrix = at_lines(joined_spectra(spectra, layout), chosen)
    s_uu, s_yu, s_yy = matrix[:, :n_input, :n_input], matrix[:, n_input:, :n_input], matrix[:, n_input:, n_input:]
    check_forces(s_uu, layout)
    if settings.estimator != "H1":
        check_responses(s_yy, layout, settings.estimator)
    inverse_force, _ = definite_inverse(s_uu)
    first = product(s_yu, inverse_force)
    response = first if settings.estimator == "H1" else ESTIMATORS[settings.estimator](s_uu, s_yu, s_yy)
    averages = sum(spectrum.averages for spectrum in spectra)
    multiple = multiple_coherence(first, s_yu, s_yy)
    enough = averages > n_input + 1
    covariance: FactoredCovariance | ComplexArray | None = None
    if enough and settings.estimator == "H1":
        covariance = covariance_of_h1(matrix, response, inverse_force, averages, half_width)
    elif enough:
        instruments = INSTRUMENTS[settings.estimator](response, np.einsum("faa->fa", matrix).real)
        covariance = covariance_of_random(matrix, response, instruments, averages, half_width)
    return Parts(
        frequency=spectra[0].frequency[chosen],
        matrix=response,
        covariance=covariance,
        averages=averages,
        dof=averages - n_input if enough else np.inf,
        findings=coherence_findings(multiple, np.einsum("foo->fo", s_yy).real, layout) if enough else _no_average_finding(averages),
        coherence=ordinary_coherence(s_uu, s_yu, s_yy),
        multiple_coherence=multiple,
        partial_coherence=partial_coherence(inverse_force, first, s_yu, s_yy) if n_input > 1 else None,
        line_correlation=spectra[0].line_correlation,
    )


def welch_average(source: SampleSource, settings: FrfSettings, of_half: Sequence[int] | None = None) -> Halved:
    """Spectra of forces, responses and the named references of a recording, and those of its first half; DataError where it is short.

    *of_half*: channels of the recording whose columns are needed of its first half, by default all.
    """
    assert settings.block is not None
    n_sample = round(settings.block * source.sample_rate)
    if n_sample < 4:
        raise DataError(f"a block of {settings.block:g} s holds {n_sample} samples of '{source.name}'", hint="lengthen `block`")
    step = max(1, round(n_sample * (1 - settings.overlap)))
    lines = line_range(n_sample, source.sample_rate, settings.band, source.n_sample)
    # Other references (tacho, temperature) are not part of the FRF matrix.
    columns = [
        number for number, channel in enumerate(source.channels) if channel.role != "reference" or channel.name in settings.reference
    ]
    average = WelchAverage(window_values(settings.window, n_sample), step, len(columns), lines, settings.detrend)
    half: CrossSpectra | None = None
    for block, ends_half in cut_at(checked_blocks(source), source.n_sample // 2):
        average.add(block if len(columns) == block.shape[1] else block[:, columns])
        if ends_half and source.n_sample // 2 >= n_sample:
            chosen = None if of_half is None else [columns.index(column) for column in of_half]
            half = _in_all_channels(average.spectra(source.sample_rate, chosen), columns, len(source.channels))
    return _in_all_channels(average.spectra(source.sample_rate), columns, len(source.channels)), half


def _in_all_channels(spectra: CrossSpectra, columns: list[int], n_channel: int) -> CrossSpectra:
    """The spectra with zeros in the rows of the other channels, and in their columns where those of all are there."""
    if len(columns) == n_channel:
        return spectra
    n_column = spectra.matrix.shape[2]
    if n_column < len(columns):
        matrix = np.zeros((spectra.frequency.size, n_channel, n_column), np.complex128)
        matrix[:, columns] = spectra.matrix
        return replace(spectra, matrix=matrix)
    matrix = np.zeros((spectra.frequency.size, n_channel, n_channel), np.complex128)
    matrix[:, np.array(columns)[:, None], columns] = spectra.matrix
    return replace(spectra, matrix=matrix)


def _no_average_finding(averages: float) -> tuple[Finding, ...]:
    message = f"{averages:.2g} effective averages are too few to estimate the noise of the FRF; record longer or shorten `block`"
    return (Finding("no-covariance", message),)
