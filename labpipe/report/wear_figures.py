"""The figures of worn-bearing fits: where depth and angle lie together, and a model before and after its tuning."""

from __future__ import annotations

import numpy as np

from labpipe.records.identification import Fit, FittedCurve, Region
from labpipe.report.chart import GREY, Axis, Panel, Series, curve, dots, level, outline, stacked, upright
from labpipe.report.document import Figure
from labpipe.report.figures import FREQUENCY, form_unit, scale_of
from labpipe.report.wording import fit_title, unit_text


def wear_figures(fit: Fit) -> list[Figure]:
    """The figures that a fit asks for; none where it has neither a joint region nor a model before it."""
    region = [] if fit.region is None else [region_figure(fit, fit.region)]
    tuned = fit.curve is not None and fit.curve.before is not None
    return [*region, *([tuning_figure(fit, fit.curve)] if tuned and fit.curve is not None else [])]


def region_figure(fit: Fit, region: Region) -> Figure:
    """The outline of the joint confidence region around the estimate, with the intervals of each parameter alone."""
    parameters = [fit.parameter(name) for name in region.names]
    factors = [scale_of(parameter.unit) for parameter in parameters]
    x, y = (np.vstack([region.outline, region.outline[:1]]) * factors).T
    joint = f"{100 * region.level:g} % joint region"
    series: list[Series] = [outline(joint, x, y), curve(joint, x, y, width=1.5)]
    series += [upright(factors[0] * end, line="--") for end in parameters[0].ci95 or ()]
    series += [level(factors[1] * end, line="--") for end in parameters[1].ci95 or ()]
    estimate = [factor * parameter.value for factor, parameter in zip(factors, parameters, strict=True)]
    series.append(dots("estimate", estimate[:1], estimate[1:], 1, marker="o", size=6.0))
    axes = [Axis(parameter.name, unit_text(parameter.unit)) for parameter in parameters]
    caption = (
        f"{fit_title(fit)}: joint {100 * region.level:g} % confidence region of {' and '.join(region.names)}, from the profile of chi², "
        "all other parameters estimated again. Dashed: the 95 % interval of each alone, which is narrower than the region."
    )
    chart = stacked([Panel(axes[0], axes[1], tuple(series))], 3.6)
    return Figure(chart, caption, f"Joint confidence region of {' and '.join(region.names)} of fit {fit_title(fit)}")


def tuning_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Measured amplitude of every term with the model before and after its tuning."""
    terms = [(o, i) for o in range(len(fitted.outputs)) for i in range(len(fitted.inputs))]
    panels = [_before_and_after(fitted, o, i) for o, i in terms]
    caption = f"{fit_title(fit)}: measured {fitted.form}, and the model before and after its tuning, one panel per term."
    chart = stacked(panels, 0.8 + 1.6 * len(terms))
    return Figure(chart, caption, f"Measured {fitted.form} and the model before and after tuning {fit_title(fit)}")


def _before_and_after(fitted: FittedCurve, o: int, i: int) -> Panel:
    """One term: dots measured, dashed before, full after."""
    assert fitted.before is not None
    unit, factor = form_unit(fitted.form)
    lines, after = fitted.drawn
    series = (
        dots("measured", fitted.frequency, factor * np.abs(fitted.measured[:, o, i]), GREY),
        curve("before tuning", fitted.frequency, factor * np.abs(fitted.before[:, o, i]), 1, "--", width=1.5),
        curve("after tuning", lines, factor * np.abs(after[:, o, i]), width=1.5),
    )
    return Panel(FREQUENCY, Axis(f"{fitted.outputs[o]}/{fitted.inputs[i]} {fitted.form}", unit, logarithmic=True), series)
