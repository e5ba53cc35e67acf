"""The report of so many tests that their results are a dataset: what holds for all, which tests do not."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import FloatArray
from labpipe.display import amount_text, count_text, difference_in, two_digits, write_values
from labpipe.quantities import readable_unit, to_display
from labpipe.records.dataset import ManyTests, TestColumns
from labpipe.records.finding import NOTE
from labpipe.records.identification import DatasetIndex, Identification, RuleOutcome
from labpipe.registry import few
from labpipe.report.build import SHOWN_SETTINGS, rig_blocks
from labpipe.report.chart import CONTROL, Axis, Panel, Series, control_lines, curve, dots, stack
from labpipe.report.cover import all_hold, rule_blocks
from labpipe.report.document import Block, Code, Document, Figure, Paragraph, Section, Table
from labpipe.report.wording import legible
from labpipe.uncertainty.weighted import ControlLimits, control_limits

Points = tuple[FloatArray, FloatArray]
HEIGHT = 2.6
# Points that are drawn one by one, with their intervals.
MOST_POINTS = 300
# Groups of neighbouring tests, each with its median and bands, where there are more.
GROUPS = 60
# Ends of the bands, as shares of the tests.
OUTER, INNER = (0.025, 0.975), (0.25, 0.75)
# Points beyond the outer band that are drawn all the same, the furthest first.
MOST_BEYOND = 100
BANDS = "shaded: half and 95 % of the tests"


def over_tests(columns: TestColumns, limits: ControlLimits) -> Figure:
    """The values in the order of dates and names, with centre and control limits."""
    there = np.isfinite(columns.values)
    values, unit = _in_unit(columns, columns.values[there])
    ends = _in_unit(columns, np.array([limits.centre, limits.low, limits.high]))[0]
    drawn, how = _draw(np.arange(1.0, values.size + 1), values, columns, there)
    panel = Panel(
        Axis("tests by date and name"),
        Axis(columns.parameter, legible(unit)),
        (*drawn, *control_lines(*ends.tolist())),
    )
    caption = f"{columns.title} by date and name{how}; {CONTROL}."
    alternative = f"{columns.title} in {values.size} tests, {len(limits.outside)} outside the control limits"
    return Figure(stack([panel], HEIGHT), caption, alternative)


def over_amount(columns: TestColumns, condition: str) -> Figure:
    unit, amounts = columns.amounts[condition]
    there = np.isfinite(columns.values) & np.isfinite(amounts)
    values, shown = _in_unit(columns, columns.values[there])
    below = readable_unit(unit, amounts[there])
    x = np.array([to_display(amount, below) for amount in amounts[there]])
    drawn, how = _draw(x, values, columns, there)
    panel = Panel(Axis(condition, legible(below)), Axis(columns.parameter, legible(shown)), drawn)
    alternative = f"{columns.title} of {values.size} tests over {condition}"
    return Figure(stack([panel], HEIGHT), f"{columns.title} over {condition}{how}.", alternative)


def _in_unit(columns: TestColumns, values: FloatArray) -> tuple[FloatArray, str]:
    unit = readable_unit(columns.unit, columns.values)
    return np.array([to_display(value, unit) for value in values]), unit


def _draw(
    x: FloatArray, values: FloatArray, columns: TestColumns, there: NDArray[np.bool_]
) -> tuple[tuple[Series, ...], str]:
    if values.size <= MOST_POINTS:
        low, high = (_in_unit(columns, end[there])[0] for end in (columns.low, columns.high))
        return (dots("tests", x, values, size=3.0, bars=(low, high)),), ", with 95 % intervals"
    order = np.argsort(x, kind="stable")
    groups = _groups(x[order])
    middle = np.array([np.median(x[order][group]) for group in groups])
    shares = [np.quantile(values[order][group], (*OUTER, 0.5, *INNER)) for group in groups]
    below, above, median, lower, upper = np.array(shares).T
    beyond = _furthest(x[order], values[order], groups, below, above)
    outer = curve("95 % of the tests", middle, median, 0, "", band=(below, above), opacity=0.15)
    inner = curve(
        "median and half of the tests", middle, median, band=(lower, upper), marker=".", opacity=0.3
    )
    return (outer, inner, dots("beyond", *beyond, 1, size=3.0)), f", {BANDS}"


def _groups(x: FloatArray) -> list[FloatArray]:
    """Places of neighbouring abscissas, ascending: one group for each where they are few, else groups of
    equal size.
    """
    _, first = np.unique(x, return_index=True)
    if first.size <= GROUPS:
        return np.split(np.arange(x.size), first[1:])
    return np.array_split(np.arange(x.size), GROUPS)


def _furthest(
    x: FloatArray, values: FloatArray, groups: list[FloatArray], low: FloatArray, high: FloatArray
) -> Points:
    number = np.repeat(np.arange(len(groups)), [group.size for group in groups])
    width = np.maximum(high - low, np.finfo(float).tiny)[number]
    distance = np.maximum(low[number] - values, values - high[number]) / width
    furthest = np.argsort(-distance, kind="stable")[:MOST_BEYOND]
    kept = np.sort(furthest[distance[furthest] > 0])
    return x[kept], values[kept]


# Coefficients with figures; of more, those that come first.
MOST_CHARTED = 24
FEWEST = 3
# Value and error of a test without them.
NOTHING = np.nan, np.nan
# Of the standard deviation of normal values: the scale of their median absolute deviation.
NORMAL_MAD = 1.4826
MOST_OUTSIDE = 10
HEADER = (
    "coefficient", "unit", "tests", "median", "scatter", "median std. error", "least", "in test", "largest",
    "in test",
)  # fmt: skip
CAPTION = (
    "Every coefficient over all tests; scatter: 1.4826 times the median distance from the median, which "
    "outliers do not widen"
)


def many_tests_document(identification: Identification, tests: ManyTests) -> Document:
    """The report of a result whose tests stand in a dataset; pages of one test are drawn on demand."""
    index = identification.dataset
    assert index is not None
    charted = tests.parameters[:MOST_CHARTED]
    coefficients = Table(HEADER, tuple(map(_row, tests.parameters)), CAPTION, (2, 3, 4, 5, 6, 8))
    n_value = sum(int(np.sum(np.isfinite(columns.values))) for columns in charted)
    sections = (
        Section("Verdict", _verdict(identification, index)),
        Section("Warnings", _findings(index)),
        *_which(tests, identification.outcomes, index),
        Section("Coefficients", (coefficients, *_left_out(tests.parameters))),
        *(Section(columns.title, _blocks(columns, n_value)) for columns in charted),
        Section("Rig", rig_blocks(identification)),
        Section("Provenance", _provenance(identification)),
    )
    subtitle = f"Report of {index.tests + index.failed} tests, labpipe {identification.version}"
    dates = sorted(
        {date for columns in tests.parameters for date in (*columns.dates[:1], *columns.dates[-1:])}
    )
    parts = f" in {count_text(len(identification.inputs), 'file')}" if identification.inputs else ""
    facts = {
        "rig": str(identification.rig.get("name", "")),
        "recorded": " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "",
        "tests": f"{index.tests} evaluated" + (f", {index.failed} failed" if index.failed else ""),
        "results": f"{index.rows} rows{parts} below dataset/",
        "pipeline": identification.pipeline,
        "computed by": f"labpipe {identification.version}",
    }
    return Document(
        identification.title,
        subtitle,
        sections,
        tuple((what, which) for what, which in facts.items() if which),
    )


def _verdict(identification: Identification, index: DatasetIndex) -> tuple[Block, ...]:
    blocks: list[Block] = []
    outcomes, n = identification.outcomes, index.tests
    if index.failed:
        text = f"INCOMPLETE: {index.failed} of {n + index.failed} tests could not be evaluated."
        blocks.append(Paragraph(text, "failed"))
    if not outcomes:
        blocks.append(Paragraph("No acceptance rules were given, so nothing is accepted or refused.", "note"))
        return tuple(blocks)
    failing = sum(not outcome.passed for outcome in outcomes)
    if failing:
        what = f"{failing} of {len(outcomes)} rules do not hold for every test"
        text = f"NOT ACCEPTED: {what}; {index.not_accepted} of {n} tests are not accepted."
        blocks.append(Paragraph(text, "failed"))
    elif not index.failed:
        kinds = len(index.of_level())
        limit = "of warning below: what limits how far some numbers can be trusted."
        text = f"ACCEPTED: {all_hold(outcomes)} for all {n} tests."
        blocks.append(Paragraph(f"{text} {count_text(kinds, 'kind')} {limit}" if kinds else text, "passed"))
    return (*blocks, *rule_blocks(outcomes, "; found: in the first test that fails, else in the first test"))


def _findings(index: DatasetIndex) -> tuple[Block, ...]:
    warnings = [Paragraph(counted.message, "warning") for counted in index.of_level()]
    notes = [Paragraph(counted.message, "note") for counted in index.of_level(NOTE)]
    return (*(warnings or [Paragraph("None in any test.", "passed")]), *notes)


def _which(tests: ManyTests, outcomes: Sequence[RuleOutcome], index: DatasetIndex) -> tuple[Section, ...]:
    broken = {outcome.rule.split()[0] for outcome in outcomes if not outcome.passed}
    judged = [of for of in tests.parameters if f"{of.fit}.{of.parameter}" in broken and not of.term]
    values = [(of, dict(zip(of.tests, zip(of.values, of.errors, strict=True), strict=True))) for of in judged]

    def values_of(test: str) -> str:
        shown = ((of, *by_test[test]) for of, by_test in values if np.isfinite(by_test.get(test, NOTHING)[0]))
        return "; ".join(
            f"{of.parameter} {amount_text(value, error if np.isfinite(error) else None, of.unit)}"
            for of, value, error in shown
        )

    not_accepted = tuple((test, where, values_of(test), said) for test, where, said in tests.not_accepted)
    sections = []
    for heading, named, count, why in (
        ("Tests that could not be evaluated", tests.failed, index.failed, ("why",)),
        ("Tests that are not accepted", not_accepted, index.not_accepted, ("found", "warnings")),
    ):
        if named:
            more = f"; the first {len(named)} of {count}" if count > len(named) else ""
            table = Table(("test", "conditions", *why), named, f"{heading}{more}")
            pages = Paragraph("The pages of one test: labpipe report DIR --test NAME -o FILE.")
            sections.append(Section(heading, (table, pages)))
    return tuple(sections)


def _row(columns: TestColumns) -> tuple[str, ...]:
    values, unit = _in_unit(columns, columns.values)
    there = np.flatnonzero(np.isfinite(values))
    if not there.size:
        return (columns.title, legible(unit), "0", *("" for _ in range(7)))
    middle = float(np.median(values[there]))
    scatter = NORMAL_MAD * float(np.median(np.abs(values[there] - middle)))
    least, largest = there[np.argmin(values[there])], there[np.argmax(values[there])]
    middle_text, scatter_text, low, high = write_values(
        middle, scatter or None, float(values[least]), float(values[largest])
    )
    errors = columns.errors[np.isfinite(columns.errors)]
    error = two_digits(difference_in(float(np.median(errors)), unit), middle) if errors.size else ""
    ends = (low, columns.tests[least], high, columns.tests[largest])
    return (columns.title, legible(unit), str(there.size), middle_text, scatter_text, error, *ends)


def _left_out(parameters: Sequence[TestColumns]) -> tuple[Block, ...]:
    if len(parameters) <= MOST_CHARTED:
        return ()
    which = f"the first {MOST_CHARTED} of {len(parameters)} coefficients"
    return (Paragraph(f"Figures follow for {which}; the dataset has them all.", "note"),)


def _blocks(columns: TestColumns, n_value: int) -> tuple[Block, ...]:
    there = np.isfinite(columns.values)
    n = int(np.sum(there))
    if n < FEWEST:
        return (Paragraph(f"{count_text(n, 'value')}; figures need {FEWEST}.", "note"),)
    limits = control_limits(columns.values[there], n_value)
    outside = np.array(columns.tests)[there][list(limits.outside)].tolist()
    which = "no value lies outside"
    if outside:
        which = f"{len(outside)} of {n} values lie outside: {few(outside, MOST_OUTSIDE)}"
    control = f"{limits.formula}; {which}. The limits suppose that all tests are of one condition."
    differing = (
        name
        for name, (_, amounts) in columns.amounts.items()
        if np.unique(amounts[np.isfinite(amounts)]).size > 1
    )
    return (
        Paragraph(control, "warning" if outside else "note"),
        over_tests(columns, limits),
        *(over_amount(columns, name) for name in differing),
    )


def _provenance(identification: Identification) -> tuple[Block, ...]:
    rows = tuple((part["path"], part["sha256"]) for part in identification.inputs)
    settings = {key: value for key, value in identification.settings.items() if key in SHOWN_SETTINGS}
    words = "Every row of the dataset carries the digest of the recordings that it comes from. To repeat:"
    repeat = f"labpipe {identification.version}, `labpipe run {identification.pipeline} -o DIR`, with"
    return (
        *([Table(("part of the dataset", "SHA-256"), rows, "Results")] if rows else []),
        Paragraph(f"{words} {repeat} the settings that identification.json states."),
        Paragraph("Settings in SI units (Hz, s, m, N, rad):"),
        Code(json.dumps(settings, indent=1)),
    )
