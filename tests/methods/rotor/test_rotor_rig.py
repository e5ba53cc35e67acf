"""The rotor in its bearings as one thing: what it refuses, its loads, and the rig with other bearings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing.bearing import journal_equilibrium
from labpipe.methods.rotor.rig import BearingPlace, RotorRig, Unbalance
from tests.methods.wear.worn_cases import FINE, RIG, worn_rig


def test_supports_are_those_of_the_bearings_under_their_loads() -> None:
    supports = worn_rig(20.0, 5.0).supports(FINE)
    assert [support.node for support in supports] == [4, 14]
    for place, support in zip(RIG.bearings, supports, strict=True):
        bearing = (
            replace(place.bearing, wear_depth=20e-6, wear_angle=np.deg2rad(5))
            if place.name == "bearing 2"
            else place.bearing
        )
        own = journal_equilibrium(bearing, RIG.static_loads()[place.name], 2 * np.pi * 50, FINE)
        np.testing.assert_allclose(support.stiffness, own.stiffness, rtol=1e-9)
        np.testing.assert_allclose(support.damping, own.damping, rtol=1e-9)


def test_vertical_loads_are_exactly_vertical() -> None:
    assert [load[0] for load in RIG.static_loads().values()] == [0.0, 0.0]


def test_loads_follow_the_lever_rule() -> None:
    """80 N more at node 10 splits between nodes 4 and 14 by their distances 260 mm and 160 mm + 40 mm - 20 mm
    of the table.
    """
    without = replace(RIG, loads=()).static_loads()
    more = {name: RIG.static_loads()[name][1] - without[name][1] for name in without}
    position = np.cumsum([0, *(piece.length for piece in RIG.rotor.elements)])
    share = (position[9] - position[3]) / (position[13] - position[3])
    assert more["bearing 2"] == pytest.approx(-80 * share) and more["bearing 1"] == pytest.approx(
        -80 * (1 - share)
    )


def test_other_speed_and_other_bearings_leave_the_rest() -> None:
    assert RIG.at_speed(40.0).omega == pytest.approx(80 * np.pi) and RIG.at_speed(40.0).rotor == RIG.rotor
    changed = RIG.with_bearings(clearance=95e-6)
    assert [place.bearing.clearance for place in changed.bearings] == [95e-6, 95e-6]
    assert [place.bearing.viscosity for place in changed.bearings] == [0.1044, 0.1044]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 0.0}, "speed above zero"),
        ({"bearings": RIG.bearings[:1]}, "at least two"),
        ({"bearings": (RIG.bearings[0], replace(RIG.bearings[0], name="x"))}, "two bearings have one node"),
        (
            {"bearings": (RIG.bearings[0], replace(RIG.bearings[1], name="bearing 1"))},
            "two bearings have one name",
        ),
        (
            {"bearings": (RIG.bearings[0], BearingPlace("far", 40, RIG.bearings[0].bearing))},
            "bearing 'far' sits on node 40",
        ),
        ({"loads": ((17, 0.0, 1.0),)}, "a load sits on node 17"),
        ({"unbalances": (Unbalance(0, 1e-5),)}, "an unbalance sits on node 0"),
        ({"response": 20}, "the response sits on node 20"),
    ],
)
def test_impossible_rigs_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(RIG, **changes)


def test_place_by_name() -> None:
    assert RIG.place("bearing 1").node == 4 and RIG.place("").node == 14
    with pytest.raises(ConfigError, match="did you mean 'bearing 1'"):
        RotorRig.place(RIG, "baring 1")
