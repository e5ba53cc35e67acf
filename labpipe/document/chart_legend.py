"""The legend of a chart: one entry for every name in a colour, above the panels or where a panel has room."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.document.chart_place import Box, Place
from labpipe.document.letters import text_width
from labpipe.report.chart import Chart, Panel, Series

LETTERS = 8.0
LINE = 1.35 * LETTERS
SAMPLE, GAP, APART = 18.0, 4.0, 10.0
# Around a legend within a panel [pt], the part of the panel's width that it may take, and its most columns.
INSET, WIDEST, MOST_COLUMNS = 4.0, 0.94, 5
# A curve of fewer points is looked at in so many steps where a legend seeks its place.
STEPS = 200
# Where a legend may stand, as parts of the room that it leaves free: the first of those that hide least.
CORNERS = ((1.0, 0.0), (0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.5, 0.0), (0.5, 1.0), (1.0, 0.5), (0.0, 0.5), (0.5, 0.5))
# The room that the name of a level is taken to need [pt].
NAME_ROOM = 60.0
NAMED = ("line", "area")
Entry = tuple[str, int]
Entries = dict[Entry, list[Series]]


def entries_of(panel: Panel) -> Entries:
    """(name, colour) -> the series that it stands for, in the order of the panel."""
    entries: Entries = {}
    for series in panel.series:
        if series.kind in NAMED and series.listed:
            entries.setdefault((series.listed, series.colour), []).append(series)
    return entries


def legends(chart: Chart) -> tuple[Entries, tuple[Entries, ...]]:
    """Above all panels, and in each of them: every entry once, in the first panel that has it."""
    listed: Entries = {}
    panels: list[Entries] = []
    for panel in chart.panels:
        fresh = {entry: series for entry, series in entries_of(panel).items() if entry not in listed}
        listed |= fresh
        panels.append(fresh if chart.legend == "panels" else {})
    return listed if chart.legend == "above" else {}, tuple(panels)


def legend_size(entries: Entries, width: float) -> tuple[int, float, float]:
    """(number of columns, width of one, height) [pt] of a legend that is at most *width* wide [pt]."""
    column_width = SAMPLE + GAP + max((text_width(name, LETTERS) for name, _ in entries), default=0.0) + APART
    columns = max(1, min(len(entries), MOST_COLUMNS, int((width + APART) / column_width)))
    return columns, column_width, LINE * -(-len(entries) // columns)


def height_above(entries: Entries, width: float) -> float:
    """The height of that legend with the gap below it [pt]."""
    return legend_size(entries, width)[2] + 2 * GAP if entries else 0.0


def place_inside(entries: Entries, panel: Panel, place: Place) -> tuple[int, float, float, float]:
    """(number of columns, width of one, left, top) [pt] of the legend within a panel, where it hides least of what is shown."""
    columns, column_width, height = legend_size(entries, WIDEST * place.box.width)
    width = columns * column_width - APART
    seen = _shown(panel, place)
    free = place.box.width - width - 2 * INSET, place.box.height - height - 2 * INSET
    boxes = [_corner(place.box, free, corner, width, height) for corner in CORNERS]
    best = min(boxes, key=lambda box: _hidden(seen, box))
    return columns, column_width, best.left, best.top


def _corner(box: Box, free: tuple[float, float], corner: tuple[float, float], width: float, height: float) -> Box:
    left, top = box.left + INSET + corner[0] * free[0], box.top + INSET + corner[1] * free[1]
    return Box(left, top, left + width, top + height)


def _shown(panel: Panel, place: Place) -> FloatArray:
    """(n, 2) [pt] points on and along what the series show."""
    parts: list[FloatArray] = [np.empty((0, 2))]
    for series in panel.series:
        if series.kind in NAMED:
            ends = [end for end in (series.low, series.high) if end is not None]
            points: list[FloatArray] = [np.column_stack([place.x.places(series.x), place.y.places(values)]) for values in (series.y, *ends)]
            parts += [_along(point) if series.line or series.kind == "area" else point for point in points]
        elif series.kind == "hline":
            across, (down,) = np.linspace(place.box.left, place.box.right, STEPS), place.y.places(series.y)
            # Its name stands above its end.
            parts.append(np.column_stack([across, np.where(across > place.box.right - NAME_ROOM, down - GAP, down)]))
    there = np.concatenate(parts)
    return there[np.isfinite(there).all(axis=1)]


def _along(points: FloatArray) -> FloatArray:
    """A curve through few points (n, 2) by more of them."""
    if not 1 < len(points) < STEPS:
        return points
    at = np.linspace(0, len(points) - 1, STEPS)
    return np.column_stack([np.interp(at, np.arange(len(points)), column) for column in points.T])


def _hidden(points: FloatArray, box: Box) -> int:
    """How many points lie under a box."""
    x, y = points.T
    return int(np.count_nonzero((x > box.left - GAP) & (x < box.right + GAP) & (y > box.top - GAP) & (y < box.bottom + GAP)))
