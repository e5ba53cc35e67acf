"""plan of a floating bearing at several loads and speeds: which states to run how often, and their signals.

Of numbers p that all states have in common, a clearance or a viscosity, the run in a state s tells J_s^T I_s
J_s, where I_s is what it tells of the coefficients there and J_s = d(coefficients)/dp.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import SettingError
from labpipe.methods.planning import plan
from labpipe.methods.planning.campaigns import INTERLEAVED, TOGETHER, Multisines, PlannedRig
from labpipe.methods.planning.excitation import PIPELINE, RIG, Evaluation, pipeline_entries, rig_entries
from labpipe.methods.planning.model import AXES, FLOATING, UNITS, PlannedModel, matrix_names, planned_model
from labpipe.methods.planning.plan_file import PlanFile, write_runs
from labpipe.methods.planning.records import PlannedRun, PlannedTest
from labpipe.methods.planning.report import run_names, run_sentences
from labpipe.methods.planning.runs import Answered, CandidateRun, RunQuantity, RunQuestion, plan_runs
from labpipe.methods.planning.search import BOTH_LIMITS, flat
from labpipe.methods.planning.settings import (
    PlanKind,
    PlanSettings,
    SignalSettings,
    check_distinct,
    check_relative,
)
from labpipe.project.bearing_file import BearingFile, open_bearing
from labpipe.project.exports import write_signal
from labpipe.project.marked_yaml import set_entry
from labpipe.records.settings import choice, integer, names, quantity, setting, settings_of
from labpipe.registry import nearest

STATES = "bearing-states"
COEFFICIENTS = matrix_names("kc")


@dataclass(frozen=True)
class StatePlanSettings(SignalSettings):
    """Which loads and speeds can be run, how a state is tested, and what the tests are to tell."""

    model: str = choice("what will be identified: a floating bearing over load and speed", (STATES,))
    bearing: str = setting(
        "file",
        "bearing file with `load` and `speed`; its y and z are the plan's x and y",
        file_kind="bearing",
    )
    _: KW_ONLY
    loads: tuple[float, ...] = setting("values", "static loads that can be set", "N")
    speeds: tuple[float, ...] = setting("values", "speeds that can be run", "Hz")
    mass: float = quantity("mass of the stator", "kg")
    band: tuple[float, float] = setting("band", "frequencies that are excited, all alike", "Hz")
    run: float = quantity("measured time of one run in one state", "s")
    duration: float = quantity("of all runs with what lies between them", "s")
    force_limit: float = quantity("largest force of a shaker, 0-to-peak", "N")
    displacement_limit: float | None = quantity(
        "largest displacement in x or y, 0-to-peak; default: none", "m", None
    )
    changeover: float = quantity("time between runs", "s", 0.0)
    estimate: tuple[str, ...] = names(
        "numbers of the bearing file that all states have in common; default: none, every state by itself"
    )
    goal: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series",
        "relative standard errors that are wanted: {k_xy: 2 %, clearance: 1 %}; default: all alike",
        "1",
        (),
    )
    scheme: str = choice("how both shakers run at once", (INTERLEAVED, TOGETHER), INTERLEAVED)
    skip: int = integer("transient periods before the measured ones, in every run", 1)

    def __post_init__(self) -> None:
        check_distinct(self, "loads", "speeds", "estimate")
        self.require_positive("loads", "speeds", "duration")
        self.require_not_negative("changeover")
        if self.periods < plan.FEWEST_PERIODS:
            what = f"{self.periods} periods in a run, the noise is known from {plan.FEWEST_PERIODS}"
            raise SettingError("run", what, f"a run of {plan.FEWEST_PERIODS * self.period:g} s or more")
        for name, _ in self.goal:
            if name not in (*COEFFICIENTS, *self.estimate):
                allowed = f"known: {', '.join((*COEFFICIENTS, *self.estimate))}"
                raise SettingError("goal", f"no {name} is predicted", allowed)
        check_relative(self.goal)
        self.at(self.speeds[0])

    @property
    def periods(self) -> int:
        return int(self.run / self.period + 0.5)

    @property
    def seconds(self) -> float:
        """Time that a run takes [s], transient periods and what lies between runs included."""
        return (self.periods + self.skip) * self.period + self.changeover

    def at(self, speed: float) -> PlanSettings:
        """The settings of the test of one state at a *speed* [Hz]; ConfigError as for any test."""
        names = "mass band period sample_rate force_limit displacement_limit noise noise_density scheme"
        return PlanSettings(
            FLOATING,
            **{name: getattr(self, name) for name in (*names.split(), "exclude", "mains", "skip")},
            duration=self.periods * self.period,
            expected=tuple((name, 1.0) for name in COEFFICIENTS),
            speed=speed,
        )


@dataclass(frozen=True)
class CommonNumber:
    """A number that all states have in common: value [unit], standard error known before, if any."""

    name: str
    value: float
    unit: str
    std_error: float | None = None


@dataclass(frozen=True)
class BearingState:
    """The bearing under a *load* [N] at a *speed* [Hz], with its expected coefficients in *model*.

    slopes (8, n_common) [units of the coefficients per unit of each number]: their derivatives by what all
    states have in common.
    """

    name: str
    load: float
    speed: float
    model: PlannedModel
    slopes: FloatArray


@dataclass(frozen=True)
class StateTest:
    """The test of a state: rig, multisine, information (8, 8) [1/units] of the coefficients by one run."""

    state: BearingState
    rig: PlannedRig
    multisine: Multisines
    planned: PlannedTest
    information: FloatArray
    notes: tuple[str, ...] = ()


def state_test(settings: StatePlanSettings, state: BearingState) -> StateTest:
    """The flat multisine of a state, as large as its limits allow; ConfigError where no line is left."""
    state_settings = settings.at(state.speed)
    rig = plan.bench(state_settings, state.model)
    campaign = flat(rig, plan.planned_lines(state_settings), settings.scheme, BOTH_LIMITS)
    factor = plan.weighting_factor(settings.periods, of_spectra=True)
    scales = np.outer(state.model.scales, state.model.scales)
    information = campaign.rate * settings.periods * settings.period / factor**2 / scales
    (test,) = campaign.tests
    planned = plan.planned_test(rig, test, settings.periods, settings.skip)
    notes = plan.settling_notes(rig, campaign, (settings.periods,), settings.skip)
    named = tuple(f"{state.name}: {note}" for note in notes)
    return StateTest(state, rig, test, planned, information, named)


def question_of(
    settings: StatePlanSettings, tests: Sequence[StateTest], common: Sequence[CommonNumber]
) -> RunQuestion:
    """What is asked of the runs: parameters are the numbers in common, or where there are none the
    coefficients of every state. Equation (plan-states).
    """
    if common:
        slopes = [test.state.slopes for test in tests]
        parameters = tuple(number.name for number in common)
        units = np.array([abs(number.value) for number in common])
        prior = np.diag([0.0 if number.std_error is None else number.std_error**-2.0 for number in common])
    else:
        n = len(COEFFICIENTS)
        slopes = [np.eye(n * len(tests))[n * number : n * (number + 1)] for number in range(len(tests))]
        parameters = tuple(f"{name}[{test.state.name}]" for test in tests for name in COEFFICIENTS)
        units = np.concatenate([test.state.model.scales for test in tests])
        prior = np.zeros((len(parameters),) * 2)
    conditions = []
    for test, rows in zip(tests, slopes, strict=True):
        words = (
            ("load", f"{test.state.load:.4g} N"),
            ("speed", f"{60 * test.state.speed:.5g} rpm"),
            ("force", f"{max(test.planned.peak_force):.4g} N peak"),
            ("displacement", f"{1e6 * max(test.planned.peak_displacement):.3g} um peak"),
        )
        information = rows.T @ test.information @ rows
        conditions.append(CandidateRun(test.state.name, settings.seconds, words, information))
    wanted, duration = tuple(_quantities(settings, tests, slopes, common)), settings.duration
    return RunQuestion(parameters, units, prior, tuple(conditions), wanted, duration, settings.criterion)


def _quantities(
    settings: StatePlanSettings,
    tests: Sequence[StateTest],
    slopes: Sequence[FloatArray],
    common: Sequence[CommonNumber],
) -> Iterator[RunQuantity]:
    goals = {name: values[0] for name, values in settings.goal}
    for row, entry in zip(np.eye(len(common)), common, strict=True):
        size = abs(entry.value)
        goal = goals[entry.name] * size if entry.name in goals else None
        yield RunQuantity(entry.name, entry.unit, entry.value, row, goal, size)
    for test, rows in zip(tests, slopes, strict=True):
        model = test.state.model
        for name, value, scale, row in zip(COEFFICIENTS, model.expected, model.scales, rows, strict=True):
            goal = goals[name] * float(scale) if name in goals else None
            label = f"{name}[{test.state.name}]"
            yield RunQuantity(label, UNITS[name[0]], float(value), row, goal, float(scale))


STEP = 1e-2
UNTESTED = (
    "What all states have in common is taken from the theory: whether it holds in the states without "
    "a run is not tested."
)


def state_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    settings: StatePlanSettings = file.settings
    answered, tests = plan_states(settings, file.title, file.path.parent)
    names, evaluations = [], {}
    for run in answered.plan.runs:
        test = tests[run.name]
        at = settings.at(test.state.speed)
        evaluations[run] = Evaluation(at, file.title, (test.planned,), with_masses=False)
        period = plan.period_signals(test.multisine, settings.sample_rate, settings.period)
        for axis, samples in zip(AXES, period.T, strict=True):
            names.append(f"signals/{run.name}-{axis}.csv")
            whole = np.tile(samples, settings.periods + settings.skip)
            write_signal(output.write_path(names[-1]), whole, settings.sample_rate, "f [N]")
    entries = {
        RIG: rig_entries(next(iter(evaluations.values()))),
        PIPELINE: _pipeline(file.title, evaluations, tests, output.target.absolute()),
    }
    names += write_runs(answered.plan, entries, output)
    return list(run_sentences(answered.plan)), names


def plan_states(
    settings: StatePlanSettings, title: str, folder: Path
) -> tuple[Answered, dict[str, StateTest]]:
    """The runs that tell most in the time, all tests by name. ConfigError where no goal can be met."""
    bearing = open_bearing(folder / settings.bearing)
    for name in ("load", "speed"):
        if name not in settings_of(bearing.kind.settings):
            what = f"a file of a {bearing.kind_name} has no '{name}'"
            raise SettingError("bearing", what, "a journal bearing has")
    common = [common_number(bearing, name) for name in settings.estimate]
    tests = [state_test(settings, state) for state in planned_states(settings, bearing, common)]
    answered = plan_runs(question_of(settings, tests, common), title, settings.model)
    if common and len(answered.plan.runs) < len(tests):
        answered = answered.add_notes([UNTESTED])
    of_state = {test.state.name: test for test in tests}
    return answered.add_notes(
        note for run in answered.plan.runs for note in of_state[run.name].notes
    ), of_state


def common_number(bearing: BearingFile, name: str) -> CommonNumber:
    """A number of the bearing file that all states have in common; SettingError for what is none."""
    declared = settings_of(bearing.kind.settings)
    values = (key for key, (declaration, _) in declared.items() if declaration.kind == "value")
    numbers = tuple(key for key in values if key not in ("load", "speed"))
    if name not in numbers:
        what = f"'{name}' is not a number of a {bearing.kind_name}"
        raise SettingError("estimate", what, nearest(name, numbers))
    value = getattr(bearing.settings(), name)
    if not value:
        raise SettingError("estimate", f"the bearing file gives no {name}", "state it there")
    uncertainty = bearing.uncertainties.get(name)
    std_error = None if uncertainty is None else uncertainty.std_error
    return CommonNumber(name, float(value), declared[name][0].unit, std_error)


def planned_states(
    settings: StatePlanSettings, bearing: BearingFile, common: Sequence[CommonNumber]
) -> list[BearingState]:
    """The bearing at each load and speed of the plan, with its slopes by what all states have in *common*."""
    points = [(load, speed) for load in settings.loads for speed in settings.speeds]
    base = {number.name: f"{number.value!r} {number.unit}".rstrip() for number in common}
    changes = [base]
    for number in common:
        for factor in (1 + STEP, 1 - STEP):
            changes.append({**base, number.name: f"{number.value * factor!r} {number.unit}".rstrip()})
    wanted = []
    for load, speed in points:
        for change in changes:
            for name, text in {"load": f"{load!r} N", "speed": f"{speed!r} Hz", **change}.items():
                set_entry(bearing.tree, f"{name}={text}")
            wanted.append(bearing.settings())
    lateral = [whole.lateral(*bearing.kind.lateral) for whole in bearing.coefficients(wanted)]
    eights = np.array([[two.stiffness, two.damping] for two in lateral])
    states = []
    for (load, speed), values in zip(points, eights.reshape(len(points), len(changes), -1), strict=True):
        steps = np.array([2 * STEP * number.value for number in common])
        slopes = ((values[1::2] - values[2::2]) / steps[:, None]).T
        expected = dict(zip(COEFFICIENTS, values[0].tolist(), strict=True))
        model = planned_model(FLOATING, expected, settings.mass)
        name = f"{load:g}N-{60 * speed:g}rpm".replace(".", "p")
        states.append(BearingState(name, load, speed, model, slopes))
    return states


def _pipeline(
    title: str, evaluations: dict[PlannedRun, Evaluation], tests: dict[str, StateTest], folder: Path
) -> dict[str, Any]:
    listed, entries = [], {}
    for run, evaluation in evaluations.items():
        entries, state = pipeline_entries(evaluation, folder), tests[run.name].state
        files = [f"recordings/{name}.csv" for name in run_names(run)]
        at = {"load": f"{state.load!r} N", "speed": f"{state.speed!r} Hz"}
        listed.append({"name": run.name, "recordings": files, "conditions": at, "frf": entries["frf"]})
    same = {name: entries[name] for name in ("frf", "identify")}
    return {"title": title, "rig": RIG, "tests": listed, **same}


STATES_PLAN = PlanKind(StatePlanSettings, state_files)
