"""Figures over frequency of a control loop: where the zones of a standard end, bands beside their prediction,
and bands that differ.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.records.comparison import ComparedBand, Comparison, QuantityCurve
from labpipe.records.finding import Parameter
from labpipe.report import loop_figures
from labpipe.report.chart import Chart, Panel
from labpipe.report.document import Figure
from tests.report.test_comparison_figures import BASE, named

LINES = (10.0, 20.0, 40.0)


def band(low: float, test: str, value: float, p_value: float, name: str = "k") -> ComparedBand:
    """From *low* on 10 Hz wide, 2 kN/m expected, 10 % known."""
    ends, ratio = (0.9 * value, 1.1 * value), value / 2000.0
    beside = {"ratio": ratio, "ratio_ci95": (0.9 * ratio, 1.1 * ratio), "p_value": p_value}
    return ComparedBand(
        test, name, "N/m", band_hz=(low, low + 10), value=value, ci95=ends, other=2e3, **beside
    )  # type: ignore[arg-type]


def comparison(**entries: object) -> Comparison:
    named_amounts = (("different", 2.0), ("peak", 3.5), ("peak_frequency", 20.0))
    amounts = tuple(Parameter(name, value, "1") for name, value in named_amounts)
    return replace(BASE, points=(), line=(), amounts=amounts, subject="k, fit a", **entries)  # type: ignore[arg-type]


def panels(figure: Figure) -> tuple[Panel, ...]:
    assert isinstance(figure.graphic, Chart)
    return figure.graphic.panels


def test_the_circle_is_where_a_loop_is_as_sensitive_as_zone_a_allows() -> None:
    """S = 1 / (1 + L): 3 on the whole circle around -1, and the zones of ISO 14839-3 end at 3, 4 and 5."""
    loop = np.array([-0.5 + 0.5j, -1.0 + 0.25j, -2.0 - 1.0j])
    size = 1 / np.abs(1 + loop)
    parts = (
        QuantityCurve("a", "|S| x", "1", frequency=LINES, measured=tuple(size), low=tuple(0.9 * size),
              high=tuple(1.1 * size), matched=tuple(1.01 * size)),
        QuantityCurve("a", "L x real", "1", frequency=LINES, measured=tuple(loop.real)),
        QuantityCurve("a", "L x imaginary", "1", frequency=LINES, measured=tuple(loop.imag)),
    )  # fmt: skip
    sizes, nyquist = loop_figures.certificate_figures(comparison(curves=parts))
    (plane,) = panels(nyquist)
    circle, seen = named(plane)["|S| = 3, end of zone A"], named(plane)["L x"]
    np.testing.assert_allclose(1 / np.abs(1 + np.array(circle.x) + 1j * np.array(circle.y)), 3.0)
    np.testing.assert_allclose(np.array(seen.x) + 1j * np.array(seen.y), loop)
    assert (named(plane)["-1"].x[0], named(plane)["-1"].y[0]) == (-1, 0)
    (panel,) = panels(sizes)
    for zone, limit in (("A", 3), ("B", 4), ("C", 5)):
        assert named(panel)[f"zone {zone} ends"].y[0] == limit
    measured = named(panel)["|S| x"]
    np.testing.assert_allclose((measured.y, measured.low, measured.high), np.outer((1, 0.9, 1.1), size))
    np.testing.assert_allclose(named(panel)["fitted loop"].y, 1.01 * size)
    (only,) = loop_figures.sensitivity_figures(comparison(curves=parts[:1]))
    peak = named(panels(only)[0])["peak"]
    assert (peak.x[0], peak.y[0]) == (20.0, 3.5)
    assert loop_figures.certificate_figures(comparison()) == []


def test_bands_stand_beside_their_prediction_in_the_units_of_people() -> None:
    """Two tests lie an eighth of the distance of bands off their centres, to either side."""
    bands = tuple(
        band(low, test, value, 0.5) for test, value in (("a", 2100.0), ("b", 2200.0)) for low in (0.0, 20.0)
    )
    loop = QuantityCurve(
        "a", "k", "N/m", frequency=LINES, theory=(1000.0, 2000.0, 3000.0), matched=(1e3, 2e3, 4e3)
    )
    (figure,) = loop_figures.prediction_figures(comparison(bands=bands, curves=(loop,)))
    coefficient, ratio = panels(figure)
    assert coefficient.y.label == "k [kN/m]" and "fitted unknowns" in figure.caption
    first, second = (named(coefficient)[f"{test} measured"] for test in "ab")
    np.testing.assert_allclose(first.x, [2.5, 22.5])
    np.testing.assert_allclose(second.x, [7.5, 27.5])
    np.testing.assert_allclose((second.y, second.low, second.high), np.outer((2.2, 1.98, 2.42), [1, 1]))
    np.testing.assert_allclose(named(coefficient)["a predicted"].y, [2.0, 2.0])
    np.testing.assert_allclose(named(coefficient)["a loop"].y, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(named(coefficient)["a with the fitted unknowns"].y, [1.0, 2.0, 4.0])
    beside = named(ratio)["b measured"]
    np.testing.assert_allclose((beside.y, beside.low, beside.high), np.outer((1.1, 0.99, 1.21), [1, 1]))
    assert ratio.y.low + ratio.y.high == pytest.approx(2.0) and ratio.y.high > 1.21
    assert coefficient.y.low < 2.0 < 2.2 < coefficient.y.high < 2.4


def test_as_many_bands_differ_as_were_counted() -> None:
    """The two of least p of all coefficients together."""
    bands = (
        band(0.0, "b", 2100.0, 0.4), band(20.0, "b", 2800.0, 0.001), band(40.0, "b", 2200.0, 0.1),
        band(0.0, "b", 2600.0, 0.01, "c"), band(20.0, "b", 2000.0, 1.0, "c"),
    )  # fmt: skip
    (figure,) = loop_figures.band_figures(comparison(bands=bands))
    stiffness, damping = panels(figure)
    np.testing.assert_allclose(named(stiffness)["different"].x, [25.0])
    np.testing.assert_allclose(named(stiffness)["different"].y, [1.4])
    np.testing.assert_allclose(named(stiffness)["alike"].x, [5.0, 45.0])
    np.testing.assert_allclose(named(damping)["different"].y, [1.3])
    np.testing.assert_allclose(named(damping)["alike"].y, [1.0])
    # All ratios lie on the axis, but for the widest tenth of the intervals.
    assert stiffness.y.low + stiffness.y.high == pytest.approx(2.0) and stiffness.y.high > 1.4
