"""The numbers of a figure: as JSON for the script of a page, as CSV, and as a table for readers without
script.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.json_file import named_entries
from labpipe.artefacts.writing import cell
from labpipe.report.chart import GREY, Axis, Chart, Panel, Series
from labpipe.report.document import Table
from labpipe.report.figures import REACH, ShapeSketch

# Digits of places along an axis, which zooming must tell apart, and the fewest of what is read there.
DIGITS, READ_DIGITS = 7, 5
# Digits of places of a structure, which is 1 in size.
SHAPE_DIGITS = 4
# Digits of a cell of a heat map, which is a colour.
CELL_DIGITS = 3
# Largest n of a double that is 10^n, and from where on whole numbers are written as powers.
EXACT_POWER, LARGEST_WHOLE = 22, 1e15
RULE = "var(--rule)"
COLUMNS = ("panel", "series", "x axis", "x", "y axis", "y", "low", "high", "interval")
# Those that are numbers: x, y, low and high.
READ = (3, 5, 6, 7)
# Rows of the table of a figure, and letters of a file's name.
MOST_ROWS, MOST_LETTERS = 60, 48


class NumberList:
    """Arrays of one figure, each kept once: curves of one figure share their abscissa."""

    def __init__(self) -> None:
        self.lists: list[list[float | None]] = []
        self._places: dict[bytes, int] = {}

    def add(self, values: FloatArray, digits: int = DIGITS) -> int:
        """The place of *values* (n,) [unit of their axis] in the list, rounded to the *digits* that a screen
        can show.
        """
        rounded = _round(np.ravel(values), digits)
        key = rounded.tobytes()
        if key not in self._places:
            self._places[key] = len(self.lists)
            self.lists.append(_as_json(rounded))
        return self._places[key]


def _read_digits(series: Series) -> int:
    """Digits of what a series shows: more where it differs little from a constant, whose digits say
    nothing.
    """
    shown = [part[np.isfinite(part)] for part in (series.y, series.low, series.high) if part is not None]
    values = np.concatenate([part.ravel() for part in shown])
    span = float(np.ptp(values)) if values.size else 0.0
    if span == 0:
        return DIGITS
    return min(DIGITS, READ_DIGITS + max(0, round(math.log10(float(np.max(np.abs(values))) / span))))


def _round(values: FloatArray, digits: int) -> FloatArray:
    """The double nearest to each of *values* (n,) [any unit] with so many decimal digits; nan for none."""
    finite = np.where(np.isfinite(values), values, np.nan)
    size = np.log10(np.abs(finite), out=np.zeros(finite.size), where=finite != 0)
    places = digits - 1 - np.nan_to_num(np.floor(size))
    # A whole number over a power of ten that is one itself is the nearest double.
    power = 10.0 ** np.minimum(np.abs(places), EXACT_POWER)
    with np.errstate(over="ignore"):
        rounded = np.where(places >= 0, np.round(finite * power) / power, np.round(finite / power) * power)
    for n in np.flatnonzero(np.abs(places) > EXACT_POWER):
        rounded[n] = float(f"{finite[n]:.{digits}g}")
    return rounded


def _as_json(values: FloatArray) -> list[float | None]:
    """Numbers (n,) [any unit] as JSON writes them shortest: whole ones without a point, none as null."""
    whole = (np.floor(values) == values) & (np.abs(values) < LARGEST_WHOLE)
    if whole.all():
        return values.astype(int).tolist()
    pairs = zip(values.tolist(), whole.tolist(), strict=True)
    return [int(x) if is_whole else x if math.isfinite(x) else None for x, is_whole in pairs]


def figure_json(chart: Chart) -> str:
    """The chart for the page's script."""
    numbers = NumberList()
    panels = [_panel(chart, number, numbers) for number in range(len(chart.panels))]
    size = {"height": chart.size[1], "rows": chart.rows, "columns": chart.columns}
    return json_text({**size, "panels": panels, "numbers": numbers.lists})


def json_text(entry: dict[str, Any]) -> str:
    """An entry as JSON; no text of it can end the script element that it stands in."""
    text = json.dumps(entry, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _panel(chart: Chart, number: int, numbers: NumberList) -> dict[str, Any]:
    panel = chart.panels[number]
    return {
        "title": panel.title,
        "share": chart.heights[number // chart.columns],
        "equal": panel.equal,
        "pick": panel.pick,
        "x": _axis(panel.x, chart.limits(number, "x"), chart.group(number, "x")),
        "y": _axis(panel.y, chart.limits(number, "y"), chart.group(number, "y")),
        "series": [_series(series, numbers) for series in panel.series],
    }


def _axis(axis: Axis, limits: tuple[float, float], group: int) -> dict[str, Any]:
    return {
        **named_entries(axis, "title", "unit", "label"),
        "limits": [float(f"{end:.12g}") for end in limits],
        "log": axis.logarithmic,
        "group": group,
        "ticks": [list(tick) for tick in axis.ticks],
    }


def _series(series: Series, numbers: NumberList) -> dict[str, Any]:
    colour = RULE if series.colour == GREY else series.colour
    entry = {
        **named_entries(series, "kind", "name"),
        "colour": colour,
        **named_entries(series, "line", "width"),
    }
    if series.entry:
        entry["entry"] = series.entry
    if series.kind == "cells":
        nothing = numbers.add(np.empty(0))
        values = [_as_json(_round(row, CELL_DIGITS)) for row in series.y]
        entry |= {"name": "", "scale": series.name, "x": nothing, "y": nothing}
        return {**entry, "texts": series.texts, "values": values}
    entry |= {
        "x": numbers.add(series.x),
        "y": numbers.add(series.y, _read_digits(series)),
        **named_entries(series, "marker", "size", "hollow"),
    }
    if series.kind in ("area", "hspan") or series.interval == "shaded":
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
            {
                "title": title,
                "real": moved.real.round(SHAPE_DIGITS).tolist(),
                "imaginary": moved.imag.round(SHAPE_DIGITS).tolist(),
            }
            for title, moved in zip(sketch.titles, sketch.motion, strict=True)
        ],
    }


def short_name(caption: str) -> str:
    """A caption as part of a file's name: its first words in small letters."""
    plain = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")
    return plain[:MOST_LETTERS].rpartition("-")[0] if len(plain) > MOST_LETTERS else plain


def figure_csv(chart: Chart, caption: str) -> str:
    """One row per point with the units of the axes; low and high: ends of its interval."""
    stream = io.StringIO()
    stream.write("# " + caption.replace("\n", " ") + "\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for count, row in _rows_of_series(chart):
        writer.writerows(map(cell, row(n)) for n in range(count))
    return stream.getvalue()


def figure_table(chart: Chart) -> Table:
    """The same rows for a page without script: of a long series a few, its first and last among them."""
    every = _rows_of_series(chart)
    room = max(2, MOST_ROWS // max(len(every), 1))
    chosen = [
        row(n)
        for count, row in every
        for n in sorted({round(at) for at in np.linspace(0, count - 1, min(room, count))})
    ]
    left_out = sum(count for count, _ in every) - len(chosen)
    caption = f"{len(chosen)} of {len(chosen) + left_out} points" if left_out else ""
    rows = tuple(tuple(_short(text) if n in READ else text for n, text in enumerate(row)) for row in chosen)
    return Table(COLUMNS, rows, caption, READ)


def _short(text: str) -> str:
    try:
        return f"{float(text):.{READ_DIGITS}g}"
    except ValueError:
        return text


# The number of rows of one series, and what makes each: a table shows few of many.
Rows = tuple[int, Callable[[int], list[str]]]


def _rows_of_series(chart: Chart) -> list[Rows]:
    """The rows of every series but arrows, which show a sense of rotation only."""
    return [
        (_cell_rows if series.kind == "cells" else _point_rows)(panel, panel.title or str(number), series)
        for number, panel in enumerate(chart.panels, 1)
        for series in panel.series
        if series.kind != "arrow"
    ]


def _cell_rows(panel: Panel, name: str, series: Series) -> Rows:
    columns, rows = (
        [label for _, label in axis.ticks] or [str(n) for n in range(max(series.y.shape))]
        for axis in (panel.x, panel.y)
    )

    def row(n: int) -> list[str]:
        r, c = divmod(n, series.y.shape[1])
        return [name, rows[r], "", columns[c], "", _number(series.y, n), "", "", ""]

    return series.y.size, row


def _point_rows(panel: Panel, name: str, series: Series) -> Rows:
    def row(n: int) -> list[str]:
        return [
            name,
            series.texts[0][n] if series.kind == "text" else series.name or series.kind,
            panel.x.label,
            _number(series.x, n),
            panel.y.label,
            _number(series.y, n),
            _number(series.low, n),
            _number(series.high, n),
            series.interval,
        ]

    return max(series.x.size, series.y.size), row


def _number(values: FloatArray | None, n: int) -> str:
    value = float(values.flat[n]) if values is not None and n < values.size else math.nan
    return f"{value:.12g}" if math.isfinite(value) else ""
