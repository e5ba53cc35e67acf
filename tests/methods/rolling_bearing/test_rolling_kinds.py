"""From settings to coefficients: sweeps solved together, held dofs, damping, findings, constants from
geometry.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.bearings.kinds import BearingCoefficients, OperatingPoint
from labpipe.errors import ConfigError, DataError
from labpipe.methods.rolling_bearing.bearing import BALL, ROLLER, rolling_coefficients, rolling_response
from labpipe.methods.rolling_bearing.equilibrium import equilibrium
from labpipe.methods.rolling_bearing.loads import sdof_stiffness
from labpipe.methods.rolling_bearing.settings import (
    BallBearingSettings,
    BallGeometrySettings,
    Displacements,
    Loads,
    RollerBearingSettings,
    ShaftSettings,
)
from tests.methods.rolling_bearing.displaced_rings import load_vector

GIVEN = BallBearingSettings(
    kind="ball-bearing",
    elements=9,
    stiffness_constant=1.10e10,
    groove_distance=5.953e-4,
    pitch_radius=30.1488e-3,
    loads=Loads(y=-24.0, z=427.0),
)
ROLLERS = RollerBearingSettings(
    kind="roller-bearing", elements=14, pitch_radius=32.5e-3, roller_length=9.6e-3, loads=Loads(y=-100.0)
)


def amount(found: BearingCoefficients, name: str) -> float:
    return next(each.value for each in (*found.rest, *found.notes) if each.name == name)


def test_settings_give_what_the_functions_give(deep_groove) -> None:  # type: ignore[no-untyped-def]
    (found,) = rolling_coefficients([GIVEN])
    state = equilibrium(deep_groove, load_vector(y=-24.0, z=427.0))
    np.testing.assert_allclose(found.stiffness, state.stiffness[0])
    assert amount(found, "z") == pytest.approx(state.displacement[0, 2]) and amount(
        found, "load_y"
    ) == pytest.approx(-24)
    np.testing.assert_allclose(found.element_state["element_load"], state.contacts.load[0])
    assert not found.damping.any() and found.findings == ()


def test_many_settings_keep_their_order_whatever_differs() -> None:
    """Loads, clearance (another bearing) and a held dof (another set of unknowns) change from one to the
    next.
    """
    settings = [
        GIVEN,
        replace(GIVEN, clearance=1e-5),
        replace(GIVEN, loads=Loads(z=900.0)),
        replace(GIVEN, displacements=Displacements(bx=0.0)),
        replace(GIVEN, clearance=1e-5, loads=Loads(x=50.0, z=90.0)),
        replace(GIVEN, cage_angle=0.2, damping_factor=1e-5),
    ]
    together = rolling_coefficients(settings)
    for entry, found in zip(settings, together, strict=True):
        (alone,) = rolling_coefficients([entry])
        scale = np.sqrt(np.outer(np.diag(alone.stiffness), np.diag(alone.stiffness)))
        assert np.max(np.abs(found.stiffness - alone.stiffness) / scale) < 1e-8
        assert amount(found, "load_z") == pytest.approx(entry.loads.z)
        np.testing.assert_allclose(found.damping, entry.damping_factor * found.stiffness)
    assert together[5].element_state["element_angle"][0] == pytest.approx(0.2)


def test_geometry_stands_in_for_what_is_not_given() -> None:
    shape = BallGeometrySettings(
        ball_diameter=11.90625e-3, pitch_diameter=60e-3, inner_conformity=0.5125, outer_conformity=0.5375
    )
    derived = replace(GIVEN, stiffness_constant=None, groove_distance=None, pitch_radius=None, geometry=shape)
    assert derived.bearing().groove_distance == pytest.approx(5.953e-4, rel=1e-4)
    assert (
        derived.bearing().stiffness_constant == pytest.approx(1.0976e10, rel=1e-3) == derived.hertz_constant()
    )
    beside = rolling_coefficients([replace(GIVEN, geometry=shape)])[0]
    assert [amount(beside, name) for name in ("stiffness_constant", "stiffness_constant_hertz")] == [
        1.10e10,
        derived.hertz_constant(),
    ]


def test_ceramic_balls_are_stiffer() -> None:
    shape = BallGeometrySettings(ball_diameter=12e-3, pitch_diameter=60e-3)
    hybrid = replace(shape, ball_youngs_modulus=310e9, ball_poissons_ratio=0.26)
    steel, ceramic = (
        replace(GIVEN, stiffness_constant=None, geometry=each).bearing().stiffness_constant
        for each in (shape, hybrid)
    )
    assert 1.1 < ceramic / steel < 1.3


@pytest.mark.parametrize(
    ("settings", "held"),
    [
        (GIVEN, ()),
        (replace(GIVEN, displacements=Displacements(by=1e-4)), ("by",)),
        (ROLLERS, ("z", "bx", "by")),
        (replace(ROLLERS, contact_angle=0.2), ("bx", "by")),
        (replace(ROLLERS, contact_angle=0.2, displacements=Displacements(z=1e-5)), ("z", "bx", "by")),
        (replace(ROLLERS, contact_angle=0.2, loads=Loads(mx=1.0)), ("by",)),
    ],
)
def test_what_is_held(settings, held: tuple[str, ...]) -> None:  # type: ignore[no-untyped-def]
    assert settings.fixed_dofs == held


def test_cylindrical_rollers_in_closed_form() -> None:
    """Radial load on the line of a roller: F = K_n dy^(10/9) sum max(cos, 0)^(19/9)."""
    aligned = replace(ROLLERS, loads=Loads(x=100.0))
    (found,) = rolling_coefficients([aligned])
    lobes = np.sum(np.maximum(np.cos(2 * np.pi * np.arange(14) / 14), 0) ** (19 / 9))
    assert amount(found, "x") == pytest.approx(
        (100 / (amount(found, "stiffness_constant") * lobes)) ** 0.9, rel=1e-9
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: replace(GIVEN, stiffness_constant=None),
            "stiffness_constant: is missing; give it, or geometry",
        ),
        (lambda: replace(GIVEN, groove_distance=None), "groove_distance: is missing"),
        (lambda: replace(ROLLERS, pitch_radius=None), "pitch_radius: is missing"),
        (
            lambda: replace(GIVEN, displacements=Displacements(y=0.0)),
            "displacements.y and loads.y are both given",
        ),
        (lambda: replace(GIVEN, damping_factor=-1e-5), "damping_factor must not be negative"),
        (
            lambda: replace(GIVEN, geometry=BallGeometrySettings(ball_diameter=21e-3, pitch_diameter=60e-3)),
            "9 balls of 21 mm do not fit on the pitch circle",
        ),
        (
            lambda: BallGeometrySettings(ball_diameter=12e-3, pitch_diameter=60e-3, ball_youngs_modulus=0.0),
            "Young's modulus above zero",
        ),
    ],
)
def test_faults_of_the_settings(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError) as fault:
        make()
    assert message in str(fault.value)


def test_findings_name_what_must_not_be_overlooked(angular) -> None:  # type: ignore[no-untyped-def]
    mirrored = BallBearingSettings(
        kind="ball-bearing",
        elements=12,
        contact_angle=angular.contact_angle,
        stiffness_constant=6e9,
        groove_distance=5.6e-4,
        pitch_radius=0.03,
        loads=Loads(z=-100.0),
    )
    loose = replace(GIVEN, clearance=3e-5, loads=Loads(x=1.0))
    assert [finding.code for finding in rolling_coefficients([mirrored])[0].findings] == ["mirrored"]
    (finding,) = rolling_coefficients([loose])[0].findings
    assert finding.code == "indeterminate" and finding.message.startswith("1 of 9 elements carry")


def test_a_shaft_has_its_frequencies_and_its_response() -> None:
    shaft = ShaftSettings(2.45, 1.24e-2, band=(10.0, 110.0), lines=11)
    settings = replace(GIVEN, shaft=shaft, damping_factor=1e-5)
    (found,) = rolling_coefficients([settings])
    amounts = {each.name: each.value for each in found.shaft}
    assert amounts["f_1"] == pytest.approx(63.09, abs=0.01) and amounts["zeta_1"] == pytest.approx(
        np.pi * 1e-5 * amounts["f_1"]
    )
    np.testing.assert_allclose(amounts["sdof_k_z"], sdof_stiffness(shaft.body, found.stiffness)[2])
    response = rolling_response(settings, found)
    np.testing.assert_allclose(response.frequency, np.linspace(10, 110, 11))
    dynamic = np.linalg.inv(response.matrix[3])
    w = 2 * np.pi * 40
    np.testing.assert_allclose(
        dynamic,
        found.stiffness * (1 + 1j * w * 1e-5) - w**2 * np.diag(shaft.body.inertias),
        rtol=1e-6,
        atol=1e-2,
    )
    assert rolling_response(GIVEN, found) is None and rolling_coefficients([GIVEN])[0].shaft == ()


def test_units_and_relative_coupling() -> None:
    (found,) = rolling_coefficients([GIVEN])
    assert [found.unit(0, 0), found.unit(0, 4), found.unit(4, 0), found.unit(3, 3)] == [
        "N/m",
        "N/rad",
        "N/rad",
        "N.m/rad",
    ]
    np.testing.assert_allclose(np.diag(found.relative), 1)
    assert found.relative[0, 4] == pytest.approx(
        found.stiffness[0, 4] / np.sqrt(found.stiffness[0, 0] * found.stiffness[4, 4])
    )
    assert np.all(rolling_coefficients([ROLLERS])[0].relative[2:, 2:] == 0)


def test_coefficients_are_checked_and_read_only() -> None:
    with pytest.raises(DataError, match=r"stiffness has the shape \(2, 3\), \(2, 2\) is needed"):
        BearingCoefficients(dofs=("y", "z"), stiffness=np.ones((2, 3)), damping=np.ones((2, 2)))
    found = BearingCoefficients(dofs=("y", "z"), stiffness=np.eye(2), damping=np.eye(2))
    with pytest.raises(ValueError, match="read-only"):
        found.stiffness[0, 0] = 2


def test_the_kinds_name_their_settings() -> None:
    assert BALL.settings is BallBearingSettings and ROLLER.settings is RollerBearingSettings
    assert BALL.bare_units == {"stiffness_constant": "N/m^1.5"}


@pytest.mark.parametrize(
    ("entries", "what"),
    [
        ({"loads": Loads(x=1.0)}, "loads.x"),
        ({"loads": Loads(y=0.0)}, "loads.y"),
        ({"displacements": Displacements(y=0.0)}, "displacements.y"),
        ({"shaft": ShaftSettings(mass=1.0, inertia_x=1.0)}, "shaft"),
    ],
)
def test_what_follows_from_the_rotor_is_not_given(entries: dict[str, object], what: str) -> None:
    assert BALL.mount is not None
    free = replace(GIVEN, loads=Loads(z=427.0))
    assert BALL.mount(free).at(OperatingPoint((-24.0, 0.0), 10.0, 10.0)).stiffness.shape == (2, 2)
    with pytest.raises(ConfigError, match=f"^{what}: follows from the rotor"):
        BALL.mount(replace(free, **entries))


def test_elements_without_load_are_not_counted() -> None:
    """Nine elements every 40 deg, pushed in -y with clearance: those at 200 to 320 deg may carry, the one at
    0 deg stands across.
    """
    pushed = replace(
        GIVEN, clearance=5e-6, loads=Loads(y=-2000.0), displacements=Displacements(z=0.0, bx=0.0, by=0.0)
    )
    (found,) = rolling_coefficients([pushed])
    carrying = np.flatnonzero(found.element_state["element_load"])
    assert carrying.tolist() == [5, 6, 7, 8] and amount(found, "loaded_elements") == 4


def test_the_range_over_a_passage_holds_the_stiffness_at_the_cage_angle_of_the_file() -> None:
    """24 positions of 40 deg miss the least k_xx, near 0.9 deg, where two balls come loose."""
    loads = Loads(y=-200.0)
    (found,) = rolling_coefficients([replace(GIVEN, loads=loads, cage_angle=np.deg2rad(0.9))])
    assert np.all(found.lowest <= found.stiffness) and np.all(found.stiffness <= found.highest)
