"""The response to unbalance over speed: circles by hand from the orbit, wear, and settings that make no
sense.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing.kind import Wear
from labpipe.methods.rotor.rig import RotorRig, Unbalance
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.section import (
    PeakChange,
    UnbalanceCase,
    UnbalanceRuns,
    UnbalanceSettings,
    orbit,
    unbalance_outcome,
    unbalance_runs,
)
from labpipe.project.rules import Rule
from tests.methods.rotor.whole_response import frequency_response

LAVAL = Path(__file__).parents[3] / "configs" / "rotors" / "laval.yaml"
CASES = (("healthy", Wear()), ("wear 1", Wear(20.52e-6, float(np.deg2rad(21)))))


@pytest.fixture(scope="module")
def rig() -> RotorRig:
    return load_rotor(LAVAL)


@pytest.fixture(scope="module")
def runs(rig: RotorRig) -> UnbalanceRuns:
    return unbalance_runs(UnbalanceSettings("laval.yaml", (48.0, 56.0), CASES, 2.0, "bearing 2", rig))


def test_orbit_is_the_response_to_the_force_that_the_unbalance_makes(rig: RotorRig) -> None:
    """Independent: H from node 7 to 11 times u Omega^2 (1, -j).

    Then the circles (y + j z) / 2 and (y - j z) / 2 of its phasors.
    """
    h = frequency_response(
        rig.rotor, rig.supports(), np.array([rig.speed]), rig.omega, rig.rotor.dofs(11), rig.rotor.dofs(7)
    )[0]
    y, z = h @ np.array([1, -1j]) * 5.5e-5 * rig.omega**2
    np.testing.assert_allclose(np.abs(orbit(rig)), np.abs([(y + 1j * z) / 2, (y - 1j * z) / 2]), rtol=1e-9)


def test_a_phase_turns_the_orbit_but_not_its_circles(rig: RotorRig) -> None:
    turned = replace(rig, unbalances=(Unbalance(7, 5.5e-5, 1.0),))
    # The scaled system has the condition number 1e5, so rounding is 2e-11 of the large circle and, 39 times
    # less, 8e-10 of the small one.
    np.testing.assert_allclose(np.abs(orbit(turned)), np.abs(orbit(rig)), rtol=1e-9)
    opposite = replace(rig, unbalances=(Unbalance(7, 5.5e-5), Unbalance(7, 3.5e-5, np.pi)))
    np.testing.assert_allclose(np.abs(orbit(opposite)), np.abs(orbit(rig)) * 2.0 / 5.5, rtol=1e-9)


def test_every_case_runs_over_every_speed_with_films_of_that_speed(
    rig: RotorRig, runs: UnbalanceRuns
) -> None:
    assert runs.speed == (48.0, 50.0, 52.0, 54.0, 56.0) and [case.name for case in runs.cases] == [
        "healthy",
        "wear 1",
    ]
    assert (runs.bearing, runs.node, runs.rotor) == ("bearing 2", 11, rig.name)
    worn = rig.with_bearings(("bearing 2",), wear_depth=20.52e-6, wear_angle=float(np.deg2rad(21))).at_speed(
        54.0
    )
    assert [runs.cases[1].forward[3], runs.cases[1].backward[3]] == pytest.approx(
        np.abs(orbit(worn)).tolist()
    )


def test_wear_enlarges_the_backward_circle(runs: UnbalanceRuns) -> None:
    healthy, worn = runs.cases
    assert all(after > 3 * before for before, after in zip(healthy.backward, worn.backward, strict=True))


def test_peaks_and_their_speeds() -> None:
    case = UnbalanceCase("a", 0.0, 0.0, (1e-6, 3e-6, 2e-6), (4e-7, 2e-7, 1e-7))
    values = UnbalanceRuns("r", "b", 1, (40.0, 41.0, 42.0), (case,)).values(case)
    assert values == {
        "forward_peak": (3e-6, "m"),
        "forward_speed": (41.0, "Hz"),
        "backward_peak": (4e-7, "m"),
        "backward_speed": (40.0, "Hz"),
    }


def test_speeds_reach_their_end_and_never_beyond() -> None:
    assert (
        UnbalanceSettings("r", (40.0, 65.0), CASES, 0.5).speed.tolist() == np.arange(40, 65.25, 0.5).tolist()
    )
    assert UnbalanceSettings("r", (40.0, 41.0), CASES, 0.4).speed == pytest.approx([40.0, 40.4, 40.8])
    assert UnbalanceSettings("r", (0.1, 0.4), CASES, 0.1).speed == pytest.approx([0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize(
    ("speeds", "step", "said"),
    [((0.0, 10.0), 1.0, "above zero"), ((9.0, 5.0), 1.0, "is empty"), ((5.0, 9.0), 0.0, "positive"), ((5.0,
    9.0), 5.0, "no longer"),
     ((5.0, 9.0), 1e-3, "more than 2000")],
)  # fmt: skip
def test_speeds_that_make_no_sense_are_refused(speeds: tuple[float, float], step: float, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        UnbalanceSettings("r", speeds, CASES, step)


def test_rotor_without_unbalance_unknown_bearing_or_impossible_wear_is_refused(rig: RotorRig) -> None:
    for none in ((), (Unbalance(2, 0.0),)):
        with pytest.raises(ConfigError, match="the rotor has no unbalance"):
            UnbalanceSettings("r", (40.0, 50.0), CASES, rig=replace(rig, unbalances=none))
    with pytest.raises(ConfigError, match="no bearing 'left'"):
        UnbalanceSettings("r", (40.0, 50.0), bearing="left", cases=CASES, rig=rig)
    with pytest.raises(ConfigError, match="does not fit a clearance"):
        UnbalanceSettings("r", (40.0, 50.0), cases=(("deep", Wear(200e-6)),), rig=rig)
    with pytest.raises(ConfigError, match="no rotor was read"):
        unbalance_runs(UnbalanceSettings("r", (40.0, 50.0), cases=CASES))


@pytest.mark.long
def test_uncertainties_of_films_make_peaks_uncertain(tmp_path: Path) -> None:
    """Half the difference of runs on rotor files with 3 % more and less viscosity.

    Peaks of parabolas through three speeds.
    """
    text = LAVAL.read_text(encoding="utf-8")
    files = {"uncertainty": "0.07 Pa.s +- 3 % (source=oil)", "above": "0.0721 Pa.s", "below": "0.0679 Pa.s"}
    found = {}
    for name, viscosity in files.items():
        (tmp_path / name).write_text(
            text.replace("viscosity: 0.07 Pa.s", f'viscosity: "{viscosity}"'), encoding="utf-8"
        )
        rig = load_rotor(tmp_path / name)
        found[name] = unbalance_runs(
            UnbalanceSettings("r", (51.0, 53.0), CASES[1:], 0.5, "bearing 2", rig)
        ).cases[0]
    change, step = found["uncertainty"].changes
    assert change.source == "oil" and (step.forward_peak, step.forward_speed) == (
        0.0,
        pytest.approx(0.5 / 12**0.5),
    )
    assert not found["above"].changes and found["above"].error("forward_peak") is None

    def peak(name: str) -> tuple[float, float]:
        radius = np.array(found[name].forward)
        at = int(np.argmax(radius))
        curve = np.polyfit([-0.5, 0.0, 0.5], radius[at - 1 : at + 2], 2)
        shift = -curve[1] / (2 * curve[0])
        return float(np.polyval(curve, shift)), 51.0 + 0.5 * at + shift

    above, below = peak("above"), peak("below")
    assert change.forward_peak == pytest.approx((above[0] - below[0]) / 2, rel=1e-6)
    assert change.forward_speed == pytest.approx((above[1] - below[1]) / 2, rel=1e-6)
    assert found["uncertainty"].error("forward_peak") == pytest.approx(abs(change.forward_peak))


def test_a_rule_with_limits_is_decided_by_the_uncertainty_of_a_peak() -> None:
    change = PeakChange("oil", 3e-6, 0.1, 4e-6, 0.2)
    case = UnbalanceCase("worn", 0.0, 0.0, (1e-5, 2e-5), (1e-6, 2e-6), (change, change))
    runs = UnbalanceRuns("rotor", "left", 1, (40.0, 41.0), (case,))
    names = ("section", "address", "fit", "which", "kind", "bound", "place")
    rule = Rule(**dict.fromkeys(names, ""), item="worn.forward_peak")
    seen = []

    def compare_number(*asked):
        seen.append(asked[1:])
        return asked[1], True, "", None

    unbalance_outcome(rule, runs, compare_number)
    assert seen == [(2e-5, "m", pytest.approx(3e-6 * np.sqrt(2)))]
