"""The figures of a report, drawn by matplotlib, the same for the same result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogFormatter, NullFormatter
from numpy.typing import NDArray

from labpipe.quantities import QUANTITIES, display_unit, to_display
from labpipe.records.identification import Fit, FittedCurve
from labpipe.records.response import FrequencyResponse
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.wording import fit_title, unit_text

WIDTH = 7.2


def stacked_axes(rows: int, height: float, **kwargs: Any) -> tuple[Canvas, list[Axes]]:
    canvas = Canvas(figsize=(WIDTH, height), layout="constrained")
    axes = canvas.subplots(rows, 1, squeeze=False, **kwargs)[:, 0]
    return canvas, list(axes)


def logarithmic(axes: Axes) -> None:
    """Plain numbers on a logarithmic axis: mathematical markup is off, so that names from files cannot become markup."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    narrow = high < 20 * low
    axes.yaxis.set_major_formatter(PlainLog())
    axes.yaxis.set_minor_formatter(PlainLog(minor_thresholds=(1.5, 0.4)) if narrow else NullFormatter())


class PlainLog(LogFormatter):
    """Labels such as 0.01, 20 or 3e-05."""

    def _num_to_string(self, x: float, vmin: float, vmax: float) -> str:  # noqa: ARG002 (matplotlib's signature)
        return f"{x:g}"


def form_unit(form: str) -> tuple[str, float]:
    """(axis label, factor from SI) of an FRF form in the unit people read."""
    quantity = QUANTITIES.get(form)
    unit = quantity.display_unit if quantity else "SI"
    return f"{form} [{unit}]", to_display(1.0, unit) if quantity else 1.0


def fitted_curve_figure(fit: Fit, curve: FittedCurve) -> Figure:
    """Amplitude, phase and residual of measured against fitted FRF; the residual with its 95 % band where the doubt is known."""
    pairs = [(o, i) for o in range(len(curve.outputs)) for i in range(len(curve.inputs))]
    label_of_form, factor = form_unit(curve.form)
    with mpl.rc_context(STYLE):
        canvas, (amplitude, phase, residual) = stacked_axes(3, 6.2, sharex=True, height_ratios=(3, 2, 2))
        for number, (o, i) in enumerate(pairs):
            colour = COLOURS[number % len(COLOURS)]
            label = f"{curve.outputs[o]}/{curve.inputs[i]}"
            measured, fitted = curve.measured[:, o, i], curve.fitted[:, o, i]
            amplitude.plot(curve.frequency, factor * np.abs(measured), ".", color=colour, label=f"{label} measured")
            amplitude.plot(curve.frequency, factor * np.abs(fitted), "-", color=colour, label=f"{label} fitted")
            phase.plot(curve.frequency, np.degrees(np.angle(measured)), ".", color=colour)
            phase.plot(curve.frequency, np.degrees(np.angle(fitted)), "-", color=colour)
            _residual(residual, curve, o, i, colour)
        logarithmic(amplitude)
        amplitude.set_ylabel(label_of_form)
        amplitude.legend(ncols=2, fontsize=8)
        phase.set_ylabel("phase [deg]")
        residual.set_ylabel("|residual| / |H| [%]")
        residual.set_xlabel("frequency [Hz]")
    band = "; shaded: 95 % of residuals lie below when only the measured noise is left" if curve.variance is not None else ""
    caption = f"{fit_title(fit)}: measured (dots) and fitted (lines) {curve.form}, and the residual{band}."
    return Figure(canvas, caption, f"Amplitude, phase and residual of fit {fit_title(fit)} over frequency")


def _residual(axes: Axes, curve: FittedCurve, o: int, i: int, colour: str) -> None:
    """Residual magnitude relative to the fitted FRF; |e|^2 / var is exponential, so 95 % lie below sqrt(ln 20 var)."""
    size = np.abs(curve.fitted[:, o, i])
    axes.plot(curve.frequency, 100 * np.abs(curve.measured[:, o, i] - curve.fitted[:, o, i]) / size, ".", color=colour)
    if curve.variance is not None:
        limit = 100 * np.sqrt(np.log(20.0) * curve.variance[:, o, i]) / size
        axes.fill_between(curve.frequency, 0, limit, color=colour, alpha=0.15, linewidth=0)


def correlation_figure(fit: Fit) -> Figure:
    """Heat map of the correlation between the estimated parameters."""
    names = [parameter.name for parameter in fit.parameters if not parameter.derived][: len(fit.correlation)]
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        side = max(2.2, 0.42 * len(names) + 1.2)
        canvas = Canvas(figsize=(side + 0.9, side), layout="constrained")
        axes = canvas.subplots()
        image = axes.imshow(fit.correlation, vmin=-1, vmax=1, cmap="PuOr")
        axes.set_xticks(range(len(names)), names, rotation=90)
        axes.set_yticks(range(len(names)), names)
        for (row, column), value in np.ndenumerate(fit.correlation):
            tone = "white" if abs(value) > 0.6 else "black"
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=tone)
        canvas.colorbar(image, ax=axes, shrink=0.8)
    caption = f"{fit_title(fit)}: correlation between the estimates. Near +1 or -1 two parameters cannot be told apart."
    return Figure(canvas, caption, f"Correlation matrix of fit {fit_title(fit)}")


def sliding_figures(fits: Sequence[Fit]) -> list[Figure]:
    """Every coefficient over the centre of its band with its 95 % interval, then G.o.F over frequency."""
    centres = np.array([fit.centre_hz for fit in fits])
    names = [p.name for p in fits[0].parameters if p.unit in ("N/m", "N.s/m") and not p.derived]
    groups = [[name for name in names if name.startswith(kind)] for kind in ("k", "c")]
    figures = [_coefficient_figure(fits, centres, group) for group in groups if group]
    return [*figures, _goodness_figure(fits, centres)]


def _coefficient_figure(fits: Sequence[Fit], centres: NDArray[np.float64], names: list[str]) -> Figure:
    unit = display_unit(fits[0].parameter(names[0]).unit)
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.2)
        for number, name in enumerate(names):
            colour = COLOURS[number % len(COLOURS)]
            value = np.array([to_display(fit.parameter(name).value, unit) for fit in fits])
            bounds = np.array([fit.parameter(name).ci95 or (np.nan, np.nan) for fit in fits]) / _factor(unit)
            axes.plot(centres, value, ".-", color=colour, label=name, linewidth=1)
            axes.fill_between(centres, bounds[:, 0], bounds[:, 1], color=colour, alpha=0.2, linewidth=0)
        axes.set_xlabel("centre of the band [Hz]")
        axes.set_ylabel(f"{names[0][0]} [{unit_text(fits[0].parameter(names[0]).unit)}]")
        axes.legend(ncols=4, fontsize=8)
    what = "stiffness" if names[0].startswith("k") else "damping"
    caption = f"{fit_title(fits[0])}: {what} over frequency, {len(fits)} bands; shaded: 95 % interval."
    return Figure(canvas, caption, f"{what} of {fit_title(fits[0])} over frequency with 95 % interval")


def _factor(unit: str) -> float:
    """SI value of one display unit without offset."""
    return 1.0 / to_display(1.0, unit)


def _goodness_figure(fits: Sequence[Fit], centres: NDArray[np.float64]) -> Figure:
    with mpl.rc_context(STYLE):
        canvas, axes = stacked_axes(2, 3.6, sharex=True)
        axes[0].plot(centres, [fit.gof.r2_adjusted for fit in fits], ".-", linewidth=1)
        axes[0].set_ylabel("G.o.F (adj. R²)")
        chi2 = [np.nan if fit.gof.chi2_reduced is None else fit.gof.chi2_reduced for fit in fits]
        axes[1].plot(centres, chi2, ".-", color=COLOURS[1], linewidth=1)
        axes[1].axhline(1.0, color="0.5", linewidth=0.8)
        axes[1].set_ylabel("chi² per datum")
        axes[1].set_xlabel("centre of the band [Hz]")
    caption = (
        f"{fit_title(fits[0])}: goodness of fit per band. A high G.o.F does not prove the coefficients; "
        "chi² per datum near 1 says that the model leaves nothing but the measured noise."
    )
    return Figure(canvas, caption, f"Goodness of fit of {fit_title(fits[0])} over frequency")


def response_figure(response: FrequencyResponse) -> Figure:
    """The measured FRF with its quality: coherence (random data) or signal-to-noise ratio per channel (periodic data)."""
    name = response.name or "the measurement"
    label_of_form, factor = form_unit(response.form)
    with mpl.rc_context(STYLE):
        canvas, (amplitude, quality) = stacked_axes(2, 4.4, sharex=True, height_ratios=(3, 2))
        for o, output in enumerate(response.outputs):
            for i, port in enumerate(response.inputs):
                size = factor * np.abs(response.matrix[:, o, i])
                amplitude.plot(response.frequency, size, linewidth=1, label=f"{output.label}/{port.label}")
        logarithmic(amplitude)
        amplitude.set_ylabel(label_of_form)
        amplitude.legend(ncols=4, fontsize=8)
        what = _quality(quality, response)
        quality.set_xlabel("frequency [Hz]")
    return Figure(canvas, f"Measured {response.form} of {name}, and {what}.", f"Measured {response.form} of {name} and {what}")


def _quality(axes: Axes, response: FrequencyResponse) -> str:
    several = response.partial_coherence is not None
    coherence = response.partial_coherence if several else response.coherence
    if coherence is not None:
        for o, output in enumerate(response.outputs):
            for i, port in enumerate(response.inputs):
                axes.plot(response.frequency, coherence[:, o, i], linewidth=1, label=f"{output.label}/{port.label}")
        axes.set_ylim(0, 1.02)
        axes.set_ylabel("partial coherence" if several else "coherence")
        return "the partial coherence of each response and force, the other forces taken out" if several else "its coherence"
    if response.snr is not None:
        for number, channel in enumerate(response.snr_channels):
            axes.plot(response.frequency, np.maximum(response.snr[:, number], 1e-3), linewidth=1, label=channel)
        logarithmic(axes)
        axes.set_ylabel("signal / noise")
        axes.legend(ncols=4, fontsize=8)
        return "the signal-to-noise ratio of its channels"
    variance = response.variance
    if variance is not None:
        relative = np.sqrt(variance) / np.abs(response.matrix)
        axes.plot(response.frequency, relative.reshape(response.n_frequency, -1), linewidth=1)
        logarithmic(axes)
        axes.set_ylabel("std / |H|")
        return "its relative standard deviation"
    axes.text(0.5, 0.5, "the doubt of this FRF is not known", transform=axes.transAxes, ha="center")
    return "no statement of its doubt"


def line_figure(fits: Sequence[Fit]) -> Figure:
    """Slopes of a calibration over its groups with their 95 % intervals."""
    slopes = [fit.parameter("slope") for fit in fits]
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.0)
        position = np.arange(len(fits))
        low = [s.value - s.ci95[0] if s.ci95 else 0.0 for s in slopes]
        high = [s.ci95[1] - s.value if s.ci95 else 0.0 for s in slopes]
        axes.errorbar(position, [s.value for s in slopes], yerr=(low, high), fmt="o", capsize=3)
        axes.set_xticks(position, [fit.test or fit.name for fit in fits], rotation=25, ha="right")
        axes.set_ylabel(f"slope [{slopes[0].unit}]")
        axes.set_ylim(bottom=0 if min(s.value for s in slopes) > 0 else None)
    return Figure(canvas, f"{fits[0].name}: slope of each line with its 95 % interval.", f"Slopes of calibration {fits[0].name}")
