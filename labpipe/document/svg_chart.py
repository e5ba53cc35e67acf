"""A chart as SVG within a page, from its numbers alone: for print and for readers without the page's script.

Colours and widths of frames are the page's: its style names the classes used here.
"""

from __future__ import annotations

import math
from html import escape
from itertools import pairwise

import numpy as np

from labpipe.document.chart_layout import (
    GAP,
    MARK,
    POINTS_PER_INCH,
    TURNED_LETTERS,
    names_height,
    numbers_across,
    numbers_upwards,
    places,
    widest_beside,
)
from labpipe.document.chart_legend import height_above, legends
from labpipe.document.chart_place import Box, Scale
from labpipe.document.chart_words import UPRIGHT, AxisTitles, axis_titles, is_leftmost, is_lowest, turn_of_names
from labpipe.document.letters import CAPITAL, LETTERS, text_height, text_width
from labpipe.document.svg_elements import PER_POINT, NamedPlace, path, rectangle, words
from labpipe.document.svg_legend import legend_above, legend_inside
from labpipe.document.svg_series import painted
from labpipe.report.chart import Chart, Panel, Ticks

# What lies below what, by kind: shades under curves, arrows over them.
DEPTHS = {"cells": 0, "hspan": 0, "vspan": 0, "area": 1, "hline": 2, "vline": 2, "line": 3, "arrow": 4, "text": 4}
# A title of a panel, in a row of one and beside others [pt].
TITLE, SMALL_TITLE = 9.0, 8.0
TICK = 2.5


def chart_svg(chart: Chart, name: str, label: str) -> str:
    """The chart as an SVG element; *name*: what its own definitions begin with, *label*: what it shows, for those who cannot see it."""
    width, height = (POINTS_PER_INCH * size for size in chart.size)
    above, inside = legends(chart)
    titles = axis_titles(chart)
    there = places(chart, height_above(above, width))
    boxes = tuple(place.box for place in there)
    widest = [widest_beside(chart, boxes, column) for column in range(chart.columns)]
    panels = []
    for number, (plain, entries) in enumerate(zip(there, inside, strict=True)):
        panel, place = chart.panels[number], NamedPlace(plain.box, plain.x, plain.y, f"{name}-{number}")
        words_of_axes = _axes(chart, number, place) + _titles(chart, number, place, titles, widest[number % chart.columns])
        panels.append(words_of_axes + _inside(panel, place) + legend_inside(entries, panel, place))
    content = "".join(panels) + legend_above(above, width) + _common(titles, width, height, boxes)
    size = f'width="{width:g}pt" height="{height:g}pt" viewBox="0 0 {PER_POINT * width:g} {PER_POINT * height:g}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} class="drawing" role="img" aria-label="{escape(label)}">{content}</svg>'


def _inside(panel: Panel, place: NamedPlace) -> str:
    """What a panel shows, cut off at its edges, and its note."""
    series = "".join(painted(one, place) for one in sorted(panel.series, key=lambda one: DEPTHS[one.kind]))
    note = words(panel.note, *place.box.middle, LETTERS) if panel.note else ""
    if not series or any(curve.kind == "cells" for curve in panel.series):
        return series + note
    box = place.box
    cut = f'<clipPath id="{place.name}">{rectangle(box.left, box.top, box.width, box.height, "")}</clipPath>'
    return f'{cut}<g clip-path="url(#{place.name})">{series}</g>{note}'


def _axes(chart: Chart, number: int, place: NamedPlace) -> str:
    """Grid, frame and numbers of a panel."""
    panel, box = chart.panels[number], place.box
    across, upwards = numbers_across(panel, place.x.limits, box), numbers_upwards(panel, place.y.limits, box)
    columns = [(float(at), text) for at, text in zip(_places(place.x, across), _texts(across), strict=True)]
    rows = [(float(at), text) for at, text in zip(_places(place.y, upwards), _texts(upwards), strict=True)]
    heat = any(series.kind == "cells" for series in panel.series)
    left, top, right, bottom = (round(PER_POINT * value) for value in (box.left, box.top, box.right, box.bottom))
    grid = "".join(f"M{round(PER_POINT * at)} {top}V{bottom}" for at, _ in columns)
    grid += "".join(f"M{left} {round(PER_POINT * at)}H{right}" for at, _ in rows)
    mark = round(PER_POINT * TICK)
    frame = f"M{left} {top}V{bottom}H{right}" + "".join(f"M{round(PER_POINT * at)} {bottom}v{mark}" for at, _ in columns)
    frame += "".join(f"M{left} {round(PER_POINT * at)}h-{mark}" for at, _ in rows)
    parts = ["" if heat else f'<g class="grid">{path(grid, "")}</g>', path(frame, 'class="frame"')]
    if is_lowest(chart, number):
        parts += _below(columns, box, turn_of_names(chart, number))
    if is_leftmost(chart, number):
        parts += [words(text, box.left - MARK, at + 0.36 * LETTERS, LETTERS, "end") for at, text in rows]
    return "".join(parts)


def _places(scale: Scale, ticks: Ticks) -> list[float]:
    return scale.places(np.array([at for at, _ in ticks], float)).tolist()


def _texts(ticks: Ticks) -> list[str]:
    return [text for _, text in ticks]


def _below(columns: list[tuple[float, str]], box: Box, turned: float) -> list[str]:
    """Numbers or names along an abscissa; of those that would touch each other every second, third ..."""
    if turned:
        upright = turned == UPRIGHT
        down = box.bottom + MARK + (0.0 if upright else CAPITAL * TURNED_LETTERS)
        aside = 0.36 * TURNED_LETTERS if upright else 0.0
        return [words(text, at + aside, down, TURNED_LETTERS, "end", turned=-turned) for at, text in columns]
    widest = max((text_width(text, LETTERS) for _, text in columns), default=0.0) + GAP
    apart = min((abs(after - before) for (before, _), (after, _) in pairwise(columns)), default=widest)
    every = max(1, math.ceil(widest / apart)) if apart > 0 else 1
    foot = box.bottom + MARK + CAPITAL * LETTERS
    return [words(text, at, foot + text_height(text, LETTERS) - text_height("", LETTERS), LETTERS) for at, text in columns[::every]]


def _titles(chart: Chart, number: int, place: NamedPlace, titles: AxisTitles, widest: float) -> str:
    """The title of a panel and those of its axes; *widest*: of the numbers at the ordinates of its column [pt]."""
    panel, box = chart.panels[number], place.box
    x, y = box.middle
    parts = []
    if panel.title:
        parts.append(words(panel.title, x, box.top - GAP, SMALL_TITLE if chart.columns > 1 else TITLE))
    if titles.below[number]:
        names = _texts(numbers_across(panel, place.x.limits, box))
        down = box.bottom + MARK + names_height(names, turn_of_names(chart, number)) + GAP + CAPITAL * LETTERS
        parts.append(words(titles.below[number], x, down, LETTERS))
    if titles.beside[number]:
        parts.append(words(titles.beside[number], box.left - MARK - widest - GAP, y, LETTERS, turned=-90.0))
    return "".join(parts)


def _common(titles: AxisTitles, width: float, height: float, boxes: tuple[Box, ...]) -> str:
    """Titles of axes that are written once for all panels."""
    below = words(titles.common_x, width / 2, height - GAP, LETTERS) if titles.common_x else ""
    middle = (min(box.top for box in boxes) + max(box.bottom for box in boxes)) / 2
    beside = words(titles.common_y, GAP + CAPITAL * LETTERS, middle, LETTERS, turned=-90.0) if titles.common_y else ""
    return below + beside
