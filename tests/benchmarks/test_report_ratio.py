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
MOST_OF_UNLIKE = 0.87


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
    """Twelve fits over twelve of slightly different heights, of which each is laid out and has its axes made.

    Measured 0.60 to 0.72, and 0.94 to 1.01 where nothing is shared.
    """

    def pdf(step: float) -> bytes:
        figures = [Figure(fit_chart(seed, 6.0 + step * seed), "a fit", "a fit") for seed in range(12)]
        return render_pdf(Document("T", "", (Section("S", tuple(figures)),)))

    (alike,) = ratios(lambda: pdf(0.01), lambda: pdf(0.0), repeats=7)
    with capsys.disabled():
        print(f"\ntwelve figures alike of a PDF: {alike:.2f} times twelve of different heights")
    assert alike < MOST_OF_UNLIKE


def fit_chart(seed: int, height: float = 6.0) -> Chart:
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
    return stack(panels, height)
