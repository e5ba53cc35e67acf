"""The numbers of a figure as JSON inside a page: what its script draws, zooms and reads, and the shapes that it turns and sways."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.document.palette import heat
from labpipe.report.chart import GREY, Axis, Chart, Series
from labpipe.report.shape_figure import REACH, ShapeSketch

# Digits of places along an axis, which zooming must tell apart, and the fewest of what is read there.
DIGITS, READ_DIGITS = 7, 5
# Digits of places of a structure, which is 1 in size.
SHAPE_DIGITS = 4
RULE = "var(--rule)"


class NumberList:
    """Arrays of one figure, each kept once: curves of one figure share their abscissa."""

    def __init__(self) -> None:
        self.lists: list[list[float | None]] = []
        self._places: dict[tuple[float | None, ...], int] = {}

    def add(self, values: FloatArray, digits: int = DIGITS) -> int:
        """The place of *values* (n,) [unit of their axis] in the list, rounded to the *digits* that a screen can show."""
        rounded = tuple(_rounded(value, digits) for value in np.ravel(values).tolist())
        if rounded not in self._places:
            self._places[rounded] = len(self.lists)
            self.lists.append(list(rounded))
        return self._places[rounded]


def _read_digits(series: Series) -> int:
    """Digits of what a series shows: more where it differs little from a constant, whose digits say nothing."""
    shown = [part[np.isfinite(part)] for part in (series.y, series.low, series.high) if part is not None]
    values = np.concatenate([part.ravel() for part in shown])
    span = float(np.ptp(values)) if values.size else 0.0
    if span == 0:
        return DIGITS
    return min(DIGITS, READ_DIGITS + max(0, round(math.log10(float(np.max(np.abs(values))) / span))))


def _rounded(value: float, digits: int) -> float | int | None:
    if not math.isfinite(value):
        return None
    near = float(f"{value:.{digits}g}")
    return int(near) if near.is_integer() and abs(near) < 1e15 else near


def figure_json(chart: Chart) -> str:
    """The chart for the page's script."""
    numbers = NumberList()
    entry = {
        "height": chart.size[1],
        "rows": chart.rows,
        "columns": chart.columns,
        "panels": [_panel(chart, number, numbers) for number in range(len(chart.panels))],
        "numbers": numbers.lists,
    }
    return json_text(entry)


def json_text(entry: dict[str, Any]) -> str:
    """An entry as JSON; no text of it can end the script element that it stands in."""
    text = json.dumps(entry, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _panel(chart: Chart, number: int, numbers: NumberList) -> dict[str, Any]:
    panel = chart.panels[number]
    return {
        "title": panel.title,
        "note": panel.note,
        "share": chart.heights[number // chart.columns],
        "equal": panel.equal,
        "pick": panel.pick,
        "x": _axis(panel.x, chart.limits(number, "x"), chart.group(number, "x")),
        "y": _axis(panel.y, chart.limits(number, "y"), chart.group(number, "y")),
        "series": [_series(series, numbers) for series in panel.series],
    }


def _axis(axis: Axis, limits: tuple[float, float], group: int) -> dict[str, Any]:
    return {
        "title": axis.title,
        "unit": axis.unit,
        "label": axis.label,
        "limits": [float(f"{end:.12g}") for end in limits],
        "log": axis.logarithmic,
        "group": group,
        "ticks": [list(tick) for tick in axis.ticks],
    }


def _series(series: Series, numbers: NumberList) -> dict[str, Any]:
    colour = RULE if series.colour == GREY else series.colour
    entry: dict[str, Any] = {"kind": series.kind, "name": series.name, "colour": colour, "line": series.line, "width": series.width}
    if series.entry:
        entry["entry"] = series.entry
    if series.kind == "cells":
        nothing = numbers.add(np.empty(0))
        fills = [[heat(value) for value in row] for row in series.y.tolist()]
        return {**entry, "name": "", "x": nothing, "y": nothing, "texts": series.texts, "fills": fills}
    entry |= {
        "x": numbers.add(series.x),
        "y": numbers.add(series.y, _read_digits(series)),
        "marker": series.marker,
        "size": series.size,
        "hollow": series.hollow,
    }
    if series.kind == "area":
        entry["opacity"] = series.opacity
    if series.kind == "text":
        entry["texts"] = series.texts[0]
    if series.low is not None and series.high is not None:
        entry |= {
            "low": numbers.add(series.low, _read_digits(series)),
            "high": numbers.add(series.high, _read_digits(series)),
            "interval": series.interval,
        }
    return entry


def shape_numbers(sketch: ShapeSketch) -> dict[str, Any]:
    """What the page's script draws: points, lines, and every mode's motion as real and imaginary part."""
    return {
        "names": sketch.names,
        "positions": sketch.positions.round(SHAPE_DIGITS).tolist(),
        "lines": sketch.lines.tolist(),
        "reach": REACH,
        "modes": [
            {"title": title, "real": moved.real.round(SHAPE_DIGITS).tolist(), "imaginary": moved.imag.round(SHAPE_DIGITS).tolist()}
            for title, moved in zip(sketch.titles, sketch.motion, strict=True)
        ],
    }
