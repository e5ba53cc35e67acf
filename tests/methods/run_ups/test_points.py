"""Coefficients per load and speed: against scipy's bounded least squares, with a shaker against the truth,
ridge and bounds.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares

from labpipe.errors import DataError
from labpipe.methods.run_ups.methods import PointFit, fit_points
from labpipe.methods.run_ups.misfit import ExcitedRun, runs_by_load, scales
from labpipe.methods.run_ups.rotor import as_eight
from labpipe.methods.run_ups.virtual_rig import run_ups, true_coefficients
from tests.methods.run_ups.run_up_cases import RIG, trained, virtual


def chi2_per_datum(fit: PointFit) -> float:
    return fit.chi2 / (fit.n_datum - fit.n_effective)


@pytest.mark.long
def test_every_point_is_the_minimum_that_scipy_finds() -> None:
    """The trust-region reflective method of scipy on the same sum of squares, point by point, with bounds
    that some points meet.
    """
    run = trained("outside")[1]
    found = fit_points(RIG, [run], bound=0.04)[0]
    assert 0.05 < np.mean(found.at_bound) < 0.8
    for n in (0, 9, 20):
        part = dataclasses.replace(
            run,
            **{
                name: getattr(run, name)[n : n + 1]
                for name in ("speed", "response", "amplitude_error", "phase_error")
            },
        )
        excited, start = ExcitedRun.of(RIG, part), found.start[n]
        unit = scales(start)

        def residual(parts: np.ndarray, excited=excited, start=start, unit=unit) -> np.ndarray:  # type: ignore[no-untyped-def]
            return np.concatenate(
                [excited.residual_and_slopes((start + unit * parts)[None])[0][0], parts / 0.15]
            )

        expected = least_squares(
            residual, np.zeros(8), bounds=(-0.04, 0.04), xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        ours = (found.coefficients[n] - start) / unit
        assert np.sum(residual(ours) ** 2) <= 2 * expected.cost * (1 + 1e-6)
        np.testing.assert_allclose(ours, expected.x, atol=2e-4)


def test_the_fit_is_perfect_and_the_coefficients_are_not_determined() -> None:
    """Rank 4 at every point and chi-square near one, while the standard deviations say that the start values
    decide.
    """
    truth = virtual("factors")
    for found in fit_points(RIG, trained("factors")):
        assert set(found.rank.tolist()) == {4}
        assert 0.6 < chi2_per_datum(found) < 1.5
        true = as_eight(*true_coefficients(truth, found.load)(found.speed))
        better, before = (
            np.sqrt(np.mean(((one - true) / scales(found.start)) ** 2))
            for one in (found.coefficients, found.start)
        )
        assert better < before < 0.15
        parts = found.std_error / scales(found.start)
        assert np.nanmedian(parts) > 0.05


def test_standard_deviations_cover_the_truth_within_the_ridge() -> None:
    """Factors of .72 to 1.27 have a standard deviation of about the ridge: two standard deviations hold the
    truth nearly always.
    """
    truth = virtual("factors")
    inside = []
    for found in fit_points(RIG, trained("factors")):
        true = as_eight(*true_coefficients(truth, found.load)(found.speed))
        inside.append((np.abs(found.coefficients - true) < 2 * found.std_error).ravel())
    assert np.mean(np.concatenate(inside)) > 0.9


def test_with_a_shaker_all_eight_follow_the_truth() -> None:
    rig = virtual("factors", "shaker=true")
    runs = run_ups(rig, 1, ["load-2", "load-2-shaker"])
    found, alone = fit_points(RIG, runs)[0], fit_points(RIG, runs[:1])[0]
    assert set(found.rank.tolist()) == {8}
    true = as_eight(*true_coefficients(rig, found.load)(found.speed))
    error = (found.coefficients - true) / scales(found.start)
    assert np.median(np.abs(error)) < 0.035
    assert np.nanmedian(found.std_error / alone.std_error) < 0.7
    missed = (found.coefficients - true) / found.std_error
    assert 0.8 < np.sqrt(np.nanmean(missed**2)) < 1.3


def test_a_strong_ridge_keeps_the_start_values() -> None:
    found = fit_points(RIG, trained("outside")[:1], ridge=1e-6)[0]
    np.testing.assert_allclose(found.coefficients, found.start, rtol=1e-3)
    assert found.n_effective < 0.01 * found.n_datum
    assert chi2_per_datum(found) > 10


def test_at_a_bound_there_is_no_standard_error() -> None:
    found = fit_points(RIG, trained("outside")[:1], bound=0.03)[0]
    assert np.mean(found.at_bound) > 0
    np.testing.assert_array_equal(np.isnan(found.std_error), found.at_bound)
    assert np.all(np.abs(found.coefficients - found.start) <= 0.03 * scales(found.start) * (1 + 1e-9))


def test_between_the_points_it_goes_straight() -> None:
    """Beyond them K and Omega C are held."""
    found = fit_points(RIG, trained("outside")[:1])[0]
    middle = (found.speed[3] + found.speed[4]) / 2
    stiffness, damping = found.at_speed()(np.array([middle, 1e4]))
    last = found.coefficients[-1] * np.repeat([1, found.speed[-1] / 1e4], 4)
    np.testing.assert_allclose(as_eight(stiffness, damping), [found.coefficients[3:5].mean(axis=0), last])


def test_runs_of_one_load_meet_at_the_speeds_they_share() -> None:
    first, second = trained("outside")[:1] * 2
    part = slice(3, 9)
    second = dataclasses.replace(
        second,
        **{
            name: getattr(second, name)[part]
            for name in ("speed", "response", "amplitude_error", "phase_error")
        },
    )
    group = runs_by_load(RIG, [first, second])[0]
    np.testing.assert_allclose(group.speed, first.speed[part])
    assert len(group.runs) == 2
    aside = dataclasses.replace(second, speed=second.speed * 1.01)
    with pytest.raises(DataError, match="share no speed"):
        runs_by_load(RIG, [first, aside])


def test_slopes_of_the_weighted_residual_equal_differences(rng: np.random.Generator) -> None:
    excited = ExcitedRun.of(RIG, trained("outside")[0])
    eight = as_eight(*RIG.start_coefficients(excited.run.load, excited.run.speed))
    _, slopes = excited.residual_and_slopes(eight)
    direction = rng.standard_normal(eight.shape) * scales(eight) * 1e-5
    ends = [excited.residual_and_slopes(eight + sign * direction)[0] for sign in (1, -1)]
    difference = ends[0] - ends[1]
    np.testing.assert_allclose((slopes @ direction[..., None])[..., 0], difference / 2, rtol=1e-4, atol=1e-6)


def test_nothing_to_fit_is_refused() -> None:
    with pytest.raises(DataError, match="no run-up"):
        fit_points(RIG, [])
