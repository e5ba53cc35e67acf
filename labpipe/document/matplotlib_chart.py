"""A chart drawn by matplotlib, for print and for notebooks: panels, numbers and legends stand where the chart's layout has them."""

from __future__ import annotations

from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from labpipe.document.chart_layout import GAP, MARK, POINTS_PER_INCH, TURNED_LETTERS, places, widest_beside
from labpipe.document.chart_legend import APART, LETTERS, LINE, SAMPLE, Entries, height_above, legend_size, legends, place_inside
from labpipe.document.chart_legend import GAP as SAMPLE_GAP
from labpipe.document.chart_place import Box, Place
from labpipe.document.chart_words import UPRIGHT, AxisTitles, axis_titles, is_leftmost, is_lowest, turn_of_names
from labpipe.document.letters import LETTERS as WORDS
from labpipe.document.matplotlib_series import PAINTERS
from labpipe.document.matplotlib_style import numbered, styled
from labpipe.report.chart import Chart, Panel

TITLE, SMALL_TITLE = 9.0, 8.0
# Matplotlib measures a legend in letters.
LOOK: dict[str, Any] = {
    "fontsize": LETTERS,
    "borderaxespad": 0.0,
    "borderpad": 0.0,
    "handlelength": SAMPLE / LETTERS,
    "handletextpad": SAMPLE_GAP / LETTERS,
    "columnspacing": APART / LETTERS,
    "labelspacing": LINE / LETTERS - 1.0,
}
# id of a series -> what was drawn for it, for the legend.
Handles = dict[int, Artist]


def chart_canvas(chart: Chart) -> Canvas:
    """The chart on a canvas of its size."""
    grid = not any(series.kind == "cells" for panel in chart.panels for series in panel.series)
    above, inside = legends(chart)
    width = POINTS_PER_INCH * chart.size[0]
    there = places(chart, height_above(above, width))
    titles = axis_titles(chart)
    boxes = tuple(place.box for place in there)
    handles: Handles = {}
    with styled(grid):
        canvas = Canvas(figsize=chart.size)
        drawn: list[Axes] = []
        for number, (panel, place, entries) in enumerate(zip(chart.panels, there, inside, strict=True)):
            axes = _axes(canvas, chart, place.box, drawn)
            drawn.append(axes)
            handles |= _painted(axes, panel)
            _scales(axes, chart, number, place)
            _titles(axes, chart, number, titles, widest_beside(chart, boxes, number % chart.columns))
            if entries:
                _legend_inside(axes, entries, panel, place, handles)
        _common_titles(canvas, titles, boxes)
        if above:
            _legend_above(canvas, above, handles)
    return canvas


def _axes(canvas: Canvas, chart: Chart, box: Box, drawn: list[Axes]) -> Axes:
    """Axes in their box; those that move together do so in a window too."""
    width, height = (POINTS_PER_INCH * size for size in chart.size)
    where = (box.left / width, 1 - box.bottom / height, box.width / width, box.height / height)
    first = drawn[0] if drawn else None
    return canvas.add_axes(where, sharex=first if "x" in chart.shared else None, sharey=first if "y" in chart.shared else None)


def _painted(axes: Axes, panel: Panel) -> Handles:
    """What the series of a panel and its note look like; the drawn artists by series."""
    handles: Handles = {}
    for series in panel.series:
        artist = PAINTERS[series.kind](axes, series)
        if artist is not None:
            handles[id(series)] = artist
    if panel.note:
        axes.text(0.5, 0.5, panel.note, transform=axes.transAxes, ha="center", va="center")
    return handles


def _scales(axes: Axes, chart: Chart, number: int, place: Place) -> None:
    """Scales, ends and numbers of both axes; axes of one scale keep it in a window too."""
    panel = chart.panels[number]
    if panel.x.logarithmic:
        axes.set_xscale("log")
    if panel.y.logarithmic:
        axes.set_yscale("log")
    axes.set_xlim(*place.x.limits)
    axes.set_ylim(*place.y.limits)
    numbered(axes, "x", panel.x)
    numbered(axes, "y", panel.y)
    axes.tick_params(labelbottom=is_lowest(chart, number), labelleft=is_leftmost(chart, number))
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if chart.shared else "datalim")
    turned = turn_of_names(chart, number)
    if turned:
        axes.tick_params(axis="x", labelrotation=turned, labelsize=TURNED_LETTERS)
        for label in axes.get_xticklabels():
            label.set_horizontalalignment("center" if turned == UPRIGHT else "right")


def _titles(axes: Axes, chart: Chart, number: int, titles: AxisTitles, widest: float) -> None:
    """The titles of a panel and its axes; those of one column of panels stand below each other."""
    if chart.panels[number].title:
        axes.set_title(chart.panels[number].title, fontsize=SMALL_TITLE if chart.columns > 1 else TITLE, pad=GAP)
    axes.set_xlabel(titles.below[number], labelpad=GAP)
    axes.set_ylabel(titles.beside[number])
    if titles.beside[number]:
        across = -(MARK + widest + GAP) / (POINTS_PER_INCH * axes.get_position().width * chart.size[0])
        axes.yaxis.set_label_coords(across, 0.5)


def _common_titles(canvas: Canvas, titles: AxisTitles, boxes: tuple[Box, ...]) -> None:
    """Titles of axes that are written once for all panels."""
    width, height = (POINTS_PER_INCH * size for size in canvas.get_size_inches())
    if titles.common_x:
        canvas.supxlabel(titles.common_x, x=0.5, y=GAP / height, ha="center", va="bottom", fontsize=WORDS)
    if titles.common_y:
        middle = (min(box.top for box in boxes) + max(box.bottom for box in boxes)) / 2
        canvas.supylabel(titles.common_y, x=GAP / width, y=1 - middle / height, ha="left", va="center", fontsize=WORDS)


def _legend_inside(axes: Axes, entries: Entries, panel: Panel, place: Place, handles: Handles) -> None:
    """The legend within a panel, where it hides least."""
    columns, _, left, top = place_inside(entries, panel, place)
    corner = (left - place.box.left) / place.box.width, 1 - (top - place.box.top) / place.box.height
    axes.legend(*_listed(entries, handles), ncols=columns, loc="upper left", bbox_to_anchor=corner, **LOOK)


def _legend_above(canvas: Canvas, entries: Entries, handles: Handles) -> None:
    """The names of all panels above them."""
    width, height = (POINTS_PER_INCH * size for size in canvas.get_size_inches())
    columns, _, _ = legend_size(entries, width)
    canvas.legend(*_listed(entries, handles), ncols=columns, loc="upper center", bbox_to_anchor=(0.5, 1 - GAP / height), **LOOK)


def _listed(entries: Entries, handles: Handles) -> tuple[list[Any], list[str]]:
    """Samples and names: of an entry its first line and its first marks, one on the other."""
    samples: list[Any] = []
    for series in entries.values():
        lined = next((curve for curve in series if curve.line), series[0])
        marked = next((curve for curve in series if curve.marker), lined)
        drawn = tuple(dict.fromkeys(handles[id(shown)] for shown in (lined, marked)))
        samples.append(drawn if len(drawn) > 1 else drawn[0])
    return samples, [name for name, _ in entries]
