"""Blocks of gain, delay and low-pass: exact on clean responses, the right order of noisy ones, coverage,
refusals.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.settings import BlockSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty

FREQUENCY = np.arange(20.0, 3000.0, 20.0)
S = 2j * np.pi * FREQUENCY
TRUE = {
    0: ({"gain": -0.5, "delay": 150e-6}, -0.5 * np.exp(-S * 150e-6)),
    1: (
        {"gain": 2.0, "delay": 75e-6, "corner_frequency": 1500.0},
        2 * np.exp(-S * 75e-6) / (1 + S / (3000 * np.pi)),
    ),
    2: (
        {"gain": 2.0, "delay": 50e-6, "f_n": 1800.0, "zeta": 0.6},
        2 * np.exp(-S * 50e-6) / (1 + 1.2 * S / (3600 * np.pi) + (S / (3600 * np.pi)) ** 2),
    ),
}


def response(order: int, noise: float = 0.0, seed: int = 1) -> FrequencyResponse:
    rng, true = np.random.default_rng(seed), TRUE[order][1]
    drawn = (rng.standard_normal(true.size) + 1j * rng.standard_normal(true.size)) / np.sqrt(2)
    covariance = np.full((true.size, 1, 1), max(noise, 1e-4) ** 2, complex)
    port = (Port("i", "i", "i"),), (Port("u", "u", "u"),)
    return FrequencyResponse(
        FREQUENCY, (true + noise * drawn)[:, None, None], *port, form="other", covariance=covariance
    )


def fitted(measured: FrequencyResponse, order: str = "auto", **keys: object) -> Fit:
    (found,) = identify(
        measured, FitSettings("block", name="amplifier", model_settings=BlockSettings(order), **keys)
    )  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize("order", [0, 1, 2])
def test_clean_responses_give_the_truth(order: int) -> None:
    found = {p.name: p.value for p in fitted(response(order), str(order)).parameters}
    assert found == pytest.approx(TRUE[order][0], rel=1e-5)


def test_stated_numbers_of_channels_are_in_the_intervals() -> None:
    """Gains of 0.3 and 0.4 % are 0.5 % of the gain, and none of the delay, to which 2 us adds itself."""
    of = [Uncertainty("u", 0.003, "1"), Uncertainty("i", 0.004, "1"), Uncertainty("late", 2e-6, "s")]
    ports = (
        {"outputs": (Port("u", "u", "u", uncertainties=(ChannelUncertainty("gain", of[0]),)),)},
        {"inputs": (Port("i", "i", "i", uncertainties=(ChannelUncertainty("gain", of[1]),)),)},
        {"outputs": (Port("u", "u", "u", uncertainties=(ChannelUncertainty("delay", of[2]),)),)},
    )
    fit = fitted(replace(response(0, 0.01), **ports[0], **ports[1]), "0")
    gain, delay = fit.parameter("gain"), fit.parameter("delay")
    assert gain.systematic == pytest.approx(0.005 * abs(gain.value), rel=1e-3)
    assert gain.expanded == pytest.approx(1.96 * np.hypot(gain.std_error, gain.systematic), rel=0.01)
    assert delay.systematic == pytest.approx(0, abs=1e-3 * delay.std_error)
    late = fitted(replace(response(0, 0.01), **ports[2]), "0").parameter("delay")
    assert late.systematic == pytest.approx(2e-6, rel=1e-3) and late.std_error == delay.std_error
    assert "block: the gain is that of u per i, in their SI units." in fit.notes


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_order_of_a_noisy_response_is_found(order: int) -> None:
    fit = fitted(response(order, 0.01))
    assert fit.candidates[0].name == f"order {order}" and fit.gof.chi2_p > 0.01
    for name, value in TRUE[order][0].items():
        assert abs(fit.parameter(name).value - value) < 4 * fit.parameter(name).std_error


@pytest.mark.long
@pytest.mark.parametrize("order", [0, 2])
def test_the_order_and_the_intervals_are_right(order: int) -> None:
    """12 draws at 2 %: the order by BIC, and the intervals of its parameters, 99.9 % regions of what chance
    leaves.
    """
    chosen, held, n = 0, Counter(), 12
    for seed in range(n):
        fit = fitted(response(order, 0.02, seed))
        chosen += fit.candidates[0].name == f"order {order}"
        same = fitted(response(order, 0.02, seed), str(order))
        for name, value in TRUE[order][0].items():
            low, high = same.parameter(name).ci95
            held[name] += low <= value <= high
    assert chosen >= 11
    assert all(held[name] >= stats.binom.ppf(0.001, n, 0.95) for name in TRUE[order][0]), held


@pytest.mark.parametrize(("low", "delay"), [(300.0, 1e-3), (20.0, 5e-3)])
def test_a_delay_that_turns_the_phase_of_the_lowest_line(low: float, delay: float) -> None:
    """-130 deg at 300 Hz: the gain is positive all the same."""
    s = 2j * np.pi * np.arange(low, 1000.0, 20.0)
    plain, true = response(1), 2 * np.exp(-s * delay) / (1 + s / (2000 * np.pi))
    late = replace(plain, frequency=s.imag / (2 * np.pi), matrix=true[:, None, None], covariance=None)
    fit = fitted(replace(late, covariance=np.full((s.size, 1, 1), 1e-6, complex)), "1")
    found = {p.name: p.value for p in fit.parameters}
    assert found == pytest.approx({"gain": 2.0, "delay": delay, "corner_frequency": 1000.0}, rel=1e-5)


def test_a_gain_of_the_other_sign_turns_its_correlations() -> None:
    """A larger gain is a smaller one in size where it is negative."""
    plain = response(1)
    one, other = (fitted(replace(plain, matrix=sign * plain.matrix), "1") for sign in (1, -1))
    signs = np.outer([-1, 1, 1], [-1, 1, 1])
    np.testing.assert_allclose(np.array(other.correlation), signs * np.array(one.correlation), atol=1e-4)
    assert abs(one.correlation[0][2]) > 0.3


def test_too_low_an_order_is_said() -> None:
    fit = fitted(response(2, 0.01), "1")
    assert "model-mismatch" in [finding.code for finding in fit.findings] and fit.gof.chi2_reduced > 10


def test_what_does_not_fit_is_refused() -> None:
    plain = response(1, 0.01)
    with pytest.raises(ConfigError, match="ls does not estimate model block"):
        fitted(plain, estimator="ls")
    with pytest.raises(FitError, match="noise of the response is not known"):
        fitted(replace(plain, covariance=None))
    silent = plain.covariance.copy()
    silent[2] = 0
    with pytest.raises(FitError, match="the line at 60 Hz has no noise"):
        fitted(replace(plain, covariance=silent))
    with pytest.raises(FitError, match="3 lines in the band"):
        fitted(plain, band=(15.0, 65.0))
    double = replace(
        plain,
        matrix=np.repeat(plain.matrix, 2, axis=1),
        outputs=(*plain.outputs, Port("j", "j", "j")),
        covariance=None,
    )
    with pytest.raises(ConfigError, match="one input and one output, not 1 and 2"):
        fitted(double)
