"""Variance components: a hand calculation, scipy's F test, recovery and coverage in simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import FitError
from labpipe.uncertainty.compare import repeatability
from labpipe.uncertainty.settings import CompareSettings
from labpipe.uncertainty.weighted import components

SETTINGS = CompareSettings(kind="repeatability", fit="axial", group="mounting", name="repeats")


def test_a_small_table_by_hand() -> None:
    """Groups (1, 3), (5, 7), (9, 11): MSW = 2, MSB = 2 x 16 = 32, between^2 = (32 - 2) / 2 = 15, mean 6."""
    values, groups = np.array([1.0, 3, 5, 7, 9, 11]), np.repeat(["a", "b", "c"], 2)
    found = components(values, groups)
    assert found.mean == pytest.approx(6.0)
    assert found.within == pytest.approx(np.sqrt(2.0))
    assert found.between == pytest.approx(np.sqrt(15.0))
    assert found.mean_error == pytest.approx(np.sqrt(32 / 6))
    assert found.p_value == pytest.approx(stats.f_oneway([1, 3], [5, 7], [9, 11]).pvalue, rel=1e-9)
    assert found.within_ci == pytest.approx(np.sqrt(6 / stats.chi2.ppf([0.975, 0.025], 3)), rel=1e-12)


def test_unequal_groups_use_their_effective_size() -> None:
    """n_0 = (N - sum n_i^2 / N) / (a - 1), Searle et al. (1992), eq. 3.6: here (5 - 13 / 5) / 1 = 2.4."""
    values, groups = np.array([1.0, 3.0, 5.0, 6.0, 10.0]), np.array(["a", "a", "b", "b", "b"])
    found = components(values, groups)
    within = (2 + 14) / 3
    between = 2 * (2 - 5) ** 2 + 3 * (7 - 5) ** 2
    assert found.within == pytest.approx(np.sqrt(within))
    assert found.between == pytest.approx(np.sqrt((between - within) / 2.4))


def test_the_mean_counts_every_setting_once() -> None:
    """Means 2 and 5 of three tests and of one: 3.5 +- |5 - 2| / 2, the standard deviation 3 / sqrt 2 over
    sqrt 2. All four tests count with 1/6, 1/6, 1/6 and 1/2.
    """
    found = components(np.array([1.0, 2.0, 3.0, 5.0]), np.array(["a", "a", "a", "b"]))
    assert (found.mean, found.mean_error) == pytest.approx((3.5, 1.5))
    assert found.weights == pytest.approx([1 / 6, 1 / 6, 1 / 6, 1 / 2])


def test_settings_that_scatter_less_than_their_repeats_have_no_part_of_their_own() -> None:
    found = components(np.array([1.0, 3.0, 1.1, 3.1]), np.array(["a", "a", "b", "b"]))
    assert found.between == 0.0
    assert found.between_ci[0] == 0.0


@pytest.mark.parametrize("between", [0.5, 2.0])
def test_components_are_recovered_and_intervals_cover(rng, between: float) -> None:
    """600 tables of 6 x 3 with within = 1: variances unbiased within 4 standard errors, intervals hold the
    truth in 93.5 % or more.
    """
    groups = np.repeat(np.arange(6).astype(str), 3)
    squares, hits = [], np.zeros(2)
    for _ in range(600):
        values = np.repeat(between * rng.standard_normal(6), 3) + rng.standard_normal(18)
        found = components(values, groups)
        mean_squares = np.array([found.within**2, found.mean_error**2 * 18])
        squares.append([mean_squares[0], (mean_squares[1] - mean_squares[0]) / 3])
        for number, (interval, truth) in enumerate(((found.within_ci, 1.0), (found.between_ci, between))):
            hits[number] += interval[0] <= truth <= interval[1]
    mean, error = np.mean(squares, axis=0), np.std(squares, axis=0) / np.sqrt(600)
    assert np.all(np.abs(mean - [1.0, between**2]) < 4 * error)
    assert np.all(hits / 600 >= 0.935)


def mounted(rng, between: float, noise: float = 1e3):
    return [
        (1e7 + offset + noise * rng.standard_normal(), noise, {"mounting": str(number)})
        for number, offset in enumerate(between * rng.standard_normal(5))
        for _ in range(3)
    ]


def test_repeatability_tells_settings_from_noise(campaign, rng) -> None:
    differing = repeatability(campaign(SETTINGS, mounted(rng, 1e5)))
    assert differing.verdict == "settings differ"
    low, high = differing.amount("between").ci95
    assert low < 1e5 < high
    assert differing.amount("noise").value == pytest.approx(1e3)
    alike = repeatability(campaign(SETTINGS, mounted(rng, 0.0)))
    assert alike.verdict == "settings alike"
    assert "agrees with the fits' standard errors" in alike.statement


def test_repeats_that_scatter_more_than_their_errors_are_told(campaign, rng) -> None:
    given = [(value, error / 10, conditions) for value, error, conditions in mounted(rng, 0.0)]
    found = repeatability(campaign(SETTINGS, given))
    assert found.amount("noise_p").value < 1e-6
    assert "exceeds the fits' standard errors" in found.statement


def test_settings_with_one_mean_leave_no_scatter_of_it(campaign) -> None:
    """Both settings have the values 1 and 3: MSB is zero, so is the mean's error where no sensor is
    uncertain.
    """
    tests = [(value, 1.0, {"mounting": name}) for name in "ab" for value in (1.0, 3.0)]
    assert repeatability(campaign(SETTINGS, tests)).amount("mean").std_error == 0.0


def test_too_few_tests_are_refused() -> None:
    with pytest.raises(FitError, match=r"3 test\(s\) in 3 setting\(s\)"):
        components(np.arange(3.0), np.array(["a", "b", "c"]))
    with pytest.raises(FitError, match="1 setting"):
        components(np.arange(3.0), np.array(["a", "a", "a"]))
    with pytest.raises(FitError, match="do not scatter"):
        components(np.array([1.0, 1.0, 2.0, 2.0]), np.array(["a", "a", "b", "b"]))
