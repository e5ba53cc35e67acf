"""What the figures of comparisons show: every test with its interval, the law, the common value, in the units people read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from labpipe.report.drawing import svg_text

from labpipe.records.comparison import ComparedPoint, Comparison, Overlay
from labpipe.records.parameter import Parameter
from labpipe.report.comparison import comparison_blocks
from labpipe.report.comparison_figures import comparison_figures
from labpipe.report.document import Table

POINTS = tuple(
    ComparedPoint(f"test {n}", 1e6 * value, (0.9e6 * value, 1.1e6 * value), 100.0 * n, way, 0.8e6 * value, 1.25, (1.2, 1.3))
    for n, value in ((1, 10.0), (2, 20.0), (3, 30.0))
    for way in ("up", "down")
)
AMOUNTS = (
    Parameter("ratio", 1.25, "1", 0.02, ci95=(1.21, 1.29)),
    Parameter("mean", 2e7, "N/m", 1e5, ci95=(1.9e7, 2.1e7)),
    Parameter("within", 1e5, "N/m", ci95=(5e4, 2e5)),
    Parameter("p_value", float("nan"), "1"),
)
OVERLAY = Overlay("test 1", "accelerance", (10.0, 20.0, 30.0), (1.0, 5.0, 1.0), (5.0, 1.0, 0.5), (1.0, 5.1, 1.0))
LAW = ((100.0, 1e7), (300.0, 3e7))
BASE = Comparison("axial", "trend", "k of z, fit peaks", "N/m", POINTS, AMOUNTS, "rising", "It rises.", "preload", "N", line=LAW)


def panels(comparison: Comparison, number: int = 0):
    return comparison_figures(comparison, ())[number].drawing.axes


def test_a_trend_shows_tests_with_bars_and_the_law_in_kilonewtons() -> None:
    (axes,) = panels(BASE)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("preload [N]", "k of z [kN/m]")
    dots, law = axes.lines[0], axes.lines[-1]
    np.testing.assert_allclose(dots.get_ydata(), [1e4, 1e4, 2e4, 2e4, 3e4, 3e4])
    np.testing.assert_allclose(law.get_ydata(), [1e4, 3e4])
    bars = axes.collections[0].get_segments()
    np.testing.assert_allclose(bars[0], [[100, 0.9e4], [100, 1.1e4]])


def test_a_difference_tells_the_groups_apart_and_shows_how_far_they_are() -> None:
    points = tuple(replace(point, value=point.value * (1.02 if point.group == "down" else 0.98), ci95=None) for point in POINTS)
    above, below = panels(replace(BASE, kind="difference", points=points))
    assert [text.get_text() for text in above.get_legend().get_texts()] == ["up", "down"]
    np.testing.assert_allclose(below.lines[0].get_ydata(), [-2.0] * 3)
    np.testing.assert_allclose(below.lines[1].get_ydata(), [2.0] * 3)


def test_repeatability_shows_each_setting_and_the_scatter_within() -> None:
    (axes,) = panels(replace(BASE, kind="repeatability", condition="mounting", condition_unit=""))
    assert [label.get_text() for label in axes.get_xticklabels()] == ["up", "down"]
    assert axes.get_xlabel() == "mounting"
    low, high = axes.patches[0].get_y(), axes.patches[0].get_y() + axes.patches[0].get_height()
    assert (low, high) == pytest.approx((1.99e4, 2.01e4))


@pytest.mark.parametrize(("kind", "label"), [("ratio", "theory"), ("rayleigh", "Rayleigh damping")])
def test_measured_stands_beside_what_was_predicted(kind: str, label: str) -> None:
    above, below = panels(replace(BASE, kind=kind))
    assert sorted(text.get_text() for text in above.get_legend().get_texts()) == sorted(["measured", label])
    predicted = next(line for line in above.lines if line.get_label() == label)
    np.testing.assert_allclose(predicted.get_ydata(), [0.8e4, 0.8e4, 1.6e4, 1.6e4, 2.4e4, 2.4e4])
    np.testing.assert_allclose(below.lines[0].get_ydata(), 1.25)
    shaded = [patch for patch in below.patches if patch.get_height() == pytest.approx(0.08)]
    assert len(shaded) == (1 if kind == "ratio" else 0)


def test_overlays_draw_the_measured_and_both_theoretical_curves() -> None:
    (axes,) = panels(replace(BASE, kind="ratio", overlays=(OVERLAY,)), 1)
    assert [line.get_label() for line in axes.lines] == ["measured", "theory", "theory times ratio"]
    assert axes.get_yscale() == "log"
    assert axes.get_title() == "test 1"


def test_tests_without_a_condition_are_numbered() -> None:
    points = tuple(replace(point, condition=None) for point in POINTS)
    (axes,) = panels(replace(BASE, points=points, condition="", condition_unit="1", line=((1.0, 1e7), (6.0, 3e7))))
    assert list(axes.lines[0].get_xdata()) == [1, 2, 3, 4, 5, 6]
    assert axes.get_xlabel() == "test"


def test_the_same_comparison_is_drawn_the_same() -> None:
    first, second = (svg_text(comparison_figures(BASE, ())[0].drawing) for _ in range(2))
    assert first == second


def test_tables_leave_out_what_no_test_has_and_say_what_was_not_tested() -> None:
    blocks = comparison_blocks(BASE, ())
    amounts, tests = (block for block in blocks if isinstance(block, Table))
    assert amounts.rows[0] == ("ratio", "1.250", "", "0.02", "1.210 to 1.290")
    assert amounts.rows[1][1:3] == ("20000", "kN/m")
    assert amounts.rows[-1][1] == "not tested"
    assert tests.header[:3] == ("test", "preload [N]", "group")
    assert tests.rows[0][:5] == ("test 1", "100", "up", "10000", "9000 to 11000")
    bare = replace(BASE, points=tuple(ComparedPoint(p.test, p.value) for p in POINTS), line=((1.0, 1e7), (6.0, 3e7)))
    (_, plain) = (block for block in comparison_blocks(bare, ()) if isinstance(block, Table))
    assert plain.header == ("test", "value [kN/m]")
