"""Worn journal bearing of Mendes et al. (2017), frame as theirs (y horizontal, z up, load -z, spin y to z), against an independent
calculation on 1440 x 72 cells with exact complementarity (an independent calculation); smoothness over the angle of wear.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.bearings.journal import JournalBearing, JournalEquilibrium, film_force, journal_equilibrium
from labpipe.bearings.journal_mesh import FilmMesh

SPEED = 2 * np.pi * 50
# load N, depth um, angle deg, eccentricity ratio, attitude deg, K c / W, C c Omega / W in the order yy yz zy zz
CASES = {
    "bearing 1": (35.38, 0.0, 0.0, 0.1326, 80.95, (2.361, 7.259, -7.946, 1.265), (14.87, -2.367, -2.367, 15.65)),
    "healthy": (58.82, 0.0, 0.0, 0.2096, 75.71, (2.331, 4.329, -5.412, 1.379), (9.204, -2.345, -2.345, 10.445)),
    "wear 1": (58.82, 22.27, 11.0, 0.2908, 44.51, (3.176, 3.187, -5.956, 1.600), (8.406, -1.831, -1.831, 9.969)),
    "wear 3": (58.82, 40.19, 8.0, 0.4423, 26.61, (5.187, 2.270, -5.269, 1.056), (7.863, -3.333, -3.333, 7.297)),
}


def bearing(depth: float, angle: float) -> JournalBearing:
    return JournalBearing(
        diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044, wear_depth=depth * 1e-6, wear_angle=np.deg2rad(angle)
    )


def scaled(equilibrium: JournalEquilibrium) -> tuple[np.ndarray, np.ndarray]:
    scale = equilibrium.bearing.clearance / -equilibrium.load[1]
    return equilibrium.stiffness.ravel() * scale, equilibrium.damping.ravel() * scale * equilibrium.speed


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("mesh", "eccentricity", "attitude", "coefficients"),
    [(FilmMesh(120, 30), 5e-3, 0.05, 0.035), (FilmMesh(240, 30), 5e-3, 0.05, 0.035), (FilmMesh(480, 60), 1e-3, 0.02, 0.005)],
    ids=["120x30", "240x30", "480x60"],
)
def test_equilibrium_and_coefficients(name: str, mesh: FilmMesh, eccentricity: float, attitude: float, coefficients: float) -> None:
    """Tolerances: relative, deg, part of the largest coefficient. Met: 120x30 .2 %, .01, .5 %; 480x60 .02 %, .005, .25 %."""
    load, depth, angle, e, phi, k, c = CASES[name]
    equilibrium = journal_equilibrium(bearing(depth, angle), (0.0, -load), SPEED, mesh)
    np.testing.assert_allclose(equilibrium.eccentricity_ratio, e, rtol=eccentricity)
    np.testing.assert_allclose(np.degrees(equilibrium.attitude), phi, atol=attitude)
    for ours, theirs in zip(scaled(equilibrium), (k, c), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=coefficients * np.max(np.abs(theirs)))
    c_yz, c_zy = equilibrium.damping[[0, 1], [1, 0]]
    assert abs(c_yz - c_zy) < 1e-8 * np.abs(equilibrium.damping).max()


@pytest.mark.parametrize("name", CASES)
def test_linearised_against_centred_differences(name: str) -> None:
    """Differences of 1e-3 of the clearance in the film force itself, .3 % of the largest coefficient."""
    load, depth, angle, *_ = CASES[name]
    worn, mesh = bearing(depth, angle), FilmMesh(120, 30)
    equilibrium = journal_equilibrium(worn, (0.0, -load), SPEED, mesh)
    step = 1e-3 * worn.clearance

    def force(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return film_force(worn, equilibrium.position + position, velocity, SPEED, mesh)

    at_rest = np.zeros(2)
    stiffness, damping = np.empty((2, 2)), np.empty((2, 2))
    for axis in range(2):
        move = step * np.eye(2)[axis]
        stiffness[:, axis] = -(force(move, at_rest) - force(-move, at_rest)) / (2 * step)
        damping[:, axis] = -(force(at_rest, move * SPEED) - force(at_rest, -move * SPEED)) / (2 * step * SPEED)
    np.testing.assert_allclose(equilibrium.stiffness, stiffness, atol=3e-3 * np.abs(stiffness).max())
    np.testing.assert_allclose(equilibrium.damping, damping, atol=3e-3 * np.abs(damping).max())


@pytest.mark.parametrize("depth", [10.0, 22.27, 40.19, 48.26])
def test_coefficients_are_smooth_over_the_angle_of_wear(depth: float) -> None:
    """Largest departure from a polynomial of degree 9 over -20 ... 20 deg, at most .1 % of the largest coefficient, 120 x 30 cells.

    A front that jumps from cell to cell gives 1 %.
    """
    angles = np.linspace(-20, 20, 81)
    equilibrium, rows = None, []
    for angle in angles:
        equilibrium = journal_equilibrium(bearing(depth, angle), (0.0, -58.82), SPEED, FilmMesh(120, 30), equilibrium)
        rows.append(np.concatenate([equilibrium.stiffness.ravel(), equilibrium.damping.ravel() * SPEED]))
    coefficients = np.array(rows)
    smooth = np.stack([np.polynomial.Chebyshev.fit(angles, column, 9)(angles) for column in coefficients.T], axis=1)
    rough = np.max(np.abs(coefficients - smooth), axis=0)
    for part in (slice(0, 4), slice(4, 8)):
        assert np.max(rough[part]) < 1e-3 * np.max(np.abs(coefficients[:, part]))
