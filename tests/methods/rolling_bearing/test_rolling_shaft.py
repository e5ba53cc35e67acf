"""The rigid shaft on its bearing: closed forms, modal superposition, reciprocity, and the fit of the theory's
own curve.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import optimize

from labpipe.errors import ConfigError, FitError
from labpipe.methods.rolling_bearing.equilibrium import equilibrium
from labpipe.methods.rolling_bearing.loads import (
    RigidShaft,
    modes,
    sdof_stiffness,
    theoretical_response,
    transfer_matrix,
)
from tests.methods.rolling_bearing.displaced_rings import load_vector

SHAFT = RigidShaft(2.45, 1.24e-2, 1.1e-2)
UNCOUPLED = np.diag([2e8, 1e8, 2e7, 8e3, 9e3])


@pytest.fixture(scope="module")
def stiffness(angular) -> np.ndarray:  # type: ignore[no-untyped-def]
    k: np.ndarray = equilibrium(angular, load_vector(y=-24.0, z=445.0)).stiffness[0]
    return k


def test_uncoupled_dofs_are_single_oscillators() -> None:
    expected = np.sort(np.sqrt(np.diag(UNCOUPLED) / SHAFT.inertias) / (2 * np.pi))
    found = modes(SHAFT, UNCOUPLED)
    np.testing.assert_allclose(found.frequency, expected)
    np.testing.assert_allclose(np.sort(found.share, axis=0)[-1], 1)
    np.testing.assert_allclose(sdof_stiffness(SHAFT, UNCOUPLED), np.diag(UNCOUPLED))
    frequency = np.array([100.0, 300.0])
    h = transfer_matrix(SHAFT, UNCOUPLED, frequency, 1e-5)
    w = 2 * np.pi * frequency
    np.testing.assert_allclose(h[:, 2, 2], 1 / (2e7 - w**2 * 2.45 + 1j * w * 1e-5 * 2e7))


def test_modes_diagonalise_mass_and_stiffness(stiffness: np.ndarray) -> None:
    found = modes(SHAFT, stiffness)
    np.testing.assert_allclose(found.shape.T @ np.diag(SHAFT.inertias) @ found.shape, np.eye(5), atol=1e-12)
    squares = (2 * np.pi * found.frequency) ** 2
    np.testing.assert_allclose(
        found.shape.T @ stiffness @ found.shape, np.diag(squares), atol=1e-9 * squares.max()
    )
    np.testing.assert_allclose(found.share.sum(axis=0), 1)
    np.testing.assert_allclose(found.share.sum(axis=1), 1)


def test_transfer_matrix_is_the_sum_of_its_modes(stiffness: np.ndarray) -> None:
    """H = sum_r phi_r phi_r^T / (w_r^2 - w^2 + 2 j zeta_r w_r w): Rayleigh damping leaves the modes
    uncoupled.
    """
    beta, frequency = 2e-6, np.linspace(5, 1500, 40)
    found, w = modes(SHAFT, stiffness), 2 * np.pi * frequency
    w_r, zeta = 2 * np.pi * found.frequency, found.damping_ratio(beta)
    factors = 1 / (w_r**2 - w[:, None] ** 2 + 2j * zeta * w_r * w[:, None])
    superposed = np.einsum("ir,jr,fr->fij", found.shape, found.shape, factors)
    inverted = transfer_matrix(SHAFT, stiffness, frequency, beta)
    np.testing.assert_allclose(inverted, superposed, rtol=1e-7, atol=1e-9 * np.abs(superposed).max())


def test_static_limit_and_reciprocity(stiffness: np.ndarray) -> None:
    h = transfer_matrix(SHAFT, stiffness, np.array([1e-6, 400.0]), 1e-5)
    np.testing.assert_allclose(h[0].real, np.linalg.inv(stiffness), rtol=1e-6, atol=1e-20)
    np.testing.assert_allclose(h[1], h[1].T, rtol=1e-9, atol=1e-20)


def test_the_response_can_lie_beside_a_measured_one(stiffness: np.ndarray) -> None:
    frequency = np.arange(10.0, 100.0)
    response = theoretical_response(SHAFT, stiffness, frequency, 1e-5)
    assert [port.label for port in response.outputs] == [
        "x",
        "y",
        "z",
        "bx",
        "by",
    ] and response.form == "receptance"
    np.testing.assert_array_equal(response.matrix, transfer_matrix(SHAFT, stiffness, frequency, 1e-5))


def test_one_dof_fit_of_the_coupled_curve(stiffness: np.ndarray) -> None:
    """An amplitude fit |H_ii| = P / |w0^2 - w^2 + 2 j zeta w0 w| near the peak, by a general optimiser: k =
    w0^2 / P.
    """
    beta, found = 1e-7, modes(SHAFT, stiffness)
    expected = sdof_stiffness(SHAFT, stiffness)
    for n, dof in enumerate(("x", "y", "z", "bx", "by")):
        peak = found.frequency[found.main_mode(dof)]
        frequency = peak * np.linspace(0.998, 1.002, 41)
        amplitude = np.abs(transfer_matrix(SHAFT, stiffness, frequency, beta)[:, n, n])
        ratio = frequency / peak

        def curve(r: np.ndarray, p: float, place: float, zeta: float) -> np.ndarray:
            return p / np.abs(place**2 - r**2 + 2j * zeta * place * r)

        start = (
            np.median(amplitude * np.abs(1 - ratio**2)),
            1.0,
            found.damping_ratio(beta)[found.main_mode(dof)],
        )
        (p, place, _), _ = optimize.curve_fit(curve, ratio, amplitude, start)
        assert place**2 / p == pytest.approx(expected[n], rel=2e-2)


def test_the_apparent_stiffness_is_explained_by_the_coupling(stiffness: np.ndarray) -> None:
    """M_ii w_r^2 = K_ii + sum_j K_ij phi_jr / phi_ir, row i of the eigenvalue equation."""
    found = modes(SHAFT, stiffness)
    main = [found.main_mode(dof) for dof in ("x", "y", "z", "bx", "by")]
    apparent = SHAFT.inertias * (2 * math.pi * found.frequency[main]) ** 2
    for n, dof in enumerate(("x", "y", "z", "bx", "by")):
        shape = found.shape[:, found.main_mode(dof)]
        assert apparent[n] == pytest.approx(stiffness[n] @ shape / shape[n], rel=1e-9)
    assert apparent[0] > stiffness[0, 0] and apparent[3] < stiffness[3, 3]


def test_a_free_dof_has_no_frequency_and_no_static_receptance() -> None:
    loose = np.diag([2e8, 1e8, 0.0, 8e3, 9e3])
    assert modes(SHAFT, loose).frequency[0] == 0
    with pytest.raises(FitError, match="singular at a line; give a damping factor, or leave out 0 Hz"):
        transfer_matrix(SHAFT, loose, np.array([0.0, 1.0]), 1e-5)


def test_an_unstable_rest_position_and_an_impossible_shaft_are_refused() -> None:
    with pytest.raises(FitError, match="negative eigenvalue"):
        modes(SHAFT, np.diag([2e8, 1e8, -1e6, 8e3, 9e3]))
    with pytest.raises(ConfigError, match="the shaft's inertia_x must be above zero"):
        RigidShaft(2.45, 0.0, 1e-2)
