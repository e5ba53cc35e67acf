"""What a study says of made-up outcomes: every figure worked out by hand."""

from __future__ import annotations

import math

import pytest

from labpipe.estimation.settings import FitSettings
from labpipe.records.finding import Parameter
from labpipe.uncertainty.study import Outcome, squared_error, success_rate, summarise, workers

FIT = FitSettings("mdof", mass=(1.0, 1.0), symmetric=True, name="two")
TRUTH = {"k_1_1": 3.0, "k_1_2": -2.0, "k_2_1": -2.0, "k_2_2": 4.0}


def outcome(diagonal: float, beside: float, converged: bool = True, std_error: float | None = 0.5) -> Outcome:
    """k_1_1 and k_1_2 with 95 % intervals of two standard errors; k_2_2 exact.

    A derived one that must not count.
    """
    values = {"k_1_1": diagonal, "k_1_2": beside, "k_2_2": 4.0}
    parameters = [
        Parameter(
            name,
            value,
            "N/m",
            std_error=std_error,
            ci95=None if std_error is None else (value - 2 * std_error, value + 2 * std_error),
        )
        for name, value in values.items()
    ]
    return Outcome(converged, (*parameters, Parameter("f_n_1", 9.9, "Hz", derived=True)))


def test_squared_error_counts_entries_beside_the_diagonal_twice() -> None:
    # 1^2 + 2 * 0.5^2
    assert squared_error(outcome(4.0, -1.5), ["k_1_1", "k_1_2", "k_2_2"], TRUTH, FIT) == pytest.approx(1.5)


def test_success_needs_a_result_within_the_limit() -> None:
    # |p_true|^2 = 9 + 2 * 4 + 16 = 33; a deviation of 0.5 is 8.7 %, one of 1 is 17 %.
    outcomes = [
        outcome(3.5, -2.0),
        outcome(4.0, -2.0),
        outcome(3.0, -2.0, converged=False),
        Outcome(False, ()),
    ]
    assert success_rate(outcomes, FIT, TRUTH, 0.1) == 0.25
    assert success_rate(outcomes, FIT, TRUTH, 0.2) == 0.5


def test_a_case_by_hand() -> None:
    results = [outcome(3.4, -2.0), outcome(2.8, -2.0), outcome(4.2, -2.0)]
    outcomes = [*results, outcome(9.0, -2.0, converged=False, std_error=None), Outcome(False, ())]
    case = summarise(outcomes, FIT, TRUTH, {"k_1_1": 0.5}, (0.1,), 0.02, 25)
    assert (case.repeats, case.failed) == (5, 2)
    # Errors 0.16, 0.04, 1.44 and, of the one that did not converge, 36.
    assert case.mean_error == pytest.approx(37.64 / 4) and case.median_error == pytest.approx(0.8)
    k = case.parameters[0]
    assert (k.name, k.truth, k.bound, k.std_error) == ("k_1_1", 3.0, 0.5, pytest.approx(0.5))
    assert k.mean == pytest.approx(10.4 / 3) and k.bias == pytest.approx(1.4 / 3)
    assert k.rmse == pytest.approx(math.sqrt(1.64 / 3)) and case.rmse_over_bound == pytest.approx(
        k.rmse / 0.5
    )
    # 3.4 and 2.8 hold 3 within +- 1, 4.2 does not; the two others always hold their truth.
    assert k.coverage == pytest.approx(2 / 3) and case.coverage == pytest.approx((2 / 3 + 1 + 1) / 3)


def test_what_a_fit_eliminates_counts_as_zero() -> None:
    """k_1_2 = -2 is dropped in one of two repeats, which makes an error of 2 x 2^2 = 8 and no success."""
    whole = outcome(3.0, -2.0)
    without = Outcome(True, tuple(p for p in whole.parameters if p.name != "k_1_2"))
    for outcomes in ([whole, without], [without, whole]):
        case = summarise(outcomes, FIT, TRUTH, {}, (0.1,), 0.02, 25)
        assert case.mean_error == pytest.approx(4.0) and case.success == (0.5,)
        beside = next(parameter for parameter in case.parameters if parameter.name == "k_1_2")
        assert beside.mean == pytest.approx(-1.0) and beside.rmse == pytest.approx(math.sqrt(2))


def test_nothing_but_failures() -> None:
    case = summarise([Outcome(False, ())] * 3, FIT, TRUTH, {}, (0.1,), 0.5, 25)
    assert (
        case.failed == 3 and math.isnan(case.mean_error) and case.success == (0.0,) and case.parameters == ()
    )
    assert case.coverage is None and case.rmse_over_bound is None


def test_one_worker_needs_no_process() -> None:
    with workers(1) as crew:
        assert crew.pool is None
