"""study: all fits of a pipeline on a virtual rig, over noise levels and numbers of lines, with errors and
coverage.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.measured import measured_part, select_ports
from labpipe.estimation.model import Setup, constrain
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import whitener
from labpipe.processes import pool_of
from labpipe.records.comparison import StudiedParameter, Study, StudyCase, StudyThreshold
from labpipe.records.finding import Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import Settings, flag, integer, names, quantity, setting
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import list_names
from labpipe.simulate.virtual_rigs import (
    Truth,
    VirtualRig,
    chosen_runs,
    kind_of,
    kind_of_responses,
    simulated_response,
)
from labpipe.spectra.bands import lines_in
from labpipe.spectra.settings import FrfSettings

FEWEST_REPEATS = 10


@dataclass(frozen=True, kw_only=True)
class StudySettings(Settings):
    """Virtual rig, noise levels and repeats of a study; *virtual_rig*: contents of `rig`."""

    rig: str = setting(
        "file", "virtual rig file, relative to the pipeline file", file_kind="virtual-rig", into="virtual_rig"
    )
    noise: tuple[float, ...] = setting(
        "values",
        "noise levels: of a rig given by its FRF the share of the largest |H|, of others relative "
        "to the rig's noise",
        "1",
    )
    runs: tuple[str, ...] = names("runs of the virtual rig that together give one FRF matrix")
    lines: tuple[float, ...] = setting(
        "values", "numbers of lines (rigs given by their FRF); default: the rig's", "1", ()
    )
    repeats: int = integer("repeats of each case", 200)
    seed: int = integer("seed of the noise", 1)
    success: tuple[float, ...] = setting("values", "relative deviations that count as success", "1", (0.1,))
    share: float = quantity("success rate asked for", "1", 0.95)
    printed: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series",
        "mean errors printed elsewhere, by fit, one for each noise level, to stand beside",
        "1",
        (),
        may_be_empty=True,
    )
    thresholds: bool = flag("search the noise level where the success rate falls under the share")
    virtual_rig: VirtualRig | None = None

    def __post_init__(self) -> None:
        if self.repeats < FEWEST_REPEATS:
            what = f"'repeats' must be at least {FEWEST_REPEATS}"
            raise ConfigError(what, hint="500 give the coverage to 1 %")
        if any(count != round(count) or count < 2 for count in self.lines):
            raise ConfigError("'lines' needs whole numbers of at least 2")
        if any(len(values) != len(self.noise) for _, values in self.printed):
            raise ConfigError("'printed' needs one value for each noise level")
        self.require_positive("noise", "success")
        self.require_share("share")


# Responses of a study from a virtual rig, noise level and seed, and their true parameters.


@dataclass(frozen=True)
class Source:
    """Responses of a virtual *rig* from its *runs*, with the same true parameters; *frf*: how recordings are
    measured.
    """

    rig: VirtualRig
    runs: tuple[str, ...]
    frf: FrfSettings | None

    @cached_property
    def truth(self) -> Truth:
        """True parameters by name [SI units]."""
        return kind_of(self.rig).parameters(self.rig, self.runs)

    @cached_property
    def n_line(self) -> int:
        """Number of frequency lines of a response."""
        return int(self.response((0, 0)).frequency.size)

    def response(self, seed: tuple[int, ...]) -> FrequencyResponse | ChannelSpectra:
        """The response, or the spectra, with the noise of a *seed*."""
        return simulated_response(self.rig, seed, self.runs or None, self.frf)

    def bounds(self, settings: FitSettings) -> Truth:
        """Cramer-Rao standard deviations of a fit's parameters by name, as far as the rig provides them."""
        kind = kind_of(self.rig)
        if kind.response is not None:
            return _bounds_of_response(kind.response(self.rig, None), self.truth, settings)
        if kind.std_errors is None or not settings.kind.one_frf or isinstance(settings.mass, str):
            return {}
        whole = self.frf.band if self.frf is not None else None
        return kind.std_errors(self.rig, self.runs, settings.band or whole or (0.0, np.inf))


def _bounds_of_response(exact: FrequencyResponse, truth: Truth, settings: FitSettings) -> Truth:
    """sqrt(diag((J^T J)^-1)) of the weighted output error at the truth, where the rig states it."""
    if settings.kind.equations is None:
        return {}
    rows, columns = select_ports(exact, settings.input, settings.output)
    outputs, inputs = tuple(exact.outputs[n] for n in rows), tuple(exact.inputs[n] for n in columns)
    setup = Setup(outputs, inputs, settings)
    model = constrain(settings.kind.model(setup), settings)
    if any(name not in truth for name in model.names):
        return {}
    measured = measured_part(exact, rows, columns, lines_in(exact.frequency, settings.band))
    problem = OutputError(measured, model, whitener(measured))
    jacobian = problem.jacobian(np.array([truth[name] for name in model.names]))
    deviations = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    return {name: float(deviation) for name, deviation in zip(model.names, deviations, strict=True)}


def source_of(
    rig: VirtualRig, noise: float, lines: int | None, runs: tuple[str, ...], frf: FrfSettings | None
) -> Source:
    """The source of a virtual rig at a noise level; ConfigError for lines or runs that it does not have."""
    kind = kind_of_responses(rig, frf)
    if lines is not None and kind.with_lines is None:
        raise ConfigError("'lines': the lines of this rig follow from its excitation", hint="leave it out")
    available = kind.runs(rig)
    if runs and not available:
        raise ConfigError("'runs': this rig has none", hint="leave it out")
    if available and not runs:
        raise ConfigError("'runs': is missing", hint=f"known: {', '.join(available)}")
    if available:
        chosen_runs(rig, runs)
    noisy: VirtualRig = kind.noisy(rig, noise)
    if lines is not None and kind.with_lines is not None:
        noisy = kind.with_lines(noisy, lines)
    return Source(noisy, runs, frf)


# Repeats of all fits with different noise, on several processors; outcomes depend on the seeds only.

# Least number of repeats for separate processes.
WORTH_SHARING = 100


@dataclass(frozen=True)
class Outcome:
    """One fit of one repeat: converged or not, and its parameters (of the last step where not converged)."""

    converged: bool
    parameters: tuple[Parameter, ...]


@dataclass
class Workers:
    """Runs repeats, in this process or in several."""

    pool: ProcessPoolExecutor | None
    count: int
    started: bool = False

    def outcomes(
        self, source: Source, fits: Sequence[FitSettings], numbers: Sequence[int], seed: tuple[int, ...]
    ) -> list[list[Outcome]]:
        """(fit, repeat of *numbers*) -> Outcome; repeat r draws its noise from seed (*seed, r)."""
        if self.pool is None or (len(numbers) < WORTH_SHARING and not self.started):
            numbered = dict(_repeat(source, fits, numbers, seed))
        else:
            self.started = True
            shares = [numbers[start :: self.count] for start in range(self.count)]
            futures = [self.pool.submit(_repeat, source, fits, share, seed) for share in shares]
            numbered = dict(pair for future in futures for pair in future.result())
        return [[numbered[number][fit] for number in numbers] for fit in range(len(fits))]


@contextmanager
def workers(jobs: int) -> Iterator[Workers]:
    """*jobs* processes; 0: as many as there are processors."""
    count = jobs or os.cpu_count() or 1
    with pool_of(count) as pool:
        yield Workers(pool, count)


def _repeat(
    source: Source, fits: Sequence[FitSettings], numbers: Sequence[int], seed: tuple[int, ...]
) -> list[tuple[int, list[Outcome]]]:
    responses = ((number, source.response((*seed, number))) for number in numbers)
    return [(number, [_outcome(response, fit) for fit in fits]) for number, response in responses]


def _outcome(response: FrequencyResponse | ChannelSpectra, settings: FitSettings) -> Outcome:
    try:
        fits = identify(response, settings, judging=False)
    except FitError:
        return Outcome(False, ())
    if len(fits) > 1:
        what = f"fit '{settings.name}' has {len(fits)} results"
        raise ConfigError(what, hint="a study repeats a fit of one band: name them as fits of their own")
    return Outcome(fits[0].converged, fits[0].parameters)


# From the outcomes of many repeats to bias, scatter against the bound, coverage and success.


def summarise(
    outcomes: Sequence[Outcome],
    settings: FitSettings,
    truth: Truth,
    bounds: dict[str, float],
    limits: tuple[float, ...],
    noise: float,
    lines: int,
) -> StudyCase:
    """One fit over all repeats; ConfigError where the rig states none. Equation (comp-study)."""
    ended = [outcome for outcome in outcomes if outcome.parameters]
    results = [outcome for outcome in ended if outcome.converged]
    names = _names(outcomes, truth)
    if ended and not names:
        what = f"the rig states no parameter of fit '{settings.name}'"
        raise ConfigError(what, hint=f"it states {list_names(list(truth))}")
    errors = np.array([squared_error(outcome, names, truth, settings) for outcome in ended])
    shown = _names(results, truth)
    parameters = tuple(_parameter(name, results, truth[name], bounds.get(name)) for name in shown)
    ratios = [p.rmse / p.bound for p in parameters if p.bound is not None]
    coverages = [p.coverage for p in parameters if p.coverage is not None]
    return StudyCase(
        fit=settings.name,
        estimator=settings.estimator,
        noise=noise,
        lines=lines,
        repeats=len(outcomes),
        failed=len(outcomes) - len(results),
        mean_error=float(errors.mean()) if errors.size else float("nan"),
        median_error=float(np.median(errors)) if errors.size else float("nan"),
        error_variance=float(np.var(errors, ddof=1)) if errors.size > 1 else float("nan"),
        success=tuple(success_rate(outcomes, settings, truth, limit) for limit in limits),
        rmse_over_bound=float(np.sqrt(np.mean(np.square(ratios)))) if ratios else None,
        coverage=float(np.mean(coverages)) if coverages else None,
        parameters=parameters,
    )


def success_rate(outcomes: Sequence[Outcome], settings: FitSettings, truth: Truth, limit: float) -> float:
    """Share of all repeats that ended in a result within *limit* of the truth. Equation (comp-success)."""
    names = _names(outcomes, truth)
    return float(np.mean([_is_success(outcome, names, settings, truth, limit) for outcome in outcomes]))


def _is_success(
    outcome: Outcome, names: Sequence[str], settings: FitSettings, truth: Truth, limit: float
) -> bool:
    if not outcome.converged:
        return False
    size = sum(count * truth[name] ** 2 for name, count in zip(names, _places(names, settings), strict=True))
    return squared_error(outcome, names, truth, settings) < limit**2 * size


def squared_error(outcome: Outcome, names: Sequence[str], truth: Truth, settings: FitSettings) -> float:
    """Sum of squared parameter errors; an entry of a symmetric matrix beside the diagonal counts at both its
    places. Equation (comp-squared-error).
    """
    values = {parameter.name: parameter.value for parameter in outcome.parameters}
    deviations = np.array([values.get(name, 0.0) - truth[name] for name in names])
    return float(_places(names, settings) @ deviations**2)


def _places(names: Sequence[str], settings: FitSettings) -> FloatArray:
    if not settings.symmetric:
        return np.ones(len(names))
    places = [name.split("_") for name in names]
    return np.array([1.0 if len(parts) != 3 or parts[1] == parts[2] else 2.0 for parts in places])


def _names(outcomes: Sequence[Outcome], truth: Truth) -> list[str]:
    """The parameters whose truth is known; one that a fit eliminated, which is zero then, is another's."""
    parameters = (parameter for outcome in outcomes for parameter in outcome.parameters)
    return list(dict.fromkeys(p.name for p in parameters if not p.derived and p.name in truth))


def _parameter(name: str, results: Sequence[Outcome], truth: float, bound: float | None) -> StudiedParameter:
    estimates = [p for outcome in results for p in outcome.parameters if p.name == name]
    # Without those that the other repeats eliminated.
    values = np.array([p.value for p in estimates] + [0.0] * (len(results) - len(estimates)))
    stated = [p.std_error for p in estimates if p.std_error is not None]
    intervals = [p.ci95 for p in estimates if p.ci95 is not None]
    return StudiedParameter(
        name=name,
        unit=estimates[0].unit,
        truth=truth,
        mean=float(values.mean()),
        rmse=float(np.sqrt(np.mean((values - truth) ** 2))),
        bound=bound,
        std_error=float(np.mean(stated)) if stated else None,
        coverage=float(np.mean([low <= truth <= high for low, high in intervals])) if intervals else None,
    )


Tell = Callable[[str], None]

# Range of the search for a threshold, in multiples of the lowest and highest noise level, and its precision.
SEARCHED_BELOW, SEARCHED_ABOVE = 0.05, 20.0
SEARCH_RATIO = 1.05
# Repeats of one step of the search; the standard error of a success rate of 95 % is 1.5 %.
SEARCH_REPEATS = 200
# Repeats between two looks at how many are lost.
SEARCH_STEP = 20


def run_study(
    rig: Any,
    settings: StudySettings,
    fits: Sequence[FitSettings],
    frf: FrfSettings | None,
    tell: Tell,
    jobs: int = 1,
) -> Study:
    """Every fit at every noise level and number of lines; *rig* is a virtual rig's settings.

    The noise of a repeat depends on the seed and its number alone, so all levels and fits see the same draws.
    *jobs*: processes, 0 for one per processor; several need the usual `if __name__ == "__main__"` of a
    script. ConfigError for lines or runs that the rig does not have.
    """
    plain = [replace(fit, compare=False) for fit in fits]
    counts: list[int | None] = [int(count) for count in settings.lines] or [None]
    cases: list[StudyCase] = []
    with workers(jobs) as crew:
        for noise, count in product(settings.noise, counts):
            source = source_of(rig, noise, count, settings.runs, frf)
            tell(f"study     noise {100 * noise:g} %, {source.n_line} lines, {settings.repeats} repeats")
            outcomes = crew.outcomes(source, plain, range(settings.repeats), (settings.seed,))
            cases += (
                summarise(
                    of_fit, fit, source.truth, source.bounds(fit), settings.success, noise, source.n_line
                )
                for fit, of_fit in zip(plain, outcomes, strict=True)
            )
        thresholds = [
            _threshold(rig, settings, fit, limit, frf, crew, tell, cases)
            for limit, fit in product(settings.success if settings.thresholds else (), plain)
        ]
    return Study(
        rig.name,
        settings.seed,
        settings.success,
        settings.share,
        tuple(cases),
        tuple(thresholds),
        settings.printed,
    )


def _threshold(
    rig: Any,
    settings: StudySettings,
    fit: FitSettings,
    limit: float,
    frf: FrfSettings | None,
    crew: Workers,
    tell: Tell,
    cases: Sequence[StudyCase],
) -> StudyThreshold:
    """Bisection over the logarithm of the noise, with the same draws at every level, left as soon as too many
    repeats are lost; the *cases* decide levels beyond theirs.
    """
    count = int(settings.lines[0]) if settings.lines else None
    numbers = list(range(min(settings.repeats, SEARCH_REPEATS)))
    lines = source_of(rig, settings.noise[0], count, settings.runs, frf).n_line
    place = settings.success.index(limit)
    decided = [
        (case.noise, case.success[place] >= settings.share)
        for case in cases
        if case.fit == fit.name and case.lines == lines and case.repeats >= len(numbers)
    ]

    def is_held(noise: float) -> bool:
        for level, held in decided:
            if (noise <= level) if held else (noise >= level):
                return held
        source: Source = source_of(rig, noise, count, settings.runs, frf)
        lost: list[int] = []
        for start in range(0, len(numbers), SEARCH_STEP):
            drawn = numbers[start : start + SEARCH_STEP]
            (outcomes,) = crew.outcomes(source, [fit], drawn, (settings.seed,))
            ended = zip(drawn, outcomes, strict=True)
            names = _names(outcomes, source.truth)
            lost += [r for r, outcome in ended if not _is_success(outcome, names, fit, source.truth, limit)]
            if (len(numbers) - len(lost)) / len(numbers) < settings.share:
                break
        numbers.sort(key=lambda r: r not in lost)
        return (len(numbers) - len(lost)) / len(numbers) >= settings.share

    tell(f"study     threshold of {fit.name} at {100 * limit:g} %")
    low, high = SEARCHED_BELOW * min(settings.noise), SEARCHED_ABOVE * max(settings.noise)
    if not is_held(low) or is_held(high):
        return StudyThreshold(fit.name, limit, None, len(numbers))
    while high / low > SEARCH_RATIO:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if is_held(middle) else (low, middle)
    return StudyThreshold(fit.name, limit, float(np.sqrt(low * high)), len(numbers))
