"""The mesh of the oil films as a part of a wear's uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.methods.journal_bearing.bearing import journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.wear.model import WornMisfit
from labpipe.methods.wear.search import (
    Interval,
    WearMinimum,
    descend,
    film_covariance,
    minima,
    refine,
    widen,
    widened_region,
)
from labpipe.methods.wear.tables import table_range, tabulate
from tests.methods.wear.worn_cases import (
    COARSE,
    FINE,
    NUISANCES,
    RIG,
    fit_settings,
    measured,
    misfit_of,
    worn_rig,
)

VALUES = {"wear_depth": 30e-6, "wear_angle": 0.1, "viscosity": 0.1044, "clearance": 90e-6}


@pytest.fixture(scope="module")
def minimum() -> tuple[WornMisfit, WearMinimum]:
    """Wear of 30 um without noise, weighted as with 1 %."""
    response = measured(worn_rig(30.0, 8.0))
    assert response.covariance is not None
    misfit = misfit_of(replace(response, covariance=1e8 * response.covariance), **NUISANCES)
    return refine(misfit, minima(misfit, [np.array([30.0, 8.0, 34.8, 50.0])])[0])


def noise_of(misfit: WornMisfit, parameters: np.ndarray) -> np.ndarray:
    jacobian = misfit.jacobian(parameters)
    return np.linalg.inv(jacobian.T @ jacobian)


@pytest.mark.long
def test_the_covariance_is_the_shift_of_the_estimate(minimum: tuple[WornMisfit, WearMinimum]) -> None:
    """Every film moved by its mesh's error and the wear estimated again: outer products of the shifts, 10 %
    for the bend of the model.
    """
    misfit, best = minimum
    films = film_covariance(misfit, best.parameters, noise_of(misfit, best.parameters))
    shifts = [
        descend(replace(misfit, model=model, _last=None), best.parameters).parameters - best.parameters
        for model in misfit.model.with_mesh_error(best.parameters)
    ]
    expected = sum(np.outer(shift, shift) for shift in shifts)
    assert len(shifts) == 2
    np.testing.assert_allclose(np.sqrt(np.diag(films)), np.sqrt(np.diag(expected)), rtol=0.1)


@pytest.mark.long
def test_the_mesh_error_is_a_third_of_the_change_from_half_the_cells() -> None:
    """And of the size of the error that a far finer film shows."""
    place, load = RIG.bearings[1], RIG.static_loads()["bearing 2"]
    bearing = tabulate(place, load, RIG.omega, True, table_range(50e-6, 0.3), FilmMesh(*COARSE))
    error = bearing.mesh_error(VALUES, FINE)
    worn = replace(place.film("a test"), **VALUES)
    fine, half, finest = (
        journal_equilibrium(worn, load, RIG.omega, mesh)
        for mesh in (FINE, FilmMesh(96, 8), FilmMesh(384, 64))
    )
    np.testing.assert_allclose(error[0], (fine.stiffness - half.stiffness) / 3, rtol=1e-6)
    np.testing.assert_allclose(error[1], (fine.damping - half.damping) / 3, rtol=1e-6)
    true = np.linalg.norm(fine.stiffness - finest.stiffness)
    assert 0.3 * true < np.linalg.norm(error[0]) < 3 * true


@pytest.mark.long
def test_a_shifted_bearing_has_other_coefficients_and_the_same_slopes() -> None:
    place, load = RIG.bearings[1], RIG.static_loads()["bearing 2"]
    change = np.arange(8.0).reshape(2, 2, 2)
    for worn, ranges in ((True, table_range(50e-6, 0.3, 1.05, 1.05)), (False, table_range(50e-6, 0.3))):
        bearing = tabulate(place, load, RIG.omega, worn, ranges, FilmMesh(24, 4)).refine(
            VALUES if worn else {}, FilmMesh(96, 16), False
        )
        before, after = (one.support(VALUES, ("wear_depth",)) for one in (bearing, bearing.shift(change)))
        np.testing.assert_allclose(after.support.stiffness - before.support.stiffness, change[0], atol=1e-6)
        np.testing.assert_allclose(after.support.damping - before.support.damping, change[1], atol=1e-6)
        np.testing.assert_array_equal(after.stiffness_slopes, before.stiffness_slopes)


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        (Interval(7.0, 16.0, False, False), Interval(5.0, 10 + np.hypot(6, 4), False, False)),
        (Interval(0.0, 13.0, True, False), Interval(0.0, 15.0, True, False)),
        (Interval(5.5, 13.0, False, True), Interval(10 - np.hypot(4.5, 4), 13.0, False, True)),
        (Interval(7.0, 29.9, False, False), Interval(5.0, 30.0, False, True)),
        (Interval(0.1, 13.0, False, False), Interval(0.0, 15.0, True, False)),
    ],
)
def test_half_widths_add_by_their_squares_within_the_bounds(interval: Interval, expected: Interval) -> None:
    found = widen(interval, 10.0, 4.0, 0.0, 30.0)
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high])
    assert (found.open_low, found.open_high) == (expected.open_low, expected.open_high)


def test_a_region_of_the_noise_becomes_one_of_both() -> None:
    """An ellipse of one covariance turns into that of the sum."""
    noise, film, best = (
        np.array([[4.0, 1.0], [1.0, 2.0]]),
        np.array([[1.0, -2.0], [-2.0, 4.0]]),
        np.array([3.0, -1.0]),
    )
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    outline = best + (np.linalg.cholesky(noise) @ np.stack([np.cos(turns), np.sin(turns)])).T
    wide = widened_region(outline, best, noise, film) - best
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", wide, np.linalg.inv(noise + film), wide), 1.0)


@pytest.mark.long
def test_little_noise_leaves_the_uncertainty_of_the_films() -> None:
    """With a hundredth of the noise the standard error does not become a hundredth."""
    rng = np.random.default_rng(4)
    quiet, loud = (
        identify(measured(worn_rig(30.0, 8.0), noise, rng), fit_settings())[0] for noise in (1e-4, 1e-2)
    )
    errors = [fit.parameter("wear_depth").std_error for fit in (quiet, loud)]
    assert errors[0] is not None and errors[1] is not None and 0.02 * errors[1] < errors[0] < errors[1]
    low, high = quiet.parameter("wear_depth").ci95 or (np.nan, np.nan)
    assert 1.8 * errors[0] < (high - low) / 2 < 2.2 * errors[0]
