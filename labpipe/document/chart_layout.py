"""Where the panels of a chart stand, by the room that their words need."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.document.chart_place import Box, Place, Scale
from labpipe.document.chart_words import UPRIGHT, AxisTitles, axis_titles, is_leftmost, is_lowest, turn_of_names
from labpipe.document.letters import LETTERS, text_height, text_width
from labpipe.document.ticks import ticks_of
from labpipe.report.chart import Chart, Panel, Ticks

POINTS_PER_INCH = 72.0
TURNED_LETTERS = SMALL = 7.0
# Room [pt]: from an axis to its numbers, from these to the title, around a panel.
MARK, GAP, ROOM = 5.0, 5.0, 7.0
# Room for one number along an ordinate and along an abscissa [pt], and the least numbers of each.
UP_ROOM, ACROSS_ROOM, LEAST_UP, LEAST_ACROSS = 26.0, 50.0, 3, 2
LEAST_INSIDE = 20.0
# The scale beside a heat map [pt]: away from it, its width, and from it to its numbers.
SCALE_GAP, SCALE_WIDTH, SCALE_NUMBERS = 9.0, 9.0, 4.0
# The layout depends on the numbers, and these on the layout.
ROUNDS = 2


def places(chart: Chart, above: float) -> tuple[Place, ...]:
    """Every panel on a drawing of the chart's size, under a strip of height *above* [pt]."""
    return tuple(_placed(chart, number, box) for number, box in enumerate(_boxes(chart, above)))


def _placed(chart: Chart, number: int, box: Box) -> Place:
    panel = chart.panels[number]
    x, y = _shown_limits(chart, number, box)
    return Place(box, Scale(x, panel.x.logarithmic, box.left, box.right), Scale(y, panel.y.logarithmic, box.bottom, box.top))


def _boxes(chart: Chart, above: float) -> tuple[Box, ...]:
    width, height = (POINTS_PER_INCH * size for size in chart.size)
    even = Box(0.0, 0.0, width / chart.columns, height / chart.rows)
    boxes = (even,) * len(chart.panels)
    for _ in range(ROUNDS):
        boxes = _laid_out(chart, boxes, above)
    return tuple(_of_one_scale(chart, number, box) for number, box in enumerate(boxes))


def numbers_across(panel: Panel, limits: tuple[float, float], box: Box) -> Ticks:
    """The numbers along the abscissa of a panel."""
    return ticks_of(panel.x, limits, most_numbers(False, box.width))


def numbers_upwards(panel: Panel, limits: tuple[float, float], box: Box) -> Ticks:
    """The numbers along the ordinate of a panel."""
    return ticks_of(panel.y, limits, most_numbers(True, box.height))


def most_numbers(upright: bool, length: float) -> int:
    """About how many numbers an axis of a *length* [pt] has room for."""
    return max(LEAST_UP, int(length // UP_ROOM)) if upright else max(LEAST_ACROSS, int(length // ACROSS_ROOM))


def _shown_limits(chart: Chart, number: int, box: Box) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ends of both axes of a panel [their units]; where both have one scale and the box is what it is, one of them is wider."""
    x, y = chart.limits(number, "x"), chart.limits(number, "y")
    if not chart.panels[number].equal or chart.shared:
        return x, y
    unit = max(abs(x[1] - x[0]) / box.width, abs(y[1] - y[0]) / box.height)
    return _widened(x, unit * box.width), _widened(y, unit * box.height)


def _widened(limits: tuple[float, float], length: float) -> tuple[float, float]:
    middle = (limits[0] + limits[1]) / 2
    return middle - length / 2, middle + length / 2


def _of_one_scale(chart: Chart, number: int, box: Box) -> Box:
    """Where axes of one scale move together, the panel is as large as the scale allows, in the middle of its box."""
    if not (chart.panels[number].equal and chart.shared):
        return box
    (left, right), (low, high) = chart.limits(number, "x"), chart.limits(number, "y")
    unit = max((right - left) / box.width, (high - low) / box.height)
    half_width, half_height = (right - left) / unit / 2, (high - low) / unit / 2
    x, y = box.middle
    return Box(x - half_width, y - half_height, x + half_width, y + half_height)


def _laid_out(chart: Chart, boxes: tuple[Box, ...], above: float) -> tuple[Box, ...]:
    """The boxes that leave the room which words of boxes nearly as large need."""
    titles = axis_titles(chart)
    width, height = (POINTS_PER_INCH * size for size in chart.size)
    widest = [widest_beside(chart, boxes, column) for column in range(chart.columns)]
    rooms = np.zeros((4, chart.rows, chart.columns))
    for number, box in enumerate(boxes):
        row, column = divmod(number, chart.columns)
        rooms[:, row, column] = _rooms(chart, number, box, titles, widest[column])
    left, right = rooms[0].max(axis=0), rooms[1].max(axis=0)
    top, bottom = rooms[2].max(axis=1), rooms[3].max(axis=1)
    beside = _strip(titles.common_y)
    wide = max(LEAST_INSIDE, (width - beside - float(np.sum(left + right))) / chart.columns)
    lefts = beside + np.cumsum(left) + np.arange(chart.columns) * wide + np.append(0.0, np.cumsum(right)[:-1])
    free = max(LEAST_INSIDE * chart.rows, height - above - _strip(titles.common_x) - float(np.sum(top + bottom)))
    high = free * np.array(chart.heights)
    tops = above + np.cumsum(top) + np.append(0.0, np.cumsum(high + bottom)[:-1])
    return tuple(_box(lefts, wide, tops, high, *divmod(number, chart.columns)) for number in range(len(boxes)))


def _box(lefts: FloatArray, wide: float, tops: FloatArray, high: FloatArray, row: int, column: int) -> Box:
    left, top = float(lefts[column]), float(tops[row])
    return Box(left, top, left + wide, top + float(high[row]))


def _strip(title: str) -> float:
    """The room for a title that is written once for all panels [pt]."""
    return text_height(title, LETTERS) + GAP if title else 0.0


def _rooms(chart: Chart, number: int, box: Box, titles: AxisTitles, widest: float) -> tuple[float, float, float, float]:
    """What a panel needs to its left and right, above and below [pt]; *widest*: of the numbers at the ordinates of its column [pt]."""
    panel = chart.panels[number]
    left = MARK + widest if is_leftmost(chart, number) else ROOM
    if titles.beside[number]:
        left += GAP + text_height(titles.beside[number], LETTERS)
    below = ROOM
    if is_lowest(chart, number):
        across = numbers_across(panel, _shown_limits(chart, number, box)[0], box)
        below = MARK + names_height([text for _, text in across], turn_of_names(chart, number))
    if titles.below[number]:
        below += GAP + text_height(titles.below[number], LETTERS)
    top = ROOM if not panel.title else text_height(panel.title, LETTERS) + ROOM
    return left, _right_of(panel), top, below


def widest_beside(chart: Chart, boxes: tuple[Box, ...], column: int) -> float:
    """The width of the widest number at the ordinates of a column of panels [pt]."""
    panels = [(number, box) for number, box in enumerate(boxes) if number % chart.columns == column and is_leftmost(chart, number)]
    return max((_widest(chart.panels[number], _shown_limits(chart, number, box)[1], box) for number, box in panels), default=0.0)


def _widest(panel: Panel, limits: tuple[float, float], box: Box) -> float:
    return max((text_width(text, LETTERS) for _, text in numbers_upwards(panel, limits, box)), default=0.0)


def _right_of(panel: Panel) -> float:
    """Half a number of the abscissa stands beyond its end, and beside a heat map stands its scale."""
    if not any(series.kind == "cells" for series in panel.series):
        return 2 * ROOM
    return SCALE_GAP + SCALE_WIDTH + SCALE_NUMBERS + text_width("\N{MINUS SIGN}0.5", SMALL) + 3 * SMALL


def names_height(names: list[str], turned: float) -> float:
    """The height of names along an abscissa, turned by an angle [deg]: in [pt]."""
    if not turned:
        return max((text_height(name, LETTERS) for name in names), default=0.0)
    longest = max((text_width(name, TURNED_LETTERS) for name in names), default=0.0)
    return float(longest * np.sin(np.radians(turned)) + (0.0 if turned == UPRIGHT else TURNED_LETTERS)) + MARK
