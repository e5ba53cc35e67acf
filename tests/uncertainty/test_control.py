"""Control limits against hand calculation, differences and trends against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import FitError
from labpipe.uncertainty.weighted import (
    are_separable,
    control_limits,
    from_the_rest,
    straight_columns,
    straight_trend,
)


def test_limits_of_an_individuals_chart_by_hand() -> None:
    # Moving ranges 2, 1, 3, 2: mean 2; 2.66 * 2 = 5.32 either side (Montgomery: 3 / d_2 = 2.66), where 5 %
    # among all values are .27 % of each.
    limits = control_limits(np.array([10.0, 12.0, 11.0, 14.0, 12.0]), 0.025 / stats.norm.sf(3.0))
    assert limits.centre == pytest.approx(11.8)
    assert limits.high - limits.centre == pytest.approx(5.32, abs=0.005)
    assert limits.centre - limits.low == pytest.approx(limits.high - limits.centre)
    assert limits.outside == ()


def test_a_single_jump_lies_outside_and_is_named_by_its_place() -> None:
    values = np.array([10.0, 10.1, 9.9, 10.0, 10.1, 10.0, 9.9, 10.0, 10.1, 15.0])
    assert control_limits(values, 10).outside == (9,)


@pytest.mark.long
@pytest.mark.parametrize("n", [8, 20, 60])
def test_one_sound_report_in_twenty_has_a_value_outside(rng: np.random.Generator, n: int) -> None:
    """Reports of six charts of n independent normal values, 2000 draws: 5 % -+ 1.5 (three binomial errors)
    have one beyond; with 3 sigma it would be 9, 26 and 58 %.
    """
    alarms = [any(control_limits(y, 6 * n).outside for y in rng.normal(size=(6, n))) for _ in range(2000)]
    assert 0.035 < np.mean(alarms) < 0.07


def test_two_values_differ_by_the_closed_form() -> None:
    # z = 3 / sqrt(1 + 1): two-sided p = 0.0339 (normal tables).
    difference, p_value = from_the_rest(np.array([10.0, 13.0]), np.array([1.0, 1.0]))
    assert difference == pytest.approx([-3.0, 3.0])
    assert p_value == pytest.approx([0.0339, 0.0339], abs=1e-4)


@pytest.mark.long
def test_p_values_of_alike_tests_are_uniform(rng: np.random.Generator) -> None:
    chances = np.concatenate([from_the_rest(rng.normal(5.0, 0.1, 6), np.full(6, 0.1))[1] for _ in range(400)])
    # Slightly too few small ones are expected: the errors of the others are enlarged where they scatter more
    # than stated.
    assert 0.02 < np.mean(chances < 0.05) < 0.06


@pytest.mark.parametrize("common", [False, True])
def test_scatter_beyond_the_errors_is_no_crowd_of_outliers(rng: np.random.Generator, common: bool) -> None:
    """20 alike tests that scatter by ten of their errors: 5 % are apart at a level of 5 %, not 64 %."""
    errors = np.eye(20) + 0.25 * common
    chances = np.concatenate(
        [from_the_rest(rng.normal(5.0, 10.0, 20), errors if common else np.ones(20))[1] for _ in range(20)]
    )
    assert 0.02 < np.mean(chances < 0.05) < 0.1
    far = from_the_rest(np.array([1.0, -2.0, 0.0, 2.0, -1.0, 20.0]), np.full(6, 0.1))[1]
    # Student's t of 4 degrees of freedom: 20 over 1.58 sqrt(1 + 1/5).
    assert far[5] == pytest.approx(2 * stats.t.sf(20 / np.sqrt(2.5 * 1.2), 4))


def test_a_trend_without_scatter_is_found_exactly() -> None:
    condition = np.array([1.0, 2.0, 4.0])
    found = straight_trend(condition, 3.0 + 0.5 * condition, np.array([0.1, 0.2, 0.1]))
    assert found.values[1] == pytest.approx(0.5)
    # Slope variance 1 / sum w (x - weighted mean)^2, w = 100, 25, 100: mean 22/9, sum 455.556.
    assert found.std_error(1) == pytest.approx(1 / np.sqrt(455.5556), rel=1e-6)


def test_too_few_values_are_refused() -> None:
    for refused in (lambda: control_limits(np.ones(2), 2), lambda: from_the_rest(np.ones(1), np.ones(1))):
        with pytest.raises(FitError):
            refused()
    with pytest.raises(FitError):
        straight_trend(np.arange(2.0), np.ones(2), np.ones(2))


def test_an_outlier_beside_a_trend_is_held_against_the_trend_of_the_others() -> None:
    """y = 3 + 2 x with errors of 0.1: of 400 draws 5 % of p-values lie below 5 % (binomial +- 1.1 %, three of
    them, of 6 x 400 that hang together); exact values but one off by 1: its difference is 1, by all others.
    """
    rng, x = np.random.default_rng(8), np.arange(6.0)
    columns, y = straight_columns(x), 3 + 2 * x
    draws = [
        from_the_rest(y + rng.normal(0, 0.1, 6), np.full(6, 0.1), columns=columns)[1] for _ in range(400)
    ]
    assert abs(np.mean(np.concatenate(draws) < 0.05) - 0.05) < 0.033
    difference, chances = from_the_rest(y + (x == 3), np.full(6, 0.1), columns=columns)
    assert difference[3] == pytest.approx(1.0) and np.argmin(chances) == 3 and chances[3] < 1e-15


def test_conditions_are_told_apart_by_their_variance_inflation() -> None:
    """1 / (1 - r^2) of two conditions: 5 at r = .894."""
    x, other = np.arange(8.0) - 3.5, np.array([1.0, -1, -1, 1, 1, -1, -1, 1])
    other -= x * (x @ other) / (x @ x)
    other *= np.linalg.norm(x) / np.linalg.norm(other)
    for r, told in ((0.0, True), (0.89, True), (0.9, False), (1.0, False)):
        assert are_separable(np.array([x, r * x + np.sqrt(1 - r**2) * other])) == told
    assert not are_separable(np.array([[0.0, 1, 2, 3], [1.0, 0, 0, 1]]))
    assert not are_separable(np.array([x, np.ones(8)])) and not are_separable(np.ones((1, 1)))
