"""plan of run-ups: settings -> which loads, trial unbalances and speeds to run, and the pipeline of their joint fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.plan import PlanFile
from labpipe.errors import ConfigError, FitError
from labpipe.formats.run_up_csv import write_run_up_csv
from labpipe.planner.run_plan import Answered, Change, Condition, Quantity, RunQuestion, plan_runs
from labpipe.planner.run_up_settings import SPEEDS, RunUpPlanSettings, TrialSettings
from labpipe.records.run_plan import RunPlan
from labpipe.records.run_up import Shaker
from labpipe.report.run_plan import run_names, run_sentences
from labpipe.rigs.film_family import COEFFICIENTS, PARAMETERS, PRIOR, FilmFamily
from labpipe.rigs.run_up_rotor import RPM, RunUpRotor
from labpipe.run_ups.candidates import ExpectedRig, Limits, Reading, RunCandidate, at_allowed_speeds, expected_run, information
from labpipe.run_ups.misfit import scales
from labpipe.stages.plan_runs import PIPELINE, ROTOR, write_runs

METHOD = "joint"
# Standard error of the logarithm of what is known.
KNOWN = 1e-5
# Half of a difference, in logarithms.
STEP = 1e-4
# The second load that is tried, over the highest.
OTHER_LOAD = 1.5


@dataclass(frozen=True)
class RunUpsPlanned:
    """The plan with the rig as expected and the candidates it chose from, by name."""

    answered: Answered
    expected: ExpectedRig
    candidates: dict[str, RunCandidate]

    @property
    def plan(self) -> RunPlan:
        """What is to be run."""
        return self.answered.plan


def run_up_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan the run-ups and write their files; sentences on them, and the files' names."""
    settings: RunUpPlanSettings = file.settings
    planned = plan_run_ups(settings, file.title, _earlier(file))
    names = []
    for run in planned.plan.runs:
        name = f"expected/{run.name}.csv"
        write_run_up_csv(output.write_path(name), expected_run(planned.expected, planned.candidates[run.name]))
        names.append(name)
    rotor = (file.path.parent / settings.rotor).read_text(encoding="utf-8")
    pipeline = pipeline_entries(planned.plan, settings)
    names += write_runs(planned.plan, {ROTOR: rotor, PIPELINE: pipeline}, output)
    return list(run_sentences(planned.plan)), names


def _earlier(file: PlanFile) -> dict[str, float]:
    """Factors and exponents of the joint fit of an earlier result."""
    if not file.settings.earlier:
        return {}
    path = file.path.parent / file.settings.earlier
    result = read_identification(path).sections.get("run_ups")
    methods = [] if result is None else [method for method in result.methods if method.name == METHOD]
    if not methods:
        raise ConfigError(f"{path.name} holds no joint fit of run-ups", hint="run_ups: {methods: [joint]}", field="earlier")
    return {parameter.name: parameter.value for parameter in methods[0].parameters}


def pipeline_entries(plan: RunPlan, settings: RunUpPlanSettings) -> dict[str, Any]:
    """The pipeline that evaluates the runs; tables are looked for in recordings/."""
    runs = [{"file": f"recordings/{name}.csv"} for run in plan.runs for name in run_names(run)]
    section: dict[str, Any] = {"rotor": ROTOR, "methods": [METHOD], "runs": runs}
    if settings.known:
        section["known"] = list(settings.known)
    return {"title": plan.title, "run_ups": section}


def plan_run_ups(settings: RunUpPlanSettings, title: str, earlier: dict[str, float]) -> RunUpsPlanned:
    """The runs that tell most within the time; ConfigError where a goal cannot be met however many there are."""
    expected = _expected(settings, earlier)
    candidates, notes = _allowed(expected, _candidates(settings, expected, settings.loads), settings)
    given = settings.known
    question = RunQuestion(
        parameters=PARAMETERS,
        units=PRIOR,
        prior=_prior(given),
        conditions=tuple(_condition(settings, expected, candidate) for candidate in candidates),
        quantities=tuple(_quantities(settings, expected)),
        duration=settings.duration,
        criterion=settings.criterion,
        known=given,
        remedies=tuple(_remedies(settings, expected, candidates)),
    )
    answered = plan_runs(question, title, settings.model, notes)
    return RunUpsPlanned(answered, expected, {candidate.name: candidate for candidate in candidates})


def _expected(settings: RunUpPlanSettings, earlier: dict[str, float]) -> ExpectedRig:
    assert settings.rig is not None
    rig: RunUpRotor = settings.rig
    if rig.speeds is None:
        rig = replace(rig, speeds=(float(settings.omega[0]), float(settings.omega[-1])))
    film = rig.place.film("a plan of run-ups")
    family = FilmFamily(film, rig.search.high / 2, float(np.exp(np.mean(np.log(sorted(set(settings.loads)))))))
    noise = settings.noise
    reading = Reading(noise.amplitude, noise.displacement, noise.phase, noise.threshold)
    return ExpectedRig(rig, family, settings.values(earlier), reading)


def _prior(known: Sequence[str]) -> FloatArray:
    """Information (12, 12) of the joint fit's prior, and of what is known."""
    return np.diag([(KNOWN if name in known else float(spread)) ** -2.0 for name, spread in zip(PARAMETERS, PRIOR, strict=True)])


def _candidates(settings: RunUpPlanSettings, expected: ExpectedRig, loads: Sequence[float]) -> Iterator[RunCandidate]:
    """Every trial under every load on every stretch of speeds; the highest also on to the threshold."""
    stretches = np.array_split(settings.omega, settings.stretches)
    for place, load in enumerate(loads, 1):
        for name, trial in settings.trials:
            for number, speed in enumerate(stretches, 1):
                stem = f"load-{place}-{name.replace(' ', '-')}" + (f"-{number}" if settings.stretches > 1 else "")
                candidate = RunCandidate(stem, load, speed, dict(trial.unbalance), _shaker(trial))
                yield candidate
                if settings.to_threshold and number == settings.stretches and not trial.shaker and expected.threshold(load) is not None:
                    yield replace(candidate, name=f"{stem}-threshold", to_threshold=True)


def _shaker(trial: TrialSettings) -> Shaker | None:
    return Shaker(trial.shaker, trial.force, 0.0, trial.ratio) if trial.shaker else None


def _allowed(
    expected: ExpectedRig, candidates: Iterator[RunCandidate], settings: RunUpPlanSettings
) -> tuple[list[RunCandidate], list[str]]:
    """The candidates at the speeds that limits and stability allow, and notes on those that were cut."""
    limits = Limits(settings.displacement_limit, settings.journal_limit)
    kept, cut, whole = [], 0, 0
    for candidate in candidates:
        allowed = at_allowed_speeds(expected, candidate, limits)
        kept += [] if allowed is None else [allowed]
        full = allowed is not None and allowed.speed.size == candidate.speed.size
        cut, whole = cut + (not full), whole + full
    if not kept:
        raise ConfigError(
            "no run keeps within the limits and above the noise", hint="other trial unbalances, or other speeds", field="trials"
        )
    words = f"{cut} of {cut + whole} candidates leave out speeds at which they would be unstable, beyond the limits or within the noise."
    return kept, [words] if cut else []


def _condition(settings: RunUpPlanSettings, expected: ExpectedRig, candidate: RunCandidate) -> Condition:
    seconds = settings.dwell * candidate.speed.size + settings.changeover
    low, high = candidate.speed[[0, -1]] / RPM
    trial = next(
        trial for name, trial in settings.trials if candidate.shaker == _shaker(trial) and candidate.unbalance == dict(trial.unbalance)
    )
    end = ", on to the threshold" if candidate.to_threshold else ""
    conditions = (
        ("load", f"{candidate.load:.4g} N"),
        ("excitation", trial.words),
        ("speeds", f"{low:.0f} to {high:.0f} rpm in {candidate.speed.size} steps{end}"),
        ("rate", f"{(high - low) / (settings.dwell * max(candidate.speed.size - 1, 1)):.3g} rpm/s"),
    )
    return Condition(candidate.name, seconds, conditions, information(expected, candidate))


def _remedies(settings: RunUpPlanSettings, expected: ExpectedRig, candidates: Sequence[RunCandidate]) -> Iterator[Change]:
    """A measured clearance, a shaker, a second load: alone, then two of them."""
    conditions = tuple(_condition(settings, expected, candidate) for candidate in candidates)
    shaken = TrialSettings(shaker=expected.rig.plane_names[0])
    with_shaker = replace(settings, trials=(*settings.trials, ("shaker", shaken)))
    other = (OTHER_LOAD * max(settings.loads),)
    changes: dict[str, tuple[tuple[Condition, ...], tuple[str, ...]]] = {"a measured clearance (known: clearance)": ((), ("clearance",))}
    if not any(trial.shaker for _, trial in settings.trials):
        changes["a run under a shaker whose force does not turn"] = (_extra(with_shaker, expected, settings.loads[:1]), ())
    if len(set(settings.loads)) == 1:
        changes["a second load"] = (_extra(settings, expected, other), ())
    for size in (1, 2):
        for names in combinations(changes, size):
            extra = tuple(condition for name in names for condition in changes[name][0])
            parameters = tuple(parameter for name in names for parameter in changes[name][1])
            yield Change(" and ".join(names), size, (*conditions, *extra), parameters)


def _extra(settings: RunUpPlanSettings, expected: ExpectedRig, loads: Sequence[float]) -> tuple[Condition, ...]:
    try:
        allowed, _ = _allowed(expected, _candidates(replace(settings, to_threshold=False), expected, loads), settings)
    except (ConfigError, FitError):
        return ()
    return tuple(_condition(settings, expected, candidate) for candidate in allowed)


def _quantities(settings: RunUpPlanSettings, expected: ExpectedRig) -> Iterator[Quantity]:
    """Parameters that are not known; at a named load and speed also speeds and coefficients, relative."""
    goals = {name: values[0] for name, values in settings.goal}
    for number, name in enumerate(PARAMETERS):
        if name not in settings.known:
            value = float(expected.values[number])
            shown = value if name in ("viscosity_speed", "viscosity_load") else float(np.exp(value))
            yield Quantity(name, "1", shown, np.eye(len(PARAMETERS))[number], goals.get(name), 1.0)
    if settings.at_load is None:
        return
    for name in SPEEDS:
        at_speed = _speed_row(expected, settings.at_load, name)
        if at_speed is not None:
            value, row = at_speed
            goal = None if name not in goals else goals[name] * value
            yield Quantity(name, "rad/s", value, row, goal, value)
        elif name in goals:
            raise ConfigError(f"no {name} is expected under {settings.at_load:g} N", hint="leave its goal out", field="goal")
    if settings.at_speed is not None:
        place = np.array([2 * np.pi * settings.at_speed])
        eight, slopes = expected.family.coefficients_and_slopes(expected.values, np.array([settings.at_load]), place)
        sizes = scales(eight)[0]
        for number, name in enumerate(COEFFICIENTS):
            unit = "N/m" if name.startswith("k") else "N.s/m"
            goal = None if name not in goals else goals[name] * float(sizes[number])
            yield Quantity(name, unit, float(eight[0, number]), slopes[0, number], goal, float(sizes[number]))


def _speed_row(expected: ExpectedRig, load: float, name: str) -> tuple[float, FloatArray] | None:
    """A critical or threshold speed [rad/s] and its derivatives (12,) by the logarithms; None where there is none."""

    def speed(values: FloatArray) -> float | None:
        at = expected.family.at_load(values, load)
        return expected.rig.critical_speed(at) if name == "critical_speed" else expected.rig.threshold(at)

    try:
        value = speed(expected.values)
        ends = [[speed(expected.values + sign * STEP * unit) for sign in (1, -1)] for unit in np.eye(len(PARAMETERS))]
    except FitError:
        return None
    if value is None or any(end is None for pair in ends for end in pair):
        return None
    return value, np.array([(high - low) / (2 * STEP) for high, low in np.array(ends, float)])
