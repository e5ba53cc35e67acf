"""A bending shaft in series with its bearing: against compliances added by inversion, the series formula, and
a two-body model.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.rolling_bearing.loads import RigidShaft, add_shaft_bending, transfer_matrix

SHAFT = RigidShaft(2.45, 1.24e-2, 1.24e-2)
K = np.diag([2.1e8, 2.2e8, 1.7e7, 7.5e3, 7.6e3])
K[0, 4] = K[4, 0] = -1.09e6
K[1, 3] = K[3, 1] = 1.09e6


def test_the_series_is_the_sum_of_compliances() -> None:
    bending = 1.176e8
    literal = np.linalg.inv(np.linalg.inv(K) + np.diag([1, 1, 0, 0, 0]) / bending)
    np.testing.assert_allclose(add_shaft_bending(K, bending), literal, rtol=1e-10, atol=1e-6)


def test_an_uncoupled_radial_coefficient_obeys_the_series_formula_and_the_rest_stays() -> None:
    plain = np.diag(np.diag(K))
    total = add_shaft_bending(plain, 1e8).real
    assert total[0, 0] == pytest.approx(2.1e8 * 1e8 / 3.1e8, rel=1e-12)
    np.testing.assert_allclose(np.diag(total)[2:], np.diag(plain)[2:], rtol=1e-15)


def test_a_rigid_shaft_changes_nothing_and_singular_stiffness_is_taken() -> None:
    np.testing.assert_array_equal(add_shaft_bending(K, np.inf), K)
    free = np.diag([1e8, 1e8, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(np.diag(add_shaft_bending(free, 1e8)), [5e7, 5e7, 0, 0, 0], rtol=1e-12)


def test_without_bending_it_is_the_rigid_transfer_matrix() -> None:
    frequency = np.linspace(20, 1500, 50)
    w = 2 * np.pi * frequency[:, None, None]
    rigid = np.linalg.inv((1 + 2e-5j * w) * K - w**2 * np.diag(SHAFT.inertias))
    np.testing.assert_allclose(transfer_matrix(SHAFT, K, frequency, 2e-5), rigid, rtol=1e-10)
    np.testing.assert_allclose(transfer_matrix(SHAFT, K, frequency, 2e-5, 1e18), rigid, rtol=1e-6, atol=1e-18)


def test_the_bent_curve_is_that_of_a_massless_node_between_bearing_and_shaft() -> None:
    """Ten coordinates: five of the shaft's mass and five of the bearing's inner ring, joined by k_s in x and
    y and stiffly elsewhere.
    """
    frequency, beta, bending = np.array([60.0, 400.0, 900.0]), 2e-5, 1.176e8
    joint = np.diag([bending, bending, 1e14, 1e10, 1e10])
    literal = []
    for f in frequency:
        w = 2 * np.pi * f
        ring = K * (1 + 1j * w * beta) + joint
        whole = np.block([[joint - w**2 * np.diag(SHAFT.inertias), -joint], [-joint, ring]])
        literal.append(np.linalg.inv(whole)[:5, :5])
    bent = transfer_matrix(SHAFT, K, frequency, beta, bending)
    scale = np.abs(bent).max(axis=0)
    assert np.max(np.abs(bent - literal) / np.where(scale > 0, scale, 1)) < 1e-5
    np.testing.assert_allclose(bent, np.swapaxes(bent, 1, 2), rtol=1e-9, atol=1e-22)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match="bending stiffness"):
        add_shaft_bending(K, 0.0)
    with pytest.raises(FitError, match="singular"):
        transfer_matrix(SHAFT, np.zeros((5, 5)), np.array([0.0]), 0.0, np.inf)
