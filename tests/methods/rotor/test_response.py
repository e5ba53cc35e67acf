"""Frequency response and unbalance response; the reduced rotor against the whole one."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.rotor.response import (
    eigenvalues,
    forward_backward_motion,
    reduced_rotor,
    unbalance_response,
)
from labpipe.methods.rotor.shaft import Disc, NodeSupport, Rotor, ShaftElement, supported_rotor
from tests.methods.rotor.whole_response import frequency_response

LINES = np.linspace(3.0, 300.0, 40)
SPEED = 400.0


def test_reduced_rotor_equals_the_dense_one(overhung: Rotor, oil_films: tuple[NodeSupport, ...]) -> None:
    """The Woodbury update against the whole rotor solved with its bearings, every kept node to every
    other.
    """
    nodes = (1, 4, 5)
    dofs = [dof for node in nodes for dof in overhung.dofs(node)]
    dense = frequency_response(overhung, oil_films, LINES, SPEED, dofs, dofs)
    free = reduced_rotor(overhung, nodes, LINES, SPEED)
    at_once = free.on(oil_films)
    one_by_one = free.on(oil_films[:1]).on(oil_films[1:])
    for reduced in (at_once, one_by_one):
        np.testing.assert_allclose(reduced.receptance, dense, atol=1e-8 * np.abs(dense).max())
    np.testing.assert_array_equal(at_once.response(5, 1), at_once.receptance[:, 4:6, 0:2])


def test_response_is_the_sum_over_the_modes(overhung: Rotor, oil_films: tuple[NodeSupport, ...]) -> None:
    """H = sum_r phi_r (left_r) / (j w - lambda_r), from the eigenvectors of the first-order form: an
    independent route.
    """
    matrices = supported_rotor(overhung, oil_films)
    roots, vectors = eigenvalues(matrices, SPEED)
    right = np.concatenate([vectors, vectors * roots])
    n = vectors.shape[0]
    inputs = np.concatenate([np.zeros((n, n)), np.linalg.inv(matrices.mass)])
    left = np.linalg.solve(right, inputs)
    modal = np.stack([(vectors / (2j * np.pi * f - roots)) @ left for f in LINES[:5]])
    dofs = list(range(n))
    direct = frequency_response(overhung, oil_films, LINES[:5], SPEED, dofs, dofs)
    np.testing.assert_allclose(modal, direct, atol=1e-6 * np.abs(direct).max())


def test_reciprocity_without_spin_and_cross_coupling(overhung: Rotor) -> None:
    supports = [NodeSupport(node, np.diag([1e6, 2e6]), np.diag([100.0, 200.0])) for node in (1, 4)]
    dofs = overhung.dofs(2) + overhung.dofs(5)
    h = frequency_response(overhung, supports, LINES, 0.0, dofs, dofs)
    np.testing.assert_allclose(h, h.swapaxes(1, 2), atol=1e-10 * np.abs(h).max())
    spinning = frequency_response(overhung, supports, LINES, SPEED, dofs, dofs)
    assert np.abs(spinning - spinning.swapaxes(1, 2)).max() > 1e-4 * np.abs(h).max()


def test_unbalance_response_is_the_response_to_a_turning_force(
    overhung: Rotor, oil_films: tuple[NodeSupport, ...]
) -> None:
    speeds = np.array([100.0, 250.0])
    outputs = overhung.dofs(5)
    amount = 2e-5 * np.exp(0.7j)
    found = unbalance_response(overhung, oil_films, speeds, {3: amount}, outputs)
    for speed, displacement in zip(speeds, found, strict=True):
        h = frequency_response(
            overhung, oil_films, np.array([speed / (2 * np.pi)]), speed, outputs, overhung.dofs(3)
        )[0]
        np.testing.assert_allclose(displacement, h @ np.array([1, -1j]) * amount * speed**2, rtol=1e-9)


def test_an_isotropic_rotor_answers_unbalance_with_a_forward_circle(overhung: Rotor) -> None:
    supports = [NodeSupport(node, 1e6 * np.eye(2), 100.0 * np.eye(2)) for node in (1, 4)]
    y, z = unbalance_response(overhung, supports, np.array([200.0]), {5: 1e-5}, overhung.dofs(5))[0]
    np.testing.assert_allclose(z, -1j * y, rtol=1e-8)
    forward, backward = forward_backward_motion(np.array([y, z]))
    np.testing.assert_allclose(forward, y)
    assert abs(backward) < 1e-8 * abs(forward)


def test_an_elliptic_orbit_is_the_sum_of_its_two_circles() -> None:
    """y = 3 cos wt, z = 1 sin wt: half axes 3 and 1 are f + b and f - b."""
    np.testing.assert_allclose(forward_backward_motion(np.array([3.0, -1j])), [2, 1])


def test_far_above_resonance_the_disc_turns_about_its_centre_of_mass() -> None:
    """|displacement| -> eccentricity u / m, opposite to the unbalance."""
    rotor = Rotor((ShaftElement(0.1, 2e-3), ShaftElement(0.1, 2e-3)), (Disc(2, 5.0, 0.01, 0.02),))
    supports = [NodeSupport(node, 1e5 * np.eye(2), 10.0 * np.eye(2)) for node in (1, 3)]
    y = unbalance_response(rotor, supports, np.array([3000.0]), {2: 5e-5}, [4])[0, 0]
    np.testing.assert_allclose(y, -1e-5, rtol=0.01)


def test_a_node_that_was_not_kept_is_named(overhung: Rotor) -> None:
    free = reduced_rotor(overhung, (1, 4), LINES, SPEED)
    with pytest.raises(ConfigError, match=r"node 5 is not in the reduced rotor \(nodes 1, 4\)"):
        free.response(5, 1)


def test_zero_hertz_is_refused_for_a_free_rotor(overhung: Rotor) -> None:
    with pytest.raises(ConfigError, match="at 0 Hz"):
        reduced_rotor(overhung, (1,), np.array([0.0, 1.0]), SPEED)


def test_a_singular_line_is_said() -> None:
    rotor = Rotor((ShaftElement(0.1, 0.01),))
    with pytest.raises(FitError, match="resonance without damping"):
        frequency_response(
            rotor, [NodeSupport(1, np.zeros((2, 2)), np.zeros((2, 2)))], np.array([0.0]), 0.0, [0], [0]
        )
