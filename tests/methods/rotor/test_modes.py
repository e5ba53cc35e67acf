"""Eigenvalues: invariants, whirl directions, stability."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.rotor.response import eigenvalues, growth_rate, modes, onset_speed
from labpipe.methods.rotor.shaft import Disc, NodeSupport, Rotor, ShaftElement, supported_rotor


def soft(node: int, damping: float = 0.0) -> NodeSupport:
    return NodeSupport(node, 1e5 * np.eye(2), damping * np.eye(2))


def test_every_mode_solves_its_equation(overhung: Rotor, oil_films: tuple[NodeSupport, ...]) -> None:
    matrices = supported_rotor(overhung, oil_films)
    roots, vectors = eigenvalues(matrices, 500.0)
    for root, vector in zip(roots, vectors.T, strict=True):
        terms = np.stack(
            [
                root**2 * matrices.mass @ vector,
                root * matrices.at_speed(500.0) @ vector,
                matrices.stiffness @ vector,
            ]
        )
        assert np.abs(terms.sum(axis=0)).max() < 1e-6 * np.abs(terms).max()


def test_an_isotropic_rotor_at_rest_has_pairs_that_split_with_speed(overhung: Rotor) -> None:
    rest = modes(overhung, [soft(1), soft(4)], 0.0)
    at_rest = rest.eigenvalues.imag
    np.testing.assert_allclose(at_rest[0:4:2], at_rest[1:4:2], rtol=1e-6)
    slow, fast = (modes(overhung, [soft(1), soft(4)], speed) for speed in (300.0, 900.0))
    assert slow.speed == 300.0
    backward, forward = (slow.eigenvalues.imag[np.sign(slow.whirl) == way][0] for way in (-1, 1))
    assert backward < at_rest[0] < forward
    assert fast.eigenvalues.imag[fast.whirl < 0][0] < backward
    np.testing.assert_allclose(np.abs(fast.whirl[:4]), 1, atol=1e-6)


def test_shapes_have_a_largest_deflection_of_one(overhung: Rotor, oil_films: tuple[NodeSupport, ...]) -> None:
    found = modes(overhung, oil_films, 200.0)
    assert found.shapes.shape == (found.eigenvalues.size, 5, 2)
    np.testing.assert_allclose(np.abs(found.shapes).max(axis=(1, 2)), 1)
    undamped = np.abs(found.eigenvalues)
    np.testing.assert_allclose(undamped * np.sqrt(1 - found.damping_ratio**2), found.eigenvalues.imag)


def test_a_rigid_mass_on_a_damped_bearing_rings_as_a_single_degree_of_freedom() -> None:
    """A stiff shaft between two bearings of 1e4 N/m and 10 N s/m each: w0^2 = 2 k / m, zeta = 2 c / (2 m
    w0).
    """
    discs = (Disc(1, 0.5, 0.0, 0.0), Disc(2, 1.0, 0.0, 0.0), Disc(3, 0.5, 0.0, 0.0))
    rotor = Rotor((ShaftElement(0.1, 0.05), ShaftElement(0.1, 0.05)), discs)
    shaft = 7800 * np.pi / 4 * 0.05**2 * 0.2
    bearings = [NodeSupport(node, 1e4 * np.eye(2), 10 * np.eye(2)) for node in (1, 3)]
    found = modes(rotor, bearings, 0.0)
    omega = np.sqrt(2e4 / (2 + shaft))
    natural = np.abs(found.eigenvalues)
    k = int(np.argmin(np.abs(natural - omega)))
    np.testing.assert_allclose(natural[k], omega, rtol=2e-3)
    np.testing.assert_allclose(found.damping_ratio[k], 20 / (2 * omega * (2 + shaft)), rtol=5e-3)


def jeffcott(cross: float) -> tuple[Rotor, list[NodeSupport]]:
    rotor = Rotor((ShaftElement(0.1, 0.05), ShaftElement(0.1, 0.05)), (Disc(2, 10.0, 0.01, 0.02),))
    k = np.array([[1e5, cross], [-cross, 1e5]])
    return rotor, [NodeSupport(node, k, 50.0 * np.eye(2)) for node in (1, 3)]


def test_cross_coupling_turns_unstable_at_c_times_omega() -> None:
    """A rigid rotor on equal bearings with k_yz = -k_zy = s Omega: unstable above k_xy = c w0, w0^2 = k / m
    (textbook).
    """
    rotor, _ = jeffcott(0.0)
    mass = 10 + 7800 * np.pi / 4 * 0.05**2 * 0.2
    expected = 50 * np.sqrt(2e5 / mass) / 20.0
    found = onset_speed(rotor, lambda speed: jeffcott(20.0 * speed)[1], np.linspace(50, 1000, 20))
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert (
        growth_rate(rotor, jeffcott(20.0 * 0.9 * found)[1], 0.9 * found)
        < 0
        < growth_rate(rotor, jeffcott(22.0 * found)[1], found)
    )


def test_a_stable_rotor_has_no_onset_speed_and_undamped_modes_do_not_pretend_one(overhung: Rotor) -> None:
    undamped = Rotor(overhung.elements, overhung.discs)
    assert onset_speed(undamped, lambda speed: [soft(1), soft(4)], [10.0, 500.0, 1000.0]) is None


def test_a_search_that_starts_unstable_is_refused() -> None:
    rotor, supports = jeffcott(1e5)
    with pytest.raises(FitError, match="already at 48 rpm"):
        onset_speed(rotor, lambda speed: supports, [5.0, 10.0])
