"""Every kind of series on a pair of axes of matplotlib. PAINTERS by kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb

from labpipe.document.chart_layout import POINTS_PER_INCH, SCALE_GAP, SCALE_NUMBERS, SCALE_WIDTH, SMALL
from labpipe.document.palette import GREY_TONE, HEAT, heat, ink_on, tone
from labpipe.report.chart import Series

# Bars of markers smaller than this [pt] have no caps: there are too many of them.
LEAST_CAPPED = 3.0
CAP = 2.0


def _line(axes: Axes, series: Series) -> Artist:
    """Points joined or not, with the interval around them."""
    colour = tone(series.colour)
    if series.low is not None and series.high is not None:
        if series.interval == "shaded":
            axes.fill_between(series.x, series.low, series.high, color=colour, alpha=series.opacity, linewidth=0)
        else:
            cap = CAP if series.size >= LEAST_CAPPED else 0.0
            reach = np.abs(np.array([series.low, series.high]) - series.y)
            axes.errorbar(series.x, series.y, np.nan_to_num(reach), fmt="none", ecolor=colour, elinewidth=0.8, capsize=cap)
    look: dict[str, Any] = {"color": colour, "linestyle": series.line or "none", "linewidth": series.width}
    if series.marker:
        look |= {"marker": series.marker, "markersize": series.size * (2 if series.marker == "." else 1)}
        look |= {"markerfacecolor": "none"} if series.hollow else {}
    (drawn,) = axes.plot(series.x, series.y, label=_label(series), **look)
    return drawn


def _area(axes: Axes, series: Series) -> Artist:
    face = (tone(series.colour), series.opacity)
    (drawn,) = axes.fill(series.x, series.y, facecolor=face, edgecolor=GREY_TONE, linewidth=series.width, label=_label(series))
    return drawn


def _level(axes: Axes, series: Series) -> None:
    """A line across with its name at its end."""
    (y,) = series.y
    axes.axhline(y, color=tone(series.colour), linewidth=series.width, linestyle=series.line)
    if series.name:
        place = axes.get_yaxis_transform()
        axes.text(0.99, y, series.name, transform=place, fontsize=SMALL, ha="right", va="bottom", color="0.3")


def _upright(axes: Axes, series: Series) -> None:
    (x,) = series.x
    axes.axvline(x, color=tone(series.colour), linewidth=series.width, linestyle=series.line)


def _level_span(axes: Axes, series: Series) -> None:
    axes.axhspan(*series.y, color=tone(series.colour), alpha=series.opacity, linewidth=0)


def _upright_span(axes: Axes, series: Series) -> None:
    axes.axvspan(*series.x, color=tone(series.colour), alpha=series.opacity, linewidth=0)


def _cells(axes: Axes, series: Series) -> None:
    """A heat map with the text of every cell and the scale beside it."""
    fills = [[heat(value) for value in row] for row in series.y.tolist()]
    axes.imshow(np.array([[to_rgb(fill) for fill in row] for row in fills]), aspect="auto")
    scale = ScalarMappable(Normalize(-1, 1), LinearSegmentedColormap.from_list("heat", HEAT))
    where = axes.get_position()
    # Of the canvas's width, a point.
    point = where.width / axes.bbox.width * axes.figure.dpi / POINTS_PER_INCH
    beside = axes.figure.add_axes((where.x1 + SCALE_GAP * point, where.y0, SCALE_WIDTH * point, where.height), label="<colorbar>")
    axes.figure.colorbar(scale, cax=beside, ticks=[-1, -0.5, 0, 0.5, 1]).set_label(series.name, fontsize=SMALL + 1, labelpad=0)
    beside.tick_params(labelsize=SMALL, length=0, pad=SCALE_NUMBERS)
    for (row, column), fill in np.ndenumerate(np.array(fills)):
        text = series.texts[row][column]
        axes.text(column, row, text, ha="center", va="center", fontsize=SMALL, color=ink_on(str(fill)))


def _arrow(axes: Axes, series: Series) -> None:
    tail, head = np.column_stack([series.x, series.y])
    axes.annotate("", head, tail, arrowprops={"arrowstyle": "-|>", "color": tone(series.colour)})


def _text(axes: Axes, series: Series) -> None:
    """Words with their middle at the points."""
    for x, y, text in zip(series.x, series.y, series.texts[0], strict=True):
        axes.text(x, y, text, ha="center", va="center", fontsize=series.size, color=tone(series.colour))


def _label(series: Series) -> str:
    """The name for a legend; matplotlib leaves out what begins with an underscore."""
    return series.name or "_"


PAINTERS: dict[str, Callable[[Axes, Series], Artist | None]] = {
    "line": _line,
    "area": _area,
    "hline": _level,
    "vline": _upright,
    "hspan": _level_span,
    "vspan": _upright_span,
    "cells": _cells,
    "arrow": _arrow,
    "text": _text,
}
