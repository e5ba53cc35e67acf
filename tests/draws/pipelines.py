"""A pipeline drawn: its fits, comparisons, calibrations, run-ups and responses to unbalance in worlds in
which every number is off.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.errors import LabpipeError
from labpipe.project.pipeline_file import Pipeline, load_pipeline
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from tests.draws.calibrations import line_worlds
from tests.draws.cases import Case, cases_of
from tests.draws.comparisons import questions_of
from tests.draws.loops import loop_worlds
from tests.draws.run_ups import run_up_worlds
from tests.draws.tally import Tally
from tests.draws.unbalances import unbalance_worlds
from tests.draws.usual import Errors

# The parameters of one world by name; without an rng those of the truth.
World = Callable[[Errors, np.random.Generator | None], dict[str, Parameter]]


@dataclass(frozen=True)
class Drawn:
    """One kind of result: its parameters in a *world*, and their *truth* by name."""

    world: World
    truth: dict[str, float]


def draw_pipeline(path: Path, draws: int, seconds: float, most: int, seed: int) -> Tally | None:
    """Tallies of all results of a pipeline; None where nothing in it has an uncertainty that can be drawn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _draw(load_pipeline(path), draws, seconds, most, seed)


def _draw(pipeline: Pipeline, draws: int, seconds: float, most: int, seed: int) -> Tally | None:
    kinds = _kinds(pipeline, most)
    if not kinds:
        return None
    tally = Tally({name: value for kind in kinds for name, value in kind.truth.items()})
    rng, end = np.random.default_rng(seed), time.monotonic() + seconds
    for _ in range(draws):
        if time.monotonic() > end:
            break
        errors = Errors(rng)
        for kind in kinds:
            try:
                tally.add(kind.world(errors, rng))
            except LabpipeError as error:
                tally.failed += 1
                tally.reasons.append(str(error))
    return tally


def _kinds(pipeline: Pipeline, most: int) -> list[Drawn]:
    """What a pipeline has of each kind; fits that a comparison draws are not drawn by themselves."""
    questions = questions_of(pipeline, most)
    kinds = [Drawn(question.amounts, question.truths()) for question in questions]
    if pipeline.fits and pipeline.tests and not questions:
        cases = cases_of(pipeline, most)
        kinds.append(
            Drawn(lambda errors, rng: fits_of(cases, errors, rng), _values(fits_of(cases, Errors(), None)))
        )
    others = [line for settings in pipeline.sections.get("calibrate", ()) for line in line_worlds(settings)]
    others += loop_worlds(pipeline)
    others += [one for one in (run_up_worlds(pipeline), unbalance_worlds(pipeline)) if one is not None]
    return kinds + [Drawn(one.amounts, one.truth()) for one in others]


def _values(parameters: dict[str, Parameter]) -> dict[str, float]:
    return {name: one.value for name, one in parameters.items()}


def fits_of(cases: Sequence[Case], errors: Errors, rng: np.random.Generator | None) -> dict[str, Parameter]:
    """The parameters of all cases in one world, a fit beginning with those before it."""
    fits: list[Fit] = []
    found: dict[str, Parameter] = {}
    for case in cases:
        made = case.fitted(errors, rng, fits)
        fits.extend(made)
        found |= {f"{case.name}.{one.name}": one for fit in made for one in fit.parameters}
    return found
