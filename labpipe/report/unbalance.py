"""The response to unbalance as people read it: forward and backward circles over speed, and their largest."""

from __future__ import annotations

import numpy as np

from labpipe.display import with_error
from labpipe.records.identification import Identification
from labpipe.records.unbalance import UnbalanceCase, UnbalanceRuns
from labpipe.report.chart import Axis, Panel, curve, look, stacked
from labpipe.report.document import Block, Figure, Paragraph, Section, Table

UM = 1e6
HEADER = ("case", "depth [um]", "angle [deg]", "forward [um]", "at [Hz]", "backward [um]", "at [Hz]", "ratio")
EXPLAINED = (
    "An unbalance turns with the shaft. Bearings that are alike in all directions answer with a forward circle only; the backward circle "
    "measures how unlike they are, and wear of one bearing enlarges it. Radii of the circles, 0-to-peak, once per revolution."
)


def unbalance_sections(runs: UnbalanceRuns, _identification: Identification) -> tuple[Section, ...]:
    """The section of the response to unbalance."""
    return (Section(f"Unbalance: {runs.rotor}", unbalance_blocks(runs)),)


def unbalance_blocks(runs: UnbalanceRuns) -> tuple[Block, ...]:
    """What it means, table and figure."""
    rows = []
    for case in runs.cases:
        (forward, _), (at, _), (backward, _), (back_at, _) = runs.values(case).values()
        wear = (f"{UM * case.depth:.4g}", f"{np.degrees(case.angle):.4g}") if case.depth else ("0", "")
        peaks = (
            _with_doubt(UM * forward, UM, case, "forward_peak"),
            _with_doubt(at, 1.0, case, "forward_speed"),
            _with_doubt(UM * backward, UM, case, "backward_peak"),
            _with_doubt(back_at, 1.0, case, "backward_speed"),
        )
        rows.append((case.name, *wear, *peaks, f"{backward / forward:.3f}"))
    caption = f"Largest radii over {len(runs.speed)} speeds from {runs.speed[0]:g} to {runs.speed[-1]:g} Hz, and backward over forward"
    if any(case.changes for case in runs.cases):
        caption += "; standard uncertainties by the doubts of the bearings' numbers and the step of the speeds"
    return (Paragraph(EXPLAINED), Table(HEADER, tuple(rows), caption, tuple(range(1, 8))), unbalance_figure(runs))


def _with_doubt(value: float, factor: float, case: UnbalanceCase, name: str) -> str:
    """A value [shown unit] with its standard uncertainty, *factor* of it [shown unit per SI unit], where it has one."""
    error = case.error(name)
    return f"{value:.4g}" if error is None else with_error(value, factor * error)


def unbalance_figure(runs: UnbalanceRuns) -> Figure:
    """Forward and backward radius over speed, one line per case."""
    panels = []
    for name in ("forward", "backward"):
        radii = [UM * np.array(getattr(case, name)) for case in runs.cases]
        cases = enumerate(zip(runs.cases, radii, strict=True))
        series = [curve(case.name, runs.speed, radius, *look(number), width=1.5) for number, (case, radius) in cases]
        panels.append(Panel(Axis("speed", "Hz"), Axis(name, "um", logarithmic=True), tuple(series)))
    caption = f"{runs.rotor}: response to unbalance at node {runs.node}, wear of {runs.bearing}; forward circle above, backward below."
    return Figure(stacked(panels, 5.0), caption, f"Forward and backward response to unbalance of {runs.rotor} over speed")
