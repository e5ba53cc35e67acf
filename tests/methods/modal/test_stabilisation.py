"""Poles of several orders put together to modes."""

from __future__ import annotations

import numpy as np

from labpipe.methods.modal.poles import SHARE_OF_DECAY, SHARE_OF_FREQUENCY, Diagram, Poles, pole_groups


def test_a_pole_between_two_modes_stays_with_the_stronger_one() -> None:
    """The mode that returns in five orders comes first and takes the pole between.

    That in four does not take it away again.
    """
    first = -1.0 + 100j
    limit = SHARE_OF_DECAY * abs(first.real) + SHARE_OF_FREQUENCY * abs(first)
    between, second = first + 0.8j * limit, first + 1.6j * limit
    values = np.array([first] * 5 + [between] + [second] * 4)
    orders = np.array([2, 4, 6, 8, 10, 10, 2, 4, 6, 8])
    poles, counted = Poles(values, np.ones((10, 1), np.complex128), orders), [2, 4, 6, 8, 10]
    group = pole_groups(poles, counted)
    assert group.tolist() == [0] * 6 + [1] * 4
    # The shares of the orders in which they return; the pole between stands for the first and the second.
    shares = Diagram(poles, group, poles, counted).returns(np.array([first, second]), np.ones((2, 1)))
    np.testing.assert_allclose(shares, [1.0, 1.0])


def test_poles_of_one_frequency_and_another_participation_are_two_modes() -> None:
    values = np.full(4, -1.0 + 100j)
    participation = np.array([[1, 0], [1, 0], [0, 1], [0, 1]], np.complex128)
    group = pole_groups(Poles(values, participation, np.array([2, 4, 2, 4])), [2, 4])
    assert group[0] == group[1] != group[2] == group[3] and min(group) == 0
