"""The first page of a report: its entries beside title and verdict, and the numbers that were asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from labpipe.display import (
    LEAST_CHANCE,
    count_text,
    difference_in,
    per_cent,
    plain_text,
    shown_unit,
    two_digits,
    with_error,
    write_values,
)
from labpipe.quantities import to_display
from labpipe.records.dataset import amount_of
from labpipe.records.finding import WARNING, Parameter, of_level
from labpipe.records.identification import (
    Fit,
    FittedCurve,
    Identification,
    RuleDecision,
    RuleOutcome,
    of_points,
)
from labpipe.records.sections import section
from labpipe.registry import few
from labpipe.report.chart import Chart, stack
from labpipe.report.document import Block, Figure, Table
from labpipe.report.figures import fitted_curve_figure
from labpipe.report.fits import blocks_of_details
from labpipe.report.wording import fit_title, legible, meaning

# What rules without limits decide by, since ISO/IEC 17025, 7.8.6, asks for it to be stated.
SIMPLE_ACCEPTANCE = "without limits: simple acceptance, the value alone is compared"


def rule_blocks(outcomes: Sequence[RuleOutcome], place: str = "") -> tuple[Block, ...]:
    """The rules with what they found, *place*: where; and the decisions on limits."""
    rows = tuple(
        (rule.section, rule.rule, rule.found, "holds" if rule.passed else "FAILS") for rule in outcomes
    )
    caption = f"Rules of the pipeline; {SIMPLE_ACCEPTANCE}{place}"
    return (Table(("section", "rule", "found", "outcome"), rows, caption), *decision_blocks(outcomes))


def all_hold(outcomes: Sequence[RuleOutcome]) -> str:
    """That none of the rules fails."""
    return f"all {len(outcomes)} rules hold" if len(outcomes) > 1 else "the one rule holds"


def decision_blocks(outcomes: Sequence[RuleOutcome]) -> tuple[Block, ...]:
    """A table of the decisions on limits; nothing without any."""
    rows = tuple(_row(outcome.rule, outcome.decision) for outcome in outcomes if outcome.decision is not None)
    if not rows:
        return ()
    heads = ("rule", "outcome", "within the limits", "u", "passes", "risk here", "global risks")
    shares = (
        ", and the shares of all that the stated process makes that are accepted falsely / rejected falsely"
    )
    caption = (
        "Decisions on limits: the probability that they hold, the combined standard uncertainty u, the "
        "values that pass, the risk of this decision (of a false acceptance where it passes, else of a "
        f"false rejection){shares if any(row[-1] for row in rows) else ''} (JCGM 106, ILAC-G8)"
    )
    return (Table(heads, rows, caption),)


def _row(rule: str, decision: RuleDecision) -> tuple[str, ...]:
    least = ">= " if decision.least else ""
    return (
        rule,
        decision.outcome,
        least + percent(decision.probability),
        "" if decision.uncertainty is None else plain_text(decision.uncertainty, decision.unit, 2),
        _passes(decision),
        percent(decision.specific_risk),
        _global(decision),
    )


def percent(probability: float) -> str:
    """A probability [1] in per cent to two digits, from its nearer end: '99.943 %', '0.057 %'."""
    small = min(probability, 1.0 - probability)
    if small <= 0.0:
        return f"{100 * probability:.0f} %"
    text = two_digits(100 * small)
    if "e" in text:
        return "< 0.01 %" if probability < 0.5 else "> 99.99 %"
    decimals = len(text.partition(".")[2])
    return f"{100 * probability:.{decimals}f} %"


def _passes(decision: RuleDecision) -> str:
    low, high = decision.accept_low, decision.accept_high
    if low is None and high is None:
        return "" if decision.together > 1 else "nothing"
    texts = ["" if end is None else plain_text(end, decision.unit, 6) for end in (low, high)]
    return " to ".join(texts) if all(texts) else f">= {texts[0]}" if texts[0] else f"<= {texts[1]}"


def _global(decision: RuleDecision) -> str:
    if decision.global_false_acceptance is None or decision.global_false_rejection is None:
        return ""
    return f"{percent(decision.global_false_acceptance)} / {percent(decision.global_false_rejection)}"


DATES = ("date", "recorded", "day")
MOST_CONDITIONS, MOST_VALUES = 6, 8
# Rows of the first page, and elements of a response that one figure of it shows.
MOST_RESULTS, MOST_ELEMENTS = 18, 4
# Height of that figure [in], alone and with phase and residual, which stand above so many rows in all.
FIGURE_HEIGHT, WHOLE_HEIGHT, FEW_ROWS = 2.1, 3.9, 9
# Ends of an interval that differ by less than this share from its middle are a half-width.
EVEN = 0.02


def cover_facts(identifications: Sequence[Identification]) -> tuple[tuple[str, str], ...]:
    """(what, which): rig, dates of the recordings where their conditions give them, conditions, sources,
    version; no clock.
    """
    of_sections = [facts for result in identifications for facts in section_facts(result)]
    rigs = [str(result.rig.get("name") or "") for result in identifications]
    rigs += [facts.get("rig", "") for facts in of_sections]
    tests = [conditions for result in identifications for _, conditions in result.measured_tests]
    dates = sorted({str(value) for test in tests for key, value in test.items() if key.lower() in DATES})
    conditions: dict[str, list[str]] = {}
    for test in tests:
        for key, value in test.items():
            if key.lower() not in DATES:
                conditions.setdefault(key, []).append(str(value))
    sources = {source["sha256"] for result in identifications for source in result.sources}
    facts = {
        "rig": _each_once(rigs),
        "recorded": " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "",
        "tests": f"{len(tests)} measured, from {count_text(len(sources), 'source file')}" if tests else "",
        **{key: which for facts in of_sections for key, which in facts.items() if key != "rig"},
        **{key: _each_condition(values) for key, values in list(conditions.items())[:MOST_CONDITIONS]},
        "pipeline": _each_once(result.pipeline for result in identifications),
        "computed by": _each_once(f"labpipe {result.version}" for result in identifications),
    }
    return tuple((what, which) for what, which in facts.items() if which)


def _each_condition(conditions: Iterable[str]) -> str:
    """Conditions, each once; amounts of one kind by their size, of many the smallest and the largest."""
    each = list(dict.fromkeys(conditions))
    amounts = {text: amount for text in each if (amount := amount_of(text)) is not None}
    if len(amounts) < len(each) or len({unit for _, unit in amounts.values()}) > 1:
        return few(each, MOST_VALUES)
    each.sort(key=amounts.__getitem__)
    return ", ".join(each) if len(each) <= MOST_VALUES else f"{each[0]} to {each[-1]}, {len(each)} values"


def _each_once(texts: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(filter(None, texts)))


def section_facts(identification: Identification) -> list[Mapping[str, str]]:
    """Cover entries of the sections of a result."""
    facts = (section(name).cover(record) for name, record in identification.sections.items())
    return [entry for entry in facts if entry]


def result_blocks(identification: Identification) -> tuple[Block, ...]:
    """What was asked for: every coefficient with its 95 % interval, and the response behind the first.

    The response of a single fit stands here whole, where the rules leave room, and not again with the fit.
    """
    fits = _single_fits(identification)
    rows = [
        (
            fit_title(fit) if number == 0 and len(fits) > 1 else "",
            f"{meaning(parameter)} {parameter.name}".lstrip(),
            *_in_print(parameter, bool(of_level(WARNING, fit.findings))),
            parameter.reason,
        )
        for fit in fits
        for number, parameter in enumerate(fit.parameters)
    ]
    if not rows:
        return ()
    header = ("result of", "coefficient", "value with its 95 % interval", "relative", "why it is so wide")
    # The first page ends with a whole result.
    ends = [n for n in range(1, MOST_RESULTS + 1) if n == len(rows) or (n < len(rows) and rows[n][0])]
    shown = ends[-1] if ends else MOST_RESULTS
    more = f"; {len(rows) - shown} more values further down" if len(rows) > shown else ""
    table = Table(header, tuple(rows[:shown]), f"Results{more}")
    is_alone = len(fits) == 1 and len(rows) + len(identification.outcomes) <= FEW_ROWS
    for fit in fits:
        if fit.curve is not None and len(fit.curve.outputs) * len(fit.curve.inputs) <= MOST_ELEMENTS:
            return (table, _response(fit, fit.curve, is_alone))
    beside = blocks_of_details(fits[0]) if is_alone else []
    charts = [block for block in beside if isinstance(block, Figure) and isinstance(block.graphic, Chart)]
    return (table, *charts[:1])


def _response(fit: Fit, fitted: FittedCurve, is_alone: bool) -> Figure:
    whole = fitted_curve_figure(fit, fitted)
    assert isinstance(whole.graphic, Chart)
    panels = whole.graphic.panels
    if is_alone:
        return replace(whole, graphic=stack(panels, WHOLE_HEIGHT))
    caption = f"Measured (dots) and fitted (lines) response of {fit_title(fit)}."
    amplitude = stack([replace(panels[0], share=1.0, x=panels[-1].x)], FIGURE_HEIGHT)
    return Figure(amplitude, caption, whole.alternative)


def _single_fits(identification: Identification) -> list[Fit]:
    """Fits that are results by themselves: no lines of calibrations, no bands of a sliding fit, and none that
    a matrix of tests sums up.
    """
    if identification.sections.get("matrix"):
        return []
    keys = Counter((fit.name, fit.term, fit.test) for fit in identification.fits)
    single = [fit for fit in identification.fits if keys[fit.name, fit.term, fit.test] == 1]
    return [fit for fit in single if not of_points(fit.model)]


def _in_print(parameter: Parameter, has_warnings: bool) -> tuple[str, str]:
    if parameter.name.endswith("probability"):
        least = parameter.value < LEAST_CHANCE
        return f"< {LEAST_CHANCE:g}" if least else f"{parameter.value:.3g}", ""
    if parameter.ci95 is None:
        unit = shown_unit(parameter.unit, parameter.value)
        none = "no interval, see the warnings" if has_warnings else "no interval"
        why = "at the end of its range" if parameter.at_bound else none
        return f"{with_error(to_display(parameter.value, unit), None, legible(unit))} ({why})", ""
    low, high = parameter.ci95
    half = (high - low) / 2
    unit = shown_unit(parameter.unit, parameter.value, half)
    value, ends = to_display(parameter.value, unit), [to_display(end, unit) for end in parameter.ci95]
    relative = f"± {per_cent(half / abs(parameter.value))}" if parameter.value else ""
    if abs((low + high) / 2 - parameter.value) <= EVEN * half:
        return with_error(value, difference_in(half, unit), legible(unit)), relative
    number, _, *limits = write_values(value, difference_in(half, unit), *ends)
    return f"{number} ({' to '.join(limits)}) {legible(unit)}".rstrip(), relative
