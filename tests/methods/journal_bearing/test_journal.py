"""The journal bearing as its user sees it: units, load directions, scaling laws, refusals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing, converged_equilibrium, journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh
from tests.methods.journal_bearing.film_force import film_force

SPEED = 2 * np.pi * 50
MESH = FilmMesh(60, 12)
HEALTHY = JournalBearing(diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044)


def turned(matrix: np.ndarray, angle: float) -> np.ndarray:
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rotation @ matrix @ rotation.T


@pytest.mark.parametrize("cells", [1, 7, 15, 31])
def test_a_turned_load_turns_everything(cells: int) -> None:
    """By whole cells, where the mesh turns into itself."""
    angle = cells * MESH.arc
    down = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, MESH)
    aside = journal_equilibrium(HEALTHY, (50 * np.sin(angle), -50 * np.cos(angle)), SPEED, MESH)
    np.testing.assert_allclose(aside.eccentricity_ratio, down.eccentricity_ratio, rtol=1e-7)
    np.testing.assert_allclose(aside.attitude, down.attitude, atol=1e-7)
    np.testing.assert_allclose(
        aside.stiffness, turned(down.stiffness, angle), atol=1e-6 * np.abs(down.stiffness).max()
    )
    np.testing.assert_allclose(
        aside.damping, turned(down.damping, angle), atol=1e-6 * np.abs(down.damping).max()
    )


def test_viscosity_and_speed_enter_as_their_product() -> None:
    one = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, MESH)
    other = journal_equilibrium(dataclasses.replace(HEALTHY, viscosity=0.0522), (0.0, -50.0), 2 * SPEED, MESH)
    np.testing.assert_allclose(one.sommerfeld, other.sommerfeld)
    np.testing.assert_allclose(one.stiffness, other.stiffness)
    np.testing.assert_allclose(one.damping, 2 * other.damping)


def test_sommerfeld_number_by_hand() -> None:
    """S = mu N L D / W (R / c)^2 = .1044 * 50 * .018 * .031 / 50 * (15.5e-3 / 90e-6)^2 = 1.7279."""
    equilibrium = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, MESH)
    np.testing.assert_allclose(equilibrium.sommerfeld, 1.7279, rtol=1e-4)


def test_the_film_carries_the_load_by_its_pressure_field() -> None:
    """Force integrated from the field in newtons, an independent sum over the whole width."""
    worn = dataclasses.replace(HEALTHY, wear_depth=22e-6, wear_angle=0.19)
    equilibrium = journal_equilibrium(worn, (12.0, -50.0), SPEED, MESH)
    area = worn.diameter / 2 * MESH.arc * worn.length / MESH.across
    assert equilibrium.pressure.shape == (60, 12)
    np.testing.assert_allclose(equilibrium.pressure, equilibrium.pressure[:, ::-1])
    force = [
        -np.sum(equilibrium.pressure * direction(equilibrium.theta)[:, None]) * area
        for direction in (np.cos, np.sin)
    ]
    np.testing.assert_allclose(force, [-12, 50], atol=1e-5)
    np.testing.assert_allclose(equilibrium.axial, -equilibrium.axial[::-1])


def test_film_thickness_is_clearance_less_displacement_plus_wear() -> None:
    worn = dataclasses.replace(HEALTHY, wear_depth=30e-6)
    equilibrium = journal_equilibrium(worn, (0.0, -50.0), SPEED, MESH)
    y, z = equilibrium.position
    bare = worn.clearance - y * np.cos(equilibrium.theta) - z * np.sin(equilibrium.theta)
    added = equilibrium.film_thickness - bare
    np.testing.assert_allclose(added.max(), 30e-6, rtol=0.01)
    np.testing.assert_allclose(added[np.sin(equilibrium.theta) > 0], 0, atol=1e-18)


def test_sign_of_the_coefficients_of_a_healthy_bearing() -> None:
    k = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, MESH).stiffness
    assert k[0, 1] > 0 > k[1, 0]


def test_film_force_balances_the_load_and_damps() -> None:
    equilibrium = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, MESH)
    rest = film_force(HEALTHY, equilibrium.position, np.zeros(2), SPEED, MESH)
    np.testing.assert_allclose(rest, [0, 50], atol=1e-4)
    falling = film_force(HEALTHY, equilibrium.position, np.array([0, -1e-4]), SPEED, MESH)
    np.testing.assert_allclose(falling - rest, 1e-4 * equilibrium.damping[:, 1], rtol=0.02)


def test_a_lower_cavitation_pressure_pulls_the_journal_aside() -> None:
    """Tension in the diverging film moves the journal towards the full film's attitude of 90 deg."""
    attitudes = []
    for pressure in (0.0, -0.1e5, -0.3e5, -20e5):
        bearing = dataclasses.replace(HEALTHY, cavitation_pressure=pressure)
        equilibrium = journal_equilibrium(bearing, (0.0, -50.0), SPEED, MESH)
        assert equilibrium.pressure.min() >= pressure - 1e-4
        attitudes.append(np.degrees(equilibrium.attitude))
    assert np.all(np.diff(attitudes) > 0)
    np.testing.assert_allclose(attitudes[-1], 90, atol=1e-4)


def test_a_near_equilibrium_of_another_mesh_is_no_start() -> None:
    near = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, FilmMesh(48, 8))
    again = journal_equilibrium(HEALTHY, (0.0, -50.0), SPEED, MESH, near)
    assert again.state.pressure.shape == (60, 6)


def test_converged_equilibrium_states_its_error_and_keeps_it() -> None:
    worn = dataclasses.replace(HEALTHY, wear_depth=40.19e-6, wear_angle=np.deg2rad(8))
    chosen = converged_equilibrium(worn, (0.0, -58.82), SPEED, 0.01, FilmMesh(48, 8))
    exact = journal_equilibrium(worn, (0.0, -58.82), SPEED, FilmMesh(480, 60))
    assert chosen.error is not None and chosen.error <= 0.01
    assert chosen.mesh.around > 48
    for ours, theirs in ((chosen.stiffness, exact.stiffness), (chosen.damping, exact.damping)):
        assert np.max(np.abs(ours - theirs)) < 2 * 0.01 * np.max(np.abs(theirs))


def test_the_default_mesh_is_enough_for_a_healthy_bearing() -> None:
    chosen = converged_equilibrium(HEALTHY, (0.0, -50.0), SPEED)
    assert (chosen.mesh.around, chosen.mesh.across) == (120, 30)
    assert chosen.error is not None and 0 < chosen.error < 0.01


def test_a_first_mesh_that_cannot_be_halved_is_refused() -> None:
    with pytest.raises(ConfigError, match="too coarse to halve"):
        converged_equilibrium(HEALTHY, (0.0, -50.0), SPEED, mesh=FilmMesh(24, 4))


@pytest.mark.parametrize("depth", [0.0, 30e-6])
def test_the_estimated_error_is_near_the_true_one(depth: float) -> None:
    """Against 960 x 60 cells, within a factor of four either way."""
    bearing = dataclasses.replace(HEALTHY, wear_depth=depth, wear_angle=0.1)
    chosen = converged_equilibrium(bearing, (0.0, -50.0), SPEED, 0.05, FilmMesh(96, 24))
    exact = journal_equilibrium(bearing, (0.0, -50.0), SPEED, FilmMesh(960, 60))
    pairs = ((chosen.stiffness, exact.stiffness), (chosen.damping, exact.damping))
    true = max(np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in pairs)
    assert chosen.error is not None
    assert true / 4 < chosen.error < 4 * true


def test_bearing_wear_and_load_turned_together_turn_the_coefficients() -> None:
    angle = 9 * MESH.arc
    worn = dataclasses.replace(HEALTHY, wear_depth=30e-6, wear_angle=0.1)
    aside = dataclasses.replace(worn, wear_angle=0.1 + angle)
    one = journal_equilibrium(worn, (0.0, -50.0), SPEED, MESH)
    other = journal_equilibrium(aside, (50 * np.sin(angle), -50 * np.cos(angle)), SPEED, MESH)
    np.testing.assert_allclose(
        other.stiffness, turned(one.stiffness, angle), atol=1e-6 * np.abs(one.stiffness).max()
    )
    np.testing.assert_allclose(
        other.damping, turned(one.damping, angle), atol=1e-6 * np.abs(one.damping).max()
    )


def test_stiffness_is_the_slope_of_the_equilibrium_itself() -> None:
    """A little more load moves the journal by K^-1 dF: no film held still, no difference of forces."""
    worn = dataclasses.replace(HEALTHY, wear_depth=22e-6, wear_angle=0.19)
    here = journal_equilibrium(worn, (0.0, -50.0), SPEED, MESH)
    for change in ((0.01, 0.0), (0.0, 0.01)):
        plus, minus = (
            journal_equilibrium(worn, (s * change[0], -50 + s * change[1]), SPEED, MESH, here)
            for s in (1, -1)
        )
        moved = (plus.position - minus.position) / 2
        np.testing.assert_allclose(here.stiffness @ moved, change, atol=2e-5)


def test_an_error_below_the_finest_mesh_is_refused() -> None:
    with pytest.raises(FitError, match="needs more than"):
        converged_equilibrium(HEALTHY, (0.0, -50.0), SPEED, 1e-9, FilmMesh(480, 8))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"diameter": 0.0}, "the diameter"),
        ({"viscosity": -0.1}, "the viscosity"),
        ({"clearance": float("nan")}, "the clearance"),
        ({"length": float("inf")}, "the length"),
        ({"wear_depth": -1e-6}, "a wear of -1 um"),
        ({"wear_depth": 200e-6}, "does not fit"),
        ({"wear_angle": 4.0}, "a wear angle"),
        ({"cavitation_pressure": 1e4}, "above the ambient"),
    ],
)
def test_bearings_that_cannot_be_are_refused(change: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        dataclasses.replace(HEALTHY, **change)


@pytest.mark.parametrize(
    ("load", "speed", "said"), [((0.0, 0.0), SPEED, "needs a load"), ((0.0, -50.0), 0.0, "needs a speed")]
)
def test_no_load_and_no_speed_are_refused(load: tuple[float, float], speed: float, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        journal_equilibrium(HEALTHY, load, speed)
