"""The numbers of a drawing as JSON inside a page: what its script draws, zooms and reads."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from labpipe.report.drawing import COLOURS
from labpipe.report.plotted import Numbers, Panel, Plotted, PlottedAxis, Series

DIGITS = 7
RULE = "var(--rule)"


class NumberList:
    """Arrays of one figure, each kept once: curves of one figure share their abscissa."""

    def __init__(self) -> None:
        self.lists: list[list[float | None]] = []
        self._known: dict[tuple[float | None, ...], int] = {}

    def add(self, values: Numbers) -> int:
        """The place of *values* in the list, rounded to the digits that a screen can show."""
        rounded = tuple(_rounded(value) for value in np.ravel(values).tolist())
        if rounded not in self._known:
            self._known[rounded] = len(self.lists)
            self.lists.append(list(rounded))
        return self._known[rounded]


def _rounded(value: float) -> float | int | None:
    if not math.isfinite(value):
        return None
    near = float(f"{value:.{DIGITS}g}")
    return int(near) if near.is_integer() and abs(near) < 1e15 else near


def figure_json(drawn: Plotted) -> str:
    """The figure for the page's script; no text of it can end the script element that it stands in."""
    numbers = NumberList()
    entry = {
        "height": drawn.size[1],
        "rows": drawn.rows,
        "columns": drawn.columns,
        "panels": [_panel(panel, numbers) for panel in drawn.panels],
        "numbers": numbers.lists,
    }
    text = json.dumps(entry, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _panel(panel: Panel, numbers: NumberList) -> dict[str, Any]:
    return {
        "title": panel.title,
        "share": panel.share,
        "equal": panel.equal,
        "x": _axis(panel.x),
        "y": _axis(panel.y),
        "series": [_series(one, numbers) for one in panel.series],
    }


def _axis(axis: PlottedAxis) -> dict[str, Any]:
    return {
        "title": axis.title,
        "unit": axis.unit,
        "label": axis.label,
        "limits": list(axis.limits),
        "log": axis.logarithmic,
        "group": axis.group,
        "ticks": [list(tick) for tick in axis.ticks],
    }


def _series(one: Series, numbers: NumberList) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": one.kind, "name": one.name, "colour": _colour(one.colour), "line": one.line, "width": one.width}
    if one.kind == "cells":
        return {**entry, "x": numbers.add(np.empty(0)), "y": numbers.add(np.empty(0)), "texts": one.texts, "fills": one.fills}
    entry |= {"x": numbers.add(one.x), "y": numbers.add(one.y), "marker": one.marker, "size": one.size, "hollow": one.hollow}
    if one.low is not None and one.high is not None:
        entry |= {"low": numbers.add(one.low), "high": numbers.add(one.high), "interval": one.interval}
    return entry


def _colour(colour: str) -> int | str:
    """The number of a colour of the palette, which each colour scheme has its own shade of; ink and grey likewise."""
    palette = [known.lower() for known in COLOURS]
    if colour in palette:
        return palette.index(colour)
    red, green, blue = (colour[n : n + 2] for n in (1, 3, 5))
    return RULE if red == green == blue else colour
