"""Fisher information against an independent calculation with the true forces as unknowns, and against closed
forms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.planning.model import (
    PlannedModel,
    SensorDensities,
    planned_model,
    relative_errors,
    sensitivities,
    vector_information,
)
from tests.methods.planning.rigs import RIGS


def _brute_force(
    model: PlannedModel, noise: SensorDensities, omega: float, force: np.ndarray, idle: float = 1.0
) -> np.ndarray:
    """Information per second of relative coefficients, true forces and accelerations unknown, by differences
    and a Schur complement.

    z = [F, D^-1 (F - M_s A), A]: the shaft inside a floating stator moves as it likes, so that its A and X
    are independent.
    """
    n, accelerated = model.n_dof, noise.acceleration > 0
    frequency = np.array([omega])

    def measured(coefficients: np.ndarray, unknown: np.ndarray) -> np.ndarray:
        stiffness = model.with_values(coefficients).stiffness(frequency)[0]
        right = unknown[:n] - model.stator_mass * unknown[n:] if accelerated else unknown
        whole = np.concatenate([unknown[:n], np.linalg.solve(stiffness, right), unknown[n:]])
        return np.concatenate([whole.real, whole.imag])

    densities = np.repeat([noise.force, noise.displacement, noise.acceleration][: 3 if accelerated else 2], n)
    densities[:n][force == 0] *= idle
    # An amplitude estimated in T seconds has the variance 2 S^2 / T, half of it in each part.
    deviation = np.tile(densities, 2)
    moved = model.receptance(frequency)[0] @ force
    unknown = np.concatenate([force, -(omega**2) * moved]) if accelerated else force
    columns = []
    for number, scale in enumerate(model.scales):
        step = np.zeros(len(model.names))
        step[number] = 1e-5 * scale
        columns.append(
            (measured(model.expected + step, unknown) - measured(model.expected - step, unknown)) / 2e-5
        )
    for part in (1.0, 1j):
        columns.extend(measured(model.expected, part * unit) for unit in np.eye(unknown.size))
    jacobian = np.stack(columns, axis=1) / deviation[:, None]
    whole = jacobian.T @ jacobian
    k = len(model.names)
    return whole[:k, :k] - whole[:k, k:] @ np.linalg.solve(whole[k:, k:], whole[k:, :k])


@pytest.mark.parametrize("name", RIGS)
def test_information_is_that_of_errors_in_variables(name: str) -> None:
    model, noise, lines = RIGS[name]()
    omega = 2 * np.pi * lines[[3, lines.size // 2]]
    forces = np.array([[2.0 - 1j, 0.5 + 3j], [1.0, -2.0]])[:, : model.n_dof]
    found = vector_information(sensitivities(model, noise, omega), forces)
    for number in range(2):
        expected = _brute_force(model, noise, omega[number], forces[number])
        size = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
        np.testing.assert_allclose(found[number] / size, expected / size, atol=2e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_force_that_is_not_recorded_has_no_noise(axis: int) -> None:
    # One force that is moved from x to y: the other is known to be zero.
    model, noise, lines = RIGS["rotor"]()
    omega, force = 2 * np.pi * lines[[3]], np.eye(2, dtype=complex)[[axis]]
    found = vector_information(sensitivities(model, replace(noise, one_force=True), omega, force), force)
    expected = _brute_force(model, noise, omega[0], force[0], idle=1e-4)
    size = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    np.testing.assert_allclose(found[0] / size, expected / size, atol=2e-6)


def test_stiffness_of_a_spring_alone() -> None:
    # D = k, noise of force alone: k = F / X with the relative error of F, |n_F| / |F|: I = |F|^2 / S_F^2 per
    # second.
    model = planned_model("sdof", {"k": 2e4, "c": 0.0}, 0.0)
    (found,) = vector_information(
        sensitivities(model, SensorDensities(force=0.1), np.array([10.0])), np.array([[3.0 + 0j]])
    )
    assert found[0, 0] == pytest.approx(9.0 / 0.01, rel=1e-12)


def test_a_spectrum_of_rank_one_tells_what_its_vector_tells() -> None:
    model, noise, lines = RIGS["rotor"]()
    sensitivity = sensitivities(model, noise, 2 * np.pi * lines[:4])
    forces = np.random.default_rng(3).normal(size=(4, 2, 2)) @ [1, 1j]
    spectra = forces[:, :, None] * forces[:, None].conj() / 2
    traces = np.einsum("lnki,lmkj,lji->lnm", sensitivity.conj(), sensitivity, spectra)
    found, expected = 2 * traces.real, vector_information(sensitivity, forces)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * expected.max())


def test_noise_per_sample_is_a_density() -> None:
    # White noise of s per sample has its power s^2 spread over half the sampling rate.
    noise = SensorDensities.of_samples(2.0, 3e-6, 0.5, 800.0)
    assert (noise.force**2 * 400, noise.displacement**2 * 400, noise.acceleration**2 * 400) == pytest.approx(
        (4.0, 9e-12, 0.25)
    )


def test_a_coefficient_without_information_has_no_error() -> None:
    assert np.all(np.isinf(relative_errors(np.diag([1.0, 0.0]))))
    np.testing.assert_allclose(relative_errors(np.array([[4.0, 2.0], [2.0, 2.0]])), [np.sqrt(0.5), 1.0])


def test_what_is_missing_is_said() -> None:
    with pytest.raises(ConfigError, match="no value is expected for c"):
        planned_model("sdof", {"k": 1.0}, 1.0)
    with pytest.raises(ConfigError, match="no coefficient m"):
        planned_model("sdof", {"k": 1.0, "c": 1.0, "m": 1.0}, 1.0)
    with pytest.raises(ConfigError, match="needs the known mass"):
        planned_model("rotor-2dof", {}, None)
    with pytest.raises(ConfigError, match="no sensor has noise"):
        SensorDensities()
