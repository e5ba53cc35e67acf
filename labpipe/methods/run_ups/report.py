"""Report of run-ups: measurements, predictions and coefficients of every method, identifiability."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from labpipe.display import chance_text, with_error, write_values
from labpipe.methods.run_ups import figures, records
from labpipe.methods.run_ups.rotor import COEFFICIENTS
from labpipe.records.identification import Identification
from labpipe.report.document import Block, Paragraph, Section, Table

SHORT = {
    "start": "original",
    "amplitudes": "(a) amplitudes",
    "points": "(b) points",
    "joint": "(c) joint",
    "process": "(d) factors",
}
# A space at which no line breaks.
FIXED = "\N{NO-BREAK SPACE}"
KINDS = {"critical_speed": "Critical speed", "threshold": "Threshold speed of instability"}
DIFFERENCES = (
    "Differences are relative to the measurement; in brackets by the source's rule, relative to the larger "
    "of the two. * differs from the measurement by more than both standard errors explain (95 %)."
)
ADVICE_WORDS = (
    "A round shaft under any unbalance moves its journal along the same vector: a second unbalance run adds "
    "no rank; a run under a shaker, whose force does not turn with the shaft, does."
)
MOST_SPEEDS = 7


def rpm_text(amount: records.UncertainAmount | None) -> str:
    if amount is None or not math.isfinite(amount.value):
        return "none"
    if amount.std_error is None:
        return f"{figures.RPM * amount.value:.1f}"
    return with_error(figures.RPM * amount.value, figures.RPM * amount.std_error)


def _measured_row(run: records.MeasuredRun) -> tuple[str, ...]:
    speeds = f"{len(run.speed)} from {figures.RPM * run.speed[0]:.0f} to {figures.RPM * run.speed[-1]:.0f}"
    excitation = run.excitation + (f"; '{run.subtracted}' subtracted" if run.subtracted else "")
    found = (rpm_text(speed) for speed in (run.critical_speed, run.threshold))
    return (run.name, f"{run.load:.4g}", run.role, excitation, speeds, *found)


def speed_blocks(result: records.RunUpResult) -> tuple[Block, ...]:
    """Critical speeds and thresholds of every method with the measurement, then printed values."""
    blocks: list[Block] = []
    for item, title in KINDS.items():
        blocks.append(_speed_table(result, item, f"{title} [rpm]: measured, and by every method"))
        if result.metamodels:
            basis = f"coefficients of metamodels, from {result.metamodels_of} at the trained loads"
            blocks.append(_speed_table(result, item, f"{title} [rpm] with {basis}", result.metamodels))
    blocks.append(Paragraph(DIFFERENCES))
    for item, title in KINDS.items():
        blocks.extend(_printed_table(result, item, title))
    return tuple(blocks)


def _speed_table(
    result: records.RunUpResult, item: str, caption: str, models: Sequence[records.Model] = ()
) -> Table:
    columns = models or result.methods
    header = ("run", "measured", *(_heading(column) for column in columns))
    rows = []
    for run in _runs_with(result, item):
        measured: records.UncertainAmount | None = getattr(run, item)
        cells = (_speed_text(column.prediction(run.name), item, measured) for column in columns)
        text = "none" if measured is None else f"{rpm_text(measured)} rpm".replace("± ", f"±{FIXED}")
        rows.append((_run_name(run), text, *cells))
    # Cells of two numbers are text, which may wrap, so that all methods fit side by side.
    return Table(header, tuple(rows), caption)


def _heading(column: records.Model) -> str:
    name = SHORT.get(column.name, column.name)
    rejected = getattr(column, "verdict", "") == records.REJECTED
    return f"{name}, {records.REJECTED}" if rejected else name


def _runs_with(result: records.RunUpResult, item: str) -> list[records.MeasuredRun]:
    selected: list[records.MeasuredRun] = []
    for run in result.runs:
        predictions = (method.prediction(run.name) for method in result.methods)
        predicted = any(getattr(prediction, item, None) is not None for prediction in predictions)
        again = item == "threshold" and any(run.load == other.load for other in selected)
        if getattr(run, item) is not None or (predicted and not again):
            selected.append(run)
    return selected


def _run_name(run: records.MeasuredRun) -> str:
    said = run.role != records.HELD_OUT or records.HELD_OUT in run.name
    return f"{run.name}, {run.load:.4g} N{'' if said else f', {run.role}'}".replace(" N", f"{FIXED}N")


def _speed_text(
    prediction: records.RunPrediction | None, item: str, measured: records.UncertainAmount | None
) -> str:
    amount: records.UncertainAmount | None = None if prediction is None else getattr(prediction, item)
    if amount is None:
        return "none"
    text = rpm_text(amount)
    if measured is None:
        return text
    value = f"{text}{_mark(amount, measured)}".replace("± ", f"±{FIXED}")
    relative, rule = both_differences(amount.value, measured.value).split(" (")
    return f"{value}: {relative.replace(' ', FIXED)} ({rule.replace(' ', FIXED)}"


def _mark(amount: records.UncertainAmount, measured: records.UncertainAmount) -> str:
    if amount.std_error is None or measured.std_error is None:
        return ""
    error = math.hypot(amount.std_error, measured.std_error)
    return "*" if abs(amount.value - measured.value) > records.TWO_SIDED * error else ""


def both_differences(predicted: float, measured: float) -> str:
    """ "+2.15 % (2.10 %)": relative to the measurement, and to the larger of the two (the source's rule)."""
    relative = (predicted - measured) / measured
    rule = abs(predicted - measured) / max(abs(predicted), abs(measured))
    return f"{100 * relative:+.2f} % ({100 * rule:.2f} %)"


def _printed_table(result: records.RunUpResult, item: str, title: str) -> list[Block]:
    rows = []
    for run in result.runs:
        printed = [60 * value for value in getattr(run, f"printed_{item}")]
        if printed:
            shown = (f"{value:.6g}: {both_differences(value, printed[0])}" for value in printed[1:])
            rows.append((_run_name(run), f"{printed[0]:.6g}", *shown))
    if not rows:
        return []
    where = result.source or "a source"
    caption = f"{title} [rpm] as printed in {where}: for reference, measured on another rig"
    header = ("run", "measured (source)", "original (source)", "enhanced (source)")
    return [Table(header, tuple(rows), caption, (1, 2, 3))]


def uncertainty_blocks(result: records.RunUpResult) -> tuple[Block, ...]:
    fitted = [method for method in result.methods if method.rank is not None]
    titles = "method,verdict,rank,condition,at a bound,data,effective parameters,chi² per datum"
    rows = tuple(_uncertainty_row(method) for method in fitted)
    caption = (
        "Identifiability by method; rank and condition of (a) and (b): the worst point of eight unknowns each"
    )
    blocks: list[Block] = [Table(tuple(titles.split(",")), rows, caption, (3, 4, 5, 6))]
    for method in fitted:
        remarks = list(method.remarks)
        if method.free:
            remarks.append(f"Determined by the priors alone: {'; '.join(method.free)} (logarithms).")
        if remarks:
            blocks.append(Paragraph(f"{method.title}: {' '.join(remarks)}"))
    blocks.extend(_rank_blocks(result))
    return tuple(blocks)


def _uncertainty_row(method: records.RunUpMethod) -> tuple[str, ...]:
    return (
        SHORT.get(method.name, method.title),
        method.verdict,
        f"{method.rank} of {method.unknowns}".replace(" ", FIXED),
        "" if method.condition is None else f"{method.condition:.3g}",
        "" if method.share_at_bound is None else f"{100 * method.share_at_bound:.0f} %",
        str(method.n_datum),
        "" if method.n_effective is None else f"{method.n_effective:.0f}",
        "no redundant datum"
        if method.chi2_per_datum is None
        else f"{method.chi2_per_datum:.2f} ({chance_text(method.chi2_p)})",
    )


def _rank_blocks(result: records.RunUpResult) -> list[Block]:
    if not result.ranks:
        return []
    place = f"{result.rank_load:.3g} N and {figures.RPM * result.rank_speed:.0f} rpm"
    rows = tuple((row.data, f"{row.rank} of 8", f"{row.condition:.3g}", row.words) for row in result.ranks)
    caption = f"Rank of the eight coefficients by kind of data, at {place}"
    table = Table(("data", "rank", "condition", "measured combinations"), rows, caption, (1, 2))
    blocks: list[Block] = [table, Paragraph(f"Advice: {ADVICE_WORDS}", "note")]
    rank = result.measured_rank
    if rank is not None and rank.free:
        free = tuple((str(number), combination) for number, combination in enumerate(rank.free, 1))
        unseen = f"Combinations that the runs {rank.data} do not determine at {place}"
        caption = f"{unseen}, in parts of the coefficients' sizes"
        blocks.append(Table(("no.", "combination"), free, caption, (0,)))
    return blocks


def parameter_table(method: records.RunUpMethod) -> Table:
    rows = []
    for parameter in method.parameters:
        kind = "exponent" if parameter.name.startswith("viscosity_") else "factor"
        value, error, *ends = write_values(parameter.value, parameter.full_error, *(parameter.ci95 or ()))
        interval = " to ".join(ends) or ("at bound" if parameter.at_bound else "none")
        rows.append((parameter.name, kind, value, error or "none", interval))
    what = "posterior values with their standard deviations, as factors on the rotor file's bearing"
    header = ("parameter", "kind", "value", "std. deviation", "95 % interval")
    return Table(header, tuple(rows), f"{method.title}: {what}", (2, 3, 4))


def coefficient_table(method: records.RunUpMethod, run: records.MeasuredRun) -> Table | None:
    prediction = method.prediction(run.name)
    if prediction is None or not prediction.coefficients:
        return None
    n = len(prediction.coefficient_speed)
    chosen = dict.fromkeys(np.linspace(0, n - 1, min(n, MOST_SPEEDS)).round().astype(int).tolist())
    rows = tuple(
        (f"{figures.RPM * prediction.coefficient_speed[place]:.0f}", *_eight(prediction, place))
        for place in chosen
    )
    units = tuple(f"{name} [{figures.scale(name)[1]}]" for name in COEFFICIENTS)
    place = f"coefficients at {run.load:.4g} N ({run.name})"
    caption = f"{method.title}: {place}, ± one standard deviation; every speed in identification.json"
    return Table(("speed [rpm]", *units), rows, caption, tuple(range(9)))


def _eight(prediction: records.RunPrediction, place: int) -> list[str]:
    cells = []
    for number, value in enumerate(prediction.coefficients[place]):
        scale, _ = figures.scale(COEFFICIENTS[number])
        error = prediction.std_errors[place][number] if prediction.std_errors else None
        if error is not None and math.isfinite(error):
            cells.append(with_error(scale * value, scale * error))
        else:
            cells.append(f"{scale * value:.4g}{'' if error is None else ' at bound'}")
    return cells


def validation_table(models: Sequence[records.MetamodelResult]) -> Table:
    loads = dict.fromkeys(validation.load for model in models for validation in model.left_out)
    rows = []
    for model in models:
        for validation in model.left_out:
            sizes = (*validation.errors, validation.rms)
            errors = ["none" if validation.failed else f"{100 * error:.1f}" for error in sizes]
            position = "outside" if validation.outside else "between"
            rows.append((model.title, f"{validation.load:.4g}", position, *errors))
    error = f"rms error over the speeds [%] at each of {len(loads)} loads, of fits to the others"
    header = ("metamodel", "load [N]", "of the others", *COEFFICIENTS, "all")
    return Table(header, tuple(rows), f"Leave-one-load-out: {error}", tuple(range(3, 12)))


FRAME = (
    "x lies along the static load, y a quarter turn further with the spin. The critical speed is that of "
    "the largest displacement on the orbit, read between the measured speeds; the threshold is the onset "
    "speed of instability."
)


def cover_facts(result: records.RunUpResult) -> dict[str, str]:
    return {
        "rig": result.rotor,
        "run-ups": ", ".join(f"{run.name} ({run.load:.3g} N, {run.role})" for run in result.runs),
    }


def run_up_sections(result: records.RunUpResult, _identification: Identification) -> tuple[Section, ...]:
    searches: list[Block] = []
    for method in result.methods:
        searches += [figures.convergence_figure(method, search) for search in method.convergence]
        searches += [figures.spread_figure(method, spread) for spread in method.spreads]
    return (
        Section(f"Run-ups: {result.rotor}", _measured_blocks(result)),
        Section(
            "Critical speed and threshold",
            (figures.speeds_figure(result), *speed_blocks(result), *_cautions(result)),
        ),
        Section("Identifiability of the coefficients", (*uncertainty_blocks(result), *searches)),
        Section("Journal coefficients", _coefficients(result)),
        *([Section("Metamodels", _metamodels(result))] if result.metamodels else []),
        Section("Response of every run", tuple(figures.bode_figure(result, run) for run in result.runs)),
    )


def _measured_blocks(result: records.RunUpResult) -> tuple[Block, ...]:
    method = figures.best_method(result)
    cascades = [figures.cascade_figure(run, cascade) for run in result.runs for cascade in run.cascades]
    titles = "run,load [N],role,known unbalance or force,speeds [rpm],critical speed [rpm],threshold [rpm]"
    rows = tuple(_measured_row(run) for run in result.runs)
    largest = f"critical speed: largest displacement at {result.plane}"
    caption = f"Run-ups as measured; {largest}; ± is one standard error"
    return (
        Paragraph(f"{result.rotor}, on its {result.bearing}. {FRAME}"),
        Table(tuple(titles.split(",")), rows, caption, (1, 5, 6)),
        figures.polar_figure(result, method),
        figures.orbit_figure(result, method),
        *cascades,
    )


def _cautions(result: records.RunUpResult) -> tuple[Block, ...]:
    notes = _notes(result.methods)
    held_out = {run.name for run in result.runs if run.role == records.HELD_OUT}
    return tuple(
        Paragraph(
            f"{text} ({', '.join(runs)}).",
            "warning" if held_out & set(runs) and records.OUTSIDE in text else "note",
        )
        for text, runs in notes.items()
    )


def _notes(owners: Sequence[records.Model]) -> dict[str, list[str]]:
    notes: dict[str, list[str]] = {}
    for owner in owners:
        for prediction in owner.predictions:
            for text in prediction.notes:
                notes.setdefault(f"{owner.title}: {text}", []).append(prediction.run)
    return notes


def _coefficients(result: records.RunUpResult) -> tuple[Block, ...]:
    method = figures.best_method(result)
    blocks: list[Block] = [] if method is None or not method.parameters else [parameter_table(method)]
    for run in result.runs:
        blocks.append(figures.coefficient_figure(result, run))
        table = None if method is None else coefficient_table(method, run)
        blocks += [] if table is None else [table]
    return tuple(blocks)


def _metamodels(result: records.RunUpResult) -> tuple[Block, ...]:
    basis = (
        f"Fitted to the coefficients of {result.metamodels_of} at the trained loads; the physical fit is "
        "(c). A metamodel is no better than these: a small leave-one-out error means that the coefficients "
        "are smooth, not that they are right."
    )
    blocks: list[Block] = [Paragraph(basis), validation_table(result.metamodels)]
    notes = _notes(result.metamodels).items()
    blocks += [Paragraph(f"{text} ({', '.join(runs)}).", "note") for text, runs in notes]
    for model in result.metamodels:
        failed = [
            f"Without {validation.load:.4g} N it could not be fitted: {validation.failed}."
            for validation in model.left_out
            if validation.failed
        ]
        remarks = " ".join((*model.remarks, *failed))
        blocks += [Paragraph(f"{model.title}: {remarks}")] if remarks else []
        blocks += figures.surface_figures(model)
    return tuple(blocks)
