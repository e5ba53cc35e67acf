"""The spread of chi-square where the covariance behind it was estimated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from labpipe.methods.floating_bearing.likelihood import Noise


@pytest.mark.parametrize(("equations", "dof"), [(2, 9.0), (4, 20.0)])
def test_chi_square_of_an_estimated_covariance_spreads_as_the_f_distribution(
    equations: int, dof: float
) -> None:
    """A line's e^H S^-1 e over its mean is F over its mean with 2 p and 2 (nu - p + 1) degrees of freedom
    (Hotelling); 50 lines.
    """
    first, second = 2 * equations, 2 * (dof - equations + 1)
    of_a_line = stats.f.std(first, second) / stats.f.mean(first, second)
    noise = Noise(dof=dof, equations=equations)
    assert noise.spread(50 * first) == pytest.approx(of_a_line / np.sqrt(50))
    # Lines with common noise: so many fewer.
    assert Noise(dof=dof, equations=equations, shared_power=1.5).spread(50 * first) == pytest.approx(
        of_a_line * np.sqrt(1.5 / 50)
    )


def test_chi_square_of_a_known_covariance_spreads_as_itself() -> None:
    assert Noise().spread(200) == pytest.approx(stats.chi2.std(200) / 200)
    assert Noise().p_value(230.0, 200) == pytest.approx(stats.chi2.sf(230.0, 200))
