"""What the figures of a report cost: on a page the numbers alone, beside a drawing by matplotlib."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.document.charts import canvas_of, svg_text
from labpipe.document.html_page import render_html
from labpipe.report.chart import Axis, Panel, curve, dots, stack
from labpipe.report.document import Document, Figure, Section
from tests.benchmarks.test_spectral_ratios import ratios

LINES, CURVES = 400, 4


def test_a_figure_of_a_page_costs_a_fraction_of_its_drawing_for_print(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Three panels over one frequency, each with four measured and four fitted curves: what a fit of a 2 x 2
    FRF shows.
    """
    rng = np.random.default_rng(1)
    frequency = np.linspace(10.0, 100.0, LINES)
    panels = []
    for title in ("receptance", "phase", "residual"):
        values = 0.1 + np.abs(rng.normal(size=(CURVES, LINES)))
        both = [
            make(f"term {n}", frequency, row, n) for n, row in enumerate(values) for make in (curve, dots)
        ]
        panels.append(Panel(Axis("frequency", "Hz"), Axis(title, "um/N"), tuple(both)))
    chart = stack(panels, 6.0)
    document = Document("T", "", (Section("S", (Figure(chart, "a fit", "a fit"),)),))
    (matplotlib,) = ratios(lambda: render_html(document), lambda: svg_text(canvas_of(chart)))
    with capsys.disabled():
        print(f"\na figure of {3 * 2 * CURVES} curves by matplotlib: {matplotlib:.1f} times its page")
    assert matplotlib > 4
