"""The predicted covariance of an FRF matrix against the scatter of simulated measurements, and against loops."""

from __future__ import annotations

import numpy as np

from labpipe.spectra.estimators import h1
from labpipe.spectra.uncertainty import covariance_of_periodic, covariance_of_random

H = np.array([[1.0 + 2.0j, 0.3 - 0.1j], [0.2j, 2.0 - 1.0j]])
MIX = np.array([[1.0, 0.4 + 0.3j], [0.0, 0.8]])
NOISE = np.array([[0.5, 0.2j], [0.0, 0.3]])


def complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def test_random_data_off_diagonals_included() -> None:
    rng = np.random.default_rng(11)
    n_average, n_run = 30, 20_000
    u = MIX @ complex_normal(rng, n_run, 2, n_average)
    y = H @ u + NOISE @ complex_normal(rng, n_run, 2, n_average)
    s_uu, s_yu, s_yy = (a @ b.conj().swapaxes(1, 2) / n_average for a, b in ((u, u), (y, u), (y, y)))
    estimates = h1(s_uu, s_yu, s_yy)
    predicted = covariance_of_random(s_uu, s_yu, s_yy, estimates, n_average).mean(axis=0)
    errors = (estimates - H).reshape(n_run, 4)
    observed = errors.T @ errors.conj() / n_run
    scale = np.sqrt(np.outer(np.diag(observed).real, np.diag(observed).real))
    np.testing.assert_allclose(predicted / scale, observed / scale, atol=0.05)
    np.testing.assert_allclose(np.diag(predicted).real / np.diag(observed).real, 1.0, atol=0.06)


def test_periodic_data_with_noise_on_force_and_response() -> None:
    rng = np.random.default_rng(12)
    n_run = 40_000
    forces = np.array([[1.0, 0.2j], [0.1, 0.8]])
    joint = 0.02 * (rng.normal(size=(2, 4, 4)) + 1j * rng.normal(size=(2, 4, 4)))
    noise = joint @ joint.conj().swapaxes(1, 2)
    errors = np.einsum("eab,reb->rea", joint, complex_normal(rng, n_run, 2, 4))
    u = forces + errors[:, :, :2].swapaxes(1, 2)
    y = H @ forces + errors[:, :, 2:].swapaxes(1, 2)
    difference = (y @ np.linalg.inv(u) - H).reshape(n_run, 4)
    observed = difference.T @ difference.conj() / n_run
    predicted = covariance_of_periodic(H[None], np.linalg.inv(forces)[None], noise[:, None])[0]
    scale = np.sqrt(np.outer(np.diag(observed).real, np.diag(observed).real))
    np.testing.assert_allclose(predicted / scale, observed / scale, atol=0.05)


def test_periodic_covariance_equals_its_literal_twin(rng: np.random.Generator) -> None:
    response, inverse = complex_normal(rng, 3, 2, 2), complex_normal(rng, 3, 4, 2)
    joint = complex_normal(rng, 4, 3, 4, 4)
    noise = joint @ joint.conj().swapaxes(2, 3)
    expected = np.zeros((3, 4, 4), complex)
    for line in range(3):
        for e in range(4):
            w = np.hstack([-response[line], np.eye(2)])
            residual = w @ noise[e, line] @ w.conj().T
            for p in range(4):
                for q in range(4):
                    gain = inverse[line, e, p % 2] * np.conj(inverse[line, e, q % 2])
                    expected[line, p, q] += residual[p // 2, q // 2] * gain
    np.testing.assert_allclose(covariance_of_periodic(response, inverse, noise), expected, rtol=1e-12)
