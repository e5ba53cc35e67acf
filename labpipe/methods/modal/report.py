"""The figures and tables of modal fits: the stabilisation diagram, the shapes with their uncertainty, and
their likeness.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.records.fit_details import FitDetailKind, Modes, StabilisationDiagram
from labpipe.records.identification import Fit
from labpipe.report import chart
from labpipe.report.document import Block, Figure, Paragraph, Table
from labpipe.report.figures import FREQUENCY, shape_figures
from labpipe.report.wording import fit_title

# Largest number of points whose names stand below the panels of the shapes.
MOST_NAMES = 12
COLUMNS = 3
HEADER = (
    "mode", "f [Hz]", "zeta [%]", "largest at", "strongest reference", "phase collinearity", "returns [%]",
    "m, k, c at",
)  # fmt: skip
# Modes whose likeness a sentence says.
FEW_MODES = 3
# Limits of 95 % of a standard normal value.
TWO_SIGMA = 1.96


def modal_blocks(fit: Fit, modes: Modes) -> list[Block]:
    # With a model error a mode is not stated where the pole of all lines lies.
    stated = {parameter.name: parameter.value for parameter in fit.parameters}
    frequency = [stated.get(f"f_n_{n}", of_pole) for n, of_pole in enumerate(modes.frequency.tolist(), 1)]
    modes = replace(modes, frequency=np.array(frequency))
    diagram = [] if modes.diagram is None else [diagram_figure(fit, modes, modes.diagram)]
    alike = _mac_blocks(fit, modes) if modes.frequency.size > 1 and len(modes.points) > 1 else []
    shapes = [shapes_figure(fit, modes)] if len(modes.points) > 1 else []
    # Of a single FRF the parameters say all that the table would.
    listed = [modes_table(fit, modes)] if len(modes.points) > 1 or modes.driving_points else []
    return [*listed, *diagram, *shape_figures(fit_title(fit), modes), *shapes, *alike]


def modes_table(fit: Fit, modes: Modes) -> Table:
    largest = np.argmax(np.abs(modes.shapes), axis=0)
    strongest = np.argmax(np.abs(modes.participation), axis=1)
    stated = {parameter.name: parameter.value for parameter in fit.parameters}
    rows = tuple(
        (
            str(n + 1),
            f"{modes.frequency[n]:.6g}",
            # A loss factor is twice the damping ratio of the same peak.
            f"{100 * stated.get(f'zeta_{n + 1}', stated.get(f'eta_{n + 1}', 2 * ratio) / 2):.4g}",
            modes.points[largest[n]],
            modes.references[strongest[n]],
            f"{modes.collinearity[n]:.4f}",
            "" if modes.returns is None else f"{100 * modes.returns[n]:.0f}",
            modes.driving_points[n] if modes.driving_points else "",
        )
        for n, ratio in enumerate(modes.damping_ratio.tolist())
    )
    return Table(HEADER, rows, f"Modes of {fit_title(fit)}", (1, 2, 5, 6))


def diagram_figure(fit: Fit, modes: Modes, diagram: StabilisationDiagram) -> Figure:
    indicators = [
        chart.curve(f"singular value {n + 1}", diagram.indicator_frequency, values, *chart.look(n))
        for n, values in enumerate(diagram.indicator.T)
    ]
    chosen = diagram.mode >= 0
    poles: list[chart.Series] = [chart.upright(float(frequency), line=":") for frequency in modes.frequency]
    poles.append(
        chart.dots("pole of noise", diagram.frequency[~chosen], diagram.order[~chosen], chart.GREY, size=3.0)
    )
    poles.append(chart.dots("pole of a mode", diagram.frequency[chosen], diagram.order[chosen], 0, size=4.0))
    panels = [
        chart.Panel(FREQUENCY, chart.Axis("CMIF", "", logarithmic=True), tuple(indicators)),
        chart.Panel(FREQUENCY, chart.Axis("order"), tuple(poles), share=1.4, pick="poles"),
    ]
    # The singular value of one FRF is its amplitude.
    alone = diagram.indicator.shape[1] == 1 and len(modes.points) == 1
    what = "the" if alone else "singular values of the FRF matrix (complex mode indicator function), and the"
    caption = (
        f"{what} stable poles of all orders. Poles that return at the same place are modes "
        "of the structure; dotted: the modes of the fit. In the page a click on a pole chooses it; the line "
        "`poles:` for the section `modal:` then stands below."
    )
    graphic = chart.stack(panels[1:], 2.0) if alone else chart.stack(panels, 3.6)
    if modes.returns is not None:
        least = int(np.argmin(modes.returns))
        caption += (
            f" Least sure is mode {least + 1} at {modes.frequency[least]:.5g} Hz, whose pole returns in "
            f"{100 * modes.returns[least]:.0f} % of the orders."
            if modes.returns[least] < 1
            else " The poles of all modes return in every order."
        )
    return _figure(fit, graphic, caption, "Stabilisation diagram")


def _figure(fit: Fit, graphic: chart.Chart, caption: str, name: str) -> Figure:
    return Figure(graphic, f"{fit_title(fit)}: {caption}", f"{name} of fit {fit_title(fit)}")


def shapes_figure(fit: Fit, modes: Modes) -> Figure:
    few = len(modes.points) <= MOST_NAMES
    axis = chart.Axis("point", ticks=chart.named_ticks(modes.points) if few else ())
    panels = tuple(_shape(modes, n, axis, few) for n in range(modes.frequency.size))
    rows = -(-len(panels) // COLUMNS)
    graphic = chart.Chart(
        panels, rows, min(COLUMNS, len(panels)), (chart.WIDTH, 0.6 + 1.4 * rows), "x", "above"
    )
    caption = (
        "real part of the mode shapes with 95 % intervals, the largest point 1, "
        f"over {len(modes.points)} points."
    )
    return _figure(fit, graphic, caption, "Mode shapes")


def _shape(modes: Modes, n: int, axis: chart.Axis, few: bool) -> chart.Panel:
    shape = modes.shapes[:, n]
    # The phase that makes the sum of squares of the imaginary part least.
    turned = (shape * np.exp(-0.5j * np.angle(np.sum(shape**2)))).real
    turned = turned * np.sign(turned[np.argmax(np.abs(turned))])
    spread = TWO_SIGMA * modes.shape_std_errors[:, n] / np.sqrt(2)
    places = np.arange(turned.size, dtype=float)
    ends = turned - spread, turned + spread
    line = chart.curve("shape", places, turned, 0, "" if few else "-", marker="o" if few else "", bars=ends)
    return chart.Panel(
        axis, chart.Axis("shape"), (chart.level(0.0), line), f"{n + 1}: {modes.frequency[n]:.4g} Hz"
    )


def _mac_blocks(fit: Fit, modes: Modes) -> list[Block]:
    n = modes.frequency.size
    if n > FEW_MODES:
        return [mac_figure(fit, modes)]
    pairs = [f"{i + 1} and {j + 1}: {modes.mac[i, j]:.2f}" for i in range(n) for j in range(i + 1, n)]
    return [Paragraph(f"Modal assurance criterion of the shapes of modes {', '.join(pairs)}.")]


def mac_figure(fit: Fit, modes: Modes) -> Figure:
    names = [f"{frequency:.4g}" for frequency in modes.frequency]
    texts = [[f"{value:.2f}" for value in row] for row in modes.mac.tolist()]
    axis = chart.Axis("mode [Hz]", ticks=chart.named_ticks(names))
    side = max(2.4, 0.5 * len(names))
    graphic = chart.Chart(
        (chart.Panel(axis, axis, (chart.cells(modes.mac, texts, "MAC"),)),), size=(side + 0.9, side)
    )
    caption = (
        "modal assurance criterion between the shapes. Two shapes near 1 cannot be "
        "told apart at these points."
    )
    return _figure(fit, graphic, caption, "Modal assurance criterion")


MODES_DETAIL = FitDetailKind(Modes, modal_blocks)
