"""Trends: exact laws are found exactly, errors are propagated as a Monte Carlo shows, no trend is called
none.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.uncertainty.compare import trend
from labpipe.uncertainty.settings import CompareSettings

PRELOADS = (427.0, 701.0, 1422.0, 1721.0)
POWER = CompareSettings(kind="trend", fit="axial", over="preload", law="power", name="series")
LINE = CompareSettings(kind="trend", fit="axial", over="preload", name="series")


def a_series(values, error: float = 1e3, preloads=PRELOADS):
    return [
        (value, error, {"preload": f"{preload!r} N"}) for value, preload in zip(values, preloads, strict=True)
    ]


def test_a_power_law_is_found_exactly(campaign) -> None:
    found = trend(campaign(POWER, a_series([2e5 * p**0.7 for p in PRELOADS])))
    assert found.amount("exponent").value == pytest.approx(0.7, rel=1e-9)
    centre = np.exp(np.mean(np.log(PRELOADS)))
    assert found.amount("level").value == pytest.approx(2e5 * centre**0.7, rel=1e-9)
    assert (found.verdict, found.condition_unit) == ("rising", "N")
    x, y = np.array(found.line).T
    np.testing.assert_allclose(y, 2e5 * x**0.7, rtol=1e-9)
    assert (x[0], x[-1]) == (427.0, 1721.0)


def test_a_straight_line_is_found_exactly(campaign) -> None:
    found = trend(campaign(LINE, a_series([1e7 - 2e3 * p for p in PRELOADS])))
    assert found.amount("slope").value == pytest.approx(-2e3, rel=1e-9)
    assert found.amount("slope").unit == "N/m/N"
    assert found.amount("level").value == pytest.approx(1e7 - 2e3 * np.mean(PRELOADS), rel=1e-12)
    assert found.verdict == "falling"


def test_the_setting_s_error_widens_the_exponent_s(campaign, rng) -> None:
    """400 series whose preloads are off by 1 %: the stated error is the scatter, within 4 standard deviations
    of a scatter.
    """
    settings = CompareSettings(kind="trend", fit="axial", over="preload", law="power", setting_error=0.01)
    found, stated = [], []
    for _ in range(400):
        actual = np.array(PRELOADS) * (1 + 0.01 * rng.standard_normal(4))
        result = trend(campaign(settings, a_series(2e5 * actual**0.7 + 1e3 * rng.standard_normal(4))))
        found.append(result.amount("exponent").value)
        stated.append(result.amount("exponent").std_error)
    assert np.std(found) == pytest.approx(np.median(stated), rel=4 / np.sqrt(800))
    assert np.mean(found) == pytest.approx(0.7, abs=4 * np.std(found) / 20)


@pytest.mark.long
def test_noise_alone_is_no_trend_at_the_stated_level(campaign, rng) -> None:
    """300 series without a trend: 5 % are called one, within 3.5 binomial standard deviations of 7.2 %, the
    rate of the scatter's test.
    """
    verdicts = [
        trend(campaign(LINE, a_series(1e7 + 1e5 * rng.standard_normal(4), 1e5))).verdict for _ in range(300)
    ]
    assert verdicts.count("no trend") >= 300 * 0.928 - 3.5 * np.sqrt(300 * 0.072 * 0.928)


def test_a_bent_series_is_told_by_the_scatter(campaign) -> None:
    found = trend(campaign(POWER, a_series([2e5 * p**0.7 * (1.05 if p == 701 else 1) for p in PRELOADS])))
    assert found.amount("scatter_p").value < 1e-6
    assert "scatter more than their errors" in found.statement


def test_a_bent_series_is_curved_and_not_without_a_trend(campaign) -> None:
    """k rises by 1 % to both ends: the middle is 1 % below the chord, as numpy's parabola is."""
    speeds = np.linspace(1000.0, 6000.0, 6)
    noise = np.array([0.5, -1.0, 0.3, 0.8, -0.6, 0.1]) * 1e-4
    for law, x in ((LINE, speeds), (POWER, np.log(speeds))):
        place = 2 * (x - x[0]) / np.ptp(x) - 1
        values = 1e6 * (1 + 0.01 * place**2 + noise)
        bend = np.polyfit(place, np.log(values) if law is POWER else values / np.mean(values), 2)[0]
        found = trend(campaign(law, a_series(values, 1e2, speeds.tolist())))
        assert found.verdict == "curved"
        assert f"in the middle {100 * bend:.2g} % below the chord" in found.statement
        straight = trend(campaign(law, a_series(1e6 * (1 + noise), 1e2, speeds.tolist())))
        assert straight.verdict == "no trend" and "chord" not in straight.statement


def test_a_power_law_needs_positive_conditions_and_values(campaign) -> None:
    with pytest.raises(FitError, match="needs 'preload' above zero"):
        trend(campaign(POWER, a_series([1.0, 2.0, 3.0], 0.1, (0.0, 1.0, 2.0))))
    with pytest.raises(FitError, match="only positive"):
        trend(campaign(POWER, a_series([-1.0, 2.0, 3.0], 0.1, (1.0, 2.0, 3.0))))


def test_two_tests_have_a_trend_but_no_scatter(campaign) -> None:
    found = trend(campaign(POWER, a_series([1e7, 2e7], 1e4, (100.0, 200.0))))
    assert found.amount("exponent").value == pytest.approx(1.0, rel=1e-9)
    assert np.isnan(found.amount("scatter_p").value)


TWO = CompareSettings(kind="trend", fit="axial", over=("speed", "load"), name="two")
GRID = [(speed, load) for speed in (20.0, 40.0, 80.0) for load in (500.0, 1000.0)]


def a_grid(value, error: float = 1e3, noise=lambda: 0.0):
    """Tests at every speed and load, k by a function of both."""
    return [
        (value(speed, load) + error * noise(), error, {"speed": f"{speed} Hz", "load": f"{load} N"})
        for speed, load in GRID
    ]


def test_a_plane_over_two_conditions_is_found_exactly(campaign) -> None:
    found = trend(campaign(TWO, a_grid(lambda speed, load: 1e6 + 300 * speed - 20 * load)))
    assert found.amount("slope").value == pytest.approx(300.0, rel=1e-9)
    assert found.amount("second_slope").value == pytest.approx(-20.0, rel=1e-9)
    assert (found.amount("slope").unit, found.amount("second_slope").unit) == ("N/m/Hz", "N/m/N")
    assert (found.condition, found.second, found.second_unit) == ("speed", "load", "N")
    assert [(point.condition, point.second) for point in found.points] == GRID


def test_a_product_of_powers_is_found_exactly(campaign) -> None:
    settings = CompareSettings(kind="trend", fit="axial", over=("speed", "load"), law="power", name="two")
    found = trend(campaign(settings, a_grid(lambda speed, load: 3e4 * speed**0.4 * load**-0.2)))
    assert found.amount("exponent").value == pytest.approx(0.4, rel=1e-9)
    assert found.amount("second_exponent").value == pytest.approx(-0.2, rel=1e-9)


def test_slopes_over_two_conditions_scatter_as_stated(campaign, rng) -> None:
    """400 grids: scatter over stated error of both slopes within 4 standard deviations of a scatter."""
    found = [
        trend(
            campaign(
                TWO, a_grid(lambda speed, load: 1e6 + 300 * speed - 20 * load, noise=rng.standard_normal)
            )
        )
        for _ in range(400)
    ]
    for name, truth in (("slope", 300.0), ("second_slope", -20.0)):
        values = np.array([result.amount(name).value for result in found])
        stated = np.median([result.amount(name).std_error for result in found])
        assert np.std(values) == pytest.approx(stated, rel=4 / np.sqrt(800))
        assert np.mean(values) == pytest.approx(truth, abs=4 * np.std(values) / 20)


def test_a_surface_that_is_no_plane_is_curved(campaign) -> None:
    """k rises by 10 % with either condition only where the other is high: products reach 10 % off the plane
    at the corners. A plane with the same noise is none.
    """
    grid = [(speed, load) for speed in (20.0, 40.0, 60.0) for load in (500.0, 1000.0, 1500.0)]
    noise = np.array([0.5, -1.0, 0.3, 0.8, -0.6, 0.1, -0.4, 0.9, -0.7]) * 1e-3
    a, b = (np.array(grid) / (20.0, 500.0) - 2).T
    for product, verdict in ((0.1, "curved"), (0.0, "no trend")):
        series = [
            (1e6 * (1 + product * first * second + off), 1e3, {"speed": f"{speed} Hz", "load": f"{load} N"})
            for (speed, load), first, second, off in zip(grid, a, b, noise, strict=True)
        ]
        found = trend(campaign(TWO, series))
        assert found.verdict == verdict
        assert ("by up to 10 % off a plane" in found.statement) == (product > 0)
