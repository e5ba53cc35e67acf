"""All methods on the run-ups of a rotor, compared on every run: coefficients, critical and threshold speeds, uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from labpipe.bearings.journal import JournalBearing
from labpipe.errors import LabpipeError
from labpipe.records.finding import Finding, note
from labpipe.records.run_up import RunUp
from labpipe.records.run_up_result import HELD_OUT, START, TRAINED, MeasuredRun, RunPrediction, RunUpMethod, RunUpResult
from labpipe.rigs.run_up_rotor import RunUpRotor, searched_over
from labpipe.run_ups.joint_result import REJECTED
from labpipe.run_ups.measured import ReadRun, measured_run
from labpipe.run_ups.metamodel_results import metamodels
from labpipe.run_ups.methods import Predictor, Solved, solve_start
from labpipe.run_ups.predictions import RPM, excited_as, predict, with_unbalance_of
from labpipe.run_ups.rank import measured_statement, rank_statements
from labpipe.run_ups.settings import METHODS, RunUpSettings

Tell = Callable[[str], None]


def run_up_result(settings: RunUpSettings, rig: RunUpRotor, read: Sequence[ReadRun], tell: Tell = lambda _: None) -> RunUpResult:
    """All methods of the settings, fitted to the trained runs and compared on every run."""
    measured = [measured_run(item, settings.plane) for item in read]
    runs = [item.run for item in read]
    rig = excited_as(searched_over(rig, runs), runs)
    trained = [item.run for item in read if item.settings.role == TRAINED]
    solved = []
    for name in [START, *(name for name in METHODS if name in settings.methods)]:
        tell(f"run-ups   {name}")
        solved.append(_solved(name, rig, trained, settings))
    methods = [_with_predictions(item, rig, runs, settings.plane) for item in solved]
    if settings.metamodels:
        tell("run-ups   metamodels")
    ranks = _ranks(rig, trained)
    result = RunUpResult(
        rig.name,
        settings.plane or rig.plane_names[-1],
        _bearing_text(rig),
        runs=tuple(record for record, _ in measured),
        methods=tuple(methods),
        metamodels=metamodels(settings, rig, trained, runs, solved),
        metamodels_of=next((item.title for item in methods if settings.metamodels and item.name == settings.metamodels_of), ""),
        **ranks,
        source=settings.source,
    )
    return _with_findings(result, [reason for _, reason in measured if reason], read)


def _solved(name: str, rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:
    try:
        solve = solve_start if name == START else METHODS[name]
        solved: Solved = solve(rig, trained, settings)
        return solved
    except LabpipeError as error:
        error.where = error.where or f"run_ups, method {name}"
        raise


def _with_predictions(method: Solved, rig: RunUpRotor, runs: Sequence[RunUp], plane: str) -> RunUpMethod:
    return replace(method.method, predictions=tuple(prediction(method.predictor, rig, run, plane) for run in runs))


def prediction(predictor: Predictor, rig: RunUpRotor, run: RunUp, plane: str, curves: bool = True) -> RunPrediction:
    """Prediction of a method for a run."""
    run_rig = with_unbalance_of(rig, run)
    return predict(run_rig, run, predictor(run_rig, run), plane, curves)


def _bearing_text(rig: RunUpRotor) -> str:
    bearing = rig.place.bearing
    if not isinstance(bearing, JournalBearing):
        return f"{rig.place.kind} '{rig.place.name}'"
    size = f"L {1e3 * bearing.length:.4g} mm, D {1e3 * bearing.diameter:.4g} mm, clearance {1e6 * bearing.clearance:.4g} um"
    return f"journal bearing '{rig.place.name}': {size}, viscosity {bearing.viscosity:.4g} Pa s"


def _ranks(rig: RunUpRotor, trained: Sequence[RunUp]) -> dict[str, Any]:
    """Rank statements at the middle load and speed, and the rank of the measured runs there."""
    loads = sorted({run.load for run in trained})
    load = loads[len(loads) // 2]
    load_runs = [run for run in trained if run.load == load]
    first = load_runs[0]
    speed = float(first.speed[first.n_speed // 2])
    return {
        "ranks": rank_statements(rig, load, speed),
        "rank_load": load,
        "rank_speed": speed,
        "measured_rank": measured_statement(rig, load_runs, load, speed),
    }


def _with_findings(result: RunUpResult, reasons: Sequence[str], read: Sequence[ReadRun]) -> RunUpResult:
    findings = [
        *(finding for method in result.methods for finding in _doubts(method, result.runs)),
        *(note("no-critical-speed", reason) for reason in reasons),
        *(note("residual", f"{item.run.name}: '{item.settings.subtract}' is subtracted") for item in read if item.settings.subtract),
        *_advice(result),
    ]
    return replace(result, findings=tuple(findings))


def _doubts(method: RunUpMethod, runs: Sequence[MeasuredRun]) -> list[Finding]:
    """Findings on a method: undetermined, rejected, at a bound, extrapolated."""
    findings = []
    if method.verdict == "not determined":
        message = (
            f"{method.title}: the data determine {method.rank} of {method.unknowns} coefficients at a point; the values are not determined"
        )
        findings.append(Finding("collinear", f"{message}, however well the response is met."))
    if method.verdict == "rejected":
        excess = f"chi² per datum is {method.chi2_per_datum:.2f}"
        family = "the bearing is not of the fitted family, and no interval is given"
        findings.append(Finding("model-mismatch", f"{method.title}: {excess}: {family}."))
    if "determined" in method.verdict and method.chi2_p is not None and method.chi2_p < REJECTED:
        excess = f"chi² per datum is {method.chi2_per_datum:.2f}: the residual exceeds the noise"
        bounds = f"{100 * (method.share_at_bound or 0.0):.0f} % of the coefficients lie on their bounds"
        findings.append(Finding("model-mismatch", f"{method.title}: {excess}; {bounds}, and stated errors may be too small."))
    bound = [parameter.name for parameter in method.parameters if parameter.at_bound]
    if bound:
        findings.append(Finding("at-bound", f"{method.title}: {', '.join(bound)} at the bound: the rotor file describes another bearing."))
    for run in runs:
        run_prediction = method.prediction(run.name)
        if run.role == HELD_OUT and run_prediction is not None and run_prediction.notes and method.verdict in ("rejected", "not rejected"):
            findings.append(Finding("extrapolated", f"{method.title}, {run.name}: {'; '.join(run_prediction.notes)}."))
    return findings


def _advice(result: RunUpResult) -> list[Finding]:
    """Recommended experiment where the coefficients are not determined."""
    if result.measured_rank is None or result.measured_rank.rank == 8:
        return []
    place = f"under {result.rank_load:.3g} N at {result.rank_speed / RPM:.0f} rpm"
    fewest = f"the runs {place} determine {result.measured_rank.rank} of 8 coefficients"
    advice = next((row.advice for row in result.ranks if row.advice), "")
    return [note("experiment", f"{fewest}; {advice}")]
