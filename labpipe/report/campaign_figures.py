"""The figures of a campaign: a coefficient over a condition, its control chart, and sliding fits of several results together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.control import ControlLimits, straight_trend
from labpipe.errors import FitError
from labpipe.records.identification import Fit, Identification, of_points
from labpipe.report.chart import Axis, Panel, Series, curve, dots, level, named_ticks, stacked
from labpipe.report.coefficient_series import CoefficientSeries
from labpipe.report.document import Figure
from labpipe.report.figures import CENTRE, sliding_curve, sliding_names
from labpipe.report.wording import unit_text

MOST_TOGETHER = 12
LONGEST_NAME = 24
# Points of a trend line, so that its band bends smoothly.
N_TREND = 41


def trend_figure(series: CoefficientSeries, condition: str) -> Figure:
    """Values with their 95 % intervals over a condition; the weighted line with its 95 % interval where there are three or more."""
    axis, x = series.over()[condition]
    low, high = series.intervals().T
    tests = dots("tests", x, series.shown(), marker="o", size=4.0, bars=(low, high))
    chart = stacked([Panel(axis, series.axis, (*_line(series, x), tests))], 3.0)
    caption = f"{series.title} over {condition}: tests with their 95 % intervals; line: weighted straight trend, shaded: its 95 % interval."
    return Figure(chart, caption, f"{series.title} of {len(series.values)} tests over {condition}")


def _line(series: CoefficientSeries, x: FloatArray) -> tuple[Series, ...]:
    """The weighted line over x (n,) with its 95 % interval; nothing where the tests do not carry one."""
    try:
        line = straight_trend(x, series.shown(), series.joint_errors())
    except FitError:
        return ()
    drawn = np.linspace(x.min(), x.max(), N_TREND)
    columns = np.column_stack([np.ones_like(drawn), drawn - np.mean(x)])
    middle = columns @ line.values
    reach = line.quantile * np.sqrt(np.einsum("ij,jk,ik->i", columns, line.covariance, columns))
    return (curve("trend", drawn, middle, 1, band=(middle - reach, middle + reach)),)


def control_figure(series: CoefficientSeries, limits: ControlLimits) -> Figure:
    """The values in their order with centre and limits; those outside are ringed."""
    values = series.shown()
    places, outside = np.arange(1, values.size + 1), list(limits.outside)
    ringed = [dots("outside", places[outside], values[outside], 1, marker="o", size=10.0, hollow=True)] if outside else []
    ends = [level(end, 1, "--", width=1.0) for end in (limits.low, limits.high)]
    tests = curve("tests", places, values, marker=".", size=4.0)
    names = [_place_name(series, n) for n in range(values.size)]
    x = Axis("tests by date" if series.dated else "tests in the order given", ticks=named_ticks(names, 1.0))
    chart = stacked([Panel(x, series.axis, (tests, *ringed, level(limits.centre, width=0.9), *ends))], 3.0)
    caption = f"{series.title}: individuals chart; full line: mean, dashed: mean ∓ 3 × mean moving range / 1.128."
    return Figure(chart, caption, f"Control chart of {series.title} with {len(outside)} values outside its limits")


def _place_name(series: CoefficientSeries, number: int) -> str:
    value = series.values[number]
    return str(value.day) if series.dated else value.label[-LONGEST_NAME:]


def sliding_overlays(results: Sequence[tuple[str, Identification]]) -> list[Figure]:
    """Every coefficient of sliding fits over frequency, one curve per test; where two tests or more have them."""
    groups: dict[tuple[str, str], dict[str, list[Fit]]] = {}
    for result, identification in results:
        for fit in identification.fits:
            label = f"{result}, {fit.test}" if fit.test and result else fit.test or result
            groups.setdefault((fit.name, fit.term), {}).setdefault(label, []).append(fit)
    figures: list[Figure] = []
    for (name, term), tests in groups.items():
        sliding = {label: fits for label, fits in tests.items() if len(fits) > 1 and not of_points(fits[0].model)}
        if len(sliding) > 1:
            title = f"{name} of {term}" if term else name
            figures.extend(_overlay(title, parameter, sliding) for parameter in sliding_names(next(iter(sliding.values()))))
    return figures


def _overlay(title: str, parameter: str, tests: dict[str, list[Fit]]) -> Figure:
    series = []
    for number, (label, fits) in enumerate(list(tests.items())[:MOST_TOGETHER]):
        shared = [fit for fit in fits if any(p.name == parameter for p in fit.parameters)]
        if shared:
            series.append(sliding_curve(shared, parameter, label, number, 0.15))
    unit = unit_text(next(iter(tests.values()))[0].parameter(parameter).unit)
    more = f"; the first {MOST_TOGETHER} of {len(tests)}" if len(tests) > MOST_TOGETHER else ""
    caption = f"{title}: {parameter} over frequency of {len(tests)} tests, shaded: 95 % intervals{more}."
    chart = stacked([Panel(CENTRE, Axis(parameter, unit), tuple(series))], 3.4)
    return Figure(chart, caption, f"{parameter} of {title} over frequency in {len(tests)} tests")
