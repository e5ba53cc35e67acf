"""plan of an excitation: settings -> signals of the shakers, plan.json, a report, and the rig and pipeline files that evaluate the test."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path

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
from labpipe.planner.settings import PlanSettings, TheorySettings
from labpipe.records.identification import Fit
from labpipe.records.parameter import Parameter
from labpipe.records.settings import settings_of
from labpipe.registry import nearest
from labpipe.report.plan import goal_sentence, plan_document, sentence
from labpipe.stages.plan_budget import rehearsal, rig_path
from labpipe.stages.plan_evaluation import PIPELINE, RIG, Evaluation, pipeline_entries, rig_entries

REPORT = "report.html"


def excitation_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan the excitation and write its files; sentences on it, and the files' names."""
    settings: PlanSettings = file.settings
    planned = make_plan(settings, _expected(file), file.title, rehearsal(file))
    plan = planned.plan
    names = list(_write_signals(planned, output))
    write_plan(output.write_path(NAME), plan)
    content: bytes = DOCUMENTS.load("html")(plan_document(plan, __version__))
    output.write_path(REPORT).write_bytes(content)
    with_masses = any(c.name[0] == "m" for c in plan.coefficients)
    evaluation = Evaluation(settings, file.title, plan.tests, with_masses, rig_path(file))
    files = {PIPELINE: pipeline_entries(evaluation, output.target.absolute())}
    files |= {RIG: rig_entries(evaluation)} if evaluation.rig_path is None else {}
    for name, entries in files.items():
        text = yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=120)
        output.write_path(name).write_text(text, encoding="utf-8")
    sentences = [line for line in (sentence(plan), goal_sentence(plan), *plan.notes) if line]
    return sentences, [*names, NAME, REPORT, *files]


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
    coefficients = {p.name: p.value for p in fits[name].parameters if _is_coefficient(p)}
    return Expected(theory | coefficients | typed, earlier_doubts(fits[name], typed))


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
        coefficients = place.bearing.at(OperatingPoint(rig.static_loads()[place.name], rig.omega, rig.omega))
    else:
        bearing = open_bearing(folder / theory.bearing)
        for name, value, unit in (("load", theory.load, "N"), ("speed", theory.speed, "Hz")):
            if value is not None and name not in settings_of(bearing.kind.settings):
                raise ConfigError(f"a file of a {bearing.kind_name} has no '{name}'", hint="state it in the bearing file", field="theory")
            if value is not None:
                set_entry(bearing.tree, f"{name}={value!r} {unit}")
        (whole,) = bearing.coefficients([bearing.settings()])
        coefficients = whole.lateral(*bearing.kind.lateral)
    if not np.any(coefficients.damping):
        raise ConfigError(
            "this theory has no damping", hint="a journal or a magnetic bearing has; or state all under `expected`", field="theory"
        )
    matrices = {"k": coefficients.stiffness, "c": coefficients.damping}
    return {f"{letter}_{AXES[i]}{AXES[j]}": float(matrix[i, j]) for letter, matrix in matrices.items() for i in (0, 1) for j in (0, 1)}


def _write_signals(planned: Planned, output: OutputFolder) -> list[str]:
    names = []
    for number in range(len(planned.tests)):
        for name, samples in planned.signals(number).items():
            write_signal(output.write_path(name), samples, planned.plan.sample_rate, "f [N]")
            names.append(name)
    return names
