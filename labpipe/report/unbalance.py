"""The response to unbalance as people read it: forward and backward circles over speed, and their largest."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np

from labpipe.records.identification import Identification
from labpipe.records.unbalance import UnbalanceRuns
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import logarithmic, stacked_axes

UM = 1e6
HEADER = ("case", "depth [um]", "angle [deg]", "forward [um]", "at [Hz]", "backward [um]", "at [Hz]", "ratio")
EXPLAINED = (
    "An unbalance turns with the shaft. Bearings that are alike in all directions answer with a forward circle only; the backward circle "
    "measures how unlike they are, and wear of one bearing enlarges it. Radii of the circles, 0-to-peak, once per revolution."
)


def unbalance_sections(runs: UnbalanceRuns, _identification: Identification) -> tuple[Section, ...]:
    """The section of a response to unbalance."""
    return (Section(f"Unbalance: {runs.rotor}", unbalance_blocks(runs)),)


def unbalance_blocks(runs: UnbalanceRuns) -> tuple[Block, ...]:
    """What it means, table and figure."""
    rows = []
    for case in runs.cases:
        found = runs.values(case)
        (forward, _), (at, _), (backward, _), (back_at, _) = found.values()
        wear = (f"{UM * case.depth:.4g}", f"{np.degrees(case.angle):.4g}") if case.depth else ("0", "")
        peaks = (f"{UM * forward:.4g}", f"{at:g}", f"{UM * backward:.4g}", f"{back_at:g}", f"{backward / forward:.3f}")
        rows.append((case.name, *wear, *peaks))
    caption = f"Largest radii over {len(runs.speed)} speeds from {runs.speed[0]:g} to {runs.speed[-1]:g} Hz, and backward over forward"
    return (Paragraph(EXPLAINED), Table(HEADER, tuple(rows), caption, tuple(range(1, 8))), unbalance_figure(runs))


def unbalance_figure(runs: UnbalanceRuns) -> Figure:
    """Forward and backward radius over speed, one line per case."""
    with mpl.rc_context(STYLE):
        canvas, panels = stacked_axes(2, 5.0, sharex=True)
        for axes, name in zip(panels, ("forward", "backward"), strict=True):
            for number, case in enumerate(runs.cases):
                axes.plot(runs.speed, UM * np.array(getattr(case, name)), color=COLOURS[number % len(COLOURS)], label=case.name)
            logarithmic(axes)
            axes.set_ylabel(f"{name} [um]")
        panels[0].legend(ncols=4, fontsize=8)
        panels[1].set_xlabel("speed [Hz]")
    caption = f"{runs.rotor}: response to unbalance at node {runs.node}, wear of {runs.bearing}; forward circle above, backward below."
    return Figure(canvas, caption, f"Forward and backward response to unbalance of {runs.rotor} over speed")
