"""The first and the second half of a record: what changed between them drifts, or has not settled."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.spectra.estimators import ESTIMATORS
from labpipe.spectra.matrices import at_lines
from labpipe.spectra.ports import Layout
from labpipe.spectra.welch import CrossSpectra

# A record of which the spectra of the whole and of its first half are known; None where that is too short. Of the half the columns of the
# forces may be all there is.
Halved = tuple[CrossSpectra, CrossSpectra | None]


def cut_at(blocks: Iterable[FloatArray], middle: int) -> Iterator[tuple[FloatArray, bool]]:
    """The *blocks* (n, n_channel) [any unit] in order, cut so that one ends before sample *middle*; True for that one."""
    start = 0
    for block in blocks:
        end = start + block.shape[0]
        if start < middle < end:
            yield block[: middle - start], True
            yield block[middle - start :], False
        else:
            yield block, end == middle
        start = end


def joined_spectra(spectra: Sequence[CrossSpectra], layout: Layout) -> ComplexArray:
    """Cross-spectra of all channels (n_line, n_channel, n_channel) [unit^2/Hz], recordings weighted by their numbers of blocks.

    Or (n_line, n_channel, n_input), where they are those of all channels with the forces that act in each recording.
    """
    n_block = sum(spectrum.n_block for spectrum in spectra)
    if len(spectra) == 1:
        return _padded(layout, 0, spectra[0].matrix)
    joined: ComplexArray = np.sum([_padded(layout, e, s.matrix) * (s.n_block / n_block) for e, s in enumerate(spectra)], axis=0)
    return joined


def _padded(layout: Layout, recording: int, matrix: ComplexArray) -> ComplexArray:
    """The *matrix* of all channels, or of all channels with the acting forces, in the order of the layout; zero for an absent force."""
    if matrix.shape[1] == matrix.shape[2]:
        return layout.padded(recording, matrix, 2)
    rows = layout.padded(recording, matrix.swapaxes(1, 2), 1).swapaxes(1, 2)
    acting = np.array(layout.input_columns[recording]) >= 0
    if np.all(acting):
        return rows
    padded = np.zeros((*rows.shape[:2], acting.size), np.complex128)
    padded[:, :, acting] = rows
    return padded


def acting_forces(layout: Layout, recording: int, estimator: str) -> list[int] | None:
    """The channels of the forces in a recording, whose columns are all that H1 needs of a half; None for another *estimator*."""
    return [column for column in layout.input_columns[recording] if column >= 0] if estimator == "H1" else None


def change_of_random(
    halved: Sequence[Halved], layout: Layout, chosen: BoolArray, response_of: Callable[[ComplexArray], ComplexArray], least: float
) -> ComplexArray | None:
    """H of the second half of all records less that of the first, (n_line, n_output, n_input) [output unit / N], at the *chosen* lines.

    *response_of*: H of the spectra (n_line, n_channel, n_channel) [unit^2/Hz] of the layout's channels. None where a half has no more
    than *least* averages, too few for the noise of an FRF of so many forces.
    """
    first = [half for _, half in halved if half is not None]
    if len(first) < len(halved) or min(half.averages for half in first) <= least:
        return None
    rest = [_rest(whole, half, layout.input_columns[number]) for number, ((whole, _), half) in enumerate(zip(halved, first, strict=True))]
    before, after = (response_of(at_lines(joined_spectra(half, layout), chosen)) for half in (first, rest))
    return after - before


def _rest(whole: CrossSpectra, half: CrossSpectra, forces: Sequence[int]) -> CrossSpectra:
    n_block = whole.n_block - half.n_block
    matrix = whole.matrix
    if half.matrix.shape[2] < matrix.shape[2]:
        matrix = matrix.transpose(1, 2, 0)[:, [column for column in forces if column >= 0]].transpose(2, 0, 1)
    rest = matrix * (whole.n_block / n_block)
    rest -= half.matrix * (half.n_block / n_block)
    return replace(whole, matrix=rest, n_block=n_block)


def estimated_by(estimator: str, n_input: int) -> Callable[[ComplexArray], ComplexArray]:
    """The *estimator* (H1, H2, Hv) as a function of the spectra (n_line, n_channel, n_channel) [unit^2/Hz], *n_input* forces first."""

    def response_of(matrix: ComplexArray) -> ComplexArray:
        return ESTIMATORS[estimator](matrix[:, :n_input, :n_input], matrix[:, n_input:, :n_input], matrix[:, n_input:, n_input:])

    return response_of


def rest_of_mean(mean: ComplexArray, count: int, part: ComplexArray, part_count: int) -> ComplexArray:
    """Mean (n_line, n_channel) [unit of the channel] of *count* values of that *mean* without *part_count* values of the mean *part*."""
    rest: ComplexArray = (mean * count - part * part_count) / (count - part_count)
    return rest
