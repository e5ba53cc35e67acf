"""study: all fits of a pipeline on a virtual rig, over noise levels and numbers of lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from labpipe.identify.settings import FitSettings
from labpipe.records.study import Study, StudyCase, StudyThreshold
from labpipe.spectra.settings import FrfSettings
from labpipe.study.repeats import Workers, workers
from labpipe.study.settings import StudySettings
from labpipe.study.sources import Source, source_of
from labpipe.study.summary import success_rate, summarised

Tell = Callable[[str], None]

# Range of the search for a threshold, in multiples of the lowest and highest noise level, and its precision.
SEARCHED_BELOW, SEARCHED_ABOVE = 0.05, 20.0
SEARCH_RATIO = 1.05
# Repeats of one step of the search; the standard error of a success rate of 95 % is 1.5 %.
SEARCH_REPEATS = 200


def run_study(rig: Any, settings: StudySettings, fits: Sequence[FitSettings], frf: FrfSettings | None, tell: Tell, jobs: int = 1) -> Study:
    """Every fit at every noise level and number of lines; *rig* is a virtual rig's settings.

    The noise of a repeat depends on the seed and the repeat's number alone, so all levels and fits see the same draws.
    *jobs*: processes, 0 for one per processor; a script that asks for several needs the usual `if __name__ == "__main__"`.
    ConfigError for lines or runs that the rig does not have.
    """
    plain = [replace(fit, compare=False, sliding=None) for fit in fits]
    with workers(jobs) as crew:
        cases = [case for level_cases in _cases(rig, settings, plain, frf, crew, tell) for case in level_cases]
        thresholds = [_threshold(rig, settings, fit, limit, frf, crew, tell) for fit, limit in _searches(settings, plain)]
    return Study(rig.name, settings.seed, settings.success, settings.share, tuple(cases), tuple(thresholds), settings.printed)


def _cases(
    rig: Any, settings: StudySettings, fits: Sequence[FitSettings], frf: FrfSettings | None, crew: Workers, tell: Tell
) -> Iterator[list[StudyCase]]:
    counts: list[int | None] = [int(count) for count in settings.lines] or [None]
    for noise, count in product(settings.noise, counts):
        source = source_of(rig, noise, count, settings.runs, frf)
        tell(f"study     noise {100 * noise:g} %, {source.n_line} lines, {settings.repeats} repeats")
        outcomes = crew.outcomes(source, fits, settings.repeats, (settings.seed,))
        yield [
            summarised(fit_outcomes, fit, source.truth, source.bounds(fit), settings.success, noise, source.n_line)
            for fit, fit_outcomes in zip(fits, outcomes, strict=True)
        ]


def _searches(settings: StudySettings, fits: Sequence[FitSettings]) -> list[tuple[FitSettings, float]]:
    return [(fit, limit) for limit in settings.success for fit in fits] if settings.thresholds else []


def _threshold(
    rig: Any, settings: StudySettings, fit: FitSettings, limit: float, frf: FrfSettings | None, crew: Workers, tell: Tell
) -> StudyThreshold:
    """Bisection over the logarithm of the noise; the same draws at every level keep the success rate from jittering."""
    count = int(settings.lines[0]) if settings.lines else None
    repeats = min(settings.repeats, SEARCH_REPEATS)

    def rate(noise: float) -> float:
        source: Source = source_of(rig, noise, count, settings.runs, frf)
        (outcomes,) = crew.outcomes(source, [fit], repeats, (settings.seed,))
        return success_rate(outcomes, fit, source.truth, limit)

    tell(f"study     threshold of {fit.name} at {100 * limit:g} %")
    low, high = SEARCHED_BELOW * min(settings.noise), SEARCHED_ABOVE * max(settings.noise)
    if rate(low) < settings.share or rate(high) >= settings.share:
        return StudyThreshold(fit.name, limit, None, repeats)
    while high / low > SEARCH_RATIO:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if rate(middle) >= settings.share else (low, middle)
    return StudyThreshold(fit.name, limit, float(np.sqrt(low * high)), repeats)
