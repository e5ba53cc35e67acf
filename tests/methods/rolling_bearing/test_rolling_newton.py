"""The solver's parts: a convex potential whose slope is the residual, steps that descend and stay short,
starts that are good.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.rolling_bearing import equilibrium as rolling_newton
from labpipe.methods.rolling_bearing.equilibrium import (
    EquilibriumProblem,
    line_search,
    newton_step,
    solve,
    starting_point,
)
from labpipe.methods.rolling_bearing.loads import ElementFrame, RollingBearing

KINDS = ("deep_groove", "angular", "taper")


@pytest.fixture(params=KINDS)
def bearing(request: pytest.FixtureRequest) -> RollingBearing:
    return request.getfixturevalue(request.param)


def problem_of(bearing: RollingBearing, loads: np.ndarray) -> EquilibriumProblem:
    return EquilibriumProblem(bearing, ElementFrame.at(bearing.angles(), 1.0), loads, np.arange(5))


@pytest.fixture
def loaded(bearing: RollingBearing, rng: np.random.Generator) -> EquilibriumProblem:
    return problem_of(bearing, rng.normal(scale=300, size=(40, 5)))


def positions(rng: np.random.Generator, n_case: int = 40) -> np.ndarray:
    return rng.normal(scale=3e-5, size=(n_case, 5))


def test_the_residual_is_the_slope_of_the_potential(loaded: EquilibriumProblem, rng) -> None:
    """dPhi/du along a random direction by central differences."""
    u, direction, step = positions(rng), rng.normal(size=(40, 5)), 1e-9
    slope = (loaded.at(u + step * direction).potential - loaded.at(u - step * direction).potential) / (
        2 * step
    )
    expected = -np.einsum("nf,nf->n", loaded.at(u).residual, direction)
    np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-2)


def test_the_potential_is_convex(loaded: EquilibriumProblem, rng) -> None:
    """Phi at the middle of any two positions lies below the mean of their values."""
    here, there = positions(rng), 5 * positions(rng)
    middle = loaded.at((here + there) / 2).potential
    assert np.all(middle <= (loaded.at(here).potential + loaded.at(there).potential) / 2 + 1e-15)


def test_steps_descend_and_are_no_longer_than_the_reach(loaded: EquilibriumProblem, rng) -> None:
    trial = loaded.at(positions(rng))
    step = newton_step(loaded, trial)
    assert np.all(np.einsum("nf,nf->n", trial.residual, step) > 0)
    assert np.all(np.linalg.norm(step, axis=1) <= loaded.bearing.reach * (1 + 1e-9))


def test_where_nothing_resists_the_step_is_the_reach_along_the_load(deep_groove: RollingBearing) -> None:
    problem = problem_of(deep_groove, np.array([[0.0, 0.0, 30.0, 0.0, 40.0]]))
    step = newton_step(problem, problem.at(np.zeros((1, 5))))
    np.testing.assert_allclose(
        step, deep_groove.reach * np.array([[0, 0, 0.6, 0, 0.8]]), rtol=1e-9, atol=1e-18
    )


def test_the_line_search_lowers_the_potential(loaded: EquilibriumProblem, rng) -> None:
    """Also from far away, where the full step overshoots by far."""
    for far in (1.0, 10.0):
        trial = loaded.at(far * positions(rng))
        landed = loaded.at(line_search(loaded, trial, newton_step(loaded, trial)))
        assert np.all(landed.potential < trial.potential)


def test_a_step_that_overshoots_is_cut(deep_groove: RollingBearing) -> None:
    problem = problem_of(deep_groove, np.array([[100.0, 0.0, 0.0, 0.0, 0.0]]))
    trial = problem.at(np.zeros((1, 5)))
    step = np.array([[1e-3, 0.0, 0.0, 0.0, 0.0]])
    landed = line_search(problem, trial, step)[0, 0]
    exact = (
        100 / (deep_groove.stiffness_constant * np.sum(np.maximum(np.cos(deep_groove.angles()), 0) ** 2.5))
    ) ** (2 / 3)
    assert 0 < landed < 3 * exact < 1e-3


def test_held_dofs_stay_where_they_are(deep_groove: RollingBearing) -> None:
    held = np.array([[0.0, 0.0, 2e-5, 0.0, -1e-5]])
    problem = EquilibriumProblem(
        deep_groove,
        ElementFrame.at(deep_groove.angles(), 1.0),
        np.array([[300.0, 0, 0, 0, 0]]),
        np.array([0, 1, 3]),
    )
    u, solved = solve(problem, held)
    assert solved.all() and np.all(u[0, [2, 4]] == held[0, [2, 4]]) and u[0, 0] > 0


@pytest.mark.parametrize("force", [1e-3, 1.0, 1e3, 2e4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_axial_start_is_near_the_axial_solution(
    bearing: RollingBearing, force: float, side: float
) -> None:
    if not bearing.is_ball and side < 0:
        return
    loads = np.array([[0.0, 0.0, side * force, 0.0, 0.0]])
    problem = (
        problem_of(bearing, loads)
        if bearing.is_ball
        else EquilibriumProblem(bearing, problem_of(bearing, loads).frame, loads, np.arange(3))
    )
    start = starting_point(problem, np.zeros((1, 5)))
    u, solved = solve(problem, np.zeros((1, 5)))
    assert solved.all() and start[0, 2] == pytest.approx(u[0, 2], rel=0.12)


@pytest.mark.long
def test_a_dozen_steps_as_a_rule(deep_groove: RollingBearing, mixed_loads, rng, monkeypatch) -> None:
    """Median and worst number of steps of single load cases, 1 N to 20 kN in every mix."""
    counts = []
    taken = [0]

    def counted(problem: EquilibriumProblem, trial: rolling_newton.Trial) -> np.ndarray:
        taken[0] += 1
        return newton_step(problem, trial)

    monkeypatch.setattr(rolling_newton, "newton_step", counted)
    scale = np.array([1, 1, 1, deep_groove.pitch_radius, deep_groove.pitch_radius])
    for load in mixed_loads(deep_groove, rng, 150):
        taken[0] = 0
        _, solved = solve(problem_of(deep_groove, (load / scale)[None]), np.zeros((1, 5)))
        assert solved.all()
        counts.append(taken[0])
    assert np.median(counts) <= 14 and max(counts) <= 40


def test_cases_are_solved_independently(deep_groove: RollingBearing) -> None:
    """An impossible load beside a possible one spoils neither answer."""
    loads = np.array([[1e13, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 500.0, 0.0, 0.0]])
    u, solved = solve(problem_of(deep_groove, loads), np.zeros((2, 5)))
    alone, _ = solve(problem_of(deep_groove, loads[1:]), np.zeros((1, 5)))
    assert list(solved) == [False, True]
    np.testing.assert_allclose(u[1], alone[0], rtol=1e-9, atol=1e-18)
