"""One mode seen from another point than it is driven at: truths are closed forms, the noise is drawn here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.likelihood import maximum_likelihood, maximum_likelihood_from
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.transfer_mode import TransferMode, is_transfer, transfer_start
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from tests.estimation.noisy import measured

F0, ZETA, CONSTANT = 40.0, 0.01, 0.8
FREQUENCY = np.arange(36.0, 44.0, 0.08)


def transfer(
    factor: complex | np.ndarray = 1.0, seed: int = 0, noise: float = 0.01, dof: str = "2"
) -> FrequencyResponse:
    """A mode of modal constant 0.8 1/kg times *factor*, driven at 1 and seen at *dof*, with noise of unknown
    size.
    """
    rng = np.random.default_rng(seed)
    w, w0 = 2 * np.pi * FREQUENCY, 2 * np.pi * F0
    h = factor * CONSTANT / (w0**2 - w**2 + 2j * ZETA * w0 * w)
    std = noise * np.sqrt(np.mean(np.abs(h) ** 2) / 2)
    h = h + std * (rng.normal(size=w.size) + 1j * rng.normal(size=w.size))
    return FrequencyResponse(FREQUENCY, h[:, None, None], (Port("y", "y", dof),), (Port("f", "f", "1"),))


@pytest.mark.parametrize("natural", [0.1, 40.0])
def test_the_start_is_the_mode_itself_without_noise(natural: float) -> None:
    """Of a slow oscillation too, whose square of the frequency is below one in (rad/s)^2."""
    w, w0 = 2 * np.pi * np.linspace(0.83, 1.2, 41) * natural, 2 * np.pi * natural
    h = (CONSTANT - 0.1j) / (w0**2 - w**2 + 0.06j * w0 * w) + (0.3 + 0.2j) / w0**2
    response = FrequencyResponse(
        w / (2 * np.pi), h[:, None, None], (Port("y", "y", "2"),), (Port("f", "f", "1"),)
    )
    start = transfer_start(measured(response))
    np.testing.assert_allclose(start, [natural, 0.03, CONSTANT, -0.1, 0.3 / w0**2, 0.2 / w0**2], rtol=1e-6)


def codes(fit: Fit) -> list[str]:
    return [finding.code for finding in fit.findings]


@pytest.mark.parametrize("estimator", ["ml", "ls", "iv"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_residue_of_either_sign_gives_frequency_damping_and_signed_constant(
    estimator: str, sign: float
) -> None:
    (fit,) = identify(transfer(sign), FitSettings("sdof", estimator=estimator))
    assert fit.parameter("f_n").value == pytest.approx(F0, rel=5e-4)
    assert fit.parameter("zeta").value == pytest.approx(ZETA, rel=0.05)
    assert fit.parameter("modal_constant").value == pytest.approx(sign * CONSTANT, rel=0.05)
    assert not {"unphysical", "model-mismatch", "collinear"} & set(codes(fit))


def test_the_same_data_at_a_driving_point_have_an_impossible_mass() -> None:
    (fit,) = identify(transfer(-1.0, dof="1"), FitSettings("sdof"))
    (said,) = [finding.message for finding in fit.findings if finding.code == "unphysical"]
    assert "m = -1.2" in said and "driving point" in said


@pytest.mark.long
@pytest.mark.parametrize("shape", ["delay", "gain", "both"])
def test_what_only_turns_the_residue_is_not_cried_over(shape: str) -> None:
    """exp(-j w t) and 1 + a (w - w0), over s - lambda, are constants over s - lambda beside what is smooth:
    the pole stays.
    """
    w, w0 = 2 * np.pi * FREQUENCY, 2 * np.pi * F0
    factor = np.ones(w.size, complex)
    if shape != "gain":
        factor *= np.exp(-1j * w * 1.2e-3)
    if shape != "delay":
        factor *= 1 + 0.5 * (w - w0) / w0
    fits = [identify(transfer(factor, seed), FitSettings("sdof"))[0] for seed in range(8)]
    assert sum("model-mismatch" in codes(fit) for fit in fits) <= 1
    assert (
        sum(
            fit.parameter("f_n").ci95[0] < F0 < fit.parameter("f_n").ci95[1]
            for fit in fits
            if fit.parameter("f_n").ci95
        )
        >= 7
    )
    assert (
        sum(
            fit.parameter("zeta").ci95[0] < ZETA < fit.parameter("zeta").ci95[1]
            for fit in fits
            if fit.parameter("zeta").ci95
        )
        >= 7
    )


@pytest.mark.parametrize("known", [True, False])
def test_negative_damping_and_a_pole_beside_the_band_are_said(known: bool) -> None:
    growing = transfer()
    growing = replace(growing, matrix=growing.matrix.conj())
    if known:
        growing = replace(
            growing,
            covariance=diagonal_covariance(
                np.full(growing.matrix.shape, 1e-4 * np.mean(np.abs(growing.matrix) ** 2))
            ),
        )
    (fit,) = identify(growing, FitSettings("sdof"))
    assert any(finding.code == "unphysical" and "zeta = -0.0" in finding.message for finding in fit.findings)
    (beside,) = identify(transfer(noise=1e-4), FitSettings("sdof", band=(36.0, 39.0)))
    assert any(
        finding.code == "unphysical" and "outside the band" in finding.message for finding in beside.findings
    )


def test_a_transfer_is_told_by_its_dofs() -> None:
    def port(dof: str, angle: float | None = None) -> Port:
        return Port(dof, dof, dof, angle)

    assert is_transfer(port("1"), port("2")) and is_transfer(port("x"), port("y"))
    assert not is_transfer(port("1"), port("1")) and not is_transfer(port(""), port("2"))
    assert not is_transfer(port("x"), port("45 deg", np.pi / 4))
    # Columns of a file without a rig: what they are named after is not known.
    assert not is_transfer(port("y"), port("f")) and not is_transfer(port("acc"), port("force"))
    assert is_transfer(Port("acc", "acc", "tip"), Port("f", "f", "root"))
    # A point with a number beside a column that is no point: not the same place.
    assert is_transfer(port("1"), port("f")) and is_transfer(port("f"), port("1"))
    assert not is_transfer(port("x"), port("f"))
    # Two points of a universal file in one direction.
    assert is_transfer(port("1.x", 0.0), port("3.x", 0.0))
    assert not is_transfer(port("3.x", 0.0), port("3.x", 0.0))


def test_what_an_frf_is_taken_for_is_said() -> None:
    (fit,) = identify(transfer(1.0), FitSettings("sdof"))
    assert any("is taken as a transfer FRF" in text for text in fit.notes)


def test_slopes_are_those_of_the_function() -> None:
    values, w = np.array([40.0, 0.02, 0.8, -0.3, 1e-6, 2e-6]), 2 * np.pi * np.arange(30.0, 50.0)
    model = TransferMode()
    for n, slope in enumerate(model.jacobian(values, w)):
        step = np.zeros(6)
        step[n] = 1e-6 * abs(values[n])
        change = (model.receptance(values + step, w) - model.receptance(values - step, w)) / (2 * step[n])
        np.testing.assert_allclose(slope, change, rtol=1e-6, atol=1e-8 * np.max(np.abs(change)))


@pytest.mark.parametrize("seed", [20, 22, 27, 40])
def test_a_dip_of_the_force_beside_the_peak_does_not_draw_the_fit_away(seed: int) -> None:
    """A peak at 213.4 Hz, and a dip of the force at 221 Hz, where noise is 300 times as large: least squares
    alone end there, at a mode narrower than a line with a larger residual.
    """
    frequency = np.arange(200.0, 230.0, 0.25)
    w, w_n = 2 * np.pi * frequency, 2 * np.pi * 213.4
    matrix = (0.5 + 0.1j) / (w_n**2 - w**2 + 2j * 0.006 * w_n * w)
    rng = np.random.default_rng(seed)
    noise = 0.005 * float(np.max(np.abs(matrix))) * (rng.normal(size=w.size) + 1j * rng.normal(size=w.size))
    matrix = matrix + noise * (1 + 300 * np.exp(-(((frequency - 221) / 0.3) ** 2)))
    ports = (Port("y", "y", "2"),), (Port("f", "f", "1"),)
    response = FrequencyResponse(frequency, matrix[:, None, None], *ports)
    drawn_away = maximum_likelihood_from(
        measured(response), TransferMode(), transfer_start(measured(response)), "least squares"
    )
    assert drawn_away.values[0] == pytest.approx(221.0, abs=0.3)
    best = maximum_likelihood(measured(response), TransferMode())
    assert best.values[0] == pytest.approx(213.4, abs=0.2) and best.squares < drawn_away.squares


def test_a_mode_narrower_than_a_line_is_said() -> None:
    frequency = np.arange(20.0, 60.0, 1.0)
    w, w_n = 2 * np.pi * frequency, 2 * np.pi * 40.2
    matrix = 0.5 / (w_n**2 - w**2 + 2j * 0.001 * w_n * w)
    rng = np.random.default_rng(0)
    noise = 1e-3 * float(np.max(np.abs(matrix))) * (rng.normal(size=w.size) + 1j * rng.normal(size=w.size))
    ports = (Port("y", "y", "2"),), (Port("f", "f", "1"),)
    (fit,) = identify(
        FrequencyResponse(frequency, (matrix + noise)[:, None, None], *ports), FitSettings("sdof")
    )
    (finding,) = [finding for finding in fit.findings if finding.code == "leakage"]
    assert "less than the 1 Hz from line to line" in finding.message
