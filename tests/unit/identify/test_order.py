"""Number of modes and of independent motions: systems whose number is known, singular values of noise from their own limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.identify.fitting import identify
from labpipe.identify.measured import Measured
from labpipe.identify.order import RationalFit, independent_motions, modal_chi2, motion_notes
from labpipe.identify.settings import FitSettings
from labpipe.identify.weights import whitener
from labpipe.records.response import FrequencyResponse


def measured(response: FrequencyResponse) -> Measured:
    return Measured(
        omega=2 * np.pi * response.frequency,
        matrix=response.matrix,
        covariance=response.covariance,
        noise_dof=np.inf,
        noise_lines=1.0,
        outputs=response.outputs,
        inputs=response.inputs,
    )


def test_slopes_of_the_rational_fit_are_central_differences(three_dof_response, rng) -> None:
    data = measured(three_dof_response(0.05, rng))
    fit = RationalFit(data, whitener(data), 3)
    start = fit.start()
    jacobian = fit.jacobian(start)
    for number in range(fit.n_parameter):
        step = 1e-6 * max(abs(start[number]), 1e-3) * np.eye(fit.n_parameter)[number]
        difference = (fit.residual(start + step) - fit.residual(start - step)) / (2 * step[number])
        np.testing.assert_allclose(jacobian[:, number], difference, rtol=1e-4, atol=1e-5 * np.max(np.abs(difference)))


def test_three_dofs_have_three_modes(three_dof_response) -> None:
    aic: dict[int, list[float]] = {2: [], 3: [], 4: []}
    for seed in range(8):
        data = measured(three_dof_response(0.05, np.random.default_rng(seed)))
        for modes, values in aic.items():
            chi2, n_parameter = modal_chi2(data, whitener(data), modes) or (np.inf, 0)
            values.append(chi2 + 2 * n_parameter)
            if modes == 3:
                # 2 n of the denominator, 2 n - 1 of each of nine numerators; chi-square within four of its standard deviations.
                assert n_parameter == 6 + 9 * 5
                assert abs(chi2 - 399) < 4 * np.sqrt(2 * 399)
    assert all(three < two for two, three in zip(aic[2], aic[3], strict=True))
    assert np.mean(aic[3]) < np.mean(aic[4])


def test_one_resonance_is_one_mode(sdof_response) -> None:
    (fit,) = identify(sdof_response(1e-7, np.random.default_rng(3)), FitSettings("sdof", compare=True))
    by_name = {candidate.name: candidate for candidate in fit.candidates}
    # k, c, m and the rational fit of one mode are one and the same family.
    assert by_name["1 mode, any structure"].chi2 == pytest.approx(by_name["this model: sdof, mass estimated"].chi2, rel=1e-6)
    assert "other-model" not in [finding.code for finding in fit.findings]


def test_a_second_mode_is_seen_in_one_frf(three_dof_response) -> None:
    whole = three_dof_response(1e-3, np.random.default_rng(4))
    ports = {"outputs": whole.outputs[:1], "inputs": whole.inputs[:1]}
    one = replace(whole, matrix=whole.matrix[:, :1, :1], covariance=whole.covariance[:, :1, :1], **ports)
    (fit,) = identify(one, FitSettings("sdof", compare=True, band=(0.05, 0.2)))
    assert fit.candidates[0].name == "2 modes, any structure"
    assert "other-model" in [finding.code for finding in fit.findings]


def test_two_responses_that_move_alike_are_one_motion(symmetric_response, coupled_response, rng) -> None:
    alike = measured(symmetric_response(1e-8, rng))
    values, count = independent_motions(alike)
    assert count == 1 and values[0] > 100 * values[1]
    assert "one independent motion" in motion_notes(alike)[0]
    assert motion_notes(measured(coupled_response(1e-8, rng))) == ()
    assert motion_notes(measured(symmetric_response())) == ()


def test_noise_alone_is_no_motion(symmetric_response, rng) -> None:
    response = symmetric_response(1e-8, rng)
    noise = 1e-8 * (rng.normal(size=response.matrix.shape) + 1j * rng.normal(size=response.matrix.shape)) / np.sqrt(2)
    values, count = independent_motions(measured(replace(response, matrix=noise)))
    # Largest singular value of 250 x 2 circular noise: sqrt(250) + sqrt(2) = 17.2.
    assert count == 0 and values[0] == pytest.approx(np.sqrt(250), rel=0.15)
