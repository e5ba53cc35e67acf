"""Misfits, the search from a mesh of starts, and what the profile of the misfit says.

Without noise on exact films.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import FitError
from labpipe.methods.wear.model import WornMisfit, WornModel
from labpipe.methods.wear.search import (
    WearMinimum,
    descend,
    healthy_minimum,
    healthy_probability,
    joint_region,
    merge,
    minima,
    peak_share,
    profile_distance,
    profile_interval,
    refine,
    start_mesh,
)
from labpipe.methods.wear.settings import Gaussian, WearSettings
from tests.methods.wear.worn_cases import LINES, NUISANCES, measured, misfit_of, wear_settings, worn_rig

TRUTH = np.array([22.27, 11.0])


@pytest.fixture(scope="module")
def noisy() -> tuple[WornMisfit, WearMinimum]:
    """Complex misfit with 2 % noise and nuisances, refined at its minimum."""
    misfit = misfit_of(measured(worn_rig(*TRUTH), 0.02, np.random.default_rng(4)), **NUISANCES)
    return refine(misfit, minima(misfit, start_mesh(wear_settings(**NUISANCES), misfit))[0])


@pytest.mark.parametrize("objective", ["complex", "log"])
def test_derivatives_of_the_residual(objective: str) -> None:
    misfit = misfit_of(measured(worn_rig(*TRUTH)), objective=objective, response="dFRF", **NUISANCES)
    here = np.array([30.0, -4.0, 35.0, 49.5])
    jacobian = misfit.jacobian(here)
    for number in range(4):
        step = 1e-4 * np.eye(4)[number]
        difference = (misfit.residual(here + step) - misfit.residual(here - step)) / 2e-4
        np.testing.assert_allclose(jacobian[:, number], difference, atol=2e-4 * np.abs(difference).max())


def test_complex_misfit_is_the_weighted_square_of_the_residual() -> None:
    """2 sum |e|^2 / var by hand, and the priors' squares on top."""
    response = measured(worn_rig(*TRUTH), 0.02)
    misfit = misfit_of(response, **NUISANCES)
    here = np.array([30.0, -4.0, 35.0, 49.0])
    modelled = misfit.model.response(here)[0]
    by_hand = 2 * np.sum(np.abs(modelled - response.matrix) ** 2 / response.variance)
    prior = (35.0 - 0.1044 / 0.003) ** 2 + (49.0 - 50.0) ** 2
    assert misfit.chi2(here) == pytest.approx(by_hand + prior)
    assert misfit.n_prior == 2 and misfit.residual(here).size == 2 * response.matrix.size + 2


@pytest.mark.long
def test_log_misfit_is_the_source_s() -> None:
    """sum log10^2(|H_model| / |H_measured|) over chosen terms."""
    response = measured(worn_rig(*TRUTH))
    misfit = misfit_of(response, objective="log", terms="cross")
    here = np.array([30.0, -4.0])
    ratio = np.abs(misfit.model.response(here)[0] / response.matrix)[:, [0, 1], [1, 0]]
    assert misfit.chi2(here) == pytest.approx(np.sum(np.log10(ratio) ** 2))


def test_a_term_of_zero_has_no_logarithm() -> None:
    response = measured(worn_rig(*TRUTH))
    silent = response.matrix.copy()
    silent[3, 0, 1] = 0
    with pytest.raises(FitError, match=f"a term at {LINES[3]:g} Hz is zero"):
        misfit_of(replace(response, matrix=silent), objective="log", terms="cross")


def test_correlated_priors_weigh_by_their_covariance() -> None:
    covariance = ((9e-6, 4e-9), (4e-9, 3.24e-12))
    known = Gaussian(("viscosity", "clearance"), (0.1044, 90e-6), covariance)
    misfit = misfit_of(measured(worn_rig(*TRUTH)), prior="t", posterior=known)
    here = np.array([22.0, 11.0, 36.0, 50.4])
    off = np.array([36.0 * 3e-3 - 0.1044, 50.4 * 1.8e-6 - 90e-6])
    assert np.sum(misfit.residual(here)[-2:] ** 2) == pytest.approx(off @ np.linalg.inv(covariance) @ off)


def test_starts_are_the_mesh_moved_off_zero_depth() -> None:
    wear = wear_settings(start_depths=(0.0, 30e-6), start_angles=(-0.1, 0.1))
    starts = start_mesh(
        wear, misfit_of(measured(worn_rig()), start_depths=(0.0, 30e-6), start_angles=(-0.1, 0.1))
    )
    np.testing.assert_allclose(starts, [[1, -5.73], [1, 5.73], [30, -5.73], [30, 5.73]], atol=0.001)
    healthy = misfit_of(measured(worn_rig()), healthy=True, **NUISANCES)
    (start,) = start_mesh(wear_settings(healthy=True, **NUISANCES), healthy)
    np.testing.assert_allclose(start, [0.1044 / 0.003, 50.0])


@pytest.mark.parametrize("objective", ["complex", "log"])
@pytest.mark.parametrize("truth", [(22.27, -11.0), (40.19, 8.0)])
def test_wear_is_found_again_without_noise(objective: str, truth: tuple[float, float]) -> None:
    """.01 um and .01 deg from at least ten of twenty starts, films of the truth's own mesh."""
    misfit = misfit_of(measured(worn_rig(*truth)), objective=objective, response="dFRF")
    own = wear_settings(start_depths=WearSettings.start_depths, start_angles=WearSettings.start_angles)
    found = minima(misfit, start_mesh(own, misfit))
    assert sum(one.starts for one in found) == 20
    _, best = refine(misfit, found[0])
    assert best.converged and best.starts >= 10
    np.testing.assert_allclose(best.parameters, truth, atol=0.01)


def test_parameters_that_are_held_do_not_move() -> None:
    misfit = misfit_of(measured(worn_rig(*TRUTH)), **NUISANCES)
    held = descend(misfit, np.array([10.0, 5.0, 34.8, 50.0]), [1, 3])
    assert held.parameters[0] == 10.0 and held.parameters[2] == 34.8 and held.parameters[1] != 5.0
    nothing = descend(misfit, np.array([10.0, 5.0, 34.8, 50.0]), [])
    assert nothing.chi2 == misfit.chi2(nothing.parameters)


def test_minima_at_one_place_are_one() -> None:
    ones = [
        WearMinimum(np.array(p), c, 1, True, 3)
        for p, c in (([20.0, 5.0], 1.0), ([20.05, 5.02], 1.1), ([40.0, 5.0], 2.0))
    ]
    joined = merge(ones)
    assert [one.starts for one in joined] == [2, 1] and joined[0].chi2 == 1.0 and joined[0].evaluations == 6
    # The angle of hardly any wear means nothing.
    shallow = [WearMinimum(np.array(p), 1.0, 1, True, 1) for p in ([0.01, -20.0], [0.03, 14.0])]
    assert len(merge(shallow)) == 1


def test_profile_interval_of_a_nearly_straight_model_is_the_usual_one(
    noisy: tuple[WornMisfit, WearMinimum],
) -> None:
    """Within 15 % of estimate +- 1.96 standard errors, and the misfit increases by 1.96^2 at its ends."""
    misfit, best = noisy
    jacobian = misfit.jacobian(best.parameters)
    errors = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    for number in (0, 1):
        interval = profile_interval(misfit, best, number, float(errors[number]))
        here = best.parameters[number]
        assert interval.low < here < interval.high and not interval.open_low and not interval.open_high
        np.testing.assert_allclose(
            [here - interval.low, interval.high - here], 1.96 * errors[number], rtol=0.15
        )
        for end in (interval.low, interval.high):
            assert profile_distance(misfit, best, {number: end}) == pytest.approx(1.96, abs=0.05)


def test_interval_does_not_depend_on_the_first_guess(noisy: tuple[WornMisfit, WearMinimum]) -> None:
    misfit, best = noisy
    guesses = [profile_interval(misfit, best, 0, guess) for guess in (0.01, 0.3, 30.0)]
    np.testing.assert_allclose([one.low for one in guesses], guesses[0].low, atol=0.03)
    np.testing.assert_allclose([one.high for one in guesses], guesses[0].high, atol=0.03)


def test_joint_region_is_where_chi_square_rises_by_its_quantile(
    noisy: tuple[WornMisfit, WearMinimum],
) -> None:
    misfit, best = noisy
    jacobian = misfit.jacobian(best.parameters)
    outline = joint_region(misfit, best, np.linalg.inv(jacobian.T @ jacobian), directions=8)
    distances = [profile_distance(misfit, best, {0: p[0], 1: p[1]}) for p in outline]
    np.testing.assert_allclose(distances, np.sqrt(stats.chi2.ppf(0.95, 2)), rtol=0.05)


def test_an_interval_ends_at_the_bound_where_nothing_stops_it() -> None:
    misfit = misfit_of(measured(worn_rig(0.0), 0.05, np.random.default_rng(1)))
    misfit, best = healthy_minimum(misfit, WearMinimum(np.array([0.0, 0.0]), 0.0, 1, True, 1))
    angle = profile_interval(misfit, best, 1, 1e4)
    assert (angle.low, angle.high) == (-20, 20) and angle.open_low and angle.open_high
    depth = profile_interval(misfit, best, 0, 1.0)
    assert depth.low == 0 and depth.open_low and 0 < depth.high < 10 and not depth.open_high


def test_probability_of_no_wear_moves_from_one_to_zero() -> None:
    """With noise of 2 %: healthy, hardly worn, worn.

    The same response leaves less uncertainty with less noise.
    """
    found = []
    for depth in (0.0, 2.0, 6.0, 22.0):
        misfit = misfit_of(measured(worn_rig(depth, 5.0), 0.02, np.random.default_rng(8)))
        misfit, best = refine(misfit, minima(misfit, start_mesh(wear_settings(), misfit))[0])
        _, healthy = healthy_minimum(misfit, best)
        found.append(healthy_probability(misfit, best, healthy.chi2))
    assert found[0] > 0.9 and found[2] < 0.05 and found[3] < 1e-10
    assert sorted(found, reverse=True) == found


def test_no_wear_that_is_out_of_the_question_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardly any noise, much wear: the probability is zero, and one film per bearing says so."""
    misfit = misfit_of(measured(worn_rig(*TRUTH), 1e-3, np.random.default_rng(8)))
    misfit, best = refine(misfit, minima(misfit, start_mesh(wear_settings(), misfit))[0])
    refinements: list[bool] = []
    films = WornModel.refine
    monkeypatch.setattr(
        WornModel,
        "refine",
        lambda model, here, slopes=True: refinements.append(slopes) or films(model, here, slopes),
    )
    _, healthy = healthy_minimum(misfit, best)
    assert refinements == [False] and not healthy.converged
    assert healthy.chi2 > best.chi2 + 6000 and healthy_probability(misfit, best, healthy.chi2) == 0


@pytest.mark.long
def test_both_ways_to_the_probability_agree_where_they_meet(noisy: tuple[WornMisfit, WearMinimum]) -> None:
    """Laplace's formula for a narrow peak against a plain sum over a fine mesh around it."""
    misfit, best = noisy
    jacobian = misfit.jacobian(best.parameters)
    errors = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))[:2]
    ticks = np.linspace(-4, 4, 17)
    places = [best.parameters[:2] + errors * [a, b] for a in ticks for b in ticks]
    likelihood = [
        np.exp(-(profile_distance(misfit, best, {0: place[0], 1: place[1]}) ** 2) / 2) for place in places
    ]
    mean = np.sum(likelihood) * (0.5**2 * np.prod(errors)) / (50 * 40)
    assert peak_share(misfit, best) == pytest.approx(mean, rel=0.15)
