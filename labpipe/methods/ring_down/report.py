"""The figures of fits of free decays: the course over time with what the fit leaves, and damping and
frequency over amplitude.
"""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.fit_details import FitDetailKind, OverAmplitude, RingDown
from labpipe.records.identification import Fit
from labpipe.report.chart import GREY, Axis, Panel, curve, level, stack
from labpipe.report.document import Figure
from labpipe.report.figures import scale_of
from labpipe.report.wording import fit_title, unit_text

TWO_SIGMA = 1.96
LAW_POINTS = 60
MODE_HEIGHT = 3.4


def ring_down_figures(fit: Fit, shown: RingDown) -> list[Figure]:
    modes = [
        over_amplitude_figure(fit, shown, n, mode)
        for n, mode in enumerate(shown.modes, start=1)
        if mode.amplitude.size > 1
    ]
    time, factor, unit = Axis("time in the recording", "s"), scale_of(shown.unit), unit_text(shown.unit)
    measured = curve("measured", shown.time, factor * shown.measured, 0)
    fitted = curve("fitted", shown.time, factor * shown.fitted, 1, "--", width=0.8)
    residual = curve("residual", shown.time, factor * shown.residual, GREY, width=0.8)
    panels = (
        Panel(time, Axis(shown.output, unit), (measured, fitted), share=2.0),
        Panel(time, Axis("residual", unit), (residual, level(0.0))),
    )
    caption = (
        f"{fit_title(fit)}: free decay of {shown.output} in recording '{shown.recording}', the largest of "
        "those fitted, and what the fit leaves of it. A residual that swells and fades with the decay shows "
        "that one exponential per mode does not say it all."
    )
    return [Figure(stack(panels, 4.2), caption, f"Free decay of fit {fit_title(fit)}"), *modes]


def over_amplitude_figure(fit: Fit, shown: RingDown, number: int, mode: OverAmplitude) -> Figure:
    unit = mode.unit or shown.unit
    across = Axis("amplitude", unit_text(unit), logarithmic=True)
    factor, law = scale_of(unit), mode.law
    amplitudes = np.geomspace(mode.amplitude[0], mode.amplitude[-1], LAW_POINTS)
    rows = (
        (f"damping ratio {number}", "%", 100 * mode.damping, 100 * mode.damping_std_error),
        (f"frequency {number}", "Hz", mode.frequency, mode.frequency_std_error),
    )
    courses: list[FloatArray | None] = [None, None]
    if law is not None:
        damping = law.zeta_rest + law.zeta_slope * amplitudes
        courses = [100 * damping, (law.omega + law.frequency_slope * amplitudes) / (2 * np.pi)]
    panels = []
    for (title, of_row, values, std_errors), course in zip(rows, courses, strict=True):
        ends = values - TWO_SIGMA * std_errors, values + TWO_SIGMA * std_errors
        series = [curve("stretches", factor * mode.amplitude, values, 0, "", marker="o", bars=ends)]
        if course is not None:
            series.append(curve("law", factor * amplitudes, course, 1))
        panels.append(Panel(across, Axis(title, of_row), tuple(series)))
    line = " The line is the fitted law of both." if law is not None else ""
    caption = (
        f"{fit_title(fit)}: mode {number} stretch by stretch, with 95 % intervals. Level: the mode is linear "
        f"over the amplitudes of the decay.{line}"
    )
    chart = stack(panels, MODE_HEIGHT)
    return Figure(chart, caption, f"Mode {number} of fit {fit_title(fit)} over amplitude")


RING_DOWN_DETAIL = FitDetailKind(RingDown, ring_down_figures)
