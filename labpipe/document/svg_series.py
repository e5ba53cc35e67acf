"""Every kind of series of a chart in SVG. PAINTERS by kind; colours and looks by class are those of the page's style."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.document.chart_layout import SCALE_GAP, SCALE_NUMBERS, SCALE_WIDTH, SMALL
from labpipe.document.letters import LEADING, text_width
from labpipe.document.palette import HEAT, heat, ink_on
from labpipe.document.svg_elements import PER_POINT, NamedPlace, closed, joined, path, rectangle, runs, stamped, words
from labpipe.report.chart import GREY, Series

# Dashes and gaps as multiples of the line's width.
DASHES = {"-": (), "--": (3.7, 1.6), ":": (1.0, 1.65), "-.": (6.4, 1.6, 1.0, 1.6)}
# Marks are larger than their size by this [pt], so that the smallest are seen.
RIM = 0.6
BAR_WIDTH, BAR_CAP, LEAST_CAPPED = 0.8, 2.0, 3.0
HEAD = 5.0


def ink(colour: int) -> str:
    """The colour of a series by its number, as the page's style names it."""
    return "var(--rule)" if colour == GREY else f"var(--c{colour})"


def painted(series: Series, place: NamedPlace) -> str:
    """A series in its colour."""
    inside = PAINTERS[series.kind](series, place)
    return f'<g style="color:{ink(series.colour)}">{inside}</g>' if inside else ""


def stroke(width: float, line: str = "-") -> str:
    """The attributes of a line of a width [pt]."""
    dashes = " ".join(f"{PER_POINT * width * part:.3g}" for part in DASHES.get(line, ()))
    return f'class="curve" stroke-width="{PER_POINT * width:g}"' + (f' stroke-dasharray="{dashes}"' if dashes else "")


def marks(series: Series, points: np.ndarray) -> str:
    """The marks of a series at points (n, 2) [units of 0.1 pt]."""
    size = round(PER_POINT * (series.size + RIM))
    half = size // 2
    if series.marker == "v":
        return path(stamped(points, f"m{-half}-{half}h{size}l{-half} {size}zm{half} {half}".replace(" -", "-")), 'class="head"')
    if series.hollow:
        ring = f"m{-half} 0a{half} {half} 0 1 0 {2 * half} 0a{half} {half} 0 1 0{-2 * half} 0m{half} 0"
        square = f"m{-half}-{half}h{2 * half}v{2 * half}h{-2 * half}zm{half} {half}"
        return path(stamped(points, square if series.marker == "s" else ring), 'class="hollow"')
    kind = "dots square" if series.marker == "s" else "dots"
    return path(stamped(points, "h0"), f'class="{kind}" stroke-width="{size}"')


def _line(series: Series, place: NamedPlace) -> str:
    """Points joined or not, with the interval around them."""
    points = place.points(series.x, series.y)
    parts = [_interval(series, place)]
    if series.line:
        parts.append(path(joined(points), stroke(series.width, series.line)))
    if series.marker:
        parts.append(marks(series, points))
    return "".join(parts)


def _interval(series: Series, place: NamedPlace) -> str:
    if series.low is None or series.high is None:
        return ""
    low, high = place.points(series.x, series.low), place.points(series.x, series.high)
    if series.interval == "shaded":
        both = runs(np.hstack([low, high]))
        return path("".join(closed(np.concatenate([low[run], high[run][::-1]])) for run in both), _shade(series))
    return path(_bars(series, low, high), stroke(BAR_WIDTH))


def _bars(series: Series, low: np.ndarray, high: np.ndarray) -> str:
    """Uprights between two ends (n, 2), with caps where the marks are large enough for them."""
    there = np.isfinite(np.hstack([low, high])).all(axis=1)
    cap = round(PER_POINT * BAR_CAP) if series.size >= LEAST_CAPPED else 0
    ends = np.column_stack([low[there], high[there, 1]]).astype(np.int64).tolist()
    caps = [f"M{x - cap} {down}h{2 * cap}m{-2 * cap} {up - down}h{2 * cap}" if cap else "" for x, down, up in ends]
    return "".join(f"M{x} {down}V{up}{ticks}" for (x, down, up), ticks in zip(ends, caps, strict=True))


def _shade(series: Series) -> str:
    return f'class="shade" style="fill-opacity:{series.opacity:g}"'


def _area(series: Series, place: NamedPlace) -> str:
    points = place.points(series.x, series.y)
    edge = f"stroke:var(--rule);stroke-width:{PER_POINT * series.width:g};" if series.width else ""
    look = f'class="shade" style="{edge}fill-opacity:{series.opacity:g}"'
    return path(closed(points[np.isfinite(points).all(axis=1)]), look)


def _level(series: Series, place: NamedPlace) -> str:
    """A line across with its name at its end."""
    (down,) = place.y.places(series.y)
    line = path(_rule(place.box.left, down, place.box.right, down), stroke(series.width, series.line))
    return line + (words(series.name, place.box.right - 4, down - 3, SMALL, "end") if series.name else "")


def _upright(series: Series, place: NamedPlace) -> str:
    (across,) = place.x.places(series.x)
    return path(_rule(across, place.box.bottom, across, place.box.top), stroke(series.width, series.line))


def _rule(*ends: float) -> str:
    """A straight line from (x, y) to (x, y) [pt]."""
    x, y, to_x, to_y = (round(PER_POINT * end) for end in ends)
    return f"M{x} {y}L{to_x} {to_y}"


def _level_span(series: Series, place: NamedPlace) -> str:
    low, high = place.y.places(series.y).tolist()
    return rectangle(place.box.left, min(low, high), place.box.width, abs(high - low), _shade(series))


def _upright_span(series: Series, place: NamedPlace) -> str:
    low, high = place.x.places(series.x).tolist()
    return rectangle(min(low, high), place.box.top, abs(high - low), place.box.height, _shade(series))


def _cells(series: Series, place: NamedPlace) -> str:
    """A heat map with the text of every cell and the scale beside it."""
    across, down = place.box.width / series.y.shape[1], place.box.height / series.y.shape[0]
    parts = []
    for (row, column), value in np.ndenumerate(series.y):
        left, top, fill = place.box.left + column * across, place.box.top + row * down, heat(float(value))
        parts.append(rectangle(left, top, across, down, f'fill="{fill}"'))
        text = series.texts[row][column]
        below = SMALL * (LEADING * text.count("\n") / 2 + 0.36)
        parts.append(words(text, left + across / 2, top + down / 2 + below, SMALL, colour=ink_on(fill)))
    return "".join(parts) + _scale_of_heat(series.name, place)


def _scale_of_heat(title: str, place: NamedPlace) -> str:
    """The colours from -1 to 1 with their numbers and what they say, right of the matrix."""
    box, left = place.box, place.box.right + SCALE_GAP
    stops = "".join(f'<stop offset="{part / (len(HEAT) - 1):g}" stop-color="{colour}"/>' for part, colour in enumerate(HEAT))
    ground = f'<linearGradient id="{place.name}-heat" x1="0" y1="1" x2="0" y2="0">{stops}</linearGradient>'
    bar = rectangle(left, box.top, SCALE_WIDTH, box.height, f'fill="url(#{place.name}-heat)"')
    numbers = left + SCALE_WIDTH + SCALE_NUMBERS
    ends = [(-1.0, "\N{MINUS SIGN}1"), (-0.5, "\N{MINUS SIGN}0.5"), (0.0, "0"), (0.5, "0.5"), (1.0, "1")]
    texts = [words(text, numbers, box.bottom - (value + 1) / 2 * box.height + 0.36 * SMALL, SMALL, "start") for value, text in ends]
    beside = numbers + text_width(ends[1][1], SMALL) + 1.4 * SMALL
    named = words(title, beside, box.middle[1], SMALL + 1, turned=-90) if title else ""
    return ground + bar + "".join(texts) + named


def _arrow(series: Series, place: NamedPlace) -> str:
    """A line with a head, whose tip is the second point."""
    tail, tip = place.points(series.x, series.y)
    long = float(np.hypot(*(tip - tail)))
    if not np.isfinite(long) or long == 0:
        return ""
    ahead = PER_POINT * HEAD * (tip - tail) / long
    aside = np.array([-ahead[1], ahead[0]]) / 2
    foot = np.rint(tip - ahead)
    corners = np.rint(np.array([tip, tip - ahead + aside, tip - ahead - aside]))
    return path(joined(np.array([tail, foot])), stroke(1.0)) + path(closed(corners), 'class="head"')


def _text(series: Series, place: NamedPlace) -> str:
    """Words with their middle at the points."""
    across, down = place.x.places(series.x), place.y.places(series.y) + 0.36 * series.size
    places = zip(across.tolist(), down.tolist(), series.texts[0], strict=True)
    return "".join(words(text, x, y, series.size, colour="currentColor") for x, y, text in places)


PAINTERS: dict[str, Callable[[Series, NamedPlace], str]] = {
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
