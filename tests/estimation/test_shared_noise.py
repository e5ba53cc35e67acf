"""Lines that share noise: sums over chosen pairs by hand, and every estimator's uncertainty grows by the same
factor.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.estimation.fitting import identify
from labpipe.estimation.likelihood import maximum_likelihood
from labpipe.estimation.linear_models import sdof
from labpipe.estimation.measured import measured_part
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import WeightUncertainty, weight_uncertainty
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

SHARED = (0.4, 0.1)


@pytest.fixture
def response(rng: np.random.Generator) -> FrequencyResponse:
    frequency = np.arange(40.0, 90.0, 0.5)
    w = 2 * np.pi * frequency
    clean = (1 / (134.5e3 - 0.79 * w**2 + 30j * w))[:, None, None]
    noise = 1e-7 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)) / np.sqrt(2)
    ports = (Port("y", "y", "y"),), (Port("f", "f", "y"),)
    covariance = diagonal_covariance(np.full(clean.shape, 1e-14))
    return FrequencyResponse(frequency, clean + noise, *ports, covariance=covariance, line_correlation=SHARED)


def test_only_chosen_lines_share(response: FrequencyResponse) -> None:
    every = np.ones(100, bool)
    # 99 pairs one apart, 98 two apart.
    measured = measured_part(response, [0], [0], every)
    assert measured.shared_noise == pytest.approx(1 + 2 * (99 * 0.4 + 98 * 0.1) / 100)
    assert measured.shared_power == pytest.approx(1 + 2 * (99 * 0.16 + 98 * 0.01) / 100)
    second, third = (np.arange(100) % step == 0 for step in (2, 3))
    assert measured_part(response, [0], [0], second).shared_noise == pytest.approx(1 + 2 * 49 * 0.1 / 50)
    assert measured_part(response, [0], [0], third).shared_noise == 1.0
    gap = every.copy()
    gap[50] = False
    # A line less takes away two pairs one apart and two pairs two apart.
    assert measured_part(response, [0], [0], gap).shared_noise == pytest.approx(
        1 + 2 * (97 * 0.4 + 96 * 0.1) / 99
    )
    assert measured_part(replace(response, line_correlation=()), [0], [0], every).shared_noise == 1.0


@pytest.mark.parametrize(
    ("estimator", "known"),
    [(e, k) for e in ("ml", "ls", "iv", "amplitude") for k in (True, False) if (e, k) != ("ml", False)],
)
def test_standard_errors_grow_by_the_root_of_the_shared_noise(
    response: FrequencyResponse, estimator: str, known: bool
) -> None:
    response = response if known else replace(response, covariance=None)
    settings = FitSettings("sdof", mass=0.79, estimator=estimator)
    (shared,), (alone,) = (
        identify(each, settings) for each in (response, replace(response, line_correlation=()))
    )
    factor = np.sqrt(1 + 2 * (99 * 0.4 + 98 * 0.1) / 100)
    for name in ("k", "c"):
        assert shared.parameter(name).value == alone.parameter(name).value
        assert shared.parameter(name).std_error == pytest.approx(
            factor * alone.parameter(name).std_error, rel=1e-12
        )


@pytest.mark.parametrize("correlation", [SHARED, (-2 / 3, 1 / 6)])
def test_noise_of_unknown_size_follows_the_correlation_line_by_line(
    response: FrequencyResponse, correlation: tuple[float, ...]
) -> None:
    """Generalised least squares' algebra with the whole matrix R: cov = s^2 A J^T R J A, s^2 = e^T e / tr((1
    - J A J^T) R).
    """
    response = replace(response, covariance=None, line_correlation=correlation)
    model = sdof(Setup(response.outputs, response.inputs, FitSettings("sdof", mass=0.79)))
    estimate = maximum_likelihood(measured_part(response, [0], [0], np.ones(100, bool)), model)
    k, c = estimate.values
    w = 2 * np.pi * response.frequency
    h = 1 / (k - 0.79 * w**2 + 1j * w * c)
    slopes = np.stack([-(h**2), -1j * w * h**2], axis=1)
    j, e = (np.concatenate([part.real, part.imag]) for part in (slopes, response.matrix[:, 0, 0] - h))
    r = np.eye(100) + sum(
        value * (np.eye(100, k=d) + np.eye(100, k=-d)) for d, value in enumerate(correlation, start=1)
    )
    r, a = np.kron(np.eye(2), r), np.linalg.inv(j.T @ j)
    variance = e @ e / np.trace((np.eye(200) - j @ a @ j.T) @ r)
    np.testing.assert_allclose(estimate.covariance, variance * (a @ j.T @ r @ j @ a), rtol=1e-6)


@pytest.mark.long
def test_bootstrap_scatters_as_much(response: FrequencyResponse) -> None:
    (plain,) = identify(response, FitSettings("sdof", mass=0.79))
    (drawn,) = identify(response, FitSettings("sdof", mass=0.79, bootstrap=200))
    # 200 repeats: the standard error of a standard deviation is 5 %.
    assert drawn.parameter("k").std_error == pytest.approx(plain.parameter("k").std_error, rel=0.15)


def test_the_residual_test_counts_independent_lines(response: FrequencyResponse) -> None:
    measured = measured_part(response, [0], [0], np.ones(100, bool))
    uncertainty = weight_uncertainty(measured, 198)
    g = measured.shared_power
    assert uncertainty == WeightUncertainty(1.0, measured.shared_noise, np.inf, g)
    assert uncertainty.p_value(1.2, 198) == pytest.approx(stats.chi2.sf(1.2 * 198 / g, 198 / g), rel=1e-12)
    # An F distribution of mean 1 whose variance is that of both parts; estimates of 30 degrees of freedom
    # share as the noise does.
    estimated = weight_uncertainty(replace(measured, noise_dof=30.0), 198)
    a, d1, d2 = 29.0, 198 / g, estimated.residual_dof
    spread = 30 * (g * a + measured.shared_noise) / ((a**2 - 1) * 100)
    assert stats.f(d1, d2).std() ** 2 / stats.f(d1, d2).mean() ** 2 == pytest.approx(
        spread * 200 / 198, rel=1e-9
    )
