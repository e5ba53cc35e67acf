"""The figure of worn-bearing fits: where depth and angle lie together."""

from __future__ import annotations

import numpy as np

from labpipe.records.fit_details import FitDetailKind, Region
from labpipe.records.identification import Fit
from labpipe.report.chart import Axis, Panel, Series, curve, dots, level, outline, stack, upright
from labpipe.report.document import Figure
from labpipe.report.figures import scale_of
from labpipe.report.wording import fit_title, unit_text


def region_figure(fit: Fit, region: Region) -> Figure:
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
        f"{fit_title(fit)}: joint {100 * region.level:g} % confidence region of "
        f"{' and '.join(region.names)}, from the profile of chi², all other parameters estimated again. "
        "Dashed: the 95 % interval of each alone, which is narrower than the region."
    )
    return Figure(
        stack([Panel(axes[0], axes[1], tuple(series))], 3.6),
        caption,
        f"Joint confidence region of {' and '.join(region.names)} of fit {fit_title(fit)}",
    )


REGION_DETAIL = FitDetailKind(Region, lambda fit, region: [region_figure(fit, region)])
