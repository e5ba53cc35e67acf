"""Several phase realisations of a periodic excitation: mean FRF and nonlinear distortion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.doubt import MatrixError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse, uncorrelated
from labpipe.spectra.distortion import robust_distortion


def realisations(sources: Sequence[SampleSource]) -> list[list[SampleSource]]:
    """The recordings of the first realisation, of the second, ...: for every set of forces in order, as many as it has forces.

    DataError unless every set of forces has the same number of realisations, at least two.
    """
    series: dict[tuple[tuple[str, str], ...], list[SampleSource]] = {}
    for source in sources:
        forces = tuple((channel.name, channel.dof) for channel in source.channels if channel.role == "input")
        series.setdefault(forces, []).append(source)
    counts = {len(members) / max(len(forces), 1) for forces, members in series.items()}
    number = min(counts)
    if len(counts) > 1 or number < 2 or number != int(number):
        hint = "as many recordings of every force direction, two or more; leave `realisations` out for one"
        raise DataError(f"{len(sources)} recording(s) do not form realisations of one measurement", hint=hint)
    return [[source for members in series.values() for source in _chunk(members, n, int(number))] for n in range(int(number))]


def _chunk(series: list[SampleSource], n: int, number: int) -> list[SampleSource]:
    size = len(series) // number
    return series[n * size : (n + 1) * size]


def robust_mean(responses: Sequence[FrequencyResponse], half_width: int) -> FrequencyResponse:
    """The mean response with its distortion; covariance of noise plus nonlinear scatter, each divided by the number M of realisations.

    Distortion is averaged over *half_width* lines to either side, as noise is: M realisations give M - 1 degrees of freedom per
    line. Raises as robust_distortion does. Equation (frf-robust).
    """
    first, m = responses[0], len(responses)
    distortion = np.empty(first.matrix.shape)
    noise = np.empty(first.matrix.shape)
    for output, force in np.ndindex(first.matrix.shape[1:]):
        levels = robust_distortion(responses, output, force)
        excess = _neighbours_mean(levels.total**2 - levels.noise**2, half_width)
        distortion[:, output, force] = np.sqrt(np.maximum(excess, 0.0))
        noise[:, output, force] = levels.noise
    covariance = np.mean([response.covariance for response in responses if response.covariance is not None], axis=0)
    matrix = np.mean([response.matrix for response in responses], axis=0)
    return dataclasses.replace(
        first,
        matrix=matrix,
        covariance=(covariance + uncorrelated(distortion**2)) / m,
        distortion=distortion / np.sqrt(m),
        errors=_mean_errors(responses),
        change=_mean_of(responses, "change"),
        open_loop=_mean_of(responses, "open_loop"),
        snr=None if first.snr is None else np.mean([response.snr for response in responses if response.snr is not None], axis=0),
        averages=sum(response.averages for response in responses),
        covariance_dof=min(sum(response.covariance_dof for response in responses), (m - 1) * (2 * half_width + 1.0)),
        findings=(*dict.fromkeys(f for response in responses for f in response.findings), _distortion_note(matrix, distortion, noise, m)),
    )


def _mean_of(responses: Sequence[FrequencyResponse], name: str) -> ComplexArray | None:
    """The mean of an array that every response has, or None."""
    present = [values for response in responses if (values := getattr(response, name)) is not None]
    return np.asarray(np.mean(present, axis=0)) if len(present) == len(responses) else None


def _mean_errors(responses: Sequence[FrequencyResponse]) -> tuple[MatrixError, ...]:
    """The systematic errors of the mean: all realisations were measured through the same sums."""
    together = zip(*(response.errors for response in responses), strict=True)
    return tuple(MatrixError(errors[0].doubt, np.asarray(np.mean([error.change for error in errors], axis=0))) for errors in together)


def _neighbours_mean(values: FloatArray, half_width: int) -> FloatArray:
    """Mean over lines k-h ... k+h, truncated at the ends."""
    ones = np.ones(2 * half_width + 1)
    middle = slice(half_width, half_width + values.size)
    total, count = (np.convolve(terms, ones)[middle] for terms in (values, np.ones(values.size)))
    return np.asarray(total / count)


def _distortion_note(matrix: ComplexArray, distortion: FloatArray, noise: FloatArray, m: int) -> Finding:
    size = np.sqrt(np.mean(np.abs(matrix) ** 2))
    nonlinear, noisy = (100 * float(np.sqrt(np.mean(level**2)) / size) for level in (distortion, noise))
    message = f"{m} realisations of the phases: nonlinearity scatters the FRF by {nonlinear:.2g} % (rms), noise by {noisy:.2g} % in each"
    return note("distortion", message)
