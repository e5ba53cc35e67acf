"""iv: against a literal twin line by line, its standard errors against the scatter, its break-down against
what it says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from tests.estimation.literal import literal_iv, literal_ls

KNOWN = FitSettings("mdof", mass=(1.0, 2.0, 3.0), symmetric=True, name="three")
# Standard deviation of the complex noise for 1 % of max |H| = 9.430 m/N (its closed form on the 25 lines) on
# either part.
PER_CENT = 0.0943 * np.sqrt(2)


def coefficients(response, settings: FitSettings) -> np.ndarray:  # type: ignore[no-untyped-def]
    (fit,) = identify(response, settings)
    return np.array([parameter.value for parameter in fit.parameters if not parameter.derived])


@pytest.mark.parametrize("seed", range(2))
def test_ls_and_iv_equal_their_literal_twins(three_dof_response, seed: int) -> None:
    response = three_dof_response(3 * PER_CENT, np.random.default_rng(seed))
    omega, mass = 2 * np.pi * response.frequency, np.diag([1.0, 2.0, 3.0])
    k, c = literal_ls(response.matrix, omega, mass)
    upper = np.triu_indices(3)
    np.testing.assert_allclose(
        coefficients(response, replace(KNOWN, estimator="ls")), [*k[upper], *c[upper]], rtol=1e-9, atol=1e-11
    )
    k, c = literal_iv(response.matrix, omega, mass)
    # The product stops by the coefficients in units of their columns, the twin by their plain sizes: 1e-4
    # apart at most.
    np.testing.assert_allclose(
        coefficients(response, replace(KNOWN, estimator="iv")), [*k[upper], *c[upper]], atol=5e-4
    )


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_sandwich_errors_are_the_scatter(three_dof_response, known: bool) -> None:
    fits = []
    for seed in range(40):
        response = three_dof_response(2 * PER_CENT, np.random.default_rng(seed))
        drawn = response if known else replace(response, covariance=None)
        fits += identify(drawn, replace(KNOWN, estimator="iv"), judging=False)
    ratios = []
    for name in ("k_1_1", "k_1_2", "k_3_3", "c_1_1", "c_2_2", "c_2_3"):
        values = [fit.parameter(name).value for fit in fits]
        ratios.append(
            np.sqrt(np.mean([fit.parameter(name).std_error ** 2 for fit in fits])) / np.std(values, ddof=1)
        )
    # Six standard deviations of 40 values are known to 11.2 % each, their mean to less.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


def test_ls_of_the_same_data_is_overconfident(three_dof_response) -> None:
    """Its bias stands outside its standard errors.

    The finding says so, and the intervals include the distance from ml.
    """
    response = three_dof_response(3 * PER_CENT, np.random.default_rng(1))
    (fit,), (right,) = (
        identify(response, replace(KNOWN, estimator="ls")),
        identify(response, replace(KNOWN, estimator="ml")),
    )
    k = fit.parameter("k_3_3")
    assert abs(k.value - 2.0) > 4 * k.std_error
    assert fit.gof.chi2_reduced > 2
    assert any(
        finding.code == "model-mismatch" and "ls is biased" in finding.message for finding in fit.findings
    )
    assert k.std_error_inflated == pytest.approx(
        np.hypot(k.std_error, k.value - right.parameter("k_3_3").value), rel=1e-6
    )
    assert k.ci95[0] < 2.0 < k.ci95[1]
    assert any("bias" in note for note in fit.notes)


@pytest.mark.long
def test_break_downs_are_no_result(three_dof_response) -> None:
    """At 6 % noise iv runs away in more than a third of the runs; ml never does."""
    broken = 0
    for seed in range(12):
        response = three_dof_response(6 * PER_CENT, np.random.default_rng(seed))
        (by_iv,), (by_ml,) = (identify(response, replace(KNOWN, estimator=name)) for name in ("iv", "ml"))
        assert by_ml.converged and by_ml.gof.chi2_p > 1e-4
        far = max(abs(by_iv.parameter(f"k_{n}_{n}").value - 2.0) for n in (1, 2, 3)) > 3.0
        if not by_iv.converged:
            broken += 1
            assert "no-convergence" in [finding.code for finding in by_iv.findings]
            assert all(
                parameter.std_error is None and parameter.significant is None
                for parameter in by_iv.parameters
            )
            assert any("broke down" in note for note in by_iv.notes)
        else:
            assert not far
    assert broken >= 4


@pytest.mark.parametrize("estimator", ["ls", "iv"])
def test_lines_may_weigh_by_their_noise(sdof_response, estimator: str) -> None:
    """Half of the lines ten times noisier: weighing by noise is nearer to the truth."""
    std = np.where(np.arange(21) % 2, 1e-6, 1e-7)

    def squares(weight: str) -> float:
        errors = []
        for seed in range(15):
            rng = np.random.default_rng(seed)
            plain = sdof_response()
            noise = std * (rng.normal(size=21) + 1j * rng.normal(size=21)) / np.sqrt(2)
            response = replace(
                plain, matrix=plain.matrix + noise[:, None, None], covariance=(std**2)[:, None, None] + 0j
            )
            (fit,) = identify(response, FitSettings("sdof", mass=0.79, estimator=estimator, weight=weight))
            errors.append((fit.parameter("k").value - 134.5e3) ** 2)
        return float(np.mean(errors))

    assert squares("noise") < 0.3 * squares("none")
