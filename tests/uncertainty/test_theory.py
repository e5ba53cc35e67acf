"""Fit with fit: a response made of the theory times a known ratio gives that ratio back, with slopes as
finite differences show.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.rolling_bearing import ratio as ratio_module
from labpipe.methods.rolling_bearing.loads import DOFS, RigidShaft, sdof_stiffness, transfer_matrix
from labpipe.methods.rolling_bearing.ratio import (
    RatioRig,
    TheoryAt,
    log_covariance,
    match,
    overlay,
    solve_ratio,
)
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import Uncertain
from tests.uncertainty.conftest import a_fit

SHAFT = RigidShaft(2.45, 1.24e-2, 1.24e-2)
# NSK 6208 at 427 N as printed by Knaapen (1997), appendix A.
K = np.diag([0.2125e9, 0.2125e9, 0.1654e8, 0.7517e4, 0.7516e4])
K[0, 4] = K[4, 0] = -0.1087e7
K[1, 3] = K[3, 1] = 0.1087e7
BETA, BENDING, ARM = 2e-5, 1.176e8, 0.1
THEORY = TheoryAt(K, K * 1.0007, 1e-3, SHAFT)
PEAKS = FitSettings(
    "sdof",
    peaks=(("x", ((700.0, 1200.0),)), ("z", ((300.0, 600.0),)), ("by", ((45.0, 100.0),))),
    name="peaks",
)
BENT, RIGID = RatioRig(Uncertain(BENDING, 0.01 * BENDING), ARM), RatioRig(Uncertain(np.inf), ARM)


def measured(ratio: float, bending: float, rng=None, noise: float = 0.003) -> FrequencyResponse:
    """Accelerance of x, z and by (at the arm) with the stiffness *ratio* times the theory's."""
    frequency = np.arange(20.0, 1500.0, 2.0)
    rows = [DOFS.index(dof) for dof in ("x", "z", "by")]
    arms = np.array([1.0, 1.0, ARM])
    h = (
        transfer_matrix(SHAFT, ratio * K, frequency, BETA, bending)[:, rows][:, :, rows]
        * arms[:, None]
        * arms
    )
    h = -((2 * np.pi * frequency) ** 2)[:, None, None] * h
    if rng is not None:
        h = h + noise * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    outputs, inputs = (
        tuple(Port(f"{name}{dof}", name or dof, dof) for dof in ("x", "z", "by")) for name in ("", "f")
    )
    return FrequencyResponse(
        frequency,
        h,
        outputs,
        inputs,
        form="accelerance",
        covariance=diagonal_covariance(np.full(h.shape, noise**2)),
        name="t",
    )


def fits_of(response: FrequencyResponse):
    return {fit.term: replace(fit, test="t") for fit in identify(response, PEAKS)}


@pytest.mark.parametrize("term", ["x", "z", "by"])
@pytest.mark.parametrize("ratio", [0.8, 1.12])
def test_the_ratio_behind_a_response_is_found(term: str, ratio: float) -> None:
    response = measured(ratio, BENDING)
    found = match(fits_of(response)[term], response, PEAKS, THEORY, BENT)
    np.testing.assert_allclose(np.exp(found.log), [ratio, BETA], rtol=1e-7)


def test_neither_k_ii_nor_the_plain_series_correction_would_do() -> None:
    """Radially the plain ratio of fits is far off, after the series correction still over 0.2 %.

    Tilt fits give 26 % of K_ii.
    """
    response = measured(1.12, BENDING)
    fits = fits_of(response)
    found = match(fits["x"], response, PEAKS, THEORY, BENT)
    total = fits["x"].parameter("k").value
    assert total / found.theory[0] < 1.05
    corrected = 1 / (1 / total - 1 / BENDING) / sdof_stiffness(SHAFT, K)[0]
    assert abs(corrected / 1.12 - 1) > 0.002
    tilt = fits["by"].parameter("k").value * ARM**2
    assert tilt / (1.12 * K[4, 4]) == pytest.approx(0.26, abs=0.02)


def test_an_uncoupled_fit_of_the_theory_is_the_coefficient_itself() -> None:
    response = measured(1.12, np.inf)
    found = match(fits_of(response)["z"], response, PEAKS, THEORY, RIGID)
    np.testing.assert_allclose(found.theory, [K[2, 2], BETA * K[2, 2]], rtol=1e-8)
    np.testing.assert_allclose(
        found.covariance[0, 0], log_covariance(fits_of(response)["z"])[0, 0], rtol=1e-6
    )
    assert not found.to_bending.any()
    assert found.to_condition[0] == pytest.approx(-0.7, rel=1e-3)


@pytest.mark.long
def test_slopes_are_what_a_changed_shaft_and_condition_do() -> None:
    """Centred differences of the result itself over 0.2 % of the shaft's stiffness and of the theory."""
    response = measured(1.12, BENDING)
    fit = fits_of(response)["x"]
    found = match(fit, response, PEAKS, THEORY, BENT)
    changed = [
        match(fit, response, PEAKS, THEORY, RatioRig(Uncertain(BENDING * f), ARM)).log for f in (0.998, 1.002)
    ]
    np.testing.assert_allclose(found.to_bending, (changed[1] - changed[0]) / 0.004, rtol=0.02, atol=1e-4)
    assert found.to_bending[0] < -1.5
    theories = [TheoryAt(K * f, K * f * 1.0007, 1e-3, SHAFT) for f in (0.998, 1.002)]
    moved = [match(fit, response, PEAKS, theory, BENT).log[0] for theory in theories]
    assert found.to_condition[0] == pytest.approx(0.7 * (moved[1] - moved[0]) / 0.004, rel=0.02)


def test_the_overlay_lies_on_the_measured_curve() -> None:
    response = measured(1.12, BENDING)
    fit = fits_of(response)["x"]
    found = match(fit, response, PEAKS, THEORY, BENT)
    drawn = overlay(fit, response, PEAKS, THEORY, BENT, found)
    np.testing.assert_allclose(drawn.matched, drawn.measured, rtol=1e-5)
    assert drawn.frequency == tuple(response.frequency)
    peaks = [drawn.frequency[int(np.argmax(curve))] for curve in (drawn.theory, drawn.matched)]
    assert peaks[0] < peaks[1]


def test_log_covariance_carries_the_correlation() -> None:
    fit = a_fit("t", {"k": (100.0, 1.0), "c": (10.0, 0.2)}, correlation=0.5)
    np.testing.assert_allclose(log_covariance(fit), [[1e-4, 1e-4], [1e-4, 4e-4]], rtol=1e-12)


def test_what_cannot_be_compared_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    response = measured(1.12, BENDING)
    fits = fits_of(response)
    with pytest.raises(ConfigError, match="the tilt by is compared without an arm"):
        match(fits["by"], response, PEAKS, THEORY, RatioRig(Uncertain(BENDING), None))
    with pytest.raises(ConfigError, match="not of the model sdof"):
        match(fits["z"], response, FitSettings("mdof", name="peaks"), THEORY, BENT)
    strange = replace(
        response,
        outputs=tuple(replace(p, dof="q", label=p.label) for p in response.outputs[:2])
        + response.outputs[2:],
    )
    named = replace(strange, outputs=(Port("q", "q", "q"), *strange.outputs[1:]))
    other = replace(fits["x"], curve=replace(fits["x"].curve, outputs=("q",)))
    with pytest.raises(ConfigError, match="'q' is not a dof of the bearing's theory"):
        match(other, named, PEAKS, THEORY, BENT)
    negative = replace(fits["z"], parameters=tuple(replace(p, value=-p.value) for p in fits["z"].parameters))
    with pytest.raises(FitError, match="impossible for a bearing"):
        match(negative, response, PEAKS, THEORY, BENT)
    soft = replace(
        fits["x"],
        parameters=tuple(replace(p, value=1e9) if p.name == "k" else p for p in fits["x"].parameters),
    )
    monkeypatch.setattr(ratio_module, "LOOPS", 3)
    with pytest.raises(FitError, match="no multiple of the theory"):
        match(soft, response, PEAKS, THEORY, BENT)


def test_a_root_further_away_than_twenty_steps_of_one_is_none() -> None:
    """In logarithms: ratios up to e^20. A straight line is solved in steps of one, and a last one."""
    slopes = np.array([[1.0, 0.5], [0.0, 2.0]])
    root, found = solve_ratio(lambda u: slopes @ u, slopes @ np.array([-17.5, 3.0]), np.zeros(2))
    np.testing.assert_allclose(root, [-17.5, 3.0], atol=1e-9)
    np.testing.assert_allclose(found, slopes, atol=1e-9)
    with pytest.raises(FitError, match="no multiple of the theory's stiffness"):
        solve_ratio(lambda u: slopes @ u, slopes @ np.array([-25.0, 3.0]), np.zeros(2))


def test_an_uncertain_number_of_the_bearing_file_moves_the_ratio() -> None:
    """Closed form: a theory stiffer by 1 % lowers measured / theory by 1 % and leaves beta; changes by
    numbers of one source add up.
    """
    response = measured(1.12, np.inf)
    fits = {fit.curve.outputs[0]: fit for fit in identify(response, PEAKS)}
    ends = (("K_n", (1.01 * K, SHAFT), (K / 1.01, SHAFT)), ("none", (K, SHAFT), (K, SHAFT)))
    to_sources = match(fits["z"], response, PEAKS, replace(THEORY, ends=ends), RIGID).to_sources
    np.testing.assert_allclose(to_sources["K_n"], [-np.log(1.01), 0.0], atol=1e-6)
    np.testing.assert_allclose(to_sources["none"], 0.0, atol=1e-9)
    twice = replace(THEORY, ends=(*ends, ends[0]))
    np.testing.assert_allclose(
        match(fits["z"], response, PEAKS, twice, RIGID).to_sources["K_n"], [-2 * np.log(1.01), 0.0], atol=1e-6
    )
