"""The table of coefficients against the film itself, its derivatives against differences, and its limits."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing, journal_equilibrium
from labpipe.methods.journal_bearing.curve import PARAMETERS, JournalTable, TableRange, journal_table
from labpipe.methods.journal_bearing.film import FilmMesh

SPEED = 2 * np.pi * 50
LOAD = (0.0, -58.85)
MESH = FilmMesh(60, 12)
BEARING = JournalBearing(diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044)
# As few nodes as a cubic takes: derivatives are those of any table.
WIDE = TableRange(
    viscosity_factor=1.1, clearance_factor=1.03, cavitation_pressure=-0.3e5, n_depth=4, n_angle=4
)


class Found(NamedTuple):
    stiffness: np.ndarray
    damping: np.ndarray
    stiffness_slopes: np.ndarray
    damping_slopes: np.ndarray


def read(table: JournalTable, *at: Any) -> Found:
    matrices, slopes = table.coefficients(*at)
    return Found(*matrices, *slopes)


@pytest.fixture(scope="module")
def wear_table() -> JournalTable:
    return journal_table(BEARING, LOAD, SPEED, mesh=MESH)


@pytest.fixture(scope="module")
def wide_table() -> JournalTable:
    return journal_table(BEARING, LOAD, SPEED, WIDE, MESH)


def worn(depth: float, degrees: float, **change: float) -> JournalBearing:
    return dataclasses.replace(BEARING, wear_depth=depth * 1e-6, wear_angle=np.deg2rad(degrees), **change)


@pytest.mark.long
def test_between_its_nodes_the_table_is_the_film(wear_table: JournalTable, rng: np.random.Generator) -> None:
    """Root mean square .5 % of the largest coefficient at this coarse mesh, whose films are the rougher part
    of it.
    """
    errors = []
    for depth, angle in zip(rng.uniform(0, 50, 40), rng.uniform(-20, 20, 40), strict=True):
        bearing = worn(depth, angle)
        film, found = journal_equilibrium(bearing, LOAD, SPEED, MESH), read(wear_table, bearing, SPEED)
        errors.append(
            [
                np.max(np.abs(found.stiffness - film.stiffness)) / np.abs(film.stiffness).max(),
                np.max(np.abs(found.damping - film.damping)) / np.abs(film.damping).max(),
            ]
        )
    assert np.sqrt(np.mean(np.square(errors))) < 5e-3


@pytest.mark.long
def test_at_its_nodes_the_table_is_exact(wear_table: JournalTable) -> None:
    bearing = worn(50.0, -20.0)
    film, found = journal_equilibrium(bearing, LOAD, SPEED, MESH), read(wear_table, bearing, SPEED)
    np.testing.assert_allclose(found.stiffness, film.stiffness, rtol=1e-6)
    np.testing.assert_allclose(found.damping, film.damping, rtol=1e-6)


@pytest.mark.long
def test_other_viscosity_clearance_and_cavitation() -> None:
    """Off the nodes in every axis at once, within 1.5 % of the largest coefficient on this small table."""
    wide_table = journal_table(BEARING, LOAD, SPEED, dataclasses.replace(WIDE, n_depth=13, n_angle=5), MESH)
    bearing = worn(35.0, 7.0, viscosity=0.109, clearance=88.6e-6, cavitation_pressure=-0.1e5)
    film, found = journal_equilibrium(bearing, LOAD, SPEED, MESH), read(wide_table, bearing, SPEED)
    np.testing.assert_allclose(found.stiffness, film.stiffness, atol=0.015 * np.abs(film.stiffness).max())
    np.testing.assert_allclose(found.damping, film.damping, atol=0.015 * np.abs(film.damping).max())


@pytest.mark.parametrize("parameter", PARAMETERS)
def test_derivatives_equal_differences(wide_table: JournalTable, parameter: str) -> None:
    bearing = worn(22.0, 11.0, viscosity=0.107, clearance=91e-6, cavitation_pressure=-0.12e5)
    step = 1e-5 * (abs(getattr(bearing, parameter)) or 1.0)
    plus, minus = (
        read(wide_table, dataclasses.replace(bearing, **{parameter: getattr(bearing, parameter) + s}), SPEED)
        for s in (step, -step)
    )
    found, number = read(wide_table, bearing, SPEED), PARAMETERS.index(parameter)
    stiffness, damping = (
        (plus.stiffness - minus.stiffness) / (2 * step),
        (plus.damping - minus.damping) / (2 * step),
    )
    np.testing.assert_allclose(found.stiffness_slopes[number], stiffness, atol=1e-5 * np.abs(stiffness).max())
    np.testing.assert_allclose(found.damping_slopes[number], damping, atol=1e-5 * np.abs(damping).max())


@pytest.mark.long
def test_a_healthy_bore_has_no_angle_and_no_slope_by_depth_that_runs_away(wear_table: JournalTable) -> None:
    left, right = (read(wear_table, worn(0.0, angle), SPEED) for angle in (-15.0, 15.0))
    np.testing.assert_allclose(left.stiffness, right.stiffness, rtol=1e-9)
    np.testing.assert_allclose(left.stiffness_slopes[1], 0, atol=1e-6 * np.abs(left.stiffness).max())
    shallow = read(wear_table, worn(0.5, 15.0), SPEED)
    per_micrometre = 0.1 * np.abs(left.stiffness).max() / 1e-6
    assert (
        np.abs(left.stiffness_slopes[0]).max()
        < 2 * np.abs(shallow.stiffness_slopes[0]).max() + per_micrometre
    )


def test_a_table_without_wear_has_no_axes_for_it() -> None:
    """Three nodes of Sommerfeld's number on a parabola: the film at them but for Newton's tolerance, .1 %
    between; wear is refused.
    """
    unworn = journal_table(
        BEARING, LOAD, SPEED, TableRange(depth=0.0, viscosity_factor=1.05, n_sommerfeld=3), MESH
    )
    assert unworn.active == (2,)
    for factor, tolerance in ((1.0, 1e-5), (1.05, 1e-5), (1.025, 1e-3)):
        bearing = dataclasses.replace(BEARING, viscosity=BEARING.viscosity * factor)
        film, found = journal_equilibrium(bearing, LOAD, SPEED, MESH), read(unworn, bearing, SPEED)
        np.testing.assert_allclose(
            found.stiffness, film.stiffness, atol=tolerance * np.abs(film.stiffness).max()
        )
    with pytest.raises(FitError, match="wear depth"):
        read(unworn, worn(1.0, 0.0), SPEED)


def test_another_load_moves_along_the_sommerfeld_axis(wide_table: JournalTable) -> None:
    film = journal_equilibrium(BEARING, (0.0, -62.0), SPEED, MESH)
    found = read(wide_table, BEARING, SPEED, 62.0)
    np.testing.assert_allclose(found.stiffness, film.stiffness, atol=2e-3 * np.abs(film.stiffness).max())


@pytest.mark.parametrize(
    ("bearing", "said"),
    [
        (worn(51.0, 0.0), "wear depth"),
        (worn(10.0, 21.0), "wear angle"),
        (worn(10.0, 2.0, viscosity=0.105), "Sommerfeld number"),
        (worn(10.0, 2.0, cavitation_pressure=-100.0), "cavitation pressure"),
    ],
)
def test_outside_the_table_is_refused(wear_table: JournalTable, bearing: JournalBearing, said: str) -> None:
    with pytest.raises(FitError, match=f"the {said} lies outside"):
        read(wear_table, bearing, SPEED)
