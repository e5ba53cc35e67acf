"""The uncertainty budget of a fit in its report: parts of the uncertainty, shares by source, and what would
improve it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from labpipe.display import difference_in, shown_unit, two_digits
from labpipe.quantities import to_display
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.uncertain import Budget
from labpipe.report.chart import PALETTE_SIZE, Axis, Panel, Series, named_ticks, outline, stack
from labpipe.report.document import Block, Figure, Paragraph, Table
from labpipe.report.wording import legible, round_to_error

HEADER = (
    "parameter", "value", "unit", "random", "systematic", "combined", "expanded", "relative", "k", "ν eff",
    "Monte Carlo / first order",
)  # fmt: skip
# Most parameters that have a bar each, and half the height of one.
MOST_BARS, BAR = 12, 0.38
# Degrees of freedom from which they count as known.
MANY = 1000
COMBINED = (
    "Combined standard uncertainty by the GUM (JCGM 100:2008, 5.1), to first order: random, from the noise "
    "of this measurement, and systematic, from the uncertainties of the numbers that were given. Expanded: "
    "times k, Student's quantile with the effective degrees of freedom after Welch and Satterthwaite, for 95 "
    "%"
)
EXPLAINED = (
    f"{COMBINED} unless the pipeline asks for another `coverage`. Intervals are of 95 % and hold all of it."
)
EXPLAINED_COMPARISON = f"{COMBINED}. Intervals hold all of it."
DRAWN = (
    "Monte Carlo / first order: scatter of the draws over what first order says of the same distributions of "
    "noise and numbers. Student's of ν degrees of freedom scatters by √(ν / (ν - 2)) times the standard "
    "uncertainty; of four or fewer no scatter of draws is settled, and none is compared. Intervals are those "
    "of the draws, with the model error where there is one."
)
# Share of the variance from which one source with sharp limits shapes the distribution.
RECTANGULAR = 0.5
# The head of the table of what nobody stated.
NOT_STATED = ("source", "uncertainty", "what it changes")


def budget_blocks(fit: Fit) -> tuple[Block, ...]:
    """Table of the parts, bars and table of the shares, a sentence on what to improve, and what was not
    stated.
    """
    blocks = () if fit.budget is None else _blocks(fit.name, fit.parameters, fit.budget, EXPLAINED)
    rows = tuple((entry.source, "0 (not stated)", entry.effect) for entry in fit.not_stated)
    not_stated = Table(NOT_STATED, rows, "What no residual shows, and counts as zero in the intervals")
    return (*blocks, *([not_stated] if rows else []))


def comparison_budget_blocks(comparison: Comparison) -> list[Block]:
    """The same of every budget of a comparison, with what it is explained once."""
    blocks: list[Block] = []
    for budget in comparison.budgets:
        amounts = tuple(amount for amount in comparison.amounts if amount.name in budget.names)
        blocks.extend(_blocks(comparison.name, amounts, budget, "" if blocks else EXPLAINED_COMPARISON))
    return blocks


def _blocks(name: str, parameters: Sequence[Parameter], budget: Budget, explained: str) -> tuple[Block, ...]:
    with_systematic = {parameter.name: parameter for parameter in parameters if parameter.systematic}
    if not with_systematic:
        return ()
    by_noise = budget.with_random({p.name: p.std_error for p in parameters if p.std_error})
    first_order = dict(zip(budget.names, by_noise.scatter_of_draws()[0].tolist(), strict=True))
    rows = tuple(_row(budget, of, first_order[name]) for name, of in with_systematic.items())
    named = list(with_systematic)
    return (
        *([Paragraph(explained)] if explained else []),
        Table(HEADER, rows, f"Uncertainty of {name}", tuple(range(1, len(HEADER)))),
        *([] if budget.drawn is None else [Paragraph(DRAWN)]),
        _bars(budget, named[:MOST_BARS]),
        _shares_table(budget, named),
        Paragraph(_improvement(with_systematic, budget), "note"),
        *([Paragraph(text, "warning")] if (text := _sharp_ends(budget, named)) else []),
    )


def _row(budget: Budget, parameter: Parameter, first_order: float) -> tuple[str, ...]:
    """Its line of the table; *first_order*: the scatter of draws that first order says [unit of it]."""
    column = budget.names.index(parameter.name)
    parts = tuple(float(part[column]) for part in (budget.random, budget.systematic, budget.combined))
    unit = shown_unit(parameter.unit, parameter.value, parts[2])
    value = to_display(parameter.value, unit)
    random, systematic, combined = (difference_in(part, unit) for part in parts)
    dof = float(budget.dof[column])
    factor = parameter.coverage_factor or 0.0
    scatter = np.nan if budget.drawn is None else float(budget.drawn[column, 0])
    ratio = f"{scatter / first_order:.3f}" if first_order > 0 else "none"
    relative = f"{two_digits(100 * _relative(parameter))} %" if parameter.value else ""
    return (
        parameter.name,
        round_to_error(value, combined),
        legible(unit),
        *(two_digits(part, value) for part in (random, systematic, combined, factor * combined)),
        relative,
        f"{factor:.2f}",
        "known" if dof > MANY else f"{math.floor(dof)}",
        "" if budget.drawn is None else ratio,
    )


def _sources(budget: Budget, names: list[str]) -> list[str]:
    largest: dict[str, float] = {}
    for name in names:
        for source, share in budget.shares(name).items():
            largest[source] = max(largest.get(source, 0.0), share)
    return sorted(largest, key=lambda source: -largest[source])


def _bars(budget: Budget, names: list[str]) -> Figure:
    series: list[Series] = []
    for number, source in enumerate(_sources(budget, names)):
        for row, name in enumerate(names):
            shares = budget.shares(name)
            ordered = list(shares)
            begin = 100 * sum(shares[other] for other in ordered[: ordered.index(source)])
            end = begin + 100 * shares[source]
            x, y = np.array([begin, end, end, begin]), row + BAR * np.array([-1, -1, 1, 1])
            series.append(outline(source if row == 0 else "", x, y, number % PALETTE_SIZE, 0.75))
    along = Axis("share of the variance", "%", low=0.0, high=100.0)
    panel = Panel(along, Axis("", "", len(names) - 0.5, -0.5, ticks=named_ticks(names)), tuple(series))
    caption = "Shares of the sources in the variance of each parameter, the largest first."
    chart = stack([panel], 1.3 + 0.32 * len(names), "above")
    return Figure(chart, caption, "Bars of the shares of all sources")


def _shares_table(budget: Budget, names: list[str]) -> Table:
    sizes = {source.source: _size(source.std_error, source.unit) for source in budget.sources}
    rows = []
    for source in _sources(budget, names):
        size = sizes.get(source, "this measurement")
        shares = (budget.shares(name).get(source, 0.0) for name in names)
        rows.append((source, size, *(f"{100 * share:.1f} %" if share >= 5e-4 else "0" for share in shares)))
    header = ("source", "standard uncertainty", *names)
    return Table(header, tuple(rows), "Share of every source in the variance", tuple(range(1, len(header))))


def _size(std_error: float, unit: str) -> str:
    if unit == "1":
        # The noise of an earlier fit is counted in its own standard errors.
        return "1 standard error" if std_error == 1.0 else f"{two_digits(100 * std_error)} %"
    shown = shown_unit(unit, std_error)
    return f"{two_digits(difference_in(std_error, shown))} {legible(shown)}"


def _improvement(parameters: Mapping[str, Parameter], budget: Budget) -> str:
    """What to improve first: the source whose removal makes the largest relative uncertainty smallest."""
    worst = max(parameters, key=lambda name: _relative(parameters[name]))
    before = 100 * _relative(parameters[worst])
    source, share = next(iter(budget.shares(worst).items()))
    part = f"{worst} is the least certain ({before:.2g} % expanded): {100 * share:.0f} % of its variance is"
    if source == "noise":
        return f"{part} noise; measure longer first."
    gain = math.sqrt(max(1 - share, 0.0))
    after = f"{before * gain:.2g} %" if gain > 0.005 else "noise alone"
    half = f"{before * math.sqrt(1 - 0.75 * share):.2g} %"
    return f"{part} {source}. Without that uncertainty it would be {after}; with half of it {half}."


def _relative(parameter: Parameter) -> float:
    """Expanded uncertainty over the value [1]; zero for a value of zero."""
    return (parameter.expanded or 0.0) / abs(parameter.value) if parameter.value else 0.0


def _sharp_ends(budget: Budget, names: list[str]) -> str:
    """Parameters of which one source with sharp limits holds most: Student's factor is too large there."""
    shapes = {source.source: source.shape for source in budget.sources}
    ends = []
    for name in names:
        source, share = next(iter(budget.shares(name).items()))
        if shapes.get(source, "normal") != "normal" and share > RECTANGULAR:
            ends.append(f"{name} ({source}, {shapes[source]})")
    most = f"One source with sharp limits holds most of the variance of {', '.join(ends)}"
    return f"{most}: the expanded intervals are too wide there." if ends else ""
