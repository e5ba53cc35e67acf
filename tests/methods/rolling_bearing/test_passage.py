"""Mean and range over one ball passage."""

from __future__ import annotations

import math

import numpy as np
import pytest

from labpipe.methods.rolling_bearing.bearing import ball_passage
from labpipe.methods.rolling_bearing.equilibrium import equilibrium
from labpipe.methods.rolling_bearing.loads import RollingBearing
from tests.methods.rolling_bearing.displaced_rings import load_vector


def test_positions_equal_the_single_solutions(deep_groove: RollingBearing) -> None:
    loads = np.array([load_vector(y=-200.0, z=50.0), load_vector(x=900.0)])
    passage = ball_passage(deep_groove, loads, positions=6)
    assert passage.stiffness.shape == (6, 2, 5, 5)
    for n, angle in enumerate(passage.cage_angle):
        alone = equilibrium(deep_groove, loads, cage_angle=angle)
        np.testing.assert_allclose(passage.stiffness[n], alone.stiffness, rtol=1e-7, atol=1)


def test_an_axial_load_sees_no_passage(deep_groove: RollingBearing, angular: RollingBearing) -> None:
    """All elements alike: K_xx = sum k cos^2 psi does not depend on the cage for three elements and more."""
    for bearing in (deep_groove, angular):
        passage = ball_passage(bearing, load_vector(z=500.0))
        np.testing.assert_allclose(np.diag(passage.lowest[0]), np.diag(passage.highest[0]), rtol=1e-9)


def test_a_radial_load_swings_between_a_ball_below_and_a_gap_below() -> None:
    """Closed form with the tilt, y and z held: F = K_n dx^1.5 sum cos^2.5, K = 1.5 F / dx at either
    position.
    """
    bearing = RollingBearing(7, 1e10, 30e-3, groove_distance=6e-4)
    passage = ball_passage(bearing, load_vector(x=800.0), fixed_dofs=("y", "z", "bx", "by"), positions=2)
    ends = []
    for n, angle in enumerate((0.0, math.pi / 7)):
        lobes = np.sum(np.maximum(np.cos(bearing.angles(angle)), 0) ** 2.5)
        dx = (800 / (1e10 * lobes)) ** (2 / 3)
        assert passage.cage_angle[n] == pytest.approx(angle)
        ends.append(1.5 * 800 / dx)
        assert passage.stiffness[n, 0, 0, 0] == pytest.approx(ends[n], rel=1e-9)
    assert (passage.lowest[0, 0, 0], passage.highest[0, 0, 0]) == pytest.approx(sorted(ends), rel=1e-9)


def test_the_passage_repeats_after_one_element(deep_groove: RollingBearing) -> None:
    load, step = load_vector(y=-300.0, z=80.0), 2 * math.pi / 9
    here, next_one = (
        equilibrium(deep_groove, load, cage_angle=angle).stiffness for angle in (0.1, 0.1 + step)
    )
    np.testing.assert_allclose(next_one, here, rtol=1e-8, atol=1e-2)


def test_mean_and_range_settle_with_few_positions(deep_groove: RollingBearing) -> None:
    few, many = (ball_passage(deep_groove, load_vector(y=-300.0, z=80.0), positions=n) for n in (24, 96))
    pairs = [(few.stiffness.mean(axis=0), many.stiffness.mean(axis=0))]
    for ours, theirs in (*pairs, (few.lowest, many.lowest), (few.highest, many.highest)):
        np.testing.assert_allclose(np.diag(ours[0]), np.diag(theirs[0]), rtol=2e-3)
