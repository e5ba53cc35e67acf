"""The rotor behind run-ups: its critical and threshold speeds, and what it refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError, FitError
from labpipe.methods.journal_bearing.bearing import journal_equilibrium
from labpipe.methods.journal_bearing.curve import CURVE_MESH, TO_LOAD_FRAME
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.rig import Unbalance
from labpipe.methods.run_ups.records import RunUp, Shaker
from labpipe.methods.run_ups.rotor import RPM, largest_displacement
from labpipe.methods.run_ups.rotor_file import PinnedSettings
from tests.methods.run_ups.run_up_cases import RIG

POUND = 4.4482216
# Falah and Khorshid, table 2: critical speeds [rpm] of the original model at their loads [lb].
PRINTED = {0.823: 1450, 1.321: 1510, 1.817: 1570, 2.316: 1650, 3.808: 1700}


@pytest.mark.parametrize("pounds", list(PRINTED))
def test_critical_speeds_are_within_six_per_cent_of_the_printed_ones(pounds: float) -> None:
    """The printed bearing and shaft with our discs.

    Displacement in y at disc 2, as in the source's figure 9.
    """
    speed = np.arange(1200.0, 2100.0)
    moved = np.abs(RIG.response(RPM * speed, RIG.start(pounds * POUND))[:, 1, 1])
    assert abs(speed[np.argmax(moved)] / PRINTED[pounds] - 1) < 0.06


def test_the_critical_speed_is_the_peak_of_a_fine_grid() -> None:
    coefficients = RIG.start(2.316 * POUND)
    speed = np.arange(1500, 1800, 0.05) * RPM
    for plane, number in (("disc 1", 0), ("disc 2", 1), ("", 1)):
        grid = largest_displacement(RIG.response(speed, coefficients))[:, number]
        np.testing.assert_allclose(RIG.critical_speed(coefficients, plane), speed[np.argmax(grid)], rtol=3e-5)


def test_a_response_without_a_peak_has_no_critical_speed() -> None:
    stiff = (np.eye(2) * 1e9, np.zeros((2, 2)))
    with pytest.raises(FitError, match="no peak"):
        RIG.critical_speed(lambda speed: tuple(np.broadcast_to(one, (np.size(speed), 2, 2)) for one in stiff))  # type: ignore[return-value]


def test_critical_speed_by_eigenvalues_lies_below_the_peak_of_the_damped_response() -> None:
    coefficients = RIG.start(1.321 * POUND)
    resonance = RIG.resonance(coefficients)
    assert resonance is not None and 0.9 < resonance / RIG.critical_speed(coefficients) < 1


def test_largest_displacement_is_that_of_the_orbit(rng: np.random.Generator) -> None:
    """Against the orbit walked through in 3600 steps."""
    phasors = rng.standard_normal((6, 2)) + 1j * rng.standard_normal((6, 2))
    angle = np.deg2rad(np.arange(0, 360, 0.1))
    walked = np.hypot(*np.moveaxis((phasors[..., None] * np.exp(1j * angle)).real, 1, 0)).max(axis=-1)
    np.testing.assert_allclose(largest_displacement(phasors), walked, rtol=1e-5)


def test_the_start_is_the_film_s_own_equilibrium() -> None:
    """Against one equilibrium on twice the cells of the curve's mesh each way."""
    speed, load = 170.0, 5.0
    film = journal_equilibrium(
        RIG.place.bearing, (0.0, -load), speed, FilmMesh(2 * CURVE_MESH.around, 2 * CURVE_MESH.across)
    )
    stiffness, damping = RIG.start_coefficients(load, np.array([speed]))
    expected = TO_LOAD_FRAME @ film.stiffness @ TO_LOAD_FRAME.T
    np.testing.assert_allclose(stiffness[0], expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(damping[0], TO_LOAD_FRAME @ film.damping @ TO_LOAD_FRAME.T, rtol=5e-3)


def test_a_static_force_that_does_not_turn_moves_the_journal_otherwise() -> None:
    shape = (2, 2, 2)
    ones = np.ones(shape)
    speed = np.array([120.0, 150.0])
    force = RunUp(
        "s",
        5.0,
        speed,
        RIG.plane_names,
        ones + 0j,
        amplitude_error=ones,
        phase_error=ones,
        shaker=Shaker("disc 1", 1.0, 0.0, 0.9),
    )
    turning = RunUp(
        "u",
        5.0,
        speed,
        RIG.plane_names,
        ones + 0j,
        amplitude_error=ones,
        phase_error=ones,
        unbalance={"disc 1": 1e-5 + 0j},
    )
    assert np.allclose(RIG.excite(force).speed, 0.9 * speed)
    np.testing.assert_allclose(
        RIG.excite(turning).force[:, 1] / RIG.excite(turning).force[:, 0], -1j, atol=1e-9
    )
    assert np.max(np.abs(RIG.excite(force).force[:, 1] / RIG.excite(force).force[:, 0])) < 1e-2


def test_a_run_of_other_planes_is_refused() -> None:
    ones = np.ones((1, 1, 2))
    run = RunUp(
        "r",
        5.0,
        np.array([100.0]),
        ("disc 2",),
        ones + 0j,
        amplitude_error=ones,
        phase_error=ones,
        unbalance={"disc 2": 1e-5 + 0j},
    )
    with pytest.raises(DataError, match="was measured at disc 2, the rotor has disc 1, disc 2"):
        RIG.excite(run)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"planes": ()}, "planes: a run-up needs a plane"),
        ({"planes": (("a", 2), ("b", 2))}, "two planes sit on one node"),
        ({"planes": (("a", 1), ("b", 2))}, "not between the pins"),
        ({"unbalances": (Unbalance(3, 1e-5),)}, "no plane at node 3"),
        ({"pins": (1, 3)}, "not between the pins"),
    ],
)
def test_rotors_that_cannot_be_are_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        dataclasses.replace(RIG, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("low", [0.0, -5.0])
def test_a_search_begins_above_zero(low: float) -> None:
    with pytest.raises(ConfigError, match="speeds must be positive"):
        PinnedSettings(speeds=(low, 50.0))


def test_unknown_planes_get_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match="no plane 'disk 1'"):
        RIG.node("disk 1")


def test_unbalances_on_one_node_add() -> None:
    twice = dataclasses.replace(RIG, unbalances=(*RIG.unbalances, Unbalance(2, 10e-6, np.pi / 2)))
    assert twice.known_unbalance["disc 1"] == pytest.approx(50e-6 + 10e-6j)
