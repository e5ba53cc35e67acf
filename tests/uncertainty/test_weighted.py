"""Weighted means and lines: against closed forms and scipy, and the enlargement by scatter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

from labpipe.errors import FitError
from labpipe.uncertainty.weighted import weighted_fit, weighted_mean


def test_a_weighted_mean_is_the_textbook_s() -> None:
    """sum(v / s^2) / sum(1 / s^2) with error sum(1 / s^2)^(-1/2)."""
    found = weighted_mean(np.array([10.0, 10.2]), np.array([0.1, 0.2]))
    assert found.values[0] == pytest.approx((10 / 0.01 + 10.2 / 0.04) / 125, rel=1e-12)
    assert found.std_error(0) == pytest.approx(125**-0.5, rel=1e-12)
    assert found.chi2 == pytest.approx(0.2**2 / 0.05, rel=1e-9)
    assert found.p_value == pytest.approx(stats.chi2.sf(0.8, 1), rel=1e-9)
    assert not found.inflated
    assert found.quantile(0) == pytest.approx(1.959964, abs=1e-6)


def test_a_weighted_line_is_scipy_s(rng) -> None:
    x, s = np.array([1.0, 2, 3, 5, 8]), np.array([0.1, 0.2, 0.1, 0.3, 0.2])
    y = 2 + 0.5 * x + s * rng.standard_normal(5)
    found = weighted_fit(np.column_stack([np.ones(5), x]), y, s)
    values, covariance = optimize.curve_fit(lambda t, a, b: a + b * t, x, y, sigma=s, absolute_sigma=True)
    np.testing.assert_allclose(found.values, values, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5)


def test_errors_that_values_share_do_not_average_out() -> None:
    """Equal own errors s and a shared one b: the mean has s^2 / n + b^2, and the shared part makes no
    scatter.
    """
    values = np.array([1.0, 1.1, 1.2])
    found = weighted_mean(values, 0.01 * np.eye(3) + 0.04)
    assert found.values[0] == pytest.approx(1.1)
    assert found.std_error(0) == pytest.approx(np.sqrt(0.01 / 3 + 0.04), rel=1e-12)
    assert found.chi2 == pytest.approx(weighted_mean(values, np.full(3, 0.1)).chi2, rel=1e-9)


def test_scatter_beyond_equal_errors_is_theirs() -> None:
    values = np.array([1.0, 2.0, 4.0])
    found = weighted_mean(values, np.full(3, 0.01))
    assert found.inflated
    assert found.std_error(0) == pytest.approx(np.std(values, ddof=1) / np.sqrt(3), rel=1e-12)
    assert found.quantile(0) == pytest.approx(stats.t.ppf(0.975, 2), rel=1e-12)
    assert found.p_of(0, 2.0) == pytest.approx(stats.ttest_1samp(values, 2.0).pvalue, rel=1e-9)


def test_scatter_beyond_unequal_errors_is_added_to_each() -> None:
    """Of two d apart chi-square is 1 for tau^2 = (d^2 - s_1^2 - s_2^2) / 2: the precise one hardly leads."""
    values, errors, square = np.array([1.0, 4.0]), np.array([0.1, 1.0]), (9 - 0.01 - 1) / 2
    found, weights = weighted_mean(values, errors), 1 / (errors**2 + square)
    assert found.spread == pytest.approx(square, rel=1e-9)
    assert found.values[0] == pytest.approx(weights @ values / weights.sum(), rel=1e-9)
    assert found.std_error(0) == pytest.approx(weights.sum() ** -0.5, rel=1e-9)
    assert weighted_mean(values, np.diag(errors**2)).values == pytest.approx(found.values, rel=1e-9)


def test_scatter_does_not_enlarge_what_values_have_in_common() -> None:
    """GUM: of values with the error b in common the mean has s^2 / n + b^2, s their own scatter, and Welch
    and Satterthwaite's degrees of freedom. A contrast has no b, nor has a slope.
    """
    values = np.array([1.0, 2.0, 4.0])
    found = weighted_mean(values, np.full(3, 0.01), np.full((1, 3), 5.0))
    own = np.var(values, ddof=1) / 3
    assert found.values[0] == pytest.approx(7 / 3)
    assert found.std_error(0) == pytest.approx(np.sqrt(own + 25), rel=1e-9)
    assert found.quantile(0) == pytest.approx(stats.t.ppf(0.975, 2 * ((own + 25) / own) ** 2), rel=1e-9)
    columns = np.column_stack([np.ones(3), [-1.0, 0.0, 1.0]])
    line = weighted_fit(columns, values, np.full(3, 0.01), np.full((1, 3), 5.0))
    alone = weighted_fit(columns, values, np.full(3, 0.01))
    assert line.std_error(1) == pytest.approx(alone.std_error(1), rel=1e-9)
    assert line.reach(np.array([0.0, 1.0])) == pytest.approx(alone.amount("a", "", 1).ci95[1] - 1.5, rel=1e-6)


def test_one_value_has_its_own_error_and_no_scatter() -> None:
    found = weighted_mean(np.array([3.0]), np.array([0.5]))
    assert (found.values[0], found.std_error(0), found.p_value, found.inflated) == (3.0, 0.5, None, False)
    assert found.p_of(0) == pytest.approx(2 * stats.norm.sf(6.0), rel=1e-9)


# Share of intervals that hold by an independent calculation (tau^2 by bisection, Student's t, 12,000
# draws each): of the first n errors below, tests scattering by tau beyond them. Enlarged only where p is
# below .05: .875, .767, .772 and .880, .828, .900 of the middle three.
HOLD = {
    (3, 0.0): 0.969, (3, 0.1): 0.926, (3, 0.2): 0.887, (3, 0.4): 0.900, (3, 1.0): 0.943,
    (5, 0.0): 0.969, (5, 0.1): 0.941, (5, 0.2): 0.925, (5, 0.4): 0.941, (5, 1.0): 0.949,
}  # fmt: skip


@pytest.mark.parametrize(
    ("n", "beyond"),
    [case if case == (3, 0.2) else pytest.param(*case, marks=pytest.mark.long) for case in HOLD],
)
def test_intervals_cover_at_the_stated_rate(rng, n: int, beyond: float) -> None:
    """2000 means of few values with known errors, within 3 standard deviations of the difference."""
    errors = np.array([0.1, 0.2, 0.3, 0.1, 0.2])[:n]
    hits = 0
    for _ in range(2000):
        found = weighted_mean(np.hypot(errors, beyond) * rng.standard_normal(n), errors)
        hits += abs(found.values[0]) <= found.quantile(0) * found.std_error(0)
    share = HOLD[n, beyond]
    assert hits / 2000 == pytest.approx(share, abs=3 * np.sqrt(share * (1 - share) * (1 / 2000 + 1 / 12000)))


def test_two_values_no_further_apart_than_by_chance_leave_their_errors_known() -> None:
    """Of two with the error s each, d apart, tau^2 = d^2 / 2 - s^2 and v = d^2 / 4; Welch and Satterthwaite
    of s^2 / 2 known and tau^2 / 2 of one degree of freedom: (d^2 / 4)^2 / (tau^2 / 2)^2. Beyond p = .05 one.
    """
    found = weighted_mean(np.array([1.0, 1.2]), np.full(2, 0.1))
    assert not found.inflated and found.std_error(0) == pytest.approx(0.1, rel=1e-9)
    assert found.quantile(0) == pytest.approx(stats.t.ppf(0.975, (0.01 / 0.005) ** 2), rel=1e-6)
    apart = weighted_mean(np.array([1.0, 1.3]), np.full(2, 0.1))
    assert apart.inflated and apart.quantile(0) == pytest.approx(stats.t.ppf(0.975, 1), rel=1e-9)


def test_what_cannot_be_weighed_is_refused() -> None:
    with pytest.raises(FitError, match="cannot determine 2 parameters"):
        weighted_fit(np.ones((1, 2)), np.ones(1), np.ones(1))
    with pytest.raises(FitError, match="has no standard error"):
        weighted_mean(np.ones(2), np.array([0.0, 1.0]))
    with pytest.raises(FitError, match="do not differ"):
        weighted_fit(np.ones((3, 2)), np.ones(3), np.ones(3))
