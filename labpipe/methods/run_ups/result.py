"""All methods on the run-ups of a rotor, compared on every run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from labpipe.errors import locate_errors
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.run_ups import records
from labpipe.methods.run_ups.joint import REJECTED as LEAST_PROBABILITY, JointFit
from labpipe.methods.run_ups.measured import ReadRun, column, measured_run
from labpipe.methods.run_ups.metamodel_kinds import Extent, Grid, PhysicalFit, physical_without
from labpipe.methods.run_ups.metamodels import METAMODELS, Metamodel, caution, leave_one_load_out
from labpipe.methods.run_ups.methods import (
    BEYOND,
    AtLoad,
    Predictor,
    Solved,
    predict,
    start,
    with_unbalance_of,
    with_unbalance_of_runs,
)
from labpipe.methods.run_ups.misfit import ADVICE, measured_statement, rank_statements
from labpipe.methods.run_ups.rotor import RPM, RunUpRotor, extend_over_speed, with_search_range
from labpipe.methods.run_ups.settings import METHODS, RunUpSettings
from labpipe.records.finding import Finding, Parameter, note
from labpipe.records.identification import ListedParameter

# Name in a pipeline -> kind of labpipe.methods.run_ups.metamodels, title.
KINDS = {
    "response-surface": ("surface", "second-order response surface"),
    "network": ("network", "feed-forward network"),
    "gaussian-process": ("process", "Gaussian process"),
    "physical": ("physical", "physical fit (c)"),
}
# Grid of the drawn surfaces.
SURFACE_LOADS, SURFACE_SPEEDS = 11, 15


def metamodels(
    settings: RunUpSettings,
    rig: RunUpRotor,
    trained: Sequence[records.RunUp],
    runs: Sequence[records.RunUp],
    solved: Sequence[Solved],
) -> tuple[records.MetamodelResult, ...]:
    """Metamodels in the section's order; LabpipeError names one that cannot be fitted."""
    if not settings.metamodels:
        return ()
    by_name = {method.method.name: method for method in solved}
    grid = _grid(by_name[settings.metamodels_of], trained)
    joint = by_name["joint"].anywhere if "joint" in by_name else None
    by_film = "physical" in settings.metamodels
    refitted = physical_without(rig, trained, settings.known) if by_film else None
    kinds = [KINDS[name][0] for name in settings.metamodels if name != "physical"]
    left_out = leave_one_load_out(grid, kinds, refitted, settings.seed)
    results = []
    for name in settings.metamodels:
        kind, title = KINDS[name]
        model = _fit(name, grid, joint, settings.seed)
        source = by_name["joint" if name == "physical" else settings.metamodels_of].method
        rejected = source.verdict == records.REJECTED
        uncertainty = (f"of a fit that chi-square rejects, {source.title}",) if rejected else ()
        predictions = tuple(_prediction(model, rig, run, settings.plane, uncertainty) for run in runs)
        loads = [run.load for run in runs]
        load = np.linspace(min(loads), max(loads), SURFACE_LOADS)
        speed = np.linspace(*model.extent.speeds, SURFACE_SPEEDS)
        values = np.stack([model.predict(one_load, speed) for one_load in load])
        sheets = tuple(tuple(column(row) for row in values[:, :, n]) for n in range(8))
        surface, remarks = records.Surface(column(load), column(speed), sheets), (f"{model.statement}.",)
        parts = surface, tuple(left_out[kind]), predictions, remarks, model.to_entries()
        results.append(records.MetamodelResult(name, title, *parts))
    return tuple(results)


def _grid(method: Solved, trained: Sequence[records.RunUp]) -> Grid:
    if method.anywhere is None:
        return Grid.of(method.fits)
    speed = max((run.speed for run in trained), key=len)
    return Grid.sample(method.anywhere, dict.fromkeys(run.load for run in trained), speed)


def _fit(name: str, grid: Grid, joint: object, seed: int) -> Metamodel:
    with locate_errors(f"run_ups, metamodel {name}"):
        if name == "physical":
            assert isinstance(joint, JointFit)
            return PhysicalFit.of(joint, Extent.of(grid).speeds)
        return METAMODELS[KINDS[name][0]](grid, seed)


def _prediction(
    model: Metamodel, rig: RunUpRotor, run: records.RunUp, plane: str, uncertainty: tuple[str, ...]
) -> records.RunPrediction:
    run_rig = with_unbalance_of(rig, run)
    remark = caution(model, run.load)
    beyond = "" if isinstance(model, PhysicalFit) else BEYOND
    notes = (*uncertainty, *(text for text in (remark, beyond) if text))
    eight = model.predict(run.load, run.speed)
    error = None if uncertainty else model.std_error(run.load, run.speed)
    course = extend_over_speed(partial(model.predict, run.load), *model.speeds)
    return predict(run_rig, run, AtLoad(course, eight, error, notes=notes), plane, curves=False)


Tell = Callable[[str], None]


def run_up_result(
    settings: RunUpSettings, rig: RunUpRotor, read: Sequence[ReadRun], tell: Tell = lambda _: None
) -> records.RunUpResult:
    """All methods of the settings, fitted to the trained runs and compared on every run."""
    measured = [measured_run(item, settings.plane) for item in read]
    runs = [item.run for item in read]
    rig = with_unbalance_of_runs(with_search_range(rig, runs), runs)
    trained = [item.run for item in read if item.settings.role == records.TRAINED]
    solved = [start()]
    for name in (name for name in METHODS if name in settings.methods):
        tell(f"run-ups   {name}")
        solved.append(_solve(name, rig, trained, settings))
    methods = []
    for item in solved:
        predictions = tuple(prediction(item.predictor, rig, run, settings.plane) for run in runs)
        methods.append(replace(item.method, predictions=predictions))
    fitted_to = settings.metamodels_of if settings.metamodels else ""
    if fitted_to:
        tell("run-ups   metamodels")
    loads = sorted({run.load for run in trained})
    load = loads[len(loads) // 2]
    load_runs = [run for run in trained if run.load == load]
    speed = float(load_runs[0].speed[load_runs[0].n_speed // 2])
    result = records.RunUpResult(
        rig.name,
        settings.plane or rig.plane_names[-1],
        _bearing_text(rig),
        runs=tuple(record for record, _ in measured),
        methods=tuple(methods),
        metamodels=metamodels(settings, rig, trained, runs, solved),
        metamodels_of=next((item.title for item in methods if item.name == fitted_to), ""),
        ranks=rank_statements(rig, load, speed),
        rank_load=load,
        rank_speed=speed,
        measured_rank=measured_statement(rig, load_runs, load, speed),
        source=settings.source,
    )
    return _with_findings(result, [reason for _, reason in measured if reason], read)


def _solve(name: str, rig: RunUpRotor, trained: Sequence[records.RunUp], settings: RunUpSettings) -> Solved:
    with locate_errors(f"run_ups, method {name}"):
        return METHODS[name](rig, trained, settings)


def prediction(
    predictor: Predictor, rig: RunUpRotor, run: records.RunUp, plane: str
) -> records.RunPrediction:
    run_rig = with_unbalance_of(rig, run)
    return predict(run_rig, run, predictor(run_rig, run), plane)


def _bearing_text(rig: RunUpRotor) -> str:
    bearing = rig.place.bearing
    if not isinstance(bearing, JournalBearing):
        return f"{rig.place.kind} '{rig.place.name}'"
    size = f"L {1e3 * bearing.length:.4g} mm, D {1e3 * bearing.diameter:.4g} mm"
    film = f"clearance {1e6 * bearing.clearance:.4g} um, viscosity {bearing.viscosity:.4g} Pa s"
    return f"journal bearing '{rig.place.name}': {size}, {film}"


def _with_findings(
    result: records.RunUpResult, reasons: Sequence[str], read: Sequence[ReadRun]
) -> records.RunUpResult:
    findings = [
        *(finding for method in result.methods for finding in fit_findings(method, result.runs)),
        *(note("no-critical-speed", reason) for reason in reasons),
        *(
            note("residual", f"{item.run.name}: '{item.settings.subtract}' is subtracted")
            for item in read
            if item.settings.subtract
        ),
        *(
            finding
            for item in read
            for run in (item.run.baseline, item.run)
            if run
            for finding in run.findings
        ),
        *_advice(result),
    ]
    return replace(result, findings=tuple(findings))


def fit_findings(method: records.RunUpMethod, runs: Sequence[records.MeasuredRun]) -> list[Finding]:
    """What is to be known of a fit to run-ups: what the data leave open, a misfit, bounds."""
    findings = []
    if method.verdict == "not determined":
        told = f"the data determine {method.rank} of {method.unknowns} coefficients at a point"
        values = "the values are not determined, however well the response is met"
        findings.append(Finding("collinear", f"{method.title}: {told}; {values}."))
    excess = f"{method.title}: chi² per datum is {method.chi2_per_datum or 0.0:.2f}"
    if method.verdict == "rejected":
        family = "the bearing is not of the fitted family, and no interval is given"
        findings.append(Finding("model-mismatch", f"{excess}: {family}."))
    if "determined" in method.verdict and method.chi2_p is not None and method.chi2_p < LEAST_PROBABILITY:
        bounds = f"{100 * (method.share_at_bound or 0.0):.0f} % of the coefficients lie on their bounds"
        message = f"the residual exceeds the noise; {bounds}, and stated errors may be too small."
        findings.append(Finding("model-mismatch", f"{excess}: {message}"))
    bound = [parameter.name for parameter in method.parameters if parameter.at_bound]
    if bound:
        message = f"{', '.join(bound)} at the bound: the rotor file describes another bearing."
        findings.append(Finding("at-bound", f"{method.title}: {message}"))
    jointly = method.verdict in ("rejected", "not rejected")
    for run in runs if jointly else ():
        notes = [
            note for note in getattr(method.prediction(run.name), "notes", ()) if records.OUTSIDE in note
        ]
        if run.role == records.HELD_OUT and notes:
            findings.append(Finding("extrapolated", f"{method.title}, {run.name}: {'; '.join(notes)}."))
    return findings


def _advice(result: records.RunUpResult) -> list[Finding]:
    if result.measured_rank is None or result.measured_rank.rank == 8:
        return []
    place = f"under {result.rank_load:.3g} N at {result.rank_speed / RPM:.0f} rpm"
    fewest = f"the runs {place} determine {result.measured_rank.rank} of 8 coefficients"
    return [note("experiment", f"{fewest}; {result.measured_rank.advice or ADVICE}")]


MEASURED = "run_ups.measured"


def listed_speeds_and_parameters(result: records.RunUpResult) -> Iterator[ListedParameter]:
    """The parameters of every method, and critical and threshold speeds [rad/s], measured and predicted."""
    for run in result.runs:
        yield from _speeds(MEASURED, run.name, run, ())
    for predictor in result.predictors:
        fit = f"run_ups.{predictor.name}"
        codes = ("model-mismatch",) if getattr(predictor, "verdict", "") == "rejected" else ()
        for parameter in getattr(predictor, "parameters", ()):
            yield ListedParameter(fit=fit, parameter=parameter, model="run_ups", warnings=codes)
        for prediction in predictor.predictions:
            yield from _speeds(fit, prediction.run, prediction, codes)


def _speeds(
    fit: str, run: str, owner: records.MeasuredRun | records.RunPrediction, codes: tuple[str, ...]
) -> Iterator[ListedParameter]:
    for name in ("critical_speed", "threshold"):
        speed: records.UncertainAmount | None = getattr(owner, name)
        if speed is not None:
            parameter = Parameter(
                name, speed.value, "rad/s", std_error=speed.std_error, ci95=speed.ci95, derived=True
            )
            yield ListedParameter(fit=fit, parameter=parameter, test=run, model="run_ups", warnings=codes)
