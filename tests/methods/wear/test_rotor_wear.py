"""The worn rig of Mendes et al. (2017): wear seen in the directional response, and found again from it
without noise.

Frame: y horizontal, z up, spin y to z, wear angle from the bottom, positive with the spin. Rotor, loads and
bearings as published.
"""

from __future__ import annotations

import dataclasses
from itertools import product

import numpy as np
import pytest
from scipy.optimize import least_squares

from labpipe.methods.journal_bearing.bearing import JournalBearing, journal_equilibrium
from labpipe.methods.journal_bearing.curve import journal_table
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import reduced_rotor
from labpipe.methods.rotor.shaft import (
    ALUMINIUM,
    Disc,
    NodeSupport,
    Rotor,
    ShaftElement,
    Sleeve,
    bearing_loads,
)
from labpipe.methods.wear.tables import VaryingSupport
from tests.methods.wear.worn_cases import WornRig, worn_response

SPEED = 2 * np.pi * 50
LINES = np.concatenate([np.arange(15.9, 35.0, 1.0), np.arange(78.1, 88.0, 0.8)])
# Half of the usual cells: the response is that of any film.
MESH = FilmMesh(120, 16)
BEARING = JournalBearing(diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044)
# Depth um and angle deg of the source's bearings 1 to 4.
WEAR = [(22.27, 11.0), (22.27, -11.0), (40.19, 8.0), (48.26, 17.0)]


@pytest.fixture(scope="module")
def rig() -> WornRig:
    diameters = [12, 12, 31, 31, 12, 12, 12, 12, 30, 30, 12, 12, 31, 31, 12]
    lengths = [60, 60, 10, 10, 55, 55, 55, 55, 40, 40, 50, 50, 10, 10, 30]
    shaft = tuple(
        ShaftElement(length * 1e-3, diameter * 1e-3)
        for length, diameter in zip(lengths, diameters, strict=True)
    )
    coupling = Disc.of_dimensions(1, 12e-3, 25e-3, 20e-3, ALUMINIUM)
    rotor = Rotor(shaft, (coupling,), (Sleeve(9, 40e-3), Sleeve(10, 40e-3)), beta=1.6e-4)
    loads = [(float(y), float(z)) for y, z in bearing_loads(rotor, [4, 14], {10: (0.0, -80.0)})]
    first = journal_equilibrium(BEARING, loads[0], SPEED, MESH)
    table = journal_table(BEARING, loads[1], SPEED, mesh=MESH)

    def worn_bearing(depth: float, angle: float) -> VaryingSupport:
        bearing = dataclasses.replace(BEARING, wear_depth=depth, wear_angle=angle)
        matrices, slopes = table.coefficients(bearing, SPEED)
        return VaryingSupport(NodeSupport(14, *matrices), *slopes[:, :2])

    standing = reduced_rotor(rotor, (4, 10, 14), LINES, SPEED).on(
        [NodeSupport(4, first.stiffness, first.damping)]
    )
    return WornRig(standing, worn_bearing, 14, 10)


@pytest.mark.long
def test_real_forces_tie_the_terms_of_the_directional_response(rig: WornRig) -> None:
    """H_bb(w) = conj H_ff(-w): with real coefficients H(-w) = conj H(w), so H_bb is A^-1 conj(H(-w)) A's
    other diagonal.
    """
    h, _ = worn_response(22.27e-6, 0.19, rig)
    d, _ = worn_response(22.27e-6, 0.19, rig, directional=True)
    a = np.array([[1, 1], [-1j, 1j]])
    negative = np.linalg.inv(a) @ h.conj() @ a
    np.testing.assert_allclose(d[:, 1, 1], negative[:, 0, 0].conj())
    np.testing.assert_allclose(d[:, 1, 0], negative[:, 0, 1].conj())


@pytest.mark.long
@pytest.mark.parametrize(("depth", "angle"), WEAR)
def test_wear_is_found_again_from_at_least_ten_of_twenty_starts(
    rig: WornRig, depth: float, angle: float
) -> None:
    """Starts [0 15 30 45] um x [-15 -7.5 0 7.5 15] deg of the source; .01 um and .01 deg.

    Complex residuals, exact derivatives.
    """
    scale = np.array([1e-6, np.deg2rad(1)])
    measured, _ = worn_response(depth * 1e-6, np.deg2rad(angle), rig, directional=True)

    def residual(x: np.ndarray) -> np.ndarray:
        misfit = (worn_response(*(x * scale), rig, directional=True)[0] - measured) / np.abs(measured).max()
        return np.concatenate([misfit.real.ravel(), misfit.imag.ravel()])

    def jacobian(x: np.ndarray) -> np.ndarray:
        slopes = worn_response(*(x * scale), rig, directional=True)[1] / np.abs(measured).max()
        flat = slopes.reshape(2, -1) * scale[:, None]
        return np.concatenate([flat.real, flat.imag], axis=1).T

    found = 0
    for start in product([0.0, 15.0, 30.0, 45.0], [-15.0, -7.5, 0.0, 7.5, 15.0]):
        fit = least_squares(
            residual,
            np.maximum(start, [1.0, -20.0]),
            jacobian,
            ([0, -20], [50, 20]),
            xtol=1e-10,
            ftol=1e-14,
            gtol=1e-14,
        )
        found += bool(np.all(np.abs(fit.x - (depth, angle)) < 0.01))
    assert found >= 10


@pytest.mark.parametrize(("depth", "angle"), [(22.27, 11.0), (40.19, 8.0)])
def test_derivatives_follow_the_film_itself(rig: WornRig, depth: float, angle: float) -> None:
    """Centred differences of 2 um and 2 deg in response with coefficients from the film, no table: within 6 %
    of the largest.
    """
    load = (0.0, -58.852)
    here = np.array([depth * 1e-6, np.deg2rad(angle)])

    def response(wear: np.ndarray) -> np.ndarray:
        worn = dataclasses.replace(BEARING, wear_depth=float(wear[0]), wear_angle=float(wear[1]))
        film = journal_equilibrium(worn, load, SPEED, MESH)
        standing = rig.rotor.on([NodeSupport(14, film.stiffness, film.damping)])
        return standing.response(14, 10)

    _, slopes = worn_response(*here, rig)
    for number, step in enumerate((2e-6, np.deg2rad(2))):
        move = step * np.eye(2)[number]
        difference = (response(here + move) - response(here - move)) / (2 * step)
        np.testing.assert_allclose(slopes[number], difference, atol=0.06 * np.abs(difference).max())
