"""A result as a figure of matplotlib, to look at, to change and to save."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from matplotlib.figure import Figure as Canvas

from labpipe.document.charts import canvas_of
from labpipe.errors import DataError
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Fit, Identification
from labpipe.records.response import FrequencyResponse
from labpipe.report.build import build
from labpipe.report.chart import Chart
from labpipe.report.comparison import comparison_figures
from labpipe.report.document import Figure
from labpipe.report.figures import response_figure, sliding_figures
from labpipe.report.fits import fit_figures


def plot(result: Any) -> Canvas:
    """The figure of a result as the report has it, a new matplotlib Figure each time.

    result: a Fit (measured and fitted FRF), several Fits of one sliding fit (coefficients over frequency), a
    FrequencyResponse, a Comparison, or an Identification (the first figure of its report). Raises DataError
    where a result has no figure, TypeError for what is none of these.
    """
    for kind, figures in FIGURES.items():
        if isinstance(result, kind):
            shown = figures(result)
            if not shown:
                what = f"this {type(result).__name__} has no figure"
                raise DataError(what, hint="its curve or responses are missing")
            return canvas_of(shown[0].graphic)
    kinds = ", ".join(kind.__name__ for kind in FIGURES)
    raise TypeError(f"no figure of {type(result).__name__}; known: {kinds}")


def _of_identification(identification: Identification) -> list[Figure]:
    """The figures of its report in their order, but for a short one on the first page."""
    first, *others = (
        [block for block in section.blocks if isinstance(block, Figure)]
        for section in build(identification).sections
    )
    whole = [figure for figure in first if isinstance(figure.graphic, Chart) and figure.graphic.rows > 1]
    return [*whole, *(figure for figures in others for figure in figures)]


def _of_fits(fits: Sequence[Fit]) -> list[Figure]:
    """One fit alone, or the bands of a sliding fit."""
    return sliding_figures(fits) if len(fits) > 1 else [figure for fit in fits for figure in fit_figures(fit)]


FIGURES: dict[type, Callable[[Any], list[Figure]]] = {
    Fit: fit_figures,
    tuple: _of_fits,
    list: _of_fits,
    FrequencyResponse: lambda response: [response_figure(response)],
    # Those that need no response: those of pairs of FRFs stand in the report of their identification.
    Comparison: lambda comparison: comparison_figures(comparison, ()),
    Identification: _of_identification,
}
