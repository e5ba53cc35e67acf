"""plan of an excitation: signals of the shakers, plan.json, a report, the rig and pipeline to evaluate it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from labpipe import __version__
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.kinds import OperatingPoint
from labpipe.document.render import DOCUMENTS
from labpipe.errors import SettingError
from labpipe.estimation.fitting import identify
from labpipe.methods.planning.campaigns import Multisines, PlannedRig as LimitedRig
from labpipe.methods.planning.model import AXES, FLOATING, UNITS, axes_of_model
from labpipe.methods.planning.plan import Planned, make_plan, planned_test
from labpipe.methods.planning.plan_file import NAME, REPORT, PlanFile, write_plan, write_settings
from labpipe.methods.planning.records import PlannedTest
from labpipe.methods.planning.report import goal_sentence, plan_document, sentence
from labpipe.methods.planning.settings import ExpectedTheorySettings, PlanKind, PlanSettings
from labpipe.methods.planning.uncertainty import Earlier, Expected, Rehearse, rehearse
from labpipe.project.bearing_file import open_bearing
from labpipe.project.exports import write_signal
from labpipe.project.marked_yaml import load_marked, set_entry
from labpipe.project.pipeline_file import Pipeline, load_pipeline
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel
from labpipe.records.rig import Rig
from labpipe.records.settings import settings_of
from labpipe.records.uncertain import SHAPES, Budget, Uncertain, split_uncertainty
from labpipe.registry import nearest
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.measurement import measure

RIG, PIPELINE = "rig.yaml", "pipeline.yaml"
FIT = "planned"
SI_UNITS = {"force": "N", "displacement": "m", "acceleration": "m/s^2"}


@dataclass(frozen=True)
class Evaluation:
    """The plan's settings, title, tests and rig file, and whether masses are among the coefficients."""

    settings: PlanSettings
    title: str
    tests: tuple[PlannedTest, ...]
    with_masses: bool
    rig_path: Path | None = None

    @property
    def shakers(self) -> list[str]:
        return list(dict.fromkeys(shaker for test in self.tests for shaker in test.shakers))

    @property
    def side_by_side(self) -> bool:
        """Whether spectra of all channels evaluate the test: a stator, or shakers that run at once."""
        return self.settings.floating or any(len(test.shakers) > 1 for test in self.tests)


def check_rig(rig: Rig, settings: PlanSettings, shakers: Sequence[str]) -> None:
    """ConfigError unless the rig has a force for every shaker, or one that is moved, and every response."""
    if rig.derived:
        raise SettingError("rig", "sums of channels are not planned with", "a rig file with what is recorded")
    axes = settings.axes
    needed = ("displacement", "acceleration") if settings.floating else ("displacement",)
    outputs = [channel.channel for channel in rig.channels if channel.channel.role == "output"]
    for quantity in needed:
        dofs = [channel.dof for channel in outputs if channel.quantity == quantity]
        for axis in axes:
            if not dofs or (len(axes) > 1 and axis not in dofs):
                what = f"the rig has no {quantity} in {axis}"
                raise SettingError("rig", what, "a channel with `dof`")
    for channel in outputs:
        if channel.quantity not in needed:
            what = f"{channel.name} is not a response that this model takes"
            raise SettingError("rig", what, "role: reference, or a rig file without it")
    forces = forces_of(rig)
    if not forces or (len(forces) > 1 and {force.dof for force in forces} != set(shakers)):
        named = ", ".join(force.dof for force in forces)
        what = f"the rig's forces ({named}) are not those of the shakers ({', '.join(shakers)})"
        raise SettingError("rig", what, "one force that is moved, or one for every shaker")


def forces_of(rig: Rig) -> list[Channel]:
    return [channel.channel for channel in rig.channels if channel.channel.role == "input"]


def rig_entries(evaluation: Evaluation) -> dict[str, Any]:
    """The rig file where the plan names none: a channel for every signal, in a column of its name."""
    shakers, settings = evaluation.shakers, evaluation.settings
    forces = [("f", "force", shakers[0])]
    if evaluation.side_by_side:
        forces = [(f"f_{number}", "force", shaker) for number, shaker in enumerate(shakers, 1)]
    # One direction is that of its shaker.
    dofs = settings.axes if len(settings.axes) > 1 else shakers
    motions = [(axis, "displacement", dof) for axis, dof in zip(settings.axes, dofs, strict=True)]
    moved = [(f"a_{axis}", "acceleration", axis) for axis in settings.axes if settings.floating]
    return {
        "name": evaluation.title,
        "sample_rate": f"{settings.sample_rate!r} Hz",
        "channels": {entry[0]: _channel(*entry) for entry in (*forces, *motions, *moved)},
    }


def _channel(name: str, quantity: str, dof: str) -> dict[str, str]:
    role, unit = "input" if quantity == "force" else "output", SI_UNITS[quantity]
    return {"column": f"{name} [{unit}]", "quantity": quantity, "unit": unit, "role": role, "dof": dof}


def pipeline_entries(evaluation: Evaluation, folder: Path) -> dict[str, Any]:
    """The pipeline in *folder* that evaluates the test, the planned lines passed to it."""
    settings, tests = evaluation.settings, evaluation.tests
    recordings: list[Any] = [f"recordings/{test.name}.csv" for test in tests]
    moved = _moved_force(evaluation)
    if moved:
        recordings = [
            {"file": name, "channels": {moved[0]: {"dof": f"{test.shakers[0]}{moved[1]}"}}}
            for name, test in zip(recordings, tests, strict=True)
        ]
    lines = sorted({frequency for test in tests for frequency in test.frequency})
    spacing = 1 / settings.period
    frf: dict[str, Any] = {
        "excitation": "periodic",
        "period": f"{settings.period!r} s",
        "skip": min(test.skip for test in tests),
        "band": f"{lines[0] - spacing / 4!r}-{lines[-1] + spacing / 4!r} Hz",
    }
    gaps = [(low, high) for low, high in pairwise(lines) if high - low > 1.5 * spacing]
    if gaps:
        frf["exclude"] = [f"{low + spacing / 4!r}-{high - spacing / 4!r} Hz" for low, high in gaps]
    if evaluation.side_by_side:
        frf["result"] = "spectra"
    rig = RIG if evaluation.rig_path is None else os.path.relpath(evaluation.rig_path, folder)
    return {
        "title": evaluation.title,
        "rig": rig,
        "recordings": recordings,
        "frf": frf,
        "identify": {FIT: _fit(evaluation)},
    }


def _moved_force(evaluation: Evaluation) -> tuple[str, str] | None:
    settings = evaluation.settings
    if evaluation.side_by_side:
        return None
    if evaluation.rig_path is None:
        return ("f", "") if len(evaluation.tests) > 1 else None
    if len(settings.axes) == 1:
        return None
    assert settings.sensors is not None
    forces = forces_of(settings.sensors)
    if len(forces) > 1:
        return None
    written = load_marked(evaluation.rig_path).content["channels"].content[forces[0].name].content.get("dof")
    uncertainty = "" if written is None else split_uncertainty(written.text)[1]
    return forces[0].name, f" +- {uncertainty}" if uncertainty else ""


def _fit(evaluation: Evaluation) -> dict[str, Any]:
    settings = evaluation.settings
    stated_mass = None if settings.mass is None else Uncertain(settings.mass)
    number = dict(settings.uncertainties).get("mass") or stated_mass
    if not evaluation.side_by_side:
        return {"model": settings.model, "mass": "estimate" if number is None else uncertain_text(number)}
    entries = {"form": "kcm" if evaluation.with_masses else "kc"}
    # Displacements of a rotor are absolute; those of a floating stator are against its shaft.
    if not settings.floating:
        entries["motion"] = "absolute"
    if number is not None:
        entries["stator_mass"] = uncertain_text(number)
    return {"model": FLOATING, "dynamic_stiffness": entries}


def uncertain_text(number: Uncertain, unit: str = "kg") -> str:
    """A number as people write it, with its uncertainty: 0.79 kg +- 0.005 kg (rectangular, source=scale)."""
    if not number.std_error:
        return f"{number.value!r} {unit}"
    qualities = [number.shape] if number.shape != "normal" else []
    qualities += [f"dof={number.dof:g}"] if number.dof else []
    qualities += [f"source={number.source}"] if number.source else []
    behind = f" ({', '.join(qualities)})" if qualities else ""
    return f"{number.value!r} {unit} +- {number.std_error * SHAPES[number.shape]!r} {unit}{behind}"


def rig_path(file: PlanFile) -> Path | None:
    settings: PlanSettings = file.settings
    return (file.path.parent / settings.rig).absolute() if settings.rig else None


def rehearsal(file: PlanFile) -> Rehearse | None:
    """What gives the budget of tests; None where only noise is uncertain. ConfigError without channels."""
    settings: PlanSettings = file.settings
    sensors = settings.sensors
    if sensors is not None:
        check_rig(sensors, settings, settings.shakers or settings.axes)
    of_sensors = sensors is not None and any(entry.channel.uncertainties for entry in sensors.channels)
    if not of_sensors and not settings.uncertainties:
        return None

    def budget(rig: LimitedRig, tests: Sequence[Multisines], periods: Sequence[int]) -> Budget | None:
        pairs = zip(tests, periods, strict=True)
        planned = tuple(planned_test(rig, test, number, 1) for test, number in pairs)
        with_masses = UNITS["m"] in rig.model.units
        evaluation = Evaluation(settings, file.title, planned, with_masses, rig_path(file))
        with tempfile.TemporaryDirectory() as folder:
            pipeline = _load(evaluation, Path(folder))
        return _coefficient_budget(_rehearsed_fit(pipeline, rig, tests, periods), rig.model.names)

    return budget


def _load(evaluation: Evaluation, folder: Path) -> Pipeline:
    if evaluation.rig_path is None:
        (folder / RIG).write_text(yaml.safe_dump(rig_entries(evaluation)), encoding="utf-8")
    (folder / PIPELINE).write_text(yaml.safe_dump(pipeline_entries(evaluation, folder)), encoding="utf-8")
    (folder / "recordings").mkdir()
    for test in evaluation.tests:
        (folder / "recordings" / f"{test.name}.csv").touch()
    return load_pipeline(folder / PIPELINE)


def _rehearsed_fit(
    pipeline: Pipeline, rig: LimitedRig, tests: Sequence[Multisines], periods: Sequence[int]
) -> Fit:
    (whole,), settings = pipeline.tests, pipeline.frf
    assert settings is not None
    highest = max(int(test.lines[-1]) for test in tests)
    recordings = []
    for source, test, number in zip(whole.recordings, tests, periods, strict=True):
        channels = [part.channel for part in source.rig.channels if part.channel.role != "reference"]
        seconds = number / rig.spacing
        recordings.append(rehearse(rig, test, channels, seconds, settings.skip, highest))
    make = channel_spectra if settings.result == "spectra" else measure
    (fit,) = identify(make(recordings, settings), pipeline.fits[0], judging=False)
    return fit


def _coefficient_budget(fit: Fit, names: Sequence[str]) -> Budget | None:
    whole = fit.budget
    if whole is None:
        return None
    columns = [whole.names.index(name) for name in names]
    random, changes = whole.random[columns], whole.changes[:, columns]
    return Budget(tuple(names), random, whole.random_dof, whole.sources, changes)


def excitation_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan the excitation and write its files; sentences on it, and the files' names."""
    settings: PlanSettings = file.settings
    expected = _read_expected(file)
    axes = axes_of_model(settings.model, expected.values, len(settings.shakers))
    settings = replace(settings, axes=axes)
    planned = make_plan(settings, expected, file.title, rehearsal(replace(file, settings=settings)))
    plan = planned.plan
    names = _write_signals(planned, output)
    write_plan(output.write_path(NAME), plan)
    content: bytes = DOCUMENTS.load("html")(plan_document(plan, __version__))
    output.write_path(REPORT).write_bytes(content)
    with_masses = UNITS["m"] in [c.unit for c in plan.coefficients]
    evaluation = Evaluation(settings, file.title, plan.tests, with_masses, rig_path(file))
    files = {PIPELINE: pipeline_entries(evaluation, output.target.absolute())}
    files |= {RIG: rig_entries(evaluation)} if evaluation.rig_path is None else {}
    write_settings(files, output)
    sentences = [line for line in (sentence(plan), goal_sentence(plan), *plan.notes) if line]
    return sentences, [*names, NAME, REPORT, *files]


def _read_expected(file: PlanFile) -> Expected:
    settings = file.settings
    theory = {} if settings.theory is None else _theory(settings.theory, file.path.parent)
    typed = dict(settings.expected)
    if not settings.earlier:
        return Expected(theory | typed)
    path = file.path.parent / settings.earlier
    whole = read_identification(path).fits
    fits = [fit for fit in whole if settings.fit in ("", fit.name)]
    names = list(dict.fromkeys(fit.name for fit in whole))
    if not fits or (len(names) > 1 and not settings.fit):
        raise SettingError("fit", f"name the fit of {path.name}", nearest(settings.fit, names))
    if len(fits) > 1:
        what = f"{path.name} holds {len(fits)} fits named '{fits[0].name}', of tests or bands"
        raise SettingError("fit", what, "the result of one test in one band")
    if totals := [p.name for p in fits[0].parameters if p.name.endswith("_total")]:
        what = f"the fit '{fits[0].name}' is of one bearing, without the support, and no plan is"
        raise SettingError("earlier", what, f"`expected` with the values of {', '.join(totals)}")
    coefficients = {p.name: p.value for p in fits[0].parameters if _is_coefficient(p)}
    return Expected(theory | coefficients | typed, earlier_uncertainties(fits[0], typed))


def _is_coefficient(parameter: Parameter) -> bool:
    return not parameter.derived and parameter.unit in UNITS.values()


def earlier_uncertainties(fit: Fit, typed: Container[str] = ()) -> Earlier:
    """Covariance by noise, NaN without errors, and changes of a fit's coefficients but *typed* ones."""
    estimated = fit.estimated
    kept = [number for number, p in enumerate(estimated) if _is_coefficient(p) and p.name not in typed]
    names = tuple(estimated[number].name for number in kept)
    by_noise = {} if fit.budget is None else dict(zip(fit.budget.names, fit.budget.random, strict=True))
    errors = np.array([by_noise.get(p.name, p.full_error) for p in estimated], float)
    # A form with constraints reports more coefficients than it estimates.
    of_all = np.shape(fit.correlation) == (len(estimated),) * 2
    correlation = np.asarray(fit.correlation) if of_all else np.eye(len(estimated))
    noise = (correlation * np.outer(errors, errors))[np.ix_(kept, kept)]
    if fit.budget is None:
        return Earlier(names, noise)
    columns = [fit.budget.names.index(name) for name in names]
    sources = tuple(source.source for source in fit.budget.sources)
    return Earlier(names, noise, sources, fit.budget.changes[:, columns])


def _theory(theory: ExpectedTheorySettings, folder: Path) -> dict[str, float]:
    """k_xx ... c_yy [N/m, N.s/m] of a bearing's theory, its y and z the plan's x and y."""
    if theory.rig is not None:
        rig = theory.rig if theory.speed is None else theory.rig.at_speed(theory.speed)
        place = rig.place(theory.name)
        coefficients = place.bearing.at(OperatingPoint(rig.static_loads()[place.name], rig.omega, rig.omega))
    else:
        bearing = open_bearing(folder / theory.bearing)
        for name, value, unit in (("load", theory.load, "N"), ("speed", theory.speed, "Hz")):
            if value is None:
                continue
            if name not in settings_of(bearing.kind.settings):
                what = f"a file of a {bearing.kind_name} has no '{name}'"
                raise SettingError("theory", what, "state it in the bearing file")
            set_entry(bearing.tree, f"{name}={value!r} {unit}")
        (whole,) = bearing.coefficients([bearing.settings()])
        coefficients = whole.lateral(*bearing.kind.lateral)
    if not np.any(coefficients.damping):
        hint = "a journal or a magnetic bearing has; or state all under `expected`"
        raise SettingError("theory", "this theory has no damping", hint)
    return {
        f"{letter}_{AXES[i]}{AXES[j]}": float(value)
        for letter, matrix in (("k", coefficients.stiffness), ("c", coefficients.damping))
        for (i, j), value in np.ndenumerate(matrix)
    }


def _write_signals(planned: Planned, output: OutputFolder) -> list[str]:
    names = []
    for number in range(len(planned.tests)):
        for name, samples in planned.signals(number).items():
            write_signal(output.write_path(name), samples, planned.plan.sample_rate, "f [N]")
            names.append(name)
    return names


EXCITATION = PlanKind(PlanSettings, excitation_files)
