"""Errors in common: what tests share cancels in differences and trends, and stays in levels."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from labpipe.artefacts.dataset_file import write_parts
from labpipe.artefacts.writing import output_folder
from labpipe.project.catalogue_search import dataset_parameters, differences
from labpipe.project.compare import listed_points
from labpipe.records.dataset import TestResult, rows_of_fit
from labpipe.records.identification import Fit, of_fit
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.uncertainty.amounts import change_in, joint_errors, parameter_changes, random_error, source_dofs
from labpipe.uncertainty.compare import difference, repeatability, trend
from labpipe.uncertainty.matrix import condition_matrix
from labpipe.uncertainty.observations import campaign_of
from labpipe.uncertainty.settings import CompareSettings, MatrixSettings
from labpipe.uncertainty.weighted import from_the_rest, straight_trend
from tests.uncertainty.conftest import a_fit


def with_gain(fit: Fit, gain: float, source: str = "force sensor", dof: float | None = None) -> Fit:
    """The fit with a relative uncertainty of its k by one source."""
    k = fit.parameter("k")
    change = -gain * k.value
    budget = Budget(
        ("k",), np.array([k.std_error]), 30.0, (Uncertainty(source, gain, "1", dof),), np.array([[change]])
    )
    whole = float(np.hypot(k.std_error, change))
    return dataclasses.replace(
        fit,
        parameters=(dataclasses.replace(k, std_error_inflated=whole, systematic=abs(change)),),
        budget=budget,
    )


def gained(values, source=lambda _n: "force sensor", gain: float = 0.02, error: float = 1e3, dof=None):
    fits = [
        with_gain(a_fit(f"t{n}", {"k": (value, error)}), gain, source(n), dof)
        for n, value in enumerate(values)
    ]
    conditions = {
        f"t{n}": {"load": f"{n % 2 + 1} kN", "way": "up" if n < 2 else "down"} for n in range(len(values))
    }
    return fits, conditions


PAIRED = CompareSettings(
    kind="difference", fit="axial", over="load", group="way", groups=("up", "down"), name="d"
)


def test_a_ratio_of_two_tests_does_not_carry_the_sensor_they_share() -> None:
    """k of both groups changes alike with the force sensor: the difference keeps the error of noise alone,
    sqrt(2) s / k / sqrt(2).
    """
    fits, conditions = gained([1e6, 2e6, 1.05e6, 2.1e6])
    shared = difference(campaign_of(PAIRED, fits, conditions)).amount("difference")
    plain = [a_fit(fit.test, {"k": (fit.parameters[0].value, 1e3)}) for fit in fits]
    alone = difference(campaign_of(PAIRED, plain, conditions)).amount("difference")
    assert shared.value == pytest.approx(0.05, rel=1e-9)
    assert shared.std_error == pytest.approx(alone.std_error, rel=1e-9)


def test_different_sensors_do_not_cancel() -> None:
    """Two sensors of 2 % each: the ratio carries sqrt(2) 2 %, times 1.05."""
    fits, conditions = gained([1e6, 2e6, 1.05e6, 2.1e6], lambda n: "a" if n < 2 else "b")
    found = difference(campaign_of(PAIRED, fits, conditions)).amount("difference")
    assert found.std_error == pytest.approx(1.05 * np.sqrt(2) * 0.02, rel=1e-3)


def test_a_trend_keeps_its_slope_and_its_level_takes_the_uncertainty() -> None:
    """A common gain moves level and slope by 2 % of themselves: level 1.5e6, slope 1e6 / kN (closed form for
    a line through the tests).
    """
    fits, conditions = gained([1e6, 2e6, 1e6, 2e6])
    settings = CompareSettings(kind="trend", fit="axial", over="load", name="t")
    found = trend(campaign_of(settings, fits, conditions))
    noise = 1e3 / np.sqrt(4)
    assert found.amount("level").std_error == pytest.approx(np.hypot(0.02 * 1.5e6, noise), rel=1e-6)
    assert found.amount("slope").std_error == pytest.approx(
        np.hypot(0.02 * 1e3, 1e3 / np.sqrt(4 * 500.0**2)), rel=1e-6
    )


def half(parameter) -> float:
    return (parameter.ci95[1] - parameter.ci95[0]) / 2


def test_a_sensor_known_by_few_degrees_of_freedom_widens_by_student_s_factor() -> None:
    """Gains of 2 % with 3 degrees of freedom are all but a thousandth of each uncertainty: of a level, of two
    settings' mean and of a matrix of repeats t(3) = 3.18 of it, and of the ratio of two sensors, with 6
    degrees of freedom (Welch and Satterthwaite), t(6) = 2.45.
    """
    three, six = stats.t.ppf(0.975, [3, 6])
    fits, conditions = gained([1e6, 2e6, 1e6, 2e6], error=1e2, dof=3.0)
    settings = CompareSettings(kind="trend", fit="axial", over="load", name="t")
    level = trend(campaign_of(settings, fits, conditions)).amount("level")
    assert half(level) == pytest.approx(three * 0.02 * 1.5e6, rel=1e-3)
    grouped = CompareSettings(kind="repeatability", fit="axial", group="way", name="r")
    alike = gained([1e6, 1.0001e6, 1.0001e6, 1e6], error=1e2, dof=3.0)[0]
    mean = repeatability(campaign_of(grouped, alike, conditions)).amount("mean")
    assert half(mean) == pytest.approx(three * 0.02 * 1e6, rel=1e-3)
    matrix = condition_matrix(MatrixSettings(fit="axial", over=("load",), name="m"), fits, conditions)
    repeated = matrix.points[0].values[0]
    assert repeated.repeats == 2 and half(repeated.parameter) == pytest.approx(three * 0.02 * 1e6, rel=1e-3)
    two = gained([1e6, 2e6, 1e6, 2e6], lambda n: "a" if n < 2 else "b", error=1e2, dof=3.0)[0]
    found = difference(campaign_of(PAIRED, two, conditions)).amount("difference")
    assert np.log1p(found.ci95[1]) == pytest.approx(six * np.sqrt(2) * 0.02, rel=1e-3)


def test_the_mean_of_repeats_keeps_the_error_that_no_repetition_shows() -> None:
    """Settings a and b of two tests each: MSB / 4 = ((a - b) / 2)^2, 2 % of 1e6 by one sensor.

    Quantile: of each part its own, by its share of u^2 (Cochran and Cox 1957).
    """
    values = [995e3, 995e3 + 1e3, 1005e3 - 1e3, 1005e3]
    fits, conditions = gained(values)
    settings = CompareSettings(kind="repeatability", fit="axial", group="way", name="r")
    found = repeatability(campaign_of(settings, fits, conditions)).amount("mean")
    scatter = abs(np.mean(values[:2]) - np.mean(values[2:])) / 2
    error = np.hypot(scatter, 0.02 * 1e6)
    assert found.std_error == pytest.approx(error, rel=1e-9)
    reach = (stats.t.ppf(0.975, 1) * scatter**2 + stats.norm.ppf(0.975) * (0.02 * 1e6) ** 2) / error
    assert found.ci95 == pytest.approx((1e6 - reach, 1e6 + reach), rel=1e-9)


@pytest.mark.parametrize("settings_share", [0.5, 0.9, 0.97])
def test_two_settings_beside_a_known_sensor_hold_at_the_stated_rate(rng, settings_share: float) -> None:
    """The sensor has the other share of the variance: 2,000 means, of which 94 to 97 % hold by the integral
    over the chi-square of one scatter (Welch and Satterthwaite's 93, 87 and 88 %).
    """
    gain, held = 1e-3, 0
    between = gain * 1e6 * np.sqrt(2 * settings_share / (1 - settings_share))
    settings = CompareSettings(kind="repeatability", fit="axial", group="way", name="r")
    for _ in range(2000):
        means = np.repeat(rng.normal(1e6, between, 2), 2) * (1 + gain * rng.standard_normal())
        fits, conditions = gained(means + rng.normal(0, 1e-3 * between, 4), gain=gain, error=1e-3 * between)
        low, high = repeatability(campaign_of(settings, fits, conditions)).amount("mean").ci95
        held += low <= 1e6 <= high
    squares = settings_share * stats.chi2.ppf((np.arange(4000) + 0.5) / 4000, 1)
    error = np.sqrt(squares + 1 - settings_share)
    reach = (stats.t.ppf(0.975, 1) * squares + stats.norm.ppf(0.975) * (1 - settings_share)) / error
    expected = np.mean(2 * stats.norm.cdf(reach) - 1)
    assert 0.93 < expected < 0.98
    assert held / 2000 == pytest.approx(expected, abs=3 * np.sqrt(expected * (1 - expected) / 2000))


def by_two_gains(difference: float, *errors: float) -> float:
    """Two-sided p-value of a difference by two errors with 3 degrees of freedom each."""
    squares = np.square(errors)
    return 2 * stats.t.sf(difference / np.sqrt(squares.sum()), 3 * squares.sum() ** 2 / np.sum(squares**2))


def test_p_values_know_the_degrees_of_freedom_of_sensors() -> None:
    """Gains of 2 % with 3 degrees of freedom are all but a thousandth of each uncertainty: by sensors of
    their own two results differ with t of 6, but for their sizes (Welch and Satterthwaite), as does a
    value from the mean of two, which share one; a slope by one sensor has t of 3.
    """
    (first, second), _ = gained([1e6, 1.06e6], "ab".__getitem__, error=1.0, dof=3.0)
    pair = differences(of_fit(first), of_fit(dataclasses.replace(second, test=first.test)))[0]
    assert pair.p_value == pytest.approx(by_two_gains(0.06, 0.02, 0.0212), rel=1e-4)
    fits, _ = gained([1e6, 1e6, 1.08e6], "aab".__getitem__, error=1.0, dof=3.0)
    k = np.array([fit.parameter("k").value for fit in fits])
    sources = parameter_changes(fits, "k"), source_dofs(fits)
    _, chances = from_the_rest(k, np.ones(3), *sources)
    assert chances[2] == pytest.approx(by_two_gains(0.08, 0.02, 0.0216), rel=1e-4)
    shared, _ = gained([1e6, 2e6, 3e6], error=1e2, dof=3.0)
    sources = parameter_changes(shared, "k"), source_dofs(shared)
    line = straight_trend(np.arange(1.0, 4.0), np.array([1e6, 2e6, 3e6]), np.full(3, 1e2), *sources)
    assert line.p_of(1, 0.9e6) == pytest.approx(2 * stats.t.sf(0.1 / 0.02, 3), rel=1e-3)


def test_points_of_matrices_and_files_of_many_tests_keep_the_degrees_of_freedom(tmp_path) -> None:
    fits, conditions = gained([1e6, 2e6, 1e6, 2e6], dof=3.0)
    matrix = condition_matrix(MatrixSettings(fit="axial", over=("load",), name="m"), fits, conditions)
    assert [listed.dofs for listed in listed_points([matrix])] == 2 * [{"force sensor": 3.0}]
    common = {"rig": "r", "date": "2026-11-30", "test": "t0"}
    with output_folder(tmp_path / "out") as output:
        write_parts([TestResult(rows=tuple(rows_of_fit(fits[0], common)))], output)
    assert [listed.dofs for listed in dataset_parameters(tmp_path / "out")] == [{"force sensor": 3.0}]


def test_random_error_is_that_of_the_test_alone() -> None:
    fit = with_gain(a_fit("t", {"k": (1e6, 1e3)}), 0.02)
    assert random_error(fit, fit.parameter("k")) == 1e3
    assert change_in(fit, "force sensor", "k") == pytest.approx(-2e4)
    assert change_in(fit, "no such", "k") == 0.0
    plain = a_fit("p", {"k": (1e6, 1e3)})
    assert parameter_changes((fit, plain), "k").tolist() == [[pytest.approx(-2e4), 0.0]]
    assert joint_errors(np.array([1.0, 2.0]), np.zeros((0, 2))).tolist() == [1.0, 2.0]


def test_a_value_apart_is_seen_behind_a_large_common_error(rng) -> None:
    """Six values with a common error of 10 and noise of 0.1.

    One 1 off the others is told, sound ones by chance only.
    """
    covariance = 0.01 * np.eye(6) + 100.0
    values = 50.0 + 0.1 * rng.standard_normal(6)
    assert np.min(from_the_rest(values, covariance)[1]) > 1e-3
    apart = values.copy()
    apart[2] += 1.0
    assert np.argmin(from_the_rest(apart, covariance)[1]) == 2
    assert from_the_rest(apart, covariance)[1][2] < 1e-6


def test_a_line_through_values_with_a_common_error_scatters_as_stated(rng) -> None:
    """500 lines: slopes scatter with the noise alone (4 standard deviations of a scatter), levels with
    both.
    """
    x = np.arange(5.0)
    covariance = 0.04 * np.eye(5) + 9.0
    fits = [
        straight_trend(x, 3 * rng.standard_normal() + 0.2 * rng.standard_normal(5) + x, covariance)
        for _ in range(500)
    ]
    for number in (0, 1):
        scatter = np.std([fit.values[number] for fit in fits])
        assert scatter == pytest.approx(
            np.median([fit.std_error(number) for fit in fits]), rel=4 / np.sqrt(1000)
        )


def test_the_model_error_that_tests_share_is_left_out_beside_stated_numbers() -> None:
    """Of a value with a model error of 5 s its fit alone has the error s, with a budget as without."""
    (fit,), _ = gained([1e6])
    k = fit.parameter("k")
    wide = dataclasses.replace(k, value=1.1e6, fitted=k.value, std_error_inflated=5e3)
    budget = dataclasses.replace(fit.budget, random=np.array([5e3]))
    alone = dataclasses.replace(fit, parameters=(wide,), budget=budget).as_fitted
    assert alone.parameter("k").value == k.value
    assert random_error(alone, alone.parameter("k")) == pytest.approx(1e3)


def test_points_of_two_matrices_do_not_differ_by_the_mass_that_they_share() -> None:
    """2 % by one sensor moves both points alike, but for 2 % of the 1 % by which they differ."""
    over = MatrixSettings(fit="axial", over=("load",), name="m")
    first, other = (
        list(listed_points([condition_matrix(over, *gained([k, 2e6, k, 2e6]))])) for k in (1e6, 1.01e6)
    )
    pair = differences(first, other)[0]
    # Both means have an error of 1e3 / sqrt(2) by themselves, and 2 % of their difference in common.
    assert pair.std_error == pytest.approx(np.hypot(1e3, 0.02 * 1e4), rel=1e-6)
    assert pair.p_value is not None and pair.p_value < 1e-15
