"""All methods on the run-ups of a rotor, held against every run: coefficients, critical and threshold speeds, and their doubt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from labpipe.bearings.journal import JournalBearing
from labpipe.errors import LabpipeError
from labpipe.records.finding import Finding, note
from labpipe.records.run_up import RunUp
from labpipe.records.run_up_result import HELD_OUT, START, TRAINED, MeasuredRun, RankRow, RunPrediction, RunUpMethod, RunUpResult
from labpipe.rigs.run_up_rotor import RunUpRotor, searched_over
from labpipe.run_ups.joint_result import REJECTED
from labpipe.run_ups.measured import ReadRun, measured_run
from labpipe.run_ups.metamodel_results import metamodels
from labpipe.run_ups.methods import Predictor, Solved, solve_start
from labpipe.run_ups.predictions import RPM, excited_as, predict, with_unbalance_of
from labpipe.run_ups.rank import RankStatement, measured_statement, rank_statements
from labpipe.run_ups.settings import METHODS, RunUpSettings

Tell = Callable[[str], None]


def run_up_result(settings: RunUpSettings, rig: RunUpRotor, read: Sequence[ReadRun], tell: Tell = lambda _: None) -> RunUpResult:
    """All methods that the settings name, fitted to the trained runs, held against every run."""
    measured = [measured_run(one, settings.plane) for one in read]
    runs = [one.run for one in read]
    rig = excited_as(searched_over(rig, runs), runs)
    trained = [one.run for one in read if one.settings.role == TRAINED]
    solved = []
    for name in [START, *(name for name in METHODS if name in settings.methods)]:
        tell(f"run-ups   {name}")
        solved.append(_solved(name, rig, trained, settings))
    methods = [_with_predictions(one, rig, runs, settings.plane) for one in solved]
    if settings.metamodels:
        tell("run-ups   metamodels")
    ranks = _ranks(rig, trained)
    result = RunUpResult(
        rig.name,
        settings.plane or rig.plane_names[-1],
        _bearing_words(rig),
        tuple(record for record, _ in measured),
        tuple(methods),
        metamodels(settings, rig, trained, runs, solved),
        next((one.title for one in methods if settings.metamodels and one.name == settings.metamodels_of), ""),
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


def _with_predictions(one: Solved, rig: RunUpRotor, runs: Sequence[RunUp], plane: str) -> RunUpMethod:
    return replace(one.method, predictions=tuple(prediction(one.predictor, rig, run, plane) for run in runs))


def prediction(predictor: Predictor, rig: RunUpRotor, run: RunUp, plane: str, curves: bool = True) -> RunPrediction:
    """What a method says of a run."""
    own = with_unbalance_of(rig, run)
    return predict(own, run, predictor(own, run), plane, curves)


def _bearing_words(rig: RunUpRotor) -> str:
    bearing = rig.place.bearing
    if not isinstance(bearing, JournalBearing):
        return f"{rig.place.kind} '{rig.place.name}'"
    size = f"L {1e3 * bearing.length:.4g} mm, D {1e3 * bearing.diameter:.4g} mm, clearance {1e6 * bearing.clearance:.4g} um"
    return f"journal bearing '{rig.place.name}': {size}, viscosity {bearing.viscosity:.4g} Pa s"


def _ranks(rig: RunUpRotor, trained: Sequence[RunUp]) -> dict[str, Any]:
    """What such data can tell at the load and speed in the middle, and what the data at hand do."""
    loads = sorted({run.load for run in trained})
    load = loads[len(loads) // 2]
    there = [run for run in trained if run.load == load]
    first = there[0]
    speed = float(first.speed[first.n_speed // 2])
    return {
        "ranks": tuple(_row(one) for one in rank_statements(rig, load, speed)),
        "rank_load": load,
        "rank_speed": speed,
        "measured_rank": _row(measured_statement(rig, there, load, speed)),
    }


def _row(one: RankStatement) -> RankRow:
    return RankRow(one.data, one.rank, one.condition, one.words, one.free, one.advice)


def _with_findings(result: RunUpResult, reasons: Sequence[str], read: Sequence[ReadRun]) -> RunUpResult:
    findings = [
        *(finding for method in result.methods for finding in _doubts(method, result.runs)),
        *(note("no-critical-speed", reason) for reason in reasons),
        *(note("residual", f"{one.run.name}: '{one.settings.subtract}' is subtracted") for one in read if one.settings.subtract),
        *_advice(result),
    ]
    return replace(result, findings=tuple(findings))


def _doubts(method: RunUpMethod, runs: Sequence[MeasuredRun]) -> list[Finding]:
    """What a reader must know of a method before its numbers."""
    found = []
    if method.verdict == "not determined":
        message = f"{method.title}: the data see {method.rank} of {method.unknowns} coefficients at a point; the values are not determined"
        found.append(Finding("collinear", f"{message}, however well the response is met."))
    if method.verdict == "rejected":
        excess = f"chi² per datum is {method.chi2_per_datum:.2f}"
        family = "the bearing is not of the fitted family, and no interval is given"
        found.append(Finding("model-mismatch", f"{method.title}: {excess}: {family}."))
    if "determined" in method.verdict and method.chi2_p is not None and method.chi2_p < REJECTED:
        excess = f"chi² per datum is {method.chi2_per_datum:.2f}: more than noise is left"
        bounds = f"{100 * (method.share_at_bound or 0.0):.0f} % of the coefficients lie on their bounds"
        found.append(Finding("model-mismatch", f"{method.title}: {excess}; {bounds}, and stated errors may be too small."))
    bound = [parameter.name for parameter in method.parameters if parameter.at_bound]
    if bound:
        found.append(Finding("at-bound", f"{method.title}: {', '.join(bound)} at the bound: the rotor file describes another bearing."))
    for run in runs:
        told = method.prediction(run.name)
        if run.role == HELD_OUT and told is not None and told.notes and method.verdict in ("rejected", "not rejected"):
            found.append(Finding("extrapolated", f"{method.title}, {run.name}: {'; '.join(told.notes)}."))
    return found


def _advice(result: RunUpResult) -> list[Finding]:
    """What to measure so that the coefficients are determined."""
    if result.measured_rank is None or result.measured_rank.rank == 8:
        return []
    where = f"under {result.rank_load:.3g} N at {result.rank_speed / RPM:.0f} rpm"
    fewest = f"the runs {where} determine {result.measured_rank.rank} of 8 coefficients"
    advice = next((row.advice for row in result.ranks if row.advice), "")
    return [note("experiment", f"{fewest}; {advice}")]
