"""The report of a dataset of results: verdicts by its counts, medians and bands of made-up values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.records.dataset import ManyTests, TestColumns
from labpipe.records.finding import Finding
from labpipe.records.identification import CountedFinding, DatasetIndex, Identification, RuleOutcome
from labpipe.report.document import Document, Figure, Paragraph, Table
from labpipe.report.many_tests import many_tests_document, over_amount

HOLDS, FAILS = RuleOutcome("accept", "a.k: >= 1", 2.0, True), RuleOutcome("accept", "a.c: >= 1", 0.5, False)


def columns(values: np.ndarray, preload: np.ndarray) -> TestColumns:
    """Stiffnesses [N/m] of errors of 2 N/m over a preload [N]."""
    names = tuple(f"t{n}" for n in range(values.size))
    return TestColumns(
        "direct",
        "",
        "k",
        "N/m",
        tests=names,
        dates=("2026-01-01",) * len(names),
        values=values,
        errors=np.full(values.size, 2.0),
        low=values - 4,
        high=values + 4,
        amounts={"preload": ("N", preload)},
    )


def document(index: DatasetIndex, *outcomes: RuleOutcome, tests: ManyTests | None = None) -> Document:
    result = Identification((), "Many", outcomes=outcomes, dataset=index, version="1")
    return many_tests_document(result, tests or ManyTests(()))


def said(shown: Document, heading: str) -> list[tuple[str, str]]:
    (section,) = (section for section in shown.sections if section.heading == heading)
    return [(block.text, block.kind) for block in section.blocks if isinstance(block, Paragraph)]


@pytest.mark.parametrize(
    ("index", "outcomes", "first"),
    [
        (
            DatasetIndex(tests=7, failed=2),
            (HOLDS,),
            ("INCOMPLETE: 2 of 9 tests could not be evaluated.", "failed"),
        ),
        (
            DatasetIndex(tests=7, not_accepted=3),
            (HOLDS, FAILS),
            (
                "NOT ACCEPTED: 1 of 2 rules do not hold for every test; 3 of 7 tests are not accepted.",
                "failed",
            ),
        ),
        (DatasetIndex(tests=7), (HOLDS,), ("ACCEPTED: the one rule holds for all 7 tests.", "passed")),
        (
            DatasetIndex(tests=7),
            (),
            ("No acceptance rules were given, so nothing is accepted or refused.", "note"),
        ),
    ],
)
def test_the_verdict_is_that_of_the_counts(
    index: DatasetIndex, outcomes: tuple[RuleOutcome, ...], first: tuple[str, str]
) -> None:
    shown = document(index, *outcomes)
    assert said(shown, "Verdict")[0] == first
    assert said(shown, "Warnings") == [("None in any test.", "passed")]
    assert shown.subtitle == f"Report of {index.tests + index.failed} tests, labpipe 1"


def test_the_bands_of_a_fit_are_told_apart() -> None:
    low, high = (replace(columns(np.arange(3.0), np.arange(3.0)), band=band) for band in ("1-2 Hz", "2-3 Hz"))
    shown = document(DatasetIndex(tests=3), tests=ManyTests((low, replace(high, term="x"))))
    assert [section.heading for section in shown.sections if "direct" in section.heading] == [
        "k of direct 1-2 Hz",
        "k of direct of x 2-3 Hz",
    ]


def test_a_warning_of_several_tests_stands_once_and_limits_the_acceptance() -> None:
    index = DatasetIndex(tests=7, findings=(CountedFinding(Finding("drift", "k fell"), "t1", 3),))
    shown = document(index, HOLDS)
    assert said(shown, "Verdict")[0][0].startswith(
        "ACCEPTED: the one rule holds for all 7 tests. 1 kind of warning"
    )
    assert said(shown, "Warnings") == [("drift: t1 (3 tests in all; this is the first): k fell", "warning")]


def test_tests_without_a_result_are_named_with_their_number() -> None:
    failed, refused = (
        (("t8", "preload 1 N", "no peak"),),
        (("t1", "preload 2 N", "drift"), ("t2", "preload 1 N", "")),
    )
    index = DatasetIndex(tests=7, failed=1, not_accepted=5)
    shown = document(index, FAILS, tests=ManyTests((), failed, refused))
    (first, second) = (
        block for section in shown.sections[2:4] for block in section.blocks if isinstance(block, Table)
    )
    assert first.caption == "Tests that could not be evaluated" and first.rows == failed
    assert second.caption == "Tests that are not accepted; the first 2 of 5" and second.rows == refused


def test_a_test_that_is_not_accepted_says_what_was_found() -> None:
    """Of the coefficient of a rule that fails, with its standard error of 2 N/m."""
    made = columns(np.array([18.3e3, 15.0e3, np.nan]), np.arange(3.0))
    other = replace(made, parameter="c", unit="N.s/m")
    refused = (("t1", "preload 2 N", ""), ("t2", "preload 1 N", "drift"))
    outcomes = (replace(FAILS, rule="direct.k >= 16 kN/m"), replace(HOLDS, rule="direct.c <= 20 kN.s/m"))
    tests = ManyTests((made, other), (), refused)
    shown = document(DatasetIndex(tests=3, not_accepted=2), *outcomes, tests=tests)
    (table,) = (block for block in shown.sections[2].blocks if isinstance(block, Table))
    assert table.header == ("test", "conditions", "found", "warnings")
    assert [row[2] for row in table.rows] == ["k 15.0000 ± 0.0020 kN/m", ""]


def test_a_row_has_median_scatter_and_ends_with_their_tests() -> None:
    """18, 18.1, 18.2, 18.3 and 30 kN/m: the median distance from 18.2 is .1, times 1.4826."""
    made = columns(np.array([18.3e3, 18.0e3, 30.0e3, 18.1e3, np.nan, 18.2e3]), np.arange(6.0))
    shown = document(DatasetIndex(tests=6), tests=ManyTests((made,)))
    (table,) = (block for block in shown.sections[2].blocks if isinstance(block, Table))
    (row,) = table.rows
    assert row[:3] == ("k of direct", "kN/m", "5") and (row[7], row[9]) == ("t1", "t2")
    numbers = [float(text) for text in (*row[3:7], row[8])]
    assert numbers == pytest.approx([18.2, 0.15, 0.002, 18.0, 30.0])
    nothing = document(DatasetIndex(tests=1), tests=ManyTests((columns(np.array([np.nan]), np.zeros(1)),)))
    assert "0 values; figures need 3." in said(nothing, "k of direct")[0][0]


def test_few_tests_are_points_with_their_intervals() -> None:
    made = columns(1e3 + np.arange(5.0), np.arange(5.0))
    (points,) = over_amount(made, "preload").graphic.panels[0].series
    np.testing.assert_allclose([points.x, points.y], [np.arange(5.0), 1 + 1e-3 * np.arange(5.0)])
    np.testing.assert_allclose(points.high - points.y, 0.004)
    np.testing.assert_allclose(points.y - points.low, 0.004)


def test_many_tests_are_medians_and_bands_of_groups() -> None:
    """Four preloads, 101 stiffnesses each, 0 to 100 times 1, 2, 3 and 4 N/m in any order: a quarter lies
    below 25, a fortieth below 2.5, and three at either end beyond the bands.
    """
    order = np.random.default_rng(1).permutation(404)
    size, preload = np.tile(np.arange(101.0), 4)[order], np.repeat([1.0, 2.0, 3.0, 4.0], 101)[order]
    shown = over_amount(columns(1e3 * preload * size, preload), "preload")
    outer, inner, beyond = shown.graphic.panels[0].series
    group = np.arange(1.0, 5.0)
    unit = {"kN/m": 1.0, "N/m": 1e3}[shown.graphic.panels[0].y.unit]
    for series, low, high in ((outer, 2.5, 97.5), (inner, 25.0, 75.0)):
        np.testing.assert_allclose([series.x, series.y], [group, 50 * group * unit])
        np.testing.assert_allclose([series.low, series.high], np.outer([low, high], group * unit))
    assert sorted(beyond.y / beyond.x / unit) == pytest.approx(np.repeat([0, 1, 2, 98, 99, 100], 4))
    assert "shaded: half and 95 % of the tests" in shown.caption
    # Of more preloads sixty groups of neighbours, the first of seven, 0 to 6 N.
    neighbours = over_amount(columns(1e3 + size, np.arange(404.0)), "preload").graphic.panels[0].series[0]
    assert neighbours.x.size == 60 and neighbours.x[0] == pytest.approx(3.0)
    # Of 180 points beyond the bands the hundred furthest: all of 0 and 100, then those of 1 and 99.
    preload = np.repeat(np.arange(1.0, 31.0), 101)
    made = columns(preload * np.tile(np.arange(101.0), 30), preload)
    beyond = over_amount(made, "preload").graphic.panels[0].series[2]
    places, counts = np.unique(np.round(beyond.y / beyond.x / beyond.y.max() * 3000), return_counts=True)
    assert places.tolist() == [0, 1, 99, 100] and counts[[0, 3]].tolist() == [30, 30] and counts.sum() == 100


def test_a_condition_of_one_value_is_no_abscissa_and_values_outside_are_named() -> None:
    """Twenty alike, one ten times their scatter away, and one test without a value."""
    values = np.append(1e3 + np.tile([-1.0, 1.0], 10), [1.03e3, np.nan])
    made = columns(values, np.full(22, 5.0))
    made = replace(made, amounts={**made.amounts, "speed": ("Hz", np.arange(22.0))})
    shown = document(DatasetIndex(tests=21), tests=ManyTests((made,)))
    (section,) = (section for section in shown.sections if section.heading == "k of direct")
    figures = [block.caption for block in section.blocks if isinstance(block, Figure)]
    assert [caption.partition(",")[0] for caption in figures] == [
        "k of direct by date and name",
        "k of direct over speed",
    ]
    assert "1 of 21 values lie outside: t20" in said(shown, "k of direct")[0][0]
