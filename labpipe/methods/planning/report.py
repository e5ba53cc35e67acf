"""Plans as people read them: the spectrum or the runs, what they will tell, and how sure that is."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from math import floor

from labpipe.display import NOT_DETERMINED, amount_text, per_cent, shown_unit
from labpipe.methods.planning import records
from labpipe.quantities import to_display
from labpipe.report.chart import Axis, Panel, dots, look, stack
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table

HEADER = (
    "coefficient", "expected", "goal", "std. error, noise known", "over draws of the expected values (95 %)",
    "std. error, weights from the periods", "flat multisine", "gain",
)  # fmt: skip
BUDGET = (
    "coefficient", "goal, expanded", "random", "systematic", "combined", "expanded",
    "largest shares of the variance",
)  # fmt: skip
SOURCES, SHOWN = 3, 0.005
BUDGETED = (
    "Random is what noise leaves, systematic what the uncertainties of the rig file's numbers and of the "
    "mass do to first order, by the budget of the plan's pipeline on the expected responses. Longer "
    "measuring lowers the random part alone."
)
TEST_HEADER = (
    "test", "shaker", "file", "lines", "periods", "skipped", "crest factor", "peak force [N]",
    "peak displacement [um]",
)  # fmt: skip
SCHEMES = {
    "one by one": "one shaker after the other",
    "together": "both shakers at once, in phase on a line and in antiphase on its neighbour",
    "interleaved": "both shakers at once, each on every other line",
}
FLATS = {
    "schroeder": "with Schroeder's phases",
    "least crest": "with phases of least crest factor",
    "both limits": "with phases for the limits of force and displacement",
}
CRITERIA = {
    "minimax": "the largest error",
    "A": "the root of the sum of squared errors",
    "D": "the volume of the errors' ellipsoid",
}


def plan_document(plan: records.Plan, version: str) -> Document:
    sections = (
        Section("Plan", tuple(_verdict(plan))),
        Section("Predicted errors", (_coefficients(plan), Paragraph(_explanation(plan)))),
        *_uncertainty(plan),
        Section("Excitation", (_tests(plan), _spectrum(plan))),
    )
    return Document(plan.title, f"Test plan, labpipe {version}", sections, to_sign=False)


def sentence(plan: records.Plan) -> str:
    worst = max(plan.coefficients, key=_ratio_to_goal if plan.with_goals else lambda c: c.error)
    tests = ", ".join(f"{test.name} {test.periods} periods" for test in plan.tests)
    gain = dict(plan.gains)["least crest"]
    rank = "tightest against its goal" if plan.with_goals else "least certain"
    reached = per_cent(worst.error_weighted)
    if worst.expanded is not None and worst.goal_expanded is not None:
        reached += f" by noise and {per_cent(worst.expanded)} expanded"
    return (
        f"{plan.duration:g} s of data ({tests} of {plan.period:g} s, {SCHEMES[plan.scheme]}) determine "
        f"{worst.name}, the {rank}, to {reached}: {gain:.2f} times better by {CRITERIA[plan.criterion]} than "
        "a flat multisine of the same peak and time."
    )


def goal_sentence(plan: records.Plan) -> str:
    if not plan.with_goals:
        return ""
    if plan.needed is None:
        why = f", that of {', '.join(plan.unreachable)} because of what sensors and mass leave"
        never = why if plan.unreachable else ""
        return f"The goals are NOT met: no time meets them{never}; {_time(plan.duration)} are planned."
    reached = "The goals are met" if plan.needed <= plan.duration else "The goals are NOT met"
    return f"{reached}: they need {_time(plan.needed)} of data, {_time(plan.duration)} are planned."


def _verdict(plan: records.Plan) -> Iterator[Block]:
    yield Paragraph(sentence(plan))
    if plan.with_goals:
        met = plan.needed is not None and plan.needed <= plan.duration
        yield Paragraph(goal_sentence(plan), "passed" if met else "failed")
    yield from (Paragraph(note, "note") for note in plan.notes)
    # Rounded down: a bound is not to be stated higher than it is.
    sure = floor(1e4 * plan.efficiency) / 100
    others = "and a flat spectrum" if plan.design == "flat" else "by three criteria"
    yield Paragraph(
        f"Certificate: the design behind the plan has an efficiency of at least {sure:.2f} % among all "
        f"spectra along the shakers of equal cost and the same floor ({100 * plan.floor:g} % of the power on "
        f"all lines alike), by the equivalence theorem. Of the optimum designs {others} it is the one that "
        "tells most at the limits of the rig."
    )
    rows = tuple((FLATS[name], f"{gain:.2f}") for name, gain in plan.gains)
    head = ("flat multisine, one shaker after the other", "its error over the plan's")
    yield Table(head, rows, "Gain at equal peak and time", (1,))
    if plan.combined:
        yield Paragraph(COMBINED)


COMBINED = (
    "The earlier result counts: errors are those of both together, weighted by their covariances, as a fit "
    "to the recordings of both gives them. The pipeline of the plan evaluates the new recordings."
)


def _coefficients(plan: records.Plan) -> Table:
    open_end = NOT_DETERMINED if any(c.error_range is not None for c in plan.coefficients) else ""
    rows = tuple(
        (
            c.name,
            _expected_text(c),
            "" if c.goal is None else per_cent(c.goal),
            per_cent(c.error),
            " to ".join(map(per_cent, c.error_range or ())) or open_end,
            per_cent(c.error_weighted),
            per_cent(c.flat),
            f"{c.flat / c.error:.2f}",
        )
        for c in plan.coefficients
    )
    numeric = tuple(range(1, len(HEADER)))
    return Table(HEADER, rows, "Relative standard errors, at the expected values", numeric)


def _uncertainty(plan: records.Plan) -> Iterator[Section]:
    stated = [c for c in plan.coefficients if c.expanded is not None]
    if not stated:
        return
    rows = tuple(
        (
            c.name,
            "" if c.goal_expanded is None else per_cent(c.goal_expanded),
            *(per_cent(number or 0.0) for number in (c.error_weighted, c.systematic, c.combined, c.expanded)),
            ", ".join(f"{p.source} {100 * p.share:.0f} %" for p in c.budget[:SOURCES] if p.share > SHOWN),
        )
        for c in stated
    )
    table = Table(BUDGET, rows, "Relative uncertainties", (1, 2, 3, 4, 5))
    yield Section("Predicted uncertainty", (table, Paragraph(BUDGETED)))


def _expected_text(coefficient: records.PlannedCoefficient) -> str:
    shown = shown_unit(coefficient.unit, coefficient.scale)
    return f"{to_display(coefficient.expected, shown):.5g} {shown}"


def _explanation(plan: records.Plan) -> str:
    return (
        "The prediction is the Cramer-Rao bound of errors in variables, with white noise in all sensors. "
        "The noise is not known before the test: weights from the scatter of "
        f"{min(test.periods for test in plan.tests)} periods make the errors {plan.factor:.2f} times as "
        "large, as counted on simulated tests. Errors are relative to the expected size, of coefficients "
        "that are nearly zero to 1 % of the largest of their kind. The prediction holds where the rig is as "
        "expected: plan again from the result of a short flat test, if it may not be."
    )


def _tests(plan: records.Plan) -> Table:
    rows = tuple(row for test in plan.tests for row in _rows(test))
    return Table(TEST_HEADER, rows, "Signals", tuple(range(3, 9)))


def _rows(test: records.PlannedTest) -> Iterator[tuple[str, ...]]:
    moved = " / ".join(f"{1e6 * peak:.3g}" for peak in test.peak_displacement)
    counts = [str(count) for count in (len(test.frequency), test.periods, test.skip)]
    of_shakers = zip(test.shakers, test.files, test.crest_factor, test.peak_force, strict=True)
    for shaker, file, crest, peak in of_shakers:
        yield (test.name, shaker, file, *counts, f"{crest:.3f}", f"{peak:.4g}", moved)


def _spectrum(plan: records.Plan) -> Figure:
    panels = []
    for test in plan.tests:
        series = []
        for number, (shaker, amplitude) in enumerate(zip(test.shakers, test.amplitude, strict=True)):
            shown = [(f, a) for f, a in zip(test.frequency, amplitude, strict=True) if a > 0]
            colour, _ = look(number)
            series.append(dots(shaker, [f for f, _ in shown], [a for _, a in shown], colour))
        force = Axis(f"force, {test.name}", "N", logarithmic=True)
        panels.append(Panel(Axis("frequency", "Hz"), force, tuple(series)))
    caption = "Amplitude of every line, 0-to-peak, by shaker; tests below each other."
    return Figure(stack(panels, 2.8 * len(panels)), caption, f"Force spectrum of the plan {plan.title}")


def _ratio_to_goal(coefficient: records.PlannedCoefficient) -> float:
    parts = [coefficient.error_weighted / coefficient.goal] if coefficient.goal else []
    parts += [(coefficient.expanded or 0.0) / coefficient.goal_expanded] if coefficient.goal_expanded else []
    return max(parts, default=0.0)


def _time(seconds: float) -> str:
    return f"{seconds / 60:.3g} min" if seconds >= 120 else f"{seconds:.3g} s"


NUMBERS = ("number", "expected", "goal", "std. error", "runs shared alike", "known before", "never below")
MODELS = {
    "bearing-states": "runs of the floating bearing",
    "run-ups": "run-ups of the rotor",
    "worn-bearing": "frequency responses of the worn rotor",
}


def run_plan_document(plan: records.RunPlan, version: str) -> Document:
    sections = (
        Section("Plan", tuple(_runs_verdict(plan))),
        Section("Runs", (runs_table(plan),)),
        Section("Predicted errors", (_numbers(plan), Paragraph(EXPLAINED))),
    )
    return Document(plan.title, f"Plan of runs, labpipe {version}", sections, to_sign=False)


EXPLAINED = (
    "Standard errors from the information matrix of the fit that will evaluate the runs, at the expected "
    "values; in per cent of the number's size, or in its unit. Beside it: the same time shared alike among "
    "all candidates, what is known without any run, and what stays however many runs there are."
)


def runs_table(plan: records.RunPlan) -> Table:
    titles = tuple(dict.fromkeys(title for run in plan.runs for title, _ in run.conditions))
    rows = tuple(
        (
            run.name,
            str(run.count),
            f"{run.seconds:.4g}",
            *(dict(run.conditions).get(title, "") for title in titles),
            f"{100 * run.share:.0f} %",
        )
        for run in plan.runs
    )
    return Table(("run", "times", "each [s]", *titles, "share at the optimum"), rows, "Runs to make", (1, 2))


def run_sentences(plan: records.RunPlan) -> Iterator[str]:
    total = sum(run.count for run in plan.runs)
    aimed = [number for number in plan.numbers if number.goal is not None and number.error is not None]
    worst = max(aimed, key=lambda number: (number.error or 0.0) / (number.goal or 1.0)) if aimed else None
    determined = " are"
    if worst:
        reached = error_text(worst, worst.error)
        determined = f" determine {worst.name}, the tightest against its goal, to {reached}:"
    yield (
        f"{total} {MODELS[plan.model]} under {len(plan.runs)} of {plan.candidates} conditions "
        f"({_time(plan.duration)}){determined} {plan.gain:.2f} times better by {CRITERIA[plan.criterion]} "
        "than the same time shared alike."
    )
    if aimed:
        met, needed = False, "no time meets them"
        if plan.needed is not None:
            met = plan.needed <= plan.duration * (1 + 1e-9)
            needed = f"they need {_time(plan.needed)} of such runs"
        yield f"The goals are {'met' if met else 'NOT met'}: {needed}, {_time(plan.duration)} are planned."
    if plan.undetermined:
        helps = f"; {' or '.join(plan.remedies)} would determine all" if plan.remedies else ""
        yield (
            f"However long one measures, these runs do not tell {'; '.join(plan.undetermined)}: what is "
            f"known before decides{helps}."
        )
    yield from plan.notes


def runs_csv(plan: records.RunPlan) -> str:
    table = runs_table(plan)
    text = io.StringIO()
    writer = csv.writer(text, quoting=csv.QUOTE_ALL, lineterminator="\n")
    writer.writerows((table.header, *table.rows))
    return text.getvalue()


def error_text(number: records.PlannedNumber, error: float | None) -> str:
    if error is None:
        return NOT_DETERMINED
    if number.scale is not None:
        return per_cent(error / number.scale)
    unit = shown_unit(number.unit, error)
    return f"{to_display(error, unit) - to_display(0.0, unit):.2g} {unit}"


def _runs_verdict(plan: records.RunPlan) -> Iterator[Block]:
    kinds = {"The goals are met": "passed", "The goals are NOT": "failed", "": ""}
    for text in run_sentences(plan):
        yield Paragraph(text, next(kind for begin, kind in kinds.items() if text.startswith(begin)))
    sure = floor(1e4 * plan.efficiency) / 100
    yield Paragraph(
        "Certificate: the plan has, whole runs included, an efficiency (by variances) of at least "
        f"{sure:.2f} % among all divisions of the same time among the {plan.candidates} conditions, by the "
        "equivalence theorem."
    )


def _numbers(plan: records.RunPlan) -> Table:
    rows = tuple(
        (
            number.name,
            amount_text(number.expected, None, number.unit),
            "" if number.goal is None else error_text(number, number.goal),
            *(error_text(number, e) for e in (number.error, number.flat, number.before, number.lasting)),
        )
        for number in plan.numbers
    )
    return Table(NUMBERS, rows, "Predicted standard errors", (1, 2, 3, 4, 5, 6))


def run_names(run: records.PlannedRun) -> tuple[str, ...]:
    numbered = tuple(f"{run.name}-{number}" for number in range(1, run.count + 1))
    return (run.name,) if run.count == 1 else numbered
