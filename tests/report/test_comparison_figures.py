"""What the figures of comparisons show: every test with its interval, the law, the common value, in the units
people read.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.records.comparison import ComparedPoint, Comparison, Overlay
from labpipe.records.finding import Parameter
from labpipe.records.response import FrequencyResponse, Port
from labpipe.report.chart import Panel, Series
from labpipe.report.comparison import comparison_blocks, comparison_figures
from labpipe.report.document import Table

POINTS = tuple(
    ComparedPoint(
        f"test {n}",
        1e6 * value,
        ci95=(0.9e6 * value, 1.1e6 * value),
        condition=100.0 * n,
        group=way,
        theory=0.8e6 * value,
        ratio=1.25,
        ratio_ci95=(1.2, 1.3),
    )
    for n, value in ((1, 10.0), (2, 20.0), (3, 30.0))
    for way in ("up", "down")
)
AMOUNTS = (
    Parameter("ratio", 1.25, "1", std_error=0.02, ci95=(1.21, 1.29)),
    Parameter("mean", 2e7, "N/m", std_error=1e5, ci95=(1.9e7, 2.1e7)),
    Parameter("within", 1e5, "N/m", ci95=(5e4, 2e5)),
    Parameter("p_value", float("nan"), "1"),
)
OVERLAY = Overlay(
    "test 1", "accelerance", (10.0, 20.0, 30.0), (1.0, 5.0, 1.0), (5.0, 1.0, 0.5), (1.0, 5.1, 1.0)
)
LAW = ((100.0, 1e7), (300.0, 3e7))
BASE = Comparison(
    name="axial",
    kind="trend",
    subject="k of z, fit peaks",
    unit="N/m",
    points=POINTS,
    amounts=AMOUNTS,
    verdict="rising",
    statement="It rises.",
    condition="preload",
    condition_unit="N",
    line=LAW,
)


def panels(comparison: Comparison, number: int = 0) -> tuple[Panel, ...]:
    return comparison_figures(comparison, ())[number].graphic.panels


def named(panel: Panel) -> dict[str, Series]:
    return {series.name: series for series in panel.series}


def test_a_trend_shows_tests_with_bars_and_the_law_in_kilonewtons() -> None:
    (panel,) = panels(BASE)
    assert (panel.x.label, panel.y.label) == ("preload [N]", "k of z [kN/m]")
    tests, law = named(panel)["tests"], named(panel)["fitted law"]
    np.testing.assert_allclose(tests.y, [1e4, 1e4, 2e4, 2e4, 3e4, 3e4])
    np.testing.assert_allclose(law.y, [1e4, 3e4])
    assert tests.interval == "bar" and (tests.x[0], tests.low[0], tests.high[0]) == pytest.approx(
        (100, 0.9e4, 1.1e4)
    )


def test_a_difference_tells_the_groups_apart_and_shows_how_far_they_are() -> None:
    points = tuple(
        replace(point, value=point.value * (1.02 if point.group == "down" else 0.98), ci95=None)
        for point in POINTS
    )
    above, below = panels(replace(BASE, kind="difference", points=points))
    assert list(named(above)) == ["up", "down"]
    np.testing.assert_allclose(named(below)["up"].y, [-2.0] * 3)
    np.testing.assert_allclose(named(below)["down"].y, [2.0] * 3)


def test_repeatability_shows_each_setting_and_the_scatter_within() -> None:
    (panel,) = panels(replace(BASE, kind="repeatability", condition="mounting", condition_unit=""))
    assert panel.x.ticks == ((0.0, "up"), (1.0, "down")) and panel.x.label == "mounting"
    (within,) = (series for series in panel.series if series.kind == "hspan")
    assert within.y == pytest.approx([1.99e4, 2.01e4])


@pytest.mark.parametrize(("kind", "label"), [("ratio", "theory"), ("rayleigh", "Rayleigh damping")])
def test_measured_stands_beside_what_was_predicted(kind: str, label: str) -> None:
    above, below = panels(replace(BASE, kind=kind))
    assert sorted(named(above)) == sorted(["measured", label])
    np.testing.assert_allclose(named(above)[label].y, [0.8e4, 0.8e4, 1.6e4, 1.6e4, 2.4e4, 2.4e4])
    np.testing.assert_allclose(below.series[0].y, 1.25)
    common = [series.y.tolist() for series in below.series if series.kind == "hspan"]
    assert common == ([[1.21, 1.29]] if kind == "ratio" else [])


def test_overlays_draw_the_measured_and_both_theoretical_curves() -> None:
    (panel,) = panels(replace(BASE, kind="ratio", overlays=(OVERLAY,)), 1)
    assert list(named(panel)) == ["measured", "theory", "theory times ratio"]
    assert panel.y.logarithmic and panel.title == "test 1"
    assert named(panel)["theory"].y.tolist() == [5.0, 1.0, 0.5]


def test_tests_without_a_condition_are_numbered() -> None:
    points = tuple(replace(point, condition=None) for point in POINTS)
    (panel,) = panels(
        replace(BASE, points=points, condition="", condition_unit="1", line=((1.0, 1e7), (6.0, 3e7)))
    )
    assert named(panel)["tests"].x.tolist() == [1, 2, 3, 4, 5, 6] and panel.x.label == "test"


def test_reciprocal_pairs_are_drawn_on_each_other() -> None:
    frequency, matrix = np.array([10.0, 20.0]), np.array([[[1.0, 2.0], [3.0, 4.0]]] * 2, complex)
    ports = Port("x", "x", "x"), Port("y", "y", "y")
    response = FrequencyResponse(frequency, matrix, ports, ports, name="test 1")
    pair = replace(
        BASE,
        kind="reciprocity",
        points=(ComparedPoint("test 1", 0.4, group="x-y"), ComparedPoint("elsewhere", 0.1, group="x-y")),
    )
    (figure,) = comparison_figures(pair, (response,))
    shown = named(figure.graphic.panels[0])
    assert shown["x/y"].y.tolist() == [2.0, 2.0] and shown["y/x"].y.tolist() == [3.0, 3.0]
    assert "rms difference 40 %" in figure.caption


def test_a_value_has_the_digits_of_its_interval() -> None:
    """10 MN/m within 4 N/m has a second digit of its error at 0.1 N/m."""
    point = replace(POINTS[0], value=10e6 + 0.4, ci95=(10e6 - 1.6, 10e6 + 2.4), theory=8e6)
    table = next(
        b
        for b in comparison_blocks(replace(BASE, points=(point,)), ())
        if getattr(b, "caption", "") == ("Tests of axial")
    )
    assert isinstance(table, Table)
    row = dict(zip(table.header, table.rows[0], strict=True))
    assert row["value [kN/m]"] == "10000.0004" and row["95 % interval"] == "9999.9984 to 10000.0024"
    assert row["theory"] == "8000.0000"


def test_tables_leave_out_what_no_test_has_and_say_what_was_not_tested() -> None:
    blocks = comparison_blocks(BASE, ())
    amounts, tests = (block for block in blocks if isinstance(block, Table))
    assert amounts.rows[0] == ("ratio", "1.250", "", "0.020", "1.210 to 1.290")
    assert amounts.rows[1][1:3] == ("20.00", "MN/m")
    assert amounts.rows[-1][1] == "not tested"
    assert tests.header[:3] == ("test", "preload [N]", "group")
    assert tests.rows[0][:5] == ("test 1", "100", "up", "10000", "9000 to 11000")
    bare = replace(
        BASE, points=tuple(ComparedPoint(p.test, p.value) for p in POINTS), line=((1.0, 1e7), (6.0, 3e7))
    )
    (_, plain) = (block for block in comparison_blocks(bare, ()) if isinstance(block, Table))
    assert plain.header == ("test", "value [kN/m]")
