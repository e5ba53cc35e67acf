"""What doubts of sensors and of a given mass do to modes, against whole refits of data with the number off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.records.doubt import ChannelDoubt, Doubt, MatrixError
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, uncorrelated
from labpipe.records.uncertain import Uncertain
from tests.unit.modal.structures import chain_response

GAIN = Doubt("x0.sensitivity", 0.01, "1")
DELAY = Doubt("x1.delay", 5e-5, "s")
NUMBER = Doubt("m_s, 2 kg", 5e-5, "kg")


def modal(response: FrequencyResponse, **settings: object) -> Fit:
    (fit,) = identify(response, FitSettings("modal", **settings))  # type: ignore[arg-type]
    return fit


def doubted(known: bool) -> FrequencyResponse:
    response = chain_response(np.linspace(5, 120, 200))
    rng = np.random.default_rng(5)
    std = 2e-8
    noise = std * (rng.normal(size=response.matrix.shape) + 1j * rng.normal(size=response.matrix.shape)) / np.sqrt(2)
    doubts = (ChannelDoubt("gain", GAIN),), (ChannelDoubt("delay", DELAY),)
    outputs = tuple(replace(port, doubts=of_port) for port, of_port in zip(response.outputs, doubts, strict=False))
    # A mass that moves with the structure and is taken off by a sum: dH = H (w^2 dm) H.
    omega = 2 * np.pi * response.frequency[:, None, None]
    change = 5e-5 * omega**2 * response.matrix[:, :, :1] @ response.matrix[:, :1, :]
    covariance = uncorrelated(np.full(response.matrix.shape, std**2)) if known else None
    return replace(response, matrix=response.matrix + noise, outputs=outputs, covariance=covariance, errors=(MatrixError(NUMBER, change),))


def with_error(response: FrequencyResponse, source: Doubt, sign: float) -> FrequencyResponse:
    """The response as it were with the number off by one standard uncertainty."""
    if source is NUMBER:
        return replace(response, matrix=response.matrix + sign * response.errors[0].change)
    row, factor = (0, 1 - sign * 0.01) if source is GAIN else (1, np.exp(2j * np.pi * response.frequency * sign * 5e-5)[:, None])
    matrix = response.matrix.copy()
    matrix[:, row] *= factor
    return replace(response, matrix=matrix)


@pytest.mark.parametrize("known", [True, False])
def test_changes_are_those_of_refits(known: bool) -> None:
    """To 2 % of the combined uncertainty (Gauss-Newton's form); without known noise the fit weighs its elements by their residual."""
    response = doubted(known)
    fit = modal(response)
    budget = fit.budget
    assert budget is not None and {doubt.source for doubt in budget.sources} == {GAIN.source, DELAY.source, NUMBER.source}
    for source in (GAIN, DELAY, NUMBER) if known else (NUMBER,):
        ends = [modal(with_error(response, source, sign)) for sign in (1.0, -1.0)]
        for name, combined in zip(budget.names, budget.combined, strict=True):
            expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
            assert budget.change_by(source.source, name) == pytest.approx(expected, abs=0.02 * combined)


def test_a_gain_moves_masses_and_no_frequencies() -> None:
    """Closed form: H (1 - d) in the driving row has the poles that it had, and 1 / (1 - d) times the modal mass."""
    budget, fit = (one := modal(doubted(True))).budget, one
    assert budget is not None
    assert budget.change_by(GAIN.source, "m_1") / fit.parameter("m_1").value == pytest.approx(0.01, rel=0.01)
    assert abs(budget.change_by(GAIN.source, "f_n_1")) < 1e-6 * fit.parameter("f_n_1").value


def test_a_given_mass_stands_beside_the_sensors() -> None:
    """k and c are proportional to it; f_n and zeta do not know it."""
    response = doubted(True)
    fit = modal(response, mass=2.0, doubts=(("mass", Uncertain(2.0, 0.02)),))
    assert fit.budget is not None
    for name in ("k_1", "c_1"):
        assert fit.budget.change_by("mass 2 kg", name) == pytest.approx(0.01 * fit.parameter(name).value)
    assert fit.budget.change_by("mass 2 kg", "f_n_1") == 0
    assert fit.parameter("k_1").combined == pytest.approx(np.hypot(fit.parameter("k_1").std_error, fit.parameter("k_1").systematic))
