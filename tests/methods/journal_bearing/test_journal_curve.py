"""Grooves in the film, and the curve of coefficients over the Sommerfeld number."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing, JournalEquilibrium, journal_equilibrium
from labpipe.methods.journal_bearing.curve import (
    HIGHEST_SOMMERFELD,
    LOWEST_SOMMERFELD,
    TO_LOAD_FRAME,
    curve_of,
    journal_curve,
    sommerfeld_number,
)
from labpipe.methods.journal_bearing.film import Film, FilmMesh
from labpipe.methods.run_ups.rotor import as_matrices

GROOVE = np.deg2rad(20)
MESH = FilmMesh(72, 12)
GROOVED = JournalBearing(
    diameter=16.5e-3, length=8.25e-3, clearance=0.2e-3, viscosity=0.55, groove_width=GROOVE
)


def test_grooves_hold_the_ambient_pressure_and_nothing_else_does() -> None:
    found = journal_equilibrium(GROOVED, (0.0, -5.0), 150.0, MESH)
    degrees = np.degrees(found.theta)
    grooved = np.minimum(np.abs((degrees + 90) % 180 - 90), 90) < 10
    assert np.count_nonzero(grooved) == 8
    assert np.abs(found.pressure[grooved]).max() < 1e-6 * found.pressure.max()
    assert np.all(found.pressure[(degrees > 200) & (degrees < 300)] > 0)


def test_the_film_reaches_zero_at_the_edge_of_the_groove_not_at_a_cell_s_centre() -> None:
    """The face towards a groove conducts twice as well when its edge is half a cell away."""
    film = Film(MESH, 2.0, groove=GROOVE)
    np.testing.assert_allclose(np.unique(film.grooves[1].round(9)), [1, 2])
    assert np.count_nonzero(film.grooves[1] > 1) == 4
    assert np.all(Film(MESH, 2.0).grooves[1] == 1)


def test_grooves_of_any_width_are_followed_smoothly() -> None:
    """Edges within a cell: the eccentricity grows steadily with the width, without steps of a whole cell."""
    widths = np.deg2rad(np.arange(16.0, 25.0, 0.5))
    found = [
        journal_equilibrium(dataclasses.replace(GROOVED, groove_width=width), (0.0, -5.0), 150.0, MESH)
        for width in widths
    ]
    stiffness = np.array([one.stiffness[1, 1] for one in found])
    assert np.ptp(stiffness) / stiffness.mean() < 0.1
    assert np.max(np.abs(np.diff(stiffness))) / stiffness.mean() < 0.02


def test_stiffness_of_a_grooved_film_is_the_slope_of_its_equilibrium() -> None:
    here = journal_equilibrium(GROOVED, (0.0, -5.0), 150.0, MESH)
    for change in ((1e-3, 0.0), (0.0, 1e-3)):
        plus, minus = (
            journal_equilibrium(GROOVED, (s * change[0], -5 + s * change[1]), 150.0, MESH, here)
            for s in (1, -1)
        )
        np.testing.assert_allclose(here.stiffness @ (plus.position - minus.position) / 2, change, atol=2e-6)


def test_damping_of_a_grooved_film_stays_symmetric() -> None:
    damping = journal_equilibrium(GROOVED, (0.0, -5.0), 150.0, MESH).damping
    np.testing.assert_allclose(damping[0, 1], damping[1, 0], rtol=1e-9)


@pytest.mark.parametrize("width", [-0.1, 2.5, float("nan")])
def test_grooves_that_cannot_be_are_refused(width: float) -> None:
    with pytest.raises(ConfigError, match="a groove of"):
        dataclasses.replace(GROOVED, groove_width=width)


def test_the_curve_gives_the_equilibrium_s_own_coefficients() -> None:
    """Between nodes, in newtons and metres, for a bearing that was not tabulated: (4 fine - coarse) / 3 of
    two meshes.
    """
    curve = journal_curve(0.5, GROOVE, MESH, 60)
    speed, load = 180.0, 7.3
    direct, coarse = (
        journal_equilibrium(GROOVED, (0.0, -load), speed, mesh) for mesh in (MESH, FilmMesh(36, 6))
    )
    number = sommerfeld_number(GROOVED, np.array(load), np.array(speed))
    np.testing.assert_allclose(number, direct.sommerfeld)
    found_stiffness, found_damping = as_matrices(curve.coefficients(number)[0])
    scale = load / GROOVED.clearance
    stiffness = TO_LOAD_FRAME @ (4 * direct.stiffness - coarse.stiffness) @ TO_LOAD_FRAME.T / 3
    damping = TO_LOAD_FRAME @ (4 * direct.damping - coarse.damping) @ TO_LOAD_FRAME.T / 3
    np.testing.assert_allclose(found_stiffness * scale, stiffness, atol=2e-3 * np.abs(stiffness).max())
    np.testing.assert_allclose(found_damping * scale / speed, damping, atol=2e-3 * np.abs(damping).max())
    eccentricity, attitude = curve.rest(number)
    rest = [(4 * fine - half) / 3 for fine, half in zip(_rest(direct), _rest(coarse), strict=True)]
    np.testing.assert_allclose([eccentricity, attitude], rest, atol=2e-4)


def _rest(film: JournalEquilibrium) -> tuple[float, float]:
    return film.eccentricity_ratio, film.attitude


def test_the_curve_is_nearer_to_a_fine_film_than_its_mesh_is() -> None:
    """Three times at least, rms over the coefficients, against sixteen times the cells."""
    curve, load = journal_curve(0.5, GROOVE, MESH, 60), 7.3
    errors = []
    for speed in (60.0, 120.0, 240.0):
        own, fine = (
            journal_equilibrium(GROOVED, (0.0, -load), speed, mesh) for mesh in (MESH, FilmMesh(288, 48))
        )
        found = as_matrices(curve.coefficients(np.array(fine.sommerfeld))[0])[0] * load / GROOVED.clearance
        stiffness, plain = (TO_LOAD_FRAME @ film.stiffness @ TO_LOAD_FRAME.T for film in (fine, own))
        errors.append([np.linalg.norm(one - stiffness) / np.linalg.norm(stiffness) for one in (plain, found)])
    plain_error, curve_error = np.sqrt(np.mean(np.square(errors), axis=0))
    assert curve_error < plain_error / 3


def test_a_mesh_that_cannot_be_halved_is_refused() -> None:
    with pytest.raises(ConfigError, match="too coarse to halve"):
        journal_curve(0.5, 0.0, FilmMesh(26, 4), 8)


def test_slopes_are_the_derivatives_by_the_logarithm() -> None:
    curve = journal_curve(0.5, GROOVE, MESH, 60)
    numbers, step = np.array([0.05, 0.4, 3.0]), 1e-5
    here, plus, minus = (curve.coefficients(numbers * np.exp(change)) for change in (0, step, -step))
    np.testing.assert_allclose(here[1], (plus[0] - minus[0]) / (2 * step), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("number", [LOWEST_SOMMERFELD / 2, HIGHEST_SOMMERFELD * 2, float("nan")])
def test_outside_the_table_nothing_is_guessed(number: float) -> None:
    with pytest.raises(FitError, match="outside the bearing's table"):
        journal_curve(0.5, GROOVE, MESH, 60).coefficients(np.array([1.0, number]))


def test_a_worn_bearing_has_no_curve() -> None:
    """K c / W of a worn film depends on its wear, of a film that tears at p_cav on p_cav L D / W as well."""
    plain = JournalBearing(diameter=0.03, length=0.015, clearance=9e-5, viscosity=0.1)
    for change in ({"wear_depth": 1e-6}, {"cavitation_pressure": -1e4}):
        with pytest.raises(ConfigError, match="has no curve over its Sommerfeld number"):
            curve_of(dataclasses.replace(plain, **change))
