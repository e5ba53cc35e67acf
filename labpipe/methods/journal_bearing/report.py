"""The oil film of a journal bearing as a figure: its pressure unrolled, and over it the thickness."""

from __future__ import annotations

from labpipe.bearings.kinds import PressureField
from labpipe.report.chart import WIDTH, Drawing
from labpipe.report.document import Figure

HEIGHT = 5.2


def film_figure(name: str, film: PressureField) -> Figure:
    """Pressure over angle and width as filled contours.

    Below, pressure at mid width and the film's thickness.
    """
    caption = (
        f"{name}: pressure of the oil film against ambient, unrolled; below, at mid width (full) with "
        "the film's thickness (dashed)."
    )
    drawing = Drawing("film", film, (WIDTH, HEIGHT))
    return Figure(drawing, caption, f"Pressure of the oil film of {name} over angle and width")
