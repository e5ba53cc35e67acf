"""plan of a floating bearing at several loads and speeds: settings -> which states to run how often, their signals, and the pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.config.bearing import BearingFile, open_bearing, setting_at
from labpipe.config.plan import PlanFile
from labpipe.errors import ConfigError
from labpipe.formats.signal_file import write_signal
from labpipe.marked_yaml import set_entry
from labpipe.planner.model import AXES, MODELS
from labpipe.planner.plan import period_signals
from labpipe.planner.run_plan import Answered, plan_runs
from labpipe.planner.state_settings import COEFFICIENTS, FLOATING, StatePlanSettings
from labpipe.planner.states import BearingState, Common, StateTest, question_of, state_tests
from labpipe.records.run_plan import PlannedRun
from labpipe.records.settings import settings_of
from labpipe.registry import nearest
from labpipe.report.run_plan import run_names, run_sentences
from labpipe.stages.plan_evaluation import PIPELINE, RIG, Evaluation, pipeline_entries, rig_entries
from labpipe.stages.plan_runs import write_runs

# Half of a difference, relative to the number.
STEP = 1e-2
UNTESTED = "What all states have in common is taken from the theory: whether it holds in the states without a run is not tested."


def state_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan the runs and write their files; sentences on them, and the files' names."""
    settings: StatePlanSettings = file.settings
    answered, tests = plan_states(settings, file.title, file.path.parent)
    names = []
    for run in answered.plan.runs:
        test = tests[run.name]
        period = period_signals(test.multisine, settings.sample_rate, settings.period)
        for axis, samples in zip(AXES, period.T, strict=True):
            names.append(f"signals/{run.name}-{axis}.csv")
            whole = np.tile(samples, settings.periods + settings.skip)
            write_signal(output.write_path(names[-1]), whole, settings.sample_rate, "f [N]")
    evaluations = {run: _evaluation(settings, file.title, tests[run.name]) for run in answered.plan.runs}
    entries = {
        RIG: rig_entries(next(iter(evaluations.values()))),
        PIPELINE: _pipeline(file.title, evaluations, tests, output.target.absolute()),
    }
    names += write_runs(answered.plan, entries, output)
    return list(run_sentences(answered.plan)), names


def plan_states(settings: StatePlanSettings, title: str, folder: Path) -> tuple[Answered, dict[str, StateTest]]:
    """The runs that tell most within the time, with the tests of all states by name; ConfigError where the goals cannot be met."""
    bearing = open_bearing(folder / settings.bearing)
    for name in ("load", "speed"):
        if name not in settings_of(bearing.kind.settings):
            raise ConfigError(f"a file of a {bearing.kind_name} has no '{name}'", hint="a journal bearing has", field="bearing")
    common = [_common(bearing, name) for name in settings.estimate]
    tests = state_tests(settings, _states(settings, bearing, common))
    answered = plan_runs(question_of(settings, tests, common), title, settings.model)
    if common and len(answered.plan.runs) < len(tests):
        answered = answered.noted([UNTESTED])
    return answered, {test.state.name: test for test in tests}


def _common(bearing: BearingFile, name: str) -> Common:
    """A number of the bearing file, with its doubt as what is known before."""
    declared = settings_of(bearing.kind.settings)
    if name not in declared or declared[name][0].kind != "value" or name in ("load", "speed"):
        numbers = tuple(key for key, (declaration, _) in declared.items() if declaration.kind == "value" and key not in ("load", "speed"))
        raise ConfigError(f"'{name}' is no number of a {bearing.kind_name}", hint=nearest(name, numbers), field="estimate")
    value = getattr(bearing.settings(), name)
    if not value:
        raise ConfigError(f"the bearing file gives no {name}", hint="state it there", field="estimate")
    doubt = bearing.doubts.get(name)
    return Common(name, float(value), declared[name][0].unit, None if doubt is None else doubt.std_error)


def _states(settings: StatePlanSettings, bearing: BearingFile, common: Sequence[Common]) -> list[BearingState]:
    """Every load at every speed, with coefficients by theory and their slopes by central differences."""
    points = [(load, speed) for load in settings.loads for speed in settings.speeds]
    changes: list[tuple[Common, float] | None] = [None, *((number, sign) for number in common for sign in (1.0, -1.0))]
    wanted = [_settings(bearing, load, speed, change) for load, speed in points for change in changes]
    values = np.array([_eight(bearing, state) for state in bearing.coefficients(wanted)]).reshape(len(points), len(changes), -1)
    states = []
    for (load, speed), coefficients in zip(points, values, strict=True):
        steps = np.array([2 * STEP * number.value for number in common])
        slopes = ((coefficients[1::2] - coefficients[2::2]) / steps[:, None]).T if common else np.zeros((len(COEFFICIENTS), 0))
        model = MODELS[FLOATING].model(dict(zip(COEFFICIENTS, coefficients[0].tolist(), strict=True)), settings.mass)
        states.append(BearingState(_name(load, speed), load, speed, model, slopes))
    return states


def _name(load: float, speed: float) -> str:
    return f"{load:g}N-{60 * speed:g}rpm".replace(".", "p")


def _settings(bearing: BearingFile, load: float, speed: float, change: tuple[Common, float] | None) -> Any:
    """The bearing's settings in a state, with a number a step off; the file's entries are as before then."""
    entries = [("load", load, "N"), ("speed", speed, "Hz")]
    for name, value, unit in entries:
        set_entry(bearing.tree, f"{name}={value!r} {unit}")
    if change is None:
        return bearing.settings()
    number, sign = change
    unit = setting_at(bearing.kind.settings, number.name).unit
    set_entry(bearing.tree, f"{number.name}={number.value * (1 + sign * STEP)!r} {unit}".rstrip())
    moved = bearing.settings()
    set_entry(bearing.tree, f"{number.name}={number.value!r} {unit}".rstrip())
    return moved


def _eight(bearing: BearingFile, whole: BearingCoefficients) -> FloatArray:
    """K, then C, row by row, (8,) [N/m, N.s/m]."""
    lateral = whole.lateral(*bearing.kind.lateral)
    return np.concatenate([lateral.stiffness.ravel(), lateral.damping.ravel()])


def _evaluation(settings: StatePlanSettings, title: str, test: StateTest) -> Evaluation:
    return Evaluation(settings.at(test.state.speed), title, (test.planned,), with_masses=False)


def _pipeline(title: str, evaluations: dict[PlannedRun, Evaluation], tests: dict[str, StateTest], folder: Path) -> dict[str, Any]:
    """The pipeline of all states, one test each with the lines of its own; recordings are looked for in recordings/."""
    listed, entries = [], {}
    for run, evaluation in evaluations.items():
        entries, state = pipeline_entries(evaluation, folder), tests[run.name].state
        listed.append(
            {
                "name": run.name,
                "recordings": [f"recordings/{name}.csv" for name in run_names(run)],
                "conditions": {"load": f"{state.load!r} N", "speed": f"{state.speed!r} Hz"},
                "frf": entries["frf"],
            }
        )
    return {"title": title, "rig": RIG, "tests": listed, "frf": entries["frf"], "identify": entries["identify"]}
