"""Charts drawn by matplotlib: every kind of series is there with its numbers, the axes are those of the
chart, every name stands once.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure as Canvas

from labpipe.document.charts import (
    DRAWINGS,
    GREY_TONE,
    PAINTERS,
    PALETTE,
    canvas_of,
    chart_canvas,
    laid_out,
    png_bytes,
    svg_text,
    tone,
)
from labpipe.document.html_page import page_part
from labpipe.report.chart import (
    GREY,
    INK,
    KINDS,
    PALETTE_SIZE,
    Axis,
    Chart,
    Drawing,
    Panel,
    curve,
    dots,
    named_ticks,
    stack,
)

X = np.array([1.0, 2.0, 4.0])


def line(axes: Axes, name: str):
    return next(drawn for drawn in axes.get_lines() if drawn.get_label() == name)


def legend(axes: Axes) -> list[str]:
    return [] if axes.get_legend() is None else [text.get_text() for text in axes.get_legend().get_texts()]


def panels_of(canvas: Canvas) -> list[Axes]:
    return [axes for axes in canvas.axes if axes.get_label() != "<colorbar>"]


def test_every_kind_of_series_has_its_painter() -> None:
    assert set(PAINTERS) == set(KINDS)


def test_curves_bands_and_bars_hold_their_numbers(every_kind: Chart) -> None:
    above, below = chart_canvas(every_kind).axes
    k, c = line(above, "k"), line(below, "c")
    assert (
        np.asarray(k.get_ydata()).tolist() == [1.0, 4.0, 16.0] and to_hex(k.get_color()) == PALETTE[0].lower()
    )
    assert (k.get_linestyle(), k.get_marker(), c.get_linestyle(), c.get_marker()) == ("-", ".", "None", "o")
    shade = above.collections[0].get_paths()[0].vertices
    assert (shade[:, 1].min(), shade[:, 1].max()) == (0.5, 17.0)
    bars = np.array([segment[:, 1] for segment in below.collections[0].get_segments()])  # type: ignore[attr-defined]
    np.testing.assert_allclose(bars, np.column_stack([0.9 * X, 1.2 * X]))
    assert np.isnan(np.asarray(line(above, "gap").get_ydata(), float)[1])
    assert line(below, "outside").get_markerfacecolor() == "none"


def test_bars_of_an_interval_beside_its_value_stand_at_the_interval() -> None:
    series = dots("c", [1.0, 2.0], [1.0, 5.0], 0, bars=([1.2, 3.0], [1.4, 4.0]))
    (axes,) = chart_canvas(Chart((Panel(Axis("x"), Axis("c"), (series,)),))).axes
    bars = np.array([segment[:, 1] for segment in axes.collections[0].get_segments()])  # type: ignore[attr-defined]
    np.testing.assert_allclose(bars, [[1.2, 1.4], [3.0, 4.0]])


def test_what_lies_across_a_panel_is_where_the_chart_says(every_kind: Chart) -> None:
    above, below = chart_canvas(every_kind).axes
    across = next(drawn for drawn in above.get_lines() if list(drawn.get_xdata()) == [0, 1])
    upright = next(drawn for drawn in above.get_lines() if list(drawn.get_ydata()) == [0, 1])
    assert (
        list(across.get_ydata()) == [10.0, 10.0]
        and to_hex(across.get_color()) == GREY_TONE
        and list(upright.get_xdata()) == [3.0, 3.0]
    )
    assert [text.get_text() for text in above.texts] == ["limit"]
    span, outline = above.patches[0].get_window_extent(), below.patches[0]
    low, high = above.transData.inverted().transform([[0, span.y0], [0, span.y1]])[:, 1]
    assert (low, high) == pytest.approx((2.0, 3.0))
    assert outline.get_path().vertices[:3].tolist() == [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]]
    head, *words = below.texts
    assert head.xy == pytest.approx((2.0, 2.0)) and [text.get_text() for text in words] == ["start", "end"]  # type: ignore[attr-defined]
    assert [text.get_position() for text in words] == [(1.5, 2.0), (3.0, 3.0)]


def test_axes_have_the_limits_labels_and_scales_of_the_chart(every_kind: Chart) -> None:
    above, below = chart_canvas(every_kind).axes
    for number, axes in enumerate((above, below)):
        assert axes.get_xlim() == pytest.approx(
            every_kind.limits(number, "x")
        ) and axes.get_ylim() == pytest.approx(every_kind.limits(number, "y"))
    assert (above.get_yscale(), below.get_yscale()) == ("log", "linear") and above.get_title() == "stiffness"
    assert (above.get_xlabel(), below.get_xlabel(), below.get_ylabel()) == ("", "speed [rpm]", "c [N s/m]")


def test_every_name_stands_in_one_legend(every_kind: Chart) -> None:
    above, below = chart_canvas(every_kind).axes
    assert legend(above) == ["k", "gap"] and legend(below) == ["c", "outside", "region"]
    again = stack(
        [
            Panel(Axis("x"), Axis("y"), (curve("k", X, X),)),
            Panel(Axis("x"), Axis("z"), (curve("k", X, X), dots("c", X, X))),
        ],
        4.0,
    )
    assert [legend(axes) for axes in chart_canvas(again).axes] == [["k"], ["c"]]
    assert [legend(axes) for axes in chart_canvas(replace(again, legend="none")).axes] == [[], []]
    (names,) = chart_canvas(replace(again, legend="above")).legends
    assert [text.get_text() for text in names.get_texts()] == ["k", "c"]


def test_a_grid_says_the_same_labels_once_and_has_no_axes_without_a_panel() -> None:
    panels = tuple(
        Panel(Axis("x", "um"), Axis("y", "um"), (curve("orbit", X, X),), equal=True) for _ in range(7)
    )
    canvas = chart_canvas(Chart(panels, 2, 4, shared="xy", legend="above"))
    assert canvas.get_supxlabel() == "x [um]" and canvas.get_supylabel() == "y [um]"
    assert len(canvas.axes) == 7
    assert len(canvas.legends) == 1 and canvas.axes[0].get_aspect() == 1.0


def test_panels_of_one_scale_are_drawn_without_a_complaint(caplog: pytest.LogCaptureFixture) -> None:
    chart = Chart((Panel(Axis("x"), Axis("y"), (curve("orbit", X, 3 * X),), equal=True),) * 2, 1, 2)
    with caplog.at_level(logging.WARNING):
        svg_text(chart_canvas(chart))
    assert caplog.records == []


def test_long_names_of_places_are_turned_and_short_ones_not() -> None:
    def rotation(names: list[str]) -> float:
        axis = Axis(ticks=named_ticks(names))
        return (
            chart_canvas(
                stack([Panel(axis, Axis(), (dots("k", range(len(names)), range(len(names))),))], 3.0)
            )
            .axes[0]
            .get_xticklabels()[0]
            .get_rotation()
        )

    assert rotation(["up", "down"]) == 0 and rotation(["a test with a long name"] * 5) == 25


def test_a_heat_map_has_texts_colours_and_a_scale(heat_map: Chart) -> None:
    canvas = chart_canvas(heat_map)
    (axes,) = panels_of(canvas)
    assert [text.get_text() for text in axes.texts] == ["1", "half", "-half", "1"]
    assert [text.get_color() for text in axes.texts] == ["#ffffff", "#000000", "#000000", "#ffffff"]
    assert axes.images[0].get_array().tolist() == [[1.0, 0.5], [-0.5, 1.0]]  # type: ignore[union-attr]
    assert axes.images[0].get_clim() == (-1, 1) and len(canvas.axes) == 2
    assert canvas.axes[1].get_ylabel() == "correlation" and axes.get_ylim() == (1.5, -0.5)


@pytest.mark.parametrize("kind", DRAWINGS.names())
def test_every_drawing_is_drawn_in_its_size(kind: str, drawings: dict[str, Drawing]) -> None:
    canvas = canvas_of(drawings[kind])
    assert tuple(canvas.get_size_inches()) == drawings[kind].size and "<path" in svg_text(canvas)


@pytest.mark.long
def test_the_same_chart_is_drawn_the_same_and_saved_twice_alike(every_kind: Chart) -> None:
    first, second = chart_canvas(every_kind), chart_canvas(every_kind)
    assert svg_text(first) == svg_text(second) == svg_text(first)
    assert png_bytes(first).startswith(b"\x89PNG") and "<text" in svg_text(first)


@pytest.mark.long
def test_a_chart_is_drawn_the_same_where_another_was_before(every_kind: Chart) -> None:
    """On its canvas, in its layout: of other curves, title, names and numbers, which fit another layout."""
    above, below = every_kind.panels
    fewer = replace(above, series=above.series[:1], title="", y=Axis("k", "MN/m", logarithmic=True))
    other = replace(every_kind, panels=(fewer, below))
    wider = replace(every_kind, panels=(above, replace(below, y=Axis("c", "N s/m", low=-1000.0))))
    canvases, layouts = {}, {}
    charts = [(chart, png_bytes(chart_canvas(chart))) for chart in (other, every_kind, wider)]
    for chart, fresh in (*charts, charts[1], charts[0]):
        assert png_bytes(laid_out(chart_canvas(chart, canvases), layouts)) == fresh
    assert len(canvases) == 1 and len(layouts) == 3


def test_one_name_in_two_colours_stands_twice_and_a_dot_of_its_curve_not() -> None:
    series = (curve("x", X, X, 0), curve("x", X, 2 * X, 3), dots("x", X[:1], X[:1], 0, marker="o"))
    (axes,) = chart_canvas(stack([Panel(Axis("f"), Axis("snr"), series)], 3.0)).axes
    assert legend(axes) == ["x", "x"]
    assert [to_hex(handle.get_color()) for handle in axes.get_legend().legend_handles] == [
        PALETTE[0].lower(),
        PALETTE[3].lower(),
    ]  # type: ignore[union-attr]


def test_names_of_many_cells_stand_upright(heat_map: Chart) -> None:
    axis = Axis(ticks=named_ticks(["wear_depth_of_1", "wear_angle_of_1"]))
    panel = replace(heat_map.panels[0], x=axis, y=axis)
    (axes,) = panels_of(chart_canvas(replace(heat_map, panels=(panel,))))
    assert {label.get_rotation() for label in axes.get_xticklabels()} == {90.0}


def ticks(axis: Axis, limits: tuple[float, float]) -> list[str]:
    ends = replace(axis, low=limits[0], high=limits[1])
    canvas = chart_canvas(stack([Panel(Axis("x"), ends, (dots("k", [0.0], [limits[0]]),))], 3.0))
    canvas.draw_without_rendering()
    low, high = canvas.axes[0].get_ylim()
    labels = zip(canvas.axes[0].get_yticks(), canvas.axes[0].get_yticklabels(), strict=True)
    return [label.get_text() for at, label in labels if low <= at <= high]


def test_numbers_of_axes_are_round_and_say_what_they_need() -> None:
    assert ticks(Axis("phase", "deg"), (-190.0, 190.0)) == [
        "\N{MINUS SIGN}180",
        "\N{MINUS SIGN}90",
        "0",
        "90",
        "180",
    ]
    assert ticks(Axis("k", logarithmic=True), (0.9, 2000.0)) == ["1", "10", "100", "1000"]
    assert ticks(Axis("k", logarithmic=True), (9.0, 110.0)) == ["10", "20", "50", "100"]
    assert {len(text.partition(".")[2]) for text in ticks(Axis("k"), (1.0, 1.3))} == {2}
    assert ticks(Axis("k"), (0.0, 1e-8))[:3] == ["0", "2 × 10⁻⁹", "4 × 10⁻⁹"]
    assert ticks(Axis("k", logarithmic=True), (9e5, 2e9)) == ["10⁶", "10⁷", "10⁸", "10⁹"]


def test_numbers_of_the_palette_go_round_and_grey_is_apart() -> None:
    assert tone(0) == tone(PALETTE_SIZE) == PALETTE[0] and tone(INK) == "#000000"
    assert tone(GREY) == GREY_TONE and len(PALETTE) == PALETTE_SIZE


@pytest.mark.parametrize("colour", [*PALETTE, GREY_TONE])
def test_every_colour_reaches_3_to_1_against_white(colour: str) -> None:
    # Contrast of WCAG 2.1: (L1 + 0.05) / (L2 + 0.05) of relative luminances, from linear sRGB.
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in to_rgb(colour)]
    assert 1.05 / (0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05) >= 3
    assert colour.lower() in page_part("report.css") or colour == GREY_TONE


def test_many_names_stand_above_their_panel_and_hide_no_curve() -> None:
    for count, is_above in ((4, False), (5, True)):
        series = tuple(curve(f"x{n}", X, n * X, n) for n in range(count))
        canvas = chart_canvas(stack([Panel(Axis("f"), Axis("snr"), series)], 3.0))
        canvas.draw_without_rendering()
        (axes,) = canvas.axes
        names = axes.get_legend().get_window_extent()
        assert (names.y0 >= axes.bbox.y1) == is_above and names.y1 <= canvas.bbox.y1


def test_numbers_follow_the_ends_of_an_axis_in_a_window(every_kind: Chart) -> None:
    axes = chart_canvas(every_kind).axes[1]
    axes.set_xlim(2.0, 2.5)
    axes.figure.draw_without_rendering()  # type: ignore[union-attr]
    texts = [text.get_text() for text in axes.get_xticklabels()]
    assert texts == ["2.0", "2.1", "2.2", "2.3", "2.4", "2.5"] and axes.format_xdata(2.25) == "2.25"
