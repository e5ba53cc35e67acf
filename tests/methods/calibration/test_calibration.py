"""Straight lines. Oracle: scipy.stats.linregress, and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import FitError
from labpipe.methods.calibration.section import fit_line, line_fit, linear_range, linear_range_of_curve


def test_equals_linregress(rng: np.random.Generator) -> None:
    x = rng.uniform(0, 5, 30)
    y = 2.5 * x - 1 + 0.1 * rng.normal(size=30)
    line, oracle = fit_line(x, y), stats.linregress(x, y)
    assert line.values == pytest.approx([oracle.slope, oracle.intercept])
    assert np.sqrt(np.diag(line.covariance)) == pytest.approx([oracle.stderr, oracle.intercept_stderr])
    assert line.r2 == pytest.approx(oracle.rvalue**2)


def test_through_the_origin_closed_form(rng: np.random.Generator) -> None:
    x, y = np.array([1.0, 2.0, 3.0]), np.array([2.1, 3.9, 6.0])
    line = fit_line(x, y, through_origin=True)
    slope = x @ y / (x @ x)
    assert line.slope == pytest.approx(slope)
    assert line.covariance[0, 0] == pytest.approx(np.sum((y - slope * x) ** 2) / 2 / (x @ x))
    assert line.r2 == pytest.approx(1 - np.sum((y - slope * x) ** 2) / (y @ y))


@pytest.mark.parametrize("scale", [1e-9, 1e6])
def test_units_do_not_matter(rng: np.random.Generator, scale: float) -> None:
    x = rng.uniform(0, 5, 30)
    y = 2.5 * x + rng.normal(size=30)
    assert fit_line(x * scale, y).slope * scale == pytest.approx(fit_line(x, y).slope)


def test_linear_range_over_positions() -> None:
    # Gains of the virtual actuator, 1 / (1 + (e / 0.4)^4): within 20 % up to 20 % eccentricity.
    e = np.array([0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5])
    assert linear_range(e, 5.8 / (1 + (e / 0.4) ** 4), 0.20) == 0.2
    assert linear_range(e, np.full(7, 5.8), 0.01) == 0.5
    # On the one side of the centre only the slope holds at 0.3.
    both = np.array([-0.3, -0.1, 0.0, 0.1, 0.3])
    assert linear_range(both, np.array([1.0, 1.0, 1.0, 1.0, 3.0]), 0.2) == 0.1
    # Nothing is within a share of a slope of zero but another zero.
    assert linear_range(e + 0.1, np.array([0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0]), 0.2) == pytest.approx(0.2)


def test_linear_range_of_a_curve_that_bends() -> None:
    # Straight to 5, slope 2 beyond: the local slope over a third of the points leaves 20 % soon after 5.
    x = np.linspace(0, 10, 101)
    y = np.where(x < 5, x, 5 + 2 * (x - 5))
    assert 5.0 < linear_range_of_curve(x, y, 0.2) < 7.0
    assert linear_range_of_curve(x, x, 0.01) == pytest.approx(10.0)


def test_the_linear_range_of_values_that_were_set_several_times() -> None:
    """Three readings of each: a line through those of one value alone would have no slope."""
    x = np.repeat([0.0, 1.0, 2.0, 3.0, 4.0], 3)
    assert linear_range_of_curve(x[:9], 2 * x[:9], 0.1) == pytest.approx(2.0)
    assert linear_range_of_curve(x, np.where(x <= 2, x, 3 * x - 4), 0.1) == pytest.approx(2.0)


def test_a_bend_is_found_and_a_straight_line_is_not(rng: np.random.Generator) -> None:
    x = np.linspace(0, 1, 40)
    straight, bent = x + 0.01 * rng.normal(size=40), x + 0.2 * x**2 + 0.01 * rng.normal(size=40)
    for y, codes in ((straight, []), (bent, ["model-mismatch"])):
        fit = line_fit("gain", "", fit_line(x, y), ("N/V", "N"), x, y)
        assert [finding.code for finding in fit.findings] == codes


def test_a_line_forced_through_zero_says_where_the_points_miss_it() -> None:
    """Points on y = 2 x + 1 but for .01: 8 % of their range off the line through zero, by scipy's F of two
    nested models; and two values, each set three times, tell no bend, but a slope as linregress has it.
    """
    x = np.arange(7.0)
    y = 2 * x + 1 + 0.01 * (-1) ** x
    fit = line_fit("gain", "", fit_line(x, y, through_origin=True), ("N/V", "N"), x, y)
    (finding,) = fit.findings
    left, least = (
        float(np.sum((y - c @ np.linalg.lstsq(c, y)[0]) ** 2)) for c in (x[:, None], np.vander(x, 3))
    )
    p_value = stats.f.sf((left / least - 1) * 4 / 2, 2, 4)
    assert f"p = {p_value:.2g} for a straight line through zero" in finding.message
    through = 2 * x + 0.01 * (-1) ** x
    assert not line_fit("g", "", fit_line(x, through, through_origin=True), ("1", "1"), x, through).findings
    x = np.repeat([0.0, 1.0], 3)
    y = np.array([0.1, -0.1, 0.0, 2.1, 1.9, 2.2])
    fit = line_fit("gain", "", fit_line(x, y), ("N/V", "N"), x, y)
    assert fit.parameter("slope").value == pytest.approx(stats.linregress(x, y).slope)
    assert not fit.findings


def test_what_makes_no_line() -> None:
    with pytest.raises(FitError, match="2 points cannot determine"):
        fit_line(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    with pytest.raises(FitError, match="same x"):
        fit_line(np.ones(5), np.arange(5.0))
    with pytest.raises(FitError, match="3 points do not show where a line ends"):
        linear_range_of_curve(np.arange(3.0), np.array([0.0, 1.0, 5.0]), 0.1)
