"""A fitted FRF matrix of many elements: one small panel per element in matrix order, or of very many the sum and the worst."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.identification import Fit, FittedCurve
from labpipe.report.chart import WIDTH, Chart, Panel, curve, dots, stacked
from labpipe.report.document import Figure
from labpipe.report.figures import FREQUENCY, form_axis, form_unit
from labpipe.report.wording import fit_title

# Largest number of elements in one pair of axes.
MOST_TOGETHER = 4
# Largest number of elements that are all shown; of more the mean over all, and the WORST in this many columns.
MOST_SHOWN, WORST, COLUMNS = 24, 12, 3
# Part of the amplitude at which a band ends that would reach below zero, for which a logarithmic axis has no place.
LEAST_SHARE = 0.05


def matrix_figures(fit: Fit, fitted: FittedCurve) -> list[Figure]:
    """Every element, or of very many their root mean square and those that are met worst."""
    many = len(fitted.outputs) * len(fitted.inputs) > MOST_SHOWN
    return [mean_figure(fit, fitted), worst_figure(fit, fitted)] if many else [matrix_figure(fit, fitted)]


def mean_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Root mean square over all elements: measured, fitted, residual, and the noise where it is known."""
    factor, lines = form_unit(fitted.form)[1], fitted.frequency
    series = [
        dots("measured", lines, factor * _mean_size(fitted.measured), 0, size=1.5),
        curve("fitted", fitted.drawn[0], factor * _mean_size(fitted.drawn[1]), 1),
        dots("residual", lines, factor * _mean_size(fitted.measured - fitted.fitted), 2, size=1.5),
    ]
    if fitted.variance is not None:
        series.append(curve("noise", lines, factor * np.sqrt(np.mean(fitted.variance, axis=(1, 2))), 3, "--"))
    number = len(fitted.outputs) * len(fitted.inputs)
    caption = (
        f"{fit_title(fit)}: {fitted.form}, root mean square over all {number} elements: measured, fitted, and what is left between them."
    )
    chart = stacked([Panel(FREQUENCY, form_axis(fitted.form), tuple(series))], 3.6)
    return Figure(chart, caption, f"Root mean square of the FRF matrix of fit {fit_title(fit)} over frequency, with the residual")


def _mean_size(values: ComplexArray) -> FloatArray:
    """Root mean square (n_line,) over the elements of (n_line, n_output, n_input)."""
    return np.asarray(np.sqrt(np.mean(np.abs(values) ** 2, axis=(1, 2))))


def worst_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """The elements with the largest residual in relation to their size, the worst first."""
    left = np.sum(np.abs(fitted.measured - fitted.fitted) ** 2, axis=0) / np.sum(np.abs(fitted.measured) ** 2, axis=0)
    worst = np.argsort(-left, axis=None)[:WORST]
    panels = tuple(_element(fitted, *map(int, np.unravel_index(place, left.shape))) for place in worst)
    chart = Chart(panels, WORST // COLUMNS, COLUMNS, (WIDTH, 0.6 + 1.7 * (WORST // COLUMNS)), "x", "above")
    caption = (
        f"{fit_title(fit)}: the {WORST} of {left.size} elements that the fit meets worst in relation to their size (residual "
        f"{100 * np.sqrt(left.flat[worst[0]]):.2g} to {100 * np.sqrt(left.flat[worst[-1]]):.2g} %), response/force; the rest meets better."
    )
    return Figure(chart, caption, f"Amplitude of the {WORST} worst elements of the FRF matrix of fit {fit_title(fit)} over frequency")


def matrix_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Amplitude of every element, measured with two standard deviations (dots, shaded) and fitted (line)."""
    rows, columns = len(fitted.outputs), len(fitted.inputs)
    panels = tuple(_element(fitted, o, i) for o in range(rows) for i in range(columns))
    chart = Chart(panels, rows, columns, (WIDTH, 0.6 + 1.7 * rows), "xy", "above")
    caption = f"{fit_title(fit)}: measured (dots; shaded: two standard deviations) and fitted (lines) {fitted.form}, response/force."
    return Figure(chart, caption, f"Amplitude of every element of the FRF matrix of fit {fit_title(fit)} over frequency")


def _element(fitted: FittedCurve, o: int, i: int) -> Panel:
    factor = form_unit(fitted.form)[1]
    size, band = factor * np.abs(fitted.measured[:, o, i]), None
    if fitted.variance is not None:
        # Half of the variance of the complex value lies along it.
        spread = 2 * factor * np.sqrt(fitted.variance[:, o, i] / 2)
        band = np.maximum(size - spread, LEAST_SHARE * size), size + spread
    lines, values = fitted.drawn
    measured = dots("measured", fitted.frequency, size, 0, size=1.5, band=band)
    model = curve("fitted", lines, factor * np.abs(values[:, o, i]), 1)
    return Panel(FREQUENCY, form_axis(fitted.form), (measured, model), f"{fitted.outputs[o]}/{fitted.inputs[i]}")
