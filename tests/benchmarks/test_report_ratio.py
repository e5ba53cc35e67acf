"""What the figures of a report cost beside writing their numbers as JSON, which a page needs in any case, and beside matplotlib."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.document.figure_numbers import figure_json
from labpipe.document.saving import canvas_of, svg_text
from labpipe.document.svg_chart import chart_svg
from labpipe.report.chart import Axis, Panel, curve, dots, stacked
from tests.benchmarks.test_spectral_ratios import ratios

LINES, CURVES = 400, 4


def test_drawing_a_fit_costs_no_more_than_writing_its_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    """Three panels over one frequency, each with four measured and four fitted curves: what a fit of a 2 x 2 FRF shows."""
    rng = np.random.default_rng(1)
    frequency = np.linspace(10.0, 100.0, LINES)
    panels = []
    for title in ("receptance", "phase", "residual"):
        values = 0.1 + np.abs(rng.normal(size=(CURVES, LINES)))
        both = [make(f"term {n}", frequency, row, n) for n, row in enumerate(values) for make in (curve, dots)]
        panels.append(Panel(Axis("frequency", "Hz"), Axis(title, "um/N"), tuple(both)))
    chart = stacked(panels, 6.0)
    own, matplotlib = ratios(lambda: figure_json(chart), lambda: chart_svg(chart, "f", "a fit"), lambda: svg_text(canvas_of(chart)))
    with capsys.disabled():
        print(f"\na figure of {3 * 2 * CURVES} curves: {own:.2f} times its numbers as JSON; by matplotlib {matplotlib:.1f} times")
    assert own < 1.5
    assert matplotlib > 4 * own
