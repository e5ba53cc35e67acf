"""Response with a worn bearing and its derivatives, on a bearing whose coefficients depend on depth and angle
by a plain formula.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.rotor.response import dynamic_stiffness, reduced_rotor
from labpipe.methods.rotor.shaft import NodeSupport, Rotor, free_rotor
from labpipe.methods.wear.tables import VaryingSupport, forward_backward, response_with_slopes
from tests.methods.rotor.whole_response import frequency_response
from tests.methods.wear.worn_cases import WornRig, worn_response

LINES = np.linspace(5.0, 120.0, 24)
SPEED = 2 * np.pi * 50
K = np.array([[8e5, 4e5], [-9e5, 1.2e6]])
C = np.array([[2500.0, -700.0], [-700.0, 3000.0]])


def simple_wear(depth: float, angle: float) -> VaryingSupport:
    """K (1 + (depth / 50 um)^2 cos(angle)) + angle * K^T, C likewise."""
    part = depth / 50e-6
    factor, by_depth, by_angle = (
        1 + part**2 * np.cos(angle),
        2 * part / 50e-6 * np.cos(angle),
        -(part**2) * np.sin(angle),
    )
    slopes = [np.stack([by_depth * matrix, by_angle * matrix + matrix.T]) for matrix in (K, C)]
    return VaryingSupport(NodeSupport(14, factor * K + angle * K.T, factor * C + angle * C.T), *slopes)


@pytest.fixture(scope="module")
def rig(mendes_rotor: Rotor) -> WornRig:
    free = reduced_rotor(mendes_rotor, (4, 10, 14), LINES, SPEED)
    return WornRig(free.on([NodeSupport(4, K, C)]), simple_wear, 14, 10)


def test_response_is_that_of_the_whole_rotor(rig: WornRig, mendes_rotor: Rotor) -> None:
    response, _ = worn_response(20e-6, 0.2, rig)
    supports = [NodeSupport(4, K, C), simple_wear(20e-6, 0.2).support]
    whole = frequency_response(
        mendes_rotor, supports, LINES, SPEED, mendes_rotor.dofs(14), mendes_rotor.dofs(10)
    )
    np.testing.assert_allclose(response, whole, atol=1e-8 * np.abs(whole).max())


@pytest.mark.parametrize("nodes", [(4, 10, 14), (14, 4), (1, 16, 9), (7,)])
def test_reduced_rotor_is_that_of_all_nodes_together(mendes_rotor: Rotor, nodes: tuple[int, ...]) -> None:
    """Node after node against the inverse of the whole dynamic stiffness.

    1e-9, since a free rotor's is nearly singular at low lines.
    """
    reduced = reduced_rotor(mendes_rotor, nodes, LINES, SPEED).receptance
    whole = np.linalg.inv(dynamic_stiffness(free_rotor(mendes_rotor), 2 * np.pi * LINES, SPEED))
    dofs = [dof for node in nodes for dof in mendes_rotor.dofs(node)]
    np.testing.assert_allclose(reduced, whole[:, dofs][:, :, dofs], atol=1e-9 * np.abs(whole).max())


def test_paths_are_parts_of_the_whole_response(mendes_rotor: Rotor) -> None:
    free, supports = (
        reduced_rotor(mendes_rotor, (4, 10, 14), LINES, SPEED),
        [NodeSupport(14, K, C), NodeSupport(4, K.T, C)],
    )
    standing = free.on(supports)
    response, to_output, from_force = free.paths(supports, 10, 4)
    np.testing.assert_allclose(response, standing.response(10, 4), rtol=1e-9)
    for number, node in enumerate((14, 4)):
        place = slice(2 * number, 2 * number + 2)
        np.testing.assert_allclose(to_output[:, :, place], standing.response(10, node), rtol=1e-9)
        np.testing.assert_allclose(from_force[:, place], standing.response(node, 4), rtol=1e-9)


@pytest.mark.parametrize("directional", [False, True])
def test_derivatives_equal_differences(rig: WornRig, directional: bool) -> None:
    here = np.array([20e-6, 0.2])
    _, slopes = worn_response(*here, rig, directional)
    for number, step in enumerate((1e-9, 1e-5)):
        move = step * np.eye(2)[number]
        plus, minus = (worn_response(*(here + m), rig, directional)[0] for m in (move, -move))
        np.testing.assert_allclose(
            slopes[number], (plus - minus) / (2 * step), atol=1e-6 * np.abs(slopes[number]).max()
        )


def test_directional_response_by_hand(rig: WornRig) -> None:
    """H_ff = (H_yy + H_zz + j (H_zy - H_yz)) / 2, H_fb = (H_yy - H_zz + j (H_zy + H_yz)) / 2."""
    h, d = worn_response(20e-6, 0.2, rig)[0], worn_response(20e-6, 0.2, rig, directional=True)[0]
    np.testing.assert_allclose(d[:, 0, 0], (h[:, 0, 0] + h[:, 1, 1] + 1j * (h[:, 1, 0] - h[:, 0, 1])) / 2)
    np.testing.assert_allclose(d[:, 0, 1], (h[:, 0, 0] - h[:, 1, 1] + 1j * (h[:, 1, 0] + h[:, 0, 1])) / 2)
    isotropic = np.array([[2 + 1j, 0.5j], [-0.5j, 2 + 1j]])
    np.testing.assert_allclose(forward_backward(isotropic)[[0, 1], [1, 0]], 0, atol=1e-15)


def test_two_bearings_with_shared_parameters(mendes_rotor: Rotor) -> None:
    """The derivative with both bearings worn alike is the sum of those with one worn after the other."""
    free = reduced_rotor(mendes_rotor, (4, 10, 14), LINES, SPEED)

    def bearings(first: float, second: float) -> list[VaryingSupport]:
        left, right = simple_wear(first, 0.1), simple_wear(second, 0.1)
        return [
            VaryingSupport(
                NodeSupport(4, left.support.stiffness, left.support.damping),
                left.stiffness_slopes,
                left.damping_slopes,
            ),
            right,
        ]

    _, slopes = response_with_slopes(free, bearings(1e-5, 1e-5), 14, 10)
    plus, minus = (response_with_slopes(free, bearings(1e-5 + s, 1e-5 + s), 14, 10)[0] for s in (1e-9, -1e-9))
    np.testing.assert_allclose(slopes[0], (plus - minus) / 2e-9, atol=1e-5 * np.abs(slopes[0]).max())


def test_a_derivative_is_zero_where_the_parameter_is_not_felt(rig: WornRig) -> None:
    """Without wear this bearing's stiffness has no slope by depth."""
    _, slopes = worn_response(0.0, 0.2, rig)
    np.testing.assert_allclose(slopes[0], 0, atol=1e-15)
    assert np.abs(slopes[1]).max() > 0


def test_reduced_response_does_not_depend_on_which_other_nodes_were_kept(
    rig: WornRig, mendes_rotor: Rotor
) -> None:
    more = reduced_rotor(mendes_rotor, (1, 4, 7, 10, 14, 16), LINES, SPEED).on([NodeSupport(4, K, C)])
    other = WornRig(more, simple_wear, 14, 10)
    for ours, theirs in zip(worn_response(1e-5, 0.1, other), worn_response(1e-5, 0.1, rig), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-8 * np.abs(theirs).max())
