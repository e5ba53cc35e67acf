"""Element and rotor matrices: rigid-body motion, printed element matrices, static loads by the lever law."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.rotor.shaft import (
    Disc,
    NodeSupport,
    Rotor,
    ShaftElement,
    Sleeve,
    bearing_loads,
    free_rotor,
    plane_inertia,
    plane_stiffness,
    supported_rotor,
)


def rigid_motions(rotor: Rotor) -> np.ndarray:
    """Translations in y and z, rotations about z and y through the left end: (n_dof, 4)."""
    x = np.concatenate([[0.0], np.cumsum([element.length for element in rotor.elements])])
    motions = np.zeros((4 * rotor.n_node, 4))
    motions[0::4, 0], motions[1::4, 1] = 1, 1
    motions[0::4, 2], motions[3::4, 2] = x, 1
    motions[1::4, 3], motions[2::4, 3] = x, -1
    return motions


def test_a_rigid_motion_strains_nothing_and_weighs_what_it_should(overhung: Rotor) -> None:
    free, motions = free_rotor(overhung), rigid_motions(overhung)
    np.testing.assert_allclose(free.stiffness @ motions, 0, atol=1e-6 * np.abs(free.stiffness).max())
    mass = motions.T @ free.mass @ motions
    shaft = sum(e.material.density * e.area * e.length for e in overhung.elements)
    np.testing.assert_allclose(np.diag(mass)[:2], shaft + 6.0)
    np.testing.assert_allclose(mass[:2, :2] - np.diag(np.diag(mass)[:2]), 0, atol=1e-12)


def test_moments_of_inertia_of_a_rigid_motion_by_hand(overhung: Rotor) -> None:
    """About the left end: discs m x^2 + I_t; a cylinder m (l^2/12 + d^2/16) + m x^2."""
    free, turning = free_rotor(overhung), rigid_motions(overhung)[:, 2]
    expected = 4.0 * 0.4**2 + 0.02 + 2.0 * 0.2**2 + 0.004
    for number, element in enumerate(overhung.elements):
        mass = element.material.density * element.area * element.length
        expected += mass * (
            element.length**2 / 12 + element.outer_diameter**2 / 16 + (0.1 * number + 0.05) ** 2
        )
    np.testing.assert_allclose(turning @ free.mass @ turning, expected)


def test_gyroscopic_couple_of_a_rigid_motion_is_the_polar_inertia(overhung: Rotor) -> None:
    """Moment about y from a rotation rate about z: I_p Omega, with discs and m d^2/8 of the shaft.

    G is skew.
    """
    free, motions = free_rotor(overhung), rigid_motions(overhung)
    polar = (
        0.035
        + 0.007
        + sum(e.material.density * e.area * e.length * e.outer_diameter**2 / 8 for e in overhung.elements)
    )
    np.testing.assert_allclose(free.gyroscopic, -free.gyroscopic.T, atol=1e-15)
    # Motion 3 has a rotation of -1 about y.
    np.testing.assert_allclose(-motions[:, 3] @ free.gyroscopic @ motions[:, 2], polar)


def test_plane_matrices_of_a_slender_element_are_the_textbook_ones() -> None:
    """Phi -> 0: 12 6l 4l2 2l2 times EI/l3, and rho A l / 420 (156 22l 54 -13l 4l2 -3l2), rotary rho I / 30 l
    (36 3l 4l2 -l2).
    """
    element = ShaftElement(1.0, 1e-4)
    bending = element.material.elastic_modulus * element.second_moment
    expected = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
    np.testing.assert_allclose(plane_stiffness(element), bending * expected, rtol=1e-6)
    translation, rotary = plane_inertia(element)
    expected = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420
    np.testing.assert_allclose(translation, element.material.density * element.area * expected, rtol=1e-6)
    expected = np.array([[36, 3, -36, 3], [3, 4, -3, -1], [-36, -3, 36, -3], [3, -1, -3, 4]]) / 30
    np.testing.assert_allclose(rotary, element.material.density * element.second_moment * expected, rtol=1e-5)


@pytest.mark.parametrize("element", [0, 2])
def test_a_sleeve_on_no_element_is_refused(element: int) -> None:
    with pytest.raises(ConfigError, match=f"element {element}, the rotor has elements 1 to 1"):
        Rotor((ShaftElement(0.1, 0.03),), sleeves=(Sleeve(element, 0.04),))


def test_a_sleeve_adds_inertia_but_no_stiffness() -> None:
    bare = Rotor((ShaftElement(0.1, 0.03), ShaftElement(0.1, 0.03)), alpha=2.0)
    sleeved = Rotor(bare.elements, sleeves=(Sleeve(2, 0.04),), alpha=2.0)
    one, other = free_rotor(bare), free_rotor(sleeved)
    np.testing.assert_array_equal(one.stiffness, other.stiffness)
    np.testing.assert_array_equal(one.damping, other.damping)
    motion = rigid_motions(bare)[:, 0]
    np.testing.assert_allclose(motion @ (other.mass - one.mass) @ motion, 7800 * np.pi / 4 * 7e-4 * 0.1)


def test_proportional_damping_is_that_of_the_shaft_alone(overhung: Rotor) -> None:
    shaft = free_rotor(Rotor(overhung.elements))
    damped = free_rotor(Rotor(overhung.elements, overhung.discs, alpha=3.0, beta=1e-4))
    np.testing.assert_allclose(damped.damping, 3 * shaft.mass + 1e-4 * shaft.stiffness)


def test_supports_enter_at_their_node(overhung: Rotor) -> None:
    k, c = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0, 6.0], [7.0, 8.0]])
    free, held = free_rotor(overhung), supported_rotor(overhung, [NodeSupport(2, k, c)])
    np.testing.assert_allclose((held.stiffness - free.stiffness)[4:6, 4:6], k, atol=1e-6)
    np.testing.assert_allclose((held.damping - free.damping)[4:6, 4:6], c, atol=1e-9)


def test_two_bearings_share_the_load_by_the_lever_law() -> None:
    """An overhanging disc of 10 kg at .3 m, bearings at 0 and .2 m, a force of 7 N in y at .1 m.

    The shaft weighs next to nothing.
    """
    rotor = Rotor(tuple(ShaftElement(0.1, 1e-3) for _ in range(3)), (Disc(4, 10.0, 0.1, 0.2),))
    loads = bearing_loads(rotor, [1, 3], {2: (7.0, 0.0)}, gravity=10.0)
    shaft = 7800 * np.pi / 4 * 1e-6 * 0.3 * 10
    np.testing.assert_allclose(loads, [[3.5, 50 - shaft / 4], [3.5, -150 - 3 * shaft / 4]], rtol=1e-6)


def test_a_third_bearing_takes_what_the_beam_gives_it() -> None:
    """A uniform beam on three equal supports: 3/16, 10/16, 3/16 of its weight (Euler-Bernoulli)."""
    rotor = Rotor(tuple(ShaftElement(0.25, 0.005) for _ in range(8)))
    loads = bearing_loads(rotor, [1, 5, 9])
    np.testing.assert_allclose(loads[:, 1] / loads[:, 1].sum(), [3 / 16, 10 / 16, 3 / 16], rtol=1e-3)


def test_one_bearing_is_refused(overhung: Rotor) -> None:
    with pytest.raises(ConfigError, match="at least two bearings"):
        bearing_loads(overhung, [2, 2])


def test_a_rotor_of_lists_is_the_same_and_its_matrices_are_kept_as_they_are(overhung: Rotor) -> None:
    """They serve the next speed too, so that nobody may write into them."""
    listed = Rotor(list(overhung.elements), list(overhung.discs), list(overhung.sleeves))  # type: ignore[arg-type]
    assert listed == Rotor(overhung.elements, overhung.discs, overhung.sleeves)
    free = free_rotor(listed)
    np.testing.assert_array_equal(free.mass, free_rotor(overhung).mass)
    with pytest.raises(ValueError, match="read-only"):
        free.stiffness[0, 0] = 1.0
