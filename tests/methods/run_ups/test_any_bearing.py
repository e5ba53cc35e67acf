"""Every kind of bearing on a rotor, in a run-up and under the methods that need an oil film."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labpipe.bearings.kinds import BEARINGS, BearingKind, OperatingPoint
from labpipe.errors import ConfigError
from labpipe.methods.rolling_bearing.settings import BallBearingSettings, Loads
from labpipe.methods.rotor.response import unbalance_response
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.section import orbit
from labpipe.methods.rotor.shaft import NodeSupport
from labpipe.methods.run_ups.joint import fit_jointly
from labpipe.methods.run_ups.methods import fit_points
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import RPM, RunUpRotor, with_search_range
from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from labpipe.methods.wear.settings import WearSettings

# An entry of `bearings:` for every kind, without its node.
ENTRIES = {
    "journal-bearing": "kind: journal-bearing, diameter: 30 mm, length: 15 mm, clearance: 90 um, viscosity: "
    "0.05 Pa.s",
    "ball-bearing": "kind: ball-bearing, elements: 9, stiffness_constant: 1.10e10, groove_distance: 0.5953 "
    "mm, pitch_radius: 30.1488 mm, "
    "damping_factor: 1e-4 s, loads: {z: 427 N}",
    "roller-bearing": "kind: roller-bearing, elements: 14, stiffness_constant: 8e8, pitch_radius: 32 mm, "
    "damping_factor: 1e-4 s",
    "linear-bearing": "kind: linear-bearing, k_yy: 8 MN/m, k_zz: 12 MN/m, k_yz: 1 MN/m, c: 5 kN.s/m",
    "magnetic-bearing": "kind: magnetic-bearing, mass: 4 kg, negative_stiffness: 20 kN/m, "
    "loop: {proportional: 6 V/V, derivative: 0.004 s, force_per_current: 40 N/A}",
}
# The journal bearing of the published run-ups, and one of its loads [N].
FALAH = (
    "kind: journal-bearing, diameter: 16.5 mm, length: 8.25 mm, clearance: 0.2 mm, viscosity: 0.55 "
    "Pa.s, groove_width: 20 deg"
)
LOAD = 5.876
ROTOR = """speed: 40 Hz
force: 2
response: 2
elements:
  - {{length: 200 mm, diameter: 25 mm, count: 2}}
discs:
  - {{node: 2, mass: 5 kg, polar_inertia: 0.01 kg.m^2, transverse_inertia: 0.006 kg.m^2}}
bearings:
  - {{name: left, node: 1, {bearing}}}
  - {{name: right, node: 3, {bearing}}}
unbalances:
  - {{node: 2, size: 20 g.mm}}
"""
RUN_UP_ROTOR = """speeds: 400-3000 rpm
pins: [1, 5]
elements:
  - {{diameter: 16.5 mm, length: 190 mm, count: 4}}
discs:
  - {{node: 2, mass: 4.3 kg, polar_inertia: 5.375e-3 kg.m^2, transverse_inertia: 4.453e-3 kg.m^2}}
  - {{node: 4, mass: 4.3 kg, polar_inertia: 5.375e-3 kg.m^2, transverse_inertia: 4.453e-3 kg.m^2}}
bearings:
  - {{name: middle, node: 3, {bearing}}}
planes: {{disc 1: 2, disc 2: 4}}
unbalances:
  - {{node: 2, size: 50 g.mm}}
"""


def braces(text: str) -> str:
    """Text whose braces survive str.format."""
    return text.replace("{", "{{").replace("}", "}}")


def rotor(kind: str, tmp_path: Path, text: str = ROTOR) -> RotorRig:
    path = tmp_path / "rotor.yaml"
    path.write_text(text.format(bearing=ENTRIES[kind]), encoding="utf-8")
    return load_rotor(path)


def run_up_rotor(kind: str, tmp_path: Path, text: str = RUN_UP_ROTOR) -> RunUpRotor:
    path = tmp_path / "run-up-rotor.yaml"
    path.write_text(text.format(bearing=ENTRIES[kind]), encoding="utf-8")
    return load_run_up_rotor(path)


def test_every_built_in_kind_is_tested_here() -> None:
    assert set(ENTRIES) == set(BEARINGS.names())


@pytest.mark.parametrize("kind", sorted(ENTRIES))
def test_a_rotor_stands_on_any_bearing(kind: str, tmp_path: Path) -> None:
    """Each carries half the weight, downwards.

    Its coefficients are those asked for at that load, speed and frequency.
    """
    rig = rotor(kind, tmp_path)
    assert [place.kind for place in rig.bearings] == [kind, kind]
    loads = rig.static_loads()
    assert loads["left"] == pytest.approx(loads["right"]) and loads["left"][1] < -20
    supports = rig.supports()
    point = OperatingPoint(loads["left"], rig.omega, rig.omega)
    asked = rig.place("left").bearing.at(point)
    np.testing.assert_allclose(supports[0].stiffness, asked.stiffness, rtol=1e-9)
    np.testing.assert_allclose(supports[0].damping, asked.damping, rtol=1e-9)
    forward, backward = np.abs(orbit(rig))
    assert np.isfinite(forward) and forward > 0 and backward >= 0


def test_an_isotropic_bearing_gives_the_circle_of_the_closed_form(tmp_path: Path) -> None:
    """Equal K and C in y and z without cross terms: no backward circle, and the forward one solves (K + j w C
    - w^2 M) q = u w^2.
    """
    rig = rotor("magnetic-bearing", tmp_path)
    support = rig.supports()[0]
    assert (
        support.stiffness[0, 1] == support.stiffness[1, 0] == 0
        and support.stiffness[0, 0] == support.stiffness[1, 1] > 0
    )
    forward, backward = np.abs(orbit(rig))
    assert backward < 1e-9 * forward
    supports = [NodeSupport(node, support.stiffness, support.damping) for node in (1, 3)]
    motion = unbalance_response(rig.rotor, supports, np.array([rig.omega]), {2: 20e-6}, rig.rotor.dofs(2))
    assert abs(abs(motion[0, 0]) / forward - 1) < 1e-9


def test_a_ball_bearing_on_a_rotor_is_that_of_its_file(tmp_path: Path) -> None:
    """Radially loaded in the rotor's z, with its axial preload: K_yy of the file at that load, the free dofs
    condensed by hand.
    """
    bearing = rotor("ball-bearing", tmp_path).place("left").bearing
    kind: BearingKind = BEARINGS["ball-bearing"]
    settings = BallBearingSettings(
        kind="ball-bearing",
        elements=9,
        stiffness_constant=1.10e10,
        groove_distance="0.5953 mm",
        pitch_radius="30.1488 mm",
        loads=Loads(0.0, -30.0, 427.0),
    )
    (whole,) = kind.coefficients([settings])
    compliance = np.linalg.inv(whole.stiffness)
    asked = bearing.at(OperatingPoint((0.0, -30.0), 100.0, 100.0))
    np.testing.assert_allclose(np.linalg.inv(asked.stiffness), compliance[:2, :2], rtol=1e-6, atol=1e-14)


def test_a_magnetic_bearing_answers_at_the_frequency_of_the_motion(tmp_path: Path) -> None:
    bearing = rotor("magnetic-bearing", tmp_path).place("left").bearing
    slow, fast = (
        bearing.at(OperatingPoint((0.0, -30.0), 2 * np.pi * 40, 2 * np.pi * f)).stiffness[0, 0]
        for f in (10.0, 200.0)
    )
    assert slow != fast


@pytest.mark.parametrize(
    ("kind", "extra", "said"),
    [
        (
            "ball-bearing",
            "cage_angle: 0 deg, shaft: {mass: 1 kg, inertia_x: 1 kg.m^2}",
            "bearings.1.shaft: follows from the rotor",
        ),
        ("magnetic-bearing", "speed: 50 Hz", "bearings.1.speed: follows from the rotor"),
        ("journal-bearing", "load: 50 N", "bearings.1.load: unknown key"),
    ],
)
def test_what_follows_from_the_rotor_is_refused_at_its_place(
    kind: str, extra: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        rotor(
            kind,
            tmp_path,
            ROTOR.replace(
                "{{name: left, node: 1, {bearing}}}",
                f"{{{{name: left, node: 1, {{bearing}}, {extra.replace('{', '{{').replace('}', '}}')}}}}}",
            ),
        )
    assert said in str(caught.value) and "rotor.yaml:9" in str(caught.value)


def test_an_unknown_kind_is_answered_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown bearing 'ball-baring'; did you mean 'ball-bearing'"):
        rotor("ball-bearing", tmp_path, ROTOR.replace("{bearing}", "kind: ball-baring"))


def small_run(rig: RunUpRotor, change: float) -> RunUp:
    """A run-up of the rotor whose bearing is stiffer and damps more by *change*; exact, with 1 % stated."""
    speed = np.linspace(500, 2500, 9) * RPM
    bare = RunUp(
        "run",
        20.0,
        speed,
        rig.plane_names,
        np.ones((9, 2, 2)) + 0j,
        amplitude_error=np.ones((9, 2, 2)),
        phase_error=np.ones((9, 2, 2)),
        unbalance=rig.known_unbalance,
    )
    stiffness, damping = rig.start_coefficients(20.0, speed)
    response = rig.excite(bare).response(change * stiffness, change * damping).reshape(9, 2, 2)
    return replace(
        bare,
        response=response,
        amplitude_error=0.01 * np.abs(response),
        phase_error=np.full(response.shape, 0.01),
    )


@pytest.mark.parametrize("kind", sorted(ENTRIES))
def test_a_run_up_on_any_bearing(kind: str, tmp_path: Path) -> None:
    """The start coefficients reproduce the exact responses.

    Point by point the stiffer bearing's responses are met.
    """
    rig = run_up_rotor(kind, tmp_path)
    stiffness, damping = rig.start_coefficients(20.0, np.array([100.0, 150.0]))
    assert stiffness.shape == damping.shape == (2, 2, 2) and np.all(np.isfinite(stiffness))
    (fit,) = fit_points(rig, [small_run(rig, 1.1)])
    # A ridge of 15 % about the start values holds what is not seen, so that 10 % are no more than two thirds
    # of a deviation away.
    assert fit.chi2 / fit.n_datum < 0.1


def test_x_lies_along_the_load_and_y_a_quarter_turn_further(tmp_path: Path) -> None:
    """A ball bearing is stiffest along its load: the first direct coefficient of a run-up, the second of the
    bearing's frame.
    """
    rig = run_up_rotor("ball-bearing", tmp_path)
    along, _ = rig.start_coefficients(800.0, np.array([100.0]))
    own = rig.place.bearing.at(OperatingPoint((0.0, -800.0), 100.0, 100.0)).stiffness
    assert along[0, 0, 0] == pytest.approx(own[1, 1]) and along[0, 1, 1] == pytest.approx(own[0, 0])


@pytest.mark.parametrize("kind", sorted(set(ENTRIES) - {"journal-bearing"}))
def test_what_needs_an_oil_film_says_so(kind: str, tmp_path: Path) -> None:
    rig = run_up_rotor(kind, tmp_path)
    with pytest.raises(ConfigError, match=f"needs an oil film, bearing 'middle' is a {kind}"):
        fit_jointly(rig, [small_run(rig, 1.1)])
    settings: dict[str, Any] = {"rotor": "rotor.yaml", "rig": rotor(kind, tmp_path)}
    with pytest.raises(ConfigError, match=f"wear needs an oil film, bearing 'right' is a {kind}"):
        WearSettings(**settings)


def test_wear_is_looked_for_beside_a_ball_bearing(tmp_path: Path) -> None:
    """Only the worn bearing needs a film; the other stands as it is."""
    text = ROTOR.replace("node: 1, {bearing}", f"node: 1, {braces(ENTRIES['ball-bearing'])}")
    rig = rotor("journal-bearing", tmp_path, text)
    assert [place.kind for place in rig.bearings] == ["ball-bearing", "journal-bearing"]
    assert WearSettings("rotor.yaml", rig=rig).rig is rig
    assert rig.with_bearings(viscosity=0.06).place("left") == rig.place("left")


def test_without_speeds_the_run_ups_say_where_to_look(tmp_path: Path) -> None:
    text = RUN_UP_ROTOR.replace("{bearing}", FALAH)
    rig = run_up_rotor("journal-bearing", tmp_path, text.replace("speeds: 400-3000 rpm\n", ""))
    with pytest.raises(ConfigError, match="speeds: are missing"):
        rig.critical_speed(rig.start(LOAD))
    run = small_run(rig, 1.0)
    over = with_search_range(rig, [run])
    assert over.search.low == run.speed[0] and over.search.high == run.speed[-1]
    assert over.search.highest == 2 * run.speed[-1] and with_search_range(over, [run]) is over
    of_file = run_up_rotor("journal-bearing", tmp_path, text)
    assert over.critical_speed(over.start(LOAD)) == pytest.approx(
        of_file.critical_speed(rig.start(LOAD)), rel=1e-4
    )
