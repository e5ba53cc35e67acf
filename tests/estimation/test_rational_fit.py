"""Rational fits: systems with a known number of modes, derivatives by central differences, normal equations
from the Jacobian.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.comparison import RationalFit
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import whitener
from tests.estimation.noisy import measured


def test_slopes_of_the_rational_fit_are_central_differences(three_dof_response, rng) -> None:
    data = measured(three_dof_response(0.05, rng))
    fit = RationalFit(data, whitener(data), 3)
    start = fit.start()
    jacobian = fit.jacobian(start)
    for number in range(fit.n_parameter):
        step = 1e-6 * max(abs(start[number]), 1e-3) * np.eye(fit.n_parameter)[number]
        difference = (fit.residual(start + step) - fit.residual(start - step)) / (2 * step[number])
        np.testing.assert_allclose(
            jacobian[:, number], difference, rtol=1e-4, atol=1e-5 * np.max(np.abs(difference))
        )


def test_normal_equations_are_those_of_the_jacobian(three_dof_response, rng) -> None:
    data = measured(three_dof_response(0.05, rng))
    fit = RationalFit(data, whitener(data), 3)
    jacobian, residual = fit.jacobian(fit.start()), fit.residual(fit.start())
    linear = fit.linearise(fit.start())
    lengths = np.linalg.norm(jacobian, axis=0)
    np.testing.assert_allclose(linear.scale, lengths, rtol=1e-10)
    unit = jacobian / lengths
    np.testing.assert_allclose(linear.triangle.T @ linear.triangle, unit.T @ unit, atol=1e-10)
    gradient, expected = linear.triangle.T @ linear.projected, unit.T @ residual
    np.testing.assert_allclose(gradient, expected, atol=1e-9 * np.linalg.norm(residual))
    assert linear.chi2 == pytest.approx(residual @ residual)


def test_models_without_a_minimum_are_named(symmetric_response, rng, monkeypatch) -> None:
    monkeypatch.setattr(RationalFit, "lowest_chi2", lambda _: None)
    response = symmetric_response(1e-8, rng)
    (fit,) = identify(response, FitSettings("rotor-2dof-direct", mass=0.92, compare=True))
    (note,) = (note for note in fit.notes if "left out" in note)
    assert "2 modes, any structure" in note and not any(
        "any structure" in candidate.name for candidate in fit.candidates
    )


def test_three_dofs_have_three_modes(three_dof_response) -> None:
    aic: dict[int, list[float]] = {2: [], 3: [], 4: []}
    for seed in range(8):
        data = measured(three_dof_response(0.05, np.random.default_rng(seed)))
        for modes, values in aic.items():
            fit = RationalFit(data, whitener(data), modes)
            chi2 = fit.lowest_chi2() or np.inf
            values.append(chi2 + 2 * fit.n_parameter)
            if modes == 3:
                # 2 n of the denominator, 2 n - 1 of each of nine numerators; chi-square within four of its
                # standard deviations.
                assert fit.n_parameter == 6 + 9 * 5
                assert abs(chi2 - 399) < 4 * np.sqrt(2 * 399)
    assert all(three < two for two, three in zip(aic[2], aic[3], strict=True))
    assert np.mean(aic[3]) < np.mean(aic[4])


def test_one_resonance_is_one_mode(sdof_response) -> None:
    (fit,) = identify(sdof_response(1e-7, np.random.default_rng(3)), FitSettings("sdof", compare=True))
    by_name = {candidate.name: candidate for candidate in fit.candidates}
    # k, c, m and the rational fit of one mode are one and the same family.
    assert by_name["1 mode, any structure"].chi2 == pytest.approx(
        by_name["this model: sdof, mass estimated"].chi2, rel=1e-6
    )
    assert "other-model" not in [finding.code for finding in fit.findings]


def test_a_second_mode_is_seen_in_one_frf(three_dof_response) -> None:
    whole = three_dof_response(1e-3, np.random.default_rng(4))
    ports = {"outputs": whole.outputs[:1], "inputs": whole.inputs[:1]}
    one = replace(whole, matrix=whole.matrix[:, :1, :1], covariance=whole.covariance[:, :1, :1], **ports)
    (fit,) = identify(one, FitSettings("sdof", compare=True, band=(0.05, 0.2)))
    assert fit.candidates[0].name == "2 modes, any structure"
    assert "other-model" in [finding.code for finding in fit.findings]
