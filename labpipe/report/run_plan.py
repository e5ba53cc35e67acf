"""Planned runs as people read them: which runs, what they will tell, and what they will not."""

from __future__ import annotations

from collections.abc import Iterator
from math import floor

from labpipe.display import NOT_DETERMINED, amount_text, shown_unit
from labpipe.quantities import to_display
from labpipe.records.run_plan import PlannedNumber, PlannedRun, RunPlan
from labpipe.report.document import Block, Document, Paragraph, Section, Table
from labpipe.report.plan import CRITERIA

NUMBERS = ("number", "expected", "goal", "std. error", "runs shared alike", "known before", "never below")
MODELS = {
    "bearing-states": "runs of the floating bearing",
    "run-ups": "run-ups of the rotor",
    "worn-bearing": "frequency responses of the worn rotor",
}


def run_plan_document(plan: RunPlan, version: str) -> Document:
    """The report of planned runs."""
    sections = (
        Section("Plan", tuple(_verdict(plan))),
        Section("Runs", (runs_table(plan),)),
        Section("Predicted errors", (_numbers(plan), Paragraph(EXPLAINED))),
    )
    return Document(plan.title, f"Plan of runs, labpipe {version}", sections, to_sign=False)


EXPLAINED = (
    "Standard errors from the information matrix of the fit that will evaluate the runs, at the expected values; in per cent of the "
    "number's size, or in its unit. Beside it: the same time shared alike among all candidates, what is known without any run, and what "
    "stays however many runs there are."
)


def runs_table(plan: RunPlan) -> Table:
    """A row for every condition that is to be run."""
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


def run_sentences(plan: RunPlan) -> Iterator[str]:
    """What is to be run and what it will tell, in sentences."""
    total = sum(run.count for run in plan.runs)
    aimed = [number for number in plan.numbers if number.goal is not None and number.error is not None]
    worst = max(aimed, key=lambda number: (number.error or 0.0) / (number.goal or 1.0)) if aimed else None
    determined = f" determine {worst.name}, the tightest against its goal, to {error_text(worst, worst.error)}:" if worst else " are"
    yield (
        f"{total} {MODELS[plan.model]} under {len(plan.runs)} of {plan.candidates} conditions ({_time(plan.duration)}){determined} "
        f"{plan.gain:.2f} times better by {CRITERIA[plan.criterion]} than the same time shared alike."
    )
    if aimed:
        met = plan.needed is not None and plan.needed <= plan.duration * (1 + 1e-9)
        needed = "no time meets them" if plan.needed is None else f"they need {_time(plan.needed)} of such runs"
        yield f"The goals are {'met' if met else 'NOT met'}: {needed}, {_time(plan.duration)} are planned."
    if plan.undetermined:
        helps = f"; {' or '.join(plan.remedies)} would determine all" if plan.remedies else ""
        yield f"However long one measures, these runs do not tell {'; '.join(plan.undetermined)}: what is known before decides{helps}."
    yield from plan.notes


def runs_csv(plan: RunPlan) -> str:
    """The runs as a table for other programs."""
    table = runs_table(plan)
    quoted = [",".join('"' + cell.replace('"', '""') + '"' for cell in row) for row in (table.header, *table.rows)]
    return "\n".join(quoted) + "\n"


def error_text(number: PlannedNumber, error: float | None) -> str:
    """A standard error, in per cent of the number's scale, or with its unit where it has none."""
    if error is None:
        return NOT_DETERMINED
    if number.scale is not None:
        return f"{100 * error / number.scale:.2g} %"
    unit = shown_unit(number.unit, error)
    return f"{to_display(error, unit) - to_display(0.0, unit):.2g} {unit}"


def _verdict(plan: RunPlan) -> Iterator[Block]:
    for text in run_sentences(plan):
        kind = "passed" if text.startswith("The goals are met") else "failed" if text.startswith("The goals are NOT") else ""
        yield Paragraph(text, kind) if kind else Paragraph(text)
    sure = floor(1e4 * plan.efficiency) / 100
    yield Paragraph(
        f"Certificate: the plan has, whole runs included, an efficiency (by variances) of at least {sure:.2f} % among all divisions of the "
        f"same time among the {plan.candidates} conditions, by the equivalence theorem."
    )


def _numbers(plan: RunPlan) -> Table:
    rows = tuple(
        (
            number.name,
            amount_text(number.expected, None, number.unit),
            "" if number.goal is None else error_text(number, number.goal),
            error_text(number, number.error),
            error_text(number, number.flat),
            error_text(number, number.before),
            error_text(number, number.lasting),
        )
        for number in plan.numbers
    )
    return Table(NUMBERS, rows, "Predicted standard errors", (1, 2, 3, 4, 5, 6))


def _time(seconds: float) -> str:
    return f"{seconds / 60:.3g} min" if seconds >= 120 else f"{seconds:.3g} s"


def run_names(run: PlannedRun) -> tuple[str, ...]:
    """The names of the recordings of a condition, one for each of its runs."""
    return (run.name,) if run.count == 1 else tuple(f"{run.name}-{number}" for number in range(1, run.count + 1))
