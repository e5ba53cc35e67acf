"""Compass search: minima known in closed form, bounds, its own mesh and counts against a plain twin, and
COBYQA beside it.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.run_ups.amplitudes import SEARCHES, SearchLimits, cobyqa_search, compass_search

CENTRES = np.array([[0.2, -0.4], [0.7, 0.1], [-0.3, 0.6]])
WEIGHTS = np.array([1.0, 7.0])
LOW, HIGH = np.full((3, 2), -1.0), np.full((3, 2), 1.0)
FINE = SearchLimits(smallest_mesh=1e-7, target_share=0.0)


def bowls(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """A paraboloid of its own for every problem."""
    return np.asarray(np.sum(WEIGHTS * (points - CENTRES[chosen]) ** 2, axis=-1))


def valley(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Rosenbrock's function, minimum 0 at (1, 1)."""
    x, y = points[..., 0], points[..., 1]
    return np.asarray((1 - x) ** 2 + 100 * (y - x**2) ** 2)


def plain_compass(objective, x: np.ndarray, low: np.ndarray, high: np.ndarray, limits: SearchLimits):  # type: ignore[no-untyped-def]
    """The same search for one problem, as one reads it in a book: the readable twin."""
    mesh, best, count = limits.first_mesh, objective(x), 1
    rows = [(count, best, mesh)]
    while mesh >= limits.smallest_mesh and count < limits.most_evaluations:
        polled = []
        for sign in (1, -1):
            for axis in range(x.size):
                neighbour = x.copy()
                neighbour[axis] = min(
                    max(x[axis] + sign * mesh * (high[axis] - low[axis]), low[axis]), high[axis]
                )
                polled.append((objective(neighbour), neighbour))
        count += len(polled)
        lowest, where = min(polled, key=lambda one: one[0])
        if lowest < best:
            x, best, mesh = where, lowest, min(2 * mesh, limits.largest_mesh)
        else:
            mesh /= 2
        rows.append((count, best, mesh))
    return x, rows


@pytest.mark.parametrize("name", list(SEARCHES))
def test_every_search_finds_the_bottom_of_every_bowl(name: str) -> None:
    found = SEARCHES[name](bowls, np.zeros((3, 2)), LOW, HIGH, FINE)
    np.testing.assert_allclose(found.values, CENTRES, atol=2e-5)
    assert np.all(found.objective < 1e-8)
    assert not np.any(found.capped)


@pytest.mark.parametrize("name", list(SEARCHES))
def test_a_minimum_outside_the_box_is_met_on_its_bound(name: str) -> None:
    """min (x - .7)^2 over x <= .5: the bound itself."""
    found = SEARCHES[name](bowls, np.zeros((3, 2)), LOW, np.full((3, 2), 0.5), FINE)
    np.testing.assert_allclose(found.values, np.clip(CENTRES, -1, 0.5), atol=2e-5)


def test_it_is_the_search_of_the_books() -> None:
    """Point for point, count for count, mesh for mesh as the plain twin goes."""
    start = np.array([[-0.9, 0.3], [0.1, 0.9], [0.4, -0.8]])
    limits = SearchLimits(smallest_mesh=1e-3, target_share=0.0)
    found = compass_search(bowls, start, LOW, HIGH, limits)
    for n in range(3):
        x, rows = plain_compass(
            lambda one, n=n: float(bowls(one[None, None], np.array([n]))[0, 0]),
            start[n],
            LOW[n],
            HIGH[n],
            limits,
        )
        np.testing.assert_allclose(found.values[n], x, rtol=1e-14)
        own = found.history.of(n)
        np.testing.assert_allclose(
            np.stack([own.evaluations[:, 0], own.objective[:, 0], own.mesh[:, 0]], axis=-1), rows, rtol=1e-12
        )
        assert found.evaluations[n] == rows[-1][0]
        assert found.mesh[n] == rows[-1][2] < limits.smallest_mesh


@pytest.mark.long
def test_in_a_curved_valley_it_creeps_and_says_that_it_hit_the_cap() -> None:
    """From (-1.2, 1) of Rosenbrock's valley: 200 evaluations do not do, and the point is still the lowest so
    far.
    """
    low, high = np.full((1, 2), -2.0), np.full((1, 2), 2.0)
    start = np.array([[-1.2, 1.0]])
    short = compass_search(valley, start, low, high, SearchLimits(most_evaluations=200))
    assert short.capped.all() and short.evaluations[0] in range(200, 205)
    assert 0 < short.objective[0] < valley(start, np.zeros(1, np.intp))[0]
    long = compass_search(
        valley, start, low, high, SearchLimits(most_evaluations=200_000, smallest_mesh=1e-9, target_share=0.0)
    )
    np.testing.assert_allclose(long.values, 1, atol=1e-3)


def test_low_enough_is_enough() -> None:
    found = compass_search(bowls, np.zeros((3, 2)), LOW, HIGH, SearchLimits(target_share=1e-2))
    first = bowls(np.zeros((3, 2)), np.arange(3))
    assert np.all(found.objective <= 1e-2 * first) and not found.capped.any()
    assert (
        found.evaluations.max() < compass_search(bowls, np.zeros((3, 2)), LOW, HIGH, FINE).evaluations.min()
    )


def test_the_objective_never_rises_and_the_mesh_halves_or_doubles() -> None:
    history = compass_search(
        valley, np.array([[-1.2, 1.0]]), np.full((1, 2), -2.0), np.full((1, 2), 2.0)
    ).history
    assert np.all(np.diff(history.objective[:, 0]) <= 0)
    ratio = history.mesh[1:, 0] / history.mesh[:-1, 0]
    assert set(ratio[history.mesh[:-1, 0] < 0.5].tolist()) == {0.5, 2.0}
    assert history.mesh.max() <= 0.5


def test_a_problem_that_ended_is_asked_no_more() -> None:
    asked: list[int] = []

    def counted(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        asked.append(chosen.size)
        return bowls(points, chosen)

    start = np.concatenate([CENTRES[:1], np.array([[-0.9, -0.9], [0.9, 0.9]])])
    found = compass_search(counted, start, LOW, HIGH)
    assert asked == sorted(asked, reverse=True) and asked[0] == 3 and asked[-1] < 3
    assert found.history.of(0).objective.shape[0] < found.history.objective.shape[0]


def test_cobyqa_keeps_its_trace() -> None:
    found = cobyqa_search(bowls, np.zeros((3, 2)), LOW, HIGH, SearchLimits(target_share=0.0))
    assert np.all(np.diff(found.history.objective, axis=0) <= 0)
    np.testing.assert_allclose(found.history.objective[-1], found.objective)
    np.testing.assert_array_equal(found.history.evaluations[-1], found.evaluations)
    assert np.isnan(found.mesh).all()
    short = cobyqa_search(
        valley,
        np.array([[-1.2, 1.0]]),
        np.full((1, 2), -2.0),
        np.full((1, 2), 2.0),
        SearchLimits(most_evaluations=15),
    )
    assert short.capped.all() and short.evaluations[0] <= 16
