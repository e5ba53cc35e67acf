"""Mass on a moving base: transmissibilities in closed form, every estimator, wrong combinations, recordings
of any motion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from labpipe.simulate.linear import BaseRig, relative_transmissibility
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

MASS, K, C = 2.0, 126.33e3, 20.0
F_N, ZETA = np.sqrt(K / MASS) / (2 * np.pi), C / (2 * np.sqrt(K * MASS))
LINES = np.arange(10.0, 90.0, 1.0)
BASE = FitSettings("base", mass=MASS)


def absolute(frequency: np.ndarray) -> np.ndarray:
    """(k + j w c) / (k + j w c - w^2 m), Thomson and Dahleh, eq. 3.5-8."""
    w = 2 * np.pi * frequency
    return (K + 1j * w * C) / (K + 1j * w * C - w**2 * MASS)


def relative(frequency: np.ndarray) -> np.ndarray:
    """w^2 m / (k + j w c - w^2 m), eq. 3.5-5 of the same."""
    w = 2 * np.pi * frequency
    return w**2 * MASS / (K + 1j * w * C - w**2 * MASS)


def response(
    values: np.ndarray, std: float = 0.0, form: str = "transmissibility", seed: int = 0
) -> FrequencyResponse:
    """An FRF with circular noise of *std* on the real and on the imaginary part."""
    rng = np.random.default_rng([81, seed])
    noise = std * (rng.normal(size=values.size) + 1j * rng.normal(size=values.size))
    covariance = np.full((values.size, 1, 1), 2 * std**2 + 0j) if std else None
    ports = (Port("mass", "mass", "z"),), (Port("base", "base", "z"),)
    return FrequencyResponse(LINES, (values + noise)[:, None, None], *ports, form=form, covariance=covariance)


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
@pytest.mark.parametrize("is_relative", [False, True])
def test_exact_transmissibilities_give_exact_coefficients(estimator: str, is_relative: bool) -> None:
    exact = relative(LINES) if is_relative else absolute(LINES)
    (fit,) = identify(response(exact), replace(BASE, estimator=estimator, relative=is_relative))
    found = {parameter.name: parameter.value for parameter in fit.parameters}
    assert found == {
        name: pytest.approx(value, rel=1e-9)
        for name, value in (("k", K), ("c", C), ("f_n", F_N), ("zeta", ZETA))
    }
    assert fit.curve is not None and fit.curve.form == "transmissibility"
    np.testing.assert_allclose(fit.curve.measured[:, 0, 0], exact)
    np.testing.assert_allclose(fit.curve.fitted[:, 0, 0], exact, rtol=1e-9)
    assert fit.curve.dense is not None and fit.curve.dense_frequency is not None
    dense = relative(fit.curve.dense_frequency) if is_relative else absolute(fit.curve.dense_frequency)
    np.testing.assert_allclose(fit.curve.dense[:, 0, 0], dense, rtol=1e-9)


def test_without_a_mass_only_ratios_are_known() -> None:
    (fit,) = identify(response(absolute(LINES), 0.01), FitSettings("base"))
    (given,) = identify(response(absolute(LINES), 0.01), BASE)
    assert [(p.name, p.unit) for p in fit.parameters] == [
        ("stiffness_per_mass", "1/s^2"),
        ("damping_per_mass", "1/s"),
        ("f_n", "Hz"),
        ("zeta", "1"),
    ]
    for name, per_mass in (("k", "stiffness_per_mass"), ("c", "damping_per_mass")):
        of, own = given.parameter(name), fit.parameter(per_mass)
        assert of.value == pytest.approx(MASS * own.value) and of.std_error == pytest.approx(
            MASS * (own.std_error or 0)
        )
    for name in ("f_n", "zeta"):
        assert fit.parameter(name).std_error == pytest.approx(given.parameter(name).std_error)


def test_standard_errors_are_those_of_the_information() -> None:
    """Cramer-Rao: (2 Re sum dT* dT^T / var)^-1 with dT/dk and dT/dc by central differences of the closed
    form.
    """
    std = 0.01
    w = 2 * np.pi * LINES

    def t(k: float, c: float) -> np.ndarray:
        return (k + 1j * w * c) / (k + 1j * w * c - w**2 * MASS)

    slopes = np.array(
        [(t(K * 1.0001, C) - t(K * 0.9999, C)) / (2e-4 * K), (t(K, C * 1.001) - t(K, C * 0.999)) / (2e-3 * C)]
    )
    bound = np.sqrt(np.diag(np.linalg.inv((slopes.conj() @ slopes.T).real / std**2)))
    (fit,) = identify(response(absolute(LINES), std), BASE)
    np.testing.assert_allclose([fit.parameter("k").std_error, fit.parameter("c").std_error], bound, rtol=0.02)


def test_the_wrong_motion_is_a_mismatch() -> None:
    (fit,) = identify(response(relative(LINES), 0.01), BASE)
    assert "model-mismatch" in {finding.code for finding in fit.findings}


@pytest.mark.parametrize(
    ("form", "settings", "message"),
    [
        ("receptance", BASE, "needs the motion of the base as input, this FRF is of a force"),
        ("other", BASE, "this FRF is of the form 'other'"),
        (
            "transmissibility",
            FitSettings("sdof"),
            "sdof needs a force as input, this FRF is of the motion of a base; model: base",
        ),
        ("transmissibility", replace(BASE, mass=(1.0, 2.0)), "takes one positive mass"),
        ("transmissibility", replace(BASE, mass=0.0), "takes one positive mass"),
    ],
)
def test_wrong_combinations_are_refused(form: str, settings: FitSettings, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        identify(response(absolute(LINES), form=form), settings)


def test_relative_goes_with_a_base_only() -> None:
    with pytest.raises(
        ConfigError, match=r"'relative' is not for model sdof; leave it out; models that take it: base$"
    ):
        FitSettings("sdof", relative=True)
    with pytest.raises(ConfigError, match="amplitude does not estimate model base"):
        FitSettings("base", estimator="amplitude")


def test_two_responses_need_a_choice() -> None:
    one = response(absolute(LINES))
    both = replace(
        one, matrix=np.repeat(one.matrix, 2, axis=1), outputs=(Port("a", "a", "z"), Port("b", "b", "z"))
    )
    with pytest.raises(ConfigError, match="one response and one base, found a, b and base"):
        identify(both, BASE)
    (fit,) = identify(both, replace(BASE, output=("b",)))
    assert fit.parameter("k").value == pytest.approx(K)


@pytest.mark.parametrize("base", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("mass", ["displacement", "velocity", "acceleration"])
def test_any_motion_over_any_motion_is_one_transmissibility(base: str, mass: str) -> None:
    """Periodic base motion; the derivative of every quantity taken line by line, so that X / B is exact."""
    order = {"displacement": 0, "velocity": 1, "acceleration": 2}
    n, rate = 512, 512.0
    lines = np.arange(10, 91)
    w = 2 * np.pi * lines
    spectra = {
        "base": (1j * w) ** order[base] * np.exp(1j * lines**2),
        "mass": (1j * w) ** order[mass] * absolute(lines) * np.exp(1j * lines**2),
    }
    columns = []
    for values in spectra.values():
        whole = np.zeros(n // 2 + 1, complex)
        whole[lines] = values
        columns.append(np.tile(np.fft.irfft(whole, n), 3))
    channels = (Channel("b", base, "input", "z"), Channel("x", mass, "output", "z"))
    found = measure(
        [Recording(channels, np.column_stack(columns), rate, "p")],
        FrfSettings("periodic", period=1.0, band=(10.0, 90.0)),
    )
    assert found.form == "transmissibility"
    np.testing.assert_allclose(found.matrix[:, 0, 0], absolute(found.frequency), rtol=1e-8)


def test_motions_of_several_quantities_are_refused() -> None:
    outputs = [Channel(name, name, "output", "z") for name in ("displacement", "acceleration")]
    channels = (Channel("b", "acceleration", "input", "z"), *outputs)
    with pytest.raises(DataError, match="the responses are of several quantities"):
        measure(
            [Recording(channels, np.random.default_rng(1).normal(size=(4096, 3)), 512.0, "r")],
            FrfSettings("random", block=1.0),
        )


def test_the_virtual_table_obeys_the_equation_of_motion() -> None:
    """m r'' + c r' + k r = -m b'' of the relative motion, by scipy.signal.lsim, against the rig's factor -m /
    (k + j w c - w^2 m).
    """
    rig = BaseRig("virtual-base-rig", MASS, K, C)
    f = 33.0
    t = np.arange(0, 8, 1 / 8192)
    moved = signal.lsim(([-MASS], [MASS, C, K]), np.sin(2 * np.pi * f * t), t)[1]
    late = t > 6
    factor = np.linalg.lstsq(
        np.column_stack([np.sin(2 * np.pi * f * t), np.cos(2 * np.pi * f * t)])[late], moved[late], rcond=None
    )[0]
    expected = relative_transmissibility(rig, np.array([f]))[0] / (2j * np.pi * f) ** 2
    assert complex(*factor) == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(1 + relative_transmissibility(rig, LINES), absolute(LINES))


@pytest.mark.parametrize("estimator", ["ml", "ls", "iv"])
@pytest.mark.parametrize("is_relative", [False, True])
def test_the_budget_is_that_of_refits(estimator: str, is_relative: bool) -> None:
    """A gain of 1 % of the mass's sensor acts on T itself, not on T - 1.

    A mass of +- 1 % on k and c in proportion.
    """
    exact = relative(LINES) if is_relative else absolute(LINES)
    gain = ChannelUncertainty("gain", Uncertainty("mass.sensitivity", 0.01, "1"))
    uncertain = replace(response(exact, 1e-3), outputs=(Port("mass", "mass", "z", None, (gain,)),))
    settings = FitSettings("base", mass="2 kg +- 1 %", relative=is_relative, estimator=estimator)
    (fit,) = identify(uncertain, settings)
    assert fit.budget is not None
    ends = [
        identify(replace(uncertain, matrix=uncertain.matrix * (1 - error)), settings)[0]
        for error in (0.001, -0.001)
    ]
    for name, combined in zip(fit.budget.names, fit.budget.combined, strict=True):
        expected = 10 * (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
        assert fit.budget.change_by("mass.sensitivity", name) == pytest.approx(expected, abs=0.02 * combined)
    weighed = {source.source for source in fit.budget.sources} - {"mass.sensitivity"}
    assert len(weighed) == 1 and fit.budget.change_by(weighed.pop(), "k") == pytest.approx(
        0.01 * fit.parameter("k").value, rel=1e-3
    )


def test_a_drift_of_a_gain_is_seen_as_such() -> None:
    """1 % between the halves of the record, of T itself."""
    noise = response(absolute(LINES), 2e-3, seed=1).matrix - absolute(LINES)[:, None, None]
    measured = replace(response(absolute(LINES), 1e-3), change=0.01 * absolute(LINES)[:, None, None] + noise)
    (fit,) = identify(measured, BASE)
    (drift,) = [finding.message for finding in fit.findings if finding.code == "drift"]
    assert "it looks like the gain of mass or base changed by +0.99" in drift
