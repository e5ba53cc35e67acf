"""What a plan takes of the uncertainties of an earlier fit."""

from __future__ import annotations

import numpy as np

from labpipe.methods.planning.excitation import earlier_uncertainties
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.records.uncertain import Budget, Uncertainty


def fit(budget: Budget | None) -> Fit:
    parameters = (
        Parameter("k", 1000.0, "N/m", std_error=10.0, std_error_inflated=12.0),
        Parameter("c", 2.0, "N.s/m", std_error=0.1),
        Parameter("f_n", 5.0, "Hz", std_error=0.1, derived=True),
    )
    return Fit(
        name="fit",
        model="sdof",
        estimator="ml",
        band_hz=(1.0, 9.0),
        lines=20,
        equations=40,
        dof=38,
        gof=Goodness(1.0, 1.0, None, None),
        parameters=parameters,
        condition_number=1.0,
        correlation=np.array([[1.0, 0.5], [0.5, 1.0]]),
        budget=budget,
    )


def test_without_a_budget_the_stated_errors_are_noise() -> None:
    # 12 and 0.1, correlated by 0.5.
    np.testing.assert_allclose(earlier_uncertainties(fit(None)).covariance(), [[144.0, 0.6], [0.6, 0.01]])


def test_noise_and_sources_of_a_budget() -> None:
    # Noise 8 and 0.1 by the budget; the probe changes k by 6, c by -0.02: their product is the covariance
    # that it makes.
    budget = Budget(
        ("k", "c", "f_n"),
        np.array([8.0, 0.1, 0.1]),
        38.0,
        (Uncertainty("probe", 0.01, "1"),),
        np.array([[6.0, -0.02, 0.0]]),
    )
    found = earlier_uncertainties(fit(budget))
    np.testing.assert_allclose(found.covariance(), [[100.0, 0.4 - 0.12], [0.28, 0.0104]])
    np.testing.assert_allclose(found.covariance(["probe"]), [[64.0, 0.4], [0.4, 0.01]])


def test_a_typed_coefficient_has_no_uncertainty() -> None:
    found = earlier_uncertainties(fit(None), {"k": 1.0})
    assert found.names == ("c",)
    np.testing.assert_allclose(found.covariance(), [[0.01]])
