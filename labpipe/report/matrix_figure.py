"""A fitted FRF matrix of many elements: one small panel for each, as they stand in the matrix."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from labpipe.records.identification import Fit, FittedCurve
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import WIDTH, form_unit, logarithmic
from labpipe.report.wording import fit_title

# More elements than this cannot be told apart in one pair of axes.
MOST_TOGETHER = 4


def matrix_figure(fit: Fit, curve: FittedCurve) -> Figure:
    """Amplitude of every element, measured with two standard deviations (dots, shaded) and fitted (line)."""
    n_output, n_input = len(curve.outputs), len(curve.inputs)
    label, factor = form_unit(curve.form)
    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(WIDTH, 0.6 + 1.7 * n_output), layout="constrained")
        panels = canvas.subplots(n_output, n_input, squeeze=False, sharex=True, sharey=True)
        for (o, i), axes in np.ndenumerate(panels):
            _element(axes, curve, o, i, factor)
        logarithmic(panels[0, 0])
        canvas.supxlabel("frequency [Hz]", fontsize=9)
        canvas.supylabel(label, fontsize=9)
    caption = f"{fit_title(fit)}: measured (dots; shaded: two standard deviations) and fitted (lines) {curve.form}, response/force."
    return Figure(canvas, caption, f"Amplitude of every element of the FRF matrix of fit {fit_title(fit)} over frequency")


def _element(axes: Axes, curve: FittedCurve, o: int, i: int, factor: float) -> None:
    size = factor * np.abs(curve.measured[:, o, i])
    if curve.variance is not None:
        # Half of the variance of the complex value lies along it.
        spread = 2 * factor * np.sqrt(curve.variance[:, o, i] / 2)
        axes.fill_between(curve.frequency, np.maximum(size - spread, 0.05 * size), size + spread, color=COLOURS[0], alpha=0.15, linewidth=0)
    axes.plot(curve.frequency, size, ".", color=COLOURS[0], markersize=3)
    axes.plot(curve.frequency, factor * np.abs(curve.fitted[:, o, i]), "-", color=COLOURS[1], linewidth=1)
    axes.set_title(f"{curve.outputs[o]}/{curve.inputs[i]}", fontsize=8)
