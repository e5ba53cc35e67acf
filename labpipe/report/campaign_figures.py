"""The figures of a campaign: a coefficient over a condition, its control chart, and sliding fits of several results together."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from labpipe.campaign.control import ControlLimits, straight_trend
from labpipe.errors import FitError
from labpipe.quantities import display_unit, to_display
from labpipe.records.identification import Fit, Identification
from labpipe.report.coefficient_series import CoefficientSeries
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import stacked_axes
from labpipe.report.wording import unit_text

MOST_TOGETHER = 12


def trend_figure(one: CoefficientSeries, condition: str) -> Figure:
    """Values with their 95 % intervals over a condition; the weighted line with its 95 % interval where there are three or more."""
    label, x = one.over()[condition]
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.0)
        _bars(axes, one, x)
        _line(axes, one, x)
        axes.set_xlabel(label)
        axes.set_ylabel(one.axis)
        axes.legend(fontsize=8)
    caption = f"{one.title} over {condition}: tests with their 95 % intervals; line: weighted straight trend, shaded: its 95 % interval."
    return Figure(canvas, caption, f"{one.title} of {len(one.values)} tests over {condition}")


def _bars(axes: Axes, one: CoefficientSeries, x: np.ndarray) -> None:
    values, ends = one.shown(), one.intervals()
    reach = np.nan_to_num(np.abs(ends.T - values))
    axes.errorbar(x, values, reach, fmt="o", color=COLOURS[0], label="tests", capsize=2, markersize=4)


def _line(axes: Axes, one: CoefficientSeries, x: np.ndarray) -> None:
    try:
        line = straight_trend(x, one.shown(), one.errors())
    except FitError:
        return
    drawn = np.linspace(x.min(), x.max(), 41)
    columns = np.column_stack([np.ones_like(drawn), drawn - np.mean(x)])
    middle = columns @ line.values
    reach = line.quantile * np.sqrt(np.einsum("ij,jk,ik->i", columns, line.covariance, columns))
    axes.plot(drawn, middle, "-", color=COLOURS[1], linewidth=1, label="trend")
    axes.fill_between(drawn, middle - reach, middle + reach, color=COLOURS[1], alpha=0.15, linewidth=0)


def control_figure(one: CoefficientSeries, limits: ControlLimits) -> Figure:
    """The values in their order with centre and limits; those outside are ringed."""
    values = one.shown()
    places = np.arange(1, values.size + 1)
    outside = list(limits.outside)
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.0)
        axes.plot(places, values, ".-", color=COLOURS[0], linewidth=1, markersize=8, label="tests")
        if outside:
            axes.plot(places[outside], values[outside], "o", color=COLOURS[1], markerfacecolor="none", markersize=10, label="outside")
        axes.axhline(limits.centre, color="0.4", linewidth=0.9)
        for end in (limits.low, limits.high):
            axes.axhline(end, color=COLOURS[1], linewidth=1, linestyle="--")
        axes.set_xticks(places, [_place_name(one, n) for n in range(values.size)], rotation=25, ha="right", fontsize=7)
        axes.set_ylabel(one.axis)
        axes.set_xlabel("tests by date" if one.dated else "tests in the order given")
        axes.legend(fontsize=8)
    caption = f"{one.title}: individuals chart; full line: mean, dashed: mean ∓ 3 × mean moving range / 1.128."
    return Figure(canvas, caption, f"Control chart of {one.title} with {len(outside)} values outside its limits")


def _place_name(one: CoefficientSeries, number: int) -> str:
    value = one.values[number]
    return str(value.day) if one.dated else value.label[-24:]


def sliding_overlays(results: Sequence[tuple[str, Identification]]) -> list[Figure]:
    """Every coefficient of sliding fits over frequency, one curve per test; where two tests or more have them."""
    groups: dict[tuple[str, str], dict[str, list[Fit]]] = {}
    for result, identification in results:
        for fit in identification.fits:
            label = f"{result}, {fit.test}" if fit.test and result else fit.test or result
            groups.setdefault((fit.name, fit.term), {}).setdefault(label, []).append(fit)
    found = []
    for (name, term), tests in groups.items():
        sliding = {label: fits for label, fits in tests.items() if len(fits) > 1 and fits[0].model != "straight-line"}
        if len(sliding) > 1:
            title = f"{name} of {term}" if term else name
            found.extend(_overlay(title, parameter, sliding) for parameter in _coefficients(next(iter(sliding.values()))))
    return found


def _coefficients(fits: Sequence[Fit]) -> list[str]:
    return [p.name for p in fits[0].parameters if p.unit in ("N/m", "N.s/m") and not p.derived]


def _overlay(title: str, parameter: str, tests: dict[str, list[Fit]]) -> Figure:
    si_unit = next(iter(tests.values()))[0].parameter(parameter).unit
    factor = to_display(1.0, display_unit(si_unit))
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.4)
        for number, (label, fits) in enumerate(list(tests.items())[:MOST_TOGETHER]):
            colour = COLOURS[number % len(COLOURS)]
            known = [fit for fit in fits if any(p.name == parameter for p in fit.parameters)]
            centres = np.array([fit.centre_hz for fit in known])
            values = factor * np.array([fit.parameter(parameter).value for fit in known])
            ends = factor * np.array([fit.parameter(parameter).ci95 or (np.nan, np.nan) for fit in known])
            style = ("-", "--")[number // len(COLOURS) % 2]
            axes.plot(centres, values, style, marker=".", color=colour, linewidth=1, label=label)
            axes.fill_between(centres, ends[:, 0], ends[:, 1], color=colour, alpha=0.15, linewidth=0)
        axes.set_xlabel("centre of the band [Hz]")
        axes.set_ylabel(f"{parameter} [{unit_text(si_unit)}]")
        axes.legend(fontsize=8)
    more = f"; the first {MOST_TOGETHER} of {len(tests)}" if len(tests) > MOST_TOGETHER else ""
    caption = f"{title}: {parameter} over frequency of {len(tests)} tests, shaded: 95 % intervals{more}."
    return Figure(canvas, caption, f"{parameter} of {title} over frequency in {len(tests)} tests")
