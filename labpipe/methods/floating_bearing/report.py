"""The figures of a floating-bearing fit: H over frequency with the model and the baseline, and what a forward
orbit feels.
"""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.fit_details import DynamicStiffness, FitDetailKind
from labpipe.records.identification import Fit
from labpipe.report.chart import GREY, WIDTH, Axis, Chart, Panel, Series, curve, dots, level
from labpipe.report.document import Block, Figure, Table
from labpipe.report.figures import FREQUENCY
from labpipe.report.wording import fit_title

TWO_SIGMA = 1.96
MEGA = 1e-6
AXES = "xy"
PARTS = (("Re", np.real), ("Im", np.imag))


def dynamic_stiffness_blocks(fit: Fit, shown: DynamicStiffness) -> list[Block]:
    orbit = [] if shown.absolute else [effective_figure(fit, shown)]
    other = [excitation_table(fit, shown)] if shown.excitations else []
    return [*other, stiffness_figure(fit, shown), *orbit]


def excitation_table(fit: Fit, shown: DynamicStiffness) -> Table:
    letters = shown.excitations[0].matrices
    header = ("excitation", *(f"{letter.upper()} times" for letter in letters))
    rows = tuple((other.name, *(f"{ratio:.2f}" for ratio in other.ratios)) for other in shown.excitations)
    caption = (
        f"Standard errors by noise of {fit_title(fit)} with other excitations of the same time and "
        "r.m.s. force, this test being 1"
    )
    return Table(header, rows, caption, tuple(range(1, len(header))))


def stiffness_figure(fit: Fit, shown: DynamicStiffness) -> Figure:
    panels = tuple(_part(shown, i, j, which) for which in range(2) for i in range(2) for j in range(2))
    lines, baseline = "of every line from its runs", ""
    if shown.paired:
        middle = "the model in their middle and what both leave"
        lines = f"of two neighbouring lines each ({middle}), since a line has one vector"
    if not shown.frequency.size:
        lines = "not drawn, since the lines do not give it without a model"
    if shown.baseline is not None:
        baseline = " Dashed: the baseline, which the measured values are without."
    caption = (
        f"{fit_title(fit)}: dynamic stiffness, force in the first direction per displacement in the second. "
        f"Dots: measured, {lines}, with 95 % intervals by noise; line: the model.{baseline} The fit itself "
        "uses the channels, not these values."
    )
    return Figure(
        Chart(panels, 4, 2, (WIDTH, 7.2), "x", "above"),
        caption,
        f"Real and imaginary parts of the dynamic stiffness of fit {fit_title(fit)} over frequency",
    )


def _part(shown: DynamicStiffness, i: int, j: int, which: int) -> Panel:
    name, part = PARTS[which]

    def values(h: ComplexArray) -> FloatArray:
        return MEGA * part(h[:, i, j])

    series: list[Series] = []
    if shown.frequency.size:
        measured = values(shown.measured)
        reach = MEGA * TWO_SIGMA * np.sqrt(shown.variance[:, i, j] / 2)
        bars = measured - reach, measured + reach
        series.append(dots("measured", shown.frequency, measured, 0, marker="o", size=2.0, bars=bars))
    series.append(curve("model", shown.drawn_frequency, values(shown.fitted), 1, width=1.5))
    if shown.baseline is not None:
        series.append(curve("baseline", shown.drawn_frequency, values(shown.baseline), GREY, "--"))
    return Panel(FREQUENCY, Axis(f"{name} H_{AXES[i]}{AXES[j]}", "MN/m"), tuple(series))


def effective_figure(fit: Fit, shown: DynamicStiffness) -> Figure:
    panels = (
        _effective("effective stiffness", "MN/m", shown.drawn_frequency, MEGA * shown.effective_stiffness),
        _effective("effective damping", "kN s/m", shown.drawn_frequency, 1e-3 * shown.effective_damping),
    )
    caption = (
        f"{fit_title(fit)}: what a forward circular orbit feels, with 95 % intervals. Where effective "
        "damping is negative, the bearing drives whirl; the frequency at which it is zero is the crossover "
        "frequency."
    )
    alone = f"Effective stiffness and damping of fit {fit_title(fit)} over frequency"
    return Figure(Chart(panels, 1, 2, (WIDTH, 2.8)), caption, alone)


def _effective(name: str, unit: str, frequency: FloatArray, values: FloatArray) -> Panel:
    course = curve(name, frequency, values[:, 0], 0, band=(values[:, 1], values[:, 2]))
    return Panel(FREQUENCY, Axis(name, unit), (course, level(0.0)))


DYNAMIC_STIFFNESS_DETAIL = FitDetailKind(DynamicStiffness, dynamic_stiffness_blocks)
