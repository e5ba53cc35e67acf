"""The part of a report that a comparison of tests fills: the answer in words, its amounts, figures, and the tests behind it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from labpipe.display import difference_in, number, shown_unit, written
from labpipe.quantities import display_unit, to_display
from labpipe.records.comparison import ComparedPoint, Comparison, Comparisons
from labpipe.records.identification import Identification
from labpipe.records.parameter import Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.report.budget import comparison_budget_blocks
from labpipe.report.comparison_figures import comparison_figures
from labpipe.report.document import Block, Paragraph, Section, Table
from labpipe.report.loop_blocks import loop_blocks
from labpipe.report.wording import legible, unit_text

AMOUNT_HEADER = ("amount", "value", "unit", "std. error", "95 % interval")
EXPLAINED = {
    "trend": "Weights: the fits' standard errors and the error of setting the condition.",
    "difference": "Tests at the same condition are paired; the logarithm of their ratio is averaged with weights.",
    "repeatability": "One-way random effects: the scatter of repeats without a new setting, and that of the settings beyond it.",
    "ratio": (
        "A one-dof fit of a coupled transfer function is not K_ii, and the shaft bends. So the theory's stiffness matrix times the ratio, "
        "in series with the shaft, gives a curve whose fit on the same lines equals the measured fit. The intervals hold the noise of "
        "the fits, the error of setting the condition and that of the shaft's stiffness."
    ),
    "rayleigh": "Rayleigh damping has one beta = c / k for all tests; the chi-square of the tests' beta about their mean judges it.",
    "prediction": (
        "The bearing's loop as its file states it, on the rig's mass and support, gives a response; the same fits of it, on the same lines "
        "with the same weights, are the prediction for each band; share_k and share_c are the bands whose 95 % interval, by noise and "
        "given numbers, holds it. Unknowns are fitted to all lines of the response at once, weighted by their noise, with the support free "
        "within its stated uncertainty; their intervals hold the doubts of channels, mass and support. "
        "Neighbouring bands share lines, so they miss together. unstable_poles and sensitivity_peak are those of the bearing file's mass."
    ),
    "bands": (
        "Every coefficient of every band of the second test is held against the first one's by Welch's t-test; the p-values are corrected "
        "after Holm for the number of tests, whatever neighbouring bands share. What both tests have in common, such as the uncertainty "
        "of the support, is no part of their difference."
    ),
    "sensitivity": (
        "An excitation is added between two points of the loop; S = H_after / (H_after - H_before), both against the excitation. The peak "
        "is that of a parabola around the highest line, since the line itself would be too high by its noise. Intervals hold noise and the "
        "doubts of the channels; what both sides of the sum have in common cancels."
    ),
    "certificate": (
        "S = H_after (H_after - H_before)^-1, both against what is added in the loop, and L = S^-1 - 1, without a model; 95 % bands by "
        "the covariance of the lines. With a bearing file its unknowns are fitted to all recorded signals; poles, decrements and margins "
        "are those of the fitted loop, with intervals to first order in the unknowns, by noise and the doubts of the channels. "
        "gain_margin_lower and _upper: factors of the gain "
        "down to and up to the border of stability; phase_margin to either side; disk_margin 1 / max|S - 1/2|. A limit counts as kept, "
        "or as broken, where the probability of it is at least the stated confidence."
    ),
    "reciprocity": "H of a response to a force against H of the reverse; pairs with a difference near 140 % are noise, so not coupled.",
}


def comparison_sections(comparisons: Comparisons, identification: Identification) -> tuple[Section, ...]:
    """One section for every comparison of tests."""
    responses = identification.responses
    return tuple(Section(f"Comparison: {part.name}", comparison_blocks(part, responses)) for part in comparisons)


def comparison_blocks(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> tuple[Block, ...]:
    """Statement, amounts, figures, tests."""
    return (
        Paragraph(comparison.statement, "note"),
        Paragraph(EXPLAINED[comparison.kind]),
        Table(AMOUNT_HEADER, tuple(_amount_row(amount) for amount in comparison.amounts), f"Amounts of {comparison.name}", (1, 3, 4)),
        *comparison_figures(comparison, responses),
        *([_point_table(comparison)] if comparison.points else []),
        *loop_blocks(comparison),
        *comparison_budget_blocks(comparison),
    )


def _amount_row(amount: Parameter) -> tuple[str, ...]:
    unit = shown_unit(amount.unit, amount.value, amount.full_error)
    error = None if amount.full_error is None else difference_in(amount.full_error, unit)
    ends = () if amount.ci95 is None else tuple(to_display(end, unit) for end in amount.ci95)
    value, doubt, *interval = written(to_display(amount.value, unit), error, *ends)
    return (amount.name, "not tested" if math.isnan(amount.value) else value, legible(unit), doubt, " to ".join(interval))


def _point_table(comparison: Comparison) -> Table:
    """The tests; columns that none of them fills are left out."""
    unit = unit_text(comparison.unit)
    titles = [
        "test",
        f"{comparison.condition or 'condition'} [{unit_text(comparison.condition_unit) or '-'}]",
        f"{comparison.second} [{unit_text(comparison.second_unit) or '-'}]",
        "group",
        f"value{f' [{unit}]' if unit else ''}",
        "95 % interval",
        "theory",
        "ratio",
        "95 % interval of the ratio",
        "p-value",
    ]
    rows = [_point_row(comparison, point) for point in comparison.points]
    used = [number for number in range(len(titles)) if any(row[number] for row in rows)]
    shown = tuple(tuple(row[number] for number in used) for row in rows)
    return Table(tuple(titles[number] for number in used), shown, f"Tests of {comparison.name}", tuple(range(1, len(used))))


def _point_row(comparison: Comparison, point: ComparedPoint) -> tuple[str, ...]:
    unit = display_unit(comparison.unit)

    def text(value: float | None) -> str:
        return "" if value is None else number(to_display(value, unit))

    return (
        point.test,
        *(
            "" if amount is None else f"{to_display(amount, display_unit(of)):g}"
            for amount, of in ((point.condition, comparison.condition_unit), (point.second, comparison.second_unit))
        ),
        point.group,
        text(point.value),
        "" if point.ci95 is None else f"{text(point.ci95[0])} to {text(point.ci95[1])}",
        text(point.theory),
        *_ratio(point),
        "" if point.p_value is None else f"{point.p_value:.2g}",
    )


def _ratio(point: ComparedPoint) -> tuple[str, str]:
    """The ratio and its interval, to the second digit of the interval's half width."""
    if point.ratio is None or point.ratio_ci95 is None:
        return "" if point.ratio is None else number(point.ratio), ""
    low, high = point.ratio_ci95
    value, _, *ends = written(point.ratio, (high - low) / 2, low, high)
    return value, " to ".join(ends)
