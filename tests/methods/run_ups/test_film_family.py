"""The physical family of coefficients: slopes, scaling laws, the combination that no run-up sees."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.run_ups.rotor import (
    PARAMETERS,
    PRIOR,
    FilmFamily,
    as_eight,
    as_matrices,
    coefficient_errors,
    extend_over_speed,
)
from tests.methods.run_ups.run_up_cases import RIG

FAMILY = FilmFamily(RIG.place.bearing, 150.0, 6.0)
LOAD = np.array([3.7, 5.0, 10.0])
SPEED = np.array([80.0, 150.0, 260.0])


def test_all_zero_is_the_rotor_file_s_bearing() -> None:
    found = FAMILY.coefficients(np.zeros(12), LOAD, SPEED)
    expected = [
        as_eight(*RIG.start_coefficients(load, np.array([speed])))[0]
        for load, speed in zip(LOAD, SPEED, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_slopes_equal_differences(rng: np.random.Generator) -> None:
    values = 0.5 * PRIOR * rng.standard_normal(12)
    own, slopes = FAMILY.coefficients_and_slopes(values, LOAD, SPEED)
    np.testing.assert_allclose(own, FAMILY.coefficients(values, LOAD, SPEED))
    for n in range(len(PARAMETERS)):
        step = 1e-5 * np.eye(12)[n]
        difference = (
            FAMILY.coefficients(values + step, LOAD, SPEED) - FAMILY.coefficients(values - step, LOAD, SPEED)
        ) / 2e-5
        np.testing.assert_allclose(slopes[..., n], difference, rtol=1e-5, atol=1e-6 * np.abs(own).max())


def test_viscosity_and_clearance_are_those_of_another_bearing() -> None:
    """exp(.2) times the viscosity and exp(.1) times the clearance, tabulated as such."""
    values = np.array([0.2, 0, 0, 0.1, *[0.0] * 8])
    own = RIG.place.bearing
    bearing = dataclasses.replace(
        own, viscosity=own.viscosity * np.exp(0.2), clearance=own.clearance * np.exp(0.1)
    )
    other = dataclasses.replace(RIG, place=dataclasses.replace(RIG.place, bearing=bearing))
    np.testing.assert_allclose(
        FAMILY.coefficients(values, 5.0, SPEED), as_eight(*other.start_coefficients(5.0, SPEED)), rtol=1e-10
    )


def test_clearance_with_viscosity_and_all_factors_changes_nothing() -> None:
    """mu / c^2 and factor / c kept: the reason why the data have rank 11 of 12."""
    values = np.array([0.2, 0, 0, 0.1, *[0.1] * 8])
    np.testing.assert_allclose(
        FAMILY.coefficients(values, LOAD, SPEED), FAMILY.coefficients(np.zeros(12), LOAD, SPEED), rtol=1e-12
    )


def test_at_a_load_it_is_a_function_of_speed() -> None:
    stiffness, damping = FAMILY.at_load(np.zeros(12), 5.0)(SPEED)
    expected = RIG.start_coefficients(5.0, SPEED)
    np.testing.assert_allclose(stiffness, expected[0], rtol=1e-12)
    np.testing.assert_allclose(damping, expected[1], rtol=1e-12)


def test_eight_and_matrices_are_inverse(rng: np.random.Generator) -> None:
    eight = rng.standard_normal((5, 8))
    stiffness, damping = as_matrices(eight)
    assert stiffness[2, 0, 1] == eight[2, 1] and damping[2, 1, 0] == eight[2, 6]
    np.testing.assert_array_equal(as_eight(stiffness, damping), eight)


def test_errors_are_parts_of_each_coefficient_s_own_rms() -> None:
    true = np.array([[3.0] * 8, [4.0] * 8])
    np.testing.assert_allclose(coefficient_errors(true * 1.1, true), 0.1)


def test_far_from_the_table_nothing_is_guessed() -> None:
    with pytest.raises(FitError, match="outside the bearing's table"):
        FAMILY.coefficients(np.array([-8.0, *[0.0] * 11]), LOAD, SPEED)


def test_a_threshold_beyond_the_known_speeds_is_near_the_film_s() -> None:
    """Coefficients known up to 300 rad/s, threshold at some 347: with K and Omega C held within 2 %, with C
    itself held there is none.
    """
    film = RIG.start(10.3)

    def known(speed: np.ndarray) -> np.ndarray:
        return as_eight(*film(speed))

    true = RIG.threshold(film)
    found = RIG.threshold(extend_over_speed(known, 50.0, 300.0))
    assert true is not None and found is not None
    assert true > 300 and abs(found / true - 1) < 0.02
    assert RIG.threshold(lambda speed: film(np.minimum(speed, 300.0))) is None


def test_within_the_known_speeds_nothing_changes_and_beyond_k_and_omega_c_are_held() -> None:
    film = RIG.start(6.0)
    carried = extend_over_speed(lambda one: as_eight(*film(one)), 50.0, 300.0)
    speed = np.array([80.0, 250.0, 25.0, 400.0])
    expected = as_eight(*film(np.clip(speed, 50, 300))) * np.where(
        np.arange(8) < 4, 1.0, [[1.0], [1.0], [2.0], [0.75]]
    )
    np.testing.assert_allclose(as_eight(*carried(speed)), expected)
