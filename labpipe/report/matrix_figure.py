"""A fitted FRF matrix of many elements: one small panel per element, in matrix order."""

from __future__ import annotations

import numpy as np

from labpipe.records.identification import Fit, FittedCurve
from labpipe.report.chart import WIDTH, Chart, Panel, curve, dots
from labpipe.report.document import Figure
from labpipe.report.figures import FREQUENCY, form_axis, form_unit
from labpipe.report.wording import fit_title

# Largest number of elements in one pair of axes.
MOST_TOGETHER = 4
# Part of the amplitude at which a band ends that would reach below zero, for which a logarithmic axis has no place.
LEAST_SHARE = 0.05


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
