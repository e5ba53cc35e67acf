"""The part of a report that a comparison of tests fills: the answer in words, amounts and figures.

FIGURES by kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from labpipe.display import number, per_cent, write_values
from labpipe.quantities import display_unit, to_display
from labpipe.records.comparison import ComparedBand, ComparedPoint, Comparison, Comparisons, Overlay
from labpipe.records.finding import WARNING, Parameter, of_level
from labpipe.records.identification import Identification
from labpipe.records.response import FrequencyResponse
from labpipe.records.text import parameter_cells
from labpipe.report import chart, loop_figures
from labpipe.report.budget import comparison_budget_blocks
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.figures import over_frequency, scale_of
from labpipe.report.wording import legible, unit_text


def loop_blocks(comparison: Comparison) -> list[Block]:
    """Correlations of fitted unknowns, or the bands."""
    warnings = [f"{finding.code}: {finding.message}" for finding in of_level(WARNING, comparison.findings)]
    blocks: list[Block] = [Paragraph(f"{'; '.join(warnings)}.", "warning")] if warnings else []
    if comparison.correlations:
        rows = tuple((first, second, f"{value:+.3f}") for first, second, value in comparison.correlations)
        caption = f"Correlation of the unknowns of {comparison.name}"
        return [*blocks, Table(("unknown", "and", "correlation"), rows, caption, (2,))]
    # Fitted unknowns are judged by their errors; the bands of the loop as stated belong to a comparison
    # without them.
    names = dict.fromkeys(band.parameter for band in comparison.bands)
    return [*blocks, *(_band_table(comparison, name) for name in names)]


def _band_table(comparison: Comparison, name: str) -> Table:
    bands = [band for band in comparison.bands if band.parameter == name]
    tested = bands[0].p_value is not None
    several = not tested and len({band.test for band in bands}) > 1
    first = ("test", "band [Hz]", f"{name} [{unit_text(bands[0].unit)}]", "95 % interval")
    other = "the other test" if tested else "predicted"
    header = (*first, other, "ratio with 95 % interval", "p-value, corrected")
    rows = tuple(_row(band, several) for band in bands)
    meaning = bands[0].test if tested else "* where the 95 % interval does not hold the prediction"
    caption = f"{name} in the bands of {comparison.name}; {meaning}"
    return Table(header, rows, caption, tuple(range(2, len(header))))


def _row(band: ComparedBand, several: bool) -> tuple[str, ...]:
    unit = display_unit(band.unit)
    value, low, high, other = (to_display(amount, unit) for amount in (band.value, *band.ci95, band.other))
    error = abs(high - low) / 4
    mark = "" if band.holds or band.p_value is not None else " *"
    p_value = "" if band.p_value is None else f"{band.p_value:.2g}"
    ends = "" if band.ratio_ci95 is None else f" ({band.ratio_ci95[0]:.3f} to {band.ratio_ci95[1]:.3f})"
    ratio = "" if band.ratio is None else f"{band.ratio:.3f}{ends}"
    first = (band.test if several else "", f"{band.band_hz[0]:g}-{band.band_hz[1]:g}")
    shown, _, lower, upper, reference = write_values(value, error, low, high, other)
    return (*first, shown + mark, f"{lower} to {upper}", reference, ratio, p_value)


SHOWN_PAIRS = 3
# Half width of the group of tests of a setting, and of the bar of their mean.
BESIDE, BAR = 0.15, 0.3


def comparison_figures(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> list[Figure]:
    """The figures of its kind, in their order."""
    if comparison.kind == "reciprocity":
        # |H_ij| over |H_ji| of the pairs that agree best, which are those that are coupled above the noise
        chosen = sorted(comparison.points, key=lambda point: point.value)[:SHOWN_PAIRS]
        by_name = {response.name: response for response in responses}
        return [_pair(comparison, point, by_name[point.test]) for point in chosen if point.test in by_name]
    if comparison.kind in OVER_FREQUENCY:
        return OVER_FREQUENCY[comparison.kind](comparison)
    return [FIGURES[comparison.kind](comparison), *([_overlays(comparison)] if comparison.overlays else [])]


def _abscissa(comparison: Comparison, points: Sequence[ComparedPoint]) -> list[float]:
    if any(point.condition is None for point in points):
        return [float(number) for number in range(1, len(points) + 1)]
    factor = scale_of(comparison.condition_unit)
    return [factor * point.condition for point in points if point.condition is not None]


def _condition(comparison: Comparison) -> chart.Axis:
    unit = unit_text(comparison.condition_unit) if comparison.condition_unit else ""
    return chart.Axis(comparison.condition or "test", unit)


def _subject(comparison: Comparison) -> chart.Axis:
    return chart.Axis(comparison.subject.split(",")[0], unit_text(comparison.unit))


def _tests(comparison: Comparison, points: Sequence[ComparedPoint], name: str, colour: int) -> chart.Series:
    factor = scale_of(comparison.unit)
    values = factor * np.array([point.value for point in points])
    ends = factor * np.array([point.ci95 or (point.value, point.value) for point in points]).T
    x = _abscissa(comparison, points)
    return chart.dots(name, x, values, colour, marker="o", size=4.0, bars=(ends[0], ends[1]))


def _trend(comparison: Comparison) -> Figure:
    x, y = np.array(comparison.line).T
    law = chart.curve("fitted law", scale_of(comparison.condition_unit) * x, scale_of(comparison.unit) * y, 1)
    tests = _tests(comparison, comparison.points, "tests", 0)
    panel = chart.Panel(_condition(comparison), _subject(comparison), (tests, law))
    mean = f" at the mean {comparison.second}" if comparison.second else ""
    meaning = f"tests with 95 % intervals and the fitted law{mean}"
    return _figure(comparison, chart.stack([panel], 3.2), meaning)


def _groups(comparison: Comparison) -> dict[str, list[ComparedPoint]]:
    groups: dict[str, list[ComparedPoint]] = {}
    for point in comparison.points:
        groups.setdefault(point.group, []).append(point)
    return groups


def _difference(comparison: Comparison) -> Figure:
    groups = _groups(comparison)
    above, below = [], []
    for order, (group, points) in enumerate(groups.items()):
        colour = order % chart.PALETTE_SIZE
        above.append(_tests(comparison, points, group, colour))
        away = [100 * (point.value / _mean_at(comparison, point) - 1) for point in points]
        below.append(chart.dots(group, _abscissa(comparison, points), away, colour, marker="o", size=4.0))
    x = _condition(comparison)
    panels = (
        chart.Panel(x, _subject(comparison), tuple(above), share=3.0),
        chart.Panel(x, chart.Axis("from the mean", "%"), (*below, chart.level(0.0)), share=2.0),
    )
    below_text = "below: distance from the mean of a condition"
    meaning = f"{' and '.join(groups)} with 95 % intervals of the fits; {below_text}"
    return _figure(comparison, chart.stack(panels, 4.4), meaning)


def _mean_at(comparison: Comparison, point: ComparedPoint) -> float:
    alike = [p.value for p in comparison.points if (p.condition, p.second) == (point.condition, point.second)]
    return float(np.mean(alike))


def _repeatability(comparison: Comparison) -> Figure:
    factor, groups = scale_of(comparison.unit), _groups(comparison)
    mean, within = (factor * comparison.amount(name).value for name in ("mean", "within"))
    series: list[chart.Series] = []
    for order, points in enumerate(groups.values()):
        values = [factor * point.value for point in points]
        places = order + np.linspace(-BESIDE, BESIDE, len(points))
        series.append(chart.dots("tests", places, values, marker="o", size=4.0))
        bar = [order - BAR, order + BAR], [float(np.mean(values))] * 2
        series.append(chart.curve("mean of a setting", *bar, 1, width=1.5))
    x = replace(_condition(comparison), ticks=chart.named_ticks(list(groups)))
    series += [chart.level(mean), chart.span(mean - within, mean + within, 0)]
    panel = chart.Panel(x, _subject(comparison), tuple(series))
    meaning = "tests (dots), mean of each setting (bars); shaded: standard deviation within a setting"
    return _figure(comparison, chart.stack([panel], 3.2), meaning)


# What stands beside the measured values, their ratio, and both in words.
BESIDE_MEASURED = {
    "ratio": (
        "theory",
        "bearing: measured / theory",
        "the measured fit beside the same fit of the theory's curve; below: ratio of the bearings' "
        "stiffness, shaded: the common one",
    ),
    "rayleigh": (
        "Rayleigh damping",
        "measured / Rayleigh",
        "measured damping beside that of one beta for all tests; below: their ratio with 95 % intervals",
    ),
}


def _ratio_figure(comparison: Comparison) -> Figure:
    what, ratio, meaning = BESIDE_MEASURED[comparison.kind]
    points, factor = comparison.points, scale_of(comparison.unit)
    x, condition = _abscissa(comparison, points), _condition(comparison)
    theory = [np.nan if point.theory is None else factor * point.theory for point in points]
    predicted = chart.curve(what, x, theory, 1, "--", width=1.5, marker="s", size=6.0)
    ratios = [np.nan if point.ratio is None else point.ratio for point in points]
    ends = np.array([point.ratio_ci95 or (np.nan, np.nan) for point in points], float).T
    measured = chart.dots("measured", x, ratios, marker="o", size=4.0, bars=(ends[0], ends[1]))
    common = _common(comparison) if comparison.kind == "ratio" else ()
    above = chart.Panel(
        condition, _subject(comparison), (_tests(comparison, points, "measured", 0), predicted), share=3.0
    )
    below = chart.Panel(condition, chart.Axis(ratio), (measured, *common, chart.level(1.0)), share=2.0)
    return _figure(comparison, chart.stack([above, below], 5.0), meaning)


def _common(comparison: Comparison) -> tuple[chart.Series, ...]:
    amount = comparison.amount("ratio")
    shade = () if amount.ci95 is None else (chart.span(*amount.ci95, 2, 0.2),)
    return (chart.level(amount.value, 2, width=1.0), *shade)


def _overlays(comparison: Comparison) -> Figure:
    panels = [_overlay(overlay) for overlay in comparison.overlays]
    what = "the term's measured curve and the theory's with the measured damping, before and after the ratio"
    caption = f"{comparison.name}: {what}."
    alternative = f"Measured and theoretical response of {comparison.subject}"
    return Figure(chart.stack(panels, 0.6 + 2.5 * len(panels)), caption, alternative)


def _overlay(overlay: Overlay) -> chart.Panel:
    series = (
        chart.dots("measured", overlay.frequency, overlay.measured, size=1.0),
        chart.curve("theory", overlay.frequency, overlay.theory, 1, "--"),
        chart.curve("theory times ratio", overlay.frequency, overlay.matched, 2),
    )
    return over_frequency(chart.Axis(f"{overlay.form} (SI)", logarithmic=True), series, title=overlay.test)


def _pair(comparison: Comparison, point: ComparedPoint, response: FrequencyResponse) -> Figure:
    first, _, second = point.group.partition("-")
    rows, columns = [port.dof for port in response.outputs], [port.dof for port in response.inputs]
    forth, back = (
        np.abs(response.matrix[:, rows.index(to), columns.index(by)])
        for to, by in ((first, second), (second, first))
    )
    series = (
        chart.dots(f"{first}/{second}", response.frequency, forth, size=1.5),
        chart.curve(f"{second}/{first}", response.frequency, back, 1),
    )
    graphic = chart.stack(
        [over_frequency(chart.Axis(f"{response.form} (SI)", logarithmic=True), series)], 3.0
    )
    both = f"{first}/{second} and {second}/{first}"
    caption = f"{comparison.name}, test {point.test}: {both}; rms difference {per_cent(point.value)}."
    return Figure(graphic, caption, f"Reciprocity of {point.group} in test {point.test}")


def _figure(comparison: Comparison, graphic: chart.Chart, meaning: str) -> Figure:
    over = f" over {comparison.condition}" if comparison.condition else ""
    caption = f"{comparison.name}: {comparison.subject}{over}; {meaning}."
    return Figure(graphic, caption, f"{comparison.kind} of {comparison.subject}{over}")


FIGURES: dict[str, Callable[[Comparison], Figure]] = {
    "trend": _trend,
    "difference": _difference,
    "quotient": _difference,
    "repeatability": _repeatability,
    "ratio": _ratio_figure,
    "rayleigh": _ratio_figure,
}
OVER_FREQUENCY: dict[str, Callable[[Comparison], list[Figure]]] = {
    "prediction": loop_figures.prediction_figures,
    "bands": loop_figures.band_figures,
    "sensitivity": loop_figures.sensitivity_figures,
    "certificate": loop_figures.certificate_figures,
}

AMOUNT_HEADER = ("amount", "value", "unit", "std. error", "95 % interval")
EXPLAINED = {
    "trend": "Weights: the fits' standard errors and the error of setting the condition.",
    **dict.fromkeys(
        ("difference", "quotient"),
        "Tests at the same condition are paired; the logarithm of their ratio is averaged with weights.",
    ),
    "repeatability": "One-way random effects: the scatter of repeats without a new setting, and that of the "
    "settings beyond it.",
    "ratio": (
        "A one-dof fit of a coupled transfer function is not K_ii, and the shaft bends. So the theory's "
        "stiffness matrix times the ratio, in series with the shaft, gives a curve whose fit on the same "
        "lines equals the measured fit. The intervals hold the noise of the fits, the error of setting the "
        "condition and that of the shaft's stiffness."
    ),
    "rayleigh": "Rayleigh damping has one beta = c / k for all tests; the chi-square of the tests' beta "
    "about their mean judges it.",
    "prediction": (
        "The bearing's loop as its file states it, on the rig's mass and support, gives a response; the same "
        "fits of it, on the same lines with the same weights, are the prediction for each band; share_k and "
        "share_c are the bands whose 95 % interval, by noise and given numbers, holds it. Unknowns are "
        "fitted to all lines of the response at once, weighted by their noise, with the support free within "
        "its stated uncertainty; their intervals hold the uncertainties of channels, mass and support. "
        "Neighbouring bands share lines, so they miss together. unstable_poles and sensitivity_peak are "
        "those of the bearing file's mass."
    ),
    "bands": (
        "Every coefficient of every band of the second test is compared with the first one's by Welch's "
        "t-test; the p-values are corrected after Holm for the number of tests, whatever neighbouring bands "
        "share. What both tests have in common, such as the uncertainty of the support, is not part of their "
        "difference."
    ),
    "sensitivity": (
        "An excitation is added between two points of the loop; S = H_after / (H_after - H_before), both "
        "against the excitation. The peak is that of a parabola around the highest line, since the line "
        "itself would be too high by its noise. Intervals hold noise and the uncertainties of the channels; "
        "what both sides of the sum have in common cancels."
    ),
    "certificate": (
        "S = H_after (H_after - H_before)^-1, both against what is added in the loop, and L = S^-1 - 1, "
        "without a model; 95 % bands by the covariance of the lines. With a bearing file its unknowns are "
        "fitted to all recorded signals; poles, decrements and margins are those of the fitted loop, with "
        "intervals to first order in the unknowns, by noise and the uncertainties of the channels. "
        "gain_margin_lower and _upper: factors of the gain down to and up to the border of stability; "
        "phase_margin to either side; disk_margin 1 / max|S - 1/2|. A limit counts as kept, or as broken, "
        "where the probability of it is at least the stated confidence."
    ),
    "reciprocity": "H of a response to a force against H of the reverse; pairs with a difference near 140 % "
    "are noise, so not coupled.",
}


def comparison_sections(comparisons: Comparisons, identification: Identification) -> tuple[Section, ...]:
    responses = identification.responses
    return tuple(
        Section(f"Comparison: {part.name}", comparison_blocks(part, responses)) for part in comparisons
    )


def comparison_blocks(comparison: Comparison, responses: Sequence[FrequencyResponse]) -> tuple[Block, ...]:
    """Statement, amounts, figures, tests."""
    amounts = tuple(map(_amount_row, comparison.amounts))
    return (
        Paragraph(comparison.statement, "note"),
        Paragraph(EXPLAINED[comparison.kind]),
        Table(AMOUNT_HEADER, amounts, f"Amounts of {comparison.name}", (1, 3, 4)),
        *comparison_figures(comparison, responses),
        *([_point_table(comparison)] if comparison.points else []),
        *loop_blocks(comparison),
        *comparison_budget_blocks(comparison),
    )


def _amount_row(amount: Parameter) -> tuple[str, ...]:
    name, value, error, interval, unit, _ = parameter_cells(amount)
    return (name, "not tested" if math.isnan(amount.value) else value, legible(unit), error, interval)


def _point_table(comparison: Comparison) -> Table:
    unit = unit_text(comparison.unit)
    header = (
        "test",
        f"{comparison.condition or 'condition'} [{unit_text(comparison.condition_unit) or '-'}]",
        f"{comparison.second} [{unit_text(comparison.second_unit) or '-'}]",
        "group",
        f"value{f' [{unit}]' if unit else ''}",
        "95 % interval",
        "theory",
        "ratio",
        "95 % interval of the ratio",
        "p-value",
    )
    rows = tuple(_point_row(comparison, point) for point in comparison.points)
    return Table(header, rows, f"Tests of {comparison.name}", tuple(range(1, len(header))))


def _point_row(comparison: Comparison, point: ComparedPoint) -> tuple[str, ...]:
    unit = display_unit(comparison.unit)
    ends = [to_display(end, unit) for end in point.ci95 or ()]
    theory = [] if point.theory is None else [to_display(point.theory, unit)]
    error = (ends[1] - ends[0]) / 4 if ends else None
    value, _, *texts = write_values(to_display(point.value, unit), error, *ends, *theory)

    def condition(amount: float | None, of: str) -> str:
        return "" if amount is None else f"{to_display(amount, display_unit(of)):g}"

    return (
        point.test,
        condition(point.condition, comparison.condition_unit),
        condition(point.second, comparison.second_unit),
        point.group,
        value,
        " to ".join(texts[: len(ends)]),
        "".join(texts[len(ends) :]),
        *_ratio_words(point),
        "" if point.p_value is None else f"{point.p_value:.2g}",
    )


def _ratio_words(point: ComparedPoint) -> tuple[str, str]:
    if point.ratio is None or point.ratio_ci95 is None:
        return "" if point.ratio is None else number(point.ratio), ""
    low, high = point.ratio_ci95
    value, _, *ends = write_values(point.ratio, (high - low) / 2, low, high)
    return value, " to ".join(ends)
