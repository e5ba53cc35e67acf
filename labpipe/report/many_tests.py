"""The report of so many tests that their results are a dataset: what holds for all, which tests do not, and every coefficient over them."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from labpipe.campaign.control import control_limits
from labpipe.display import number, unit_label, written
from labpipe.quantities import readable_unit, to_display
from labpipe.records.dataset_index import DatasetIndex
from labpipe.records.finding import NOTE
from labpipe.records.identification import Identification
from labpipe.records.test_columns import ManyTests, TestColumns
from labpipe.report.document import Block, Code, Document, Paragraph, Section, Table
from labpipe.report.many_tests_figures import over_amount, over_tests
from labpipe.report.provenance import SHOWN_SETTINGS, rig_blocks

# Coefficients with figures; of more, those that come first.
MOST_CHARTED = 24
FEWEST = 3
# Of the standard deviation of normal values: the scale of their median absolute deviation.
NORMAL_MAD = 1.4826
MOST_OUTSIDE = 10
CHART = "Individuals (Shewhart) chart, mean ∓ 3 × mean moving range / 1.128"


def many_tests_document(identification: Identification, tests: ManyTests) -> Document:
    """The report of a result whose tests stand in a dataset; pages of one test are drawn on demand."""
    index = identification.dataset
    assert index is not None
    charted = tests.parameters[:MOST_CHARTED]
    sections = (
        Section("Verdict", _verdict(identification, index)),
        Section("Warnings", _findings(index)),
        *_which(tests, index),
        Section("Coefficients", (_coefficients(tests.parameters), *_left_out(tests.parameters))),
        *(Section(columns.title, _blocks(columns)) for columns in charted),
        Section("Rig", rig_blocks(identification)),
        Section("Provenance", _provenance(identification)),
    )
    subtitle = f"Report of {index.tests + index.failed} tests, labpipe {identification.version}"
    return Document(identification.title, subtitle, sections, _cover(identification, index, tests))


def _cover(identification: Identification, index: DatasetIndex, tests: ManyTests) -> tuple[tuple[str, str], ...]:
    dates = sorted({date for columns in tests.parameters for date in (*columns.dates[:1], *columns.dates[-1:])})
    facts = {
        "rig": str(identification.rig.get("name", "")),
        "recorded": " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "",
        "tests": f"{index.tests} evaluated" + (f", {index.failed} failed" if index.failed else ""),
        "results": f"{index.rows} rows in {len(identification.inputs)} file(s) below dataset/",
        "pipeline": identification.pipeline,
        "computed by": f"labpipe {identification.version}",
    }
    return tuple((what, which) for what, which in facts.items() if which)


def _verdict(identification: Identification, index: DatasetIndex) -> tuple[Block, ...]:
    """Whether all tests were evaluated and every rule holds for each of them."""
    blocks: list[Block] = []
    if index.failed:
        blocks.append(Paragraph(f"INCOMPLETE: {index.failed} of {index.tests + index.failed} tests could not be evaluated.", "failed"))
    outcomes = identification.outcomes
    failing = sum(not outcome.passed for outcome in outcomes)
    if not outcomes:
        blocks.append(Paragraph("No acceptance rules were given, so nothing is accepted or refused.", "note"))
    elif failing:
        what = f"{failing} of {len(outcomes)} rules do not hold for every test"
        blocks.append(Paragraph(f"NOT ACCEPTED: {what}; {index.not_accepted} of {index.tests} tests are not accepted.", "failed"))
    elif not index.failed:
        kinds = len(index.of_level())
        doubt = f" {kinds} kind(s) of warning below limit how far some numbers can be trusted." if kinds else ""
        blocks.append(Paragraph(f"ACCEPTED: all {len(outcomes)} rules hold for all {index.tests} tests.{doubt}", "passed"))
    rows = tuple((outcome.section, outcome.rule, outcome.found, "holds" if outcome.passed else "FAILS") for outcome in outcomes)
    caption = "Rules of the pipeline; found: in the first test that fails, else in the first test"
    return (*blocks, Table(("section", "rule", "found", "outcome"), rows, caption)) if rows else tuple(blocks)


def _findings(index: DatasetIndex) -> tuple[Block, ...]:
    """Each kind of warning once, with the number of tests that have it; then the kinds of notes."""
    warnings = [Paragraph(counted.message, "warning") for counted in index.of_level()]
    notes = [Paragraph(counted.message, "note") for counted in index.of_level(NOTE)]
    return (*(warnings or [Paragraph("None in any test.", "passed")]), *notes)


def _which(tests: ManyTests, index: DatasetIndex) -> tuple[Section, ...]:
    """The tests that failed and those that were not accepted, by name."""
    sections = []
    for heading, named, count, why in (
        ("Tests that could not be evaluated", tests.failed, index.failed, "why"),
        ("Tests that are not accepted", tests.not_accepted, index.not_accepted, "warnings"),
    ):
        if named:
            more = f"; the first {len(named)} of {count}" if count > len(named) else ""
            table = Table(("test", "conditions", why), named, f"{heading}{more}")
            sections.append(Section(heading, (table, Paragraph("The pages of one test: labpipe report DIR --test NAME -o FILE."))))
    return tuple(sections)


def _coefficients(parameters: Sequence[TestColumns]) -> Table:
    """Centre, scatter and extremes of every coefficient."""
    header = ("coefficient", "unit", "tests", "median", "scatter", "median std. error", "least", "in test", "largest", "in test")
    return Table(header, tuple(_row(columns) for columns in parameters), SCATTER, (2, 3, 4, 5, 6, 8))


SCATTER = "Every coefficient over all tests; scatter: 1.4826 times the median distance from the median, which outliers do not widen"


def _row(columns: TestColumns) -> tuple[str, ...]:
    unit = readable_unit(columns.unit, columns.values)
    values = np.array([to_display(value, unit) for value in columns.values])
    scale = to_display(1.0, unit) - to_display(0.0, unit)
    there = np.flatnonzero(np.isfinite(values))
    if not there.size:
        return (columns.title, unit_label(unit), "0", *("" for _ in range(7)))
    middle = float(np.median(values[there]))
    scatter = NORMAL_MAD * float(np.median(np.abs(values[there] - middle)))
    least, largest = there[np.argmin(values[there])], there[np.argmax(values[there])]
    middle_text, scatter_text, low, high = written(middle, scatter or None, float(values[least]), float(values[largest]))
    errors = columns.errors[np.isfinite(columns.errors)]
    error = number(float(np.median(errors)) * scale, 2) if errors.size else ""
    ends = (low, columns.tests[least], high, columns.tests[largest])
    return (columns.title, unit_label(unit), str(there.size), middle_text, scatter_text, error, *ends)


def _left_out(parameters: Sequence[TestColumns]) -> tuple[Block, ...]:
    if len(parameters) <= MOST_CHARTED:
        return ()
    return (Paragraph(f"Figures follow for the first {MOST_CHARTED} of {len(parameters)} coefficients; the dataset has them all.", "note"),)


def _blocks(columns: TestColumns) -> tuple[Block, ...]:
    """The coefficient over the tests by date with its control limits, and over every condition that differs."""
    there = np.isfinite(columns.values)
    if np.sum(there) < FEWEST:
        return (Paragraph(f"{int(np.sum(there))} value(s); figures need {FEWEST}.", "note"),)
    limits = control_limits(columns.values[there])
    outside = np.array(columns.tests)[there][list(limits.outside)].tolist()
    return (_control(columns, outside), over_tests(columns, limits), *(over_amount(columns, name) for name in _differing(columns)))


def _control(columns: TestColumns, outside: Sequence[str]) -> Paragraph:
    """The control chart in words."""
    said = "No value lies outside"
    if outside:
        more = f" and {len(outside) - MOST_OUTSIDE} more" if len(outside) > MOST_OUTSIDE else ""
        said = f"{len(outside)} of {len(columns.tests)} values lie outside: {', '.join(outside[:MOST_OUTSIDE])}{more}"
    return Paragraph(f"{CHART}: {said}. The limits suppose that all tests are of one condition.", "warning" if outside else "note")


def _differing(columns: TestColumns) -> list[str]:
    """The conditions with two amounts or more."""
    return [name for name, (_, amounts) in columns.amounts.items() if np.unique(amounts[np.isfinite(amounts)]).size > 1]


def _provenance(identification: Identification) -> tuple[Block, ...]:
    rows = tuple((part["path"], part["sha256"]) for part in identification.inputs)
    settings = {key: value for key, value in identification.settings.items() if key in SHOWN_SETTINGS}
    words = "Every row of the dataset carries the digest of the recordings that it comes from."
    return (
        Table(("part of the dataset", "SHA-256"), rows, "Results"),
        Paragraph(f"{words} To repeat: labpipe {identification.version}, `labpipe run {identification.pipeline} -o DIR`."),
        Paragraph("Settings in SI units (Hz, s, m, N, rad):"),
        Code(json.dumps(settings, indent=1)),
    )
