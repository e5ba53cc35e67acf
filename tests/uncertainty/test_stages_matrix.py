"""The theory of a bearing in the axes of the rig."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.bearings.kinds import BearingCoefficients
from labpipe.errors import ConfigError
from labpipe.project.compare import turn_to_rig_axes

STIFFNESS = np.arange(1.0, 10.0).reshape(3, 3)
BEARING = BearingCoefficients(("y", "z", "by"), STIFFNESS, 10 * STIFFNESS)


def test_rows_and_columns_follow_the_axes_with_their_signs() -> None:
    """The rig's x is the bearing's z, its y points against the bearing's y: force and motion both change
    their sign.
    """
    assert turn_to_rig_axes(BEARING, ("z", "-y")) == {
        "k_xx": 5, "k_xy": -4, "k_yx": -2, "k_yy": 1, "c_xx": 50, "c_xy": -40, "c_yx": -20, "c_yy": 10,
    }  # fmt: skip
    assert turn_to_rig_axes(BEARING, ())["k_xy"] == 2.0


def test_an_axis_that_the_bearing_does_not_have() -> None:
    with pytest.raises(ConfigError, match="no dof 'x'"):
        turn_to_rig_axes(BEARING, ("x", "y"))
