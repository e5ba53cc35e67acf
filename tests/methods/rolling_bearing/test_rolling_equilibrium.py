"""Rest positions: the loads come back, whatever the mix; what cannot be carried is refused in plain words."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from labpipe.errors import ConfigError, FitError
from labpipe.methods.rolling_bearing.equilibrium import EquilibriumProblem, equilibrium, solve
from labpipe.methods.rolling_bearing.loads import DOFS, ElementFrame, RollingBearing
from tests.methods.rolling_bearing.displaced_rings import bearing_loads, load_vector

HELD_TILT = ("bx", "by")


def misfit(bearing: RollingBearing, found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest |F - f| relative to the case's load, moments as forces at the pitch radius."""
    scale = np.array([1, 1, 1, bearing.pitch_radius, bearing.pitch_radius])
    return float(
        np.max(np.linalg.norm((found - wanted) / scale, axis=1) / np.linalg.norm(wanted / scale, axis=1))
    )


@pytest.mark.parametrize("name", ["deep_groove", "angular"])
def test_every_mix_of_loads_from_1_n_to_20_kn_is_solved(name: str, request, mixed_loads, rng, twin) -> None:
    bearing = request.getfixturevalue(name)
    loads = mixed_loads(bearing, rng, 1000)
    state = equilibrium(bearing, loads, cage_angle=rng.uniform(0, 1, 1000))
    assert misfit(bearing, state.load, loads) < 1e-9
    for case in range(0, 1000, 100):
        written_out = twin(bearing, state.displacement[case], state.angles[case, 0])
        np.testing.assert_allclose(written_out, loads[case], atol=1e-6 * np.abs(loads[case]).max())


@pytest.mark.parametrize("clearance", [-5e-6, 1e-5, 4e-5])
def test_clearance_and_interference(clearance: float, mixed_loads, rng) -> None:
    bearing = RollingBearing(9, 1.10e10, 30.1488e-3, clearance=clearance, groove_distance=5.953e-4)
    loads = mixed_loads(bearing, rng, 300)
    assert misfit(bearing, equilibrium(bearing, loads).load, loads) < 1e-9


@pytest.mark.long
def test_taper_rollers_carry_what_lies_between_their_normals(taper: RollingBearing, rng) -> None:
    """A load is carried exactly when it is a sum of pushes along the rollers' normals: an independent linear
    programme decides.
    """
    psi, a0 = taper.angles(), taper.contact_angle
    normals = np.array([np.cos(a0) * np.cos(psi), np.cos(a0) * np.sin(psi), np.full_like(psi, np.sin(a0))])
    outcomes = []
    for _ in range(200):
        radial = rng.normal(size=2) * 10 ** rng.uniform(0, 3.5)
        loads = np.array([*radial, np.linalg.norm(radial) * np.tan(a0) * rng.uniform(0.7, 2), 0, 0])
        possible = optimize.nnls(normals, loads[:3])[1] < 1e-9 * np.linalg.norm(loads)
        outcomes.append(possible)
        if possible:
            state = equilibrium(taper, loads, fixed_dofs=HELD_TILT)
            np.testing.assert_allclose(state.load[0, :3], loads[:3], atol=1e-9 * np.abs(loads).max())
        else:
            with pytest.raises(FitError, match="no rest position: the bearing cannot carry x"):
                equilibrium(taper, loads, fixed_dofs=HELD_TILT)
    assert 20 < sum(outcomes) < 180


def test_the_solution_does_not_depend_on_the_start(deep_groove: RollingBearing, rng) -> None:
    load = np.tile([100.0, -2000.0, 700.0, 20.0, 0.0], (50, 1))
    problem = EquilibriumProblem(deep_groove, ElementFrame.at(deep_groove.angles(), 1.0), load, np.arange(5))
    held_nowhere, solved = solve(problem, np.zeros((50, 5)))
    started, also = solve(problem, rng.normal(scale=2e-4, size=(50, 5)))
    assert solved.all() and also.all()
    np.testing.assert_allclose(started, held_nowhere, atol=1e-15)


@pytest.mark.parametrize("held", [("x",), ("z",), HELD_TILT, ("x", "z", "by"), DOFS])
def test_any_dof_may_be_held_instead_of_loaded(angular: RollingBearing, held: tuple[str, ...], rng) -> None:
    free_loads = load_vector(y=-200.0, x=50.0, z=900.0, mx=4.0)
    whole = equilibrium(angular, free_loads)
    again = equilibrium(
        angular,
        np.where([name in held for name in DOFS], rng.normal(size=5), free_loads),
        whole.displacement,
        held,
    )
    np.testing.assert_allclose(again.load, whole.load, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(again.stiffness, whole.stiffness, rtol=1e-6, atol=1)


def test_many_cases_at_once_equal_one_by_one(deep_groove: RollingBearing, mixed_loads, rng) -> None:
    loads = mixed_loads(deep_groove, rng, 40)
    together = equilibrium(deep_groove, loads)
    for case in range(40):
        alone = equilibrium(deep_groove, loads[case])
        scale = np.sqrt(np.diag(alone.stiffness[0]))
        assert np.max(np.abs(alone.stiffness[0] - together.stiffness[case]) / np.outer(scale, scale)) < 1e-7


def test_a_lighter_bearing_needs_no_luck(deep_groove: RollingBearing) -> None:
    """1 mN to 20 kN purely axial at contact angle 0, where K vanishes at q = 0.

    Dz by a scalar root finder.
    """
    forces = np.geomspace(1e-3, 2e4, 60)
    state = equilibrium(deep_groove, np.array([load_vector(z=force) for force in forces]))
    for force, dz in zip(forces, state.displacement[:, 2], strict=True):
        exact = optimize.brentq(
            lambda s, f=force: bearing_loads(deep_groove, [0, 0, s, 0, 0])[0, 2] - f, 1e-7, 5e-4, xtol=1e-20
        )
        assert dz == pytest.approx(exact, rel=1e-9)


def test_pure_radial_load_in_closed_form(deep_groove: RollingBearing) -> None:
    """F = K_n dx^1.5 sum cos(psi)^2.5 over the loaded half: dx from it."""
    cosines = np.cos(deep_groove.angles())
    dx = (500 / (1.10e10 * np.sum(np.maximum(cosines, 0) ** 2.5))) ** (2 / 3)
    state = equilibrium(deep_groove, load_vector(x=500.0))
    np.testing.assert_allclose(state.displacement[0], [dx, 0, 0, 0, 0], rtol=1e-9, atol=1e-12)
    assert np.sum(state.contacts.load > 0) == 5 and state.determinate[0]


def test_one_ball_alone_leaves_the_position_open() -> None:
    """With clearance and a light load on the ball at psi = 0, sideways nothing acts: said, not hidden."""
    loose = RollingBearing(9, 1.10e10, 30e-3, clearance=3e-5, groove_distance=6e-4)
    state = equilibrium(loose, load_vector(x=1.0))
    assert np.sum(state.contacts.load > 0) == 1 and not state.determinate[0]
    held = equilibrium(loose, load_vector(x=1.0), fixed_dofs=("y", "z", "bx", "by"))
    assert held.determinate[0] and held.displacement[0, 0] == pytest.approx(3e-5 + (1 / 1.10e10) ** (2 / 3))


def test_no_load_is_rest_without_stiffness(deep_groove: RollingBearing) -> None:
    state = equilibrium(deep_groove)
    assert np.abs(state.load).max() < 1e-6 and not state.determinate[0]


def test_reversed_axial_load_gives_the_mirror_and_says_so(angular: RollingBearing) -> None:
    there, back = (equilibrium(angular, load_vector(z=force)) for force in (445.0, -445.0))
    assert not there.mirrored[0] and back.mirrored[0]
    np.testing.assert_allclose(back.contact_angle, -there.contact_angle, rtol=1e-9)
    np.testing.assert_allclose(np.diag(back.stiffness[0]), np.diag(there.stiffness[0]), rtol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"loads": load_vector(y=-100)}, ConfigError, "leave the tilt bx without support"),
        (
            {"loads": load_vector(z=1.0), "fixed_dofs": ("bx",)},
            ConfigError,
            "leave the tilt by without support",
        ),
        (
            {"loads": load_vector(z=-10), "fixed_dofs": HELD_TILT},
            FitError,
            "no rest position: the bearing cannot carry z -10 N",
        ),
        ({"loads": load_vector(z=1e9), "fixed_dofs": HELD_TILT}, FitError, "element 1 is pressed in by"),
        (
            {"loads": [load_vector(z=9), load_vector(x=9, z=1)], "fixed_dofs": HELD_TILT},
            FitError,
            "load case 2: no rest position",
        ),
    ],
)
def test_what_cannot_be_carried_is_refused(
    taper: RollingBearing, arguments: dict, kind: type, message: str
) -> None:
    with pytest.raises(kind, match=message):
        equilibrium(taper, **arguments)


@pytest.mark.parametrize(
    ("held", "loads", "message"),
    [
        (HELD_TILT, {"x": 100.0}, "leave z without support"),
        (HELD_TILT, {"x": 100.0, "z": 5.0}, "carry no axial load"),
    ],
)
def test_cylindrical_rollers_need_z_held(
    held: tuple[str, ...], loads: dict[str, float], message: str
) -> None:
    rollers = RollingBearing(14, 1.0e9, 32.5e-3)
    with pytest.raises(ConfigError, match=message):
        equilibrium(rollers, load_vector(**loads), fixed_dofs=held)
    state = equilibrium(rollers, load_vector(x=100.0), fixed_dofs=("z", *held))
    assert state.load[0, 0] == pytest.approx(100.0)


def test_too_large_a_load_is_beyond_the_model(deep_groove: RollingBearing) -> None:
    with pytest.raises(FitError, match=r"is pressed in by .* um; the model holds up to 595.3 um"):
        equilibrium(deep_groove, load_vector(x=5e6))
