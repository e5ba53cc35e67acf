"""plan of wear tests: settings -> at which speeds and loads and in which bands to test, and the pipeline of the fits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.journal_kind import Wear
from labpipe.config.plan import PlanFile
from labpipe.planner.run_plan import Answered, Change, Condition, Quantity, RunQuestion, plan_runs
from labpipe.planner.wear_settings import WearPlanSettings
from labpipe.records.run_plan import PlannedRun, RunPlan
from labpipe.report.run_plan import run_sentences
from labpipe.stages.plan_runs import PIPELINE, write_runs
from labpipe.wear.candidates import ExpectedWear, ResponseTest, information
from labpipe.wear.measured import PLACES
from labpipe.wear.settings import ANGLE, DEPTH, UNITS

RIG = "rig.yaml"
# Lines about a speed that are left out, either way [blocks].
BESIDE = 2.5
# Correlation above which two parameters are hardly told apart.
ALIKE = 0.95
# Wear that is tried as a change where the expected one tells no angle.
VISIBLE = 5e-6


@dataclass(frozen=True)
class WearPoint:
    """One operating point and band of a test: *speed* [Hz], static *force* [N], *band* [Hz]."""

    name: str
    speed: float
    force: float
    band: tuple[float, float]


@dataclass(frozen=True)
class WearPlanned:
    """The plan with the rotor as expected and the points it chose from, by name."""

    answered: Answered
    expected: ExpectedWear
    testing: ResponseTest
    points: dict[str, WearPoint]

    @property
    def plan(self) -> RunPlan:
        """What is to be run."""
        return self.answered.plan


def wear_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan the tests and write their files; sentences on them, and the files' names."""
    settings: WearPlanSettings = file.settings
    planned = plan_wear(settings, file.title)
    rotor = yaml.safe_load((file.path.parent / settings.rotor).read_text(encoding="utf-8"))
    files: dict[str, Any] = {}
    for run in planned.plan.runs:
        point = planned.points[run.name]
        files[_rotor_name(run)] = rotor_entries(rotor, settings, point)
        files[f"virtual-{run.name}.yaml"] = virtual_entries(settings, run, point)
    files |= {RIG: rig_entries(settings), PIPELINE: pipeline_entries(planned, settings)}
    names = write_runs(planned.plan, files, output)
    return list(run_sentences(planned.plan)), names


def plan_wear(settings: WearPlanSettings, title: str) -> WearPlanned:
    """The tests that tell most within the time; ConfigError where a goal cannot be met however many there are."""
    assert settings.rig is not None
    bearing = settings.rig.place(settings.bearing).name
    expected = _expected(settings, bearing, settings.expected)
    testing = _testing(settings)
    points = tuple(_points(settings))
    conditions = _conditions(settings, expected, testing, points)
    units = _units(settings, expected)
    question = RunQuestion(
        parameters=tuple(expected.values),
        units=units,
        prior=_prior(settings),
        conditions=conditions,
        quantities=tuple(_quantities(settings, expected)),
        duration=settings.duration,
        criterion=settings.criterion,
        remedies=tuple(_remedies(settings, bearing, testing, points)),
    )
    answered = plan_runs(question, title, settings.model)
    notes = (
        *_range_notes(settings, answered),
        *_alike_notes(expected, answered),
        *_term_notes(settings, expected, testing, points, answered),
    )
    answered = answered.noted(notes)
    return WearPlanned(answered, expected, testing, {point.name: point for point in points})


def _expected(settings: WearPlanSettings, bearing: str, wear: Wear) -> ExpectedWear:
    assert settings.rig is not None
    values = {DEPTH: wear.depth, ANGLE: wear.angle, **{name: given.value for name, given in settings.nuisances.items()}}
    return ExpectedWear(settings.rig, bearing, values)


def _testing(settings: WearPlanSettings) -> ResponseTest:
    density = float(np.sqrt(2 / settings.sample_rate))
    exclude = tuple((speed - BESIDE / settings.block, speed + BESIDE / settings.block) for speed in settings.speeds)
    noise = settings.noise
    return ResponseTest(settings.force, settings.run, 1 / settings.block, noise.displacement * density, noise.force * density, exclude)


def _points(settings: WearPlanSettings) -> Iterator[WearPoint]:
    for speed in settings.speeds:
        for place, force in enumerate(settings.static_forces, 1):
            for number, band in enumerate(settings.bands, 1):
                name = f"{speed:g}Hz" + (f"-load-{place}" if len(settings.static_forces) > 1 else "")
                yield WearPoint(name.replace(".", "p") + (f"-band-{number}" if len(settings.bands) > 1 else ""), speed, force, band)


def _conditions(
    settings: WearPlanSettings, expected: ExpectedWear, testing: ResponseTest, points: Sequence[WearPoint]
) -> tuple[Condition, ...]:
    seconds = 2 * settings.run + settings.changeover
    conditions = []
    for point in points:
        at = expected.at(point.speed, settings.node, point.force)
        words = (
            ("speed", f"{60 * point.speed:.5g} rpm"),
            ("static force", f"{point.force:.4g} N"),
            ("band", f"{point.band[0]:g} to {point.band[1]:g} Hz"),
            ("force", f"{settings.force:g} N rms in y, then in z, {settings.run:g} s each"),
        )
        conditions.append(Condition(point.name, seconds, words, information(at, testing, point.band)))
    return tuple(conditions)


def _prior(settings: WearPlanSettings) -> FloatArray:
    return np.diag([0.0, 0.0, *(given.std_error**-2.0 for given in settings.nuisances.values())])


def _units(settings: WearPlanSettings, expected: ExpectedWear) -> FloatArray:
    """Micrometres and degrees; of the others their doubt."""
    return np.array(
        [1e-6, np.deg2rad(1.0), *(settings.nuisances[name].std_error for name in expected.values if name not in (DEPTH, ANGLE))]
    )


def _quantities(settings: WearPlanSettings, expected: ExpectedWear) -> Iterator[Quantity]:
    goals = {DEPTH: settings.goal.depth, ANGLE: settings.goal.angle}
    for number, (name, value) in enumerate(expected.values.items()):
        yield Quantity(name, UNITS[name], value, np.eye(len(expected.values))[number], goals.get(name))


def _remedies(settings: WearPlanSettings, bearing: str, testing: ResponseTest, points: Sequence[WearPoint]) -> Iterator[Change]:
    """What would tell an angle that light wear does not show: waiting until there is some."""
    if settings.expected.depth < VISIBLE:
        worn = _expected(settings, bearing, Wear(VISIBLE, settings.expected.angle))
        yield Change(f"a wear of {1e6 * VISIBLE:g} um", 1, _conditions(settings, worn, testing, points))


def _range_notes(settings: WearPlanSettings, answered: Answered) -> Iterator[str]:
    """Where the angle is known no better than before: with every angle of its range alike."""
    error = next(number.error for number in answered.plan.numbers if number.name == ANGLE)
    before = float(2 * settings.angle_limit / np.sqrt(12))
    if error is not None and error > before / 2:
        longer = (error / (before / 5)) ** 2
        yield (
            f"At a depth of {1e6 * settings.expected.depth:.3g} um these tests do not tell the angle: its standard error of "
            f"{np.degrees(error):.2g} deg stands against {np.degrees(before):.2g} deg if every angle up to "
            f"{np.degrees(settings.angle_limit):.3g} deg is alike. A fifth of that needs {longer:.2g} times the time, or deeper wear."
        )


def _alike_notes(expected: ExpectedWear, answered: Answered) -> Iterator[str]:
    """Parameters that the tests hardly tell apart."""
    errors = np.sqrt(np.diagonal(answered.covariance))
    correlation = answered.covariance / np.outer(errors, errors)
    names = tuple(expected.values)
    for first in range(len(names)):
        for second in range(first):
            if abs(correlation[first, second]) > ALIKE:
                pair = f"{names[second]} and {names[first]}"
                yield f"{pair} are hardly told apart (correlation {correlation[first, second]:+.3f}): one decides on the other."


def _term_notes(
    settings: WearPlanSettings, expected: ExpectedWear, testing: ResponseTest, points: Sequence[WearPoint], answered: Answered
) -> Iterator[str]:
    """What the same tests tell from some terms of the response only."""
    counts = {run.name: run.count for run in answered.plan.runs}
    for terms in PLACES:
        if terms == "full":
            continue
        total = _prior(settings)
        for point in points:
            if point.name in counts:
                at = expected.at(point.speed, settings.node, point.force)
                total = total + counts[point.name] * information(at, testing, point.band, terms)
        scale = _units(settings, expected)
        errors = np.sqrt(np.diagonal(np.linalg.pinv(total * np.outer(scale, scale))))
        yield f"From the {terms} terms alone: depth to {errors[0]:.2g} um, angle to {errors[1]:.2g} deg."


def _rotor_name(run: PlannedRun) -> str:
    return f"rotor-{run.name}.yaml"


def rotor_entries(rotor: dict[str, Any], settings: WearPlanSettings, point: WearPoint) -> dict[str, Any]:
    """The rotor file at another speed, and with another static force at the loaded node."""
    others = [load for load in rotor.get("loads", []) if load["node"] != settings.node]
    return {**rotor, "speed": f"{point.speed!r} Hz", "loads": [*others, {"node": settings.node, "z": f"{point.force!r} N"}]}


def virtual_entries(settings: WearPlanSettings, run: PlannedRun, point: WearPoint) -> dict[str, Any]:
    """A virtual rig that rehearses one test: labpipe simulate FILE -o recordings/NAME."""
    expected = settings.expected
    return {
        "kind": "virtual-journal-rig",
        "rotor": _rotor_name(run),
        **({"bearing": settings.bearing} if settings.bearing else {}),
        "states": {"worn": {"depth": f"{expected.depth!r} m", "angle": f"{expected.angle!r} rad"}},
        "force": f"{settings.force!r} N",
        "lowest": f"{point.band[0]!r} Hz",
        "bandwidth": f"{point.band[1]!r} Hz",
        "sample_rate": f"{settings.sample_rate!r} Hz",
        "duration": f"{run.count * settings.run!r} s",
        "noise": {"displacement": f"{settings.noise.displacement!r} m", "force": f"{settings.noise.force!r} N"},
    }


def rig_entries(settings: WearPlanSettings) -> dict[str, Any]:
    """The rig file that the pipeline names."""
    channels = {
        "f": {"column": "force [N]", "quantity": "force", "unit": "N", "role": "input", "dof": "y"},
        "y": {"column": "y [um]", "quantity": "displacement", "unit": "um", "role": "output", "dof": "y"},
        "z": {"column": "z [um]", "quantity": "displacement", "unit": "um", "role": "output", "dof": "z"},
    }
    return {"name": "Wear rig", "sample_rate": f"{settings.sample_rate!r} Hz", "channels": channels}


def pipeline_entries(planned: WearPlanned, settings: WearPlanSettings) -> dict[str, Any]:
    """The pipeline that evaluates the tests: each fit begins with what the one before has found, so that the last one knows all."""
    tests, fits, last = [], {}, ""
    for run in planned.plan.runs:
        folder, point = f"recordings/{run.name}", planned.points[run.name]
        recordings = [f"{folder}/worn-y.parquet", {"file": f"{folder}/worn-z.parquet", "channels": {"f": {"dof": "z"}}}]
        tests.append(
            {"name": run.name, "recordings": recordings, "conditions": {"speed": f"{point.speed!r} Hz", "load": f"{point.force!r} N"}}
        )
        wear: dict[str, Any] = {"rotor": _rotor_name(run), "bearing": planned.expected.bearing}
        if last:
            wear |= {"prior": last, "same_wear": True}
        else:
            wear |= {
                name: f"{given.value!r} {UNITS[name]} +- {given.std_error!r} {UNITS[name]}" for name, given in settings.nuisances.items()
            }
        wear["angle_limit"] = f"{settings.angle_limit!r} rad"
        last = f"wear-{run.name}"
        fits[last] = {"model": settings.model, "test": run.name, "band": f"{point.band[0]!r}-{point.band[1]!r} Hz", "wear": wear}
    ends = [end for run in planned.plan.runs for end in planned.points[run.name].band]
    frf = {
        "excitation": "random",
        "block": f"{settings.block!r} s",
        "band": f"{min(ends)!r}-{max(ends)!r} Hz",
        "exclude": [f"{max(low, 0.0)!r}-{high!r} Hz" for low, high in planned.testing.exclude],
    }
    return {"title": planned.plan.title, "rig": RIG, "tests": tests, "frf": frf, "identify": fits}
