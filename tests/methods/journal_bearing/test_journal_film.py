"""The film's equations: rounding of the maximum, the banded solver against dense algebra, the linearisation
against differences.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.journal_bearing.bearing import film_equilibrium
from labpipe.methods.journal_bearing.film import (
    LEAST_SLOPE,
    Film,
    FilmMesh,
    band_room,
    factorise,
    film_equations,
    film_grid,
    interpolation,
    mean_worn_depth,
    rounded_maximum,
)
from tests.methods.journal_bearing.film_force import held_force, held_pressure

MESH = FilmMesh(48, 8)


def dense_operator(film: Film, equations) -> np.ndarray:  # type: ignore[no-untyped-def]
    """A + diagonal written out cell by cell: the readable twin of the banded solver."""
    n, m = equations.diagonal.shape
    matrix = np.diag(equations.diagonal.ravel())
    for i in range(n):
        for j in range(m):
            here, after = i * m + j, (i + 1) % n * m + j
            matrix[[here, after], [here, after]] += equations.around[i]
            matrix[[here, after], [after, here]] -= equations.around[i]
            matrix[here, i * m : (i + 1) * m] += equations.across[i] * film.grid.curvature[j]
    return matrix


@pytest.mark.parametrize(("cavitation", "folded"), [(0.0, False), (-10.0, True)])
def test_banded_factors_equal_dense_algebra(
    rng: np.random.Generator, cavitation: float, folded: bool
) -> None:
    film = Film(MESH, 1.7, 0.3, 0.2, cavitation)
    pressure = np.full((48, 4), cavitation) if not folded else rng.uniform(0, 0.1, (48, 4))
    equations = film_equations(film, np.array([0.2, -0.3]), np.zeros(2), pressure)
    factors = factorise(equations, film.grid.curvature, band_room(MESH))
    assert (factors.columns.size == 48) == folded
    sides = np.concatenate([equations.residual[None], equations.by_displacement])
    sides[:, equations.cavitated] = 0
    expected = np.linalg.solve(dense_operator(film, equations), sides.reshape(3, -1).T).T.reshape(sides.shape)
    np.testing.assert_allclose(factors.solve(sides), expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_a_film_that_is_not_positive_definite_is_refused() -> None:
    film = Film(MESH, 1.7)
    equations = film_equations(film, np.array([0.0, -1.5]), np.zeros(2), np.zeros((48, 4)))
    with pytest.raises(FitError, match="singular"):
        factorise(equations, film.grid.curvature, band_room(MESH))


@pytest.mark.parametrize("axis", [0, 1])
def test_residual_slopes_equal_differences(rng: np.random.Generator, axis: int) -> None:
    """In flowing, cavitated and front cells alike: d residual / d displacement = by_displacement where the
    residual is zero.
    """
    film = Film(MESH, 1.7, 0.4, 0.3, -0.001)
    state = film_equilibrium(film, np.array([0.004, -0.03]))
    step = 1e-6 * np.eye(2)[axis]
    plus, minus = (
        film_equations(film, state.displacement + s, np.zeros(2), state.pressure) for s in (step, -step)
    )
    here = film_equations(film, state.displacement, np.zeros(2), state.pressure)
    assert np.count_nonzero((here.diagonal > 0) & ~here.cavitated) > 10
    moving = ~here.cavitated
    difference = (plus.residual - minus.residual)[moving] / 2e-6
    expected = here.by_displacement[axis][moving]
    assert np.max(np.abs(difference - expected)) < 2e-4 * np.max(np.abs(expected))


def test_rounded_maximum_is_exact_outside_and_its_slopes_are_its_derivatives() -> None:
    x = np.linspace(-2, 2, 401)
    largest, slope, by_width = rounded_maximum(x, np.array(0.5))
    outside = np.abs(x) >= 0.5
    np.testing.assert_allclose(largest[outside], np.maximum(x, 0)[outside], atol=1e-15)
    plus, minus = (rounded_maximum(x + h, np.array(0.5))[0] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(slope, np.maximum((plus - minus) / 2e-6, LEAST_SLOPE), atol=1e-8)
    plus, minus = (rounded_maximum(x, np.array(0.5 + h))[0] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(by_width[~outside], ((plus - minus) / 2e-6)[~outside], atol=1e-8)


def test_complementarity_holds_in_the_solved_film() -> None:
    """Away from the rounded front a cell is either at the cavitation pressure or carries without surplus."""
    film = Film(FilmMesh(120, 16), 1.7, 0.25, 0.19, -0.002)
    state = film_equilibrium(film, np.array([0.0, -0.03]))
    equations = film_equations(film, state.displacement, np.zeros(2), state.pressure)
    gap = state.pressure + 0.002
    assert gap.min() > -1e-12
    np.testing.assert_allclose(gap[equations.cavitated], 0, atol=1e-10)
    flowing = equations.diagonal == 0
    assert np.mean(flowing | equations.cavitated) > 0.3
    assert np.max(np.abs(equations.residual[flowing])) < 1e-5


def test_coarser_meshes_and_a_neighbour_lead_to_the_same_state() -> None:
    film, load = Film(FilmMesh(96, 16), 1.7, 0.45, 0.14), np.array([0.0, -0.035])
    cold = film_equilibrium(film, load)
    warm = film_equilibrium(film, load, film_equilibrium(Film(FilmMesh(96, 16), 1.7, 0.40, 0.10), load))
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=1e-7)
    np.testing.assert_allclose(warm.stiffness, cold.stiffness, rtol=1e-4)
    assert warm.steps < 9


def test_a_far_neighbour_of_many_cells_is_left_by_way_of_half_the_cells() -> None:
    """Wear that divides the film against none: the front moves over many cells, which takes 14 steps on the
    cells themselves.
    """
    mesh, load = FilmMesh(240, 60), np.array([0.0, -0.035])
    healthy, worn = Film(mesh, 1.7), Film(mesh, 1.7, 0.3, 0.15)
    cold, neighbour = film_equilibrium(healthy, load), film_equilibrium(worn, load)
    near, plain = (
        film_equilibrium(healthy, load, start)
        for start in (neighbour, dataclasses.replace(neighbour, coarse=None))
    )
    assert near.steps <= 6 < plain.steps
    for state in (near, plain):
        np.testing.assert_allclose(state.displacement, cold.displacement, atol=1e-7)
        np.testing.assert_allclose(state.stiffness, cold.stiffness, atol=1e-5 * np.abs(cold.stiffness).max())


def test_a_start_moved_as_two_neighbours_differ_is_nearer() -> None:
    """The fourth corner of a parallelogram in load and angle: its start lies nearer than either neighbour."""
    films, loads = (
        [Film(MESH, 1.7, 0.3, angle) for angle in (0.1, 0.16)],
        [np.array([0.0, -w]) for w in (0.03, 0.031)],
    )
    states = [[film_equilibrium(film, load) for load in loads] for film in films]
    start, end = states[1][0].move(states[0][0], states[0][1]), states[1][1]
    distances = [
        np.abs(one.displacement - end.displacement).max() for one in (start, states[1][0], states[0][1])
    ]
    assert distances[0] < 0.2 * min(distances[1:])


def test_a_neighbour_that_is_none_does_no_harm() -> None:
    """Started from a state with the journal outside the bore, the film is found all the same."""
    film, load = Film(MESH, 1.7, 0.45, 0.14), np.array([0.0, -0.035])
    cold = film_equilibrium(film, load)
    lost = dataclasses.replace(cold, displacement=np.array([0.0, 1.2]))
    np.testing.assert_array_equal(film_equilibrium(film, load, lost).displacement, cold.displacement)


def test_the_film_around_a_held_journal_is_that_of_the_equilibrium() -> None:
    film = Film(MESH, 1.7, 0.3, 0.1)
    state = film_equilibrium(film, np.array([0.0, -0.03]))
    still, moves = np.zeros(2), 1e-4 * np.eye(2)

    def force(change: np.ndarray, motion: np.ndarray) -> np.ndarray:
        return held_force(film, state.displacement + change, motion)

    np.testing.assert_allclose(force(still, still), [0, 0.03], atol=1e-8)
    stiffness = np.transpose([(force(-move, still) - force(move, still)) / 2e-4 for move in moves])
    damping = np.transpose([(force(still, -move) - force(still, move)) / 2e-4 for move in moves])
    np.testing.assert_allclose(state.stiffness, stiffness, atol=1e-4 * np.abs(stiffness).max())
    np.testing.assert_allclose(state.damping, damping, atol=1e-4 * np.abs(damping).max())


def test_too_heavy_a_load_is_said() -> None:
    with pytest.raises(FitError, match=r"no equilibrium|singular"):
        film_equilibrium(Film(MESH, 1.7), np.array([0.0, -1e7]))


def test_worn_depth_by_hand() -> None:
    """At the bottom the wear is its depth; half way up the bore there is none, nor beyond the edges at
    arccos(1 - depth) from the deepest point. The mean over an arc keeps the volume.
    """
    theta = np.deg2rad([270.0, 280.0, 90.0])
    np.testing.assert_allclose(
        mean_worn_depth(theta, 0.4, 0.0, 1e-4), [0.4, 0.4 - 1 + np.cos(np.deg2rad(10)), 0], atol=1e-9
    )
    edges = np.deg2rad(290) + np.arccos(0.6) * np.array([-1, 1])
    inside, outside = (edges + step * np.array([1, -1]) for step in (1e-3, -1e-3))
    assert mean_worn_depth(inside, 0.4, np.deg2rad(20), 1e-4).min() > 0
    assert np.all(mean_worn_depth(outside, 0.4, np.deg2rad(20), 1e-4) == 0)
    centre = film_grid(FilmMesh(720, 4)).centre
    arc = 2 * np.pi / 720
    mean = mean_worn_depth(centre, 0.4, 0.3, arc)
    half = np.arccos(0.6)
    np.testing.assert_allclose(mean.sum() * arc, 2 * (np.sin(half) - 0.6 * half), rtol=1e-12)
    deep = np.maximum(0.0, 0.4 - 1 - np.cos(centre - np.pi / 2 - 0.3))
    np.testing.assert_allclose(mean, deep, atol=3e-3)
    assert np.all(mean_worn_depth(centre, 0.0, 0.3, arc) == 0)
    assert mean.min() >= 0


@pytest.mark.parametrize(("around", "across"), [(23, 8), (48, 7), (20, 8), (48, 2)])
def test_meshes_that_cannot_be_solved_are_refused(around: int, across: int) -> None:
    with pytest.raises(ConfigError, match="cannot be solved"):
        FilmMesh(around, across)


def test_interpolation_keeps_constants_and_closes_the_ring() -> None:
    coarse, fine = FilmMesh(24, 4), FilmMesh(48, 8)
    around, across = interpolation(coarse, fine)
    np.testing.assert_allclose(around.sum(axis=1), 1)
    np.testing.assert_allclose(across.sum(axis=0), 1)
    smooth = around @ np.cos(film_grid(coarse).centre)
    np.testing.assert_allclose(smooth, np.cos(film_grid(fine).centre), atol=0.03)


def exact_complementarity(film: Film, displacement: np.ndarray) -> np.ndarray:
    """Pressures with p >= p_cav, surplus >= 0, their product zero: cells change sides until none wants to.

    The readable twin.
    """
    n, m = film.mesh.around, film.mesh.across // 2
    centre, face = film.thickness(displacement)
    around, across, wedge = (
        face**3 / film.mesh.arc**2,
        film.slenderness**2 * centre**3,
        (face - np.roll(face, 1)) / film.mesh.arc,
    )
    matrix, source = np.zeros((n * m, n * m)), np.repeat(wedge, m)
    for i in range(n):
        for j in range(m):
            here, after = i * m + j, (i + 1) % n * m + j
            matrix[[here, after], [here, after]] += around[i]
            matrix[[here, after], [after, here]] -= around[i]
            matrix[here, i * m : (i + 1) * m] += across[i] * film.grid.curvature[j]
    flowing = source < 0
    pressure = np.full(n * m, film.cavitation)
    for _ in range(50):
        pressure[~flowing] = film.cavitation
        known = source[flowing] + matrix[np.ix_(flowing, ~flowing)] @ pressure[~flowing]
        pressure[flowing] = -np.linalg.solve(matrix[np.ix_(flowing, flowing)], known)
        wanted = pressure - film.cavitation - (matrix @ pressure + source) / np.diag(matrix) > 0
        if np.array_equal(wanted, flowing):
            return pressure.reshape(n, m)
        flowing = wanted
    raise AssertionError("the cells never agreed")


@pytest.mark.parametrize(("depth", "cavitation"), [(0.0, 0.0), (0.3, 0.0), (0.45, -0.004)])
def test_rounding_the_front_changes_little(depth: float, cavitation: float) -> None:
    """Force and highest pressure within 1 % of exact complementarity on the same mesh of 72 x 8 cells."""
    film, displacement = Film(FilmMesh(72, 8), 1.7, depth, 0.2, cavitation), np.array([0.2, -0.25])
    exact = exact_complementarity(film, displacement)
    rounded = held_pressure(film, displacement, np.zeros(2))
    force, ours = (film.force_weights @ pressure.sum(axis=1) for pressure in (exact, rounded))
    np.testing.assert_allclose(ours, force, atol=0.01 * np.hypot(*force))
    np.testing.assert_allclose(rounded.max(), exact.max(), rtol=0.01)
    np.testing.assert_allclose(rounded, exact, atol=0.02 * exact.max())


@pytest.mark.parametrize("slenderness", [0.5, 1.7, 40.0])
@pytest.mark.parametrize(("depth", "angle"), [(0.0, 0.0), (0.55, 0.3), (0.5, -0.3)])
def test_an_equilibrium_is_found_from_light_to_heavy_loads(
    slenderness: float, depth: float, angle: float
) -> None:
    """Loads over four decades, eccentricity ratios of 1e-3 ... .98 in the healthy bore.

    Each balanced and stable in its own film.
    """
    for size in (1e-3, 1e-2, 0.1, 1.0, 10.0, 30.0):
        load = np.array([0.0, -size / (1 + 0.3 * slenderness**2)])
        for cavitation in (0.0, -0.015 * np.hypot(*load)):
            state = film_equilibrium(Film(FilmMesh(60, 12), slenderness, depth, angle, cavitation), load)
            np.testing.assert_allclose(state.force, -load, atol=1e-6 * np.hypot(*load))
            assert np.all(np.linalg.eigvalsh(state.damping) > 0)
