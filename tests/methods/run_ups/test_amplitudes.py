"""Coefficients from amplitudes alone: slopes and errors against differences and draws, and what twenty starts
show of the method.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.methods.run_ups.amplitudes import (
    AmplitudeFit,
    Amplitudes,
    SearchLimits,
    fit_amplitudes,
    perfect_but_wrong,
)
from labpipe.methods.run_ups.figures import spread_text
from labpipe.methods.run_ups.misfit import displacement_slopes, runs_by_load, scales
from labpipe.methods.run_ups.records import StartSpread
from labpipe.methods.run_ups.rotor import as_eight, as_matrices, largest_displacement
from labpipe.methods.run_ups.virtual_rig import run_ups, true_coefficients
from tests.methods.run_ups.run_up_cases import RIG, trained, virtual


@pytest.fixture(scope="module")
def factors() -> list[AmplitudeFit]:
    """Four loads of the rig with arbitrary smooth factors, from the rotor file's coefficients on."""
    return fit_amplitudes(RIG, trained("factors"))


@pytest.fixture(scope="module")
def twenty() -> AmplitudeFit:
    """One load, twenty starts."""
    return fit_amplitudes(RIG, trained("factors")[1:2], starts=20)[0]


def test_slopes_of_the_largest_displacement_equal_differences(rng: np.random.Generator) -> None:
    speed = np.array([90.0, 150.0, 260.0])
    condensed = RIG.condense(speed, RIG.known_unbalance)
    eight = as_eight(*RIG.start_coefficients(6.0, speed))
    slopes = displacement_slopes(*condensed.response_and_slopes(*as_matrices(eight)))
    assert slopes.shape == (3, 2, 8)
    direction = 1e-6 * scales(eight) * rng.standard_normal(eight.shape)

    def displacement(eight: np.ndarray) -> np.ndarray:
        return largest_displacement(condensed.response(*as_matrices(eight)).reshape(3, 2, 2))

    difference = (displacement(eight + direction) - displacement(eight - direction)) / 2
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slopes, direction), difference, rtol=1e-6)


def test_errors_of_the_largest_displacement_are_those_of_many_draws(rng: np.random.Generator) -> None:
    """1 % and 1 deg on both directions, 4000 draws, three per cent agreement."""
    run = trained("outside")[1]
    draws = run.response * (1 + 0.01 * rng.standard_normal((4000, *run.response.shape)))
    draws = draws * np.exp(1j * np.deg2rad(1) * rng.standard_normal(draws.shape))
    run = dataclasses.replace(
        run,
        amplitude_error=0.01 * np.abs(run.response),
        phase_error=np.full(run.response.shape, np.deg2rad(1)),
    )
    stated = Amplitudes.of(runs_by_load(RIG, [run])[0]).error
    spread = np.std(largest_displacement(draws), axis=0)
    np.testing.assert_allclose(stated, spread, rtol=0.06)
    assert abs(np.mean(stated / spread) - 1) < 0.01


def test_the_fit_looks_perfect_and_the_coefficients_move_away_from_the_truth(
    factors: list[AmplitudeFit],
) -> None:
    """Amplitudes within a quarter of a per cent (their own noise is 1 %) at rank 2 of 8.

    Further from the truth than doing nothing.
    """
    misfit = np.concatenate([fit.misfit for fit in factors])
    assert np.sqrt(np.mean(misfit**2)) < 0.0025
    truth = virtual("factors")
    true = [as_eight(*true_coefficients(truth, fit.load)(fit.speed)) for fit in factors]
    found, nothing = (
        np.sqrt(
            np.mean(
                np.concatenate([getattr(fit, name) / one - 1 for fit, one in zip(factors, true, strict=True)])
                ** 2
            )
        )
        for name in ("coefficients", "start")
    )
    assert found > 1.2 * nothing
    for fit in factors:
        assert set(fit.rank.tolist()) == {2}
        assert fit.n_effective == fit.n_datum


def test_its_thresholds_are_ten_per_cent_off_at_half_of_the_loads(factors: list[AmplitudeFit]) -> None:
    truth = virtual("factors")
    missed = []
    for fit in factors:
        found, true = RIG.threshold(fit.at_speed()), RIG.threshold(true_coefficients(truth, fit.load))
        assert found is not None and true is not None
        missed.append(abs(found / true - 1) > 0.1)
    assert sum(missed) == 2


def test_all_factors_stay_within_the_box(factors: list[AmplitudeFit]) -> None:
    for fit in factors:
        factor = fit.coefficients / fit.start
        assert np.all((factor > 0.7 - 1e-9) & (factor < 1.3 + 1e-9))
        edge = (factor < 0.7003) | (factor > 1.2997)
        np.testing.assert_array_equal(fit.at_bound, edge)


def test_beyond_its_speeds_stiffness_and_damping_times_speed_are_held(factors: list[AmplitudeFit]) -> None:
    """What a film does at one Sommerfeld number."""
    fit = factors[0]
    first, last = fit.speed[0], fit.speed[-1]
    stiffness, damping = fit.at_speed()(np.array([first / 2, last, 2 * last]))
    np.testing.assert_allclose(stiffness[2], stiffness[1])
    np.testing.assert_allclose(damping[2], damping[1] / 2)
    np.testing.assert_allclose(
        as_eight(stiffness, damping)[0], fit.coefficients[0] * np.repeat([1.0, 2.0], 4)
    )


def test_the_objective_is_the_sum_of_squares_of_the_amplitudes(factors: list[AmplitudeFit]) -> None:
    fit, run = factors[2], trained("factors")[2]
    computed = largest_displacement(RIG.response(run.speed, fit.at_speed()))
    squares = np.sum((computed - largest_displacement(run.response)) ** 2, axis=1)
    np.testing.assert_allclose(fit.objective, squares, rtol=1e-6)
    np.testing.assert_allclose(fit.history.objective[-1], fit.objective)
    assert fit.history.evaluations[-1].tolist() == fit.evaluations.tolist()


def spread_of(fit: AmplitudeFit, point: int) -> StartSpread:
    misfit = np.sqrt(fit.objectives[:, point] / fit.measured[point])
    return StartSpread("", tuple(map(tuple, fit.factors[:, point])), tuple(misfit))


def test_twenty_starts_reach_the_data_with_factors_all_over_the_box(twenty: AmplitudeFit) -> None:
    assert twenty.factors.shape == (20, twenty.speed.size, 8)
    width = np.ptp(twenty.factors, axis=0)
    assert np.median(width) > 0.5
    text = spread_text(spread_of(twenty, 9))
    assert text.startswith("all meet the measured amplitudes within")
    assert "the coefficients are not determined" in text
    np.testing.assert_allclose(twenty.objective, twenty.objectives.min(axis=0))


def test_starts_are_repeatable(factors: list[AmplitudeFit], twenty: AmplitudeFit) -> None:
    np.testing.assert_array_equal(factors[1].factors[0], twenty.factors[0])
    few = {"starts": 3, "limits": SearchLimits(most_evaluations=200)}
    one, other = (fit_amplitudes(RIG, trained("factors")[1:2], seed=5, **few)[0] for _ in range(2))  # type: ignore[arg-type]
    np.testing.assert_array_equal(one.factors, other.factors)


def test_with_enough_data_the_starts_would_agree() -> None:
    """Spread in words where a box so narrow leaves no room: the sentence that says "not determined" can also
    not be said.
    """
    fit = fit_amplitudes(
        RIG, trained("outside")[1:2], bound=0.004, starts=4, limits=SearchLimits(most_evaluations=400)
    )[0]
    assert all(
        "factors that agree within 0.0" in spread_text(spread_of(fit, n)) for n in range(fit.speed.size)
    )


def test_all_runs_of_a_load_count() -> None:
    """A second run-up adds amplitudes of the same vectors: four data per speed, and the way is still blind to
    most.
    """
    rig = virtual("outside", "second_unbalance=true")
    fit = fit_amplitudes(
        RIG, run_ups(rig, 1, ["load-2", "load-2-second"]), limits=SearchLimits(most_evaluations=500)
    )[0]
    assert fit.n_datum == 4 * fit.speed.size
    assert fit.rank.max() < 8
    assert fit.chi2 > 0 and fit.n_datum > fit.n_effective


@pytest.mark.long
def test_cobyqa_meets_the_same_amplitudes() -> None:
    run = trained("outside")[1]
    part = slice(5, 6)
    cut = {name: getattr(run, name)[part] for name in ("speed", "response", "amplitude_error", "phase_error")}
    fit = fit_amplitudes(
        RIG, [dataclasses.replace(run, **cut)], method="cobyqa", limits=SearchLimits(most_evaluations=300)
    )[0]
    assert np.all(fit.misfit < 1e-3) and np.isnan(fit.history.mesh).all()


def test_a_sentence_for_the_report(factors: list[AmplitudeFit]) -> None:
    said = perfect_but_wrong(factors)
    assert "determine only 2 combinations of the eight coefficients" in said and "are at a bound" in said
