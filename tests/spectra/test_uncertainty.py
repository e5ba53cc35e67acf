"""The predicted covariance of an FRF matrix against the scatter of simulated measurements, and against
loops.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.covariance import (
    covariance_of_h1,
    covariance_of_periodic,
    covariance_of_random,
    joined_response,
)
from labpipe.spectra.measurement import measure
from labpipe.spectra.random import ESTIMATORS, INSTRUMENTS
from labpipe.spectra.settings import FrfSettings

H = np.array([[1.0 + 2.0j, 0.3 - 0.1j], [0.2j, 2.0 - 1.0j]])
MIX = np.array([[1.0, 0.4 + 0.3j], [0.0, 0.8]])
NOISE = np.array([[0.5, 0.2j], [0.0, 0.3]])


def complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def estimated(name: str, u: np.ndarray, y: np.ndarray, averages: float) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and predicted covariance from the spectra u, y (n_run, n, n_average) of many measurements."""
    n_input, both = u.shape[1], np.concatenate([u, y], axis=1)
    joint = both @ both.conj().swapaxes(1, 2) / u.shape[2]
    response = ESTIMATORS[name](
        joint[:, :n_input, :n_input], joint[:, n_input:, :n_input], joint[:, n_input:, n_input:]
    )
    instruments = INSTRUMENTS[name](response, np.einsum("faa->fa", joint).real)
    return response, covariance_of_random(joint, response, instruments, averages)


@pytest.mark.parametrize(
    ("name", "force_noise", "response_noise"), [("H1", 0.0, 1.0), ("H2", 0.3, 0.0), ("Hv", 0.15, 0.3)]
)
def test_random_data_off_diagonals_included(name: str, force_noise: float, response_noise: float) -> None:
    # Recipe: E[d d^H] over 8,000 simulated measurements of 60 averages each, around their mean.
    rng = np.random.default_rng(11)
    n_average, n_run = 60, 8000
    forces = MIX @ complex_normal(rng, n_run, 2, n_average)
    y = H @ forces + response_noise * NOISE @ complex_normal(rng, n_run, 2, n_average)
    u = forces + force_noise * NOISE @ complex_normal(rng, n_run, 2, n_average)
    estimates, covariance = estimated(name, u, y, n_average)
    predicted = covariance.mean(axis=0)
    errors = (estimates - estimates.mean(axis=0)).reshape(n_run, 4)
    observed = errors.T @ errors.conj() / n_run
    scale = np.sqrt(np.outer(np.diag(observed).real, np.diag(observed).real))
    np.testing.assert_allclose(predicted / scale, observed / scale, atol=0.05)
    np.testing.assert_allclose(np.diag(predicted).real / np.diag(observed).real, 1.0, atol=0.06)


@pytest.mark.parametrize("coherence", [0.5, 0.8, 0.95])
def test_h1_and_h2_have_the_same_relative_variance(coherence: float) -> None:
    # Closed form, one force and one response: H2 = S_yy / S_uy errs by sum r y* / (n S_uy), so var H2 = S_rr
    # S_yy / |S_uy|^2 / (n - 1) with S_rr = |H2|^2 S_uu - S_yy: (1 - c) / c |H2|^2 / (n - 1), as for H1.
    joint = np.array([[[1.0, 2.0], [2.0, 4.0 / coherence]]], complex)
    shares = []
    for name in ("H1", "H2"):
        response = ESTIMATORS[name](joint[:, :1, :1], joint[:, 1:, :1], joint[:, 1:, 1:])
        covariance = covariance_of_random(
            joint, response, INSTRUMENTS[name](response, np.array([[1.0, 4.0 / coherence]])), 101.0
        )
        shares.append(covariance[0, 0, 0].real / abs(response[0, 0, 0]) ** 2)
    np.testing.assert_allclose(shares, (1 - coherence) / coherence / 100, rtol=1e-12)


def test_h1_covariance_equals_its_literal_twin(rng: np.random.Generator) -> None:
    # cov(H_oi, H_pj) = S_rr[o, p] (S_uu^-1)[j, i] / (n_e - n_input), written out line by line.
    u, y = complex_normal(rng, 3, 2, 40), complex_normal(rng, 3, 2, 40)
    response, covariance = estimated("H1", u, y, 40)
    for line in range(3):
        residual = y[line] - response[line] @ u[line]
        s_rr, inverse = residual @ residual.conj().T / 40, np.linalg.inv(u[line] @ u[line].conj().T / 40)
        for p in range(4):
            for q in range(4):
                expected = s_rr[p // 2, q // 2] * inverse[q % 2, p % 2] / 38
                assert covariance[line, p, q] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("half_width", [0, 2])
def test_the_short_way_for_h1_is_the_general_one_with_forces_as_instruments(
    rng: np.random.Generator, half_width: int
) -> None:
    u, y = complex_normal(rng, 9, 2, 40), complex_normal(rng, 9, 3, 40)
    both = np.concatenate([u, y], axis=1)
    joint = both @ both.conj().swapaxes(1, 2) / 40
    response = ESTIMATORS["H1"](joint[:, :2, :2], joint[:, 2:, :2], joint[:, 2:, 2:])
    instruments = INSTRUMENTS["H1"](response, np.einsum("faa->fa", joint).real)
    general = covariance_of_random(joint, response, instruments, 40.0, half_width)
    factors = covariance_of_h1(joint, response, np.linalg.inv(joint[:, :2, :2]), 40.0, half_width)
    short = factors.whole()
    np.testing.assert_allclose(short, general, rtol=0, atol=1e-12 * np.max(np.abs(general)))
    np.testing.assert_array_equal(short, short.conj().swapaxes(1, 2))
    assert factors.shape == short.shape
    np.testing.assert_array_equal(factors.variance.reshape(len(short), -1), np.einsum("faa->fa", short).real)
    for p, q in ((0, 0), (3, 1), (2, 3)):
        np.testing.assert_allclose(factors.element(p, q), short[:, p, q], rtol=1e-15)


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


def test_recordings_beyond_the_number_of_forces_leave_no_bias() -> None:
    """Six recordings of two forces with noise that forces and responses share: Y pinv(U) is off by the share
    of noise in U U^H, -N_uu (U U^H)^-1 H + N_yu (U U^H)^-1; what is stated is not, by the mean of 40,000
    lines and its scatter. Two recordings are solved as they are.
    """
    rng = np.random.default_rng(13)
    n_line = 40_000
    forces = np.array([[1.0, 0.2j, 0.9, 0.1, -1.1j, 0.3], [0.1, 0.8, 0.1j, -1.0, 0.2, 1.2]])
    joint = 0.05 * (rng.normal(size=(6, 4, 4)) + 1j * rng.normal(size=(6, 4, 4)))
    errors = np.einsum("eab,leb->lae", joint, complex_normal(rng, n_line, 6, 4))
    mean = np.concatenate([forces, H @ forces])[None] + errors
    noise = np.repeat((joint @ joint.conj().swapaxes(1, 2))[:, None], n_line, axis=1)
    inverse = np.linalg.pinv(mean[:, :2])
    joined = joined_response(mean, inverse, noise)
    error = np.std(joined, axis=0) / np.sqrt(n_line)
    assert np.all(np.abs(np.mean(joined, axis=0) - H) < 4 * error)
    as_it_is = joined_response(mean, inverse, None)
    assert np.all(np.max(np.abs(np.mean(as_it_is, axis=0) - H) / error) > 10)
    first_two = np.linalg.pinv(mean[:3, :2, :2])
    np.testing.assert_array_equal(
        joined_response(mean[:3, :, :2], first_two, noise[:2, :3]), mean[:3, 2:, :2] @ first_two
    )
    loud = joined_response(mean[:3], inverse[:3], 50 * noise[:, :3])
    np.testing.assert_array_equal(loud, as_it_is[:3])


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


def test_what_leaks_under_one_force_is_not_the_noise_of_another() -> None:
    """Eight responses of two modes, forces of 1 and .3 one after the other, 29 blocks, too few for each force
    by itself: variance over 24 records, of which leakage is most, over the mean of what is stated.

    Pooled over the forces it was 1.65 of the one and .15 of the other.
    """
    rate, n, outputs = 256.0, 7680, 8
    omega = 2 * np.pi * np.fft.rfftfreq(2 * n, 1 / rate)
    shapes = np.array([np.linspace(1.0, 0.3, outputs), np.cos(np.linspace(0.3, 2.5, outputs))])
    frf, stated = [], []
    for seed in range(24):
        rng, records = np.random.default_rng([seed, 77]), []
        for number, drives in enumerate(((1.0, 1.0), (0.3, 0.3))):
            spectrum, motion = np.fft.rfft(rng.normal(size=2 * n)), np.zeros((outputs, n))
            for f_n, drive, shape in zip((30.0, 70.0), drives, shapes, strict=True):
                w_n = 2 * np.pi * f_n
                receptance = drive / (w_n**2 - omega**2 + 0.02j * w_n * omega)
                motion += np.outer(shape, np.fft.irfft(-(omega**2) * receptance * spectrum, 2 * n)[n:])
            motion += 0.01 * np.std(motion) * rng.normal(size=motion.shape)
            force = np.fft.irfft(spectrum, 2 * n)[n:]
            channels = (
                Channel("f", "force", "input", f"f{number}"),
                *(Channel(f"a{k}", "acceleration", "output", f"{k}") for k in range(outputs)),
            )
            records.append(Recording(channels, np.column_stack([force, *motion]), rate, f"r{number}"))
        response = measure(records, FrfSettings("random", block=2.0, overlap=0.5, band=(20.0, 100.0)))
        frf.append(response.matrix)
        stated.append(np.einsum("lii->li", response.covariance).real.reshape(response.matrix.shape))
    scatter = np.var(frf, axis=0, ddof=1)
    ratio = np.mean(scatter / np.mean(stated, axis=0), axis=(0, 1))
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)
