"""What the figures of a report cost: on a page the numbers alone, beside a drawing by matplotlib."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.layout_engine import ConstrainedLayoutEngine

from labpipe.document.charts import canvas_of, svg_text
from labpipe.document.html_page import render_html
from labpipe.document.pdf import render_pdf
from labpipe.report.chart import Axis, Chart, Panel, curve, dots, stack
from labpipe.report.document import Document, Figure, Section
from tests.benchmarks.test_spectral_ratios import ratios

LINES, CURVES = 400, 4


def test_a_figure_of_a_page_costs_a_fraction_of_its_drawing_for_print(
    capsys: pytest.CaptureFixture[str],
) -> None:
    chart = fit_chart(1)
    document = Document("T", "", (Section("S", (Figure(chart, "a fit", "a fit"),)),))
    (matplotlib,) = ratios(lambda: render_html(document), lambda: svg_text(canvas_of(chart)))
    with capsys.disabled():
        print(f"\na figure of {3 * 2 * CURVES} curves by matplotlib: {matplotlib:.1f} times its page")
    assert matplotlib > 4


@pytest.mark.parametrize(("step", "n_layout"), [(0.0, 1), (0.01, 4)])
def test_figures_alike_of_a_pdf_share_their_canvas_and_layout(
    monkeypatch: pytest.MonkeyPatch, step: float, n_layout: int
) -> None:
    """Four fits, alike or of slightly different heights: laying out and making axes are what a figure costs
    most, and a count is not a matter of what else the machine does.
    """
    layouts, axes = count(), count()

    def execute(self: ConstrainedLayoutEngine, canvas: object) -> None:
        next(layouts)
        laid_out(self, canvas)

    def begin(self: Axes, *arguments: object, **named: object) -> None:
        next(axes)
        made(self, *arguments, **named)

    laid_out, made = ConstrainedLayoutEngine.execute, Axes.__init__
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", execute)
    monkeypatch.setattr(Axes, "__init__", begin)
    figures = [Figure(fit_chart(seed, 6.0 + step * seed), "a fit", "a fit") for seed in range(4)]
    render_pdf(Document("T", "", (Section("S", tuple(figures)),)))
    assert (next(layouts), next(axes)) == (n_layout, 3 * n_layout)


def fit_chart(seed: int, height: float = 6.0) -> Chart:
    """Three panels over one frequency, each with four measured and four fitted curves: what a fit of a 2 x 2
    FRF shows.
    """
    rng = np.random.default_rng(seed)
    frequency = np.linspace(10.0, 100.0, LINES)
    panels = []
    for title in ("receptance", "phase", "residual"):
        # Of the same ends, so that axes have the same numbers.
        values = np.clip(np.abs(rng.normal(size=(CURVES, LINES))), 0.1, 2.0)
        both = [
            make(f"term {n}", frequency, row, n) for n, row in enumerate(values) for make in (curve, dots)
        ]
        panels.append(Panel(Axis("frequency", "Hz"), Axis(title, "um/N"), tuple(both)))
    return stack(panels, height)
