"""The figures of a comparison: what a person would draw to see what the numbers say. FIGURES by kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from labpipe.quantities import display_unit, to_display
from labpipe.records.comparison import ComparedPoint, Comparison
from labpipe.records.response import FrequencyResponse
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import logarithmic, stacked_axes
from labpipe.report.loop_figures import band_figures, prediction_figures, sensitivity_figures
from labpipe.report.wording import unit_text

SHOWN_PAIRS = 3


def comparison_figures(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> list[Figure]:
    """The figures of its kind, in their order."""
    if comparison.kind == "reciprocity":
        return _reciprocity(comparison, responses)
    if comparison.kind in OVER_FREQUENCY:
        return OVER_FREQUENCY[comparison.kind](comparison)
    return [FIGURES[comparison.kind](comparison), *([_overlays(comparison)] if comparison.overlays else [])]


def _scale(unit: str) -> float:
    return to_display(1.0, display_unit(unit))


def _abscissa(comparison: Comparison, points: Sequence[ComparedPoint]) -> list[float]:
    """The condition in its display unit, or the number of the test where there is none."""
    if any(point.condition is None for point in points):
        return [float(number) for number in range(1, len(points) + 1)]
    factor = _scale(comparison.condition_unit)
    return [factor * point.condition for point in points if point.condition is not None]


def _label_x(axes: Axes, comparison: Comparison) -> None:
    unit = unit_text(comparison.condition_unit) if comparison.condition_unit else ""
    axes.set_xlabel(f"{comparison.condition or 'test'}{f' [{unit}]' if unit else ''}")


def _label_y(axes: Axes, comparison: Comparison) -> None:
    unit = unit_text(comparison.unit)
    axes.set_ylabel(f"{comparison.subject.split(',')[0]}{f' [{unit}]' if unit else ''}")


def _dots(axes: Axes, comparison: Comparison, points: Sequence[ComparedPoint], label: str, colour: str) -> None:
    """Values with their 95 % intervals."""
    factor = _scale(comparison.unit)
    values = factor * np.array([point.value for point in points])
    ends = factor * np.array([point.ci95 or (point.value, point.value) for point in points])
    _bars(axes, _abscissa(comparison, points), values, ends, colour, label)


def _bars(axes: Axes, x: Sequence[float], values: NDArray[np.floating], ends: NDArray[np.floating], colour: str, label: str = "") -> None:
    """Dots at (x, values), with bars to their *ends* (n, 2)."""
    axes.errorbar(x, values, np.abs(ends.T - values), fmt="o", color=colour, label=label, capsize=2, markersize=4)


def _trend(comparison: Comparison) -> Figure:
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.2)
        _dots(axes, comparison, comparison.points, "tests", COLOURS[0])
        x, y = np.array(comparison.line).T
        drawn = _scale(comparison.condition_unit) * x, _scale(comparison.unit) * y
        axes.plot(*drawn, "-", color=COLOURS[1], linewidth=1, label="fitted law")
        _label_x(axes, comparison)
        _label_y(axes, comparison)
        axes.legend(fontsize=8)
    return _figure(comparison, canvas, "tests with 95 % intervals and the fitted law")


def _difference(comparison: Comparison) -> Figure:
    """Both groups over the condition, and below how far each test is from the mean of its condition."""
    groups = list(dict.fromkeys(point.group for point in comparison.points))
    with mpl.rc_context(STYLE):
        canvas, (above, below) = stacked_axes(2, 4.4, sharex=True, height_ratios=(3, 2))
        for number, group in enumerate(groups):
            own = [point for point in comparison.points if point.group == group]
            _dots(above, comparison, own, group, COLOURS[number % len(COLOURS)])
            away = [100 * (point.value / _mean_at(comparison, point) - 1) for point in own]
            below.plot(_abscissa(comparison, own), away, "o", color=COLOURS[number % len(COLOURS)], markersize=4)
        below.axhline(0.0, color="0.5", linewidth=0.8)
        below.set_ylabel("from the mean [%]")
        _label_y(above, comparison)
        _label_x(below, comparison)
        above.legend(fontsize=8)
    said = f"{' and '.join(groups)} with 95 % intervals of the fits; below: distance from the mean of a condition"
    return _figure(comparison, canvas, said)


def _mean_at(comparison: Comparison, point: ComparedPoint) -> float:
    return float(np.mean([other.value for other in comparison.points if other.condition == point.condition]))


def _repeatability(comparison: Comparison) -> Figure:
    """Every test in its setting; shaded: the scatter within a setting about the mean of all."""
    factor = _scale(comparison.unit)
    groups = list(dict.fromkeys(point.group for point in comparison.points))
    mean, within = (factor * comparison.amount(name).value for name in ("mean", "within"))
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.2)
        for number, group in enumerate(groups):
            own = [point for point in comparison.points if point.group == group]
            places = number + np.linspace(-0.15, 0.15, len(own))
            axes.plot(places, [factor * point.value for point in own], "o", color=COLOURS[0], markersize=4)
            axes.plot([number - 0.3, number + 0.3], [factor * np.mean([point.value for point in own])] * 2, "-", color=COLOURS[1])
        axes.axhline(mean, color="0.5", linewidth=0.8)
        axes.axhspan(mean - within, mean + within, color=COLOURS[0], alpha=0.15, linewidth=0)
        axes.set_xticks(range(len(groups)), groups)
        _label_x(axes, comparison)
        _label_y(axes, comparison)
    return _figure(comparison, canvas, "tests (dots), mean of each setting (bars); shaded: standard deviation within a setting")


def _ratio(comparison: Comparison) -> Figure:
    """Measured and theory over the condition, and their ratio with the common one."""
    canvas = _beside(comparison, "theory", "bearing: measured / theory")
    said = "the measured fit beside the same fit of the theory's curve; below: ratio of the bearings' stiffness, shaded: the common one"
    return _figure(comparison, canvas, said)


def _rayleigh(comparison: Comparison) -> Figure:
    """Measured damping beside beta times stiffness."""
    canvas = _beside(comparison, "Rayleigh damping", "measured / Rayleigh")
    return _figure(comparison, canvas, "measured damping beside that of one beta for all tests; below: their ratio with 95 % intervals")


def _beside(comparison: Comparison, what: str, ratio: str) -> Canvas:
    """Measured and predicted values over the condition; below, their ratio."""
    points = comparison.points
    x, factor = _abscissa(comparison, points), _scale(comparison.unit)
    with mpl.rc_context(STYLE):
        canvas, (above, below) = stacked_axes(2, 5.0, sharex=True, height_ratios=(3, 2))
        _dots(above, comparison, points, "measured", COLOURS[0])
        above.plot(x, [factor * point.theory for point in points if point.theory is not None], "s--", color=COLOURS[1], label=what)
        _label_y(above, comparison)
        above.legend(fontsize=8)
        ratios = np.array([point.ratio for point in points], float)
        ends = np.array([point.ratio_ci95 for point in points], float)
        _bars(below, x, ratios, ends, COLOURS[0])
        if comparison.kind == "ratio":
            _common(below, comparison, "ratio")
        below.axhline(1.0, color="0.5", linewidth=0.8)
        below.set_ylabel(ratio)
        _label_x(below, comparison)
    return canvas


def _common(axes: Axes, comparison: Comparison, name: str) -> None:
    """A common value with its 95 % interval across the whole width."""
    amount = comparison.amount(name)
    axes.axhline(amount.value, color=COLOURS[2], linewidth=1)
    if amount.ci95 is not None:
        axes.axhspan(*amount.ci95, color=COLOURS[2], alpha=0.2, linewidth=0)


def _overlays(comparison: Comparison) -> Figure:
    """The measured curve, the theory's, and the theory times the test's own ratio, at the first and the last condition."""
    with mpl.rc_context(STYLE):
        canvas, panels = stacked_axes(len(comparison.overlays), 0.6 + 2.5 * len(comparison.overlays), sharex=True)
        for axes, each in zip(panels, comparison.overlays, strict=True):
            axes.plot(each.frequency, each.measured, ".", color=COLOURS[0], markersize=2, label="measured")
            axes.plot(each.frequency, each.theory, "--", color=COLOURS[1], linewidth=1, label="theory")
            axes.plot(each.frequency, each.matched, "-", color=COLOURS[2], linewidth=1, label="theory times ratio")
            logarithmic(axes)
            axes.set_ylabel(f"{each.form} (SI)")
            axes.set_title(each.test, fontsize=9)
        panels[0].legend(ncols=3, fontsize=8)
        panels[-1].set_xlabel("frequency [Hz]")
    caption = f"{comparison.name}: the term's measured curve and the theory's with the measured damping, before and after the ratio."
    return Figure(canvas, caption, f"Measured and theoretical response of {comparison.subject}")


def _reciprocity(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> list[Figure]:
    """|H_ij| over |H_ji| of the pairs that agree best, which are those that are coupled above the noise."""
    chosen = sorted(comparison.points, key=lambda point: point.value)[:SHOWN_PAIRS]
    by_name = {response.name: response for response in responses}
    return [_pair(comparison, point, by_name[point.test]) for point in chosen if point.test in by_name]


def _pair(comparison: Comparison, point: ComparedPoint, response: FrequencyResponse) -> Figure:
    first, _, second = point.group.partition("-")
    rows, columns = [port.dof for port in response.outputs], [port.dof for port in response.inputs]
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.0)
        for number, (to, by) in enumerate(((first, second), (second, first))):
            size = np.abs(response.matrix[:, rows.index(to), columns.index(by)])
            style = "-" if number else "."
            axes.plot(response.frequency, size, style, color=COLOURS[number], linewidth=1, label=f"{to}/{by}", markersize=3)
        logarithmic(axes)
        axes.set_ylabel(f"{response.form} (SI)")
        axes.set_xlabel("frequency [Hz]")
        axes.legend(fontsize=8)
    both = f"{first}/{second} and {second}/{first}"
    caption = f"{comparison.name}, test {point.test}: {both}; rms difference {100 * point.value:.2g} %."
    return Figure(canvas, caption, f"Reciprocity of {point.group} in test {point.test}")


def _figure(comparison: Comparison, canvas: Canvas, said: str) -> Figure:
    over = f" over {comparison.condition}" if comparison.condition else ""
    caption = f"{comparison.name}: {comparison.subject}{over}; {said}."
    return Figure(canvas, caption, f"{comparison.kind} of {comparison.subject}{over}")


FIGURES: dict[str, Callable[[Comparison], Figure]] = {
    "trend": _trend,
    "difference": _difference,
    "repeatability": _repeatability,
    "ratio": _ratio,
    "rayleigh": _rayleigh,
}
OVER_FREQUENCY: dict[str, Callable[[Comparison], list[Figure]]] = {
    "prediction": prediction_figures,
    "bands": band_figures,
    "sensitivity": sensitivity_figures,
}
