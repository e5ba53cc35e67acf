"""Loads and stiffness of displaced rings: a readable twin, finite differences, frame rotation, closed
forms.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.rolling_bearing.equilibrium import equilibrium
from labpipe.methods.rolling_bearing.loads import RollingBearing
from tests.methods.rolling_bearing.displaced_rings import bearing_loads, bearing_stiffness

KINDS = ("deep_groove", "angular", "taper")


@pytest.fixture(params=KINDS)
def bearing(request: pytest.FixtureRequest) -> RollingBearing:
    return request.getfixturevalue(request.param)


def displacements(bearing: RollingBearing, rng: np.random.Generator, n_case: int) -> np.ndarray:
    """Displacements of some 20 um, tilts alike at the pitch radius; about half of the elements are loose."""
    return rng.normal(scale=2e-5, size=(n_case, 5)) / [1, 1, 1, bearing.pitch_radius, bearing.pitch_radius]


def test_loads_equal_the_sum_over_elements_written_out(bearing: RollingBearing, twin, rng) -> None:
    q = displacements(bearing, rng, 50)
    angles = rng.uniform(0, 1, 50)
    written_out = np.array([twin(bearing, row, angle) for row, angle in zip(q, angles, strict=True)])
    scale = np.abs(written_out).max(axis=1, keepdims=True)
    # The twin forms A - A0 as a difference of lengths and loses four digits by it.
    assert np.all(np.abs(bearing_loads(bearing, q, angles) - written_out) <= 1e-10 * scale)


def test_one_cage_angle_for_all_equals_the_same_angle_for_each(bearing: RollingBearing, rng) -> None:
    q = displacements(bearing, rng, 20)
    for function in (bearing_loads, bearing_stiffness):
        np.testing.assert_allclose(
            function(bearing, q, 0.3), function(bearing, q, np.full(20, 0.3)), rtol=1e-9, atol=1e-3
        )


def nearest_opening(bearing: RollingBearing, q: np.ndarray) -> np.ndarray:
    """Distance of the element nearest to gaining or losing contact from doing so, (n_case,) [m]."""
    psi = bearing.angles()
    r, sin0, cos0 = bearing.pitch_radius, math.sin(bearing.contact_angle), math.cos(bearing.contact_angle)
    dz = q[:, 2:3] + r * (q[:, 3:4] * np.sin(psi) - q[:, 4:5] * np.cos(psi))
    dr = q[:, 0:1] * np.cos(psi) + q[:, 1:2] * np.sin(psi) - bearing.clearance
    if bearing.groove_distance is None:
        return np.abs(dr * cos0 + dz * sin0).min(axis=1)
    a0 = bearing.groove_distance
    return np.abs(np.hypot(a0 * sin0 + dz, a0 * cos0 + dr) - a0).min(axis=1)


def difference_quotient(bearing: RollingBearing, q: np.ndarray) -> np.ndarray:
    """dF/dq by a five-point formula.

    The step stays within one hundredth of the nearest opening, where F is smooth.
    """
    step = 0.01 * nearest_opening(bearing, q)[:, None]
    columns = []
    for i in range(5):
        lever = 1 if i < 3 else bearing.pitch_radius
        move = np.eye(5)[i] * step / lever
        near = bearing_loads(bearing, q + move) - bearing_loads(bearing, q - move)
        far = bearing_loads(bearing, q + 2 * move) - bearing_loads(bearing, q - 2 * move)
        columns.append((8 * near - far) / (12 * step / lever))
    return np.stack(columns, -1)


def relative_to_diagonal(difference: np.ndarray, k: np.ndarray) -> np.ndarray:
    """|d_ij| / sqrt(K_ii K_jj)."""
    diagonal = np.sqrt(np.einsum("nii->ni", k))
    return np.abs(difference) / (diagonal[:, :, None] * diagonal[:, None, :])


def test_stiffness_is_the_derivative_of_the_loads(bearing: RollingBearing, rng) -> None:
    q = displacements(bearing, rng, 1000)
    k = bearing_stiffness(bearing, q)
    diagonal = np.einsum("nii->ni", k) / np.array([1, 1, 1, bearing.pitch_radius, bearing.pitch_radius]) ** 2
    # One element alone on an axis leaves a direction without any stiffness to compare with.
    loaded = diagonal.min(axis=1) > 1e-6 * diagonal.max(axis=1)
    assert loaded.sum() > 900
    q, k = q[loaded], k[loaded]
    assert relative_to_diagonal(difference_quotient(bearing, q) - k, k).max() < 1e-6
    assert relative_to_diagonal(k - np.swapaxes(k, 1, 2), k).max() < 1e-9


def test_stiffness_at_a_thousand_rest_positions_is_the_derivative(
    bearing: RollingBearing, mixed_loads, rng
) -> None:
    """1 N to 20 kN in every mix of directions.

    Taper rollers with tilts held and the axial load above what the radial one needs.
    """
    loads = mixed_loads(bearing, rng, 1000)
    if bearing.is_ball:
        state = equilibrium(bearing, loads)
    else:
        radial = np.hypot(loads[:, 0], loads[:, 1])
        loads[:, 2] = 1 + np.abs(loads[:, 2]) + 1.2 * radial * math.tan(bearing.contact_angle)
        state = equilibrium(bearing, loads, fixed_dofs=("bx", "by"))
    determinate = state.determinate
    assert determinate.mean() > 0.85
    q, k = state.displacement[determinate], state.stiffness[determinate]
    assert relative_to_diagonal(difference_quotient(bearing, q) - k, k).max() < 1e-6
    assert relative_to_diagonal(k - np.swapaxes(k, 1, 2), k).max() < 1e-9


def test_stiffness_is_positive_semidefinite(bearing: RollingBearing, rng) -> None:
    k = bearing_stiffness(bearing, displacements(bearing, rng, 200))
    lever = np.array([1, 1, 1, 1 / bearing.pitch_radius, 1 / bearing.pitch_radius])
    eigenvalues = np.linalg.eigvalsh(k * np.outer(lever, lever))
    assert np.all(eigenvalues[:, 0] >= -1e-12 * eigenvalues[:, -1])


def test_turning_the_frame_turns_loads_and_stiffness(bearing: RollingBearing, rng) -> None:
    """Displacements and cage turned about z by 0.7 rad: F' = T F, K' = T K T^T."""
    q, angle = displacements(bearing, rng, 20), 0.7
    turn = np.eye(5)
    for block in (slice(0, 2), slice(3, 5)):
        turn[block, block] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    plain, turned = bearing_loads(bearing, q), bearing_loads(bearing, q @ turn.T, angle)
    np.testing.assert_allclose(turned, plain @ turn.T, atol=1e-9 * np.abs(plain).max())
    k = bearing_stiffness(bearing, q)
    np.testing.assert_allclose(
        bearing_stiffness(bearing, q @ turn.T, angle), turn @ k @ turn.T, atol=1e-9 * np.abs(k).max()
    )


def test_axial_load_of_a_deep_groove_bearing_in_closed_form(deep_groove: RollingBearing) -> None:
    """Fz = z K_n (sqrt(A0^2 + dz^2) - A0)^1.5 dz / sqrt(A0^2 + dz^2), all balls alike."""
    dz, a0 = 1e-4, 5.953e-4
    distance = math.hypot(a0, dz)
    force = 9 * 1.10e10 * (distance - a0) ** 1.5 * dz / distance
    np.testing.assert_allclose(
        bearing_loads(deep_groove, [0, 0, dz, 0, 0])[0], [0, 0, force, 0, 0], rtol=1e-11, atol=1e-10 * force
    )


def test_axial_stiffness_of_taper_rollers_in_closed_form(taper: RollingBearing) -> None:
    """All rollers alike: Kzz = z k sin^2, Kxx = z k cos^2 / 2, Kbx,bx = z k r^2 sin^2 / 2, Kx,by = -z k r sin
    cos / 2, k = dQ/ddelta.
    """
    dz, a0, r = 2e-5, math.radians(14), 32e-3
    slope = 10 / 9 * 1.0e9 * (dz * math.sin(a0)) ** (1 / 9)
    k = bearing_stiffness(taper, [0, 0, dz, 0, 0])[0]
    assert k[2, 2] == pytest.approx(17 * slope * math.sin(a0) ** 2)
    assert k[0, 0] == pytest.approx(17 * slope * math.cos(a0) ** 2 / 2)
    assert k[3, 3] == pytest.approx(17 * slope * (r * math.sin(a0)) ** 2 / 2)
    assert k[0, 4] == pytest.approx(-17 * slope * r * math.sin(a0) * math.cos(a0) / 2)
    assert np.linalg.matrix_rank(k / np.outer(np.sqrt(np.diag(k)), np.sqrt(np.diag(k))), tol=1e-9) == 3


def test_nothing_acts_inside_the_clearance() -> None:
    loose = RollingBearing(9, 1.10e10, 30e-3, clearance=2e-5, groove_distance=6e-4)
    assert np.all(bearing_loads(loose, [1.9e-5, 0, 0, 0, 0]) == 0) and np.all(
        bearing_stiffness(loose, [1.9e-5, 0, 0, 0, 0]) == 0
    )
    assert bearing_loads(loose, [2.1e-5, 0, 0, 0, 0])[0, 0] == pytest.approx(1.10e10 * 1e-6**1.5, rel=1e-9)


def test_interference_loads_all_elements_alike(deep_groove: RollingBearing) -> None:
    tight = RollingBearing(9, 1.10e10, 30.1488e-3, clearance=-1e-5, groove_distance=5.953e-4)
    k = bearing_stiffness(tight, np.zeros(5))[0]
    assert k[0, 0] == pytest.approx(9 / 2 * 1.5 * 1.10e10 * math.sqrt(1e-5))
    assert k[2, 2] == pytest.approx(9 * 1.10e10 * 1e-5**1.5 / (5.953e-4 + 1e-5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elements": 2}, "2 rolling elements do not make a bearing"),
        ({"elements": 10**21}, "a bearing of 1000000000000000000000 rolling elements is not computed"),
        ({"stiffness_constant": 0.0}, "stiffness_constant must be above zero"),
        ({"pitch_radius": -0.03}, "pitch_radius must be above zero, found -0.03"),
        ({"groove_distance": math.inf}, "groove_distance must be above zero"),
        ({"contact_angle": 2.0}, "between -90 and 90 deg"),
        ({"clearance": 7e-4}, "larger than the groove centres' radial distance"),
    ],
)
def test_impossible_geometry_is_refused(change: dict[str, float], message: str) -> None:
    geometry = {
        "elements": 9,
        "stiffness_constant": 1e10,
        "pitch_radius": 0.03,
        "groove_distance": 6e-4,
    } | change
    with pytest.raises(ConfigError, match=message):
        RollingBearing(**geometry)  # type: ignore[arg-type]
