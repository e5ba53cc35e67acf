"""A chart drawn by matplotlib, for print and for pages without their script."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from labpipe.document.matplotlib_series import PAINTERS
from labpipe.document.matplotlib_style import canvas_of_size, plain_logarithmic, styled
from labpipe.report.chart import Chart, Panel

SMALL = 8
# More panels than this are laid out by rule: measuring every label of theirs takes half a minute.
MOST_MEASURED = 6
# Letters that fit side by side into a legend as wide as the page, and those of the sample beside each name.
LETTERS, SAMPLE = 100, 7
MOST_COLUMNS = 5
# Letters that fit into an inch of an ordinate.
LETTERS_UPWARDS = 13
# Names of ticks longer than this together are turned.
MOST_LEVEL = 70
HANDLED = ("line", "area")


def chart_canvas(chart: Chart) -> Canvas:
    """The chart on a canvas of its size."""
    grid = not any(series.kind == "cells" for panel in chart.panels for series in panel.series)
    with styled(grid):
        by_rule = len(chart.panels) > MOST_MEASURED
        canvas = canvas_of_size(chart.size, measured=not by_rule)
        places = canvas.subplots(
            chart.rows,
            chart.columns,
            squeeze=False,
            sharex="x" in chart.shared,
            sharey="y" in chart.shared,
            height_ratios=chart.heights,
        ).reshape(-1)
        for number, (axes, panel) in enumerate(zip(places, chart.panels, strict=False)):
            _panel(axes, chart, number, panel)
        for axes in places[len(chart.panels) :]:
            axes.set_visible(False)
        if by_rule:
            _rooms(canvas, chart)
        _titles(canvas, list(places), chart)
        _legends(canvas, list(places), chart)
    return canvas


def _panel(axes: Axes, chart: Chart, number: int, panel: Panel) -> None:
    for series in panel.series:
        PAINTERS[series.kind](axes, series)
    if panel.title:
        axes.set_title(panel.title, fontsize=SMALL if chart.columns > 1 else SMALL + 1)
    if panel.note:
        axes.text(0.5, 0.5, panel.note, transform=axes.transAxes, ha="center")
    _axis(axes, "x", panel, chart.limits(number, "x"))
    _axis(axes, "y", panel, chart.limits(number, "y"))
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if chart.shared else "datalim")


def _axis(axes: Axes, which: str, panel: Panel, limits: tuple[float, float]) -> None:
    """Scale, ends and, where places have names, these; of two axes with one scale matplotlib may move an end outwards."""
    axis, drawn = (panel.x, axes.xaxis) if which == "x" else (panel.y, axes.yaxis)
    if axis.logarithmic:
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        plain_logarithmic(drawn, *limits)
    (axes.set_xlim if which == "x" else axes.set_ylim)(*limits, auto=panel.equal)
    if axis.ticks:
        names = [name for _, name in axis.ticks]
        drawn.set_ticks([place for place, _ in axis.ticks], names)
        if which == "x" and sum(len(name) for name in names) > MOST_LEVEL:
            drawn.set_tick_params(rotation=25, labelsize=SMALL - 1)
            for label in drawn.get_ticklabels():
                label.set_horizontalalignment("right")


def _titles(canvas: Canvas, places: list[Axes], chart: Chart) -> None:
    """Labels of the axes: along a shared abscissa the lowest panel has it; what is the same in all panels of a grid is said once."""
    wide = chart.columns > 1
    for which, once in (("x", wide and chart.rows > 1), ("y", wide)):
        labels = [(panel.x if which == "x" else panel.y).label for panel in chart.panels]
        if once and len(set(labels)) == 1:
            (canvas.supxlabel if which == "x" else canvas.supylabel)(labels[0], fontsize=SMALL + 1)
            continue
        for number, (axes, label) in enumerate(zip(places, labels, strict=False)):
            below = labels[number + chart.columns : number + chart.columns + 1]
            if which == "y" or "x" not in chart.shared or not below:
                (axes.set_xlabel if which == "x" else axes.set_ylabel)(_wrapped(label, chart, number) if which == "y" else label)


def _wrapped(label: str, chart: Chart, number: int) -> str:
    """A title of an ordinate that is longer than its panel is high has its unit on a line of its own."""
    room = LETTERS_UPWARDS * chart.size[1] * chart.heights[number // chart.columns]
    return label.replace(" [", "\n[") if len(label) > room else label


def _legends(canvas: Canvas, places: list[Axes], chart: Chart) -> None:
    """Names once: in the first panel that has them, or all of them above."""
    named: set[str] = set()
    for axes, panel in zip(places, chart.panels, strict=False):
        names = [series.name for series in panel.series if series.kind in HANDLED and series.name]
        fresh = [name for name in dict.fromkeys(names) if name not in named]
        named.update(fresh)
        if chart.legend == "panels" and fresh:
            handles = _handles(axes)
            axes.legend([handles[name] for name in fresh], fresh, ncols=_columns(fresh, chart.columns), fontsize=SMALL)
    if chart.legend == "above":
        _legend_above(canvas, places, len(chart.panels) > MOST_MEASURED)


def _legend_above(canvas: Canvas, places: list[Axes], by_rule: bool) -> None:
    """The names of all panels above them, each once."""
    handles: dict[str, Artist] = {}
    for axes in places:
        for name, handle in _handles(axes).items():
            handles.setdefault(name, handle)
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0)} if by_rule else {"loc": "outside upper center"}
    size = SMALL - 1 if len(handles) > SMALL else SMALL
    canvas.legend(list(handles.values()), list(handles), ncols=_columns(list(handles), 1), fontsize=size, **where)


def _handles(axes: Axes) -> dict[str, Artist]:
    """Name -> what stands for it in a legend, the first of each name."""
    handles, names = axes.get_legend_handles_labels()
    first: dict[str, Artist] = {}
    for name, handle in zip(names, handles, strict=True):
        if isinstance(handle, Artist):
            first.setdefault(name, handle)
    return first


def _columns(names: list[str], side_by_side: int) -> int:
    """How many names stand side by side: as many as the width holds."""
    longest = max((len(name) for name in names), default=0) + SAMPLE
    return max(1, min(len(names), MOST_COLUMNS, int(LETTERS / side_by_side / longest)))


def _rooms(canvas: Canvas, chart: Chart) -> None:
    """Panels by rule, with room for labels in inches and a legend above."""
    width, height = chart.size
    above = 0.72 if chart.legend == "above" else 0.3
    alone = {panel.y.label for panel in chart.panels} != {chart.panels[0].y.label}
    wide, high = (width - 0.7) / chart.columns, (height - 0.48 - above) / chart.rows
    across = 0.75 if alone else 0.45
    upwards = 0.42 if any(panel.title for panel in chart.panels[chart.columns :]) else 0.25
    canvas.subplots_adjust(
        left=0.62 / width,
        right=1 - 0.08 / width,
        bottom=0.48 / height,
        top=1 - above / height,
        wspace=across / (wide - across),
        hspace=upwards / float(np.maximum(high - upwards, 0.3)),
    )
