"""The directional response as measured: `directional: true` from simulated recordings of rotors with known
matrices.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.convert import directional, two_sided_response
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

RATE, N = 256.0, 256
MASS, DAMPING = 2.0, 300.0
ISOTROPIC = np.array([[5e4, 8e3], [-8e3, 5e4]])
ANISOTROPIC = np.array([[5e4, 2e3], [1e3, 9e4]])
PERIODIC = FrfSettings(excitation="periodic", period=1.0, skip=0, band=(1.0, 100.0), directional=True)


def stiffness(static: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    omega = 2 * np.pi * frequency
    return static + (1j * omega * DAMPING - omega**2 * MASS)[:, None, None] * np.eye(2)


def run(
    direction: int, static: np.ndarray, rng: np.random.Generator, periods: int = 3, noise: float = 0.0
) -> Recording:
    """One period after the other of the exact response to random phases in one direction."""
    spectrum = np.exp(2j * np.pi * rng.uniform(size=N // 2 + 1))
    spectrum[[0, -1]] = 0.0
    receptance = np.zeros((N // 2 + 1, 2, 2), complex)
    receptance[1:] = np.linalg.inv(stiffness(static, np.arange(1, N // 2 + 1) * RATE / N))
    response = np.fft.irfft(receptance[:, :, direction] * spectrum[:, None], N, axis=0)
    samples = np.tile(np.column_stack([np.fft.irfft(spectrum, N), response]), (periods, 1))
    samples[:, 1:] += noise * rng.normal(size=(samples.shape[0], 2)) * np.std(response)
    angle = direction * np.pi / 2
    ports = (
        Channel("x", "displacement", "output", "x", 0.0),
        Channel("y", "displacement", "output", "y", np.pi / 2),
    )
    return Recording(
        (Channel("f", "force", "input", "xy"[direction], angle), *ports),
        samples,
        RATE,
        f"force {'xy'[direction]}",
    )


def measured(static: np.ndarray, rng: np.random.Generator, noise: float = 0.0):  # type: ignore[no-untyped-def]
    return measure([run(0, static, rng, noise=noise), run(1, static, rng, noise=noise)], PERIODIC)


def test_an_isotropic_rotor_has_no_cross_terms(rng: np.random.Generator) -> None:
    response = measured(ISOTROPIC, rng)
    direct = np.abs(response.matrix[:, [0, 1], [0, 1]])
    cross = np.abs(response.matrix[:, [0, 1], [1, 0]])
    assert np.max(cross / direct.min(axis=1)[:, None]) < 1e-12
    # x + j y turning forward sees k_xx - j k_xy.
    common = stiffness(ISOTROPIC, response.frequency)[:, 0, 0]
    np.testing.assert_allclose(response.matrix[:, 0, 0], 1 / (common - 8e3j), rtol=1e-9)
    assert np.max(np.abs(response.matrix[:, 0, 0] / response.matrix[:, 1, 1] - 1)) > 0.2


def test_backward_is_forward_at_negative_frequency(rng: np.random.Generator) -> None:
    response = measured(ANISOTROPIC, rng)
    a = np.array([[1, 1], [-1j, 1j]])
    negative = np.linalg.inv(a) @ np.linalg.inv(stiffness(ANISOTROPIC, -response.frequency)) @ a
    np.testing.assert_allclose(response.matrix[:, 1, 1], negative[:, 0, 0].conj(), rtol=1e-9)
    np.testing.assert_allclose(response.matrix[:, 1, 0], negative[:, 0, 1].conj(), rtol=1e-9)
    frequency, forward = two_sided_response(response)
    assert frequency[0] == -100.0 and frequency[-1] == 100.0 and np.all(np.diff(frequency) > 0)
    np.testing.assert_allclose(forward[frequency < 0][::-1], negative[:, 0], rtol=1e-9)
    np.testing.assert_array_equal(forward[frequency > 0], response.matrix[:, 0])


@pytest.mark.long
def test_the_covariance_goes_along(rng: np.random.Generator) -> None:
    # Recipe: variance over 80 simulated measurements of the same rotor against the mean of the predicted
    # ones.
    responses = [measured(ANISOTROPIC, rng, noise=0.05) for _ in range(80)]
    matrices = np.array([response.matrix for response in responses])
    predicted = np.mean([response.variance for response in responses], axis=0)
    np.testing.assert_allclose(np.mean(predicted / matrices.var(axis=0), axis=0), 1.0, atol=0.1)


def test_the_artefact_carries_the_directional_response(rng: np.random.Generator, tmp_path: Path) -> None:
    response = measured(ANISOTROPIC, rng, noise=0.01)
    write_response(tmp_path / "a.frf.parquet", response, Header("frf", {}, inputs=()))
    stored = read_response(tmp_path / "a.frf.parquet")
    assert [port.label for port in (*stored.outputs, *stored.inputs)] == ["f", "b", "f", "b"]
    np.testing.assert_array_equal(stored.matrix, response.matrix)
    np.testing.assert_array_equal(stored.covariance, response.covariance)


def test_random_data_give_directional_terms_too(rng: np.random.Generator) -> None:
    # Both forces act at once; gains without dynamics, y lags x: H = g [[1, -0.5], [0.5, 1]] is H_ff = g (1 +
    # 0.5 j).
    forces = rng.normal(size=(40_000, 2))
    samples = np.column_stack(
        [forces, forces @ np.array([[1.0, 0.5], [-0.5, 1.0]]) + 0.01 * rng.normal(size=(40_000, 2))]
    )
    names = (
        ("fx", "force", "input"),
        ("fy", "force", "input"),
        ("x", "displacement", "output"),
        ("y", "displacement", "output"),
    )
    channels = tuple(Channel(*name, "xy"[n % 2], (n % 2) * np.pi / 2) for n, name in enumerate(names))
    response = measure(
        [Recording(channels, samples, RATE, "run")],
        FrfSettings(excitation="random", block=1.0, directional=True),
    )
    np.testing.assert_allclose(response.matrix.mean(axis=0), [[1 + 0.5j, 0], [0, 1 - 0.5j]], atol=1e-3)
    assert response.coherence is None and response.averages > 200


def test_one_direction_is_not_enough(rng: np.random.Generator) -> None:
    with pytest.raises(DataError, match="need two forces in known directions"):
        measure([run(0, ISOTROPIC, rng)], PERIODIC)
    plain = measure([run(0, ISOTROPIC, rng)], FrfSettings(excitation="periodic", period=1.0, skip=0))
    with pytest.raises(DataError, match="needs forward and backward terms"):
        two_sided_response(plain)
    with pytest.raises(DataError, match="two forces"):
        directional(plain)


@pytest.mark.parametrize("model", ["rotor-2dof", "mdof"])
def test_matrices_of_directions_are_not_fitted_to_forward_and_backward_terms(
    model: str, rng: np.random.Generator
) -> None:
    """K between forward and backward terms is complex: real coefficients would be those of another rotor."""
    with pytest.raises(ConfigError, match=f"model {model} is of directions, not of forward and backward"):
        identify(measured(ANISOTROPIC, rng), FitSettings(model, mass=1.0))
