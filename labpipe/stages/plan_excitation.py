"""plan of an excitation: settings -> signals of the shakers, plan.json, a report, and the rig and pipeline files that evaluate the test."""

from __future__ import annotations

from collections.abc import Container, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from labpipe import __version__
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.plan_file import NAME, write_plan
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.kinds import OperatingPoint
from labpipe.config.bearing import open_bearing
from labpipe.config.plan import PlanFile
from labpipe.document.render import DOCUMENTS
from labpipe.errors import ConfigError
from labpipe.formats.signal_file import write_signal
from labpipe.marked_yaml import set_entry
from labpipe.planner.expectation import Earlier, Expected
from labpipe.planner.model import AXES
from labpipe.planner.plan import Planned, make_plan
from labpipe.planner.settings import TheorySettings
from labpipe.records.identification import Fit
from labpipe.records.parameter import Parameter
from labpipe.records.plan import Plan
from labpipe.records.settings import settings_of
from labpipe.registry import nearest
from labpipe.report.plan import goal_sentence, plan_document, sentence

RIG, PIPELINE, REPORT = "rig.yaml", "pipeline.yaml", "report.html"
FIT = "planned"
# Displacements of a rotor are absolute; those of a floating stator are against its shaft.
ROTOR, FLOATING = "rotor-2dof", "dynamic-stiffness"


def excitation_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan the excitation and write its files; sentences on it, and the files' names."""
    planned = make_plan(file.settings, _expected(file), file.title)
    names = list(_write_signals(planned, output))
    write_plan(output.write_path(NAME), planned.plan)
    content: bytes = DOCUMENTS.load("html")(plan_document(planned.plan, __version__))
    output.write_path(REPORT).write_bytes(content)
    for name, entries in ((RIG, rig_entries(planned.plan)), (PIPELINE, pipeline_entries(planned.plan))):
        text = yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=120)
        output.write_path(name).write_text(text, encoding="utf-8")
    sentences = [line for line in (sentence(planned.plan), goal_sentence(planned.plan), *planned.plan.notes) if line]
    return sentences, [*names, NAME, REPORT, RIG, PIPELINE]


def _expected(file: PlanFile) -> Expected:
    """Values by name: those of `expected`, the others from the earlier result, with its doubts, then from theory."""
    settings = file.settings
    theory = {} if settings.theory is None else _theory(settings.theory, file.path.parent)
    typed = dict(settings.expected)
    if not settings.earlier:
        return Expected(theory | typed)
    path = file.path.parent / settings.earlier
    fits = {fit.name: fit for fit in read_identification(path).fits}
    name = settings.fit or next(iter(fits), "")
    if name not in fits or (not settings.fit and len(fits) > 1):
        raise ConfigError(f"name the fit of {path.name}", hint=nearest(settings.fit, tuple(fits)), field="fit")
    found = {p.name: p.value for p in fits[name].parameters if _is_coefficient(p)}
    return Expected(theory | found | typed, earlier_doubts(fits[name], typed))


def _is_coefficient(parameter: Parameter) -> bool:
    return not parameter.derived and parameter.name[0] in "kcm"


def earlier_doubts(fit: Fit, typed: Container[str] = ()) -> Earlier:
    """Covariance by noise and systematic changes of a fit's coefficients, without those that are *typed*; NaN where it states no errors."""
    estimated = [p for p in fit.parameters if not p.derived]
    kept = [number for number, p in enumerate(estimated) if _is_coefficient(p) and p.name not in typed]
    names = tuple(estimated[number].name for number in kept)
    by_noise = {} if fit.budget is None else dict(zip(fit.budget.names, fit.budget.random, strict=True))
    errors = np.array([by_noise.get(p.name, np.nan if p.full_error is None else p.full_error) for p in estimated], float)
    # A form with constraints reports more coefficients than it estimates.
    of_all = np.shape(fit.correlation) == (len(estimated),) * 2
    correlation = np.asarray(fit.correlation) if of_all else np.eye(len(estimated))
    noise = (correlation * np.outer(errors, errors))[np.ix_(kept, kept)]
    if fit.budget is None:
        return Earlier(names, noise)
    columns = [fit.budget.names.index(name) for name in names]
    return Earlier(names, noise, tuple(source.source for source in fit.budget.sources), fit.budget.changes[:, columns])


def _theory(theory: TheorySettings, folder: Path) -> dict[str, float]:
    """k_xx ... c_yy [N/m, N.s/m] of a bearing's theory, its y and z the plan's x and y."""
    if theory.rig is not None:
        rig = theory.rig if theory.speed is None else theory.rig.at_speed(theory.speed)
        place = rig.place(theory.name)
        found = place.bearing.at(OperatingPoint(rig.static_loads()[place.name], rig.omega, rig.omega))
    else:
        bearing = open_bearing(folder / theory.bearing)
        for name, value, unit in (("load", theory.load, "N"), ("speed", theory.speed, "Hz")):
            if value is not None and name not in settings_of(bearing.kind.settings):
                raise ConfigError(f"a file of a {bearing.kind_name} has no '{name}'", hint="state it in the bearing file", field="theory")
            if value is not None:
                set_entry(bearing.tree, f"{name}={value!r} {unit}")
        (whole,) = bearing.coefficients([bearing.settings()])
        found = whole.lateral(*bearing.kind.lateral)
    if not np.any(found.damping):
        raise ConfigError(
            "this theory has no damping", hint="a journal or a magnetic bearing has; or state all under `expected`", field="theory"
        )
    matrices = {"k": found.stiffness, "c": found.damping}
    return {f"{letter}_{AXES[i]}{AXES[j]}": float(matrix[i, j]) for letter, matrix in matrices.items() for i in (0, 1) for j in (0, 1)}


def _write_signals(planned: Planned, output: OutputFolder) -> list[str]:
    names = []
    for number in range(len(planned.tests)):
        for name, samples in planned.signals(number).items():
            write_signal(output.write_path(name), samples, planned.plan.sample_rate, "f [N]")
            names.append(name)
    return names


def _at_once(plan: Plan) -> bool:
    return any(len(test.shakers) > 1 for test in plan.tests)


def _side_by_side(plan: Plan) -> bool:
    """Whether the test is evaluated from spectra of all channels: a stator, or shakers that run at once."""
    return plan.model == FLOATING or _at_once(plan)


def rig_entries(plan: Plan) -> dict[str, Any]:
    """The rig file that the pipeline names: a channel for every signal, its column of the same name with its unit."""
    shakers = list(dict.fromkeys(shaker for test in plan.tests for shaker in test.shakers))
    if _side_by_side(plan):
        forces = {f"f_{number}": _channel(f"f_{number}", "force", "N", shaker) for number, shaker in enumerate(shakers, 1)}
    else:
        forces = {"f": _channel("f", "force", "N", shakers[0])}
    axes = ("x",) if plan.model == "sdof" else ("x", "y")
    motions = {axis: _channel(axis, "displacement", "m", axis) for axis in axes}
    moved = {f"a_{axis}": _channel(f"a_{axis}", "acceleration", "m/s^2", axis) for axis in axes} if plan.model == FLOATING else {}
    return {"name": plan.title, "sample_rate": f"{plan.sample_rate!r} Hz", "channels": {**forces, **motions, **moved}}


def _channel(name: str, quantity: str, unit: str, dof: str) -> dict[str, str]:
    role = "input" if quantity == "force" else "output"
    return {"column": f"{name} [{unit}]", "quantity": quantity, "unit": unit, "role": role, "dof": dof}


def pipeline_entries(plan: Plan) -> dict[str, Any]:
    """The pipeline that evaluates the test, the planned lines passed to it; recordings are looked for in recordings/."""
    recordings: list[Any] = [f"recordings/{test.name}.csv" for test in plan.tests]
    if len(recordings) > 1 and not _side_by_side(plan):
        recordings = [
            {"file": name, "channels": {"f": {"dof": test.shakers[0]}}} for name, test in zip(recordings, plan.tests, strict=True)
        ]
    lines = sorted({frequency for test in plan.tests for frequency in test.frequency})
    spacing = 1 / plan.period
    frf: dict[str, Any] = {
        "excitation": "periodic",
        "period": f"{plan.period!r} s",
        "skip": min(test.skip for test in plan.tests),
        "band": f"{lines[0] - spacing / 4!r}-{lines[-1] + spacing / 4!r} Hz",
    }
    gaps = list(_gaps(lines, spacing))
    if gaps:
        frf["exclude"] = gaps
    if _side_by_side(plan):
        frf["result"] = "spectra"
    return {"title": plan.title, "rig": RIG, "recordings": recordings, "frf": frf, "identify": {FIT: _fit(plan)}}


def _gaps(lines: Sequence[float], spacing: float) -> list[str]:
    """Bands between excited lines without any."""
    return [f"{low + spacing / 4!r}-{high - spacing / 4!r} Hz" for low, high in pairwise(lines) if high - low > 1.5 * spacing]


def _fit(plan: Plan) -> dict[str, Any]:
    mass = {} if plan.mass is None else {"mass": f"{plan.mass!r} kg"}
    if not _side_by_side(plan):
        return {"model": plan.model, **mass}
    letters = {coefficient.name[0] for coefficient in plan.coefficients}
    own = {"form": "kcm" if "m" in letters else "kc"}
    if plan.model == ROTOR:
        own["motion"] = "absolute"
    return {"model": FLOATING, **mass, "dynamic_stiffness": own}
