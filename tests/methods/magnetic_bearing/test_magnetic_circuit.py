"""The reluctance network against a nodal solution of the same circuit, closed forms and the printed
magnet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.bearing import (
    MU_0,
    Magnet,
    inferred_pole_area,
    magnet_factors,
    magnet_force,
    pole_fluxes,
)

# Turns, gap, bias current and coercivity (9.465 kOe) of Lim et al. (2009), section 2; areas and lengths are
# made up.
MAGNET = Magnet(
    turns=180,
    gap=0.45e-3,
    pole_area=60e-6,
    bias_current=0.2,
    coercivity=753.2e3,
    magnet_length=1e-3,
    magnet_area=200e-6,
    iron_path=30e-3,
)


def nodal_fluxes(magnet: Magnet, x: float, i: float) -> np.ndarray:
    """Kirchhoff's laws with both rings written out: 8 pole fluxes, 2 potentials and the magnet's flux as
    unknowns; (8,) [Wb].
    """
    sense = np.array([1.0, -1.0, 0.0, 0.0])
    area = MU_0 * magnet.pole_area
    reluctance = (magnet.gap - sense * x) / area + magnet.iron_path / (area * magnet.iron_permeability)
    coils = magnet.turns * (magnet.bias_current + sense * i)
    matrix, right = np.zeros((11, 11)), np.zeros(11)
    for ring in range(2):
        for pole in range(4):
            row = 4 * ring + pole
            matrix[row, row], matrix[row, 8 + ring], right[row] = reluctance[pole], -1.0, coils[pole]
        matrix[8 + ring, 4 * ring : 4 * ring + 4], matrix[8 + ring, 10] = 1.0, -1.0
    matrix[10, 8:10], matrix[10, 10], right[10] = (
        1.0,
        magnet.magnet_reluctance,
        magnet.coercivity * magnet.magnet_length,
    )
    scale = np.abs(matrix).max(axis=1)
    return np.linalg.solve(matrix / scale[:, None], right / scale)[:8]


@pytest.mark.parametrize(("x", "i"), [(0.0, 0.0), (45e-6, 0.0), (0.0, 0.36), (-45e-6, 0.2)])
def test_fluxes_are_those_of_the_whole_network(x: float, i: float) -> None:
    np.testing.assert_allclose(np.tile(pole_fluxes(MAGNET, x, i), 2), nodal_fluxes(MAGNET, x, i), rtol=1e-9)


@pytest.mark.parametrize(
    "magnet",
    [
        MAGNET,
        replace(MAGNET, magnet_area=None),
        replace(MAGNET, bias_current=0.0),
        replace(MAGNET, iron_path=0.0),
    ],
)
def test_factors_are_the_slopes_of_the_force(magnet: Magnet) -> None:
    """Central differences of the nonlinear force: error of second order in the step."""
    factors = magnet_factors(magnet)
    per_current = (magnet_force(magnet, 0.0, 1e-4) - magnet_force(magnet, 0.0, -1e-4)) / 2e-4
    per_displacement = (magnet_force(magnet, 1e-8, 0.0) - magnet_force(magnet, -1e-8, 0.0)) / 2e-8
    assert factors.force_per_current == pytest.approx(per_current, rel=1e-6)
    assert factors.negative_stiffness == pytest.approx(per_displacement, rel=1e-6)


def test_electromagnet_alone_has_the_textbook_factors() -> None:
    """Per pole pair k_i = mu_0 N^2 A i_0 / g^2 * 2, k_n = 2 mu_0 N^2 A i_0^2 / g^3 (straight poles), two
    rings.
    """
    magnet = Magnet(turns=180, gap=0.45e-3, pole_area=60e-6, bias_current=0.2)
    factors = magnet_factors(magnet)
    pair = 2 * MU_0 * 180**2 * 60e-6
    assert factors.force_per_current == pytest.approx(2 * pair * 0.2 / 0.45e-3**2, rel=1e-12)
    assert factors.negative_stiffness == pytest.approx(2 * pair * 0.2**2 / 0.45e-3**3, rel=1e-12)
    assert pole_fluxes(magnet, 0.0, 0.0)[0] / 60e-6 == pytest.approx(MU_0 * 36 / 0.45e-3, rel=1e-12)


def test_force_of_the_centred_rotor_is_zero() -> None:
    assert magnet_force(MAGNET, 0.0, 0.0) == 0.0


def test_inferred_pole_area_gives_both_factors_back() -> None:
    """The permanent magnet's strength is the other free value.

    It makes k_i 5.8 N/A, so it is solved from phi_0 = k_i g / 4 N.
    """
    area = inferred_pole_area(180, 0.45e-3, 5.8, 33106.0)
    bias = 5.8 * 0.45e-3 / (4 * 180)
    source = 2 * bias * 0.45e-3 / (MU_0 * area)
    factors = magnet_factors(
        Magnet(turns=180, gap=0.45e-3, pole_area=area, coercivity=source, magnet_length=1.0)
    )
    assert (factors.force_per_current, factors.negative_stiffness) == pytest.approx((5.8, 33106.0), rel=1e-9)
    # 2.8 mm^2 with 1.3 T is not a pole of this size: the printed stiffness and the printed force-current
    # factor do not fit one geometry.
    assert area == pytest.approx(2.81e-6, rel=2e-3)


@pytest.mark.parametrize("entry", ["turns", "gap", "pole_area", "magnet_area", "recoil", "iron_permeability"])
def test_impossible_geometry_is_refused(entry: str) -> None:
    with pytest.raises(ConfigError, match=entry):
        replace(MAGNET, **{entry: 0})


def test_negative_currents_and_missing_bias_are_refused() -> None:
    with pytest.raises(ConfigError, match="bias_current"):
        replace(MAGNET, bias_current=-0.1)
    with pytest.raises(ConfigError, match="without bias flux"):
        replace(MAGNET, bias_current=0.0, coercivity=0.0)


def test_a_permanent_magnet_has_strength_and_length() -> None:
    """Each alone, or the area of a ring without a length, changed nothing."""
    for entries in ({"coercivity": 9e5}, {"magnet_length": 3e-3}, {"magnet_area": 1e-4}):
        with pytest.raises(ConfigError, match="magnet_length"):
            Magnet(turns=100, gap=5e-4, pole_area=1e-4, bias_current=2.0, **entries)
