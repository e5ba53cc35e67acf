"""Results of comparisons: intervals, and whether they differ from nothing."""

from __future__ import annotations

import math

import pytest

from labpipe.uncertainty.amounts import chance, from_log, relative_change, with_error


@pytest.mark.parametrize(("value", "significant"), [(4.1, True), (3.9, False), (-4.1, True)])
def test_value_and_error(value: float, significant: bool) -> None:
    found = with_error("k", "N/m", value, 2.0, 2.0)
    assert (found.std_error, found.t_ratio, found.ci95) == (
        2.0,
        value / 2,
        (value - 4, value + 4),
    ) and found.significant is significant


def test_a_logarithm_has_an_interval_wider_upwards() -> None:
    found = from_log("ratio", "1", math.log(2), 0.1, 2.0)
    assert found.value == pytest.approx(2) and found.std_error == pytest.approx(0.2)
    assert found.ci95 == pytest.approx((2 * math.exp(-0.2), 2 * math.exp(0.2)))


@pytest.mark.parametrize(("log", "significant"), [(0.21, True), (0.19, False), (-0.21, True), (0.0, False)])
def test_a_relative_change_is_told_from_none(log: float, significant: bool) -> None:
    found = relative_change("change", log, 0.1, 2.0)
    assert found.value == pytest.approx(math.exp(log) - 1) and found.std_error == pytest.approx(
        0.1 * math.exp(log)
    )
    assert (
        found.ci95 == pytest.approx((math.exp(log - 0.2) - 1, math.exp(log + 0.2) - 1))
        and found.significant is significant
    )


def test_a_chance_that_could_not_be_tested_is_no_number() -> None:
    assert chance("p_value", 0.03).value == 0.03 and math.isnan(chance("p_value", None).value)
