"""Figures of a coefficient in many tests: points where they can be told apart, else the share of tests within bands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import FloatArray
from labpipe.campaign.control import ControlLimits
from labpipe.quantities import readable_unit, to_display
from labpipe.records.test_columns import TestColumns
from labpipe.report.chart import Axis, Panel, Series, curve, dots, level, stacked
from labpipe.report.document import Figure
from labpipe.report.wording import legible, unit_text

Points = tuple[FloatArray, FloatArray]
HEIGHT = 2.6
# Points that are drawn one by one, with their intervals.
MOST_POINTS = 300
# Groups of neighbouring tests, each with its median and bands, where there are more.
GROUPS = 60
# Ends of the bands, as shares of the tests.
OUTER, INNER = (0.025, 0.975), (0.25, 0.75)
# Points beyond the outer band that are drawn all the same, the furthest first.
MOST_BEYOND = 100
BANDS = "shaded: half and 95 % of the tests"


def over_tests(columns: TestColumns, limits: ControlLimits) -> Figure:
    """The values in the order of dates and names, with centre and control limits."""
    there = np.isfinite(columns.values)
    values, unit = _shown(columns, columns.values[there])
    centre, low, high = _shown(columns, np.array([limits.centre, limits.low, limits.high]))[0]
    x = np.arange(1.0, values.size + 1)
    lines = (level(float(centre), width=0.9), *(level(float(end), 1, "--", width=1.0) for end in (low, high)))
    drawn, how = _drawn(x, values, columns, there)
    chart = stacked([Panel(Axis("tests by date and name"), Axis(columns.parameter, legible(unit)), (*drawn, *lines))], HEIGHT)
    caption = f"{columns.title} by date and name{how}; full line: mean, dashed: mean ∓ 3 × mean moving range / 1.128."
    return Figure(chart, caption, f"{columns.title} in {values.size} tests, {len(limits.outside)} outside the control limits")


def over_amount(columns: TestColumns, condition: str) -> Figure:
    """The values over a condition."""
    unit, amounts = columns.amounts[condition]
    there = np.isfinite(columns.values) & np.isfinite(amounts)
    values, shown = _shown(columns, columns.values[there])
    below = readable_unit(unit, amounts[there])
    x = np.array([to_display(amount, below) for amount in amounts[there]])
    drawn, how = _drawn(x, values, columns, there)
    chart = stacked([Panel(Axis(condition, legible(below)), Axis(columns.parameter, legible(shown)), drawn)], HEIGHT)
    return Figure(chart, f"{columns.title} over {condition}{how}.", f"{columns.title} of {values.size} tests over {condition}")


def _shown(columns: TestColumns, values: FloatArray) -> tuple[FloatArray, str]:
    """Values (n,) [SI] in the unit that suits them all."""
    unit = readable_unit(columns.unit, columns.values) if columns.unit != "1" else unit_text("1")
    return (np.array([to_display(value, unit) for value in values]) if unit else values), unit


def _drawn(x: FloatArray, values: FloatArray, columns: TestColumns, there: NDArray[np.bool_]) -> tuple[tuple[Series, ...], str]:
    """Points with their intervals, or of more tests the median and bands of groups; and how the caption says it."""
    if values.size <= MOST_POINTS:
        low, high = (_shown(columns, end[there])[0] for end in (columns.low, columns.high))
        return (dots("tests", x, values, size=3.0, bars=(low, high)),), ", with 95 % intervals"
    order = np.argsort(x, kind="stable")
    groups = _groups(x[order])
    middle = np.array([np.median(x[order][group]) for group in groups])
    shares = (*OUTER, 0.5, *INNER)
    ends = np.array([np.quantile(values[order][group], shares) for group in groups]).T
    below, above, median, lower, upper = ends
    beyond = _furthest(x[order], values[order], groups, below, above)
    outer = curve("95 % of the tests", middle, median, 0, "", band=(below, above), opacity=0.15)
    inner = curve("median and half of the tests", middle, median, 0, band=(lower, upper), marker=".", opacity=0.3)
    return (outer, inner, dots("beyond", *beyond, 1, size=3.0)), f", {BANDS}"


def _groups(x: FloatArray) -> list[FloatArray]:
    """Places of neighbouring abscissas, ascending: one group for each where they are few, else groups of equal size."""
    _, first = np.unique(x, return_index=True)
    if first.size <= GROUPS:
        return np.split(np.arange(x.size), first[1:])
    return np.array_split(np.arange(x.size), GROUPS)


def _furthest(x: FloatArray, values: FloatArray, groups: list[FloatArray], low: FloatArray, high: FloatArray) -> Points:
    """The points furthest beyond the outer band, in widths of the band of their group."""
    number = np.repeat(np.arange(len(groups)), [group.size for group in groups])
    width = np.maximum(high - low, np.finfo(float).tiny)[number]
    distance = np.maximum(low[number] - values, values - high[number]) / width
    furthest = np.argsort(-distance, kind="stable")[:MOST_BEYOND]
    kept = np.sort(furthest[distance[furthest] > 0])
    return x[kept], values[kept]
