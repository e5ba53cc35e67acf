"""Which poles of a loop are modes."""

from __future__ import annotations

import numpy as np

from labpipe.methods.magnetic_bearing.certificate import modes_of


def test_modes_swing_and_stand_in_rising_frequency_up_to_the_highest() -> None:
    """Of a pair the upper one; real poles do not swing; pi rad/s is half a hertz, the highest. Damped: by the
    natural frequency.
    """
    top = 1j * np.pi
    poles = np.array([top, -top, -2.0, 1.5, -0.3 + 0.4j, -0.3 - 0.4j, 1.01 * top, -2.4 + 1.8j, -1.0 + 1e-12j])
    np.testing.assert_array_equal(modes_of(poles, 0.5), [-0.3 + 0.4j, -2.4 + 1.8j, top])
