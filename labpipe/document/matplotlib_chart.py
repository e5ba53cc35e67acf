"""A chart drawn by matplotlib, for print and for pages without their script."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from labpipe.document.chart_words import UPRIGHT, axis_titles, turn_of_names
from labpipe.document.matplotlib_series import PAINTERS
from labpipe.document.matplotlib_style import canvas_of_size, plain_logarithmic, styled
from labpipe.report.chart import Chart, Panel

SMALL = 8
# More panels than this are laid out by rule: measuring every label of theirs takes half a minute.
MOST_MEASURED = 6
# Letters that fit side by side into a legend as wide as the page, and those of the sample beside each name.
LETTERS, SAMPLE = 112, 11
MOST_COLUMNS = 5
# Kinds of series that a legend names, in the order in which matplotlib lists them, and what makes two entries the same: name and colour.
HANDLED = ("line", "area")
Entry = tuple[str, int]


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
    _axis(axes, "x", chart, number)
    _axis(axes, "y", chart, number)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if chart.shared else "datalim")


def _axis(axes: Axes, which: str, chart: Chart, number: int) -> None:
    """Scale, ends and, where places have names, these; of two axes with one scale matplotlib may move an end outwards."""
    panel, limits = chart.panels[number], chart.limits(number, which)
    axis, drawn = (panel.x, axes.xaxis) if which == "x" else (panel.y, axes.yaxis)
    if axis.logarithmic:
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        plain_logarithmic(drawn, *limits)
    (axes.set_xlim if which == "x" else axes.set_ylim)(*limits, auto=panel.equal)
    if axis.ticks:
        names = [name for _, name in axis.ticks]
        drawn.set_ticks([place for place, _ in axis.ticks], names)
        turned = turn_of_names(chart, number) if which == "x" else 0.0
        if turned:
            drawn.set_tick_params(rotation=turned, labelsize=SMALL - 1)
            for label in drawn.get_ticklabels():
                label.set_horizontalalignment("center" if turned == UPRIGHT else "right")


def _titles(canvas: Canvas, places: list[Axes], chart: Chart) -> None:
    """The titles of the axes where they stand."""
    titles = axis_titles(chart)
    for axes, below, beside in zip(places, titles.below, titles.beside, strict=False):
        axes.set_xlabel(below)
        axes.set_ylabel(beside)
    if titles.common_x:
        canvas.supxlabel(titles.common_x, fontsize=SMALL + 1)
    if titles.common_y:
        canvas.supylabel(titles.common_y, fontsize=SMALL + 1)


def _legends(canvas: Canvas, places: list[Axes], chart: Chart) -> None:
    """Names once for each colour: in the first panel that has them, or all of them above."""
    entries: dict[Entry, Artist] = {}
    for axes, panel in zip(places, chart.panels, strict=False):
        fresh = {entry: handle for entry, handle in _entries(axes, panel).items() if entry not in entries}
        entries |= fresh
        if chart.legend == "panels" and fresh:
            names = [name for name, _ in fresh]
            axes.legend(list(fresh.values()), names, ncols=_columns(names, chart.columns), fontsize=SMALL)
    if chart.legend == "above":
        _legend_above(canvas, entries, len(chart.panels) > MOST_MEASURED)


def _legend_above(canvas: Canvas, entries: dict[Entry, Artist], by_rule: bool) -> None:
    """The names of all panels above them."""
    names = [name for name, _ in entries]
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0)} if by_rule else {"loc": "outside upper center"}
    size = SMALL - 1 if len(names) > SMALL else SMALL
    canvas.legend(list(entries.values()), names, ncols=_columns(names, 1), fontsize=size, **where)


def _entries(axes: Axes, panel: Panel) -> dict[Entry, Artist]:
    """(name, colour) -> its legend handle, the first of each; matplotlib lists them as they were drawn, kind by kind."""
    handles: dict[str, list[Artist]] = {}
    for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
        handles.setdefault(name, []).append(handle)
    named = [series for kind in HANDLED for series in panel.series if series.kind == kind and series.name]
    listed = [(series, handles[series.name].pop(0)) for series in named]
    first: dict[Entry, Artist] = {}
    for series in panel.series:
        for other, handle in listed:
            if other is series:
                first.setdefault((series.listed, series.colour), handle)
    return first


def _columns(names: list[str], side_by_side: int) -> int:
    """Number of names per row of the legend, by the width."""
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
