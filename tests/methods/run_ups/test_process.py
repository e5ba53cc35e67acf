"""Smooth factors on the joint fit: the process against textbook formulas, and a bearing with arbitrary
factors recovered with its uncertainty.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import FitError
from labpipe.methods.rotor.posterior import Problem
from labpipe.methods.run_ups.joint import (
    JointFit,
    MeasuredThreshold,
    fit_jointly,
    nearby_threshold,
    run_up_problem,
)
from labpipe.methods.run_ups.misfit import runs_by_load
from labpipe.methods.run_ups.process import (
    LinearData,
    ProcessFamily,
    ProcessFit,
    SmoothField,
    SquaredExponential,
    fit_with_process,
    places_of,
    rows_by_place,
)
from labpipe.methods.run_ups.rotor import PRIOR, FilmFamily, as_eight, as_matrices, coefficient_errors
from labpipe.methods.run_ups.virtual_rig import true_coefficients
from labpipe.records.uncertain import Uncertain
from tests.methods.run_ups.run_up_cases import RIG, trained, virtual

KERNEL = SquaredExponential(0.15, 4.0, 90.0)
FAMILY = FilmFamily(RIG.place.bearing, 50 * np.pi, 6.5)


@pytest.fixture(scope="module")
def joint() -> JointFit:
    return fit_jointly(RIG, trained("factors"))


@pytest.fixture(scope="module")
def found(joint: JointFit) -> ProcessFit:
    return fit_with_process(RIG, trained("factors"), joint)


def some_places(rng: np.random.Generator, n: int = 30) -> np.ndarray:
    return np.stack([rng.uniform(3, 11, n), rng.uniform(40, 320, n)], axis=-1)


def test_the_covariance_falls_with_load_and_speed() -> None:
    here, there = np.array([[5.0, 100.0]]), np.array([[9.0, 190.0]])
    np.testing.assert_allclose(KERNEL.covariance(here, there), 0.15**2 * np.exp(-0.5 - 0.5))
    np.testing.assert_allclose(KERNEL.covariance(here, here), 0.15**2)


def test_what_the_basis_says_and_what_it_leaves_are_the_whole_covariance(rng: np.random.Generator) -> None:
    places, elsewhere = some_places(rng), some_places(rng, 7)
    field = SmoothField.of(KERNEL, places)
    basis = field.basis(elsewhere)
    np.testing.assert_allclose(
        basis @ basis.T + field.residual_covariance(elsewhere),
        KERNEL.covariance(elsewhere, elsewhere),
        atol=1e-12,
    )
    assert np.all(np.diagonal(field.residual_covariance(places)) < 1e-5 * KERNEL.size**2)
    far = np.array([[60.0, 100.0]])
    np.testing.assert_allclose(field.residual_covariance(far), KERNEL.size**2, rtol=1e-6)


def test_the_posterior_of_the_basis_is_the_textbook_s(rng: np.random.Generator) -> None:
    """Mean k^T (K + s^2)^-1 y and variance k - k^T (K + s^2)^-1 k (Rasmussen and Williams, 2.25 and 2.26)."""
    places, elsewhere, noise = some_places(rng, 12), some_places(rng, 5), 0.05
    measured = rng.standard_normal(12) * 0.1
    whole = KERNEL.covariance(places, places) + noise**2 * np.eye(12)
    between = KERNEL.covariance(elsewhere, places)
    mean = between @ np.linalg.solve(whole, measured)
    variance = KERNEL.covariance(elsewhere, elsewhere) - between @ np.linalg.solve(whole, between.T)
    field = SmoothField.of(KERNEL, places)
    known, asked = field.basis(places), field.basis(elsewhere)
    own = np.linalg.inv(known.T @ known / noise**2 + np.eye(field.n_mode))
    np.testing.assert_allclose(asked @ own @ known.T @ measured / noise**2, mean, atol=1e-5)
    np.testing.assert_allclose(
        asked @ own @ asked.T + field.residual_covariance(elsewhere), variance, atol=1e-6
    )


def test_slopes_of_the_coefficients_equal_differences(rng: np.random.Generator) -> None:
    family = ProcessFamily(FAMILY, SmoothField.of(KERNEL, some_places(rng, 10)))
    values = np.concatenate(
        [0.2 * PRIOR * rng.standard_normal(12), 0.5 * rng.standard_normal(8 * family.field.n_mode)]
    )
    load, speed = np.array([4.0, 9.0]), np.array([80.0, 240.0])
    eight, slopes = family.coefficients_and_slopes(values, load, speed)
    np.testing.assert_allclose(eight, family.coefficients(values, load, speed))
    assert slopes.shape == (2, 8, 12 + 8 * family.field.n_mode)
    direction = 1e-6 * rng.standard_normal(values.size)
    change = (
        family.coefficients(values + direction, load, speed)
        - family.coefficients(values - direction, load, speed)
    ) / 2
    np.testing.assert_allclose(slopes @ direction, change, rtol=1e-5)


def test_without_factors_it_is_the_family(rng: np.random.Generator) -> None:
    family = ProcessFamily(FAMILY, SmoothField.of(KERNEL, some_places(rng, 6)))
    values = np.concatenate([0.2 * PRIOR, np.zeros(8 * family.field.n_mode)])
    speed = np.array([60.0, 200.0])
    np.testing.assert_allclose(
        family.coefficients(values, 5.0, speed), FAMILY.coefficients(0.2 * PRIOR, 5.0, speed)
    )


def small_problem(kernel: SquaredExponential) -> tuple[Problem[ProcessFamily], np.ndarray]:
    """One load, six speeds, no threshold."""
    run = trained("factors")[1]
    cut = {
        name: getattr(run, name)[4:22:3] for name in ("speed", "response", "amplitude_error", "phase_error")
    }
    part = dataclasses.replace(run, **cut)
    groups = tuple(runs_by_load(RIG, [part]))
    places = places_of(part.load, part.speed)
    field = SmoothField.of(kernel, places)
    spread = np.concatenate([PRIOR, np.ones(8 * field.n_mode)])
    return run_up_problem(ProcessFamily(FAMILY, field), groups, (), spread), places


def test_the_marginal_likelihood_is_that_of_a_normal_distribution() -> None:
    """Between two kernels, against the density of all responses at once, N(0, 1 + A (K + T P^2 T^T) A^T)."""
    problem, places = small_problem(KERNEL)
    values = np.zeros(12 + 8 * problem.model.field.n_mode)
    data = LinearData.at(problem, values, places)
    eight = problem.model.coefficients(values, places[:, 0], places[:, 1])
    rows = rows_by_place(problem, values, eight)
    n, m = len(rows), rows[0][1].shape[0]
    slopes = np.zeros((n * m, n * 8))
    for number, (_, row) in enumerate(rows):
        slopes[number * m : (number + 1) * m, number * 8 : (number + 1) * 8] = row
    measured = -np.concatenate([residual for residual, _ in rows])
    by_family = (data.by_family * PRIOR).reshape(n * 8, -1)

    def density(kernel: SquaredExponential) -> float:
        prior = np.kron(kernel.covariance(places, places), np.eye(8)) + by_family @ by_family.T
        return float(
            stats.multivariate_normal.logpdf(measured, cov=slopes @ prior @ slopes.T + np.eye(n * m))
        )

    other = SquaredExponential(0.3, 4.0, 50.0)
    ours = data.log_likelihood(SmoothField.of(other, places)) - data.log_likelihood(
        SmoothField.of(KERNEL, places)
    )
    assert ours == pytest.approx(density(other) - density(KERNEL), abs=0.02)
    assert abs(ours) > 1


def test_slopes_of_a_threshold_by_the_coefficients_equal_differences() -> None:
    """The row that a measured threshold adds: each coefficient a little larger at all speeds."""
    problem, places = small_problem(KERNEL)
    load, speed = float(places[0, 0]), RIG.threshold(RIG.start(float(places[0, 0])))
    assert speed is not None
    places = np.concatenate([places, [[load, speed]]])
    family = ProcessFamily(FAMILY, SmoothField.of(KERNEL, places))
    threshold = MeasuredThreshold(RIG, load, Uncertain(speed, 0.5))
    problem = dataclasses.replace(problem, model=family, tests=(*problem.tests, threshold))
    values = np.zeros(12 + 8 * family.field.n_mode)
    residual, row = rows_by_place(problem, values, family.coefficients(values, places[:, 0], places[:, 1]))[
        -1
    ]
    at_load = family.at_load(values, load)

    def scaled(change: np.ndarray) -> float:
        def coefficients(speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return as_matrices(as_eight(*at_load(speed)) * np.exp(change))

        return nearby_threshold(RIG, coefficients, speed)[0]

    assert residual == pytest.approx((scaled(np.zeros(8)) - speed) / 0.5, abs=1e-3)
    for n in range(8):
        step = 1e-4 * np.eye(8)[n]
        assert row[0, n] == pytest.approx(
            (scaled(step) - scaled(-step)) / 2e-4 / 0.5, rel=0.02, abs=0.02 * np.abs(row).max()
        )


@pytest.mark.long
def test_outside_the_family_its_held_out_interval_holds_where_the_joint_fit_s_does_not() -> None:
    """Other grooves, clearance and oil: chi-square accepts the joint fit, whose threshold at the held-out
    load misses by 2.8 errors.
    """
    truth, runs = virtual("outside"), trained("outside")
    joint = fit_jointly(RIG, runs)
    true = RIG.threshold(true_coefficients(truth, truth.held_out))
    alone, ours = (
        joint.threshold(truth.held_out),
        fit_with_process(RIG, runs, joint).threshold(truth.held_out),
    )
    assert true is not None and alone is not None and ours is not None
    assert not joint.rejected
    assert abs(alone.value - true) > 2 * alone.std_error
    assert abs(ours.value - true) < 2 * ours.std_error < 0.1 * true


@pytest.mark.long
def test_where_the_joint_fit_is_rejected_it_meets_the_data(joint: JointFit, found: ProcessFit) -> None:
    assert joint.rejected and joint.chi2_per_datum > 4
    assert 0.8 < found.chi2_per_datum < 1.3
    assert 12 < found.n_effective < found.values.size
    assert found.loads == joint.loads


@pytest.mark.long
def test_trained_critical_speeds_within_three_in_a_thousand(joint: JointFit, found: ProcessFit) -> None:
    """Where the joint fit is one to two per cent off; its standard errors hold."""
    truth = virtual("factors")
    for load in found.loads:
        true = RIG.critical_speed(true_coefficients(truth, load))
        ours = found.critical_speed(load)
        assert abs(ours.value / true - 1) < 0.003
        assert abs(ours.value - true) < 3 * ours.std_error < 0.006 * true
    assert (
        max(
            abs(joint.critical_speed(load).value / RIG.critical_speed(true_coefficients(truth, load)) - 1)
            for load in joint.loads
        )
        > 0.01
    )


def test_intervals_of_thresholds_hold_the_truth(found: ProcessFit) -> None:
    """At trained loads within seconds of rpm, at the load that no fit saw within an interval that says how
    little is known there.
    """
    truth = virtual("factors")
    for load in (*found.loads, truth.held_out):
        true, ours = RIG.threshold(true_coefficients(truth, load)), found.threshold(load)
        assert true is not None and ours is not None
        assert abs(ours.value - true) < 2.5 * ours.std_error
        assert (ours.std_error < 0.005 * true) == (load <= max(found.loads))


def test_coefficients_are_nearer_to_the_truth_and_their_errors_say_how_near(
    joint: JointFit, found: ProcessFit
) -> None:
    truth, missed, better, worse = virtual("factors"), [], [], []
    for load in found.loads:
        true = as_eight(*true_coefficients(truth, load)(truth.omega))
        eight, error = found.coefficients(load, truth.omega)
        missed.append((eight - true) / error)
        better.append(coefficient_errors(eight, true))
        worse.append(coefficient_errors(joint.coefficients(load, truth.omega)[0], true))
    assert np.sqrt(np.mean(np.square(missed))) < 1.3
    assert np.sqrt(np.mean(np.square(better))) < 0.6 * np.sqrt(np.mean(np.square(worse)))


@pytest.mark.long
def test_errors_of_predictions_are_those_of_drawn_parameters(
    found: ProcessFit, rng: np.random.Generator
) -> None:
    """120 draws from the covariance at a trained load, so close to the fit that all is linear.

    20 % agreement.
    """
    load, part = found.loads[1], 0.05
    draws = (
        found.values
        + part * rng.standard_normal((120, found.values.size)) @ np.linalg.cholesky(found.covariance).T
    )
    critical = [RIG.critical_speed(found.model.at_load(one, load)) for one in draws]
    threshold = [RIG.threshold(found.model.at_load(one, load)) for one in draws]
    stated = found.threshold(load)
    assert stated is not None
    assert np.std(critical) / part * found.widening == pytest.approx(
        found.critical_speed(load).std_error, rel=0.2
    )
    assert np.std(np.array(threshold, np.float64)) / part * found.widening == pytest.approx(
        stated.std_error, rel=0.2
    )


def test_what_it_says_of_itself(found: ProcessFit) -> None:
    assert found.caution(found.loads[0]) == ""
    assert (
        "16.9 N lies outside the loads of the fit (3.66 to 10.3 N): the smooth factors are extrapolated"
        in found.caution(16.94)
    )
    assert (
        f"of {found.values.size} parameters the data determine {found.n_determined} combinations"
        in found.statement
    )
    assert found.n_determined < found.rank <= found.values.size
    factors = found.model.factors(found.values, 6.0, np.array([100.0, 200.0]))
    assert factors.shape == (2, 8) and np.all((factors > 0.4) & (factors < 1.8))
    assert found.at_load(6.0)(np.array([100.0]))[0].shape == (1, 2, 2)


def test_it_needs_no_joint_fit_and_no_threshold() -> None:
    """Two loads from the rotor file's bearing on."""
    alone = fit_with_process(RIG, trained("factors")[1:3], use_thresholds=False)
    assert 0.7 < alone.chi2_per_datum < 1.4
    assert alone.n_datum == sum(8 * run.n_speed for run in trained("factors")[1:3])


@pytest.mark.long
def test_twice_the_unbalance_is_refused() -> None:
    """No smooth factor of some ten per cent makes up for that."""
    run = trained("factors")[1]
    wrong = dataclasses.replace(run, unbalance={plane: 2 * size for plane, size in run.unbalance.items()})
    with pytest.raises(FitError, match="no minimum") as caught:
        fit_with_process(RIG, [wrong])
    assert "check unbalance" in caught.value.hint
