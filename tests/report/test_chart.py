"""Charts as numbers: what they refuse, what their axes show, and which axes move together."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.report.chart import (
    GREY,
    Axis,
    Chart,
    Panel,
    Series,
    arrow,
    cells,
    curve,
    dots,
    level,
    look,
    named_ticks,
    outline,
    span,
    stack,
    upright,
)

X = [1.0, 2.0, 4.0]
PLAIN = Axis("speed", "rpm"), Axis("k", "kN/m")


def panel(*series: Series, x: Axis = PLAIN[0], y: Axis = PLAIN[1]) -> Panel:
    return Panel(x, y, series)


def test_an_axis_says_title_and_unit() -> None:
    assert PLAIN[1].label == "k [kN/m]" and Axis("coherence").label == "coherence"


def test_a_series_keeps_its_own_numbers() -> None:
    values = np.array([1.0, 4.0, 16.0])
    series = curve("k", X, values, band=(values - 1, values + 1))
    values[0] = 9.0
    assert (
        series.y.tolist() == [1.0, 4.0, 16.0]
        and series.low is not None
        and series.low.tolist() == [0.0, 3.0, 15.0]
    )
    with pytest.raises(ValueError, match="read-only"):
        series.y[0] = 2.0


@pytest.mark.parametrize(
    ("kind", "x", "y", "more", "message"),
    [
        ("pie", X, X, {}, "no series of kind 'pie'"),
        ("line", X, X[:2], {}, r"\(3,\) over \(2,\)"),
        ("line", X, X, {"low": X}, "both ends"),
        ("line", X, X, {"low": X[:2], "high": X[:2]}, "as long as its values"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    kind: str, x: list[float], y: list[float], more: dict[str, list[float]], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Series(
            kind,
            "k",
            x=np.array(x),
            y=np.array(y),
            **{name: np.array(values) for name, values in more.items()},
        )
    with pytest.raises(ValueError, match="2 panels in 1 x 1"):
        Chart((panel(), panel()))


def test_limits_hold_all_values_their_intervals_and_a_twentieth_more() -> None:
    chart = stack(
        [panel(curve("k", X, [1.0, np.nan, 9.0], bars=([0.0, 0.0, 8.0], [2.0, 0.0, 10.0])), level(-10.0))],
        3.0,
    )
    assert chart.limits(0, "x") == pytest.approx((0.85, 4.15))
    assert chart.limits(0, "y") == pytest.approx((-11.0, 11.0))


def test_limits_of_a_logarithmic_axis_leave_out_what_it_has_no_place_for() -> None:
    y = Axis("|H|", "um/N", logarithmic=True)
    chart = stack([panel(curve("H", X, [0.0, 1.0, 100.0]), y=y)], 3.0)
    assert chart.limits(0, "y") == pytest.approx((10**-0.1, 10**2.1))
    assert stack([panel(curve("H", X, [5.0] * 3), y=y)], 3.0).limits(0, "y") == pytest.approx((0.5, 50.0))
    assert stack([panel(y=y)], 3.0).limits(0, "y") == (1.0, 10.0)


def test_limits_of_one_value_of_none_and_as_stated() -> None:
    assert stack([panel(dots("k", [1.0], [2.0]))], 3.0).limits(0, "y") == pytest.approx((1.9, 2.1))
    assert stack([panel(dots("k", [1.0], [0.0]))], 3.0).limits(0, "y") == pytest.approx((-0.05, 0.05))
    assert stack([panel()], 3.0).limits(0, "y") == (0.0, 1.0)
    low = stack([panel(curve("k", X, X), y=Axis("k", "", low=0.0))], 3.0)
    assert low.limits(0, "y") == pytest.approx((0.0, 4.15))
    assert stack([panel(curve("k", X, X), y=Axis("k", "", -1.0, 7.0))], 3.0).limits(0, "y") == (-1.0, 7.0)


def test_panels_over_one_abscissa_share_its_limits_and_alone_they_do_not() -> None:
    near, far = (
        panel(curve("k", [0.0, 1.0], [0.0, 1.0])),
        panel(curve("c", [9.0, 10.0], [5.0, 6.0]), upright(20.0)),
    )
    together, apart = stack([near, far], 4.0), Chart((near, far), 1, 2)
    assert together.limits(0, "x") == together.limits(1, "x") == pytest.approx((-1.0, 21.0))
    assert together.limits(0, "y") == pytest.approx((-0.05, 1.05))
    assert [together.group(1, which) for which in "xy"] == [0, 1] and [
        apart.group(1, which) for which in "xy"
    ] == [1, 1]
    assert apart.limits(0, "x") == pytest.approx((-0.05, 1.05)) and stack([near], 3.0).shared == ""


def test_heights_are_parts_of_the_whole_row_by_row() -> None:
    high, flat = Panel(*PLAIN, (), share=3.0), Panel(*PLAIN, (), share=1.0)
    assert stack([high, flat], 4.0).heights == (0.75, 0.25)
    assert Chart((high, high, flat), 2, 2).heights == (0.75, 0.25)


def test_cells_have_their_edges_and_their_first_row_above() -> None:
    matrix = cells([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0]], [["a", "b", "c"], ["d", "e", "f"]])
    chart = Chart((Panel(Axis(ticks=named_ticks("xyz")), Axis(), (matrix,)),))
    assert chart.limits(0, "x") == (-0.5, 2.5) and chart.limits(0, "y") == (1.5, -0.5)
    assert chart.panels[0].x.ticks == ((0.0, "x"), (1.0, "y"), (2.0, "z"))


def test_names_come_once_and_lines_across_have_no_abscissa() -> None:
    chart = stack(
        [
            panel(curve("k", X, X), dots("k", X, X)),
            panel(outline("region", X, X), span(1.0, 2.0, 0), level(1.0)),
        ],
        4.0,
    )
    assert chart.names == ("k", "region")
    across, shade = level(2.0, name="limit"), span(1.0, 3.0, 2)
    assert (across.kind, across.x.size, across.y.tolist(), across.colour) == ("hline", 0, [2.0], GREY)
    assert (shade.kind, shade.y.tolist()) == ("hspan", [1.0, 3.0])
    sense = arrow([0.0, 1.0], [2.0, 3.0], 1)
    assert (sense.kind, sense.x.tolist(), sense.y.tolist()) == ("arrow", [0.0, 2.0], [1.0, 3.0])


def test_more_curves_than_colours_are_dashed() -> None:
    assert [look(number) for number in (0, 6, 7, 14, 21)] == [
        (0, "-"),
        (6, "-"),
        (0, "--"),
        (0, ":"),
        (0, "-"),
    ]


def test_dots_are_not_joined_and_curves_without_marker_have_no_size() -> None:
    points, line = dots("k", X, X, hollow=True, size=5.0), curve("k", X, X)
    assert (points.line, points.marker, points.size, points.hollow) == ("", ".", 5.0, True)
    assert (line.line, line.marker, line.size) == ("-", "", 0.0)
