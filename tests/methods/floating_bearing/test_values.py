"""Coefficients that a symmetry ties to estimated ones."""

from __future__ import annotations

import numpy as np

from labpipe.methods.floating_bearing.values import Valued, tied_element
from labpipe.records.finding import Parameter


def test_a_seal_has_equal_direct_and_opposite_cross_terms() -> None:
    """k_yy = k_xx and k_yx = -k_xy: value, interval and slopes by what both rest on.

    The sign of an error's effect too.
    """
    slopes = np.array([0.0, 2.0, -1.0])
    plain = Parameter("k_xx", 5.0, "N/m", std_error=1.0, t_ratio=5.0, ci95=(3.0, 7.0))
    direct = tied_element(Valued(plain, slopes))
    assert (
        direct.parameter.name,
        direct.parameter.value,
        direct.parameter.ci95,
        direct.parameter.t_ratio,
    ) == ("k_yy", 5.0, (3.0, 7.0), 5.0)
    np.testing.assert_array_equal(direct.slopes, slopes)
    cross = tied_element(
        Valued(Parameter("k_p_xy_2", 5.0, "N/m", std_error=1.0, t_ratio=5.0, ci95=(3.0, 7.0)), slopes)
    )
    assert (cross.parameter.name, cross.parameter.value, cross.parameter.ci95) == (
        "k_p_yx_2",
        -5.0,
        (-7.0, -3.0),
    )
    assert (cross.parameter.t_ratio, cross.parameter.std_error, cross.parameter.derived) == (-5.0, 1.0, True)
    np.testing.assert_array_equal(cross.slopes, -slopes)
