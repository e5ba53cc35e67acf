"""Cost of a wear identification in equilibria: figures are printed; only gross failures fail."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from scipy.linalg import lapack
from scipy.optimize import least_squares

from labpipe.estimation.fitting import identify as fitted
from labpipe.methods.journal_bearing import bearing as equilibria
from labpipe.methods.journal_bearing.bearing import JournalBearing, JournalEquilibrium, journal_equilibrium
from labpipe.methods.journal_bearing.curve import JournalTable, journal_table
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import reduced_rotor
from labpipe.methods.rotor.shaft import NodeSupport, Rotor, ShaftElement, Sleeve
from labpipe.methods.wear.tables import VaryingSupport
from labpipe.records.uncertain import Uncertain
from tests.methods.wear.worn_cases import WornRig, fit_settings, measured, worn_response, worn_rig

SPEED = 2 * np.pi * 50
LOAD = (0.0, -58.85)
BEARING = JournalBearing(diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044)
LINES = np.array([15.9, 25.1, 34.3, 78.1, 81.3, 84.5, 87.7])
STARTS = list(product([1.0, 15.0, 30.0, 45.0], [-15.0, -7.5, 0.0, 7.5, 15.0]))


def wall_seconds(action: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def worn(depth: float, angle: float) -> JournalBearing:
    return dataclasses.replace(BEARING, wear_depth=depth, wear_angle=angle)


def equilibrium_seconds() -> tuple[float, float]:
    """One 120 x 30 equilibrium with its coefficients: from nothing, and from a neighbour 1 deg away."""
    turning = iter(np.deg2rad(np.arange(-20.0, 20.0)))
    neighbour: list[JournalEquilibrium] = [journal_equilibrium(worn(30e-6, -0.36), LOAD, SPEED)]

    def from_neighbour() -> None:
        neighbour[0] = journal_equilibrium(worn(30e-6, float(next(turning))), LOAD, SPEED, near=neighbour[0])

    cold = wall_seconds(lambda: journal_equilibrium(worn(30e-6, 0.1), LOAD, SPEED), 15)
    return cold, wall_seconds(from_neighbour, 31)


def identify(table: JournalTable) -> None:
    """Twenty starts on seven lines of the full directional response, complex residuals, exact derivatives."""
    rotor = Rotor(
        tuple(ShaftElement(0.06, 0.012) for _ in range(15)), sleeves=(Sleeve(8, 0.04),), beta=1.6e-4
    )
    first = journal_equilibrium(BEARING, LOAD, SPEED)
    standing = reduced_rotor(rotor, (4, 10, 14), LINES, SPEED).on(
        [NodeSupport(4, first.stiffness, first.damping)]
    )

    def bearing(depth: float, angle: float) -> VaryingSupport:
        matrices, slopes = table.coefficients(worn(depth, angle), SPEED)
        return VaryingSupport(NodeSupport(14, *matrices), *slopes[:, :2])

    rig, scale = WornRig(standing, bearing, 14, 10), np.array([1e-6, np.deg2rad(1)])
    measured, _ = worn_response(22.27e-6, 0.19, rig, directional=True)

    def residual(x: np.ndarray) -> np.ndarray:
        misfit = (worn_response(*(x * scale), rig, directional=True)[0] - measured).ravel() / np.abs(
            measured
        ).max()
        return np.concatenate([misfit.real, misfit.imag])

    def jacobian(x: np.ndarray) -> np.ndarray:
        flat = (
            worn_response(*(x * scale), rig, directional=True)[1].reshape(2, -1).T
            * scale
            / np.abs(measured).max()
        )
        return np.concatenate([flat.real, flat.imag])

    for start in STARTS:
        least_squares(residual, start, jacobian, ([0, -20], [50, 20]))


def test_identification_with_its_table_in_equilibria(capsys) -> None:  # type: ignore[no-untyped-def]
    """Goal: 3 s where an equilibrium takes 3 ms, that is 1000 equilibria."""
    cold, warm = equilibrium_seconds()
    tables: list[JournalTable] = []
    table = wall_seconds(lambda: tables.append(journal_table(BEARING, LOAD, SPEED)), 1)
    search = wall_seconds(lambda: identify(tables[-1]), 1)
    with capsys.disabled():
        print(
            f"\n120 x 30 equilibrium with coefficients: {1e3 * cold:.1f} ms from nothing, "
            f"{1e3 * warm:.1f} ms from a neighbour"
        )
        print(
            f"table {table:.2f} s, 20 starts {search:.2f} s: "
            f"{(table + search) / warm:.0f} equilibria (goal 1000)"
        )
    assert table + search < 4000 * warm
    assert warm < cold


def test_steps_do_not_grow_with_the_mesh(capsys) -> None:  # type: ignore[no-untyped-def]
    """Coarser meshes find the neighbourhood: four times the cells cost about four times the time, not
    more.
    """
    meshes = (FilmMesh(120, 30), FilmMesh(240, 60))
    coarse, fine = (
        wall_seconds(lambda mesh=mesh: journal_equilibrium(worn(30e-6, 0.1), LOAD, SPEED, mesh), 7)
        for mesh in meshes
    )
    with capsys.disabled():
        print(f"\n240 x 60 cells take {fine / coarse:.1f} times 120 x 30")
    assert fine < 24 * coarse


def bare_factor_seconds(shape: tuple[int, int]) -> float:
    """CPU of LAPACK's Cholesky factors of a band of as many cells as a film of *shape* (n_theta, n_half) has
    outside its cavity.
    """
    n_cell, n_half = int(0.7 * shape[0]) * shape[1], shape[1]
    band = np.full((n_half + 1, n_cell), -1.0 / (2 * n_half), order="F")
    band[0] = 2.0
    return cpu_seconds(lambda: lapack.dpbtrf(band, lower=1), 15)


def cpu_seconds(action: Callable[[], object], repeats: int) -> float:
    """The least CPU of one call."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times)


@pytest.mark.parametrize("mesh", [FilmMesh(120, 30), FilmMesh(480, 60)])
def test_an_equilibrium_in_factorisations(mesh: FilmMesh, capsys) -> None:  # type: ignore[no-untyped-def]
    """An equilibrium one degree from its neighbour, coefficients and all, over one bare factorisation of its
    equations.
    """
    neighbour = journal_equilibrium(worn(25e-6, 0.15), LOAD, SPEED, mesh)
    near = cpu_seconds(lambda: journal_equilibrium(worn(25e-6, 0.1675), LOAD, SPEED, mesh, neighbour), 9)
    factor = bare_factor_seconds((mesh.around, mesh.across // 2))
    with capsys.disabled():
        print(
            f"\n{mesh.around} x {mesh.across}: {1e3 * near:.1f} ms, {near / factor:.0f} bare "
            f"factorisations of {1e3 * factor:.2f} ms"
        )
    assert near < 100 * factor


def test_a_whole_fit_in_factorisations(capsys, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    """A wear with two more parameters, from tables to intervals, over all its bare factorisations."""
    shapes: list[tuple[int, int]] = []
    factored = equilibria.factorise

    def counted(equations, curvature, room):  # type: ignore[no-untyped-def]
        shapes.append(equations.diagonal.shape)
        return factored(equations, curvature, room)

    monkeypatch.setattr(equilibria, "factorise", counted)
    response = measured(worn_rig(22.27, 11.0), 0.02, np.random.default_rng(3), np.linspace(10, 100, 359))
    known = {"viscosity": Uncertain(0.1044, 0.0004), "clearance": Uncertain(90e-6, 0.1e-6)}
    settings = fit_settings(cells_around=120, cells_across=30, **known)
    spent = cpu_seconds(lambda: fitted(response, settings), 1)
    floor = sum(shapes.count(shape) * bare_factor_seconds(shape) for shape in sorted(set(shapes)))
    with capsys.disabled():
        print(
            f"\na fit of wear {spent:.2f} s: {spent / floor:.1f} times its {len(shapes)} bare factorisations"
        )
    assert spent < 30 * floor
