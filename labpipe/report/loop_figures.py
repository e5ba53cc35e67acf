"""Figures of comparisons over frequency: predicted stiffness and damping of a control loop, two tests band by
band, sensitivity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.records.comparison import ComparedBand, Comparison, QuantityCurve
from labpipe.report.chart import INK, PALETTE_SIZE, Axis, Panel, Series, curve, dots, level, stack
from labpipe.report.document import Figure
from labpipe.report.figures import FREQUENCY, over_frequency, scale_of
from labpipe.report.wording import unit_text

# Ratios and damping of the lowest bands have intervals many times their value, which would flatten all
# others.
LEAST_RATIO_RANGE = 0.2
# Upper ends of the zones of ISO 14839-3; D lies above the last.
ZONE_LIMITS = (("A", 3.0), ("B", 4.0), ("C", 5.0))
SMALL_DOT = 2.5


def prediction_figures(comparison: Comparison) -> list[Figure]:
    """k and c of the bands beside the prediction; below, measured / predicted stiffness."""
    names = list(dict.fromkeys(band.parameter for band in comparison.bands))
    tests = list(dict.fromkeys(band.test for band in comparison.bands))
    ratios = []
    for number, test in enumerate(tests):
        name = f"{test} measured" if len(tests) > 1 else "measured"
        bands, aside = _of(comparison.bands, names[0], test), _aside(comparison, number, len(tests))
        ratios.append(_ratios(bands, number % PALETTE_SIZE, name, aside))
    low, high = _ratio_range([band for band in comparison.bands if band.parameter == names[0]])
    ratio_axis = Axis(f"{names[0]}: measured / predicted", low=low, high=high)
    panels = [_coefficient_panel(comparison, name, tests) for name in names]
    chart = stack([*panels, over_frequency(ratio_axis, (level(1.0), *ratios), 2.0)], 7.4)
    fitted = ", dashed: with the fitted unknowns" if any(part.matched for part in comparison.curves) else ""
    caption = (
        f"{comparison.name}: bands with 95 % intervals (dots); lines: the prediction as the same fit sees "
        "it; dotted: the loop's K_eq and "
        f"C_eq at each frequency{fitted}; below: ratio of the stiffness with 95 % intervals."
    )
    return [Figure(chart, caption, f"Measured and predicted {comparison.subject} over frequency")]


def _coefficient_panel(comparison: Comparison, name: str, tests: Sequence[str]) -> Panel:
    """One coefficient beside its prediction; the axis shows nine values in ten."""
    series: list[Series] = []
    ends: list[float] = []
    for number, test in enumerate(tests):
        label = f"{test} " if len(tests) > 1 else ""
        aside = _aside(comparison, number, len(tests))
        bands = _of(comparison.bands, name, test)
        series += _coefficient(comparison, bands, label, number % PALETTE_SIZE, aside)
        # Ends (SI) between which nine values in ten and all of the prediction lie
        values, predicted = np.array([[band.value, band.other] for band in bands]).T
        shown = np.concatenate([np.nanquantile(values, [0.05, 0.95]), predicted])
        margin = 0.25 * float(np.ptp(shown) or np.max(np.abs(shown)) or 1.0)
        ends += (float(np.min(shown)) - margin, float(np.max(shown)) + margin)
    unit = next(band.unit for band in comparison.bands if band.parameter == name)
    factor = scale_of(unit)
    y = Axis(name, unit_text(unit), low=factor * min(ends), high=factor * max(ends))
    return over_frequency(y, series, 3.0)


def _aside(comparison: Comparison, number: int, tests: int) -> float:
    """Offset of a test's dots from the centre of their band [Hz], so that tests do not hide each other."""
    if tests == 1:
        return 0.0
    centres = np.unique([band.centre_hz for band in comparison.bands])
    apart = float(np.min(np.diff(centres))) if centres.size > 1 else 1.0
    return 0.5 * apart * (number - (tests - 1) / 2) / tests


def _of(bands: Sequence[ComparedBand], name: str, test: str) -> list[ComparedBand]:
    return [band for band in bands if band.parameter == name and band.test == test]


def _coefficient(
    comparison: Comparison, bands: Sequence[ComparedBand], label: str, colour: int, aside: float
) -> list[Series]:
    factor = scale_of(bands[0].unit)
    centres = np.array([band.centre_hz for band in bands])
    ends = factor * np.array([band.ci95 for band in bands]).T
    values, predicted = factor * np.array([[band.value, band.other] for band in bands]).T
    line, matched = (colour, colour) if label else (1, 2)
    bars = ends[0], ends[1]
    measured = dots(
        f"{label}measured", centres + aside, values, colour, marker="o", size=SMALL_DOT, bars=bars
    )
    series = [measured, curve(f"{label}predicted", centres, predicted, line, width=1.2)]
    for part in comparison.curves:
        if part.test == bands[0].test and part.quantity == bands[0].parameter[0]:
            series += _pointwise(part, factor, label, line, matched)
    return series


def _pointwise(part: QuantityCurve, factor: float, label: str, colour: int, matched: int) -> list[Series]:
    series = [curve(f"{label}loop", part.frequency, factor * np.array(part.theory), colour, ":", width=0.9)]
    if part.matched:
        values = factor * np.array(part.matched)
        series.append(curve(f"{label}with the fitted unknowns", part.frequency, values, matched, "--"))
    return series


def _ratios(bands: Sequence[ComparedBand], colour: int, name: str, aside: float = 0.0) -> Series:
    values = np.array([band.ratio for band in bands], float)
    ends = np.array([band.ratio_ci95 or (np.nan, np.nan) for band in bands], float).T
    centres = np.array([band.centre_hz for band in bands]) + aside
    return dots(name, centres, values, colour, marker="o", size=SMALL_DOT, bars=(ends[0], ends[1]))


def _ratio_range(bands: Sequence[ComparedBand]) -> tuple[float, float]:
    """Ends of an axis of ratios about one: nine bands in ten are within with their intervals."""
    reach = [max(abs(end - 1) for end in band.ratio_ci95) for band in bands if band.ratio_ci95 is not None]
    size = max(LEAST_RATIO_RANGE, 1.1 * float(np.nanquantile(reach, 0.9))) if reach else 1.0
    return 1 - size, 1 + size


def band_figures(comparison: Comparison) -> list[Figure]:
    """Second test over first for every coefficient; bands that differ stand out."""
    by_name: dict[str, list[ComparedBand]] = {}
    for band in comparison.bands:
        by_name.setdefault(band.parameter, []).append(band)
    chart = stack([_band_panel(comparison, bands) for bands in by_name.values()], 0.8 + 1.8 * len(by_name))
    test = comparison.bands[0].test
    meaning = (
        "ratio of every band with its 95 % interval, not corrected; orange: different after Holm's correction"
    )
    alternative = f"{test}: ratio of {comparison.subject} over frequency"
    return [Figure(chart, f"{comparison.name}: {test}, {meaning}.", alternative)]


def _band_panel(comparison: Comparison, bands: Sequence[ComparedBand]) -> Panel:
    low, high = _ratio_range(bands)
    alike = [band for band in bands if not _differs(comparison, band)]
    different = [band for band in bands if _differs(comparison, band)]
    parts = ((alike, 0, "alike"), (different, 1, "different"))
    series = [_ratios(some, colour, name) for some, colour, name in parts if some]
    return Panel(FREQUENCY, Axis(f"{bands[0].parameter}: ratio", low=low, high=high), (level(1.0), *series))


def _differs(comparison: Comparison, band: ComparedBand) -> bool:
    count = round(comparison.amount("different").value)
    ordered = sorted(other.p_value for other in comparison.bands if other.p_value is not None)
    return count > 0 and band.p_value is not None and band.p_value <= ordered[count - 1]


def sensitivity_figures(comparison: Comparison) -> list[Figure]:
    """Measured |S| with its 95 % band, the prediction, and the limits of the zones."""
    (part,) = comparison.curves
    series = [_measured_size(part, "measured")]
    if part.theory:
        series.append(curve("predicted", part.frequency, part.theory, 1, width=1.1))
    if part.matched:
        series.append(curve("with the fitted unknowns", part.frequency, part.matched, 2, "--", width=1.1))
    at, peak = comparison.amount("peak_frequency").value, comparison.amount("peak").value
    mark = dots("peak", [at], [peak], INK, marker="v", size=6.0)
    return [_sizes(comparison, series, "control", mark)]


def certificate_figures(comparison: Comparison) -> list[Figure]:
    """|S| of every loop with its 95 % band and the zones, and L in the complex plane around -1."""
    if not comparison.curves:
        return []
    sizes = [part for part in comparison.curves if not part.quantity.startswith("L ") and part.measured]
    series: list[Series] = []
    for number, part in enumerate(sizes):
        series.append(_measured_size(part, part.quantity, 3 + number if number else 0))
        if part.matched and not number:
            series.append(curve("fitted loop", part.frequency, part.matched, 1, width=1.1))
    return [_sizes(comparison, series, "closed"), _nyquist(comparison)]


def _measured_size(part: QuantityCurve, name: str, colour: int = 0) -> Series:
    band = part.low, part.high
    return dots(name, part.frequency, part.measured, colour, size=1.25, band=band, opacity=0.25)


def _sizes(comparison: Comparison, series: Sequence[Series], loop: str, *marks: Series) -> Figure:
    zones = [level(limit, line="--", name=f"zone {name} ends") for name, limit in ZONE_LIMITS]
    x = Axis(FREQUENCY.title, FREQUENCY.unit, logarithmic=True)
    panel = Panel(x, Axis("|S|", "1", low=0.0), (*series, *zones, *marks))
    meaning = "measured sensitivity with its 95 % band; dashed: limits of the zones of ISO 14839-3"
    alternative = f"Sensitivity of the {loop} loop over frequency, {comparison.verdict}"
    return Figure(stack([panel], 3.6), f"{comparison.name}: {meaning}.", alternative)


def _nyquist(comparison: Comparison) -> Figure:
    real = [part for part in comparison.curves if part.quantity.endswith(" real")]
    imaginary = [part for part in comparison.curves if part.quantity.endswith(" imaginary")]
    series: list[Series] = [
        dots(x.quantity.removesuffix(" real"), x.measured, y.measured, number % PALETTE_SIZE, size=1.5)
        for number, (x, y) in enumerate(zip(real, imaginary, strict=True))
    ]
    turn = np.linspace(0, 2 * np.pi, 181)
    circle = curve("|S| = 3, end of zone A", -1 + np.cos(turn) / 3, np.sin(turn) / 3, 1, "--", width=0.9)
    axes = [
        Axis(title, "1", low=low, high=high)
        for title, low, high in (("Re L", -3.0, 1.0), ("Im L", -2.0, 2.0))
    ]
    critical_point = dots("-1", [-1.0], [0.0], INK, marker="v", size=5.0)
    panel = Panel(axes[0], axes[1], (*series, circle, critical_point), equal=True)
    caption = f"{comparison.name}: loop transfer L = 1/S - 1 line by line around -1; dashed: |S| = 3."
    return Figure(stack([panel], 4.4), caption, "Loop transfer function in the complex plane around -1")
