"""Intervals of wear against films solved elsewhere: own discretisation, exact complementarity, 960 x 120
(reynolds_reference).

The Mendes rotor on ten states of its bearings, none of them shipped: speed 40-60 Hz, clearance 75-100 um,
viscosity .08-.12 Pa s, wear 8-46 um within 18 deg, all drawn; the rotor file of the fit is wrong by draws of
2 % of clearance and 3 % of viscosity. Lines every .25 Hz, circular noise of 1 and 2 % of the largest |H| in
turn. Starts at the truth: where minima are is tested by itself. The reference's films take a second and a
half each and are recorded: `python -m tests.methods.wear.test_wear_intervals` solves them anew.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.journal_bearing.bearing import JournalBearing, journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import reduced_rotor
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.shaft import NodeSupport
from labpipe.methods.wear import tables
from labpipe.methods.wear.settings import WearSettings
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import Uncertain
from tests.methods.journal_bearing.reynolds_reference import Bearing, coefficients
from tests.methods.wear.worn_cases import without_region

RIG = load_rotor(Path(__file__).parents[3] / "configs/rotors/mendes.yaml")
PORTS = (Port("y", "y", "y"), Port("z", "z", "z"))
LINES = np.setdiff1d(np.arange(10.0, 100.5, 0.25), [50.0])
NOISE = (0.01, 0.02)
RECORDED = Path(__file__).with_name("reference_films.json")
# Speed [Hz], clearance [m], viscosity [Pa s], depth [m], angle [rad]; errors of clearance and viscosity in
# standard deviations.
State = tuple[float, float, float, float, float, float, float]


def states() -> list[State]:
    rng = np.random.default_rng(1)
    drawn = []
    for _ in range(10):
        ranges = ((40, 60), (75e-6, 100e-6), (0.08, 0.12), (8e-6, 46e-6))
        speed, clearance, viscosity, depth = (float(rng.uniform(*ends)) for ends in ranges)
        angle = float(np.deg2rad(rng.uniform(-18, 18)))
        drawn.append((speed, clearance, viscosity, depth, angle, *rng.standard_normal(2).tolist()))
    return drawn


def reference(
    bearing: JournalBearing, load: tuple[float, float], speed: float
) -> tuple[np.ndarray, np.ndarray]:
    sizes = (bearing.diameter, bearing.length, bearing.clearance, bearing.viscosity)
    return coefficients(Bearing(*sizes, depth=bearing.wear_depth, angle=bearing.wear_angle), load, speed)[1:]


def rigs(state: State) -> tuple[RotorRig, RotorRig]:
    """The true rig and that of the rotor file."""
    speed, clearance, viscosity, depth, angle, _, _ = state
    bare = replace(RIG, speed=speed)
    true = bare.with_bearings((), clearance=clearance, viscosity=viscosity)
    known = {name: prior.value for name, prior in priors(state).items()}
    return true.with_bearings(["bearing 2"], wear_depth=depth, wear_angle=angle), bare.with_bearings(
        (), **known
    )


def priors(state: State) -> dict[str, Uncertain]:
    clearance, viscosity = state[1] / (1 + 0.02 * state[5]), state[2] / (1 + 0.03 * state[6])
    return {
        "clearance": Uncertain(clearance, 0.02 * clearance),
        "viscosity": Uncertain(viscosity, 0.03 * viscosity),
    }


def films(rig: RotorRig) -> np.ndarray:
    """K [N/m] and C [N s/m] of the reference for every bearing, (n_bearing, 2, 2, 2)."""
    loads = rig.static_loads()
    return np.array([reference(place.film("a test"), loads[place.name], rig.omega) for place in rig.bearings])


def recorded_films() -> np.ndarray:
    """Those of every state, (n_state, n_bearing, 2, 2, 2)."""
    return np.array(json.loads(RECORDED.read_text("utf-8")))


def response(rig: RotorRig, coefficients: np.ndarray) -> np.ndarray:
    """H on the lines with the *coefficients* of its films, (n_line, 2, 2) [m/N]."""
    nodes = [place.node for place in rig.bearings]
    free = reduced_rotor(rig.rotor, (*nodes, rig.force, rig.response), LINES, rig.omega)
    supports = [NodeSupport(node, *film) for node, film in zip(nodes, coefficients, strict=True)]
    return free.on(supports).response(rig.response, rig.force)


def errors(state: State, n_draw: int, number: int) -> np.ndarray:
    """Of every draw: depth and angle, each with error, standard error [SI] and whether the interval holds the
    truth, (n_draw, 2, 3).
    """
    true, known = rigs(state)
    exact, (depth, angle) = response(true, recorded_films()[number]), state[3:5]
    settings = WearSettings(
        "mendes.yaml", rig=known, start_depths=(depth,), start_angles=(angle,), **priors(state)
    )
    rows = []
    for draw in range(n_draw):
        rng, std = np.random.default_rng([1, number, draw]), NOISE[draw % 2] * np.abs(exact).max()
        matrix = exact + std * (
            rng.standard_normal(exact.shape) + 1j * rng.standard_normal(exact.shape)
        ) / np.sqrt(2)
        measured = FrequencyResponse(
            LINES, matrix, PORTS, PORTS, covariance=diagonal_covariance(np.full(exact.shape, std**2))
        )
        (fit,) = identify(measured, FitSettings("worn-bearing", model_settings=settings, name="wear"))
        rows.append([])
        for name, truth in (("wear_depth", depth), ("wear_angle", angle)):
            parameter = fit.parameter(name)
            assert parameter.std_error is not None and parameter.ci95 is not None
            rows[-1].append(
                (
                    parameter.value - truth,
                    parameter.std_error,
                    parameter.ci95[0] <= truth <= parameter.ci95[1],
                )
            )
    return np.array(rows, float)


@pytest.mark.long
@pytest.mark.parametrize(
    "depth", [40.19e-6, *(pytest.param(depth, marks=pytest.mark.long) for depth in (0.0, 22.27e-6))]
)
def test_two_independent_films_agree(depth: float) -> None:
    """.15 % of the largest coefficient between labpipe on 480 x 60 and the reference on 480 x 60 and 960 x
    120.
    """
    worn = JournalBearing(
        diameter=31e-3, length=18e-3, clearance=90e-6, viscosity=0.1044, wear_depth=depth, wear_angle=0.15
    )
    ours = journal_equilibrium(worn, (0.0, -58.82), 100 * np.pi, FilmMesh(480, 60))
    theirs = reference(worn, (0.0, -58.82), 100 * np.pi)
    for film, other in zip((ours.stiffness, ours.damping), theirs, strict=True):
        np.testing.assert_allclose(film, other, atol=1.5e-3 * np.abs(other).max())


@pytest.mark.long
def test_recorded_films_are_the_reference_s() -> None:
    """Of the state whose wear divides the film."""
    np.testing.assert_allclose(films(rigs(states()[8])[0]), recorded_films()[8], rtol=1e-9)


@pytest.fixture(scope="module")
def drawn_errors() -> np.ndarray:
    """Errors of two draws of every state, (n_state, 2, 2, 3); from tables of few nodes, since starts are the
    truth and films correct them: that moves no estimate by a twentieth of its standard error.
    """
    with without_region(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "WEAR_NODES", ((9, 4),) * 3)
        return np.array([errors(state, 2, number) for number, state in enumerate(states())])


@pytest.mark.long
def test_the_error_of_the_films_is_in_the_standard_error(drawn_errors: np.ndarray) -> None:
    """Where wear divides the film (25.9 um here) intervals of the noise alone missed the depth in ten of ten
    draws, by .32 um.
    """
    depth, angle = drawn_errors[8, 0]
    assert abs(depth[0]) < 0.2e-6 and abs(depth[0]) < 2 * depth[1] and depth[2] and angle[2]


@pytest.mark.long
def test_intervals_hold_the_truth_under_noise(drawn_errors: np.ndarray) -> None:
    """20 draws: of the depths 94 % or more, .15 um rms; of the angles within the central 99 % of a binomial
    with 95 %.

    Error over standard error near one. Over 100 draws 97 and 92 %, films of half the cells and no part of the
    mesh 87 and 92 %. The angle's error is that of the noise: .1 deg for deep wear, .5 deg for 12 um; among
    wears above 20 um .15 deg rms at 1 %.
    """
    drawn, found = states(), drawn_errors
    held = found[..., 2].mean(axis=(0, 1))
    rms = np.sqrt(np.mean(found[..., 0] ** 2, axis=(0, 1)))
    deep = np.array([state[3] > 20e-6 for state in drawn])
    deep_angle = np.rad2deg(np.sqrt(np.mean(found[deep, ::2, 1, 0] ** 2)))
    ratio = np.sqrt(np.mean((found[..., 0] / found[..., 1]) ** 2, axis=(0, 1)))
    print(
        f"\nheld {held}, rms {1e6 * rms[0]:.3f} um {np.rad2deg(rms[1]):.3f} deg, deep at 1 % "
        f"{deep_angle:.3f} deg, error/se {ratio}"
    )
    assert held[0] >= 0.94 and held[1] >= stats.binom.ppf(0.005, 20, 0.95) / 20
    assert rms[0] <= 0.15e-6 and deep_angle <= 0.15
    assert np.all(ratio < 1.2)


if __name__ == "__main__":
    solved = [json.dumps(films(rigs(state)[0]).tolist()) for state in states()]
    RECORDED.write_text("[\n" + ",\n".join(solved) + "\n]\n", encoding="utf-8")
