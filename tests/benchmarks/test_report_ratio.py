"""What the figures of a report cost: on a page the numbers alone, beside a drawing by matplotlib."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.document.charts import canvas_of, svg_text
from labpipe.document.html_page import render_html
from labpipe.document.pdf import render_pdf
from labpipe.report.chart import Axis, Chart, Panel, curve, dots, stack
from labpipe.report.document import Document, Figure, Section
from tests.benchmarks.test_spectral_ratios import ratios

LINES, CURVES = 400, 4
MOST_OF_ONE = 0.57


def test_a_figure_of_a_page_costs_a_fraction_of_its_drawing_for_print(
    capsys: pytest.CaptureFixture[str],
) -> None:
    chart = fit_chart(1)
    document = Document("T", "", (Section("S", (Figure(chart, "a fit", "a fit"),)),))
    (matplotlib,) = ratios(lambda: render_html(document), lambda: svg_text(canvas_of(chart)))
    with capsys.disabled():
        print(f"\na figure of {3 * 2 * CURVES} curves by matplotlib: {matplotlib:.1f} times its page")
    assert matplotlib > 4


def test_figures_alike_of_a_pdf_share_their_canvas_and_layout(capsys: pytest.CaptureFixture[str]) -> None:
    """Twelve fits over twelve times one of them: the first is laid out and has its axes made, the others not.

    Measured 0.43, and 0.69 where each has its own; one figure alone has the cost of the fonts and the file.
    """
    figures = [Figure(fit_chart(seed), "a fit", "a fit") for seed in range(12)]

    def pdf(count: int) -> bytes:
        return render_pdf(Document("T", "", (Section("S", tuple(figures[:count])),)))

    (many,) = ratios(lambda: pdf(1), lambda: pdf(12), repeats=3)
    with capsys.disabled():
        print(f"\ntwelve figures of a PDF: {many / 12:.2f} times as much each as one alone")
    assert many / 12 < MOST_OF_ONE


def fit_chart(seed: int) -> Chart:
    """Three panels over one frequency, each with four measured and four fitted curves: what a fit of a 2 x 2
    FRF shows.
    """
    rng = np.random.default_rng(seed)
    frequency = np.linspace(10.0, 100.0, LINES)
    panels = []
    for title in ("receptance", "phase", "residual"):
        values = 0.1 + np.abs(rng.normal(size=(CURVES, LINES)))
        both = [
            make(f"term {n}", frequency, row, n) for n, row in enumerate(values) for make in (curve, dots)
        ]
        panels.append(Panel(Axis("frequency", "Hz"), Axis(title, "um/N"), tuple(both)))
    return stack(panels, 6.0)
