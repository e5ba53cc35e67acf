"""The joint fit: slopes, recovery inside its family, priors, bounds, and chi-square where the truth lies
outside.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.run_ups.joint import (
    JointFit,
    MeasuredThreshold,
    fit_jointly,
    measured_thresholds,
    nearby_threshold,
    run_up_problem,
)
from labpipe.methods.run_ups.misfit import runs_by_load
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import BOUND, COEFFICIENTS, PARAMETERS, PRIOR, FilmFamily, as_eight
from labpipe.methods.run_ups.virtual_rig import INSIDE, true_coefficients
from labpipe.records.uncertain import Uncertain
from tests.methods.run_ups.run_up_cases import RIG, trained, virtual

FAMILY = FilmFamily(RIG.place.bearing, 50 * np.pi, 6.5)


@pytest.fixture(scope="module")
def inside() -> JointFit:
    return fit_jointly(RIG, trained("inside"))


def test_slopes_of_everything_equal_differences(rng: np.random.Generator) -> None:
    """Responses by analytic slopes, thresholds by left and right eigenvectors, against central
    differences.
    """
    groups = tuple(runs_by_load(RIG, trained("inside")))
    problem = run_up_problem(FAMILY, groups, measured_thresholds(RIG, groups), PRIOR)
    values = 0.3 * PRIOR * rng.standard_normal(12)
    slopes = problem.jacobian(values)
    for n in range(12):
        step = 1e-5 * np.eye(12)[n]
        difference = (problem.residual(values + step) - problem.residual(values - step)) / 2e-5
        np.testing.assert_allclose(slopes[:, n], difference, rtol=1e-3, atol=1e-4 * np.abs(difference).max())


def test_newton_s_threshold_is_the_search_s() -> None:
    coefficients = RIG.start(6.0)
    searched = RIG.threshold(coefficients)
    assert searched is not None
    found, by_speed = nearby_threshold(RIG, coefficients, 1.1 * searched)
    np.testing.assert_allclose(found, searched, rtol=1e-6)
    assert by_speed > 0
    off, _ = MeasuredThreshold(RIG, 6.0, Uncertain(found, 1.0)).residual(FAMILY, np.zeros(12))
    assert off == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("name", ["critical_speed", "threshold"])
def test_errors_of_its_predictions_are_those_of_differences(inside: JointFit, name: str) -> None:
    """Along the axes of the covariance, a tenth of a standard error to both sides."""
    sizes, axes = np.linalg.eigh(inside.whole_covariance)
    changes = 0.1 * (np.sqrt(np.maximum(sizes, 0)) * axes).T
    ends = [
        [getattr(RIG, name)(inside.model.at_load(inside.values + sign * change, 6.0)) for change in changes]
        for sign in (1, -1)
    ]
    error = np.linalg.norm(np.subtract(*ends)) / 0.2
    assert getattr(inside, name)(6.0).std_error == pytest.approx(error, rel=5e-3)


def test_a_threshold_that_two_files_of_one_load_state_counts_once() -> None:
    """A second trial unbalance under the same load, its file with the same head; another measurement is
    another one.
    """
    run, other = trained("inside")[:2]
    again = dataclasses.replace(run, name="again", unbalance={"disc 2": 5e-5})
    assert run.threshold is not None
    once_more = dataclasses.replace(again, threshold=dataclasses.replace(run.threshold, value=290.0))
    for runs, number in (((run, again, other), 2), ((run, once_more), 2)):
        assert len(measured_thresholds(RIG, tuple(runs_by_load(RIG, runs)))) == number


def test_a_threshold_that_is_nowhere_near_is_refused() -> None:
    stiff = (np.eye(2) * 1e6, np.eye(2) * 1e3)
    with pytest.raises(FitError, match="far from the measured one"):
        nearby_threshold(
            RIG, lambda speed: tuple(np.broadcast_to(one, (np.size(speed), 2, 2)) for one in stiff), 290.0
        )  # type: ignore[return-value]


def test_inside_its_family_it_finds_what_can_be_found(inside: JointFit) -> None:
    """Slopes of the viscosity within three standard errors.

    Level, clearance and factors up to the combination that nothing sees.
    """
    assert not inside.rejected
    assert 0.85 < inside.chi2_per_datum < 1.15
    assert inside.rank == 11
    error = inside.std_error
    for name in ("viscosity_speed", "viscosity_load"):
        n = PARAMETERS.index(name)
        # The reference load of the virtual rig is that of the fit: the mean of the logarithms of the trained
        # loads.
        assert abs(inside.values[n] - INSIDE[n]) < 3.5 * error[n]
    seen = inside.values[0] - 2 * inside.values[3], np.mean(inside.values[4:]) - inside.values[3]
    true = INSIDE[0] - 2 * INSIDE[3], np.mean(INSIDE[4:]) - INSIDE[3]
    np.testing.assert_allclose(seen, true, atol=0.06)


def test_the_priors_hold_clearance_viscosity_and_the_common_factor(inside: JointFit) -> None:
    assert len(inside.prior_dominated) == 1
    assert "clearance +0.50" in inside.prior_dominated[0] and "viscosity +1.00" in inside.prior_dominated[0]
    assert all(f"factor_{name} +0.50" in inside.prior_dominated[0] for name in COEFFICIENTS)
    assert 10 < inside.n_effective < 12


def test_intervals_of_predictions_cover_the_truth(inside: JointFit) -> None:
    """At the load that no fit saw: critical speed, threshold and coefficients within three standard
    errors.
    """
    truth = virtual("inside")
    held_out = true_coefficients(truth, truth.held_out)
    critical, threshold = inside.critical_speed(truth.held_out), inside.threshold(truth.held_out)
    assert threshold is not None
    assert abs(critical.value - RIG.critical_speed(held_out)) < 3 * critical.std_error < 0.01 * critical.value
    true_threshold = RIG.threshold(held_out)
    assert true_threshold is not None
    assert abs(threshold.value - true_threshold) < 3 * threshold.std_error < 0.03 * threshold.value
    eight, error = inside.coefficients(truth.held_out, truth.omega)
    missed = (eight - as_eight(*held_out(truth.omega))) / error
    assert np.sqrt(np.mean(missed**2)) < 2


@pytest.mark.long
def test_a_truth_of_arbitrary_factors_is_flagged() -> None:
    found = fit_jointly(RIG, trained("factors"))
    assert found.rejected
    assert found.chi2_per_datum > 4
    assert found.widening == pytest.approx(np.sqrt(found.chi2_per_datum))
    np.testing.assert_array_equal(np.isnan(found.std_error), found.at_bound)
    assert np.all(np.abs(found.values) <= BOUND * (1 + 1e-9))


def test_a_load_outside_those_of_the_fit_is_cautioned(inside: JointFit) -> None:
    assert inside.caution(inside.loads[0]) == ""
    assert "16.9 N lies outside the loads of the fit (3.66 to 10.3 N)" in inside.caution(16.94)
    # The same rotor read with errors that are stated 1 / sqrt(6) as large.
    sharper = [
        dataclasses.replace(
            run, amplitude_error=run.amplitude_error / 6**0.5, phase_error=run.phase_error / 6**0.5
        )
        for run in trained("inside")
    ]
    flagged = fit_jointly(RIG, sharper, use_thresholds=False)
    assert flagged.caution(5.0).startswith("chi-square per datum is 6.")


def test_parameters_as_people_read_them(inside: JointFit) -> None:
    """Factors on the file's values; the two slopes are exponents."""
    viscosity, slope = inside.parameter("viscosity"), inside.parameter("viscosity_speed")
    assert viscosity.value == pytest.approx(np.exp(inside.values[0]))
    assert viscosity.std_error == pytest.approx(viscosity.value * inside.std_error[0])
    assert slope.value == pytest.approx(inside.values[1])


@pytest.mark.long
def test_without_thresholds_the_trained_ones_are_less_certain(inside: JointFit) -> None:
    alone = fit_jointly(RIG, trained("inside"), use_thresholds=False)
    assert inside.n_datum - alone.n_datum == 4
    load = inside.loads[0]
    with_it, without = inside.threshold(load), alone.threshold(load)
    assert with_it is not None and without is not None
    assert with_it.std_error < without.std_error


def with_second_disc(factor: complex) -> list[RunUp]:
    """The run-ups with a mistaken unbalance of disc 2."""
    return [
        dataclasses.replace(
            run,
            unbalance={
                name: size * (factor if name == "disc 2" else 1) for name, size in run.unbalance.items()
            },
        )
        for run in trained("inside")
    ]


@pytest.mark.long
def test_an_unbalance_a_fifth_too_small_is_flagged() -> None:
    found = fit_jointly(RIG, with_second_disc(0.8))
    assert found.rejected and found.chi2_per_datum > 10
    assert found.share_at_bound == np.mean(found.at_bound) > 0


@pytest.mark.long
def test_an_unbalance_of_wrong_phase_is_refused() -> None:
    """Off by a right angle: no coefficients make up for that, and the message says where to look."""
    with pytest.raises(FitError) as caught:
        fit_jointly(RIG, with_second_disc(1j))
    assert "check unbalance" in caught.value.hint


def test_a_run_far_from_the_rotor_file_is_refused() -> None:
    """Thresholds at a tenth of where they are: a unit mistaken."""
    wrong = [dataclasses.replace(run, threshold=Uncertain(20.0, 0.1)) for run in trained("inside")]
    with pytest.raises(FitError):
        fit_jointly(RIG, wrong)
