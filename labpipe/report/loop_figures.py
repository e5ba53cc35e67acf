"""Figures of what is compared over frequency: predicted stiffness and damping of a control loop, two tests band by band, sensitivity."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from labpipe.quantities import display_unit, to_display
from labpipe.records.comparison import ComparedBand, Comparison, Curve
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import PlainLog, stacked_axes
from labpipe.report.wording import unit_text

# Ratios and damping of the lowest bands have intervals many times their value, which would flatten all others.
LEAST_RATIO_RANGE = 0.2
# Upper ends of the zones of ISO 14839-3; D lies above the last.
ZONE_LIMITS = (("A", 3.0), ("B", 4.0), ("C", 5.0))


def prediction_figures(comparison: Comparison) -> list[Figure]:
    """k and c of the bands beside the prediction and, below, measured / predicted stiffness; every test in its colour."""
    names = list(dict.fromkeys(band.parameter for band in comparison.bands))
    tests = list(dict.fromkeys(band.test for band in comparison.bands))
    with mpl.rc_context(STYLE):
        canvas, (above, middle, below) = stacked_axes(3, 7.4, sharex=True, height_ratios=(3, 3, 2))
        for axes, name in zip((above, middle), names, strict=True):
            for number, test in enumerate(tests):
                _coefficient(axes, comparison, name, test, COLOURS[number % len(COLOURS)], _aside(comparison, number, len(tests)))
            unit = next(band.unit for band in comparison.bands if band.parameter == name)
            axes.set_ylabel(f"{name} [{unit_text(unit)}]")
        for number, test in enumerate(tests):
            aside = _aside(comparison, number, len(tests)) or 0.0
            _ratios(below, _of(comparison.bands, names[0], test), COLOURS[number % len(COLOURS)], aside)
        _ratio_axis(below, [band for band in comparison.bands if band.parameter == names[0]])
        below.set_ylabel(f"{names[0]}: measured / predicted")
        below.set_xlabel("frequency [Hz]")
        above.legend(ncols=2, fontsize=8)
    fitted = ", dashed: with the fitted unknowns" if any(curve.matched for curve in comparison.curves) else ""
    caption = (
        f"{comparison.name}: bands with 95 % intervals (dots); lines: the prediction as the same fit sees it; dotted: the loop's K_eq and "
        f"C_eq at each frequency{fitted}; below: ratio of the stiffness with 95 % intervals."
    )
    return [Figure(canvas, caption, f"Measured and predicted {comparison.subject} over frequency")]


def _aside(comparison: Comparison, number: int, tests: int) -> float | None:
    """How far the dots of a test stand beside the centre of their band [Hz], so that tests do not hide each other; None for one test."""
    if tests == 1:
        return None
    centres = np.unique([band.centre_hz for band in comparison.bands])
    apart = float(np.min(np.diff(centres))) if centres.size > 1 else 1.0
    return 0.5 * apart * (number - (tests - 1) / 2) / tests


def _of(bands: Sequence[ComparedBand], name: str, test: str) -> list[ComparedBand]:
    return [band for band in bands if band.parameter == name and band.test == test]


def _coefficient(axes: Axes, comparison: Comparison, name: str, test: str, colour: str, aside: float | None) -> None:
    bands, several = _of(comparison.bands, name, test), aside is not None
    factor = to_display(1.0, display_unit(bands[0].unit))
    centres = np.array([band.centre_hz for band in bands])
    values, ends = factor * np.array([band.value for band in bands]), factor * np.array([band.ci95 for band in bands])
    label = f"{test} " if several else ""
    _bars(axes, centres + (aside or 0.0), values, ends, colour, f"{label}measured")
    line = colour if several else COLOURS[1]
    axes.plot(centres, factor * np.array([band.other for band in bands]), "-", color=line, linewidth=1.2, label=f"{label}predicted")
    for curve in comparison.curves:
        if curve.test == test and curve.quantity == name[0]:
            _pointwise(axes, curve, factor, line, line if several else COLOURS[2])
    _focus(axes, values, factor * np.array([band.other for band in bands]))


def _pointwise(axes: Axes, curve: Curve, factor: float, colour: str, matched: str) -> None:
    axes.plot(curve.frequency, factor * np.array(curve.theory), ":", color=colour, linewidth=0.9)
    if curve.matched:
        axes.plot(curve.frequency, factor * np.array(curve.matched), "--", color=matched, linewidth=1)


def _focus(axes: Axes, values: NDArray[np.floating], predicted: NDArray[np.floating]) -> None:
    """The axis shows nine values in ten and all of the prediction; the widest intervals leave it."""
    shown = np.concatenate([np.nanquantile(values, [0.05, 0.95]), predicted])
    margin = 0.25 * float(np.ptp(shown) or np.max(np.abs(shown)) or 1.0)
    before = [axes.get_ylim()] if axes.get_label() == "focused" else []
    low, high = float(np.min(shown)) - margin, float(np.max(shown)) + margin
    axes.set_ylim(min([low, *(each[0] for each in before)]), max([high, *(each[1] for each in before)]))
    axes.set_label("focused")


def _bars(axes: Axes, x: NDArray[np.floating], values: NDArray[np.floating], ends: NDArray[np.floating], colour: str, label: str) -> None:
    reach = np.abs(ends.T - values)
    axes.errorbar(x, values, reach, fmt="o", color=colour, markersize=2.5, elinewidth=0.7, capsize=0, alpha=0.8, label=label)


def _ratios(axes: Axes, bands: Sequence[ComparedBand], colour: str, aside: float = 0.0) -> None:
    values, ends = np.array([band.ratio for band in bands], float), np.array([band.ratio_ci95 for band in bands], float)
    _bars(axes, np.array([band.centre_hz for band in bands]) + aside, values, ends, colour, "")


def _ratio_axis(axes: Axes, bands: Sequence[ComparedBand]) -> None:
    """One stands in the middle; nine bands in ten are within the axis with their intervals."""
    reach = [max(abs(end - 1) for end in band.ratio_ci95) for band in bands if band.ratio_ci95 is not None]
    size = max(LEAST_RATIO_RANGE, 1.1 * float(np.nanquantile(reach, 0.9))) if reach else 1.0
    axes.axhline(1.0, color="0.4", linewidth=0.8)
    axes.set_ylim(1 - size, 1 + size)


def band_figures(comparison: Comparison) -> list[Figure]:
    """Second test over first for every coefficient, with the interval of the difference; bands that differ stand out."""
    names = list(dict.fromkeys(band.parameter for band in comparison.bands))
    with mpl.rc_context(STYLE):
        canvas, panels = stacked_axes(len(names), 0.8 + 1.8 * len(names), sharex=True)
        for axes, name in zip(panels, names, strict=True):
            bands = [band for band in comparison.bands if band.parameter == name]
            _ratio_axis(axes, bands)
            _ratios(axes, [band for band in bands if not _differs(comparison, band)], COLOURS[0])
            if any(_differs(comparison, band) for band in bands):
                _ratios(axes, [band for band in bands if _differs(comparison, band)], COLOURS[1])
            axes.set_ylabel(f"{name}: ratio")
        panels[-1].set_xlabel("frequency [Hz]")
    test = comparison.bands[0].test
    meaning = "ratio of every band with its 95 % interval, not corrected; orange: different after Holm's correction"
    caption = f"{comparison.name}: {test}, {meaning}."
    return [Figure(canvas, caption, f"{test}: ratio of {comparison.subject} over frequency")]


def _differs(comparison: Comparison, band: ComparedBand) -> bool:
    """Whether the band is among those that are counted as different."""
    count = round(comparison.amount("different").value)
    ordered = sorted(each.p_value for each in comparison.bands if each.p_value is not None)
    return count > 0 and band.p_value is not None and band.p_value <= ordered[count - 1]


def sensitivity_figures(comparison: Comparison) -> list[Figure]:
    """Measured |S| with its 95 % band, the prediction, and the limits of the zones."""
    (curve,) = comparison.curves
    frequency, measured = np.array(curve.frequency), np.array(curve.measured)
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.6)
        axes.fill_between(frequency, curve.low, curve.high, color=COLOURS[0], alpha=0.25, linewidth=0)
        axes.plot(frequency, measured, ".", color=COLOURS[0], markersize=2.5, label="measured")
        if curve.theory:
            axes.plot(frequency, curve.theory, "-", color=COLOURS[1], linewidth=1.1, label="predicted")
        if curve.matched:
            axes.plot(frequency, curve.matched, "--", color=COLOURS[2], linewidth=1.1, label="with the fitted unknowns")
        for name, limit in ZONE_LIMITS:
            axes.axhline(limit, color="0.4", linewidth=0.8, linestyle="--")
            axes.text(frequency[-1], limit, f"zone {name} ends", fontsize=7, ha="right", va="bottom", color="0.3")
        axes.plot(comparison.amount("peak_frequency").value, comparison.amount("peak").value, "v", color=COLOURS[6], label="peak")
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(PlainLog())
        axes.set_ylim(0, None)
        axes.set_ylabel("|S| [1]")
        axes.set_xlabel("frequency [Hz]")
        axes.legend(ncols=4, fontsize=8)
    caption = f"{comparison.name}: measured sensitivity with its 95 % band; dashed: limits of the zones of ISO 14839-3."
    return [Figure(canvas, caption, f"Sensitivity of the control loop over frequency, {comparison.verdict}")]
