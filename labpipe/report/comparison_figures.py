"""The figures of a comparison. FIGURES by kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from labpipe.records.comparison import ComparedPoint, Comparison, Overlay
from labpipe.records.response import FrequencyResponse
from labpipe.report.chart import PALETTE_SIZE, Axis, Chart, Panel, Series, curve, dots, level, named_ticks, span, stacked
from labpipe.report.document import Figure
from labpipe.report.figures import over_frequency, scale_of
from labpipe.report.loop_figures import band_figures, certificate_figures, prediction_figures, sensitivity_figures
from labpipe.report.wording import unit_text

SHOWN_PAIRS = 3
# Half width of the group of tests of a setting, and of the bar of their mean.
BESIDE, BAR = 0.15, 0.3


def comparison_figures(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> list[Figure]:
    """The figures of its kind, in their order."""
    if comparison.kind == "reciprocity":
        return _reciprocity(comparison, responses)
    if comparison.kind in OVER_FREQUENCY:
        return OVER_FREQUENCY[comparison.kind](comparison)
    return [FIGURES[comparison.kind](comparison), *([_overlays(comparison)] if comparison.overlays else [])]


def _abscissa(comparison: Comparison, points: Sequence[ComparedPoint]) -> list[float]:
    """The condition in its display unit, or the number of the test where there is none."""
    if any(point.condition is None for point in points):
        return [float(number) for number in range(1, len(points) + 1)]
    factor = scale_of(comparison.condition_unit)
    return [factor * point.condition for point in points if point.condition is not None]


def _condition(comparison: Comparison) -> Axis:
    unit = unit_text(comparison.condition_unit) if comparison.condition_unit else ""
    return Axis(comparison.condition or "test", unit)


def _subject(comparison: Comparison) -> Axis:
    return Axis(comparison.subject.split(",")[0], unit_text(comparison.unit))


def _tests(comparison: Comparison, points: Sequence[ComparedPoint], name: str, colour: int) -> Series:
    """Values with their 95 % intervals."""
    factor = scale_of(comparison.unit)
    values = factor * np.array([point.value for point in points])
    ends = factor * np.array([point.ci95 or (point.value, point.value) for point in points]).T
    return dots(name, _abscissa(comparison, points), values, colour, marker="o", size=4.0, bars=(ends[0], ends[1]))


def _trend(comparison: Comparison) -> Figure:
    x, y = np.array(comparison.line).T
    law = curve("fitted law", scale_of(comparison.condition_unit) * x, scale_of(comparison.unit) * y, 1)
    panel = Panel(_condition(comparison), _subject(comparison), (_tests(comparison, comparison.points, "tests", 0), law))
    mean = f" at the mean {comparison.second}" if comparison.second else ""
    return _figure(comparison, stacked([panel], 3.2), f"tests with 95 % intervals and the fitted law{mean}")


def _groups(comparison: Comparison) -> dict[str, list[ComparedPoint]]:
    """The points of every group, in the order in which the groups come."""
    groups: dict[str, list[ComparedPoint]] = {}
    for point in comparison.points:
        groups.setdefault(point.group, []).append(point)
    return groups


def _difference(comparison: Comparison) -> Figure:
    """Both groups over the condition, and below how far each test is from the mean of its condition."""
    groups = _groups(comparison)
    above, below = [], []
    for number, (group, points) in enumerate(groups.items()):
        colour = number % PALETTE_SIZE
        above.append(_tests(comparison, points, group, colour))
        away = [100 * (point.value / _mean_at(comparison, point) - 1) for point in points]
        below.append(dots(group, _abscissa(comparison, points), away, colour, marker="o", size=4.0))
    x = _condition(comparison)
    panels = (
        Panel(x, _subject(comparison), tuple(above), share=3.0),
        Panel(x, Axis("from the mean", "%"), (*below, level(0.0)), share=2.0),
    )
    meaning = f"{' and '.join(groups)} with 95 % intervals of the fits; below: distance from the mean of a condition"
    return _figure(comparison, stacked(panels, 4.4), meaning)


def _mean_at(comparison: Comparison, point: ComparedPoint) -> float:
    here = (point.condition, point.second)
    return float(np.mean([other.value for other in comparison.points if (other.condition, other.second) == here]))


def _repeatability(comparison: Comparison) -> Figure:
    """Every test in its setting; shaded: the scatter within a setting about the mean of all."""
    factor, groups = scale_of(comparison.unit), _groups(comparison)
    mean, within = (factor * comparison.amount(name).value for name in ("mean", "within"))
    series: list[Series] = []
    for number, points in enumerate(groups.values()):
        values = [factor * point.value for point in points]
        places = number + np.linspace(-BESIDE, BESIDE, len(points))
        series.append(dots("tests", places, values, marker="o", size=4.0))
        series.append(curve("mean of a setting", [number - BAR, number + BAR], [float(np.mean(values))] * 2, 1, width=1.5))
    x = Axis(_condition(comparison).title, _condition(comparison).unit, ticks=named_ticks(list(groups)))
    panel = Panel(x, _subject(comparison), (*series, level(mean), span(mean - within, mean + within, 0)))
    meaning = "tests (dots), mean of each setting (bars); shaded: standard deviation within a setting"
    return _figure(comparison, stacked([panel], 3.2), meaning)


def _ratio(comparison: Comparison) -> Figure:
    """Measured and theory over the condition, and their ratio with the common one."""
    chart = _beside(comparison, "theory", "bearing: measured / theory")
    meaning = "the measured fit beside the same fit of the theory's curve; below: ratio of the bearings' stiffness, shaded: the common one"
    return _figure(comparison, chart, meaning)


def _rayleigh(comparison: Comparison) -> Figure:
    """Measured damping beside beta times stiffness."""
    chart = _beside(comparison, "Rayleigh damping", "measured / Rayleigh")
    return _figure(comparison, chart, "measured damping beside that of one beta for all tests; below: their ratio with 95 % intervals")


def _beside(comparison: Comparison, what: str, ratio: str) -> Chart:
    """Measured and predicted values over the condition; below, their ratio."""
    points, factor = comparison.points, scale_of(comparison.unit)
    x, condition = _abscissa(comparison, points), _condition(comparison)
    theory = [np.nan if point.theory is None else factor * point.theory for point in points]
    predicted = curve(what, x, theory, 1, "--", width=1.5, marker="s", size=6.0)
    ratios = [np.nan if point.ratio is None else point.ratio for point in points]
    ends = np.array([point.ratio_ci95 or (np.nan, np.nan) for point in points], float).T
    measured = dots("measured", x, ratios, marker="o", size=4.0, bars=(ends[0], ends[1]))
    common = _common(comparison, "ratio") if comparison.kind == "ratio" else ()
    above = Panel(condition, _subject(comparison), (_tests(comparison, points, "measured", 0), predicted), share=3.0)
    below = Panel(condition, Axis(ratio), (measured, *common, level(1.0)), share=2.0)
    return stacked([above, below], 5.0)


def _common(comparison: Comparison, name: str) -> tuple[Series, ...]:
    """A common value with its 95 % interval across the whole width."""
    amount = comparison.amount(name)
    shade = () if amount.ci95 is None else (span(*amount.ci95, 2, 0.2),)
    return (level(amount.value, 2, width=1.0), *shade)


def _overlays(comparison: Comparison) -> Figure:
    """The measured curve, the theory's, and the theory times the test's own ratio, at the first and the last condition."""
    panels = [_overlay(overlay) for overlay in comparison.overlays]
    caption = f"{comparison.name}: the term's measured curve and the theory's with the measured damping, before and after the ratio."
    return Figure(stacked(panels, 0.6 + 2.5 * len(panels)), caption, f"Measured and theoretical response of {comparison.subject}")


def _overlay(overlay: Overlay) -> Panel:
    series = (
        dots("measured", overlay.frequency, overlay.measured, size=1.0),
        curve("theory", overlay.frequency, overlay.theory, 1, "--"),
        curve("theory times ratio", overlay.frequency, overlay.matched, 2),
    )
    return over_frequency(Axis(f"{overlay.form} (SI)", logarithmic=True), series, title=overlay.test)


def _reciprocity(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> list[Figure]:
    """|H_ij| over |H_ji| of the pairs that agree best, which are those that are coupled above the noise."""
    chosen = sorted(comparison.points, key=lambda point: point.value)[:SHOWN_PAIRS]
    by_name = {response.name: response for response in responses}
    return [_pair(comparison, point, by_name[point.test]) for point in chosen if point.test in by_name]


def _pair(comparison: Comparison, point: ComparedPoint, response: FrequencyResponse) -> Figure:
    first, _, second = point.group.partition("-")
    rows, columns = [port.dof for port in response.outputs], [port.dof for port in response.inputs]
    forth, back = (np.abs(response.matrix[:, rows.index(to), columns.index(by)]) for to, by in ((first, second), (second, first)))
    series = (dots(f"{first}/{second}", response.frequency, forth, size=1.5), curve(f"{second}/{first}", response.frequency, back, 1))
    chart = stacked([over_frequency(Axis(f"{response.form} (SI)", logarithmic=True), series)], 3.0)
    both = f"{first}/{second} and {second}/{first}"
    caption = f"{comparison.name}, test {point.test}: {both}; rms difference {100 * point.value:.2g} %."
    return Figure(chart, caption, f"Reciprocity of {point.group} in test {point.test}")


def _figure(comparison: Comparison, chart: Chart, meaning: str) -> Figure:
    over = f" over {comparison.condition}" if comparison.condition else ""
    caption = f"{comparison.name}: {comparison.subject}{over}; {meaning}."
    return Figure(chart, caption, f"{comparison.kind} of {comparison.subject}{over}")


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
    "certificate": certificate_figures,
}
