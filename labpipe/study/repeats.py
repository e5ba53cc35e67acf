"""Repeats of all fits with different noise, on several processors; outcomes depend on the seeds only."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

from labpipe.errors import FitError
from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.processes import end_with_parent
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.identification import Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.study.sources import Source

# Least number of repeats for separate processes.
WORTH_SHARING = 100


@dataclass(frozen=True)
class Outcome:
    """One fit of one repeat: converged or not, and its parameters (of the last step where not converged)."""

    converged: bool
    parameters: tuple[Parameter, ...]


class Workers:
    """Runs repeats, in this process or in several."""

    def __init__(self, pool: ProcessPoolExecutor | None, count: int) -> None:
        self._pool = pool
        self._count = count

    def outcomes(self, source: Source, fits: Sequence[FitSettings], repeats: int, seed: tuple[int, ...]) -> list[list[Outcome]]:
        """(fit, repeat) -> Outcome; repeat r draws its noise from seed (*seed, r)."""
        numbers = list(range(repeats))
        if self._pool is None or repeats < WORTH_SHARING:
            numbered = _repeated(source, fits, numbers, seed)
        else:
            shares = [numbers[start :: self._count] for start in range(self._count)]
            futures = [self._pool.submit(_repeated, source, fits, share, seed) for share in shares]
            numbered = sorted((pair for future in futures for pair in future.result()), key=lambda pair: pair[0])
        return [[outcomes[number] for _, outcomes in numbered] for number in range(len(fits))]


@contextmanager
def workers(jobs: int) -> Iterator[Workers]:
    """*jobs* processes; 0: as many as there are processors."""
    count = jobs or os.cpu_count() or 1
    if count == 1:
        yield Workers(None, 1)
        return
    # Fresh interpreters: forking a process that has threads is not safe.
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool:
        yield Workers(pool, count)


def _repeated(
    source: Source, fits: Sequence[FitSettings], numbers: Sequence[int], seed: tuple[int, ...]
) -> list[tuple[int, list[Outcome]]]:
    numbered = []
    for number in numbers:
        response = source.response((*seed, number))
        numbered.append((number, [_outcome(response, settings) for settings in fits]))
    return numbered


def _outcome(response: FrequencyResponse | ChannelSpectra, settings: FitSettings) -> Outcome:
    """A fit with FitError counts as not converged; intervals are those of the estimator alone."""
    try:
        (fit,) = identify(response, settings, judging=False)
    except FitError:
        return Outcome(False, ())
    return Outcome(fit.converged, fit.parameters)
