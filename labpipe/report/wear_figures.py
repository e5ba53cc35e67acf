"""The figures of worn-bearing fits: where depth and angle lie together, and a model before and after its tuning."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from labpipe.quantities import display_unit, to_display
from labpipe.records.identification import Fit, FittedCurve, Region
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import form_unit, logarithmic, stacked_axes
from labpipe.report.wording import fit_title, unit_text


def wear_figures(fit: Fit) -> list[Figure]:
    """The figures that a fit asks for; none where it has neither a joint region nor a model before it."""
    region = [] if fit.region is None else [region_figure(fit, fit.region)]
    tuned = fit.curve is not None and fit.curve.before is not None
    return [*region, *([tuning_figure(fit, fit.curve)] if tuned and fit.curve is not None else [])]


def region_figure(fit: Fit, region: Region) -> Figure:
    """The outline of the joint confidence region around the estimate, with the intervals of each parameter alone."""
    parameters = [fit.parameter(name) for name in region.names]
    units = [display_unit(parameter.unit) for parameter in parameters]
    factors = [to_display(1.0, unit) for unit in units]
    titles = [f"{parameter.name} [{unit_text(parameter.unit)}]" for parameter in parameters]
    closed = np.vstack([region.outline, region.outline[:1]]) * factors
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.6)
        axes.fill(*closed.T, color=COLOURS[0], alpha=0.15, linewidth=0)
        axes.plot(*closed.T, "-", color=COLOURS[0], label=f"{100 * region.level:g} % joint region")
        ends = [(np.nan, np.nan) if one.ci95 is None else one.ci95 for one in parameters]
        for draw, pair, factor in zip((axes.axvline, axes.axhline), ends, factors, strict=True):
            for end in pair:
                draw(factor * end, color="0.45", linewidth=0.8, linestyle="--")
        axes.plot(*([factor * one.value] for factor, one in zip(factors, parameters, strict=True)), "o", color=COLOURS[1], label="estimate")
        axes.set_xlabel(titles[0])
        axes.set_ylabel(titles[1])
        axes.legend(fontsize=8)
    caption = (
        f"{fit_title(fit)}: joint {100 * region.level:g} % confidence region of {' and '.join(region.names)}, from the profile of chi², "
        "all other parameters estimated again. Dashed: the 95 % interval of each alone, which is narrower than the region."
    )
    return Figure(canvas, caption, f"Joint confidence region of {' and '.join(region.names)} of fit {fit_title(fit)}")


def tuning_figure(fit: Fit, curve: FittedCurve) -> Figure:
    """Measured amplitude of every term with the model before and after its tuning."""
    assert curve.before is not None
    terms = [(o, i) for o in range(len(curve.outputs)) for i in range(len(curve.inputs))]
    with mpl.rc_context(STYLE):
        canvas, panels = stacked_axes(len(terms), 0.8 + 1.6 * len(terms), sharex=True)
        for axes, (o, i) in zip(panels, terms, strict=True):
            _before_and_after(axes, curve, o, i)
        panels[0].legend(ncols=3, fontsize=8)
        panels[-1].set_xlabel("frequency [Hz]")
    caption = f"{fit_title(fit)}: measured {curve.form}, and the model before and after its tuning, one panel per term."
    return Figure(canvas, caption, f"Measured {curve.form} and the model before and after tuning {fit_title(fit)}")


def _before_and_after(axes: Axes, curve: FittedCurve, o: int, i: int) -> None:
    """One term: dots measured, dashed before, full after."""
    assert curve.before is not None
    label, factor = form_unit(curve.form)
    size = {name: factor * np.abs(matrix[:, o, i]) for name, matrix in (("m", curve.measured), ("b", curve.before), ("a", curve.fitted))}
    axes.plot(curve.frequency, size["m"], ".", color="0.6", label="measured")
    axes.plot(curve.frequency, size["b"], "--", color=COLOURS[1], label="before tuning")
    axes.plot(curve.frequency, size["a"], "-", color=COLOURS[0], label="after tuning")
    logarithmic(axes)
    axes.set_ylabel(f"{curve.outputs[o]}/{curve.inputs[i]}\n{label}")
