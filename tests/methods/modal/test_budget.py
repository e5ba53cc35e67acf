"""What uncertainties of sensors and of a given mass do to modes, against whole refits of data with the number
off.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal import whole_covariance
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import ChannelUncertainty, MatrixError, Uncertain, Uncertainty
from tests.methods.modal.structures import chain_response

GAIN = Uncertainty("x0.sensitivity", 0.01, "1")
DELAY = Uncertainty("x1.delay", 5e-5, "s")
NUMBER = Uncertainty("m_s, 2 kg", 5e-5, "kg")
TURNED = Uncertainty("port.dof", 0.01, "rad")


def modal(response: FrequencyResponse, **settings: object) -> Fit:
    (fit,) = identify(response, FitSettings("modal", **settings))  # type: ignore[arg-type]
    return fit


def uncertain(known: bool) -> FrequencyResponse:
    response = chain_response(np.linspace(5, 120, 100))
    rng = np.random.default_rng(5)
    std = 2e-8
    noise = (
        std
        * (rng.normal(size=response.matrix.shape) + 1j * rng.normal(size=response.matrix.shape))
        / np.sqrt(2)
    )
    uncertainties = (ChannelUncertainty("gain", GAIN),), (ChannelUncertainty("delay", DELAY),)
    outputs = tuple(
        replace(port, uncertainties=of_port)
        for port, of_port in zip(response.outputs, uncertainties, strict=False)
    )
    # A mass that moves with the structure and is taken off by a sum: dH = H (w^2 dm) H.
    omega = 2 * np.pi * response.frequency[:, None, None]
    change = 5e-5 * omega**2 * response.matrix[:, :, :1] @ response.matrix[:, :1, :]
    covariance = diagonal_covariance(np.full(response.matrix.shape, std**2)) if known else None
    return replace(
        response,
        matrix=response.matrix + noise,
        outputs=outputs,
        covariance=covariance,
        errors=(MatrixError(NUMBER, change),),
    )


def with_error(response: FrequencyResponse, source: Uncertainty, sign: float) -> FrequencyResponse:
    """The response as it were with the number off by one standard uncertainty."""
    if source is NUMBER:
        return replace(response, matrix=response.matrix + sign * response.errors[0].change)
    row, factor = (
        (0, 1 - sign * 0.01)
        if source is GAIN
        else (1, np.exp(2j * np.pi * response.frequency * sign * 5e-5)[:, None])
    )
    matrix = response.matrix.copy()
    matrix[:, row] *= factor
    return replace(response, matrix=matrix)


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_changes_are_those_of_refits(known: bool) -> None:
    """To 2 % of the combined uncertainty (Gauss-Newton's form).

    Without known noise the fit weighs its elements by their residual.
    """
    response = uncertain(known)
    fit = modal(response)
    budget = fit.budget
    assert budget is not None and {uncertainty.source for uncertainty in budget.sources} == {
        GAIN.source,
        DELAY.source,
        NUMBER.source,
    }
    for source in (GAIN, DELAY, NUMBER):
        ends = [modal(with_error(response, source, sign)) for sign in (1.0, -1.0)]
        for name, combined in zip(budget.names, budget.combined, strict=True):
            expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
            assert budget.change_by(source.source, name) == pytest.approx(expected, abs=0.02 * combined)


def oblique(of_force: bool) -> FrequencyResponse:
    """Two modes at 20 and 70 deg, 30 and 47 Hz, seen and driven along x and y.

    One sensor or force with an uncertainty of its direction.
    """
    frequency = np.linspace(15, 80, 200)
    w = 2 * np.pi * frequency
    matrix = np.zeros((w.size, 2, 2), complex)
    for f_n, zeta, mass, angle in ((30.0, 0.02, 2.0, 0.35), (47.0, 0.015, 3.0, 1.22)):
        shape = np.array([np.cos(angle), np.sin(angle)])
        w_n = 2 * np.pi * f_n
        matrix += (1 / mass / (w_n**2 - w**2 + 2j * zeta * w_n * w))[:, None, None] * np.outer(shape, shape)
    rng, std = np.random.default_rng(3), 2e-9
    noise = std * (rng.normal(size=matrix.shape) + 1j * rng.normal(size=matrix.shape)) / np.sqrt(2)
    uncertainties = [
        (ChannelUncertainty("direction", TURNED),) if (n, of_force) in ((0, True), (1, False)) else ()
        for n in (0, 1)
    ]
    outputs = tuple(
        Port(n, n, n, a, () if of_force else d)
        for (n, a), d in zip((("x", 0.0), ("y", np.pi / 2)), uncertainties, strict=True)
    )
    inputs = tuple(
        Port(n, n, n, a, d if of_force else ())
        for (n, a), d in zip((("x", 0.0), ("y", np.pi / 2)), uncertainties, strict=True)
    )
    return FrequencyResponse(
        frequency,
        matrix + noise,
        outputs,
        inputs,
        covariance=diagonal_covariance(np.full(matrix.shape, std**2)),
    )


@pytest.mark.long
@pytest.mark.parametrize("of_force", [True, False])
def test_a_direction_moves_modal_masses_as_refits_say(of_force: bool) -> None:
    """A sensor or force at the angle d sees cos d and sin d of the two directions.

    To 2 % of the combined uncertainty.
    """
    response = oblique(of_force)
    budget = modal(response).budget
    assert budget is not None
    ends = []
    # An angle that is written too large is a port that is turned back.
    for angle in (-TURNED.std_error, TURNED.std_error):
        matrix = response.matrix.swapaxes(1, 2).copy() if of_force else response.matrix.copy()
        one, other, sine = (0, 1, np.sin(angle)) if of_force else (1, 0, -np.sin(angle))
        matrix[:, one] = np.cos(angle) * matrix[:, one] + sine * matrix[:, other]
        ends.append(modal(replace(response, matrix=matrix.swapaxes(1, 2) if of_force else matrix)))
    for name, combined in zip(budget.names, budget.combined, strict=True):
        expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
        assert budget.change_by("port.dof", name) == pytest.approx(expected, abs=0.02 * combined)
    assert (
        max(
            abs(budget.change_by("port.dof", name)) / budget.combined[budget.names.index(name)]
            for name in ("m_1", "m_2")
        )
        > 0.5
    )


def test_budgets_of_large_matrices_are_those_of_refits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the covariance of all FRFs a fit has the weights of its residual, here of one output a
    hundred times as noisy as the other: to 1 % of the combined uncertainty.
    """
    monkeypatch.setattr(whole_covariance, "MOST_PRODUCTS", 0)
    response = uncertain(known=True)
    noise = np.random.default_rng(8).standard_normal((2, *response.matrix[:, 1].shape))
    matrix = response.matrix.copy()
    matrix[:, 1] += 2e-6 * (noise[0] + 1j * noise[1])
    response = replace(response, matrix=matrix)
    budget = modal(response).budget
    ends = [modal(with_error(response, DELAY, sign)) for sign in (1.0, -1.0)]
    for name, combined in zip(budget.names, budget.combined, strict=True):
        expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
        assert budget.change_by(DELAY.source, name) == pytest.approx(expected, abs=0.01 * combined)


def test_a_gain_moves_masses_and_no_frequencies() -> None:
    """Closed form: H (1 - d) in the driving row has the poles that it had, and 1 / (1 - d) times the modal
    mass.
    """
    budget, fit = (one := modal(uncertain(True))).budget, one
    assert budget is not None
    assert budget.change_by(GAIN.source, "m_1") / fit.parameter("m_1").value == pytest.approx(0.01, rel=0.01)
    assert abs(budget.change_by(GAIN.source, "f_n_1")) < 1e-6 * fit.parameter("f_n_1").value


def test_a_given_mass_stands_beside_the_sensors() -> None:
    """k and c are proportional to it; f_n and zeta do not know it."""
    response = uncertain(True)
    fit = modal(response, mass=2.0, uncertainties=(("mass", Uncertain(2.0, 0.02)),))
    assert fit.budget is not None
    for name in ("k_1", "c_1"):
        assert fit.budget.change_by("mass 2 kg", name) == pytest.approx(0.01 * fit.parameter(name).value)
    assert fit.budget.change_by("mass 2 kg", "f_n_1") == 0
    assert fit.parameter("k_1").combined == pytest.approx(
        np.hypot(fit.parameter("k_1").std_error, fit.parameter("k_1").systematic)
    )
