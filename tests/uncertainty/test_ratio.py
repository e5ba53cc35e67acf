"""One ratio over several tests, and Rayleigh damping: combination in closed form, verdicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.rolling_bearing.ratio import (
    Matched,
    log_covariance,
    ratio_of_tests,
    rayleigh,
    rayleigh_of_tests,
    stiffness_ratio,
)
from labpipe.records.finding import Parameter
from labpipe.uncertainty.compare import Evidence
from labpipe.uncertainty.observations import campaign_of
from labpipe.uncertainty.settings import CompareSettings, TheorySettings
from tests.uncertainty.conftest import a_fit

RATIO = CompareSettings(
    kind="ratio",
    fit="axial",
    over="preload",
    theory=TheorySettings("b.yaml"),
    setting_error=0.01,
    name="ratio",
)
RAYLEIGH = CompareSettings(kind="rayleigh", fit="axial", over="preload", name="damping")


def a_match(
    ratio: float, error: float = 1e-3, bending: float = 0.0, condition: float = 0.0, beta: float = 2e-5
) -> Matched:
    log = np.log([ratio, beta])
    covariance = np.diag([error**2, 4e-6])
    return Matched(
        log, covariance, np.array([bending, 0.0]), np.array([condition, 0.0]), np.array([1e7, 200.0])
    )


def series(settings: CompareSettings, stiffness=(1e7, 2e7), damping=(200.0, 400.0), error: float = 1.0):
    pairs = enumerate(zip(stiffness, damping, strict=True))
    fits = [a_fit(f"t{n}", {"k": (k, k / 1000), "c": (c, error * c / 500)}) for n, (k, c) in pairs]
    return campaign_of(
        settings,
        fits,
        {fit.test: {"preload": f"{100 * (n + 1)} N"} for n, fit in enumerate(fits)},
        "c" if settings is RAYLEIGH else "k",
    )


def test_tests_are_weighed_and_the_shaft_s_error_is_common() -> None:
    """ln ratio by generalised least squares, written out with the inverse of V = diag(s^2) + b b^T."""
    matched = [a_match(1.10, 1e-3, bending=-2.0), a_match(1.1011, 2e-3, bending=-3.0)]
    found = stiffness_ratio(series(RATIO), matched, (), 0.005)
    inverse = np.linalg.inv(np.diag([1e-6, 4e-6]) + np.outer([0.01, 0.015], [0.01, 0.015]))
    log = inverse.sum(axis=0) @ np.log([1.10, 1.1011]) / inverse.sum()
    error = inverse.sum() ** -0.5
    ratio = found.amount("ratio")
    assert ratio.value == pytest.approx(np.exp(log), rel=1e-9)
    assert ratio.std_error == pytest.approx(np.exp(log) * error, rel=1e-9)
    assert ratio.ci95 == pytest.approx(tuple(np.exp(log + np.array([-1, 1]) * 1.959964 * error)), rel=1e-6)
    assert found.verdict == "stiffer than theory"
    assert "corrected for the bending shaft" in found.statement


def test_the_setting_s_error_is_each_test_s_own() -> None:
    found = stiffness_ratio(series(RATIO), [a_match(1.0, 1e-6, condition=-0.7)] * 2, (), 0.0)
    assert found.amount("ratio").std_error == pytest.approx(0.7 * 0.01 / np.sqrt(2), rel=1e-4)
    assert found.verdict == "as theory"
    assert found.points[0].ratio_ci95 == pytest.approx(
        (np.exp(-1.96 * 0.007), np.exp(1.96 * 0.007)), rel=1e-4
    )


def test_one_factor_that_does_not_hold_is_told_and_the_interval_widened() -> None:
    found = stiffness_ratio(series(RATIO), [a_match(0.8), a_match(0.9)], (), 0.0)
    assert found.amount("scatter_p").value < 1e-6
    assert "One factor does not hold" in found.statement
    low, high = found.amount("ratio").ci95
    assert low < 0.8
    assert high > 0.9
    assert (
        stiffness_ratio(series(RATIO), [a_match(0.8), a_match(0.801)], (), 0.0).verdict
        == "softer than theory"
    )


def test_damping_proportional_to_stiffness_is_called_so() -> None:
    found = rayleigh(series(RAYLEIGH), None)
    assert found.verdict == "proportional"
    assert found.amount("beta").value == pytest.approx(2e-5, rel=1e-9)
    assert found.amount("exponent").value == pytest.approx(1.0, abs=1e-9)
    assert found.amount("beta").std_error == pytest.approx(2e-5 * np.hypot(1e-3, 2e-3) / np.sqrt(2), rel=1e-9)
    assert [point.ratio for point in found.points] == pytest.approx([1.0, 1.0])
    assert [point.theory for point in found.points] == pytest.approx([200.0, 400.0])


def test_constant_damping_is_not_proportional() -> None:
    found = rayleigh(series(RAYLEIGH, damping=(200.0, 200.0)), None)
    assert found.verdict == "not proportional"
    assert found.amount("exponent").value == pytest.approx(0.0, abs=1e-9)
    assert [point.ratio for point in found.points] == pytest.approx([2**0.5, 2**-0.5], rel=1e-9)


def test_with_a_theory_its_beta_counts() -> None:
    found = rayleigh(
        series(RAYLEIGH, damping=(200.0, 200.0)), [a_match(1.1, beta=3e-5), a_match(1.1, beta=3e-5)]
    )
    assert found.verdict == "proportional"
    assert found.amount("beta").value == pytest.approx(3e-5, rel=1e-9)


def test_a_theory_is_matched_anew_where_the_tests_stand_in_another_order(monkeypatch) -> None:
    """Of tests at one preload `group` makes the order: by it up stands behind down."""
    fits = tuple(a_fit(way, {"k": (k, 1e3), "c": (100.0, 0.1)}) for way, k in (("up", 1e7), ("down", 2e7)))
    conditions = {way: {"preload": "100 N", "way": way} for way in ("up", "down")}
    beta = {"up": 1e-5, "down": 5e-6}
    monkeypatch.setattr(
        "labpipe.methods.rolling_bearing.ratio._match_anew",
        lambda campaign, *_: ([a_match(1.0, beta=beta[o.fit.test]) for o in campaign.observations], ()),
    )
    evidence = Evidence(fits, (), (), conditions=conditions, theory=object())
    ratio_of_tests(replace(RATIO, group="way"), evidence)
    found = rayleigh_of_tests(replace(RAYLEIGH, theory=TheorySettings("b.yaml")), evidence)
    by_test = {point.test: point.ratio for point in found.points}
    assert by_test == pytest.approx({"up": 2**0.5, "down": 2**-0.5}, rel=1e-6)


@pytest.mark.long
def test_chance_alone_is_not_proportional_in_one_case_of_twenty(rng) -> None:
    """300 series of four tests with independent c: 5 % within 4 binomial standard deviations."""
    wrong = 0
    for _ in range(300):
        k = np.array([1e7, 2e7, 3e7, 4e7]) * (1 + 1e-3 * rng.standard_normal(4))
        c = 2e-5 * np.array([1e7, 2e7, 3e7, 4e7]) * (1 + 2e-3 * rng.standard_normal(4))
        wrong += rayleigh(series(RAYLEIGH, k, c), None).verdict == "not proportional"
    assert wrong / 300 == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 300))


def test_a_fit_without_damping_is_refused() -> None:
    with pytest.raises(FitError, match="has no standard error"):
        rayleigh(
            series(RAYLEIGH),
            [
                a_match(1.1),
                Matched(np.log([1.1, 2e-5]), np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.ones(2)),
            ],
        )


def test_what_repeats_scatter_by_counts_and_given_coefficients_are_refused() -> None:
    """beta of two tests whose inflated errors are three times those of noise: three times sqrt(2) / 2 of
    those, as in the test of proportional damping. A derived c was given, and says nothing of damping.
    """
    plain = series(RAYLEIGH)
    wider = replace(
        plain,
        observations=tuple(
            replace(one, fit=replace(one.fit, parameters=tuple(inflated(p) for p in one.fit.parameters)))
            for one in plain.observations
        ),
    )
    errors = [rayleigh(tests, None).amount("beta").std_error for tests in (plain, wider)]
    assert errors[1] == pytest.approx(3 * 2e-5 * np.hypot(1e-3, 2e-3) / np.sqrt(2), rel=1e-9)
    assert errors[1] == pytest.approx(3 * errors[0], rel=1e-9)
    k, c = plain.observations[0].fit.parameters
    given = replace(plain.observations[0].fit, parameters=(k, replace(c, derived=True, std_error=None)))
    with pytest.raises(FitError, match="c of test t0 has no standard error of its own"):
        log_covariance(given)
    with pytest.raises(FitError, match="c of test t0 is missing"):
        log_covariance(replace(given, parameters=(k,)))


def test_a_negative_damping_has_no_logarithm() -> None:
    with pytest.raises(FitError, match="c of test t0 is -200"):
        rayleigh(series(RAYLEIGH, damping=(-200.0, 400.0)), None)


def inflated(parameter: Parameter) -> Parameter:
    return replace(parameter, std_error_inflated=3 * parameter.std_error)
