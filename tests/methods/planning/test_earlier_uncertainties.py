"""What a plan takes of the uncertainties of an earlier fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from labpipe.artefacts.identification_file import write_identification
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError
from labpipe.methods.planning.excitation import EXCITATION, earlier_uncertainties
from labpipe.methods.planning.plan_file import PlanFile, plan_files
from labpipe.methods.planning.settings import NoiseSettings, PlanSettings
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness, Identification
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


def test_fits_of_several_bands_or_of_one_bearing_of_two_are_not_one_expectation(tmp_path: Path) -> None:
    """A sliding fit has one name for all of its bands; one that shares its load has the totals beside it."""
    first = fit(None)
    whole = Parameter("k_total", 2500.0, "N/m", std_error=20.0, derived=True)
    limits = {"band": (60.0, 72.0), "period": 2.0, "sample_rate": 2e3, "duration": 40.0, "force_limit": 1.0}
    noise = NoiseSettings(0.02, 3e-7)
    settings = PlanSettings("sdof", **limits, noise=noise, mass=0.8, earlier="earlier.json", fit="fit")
    plan = PlanFile(tmp_path / "plan.yaml", "t", EXCITATION, settings)
    for fits, message in (
        ((first, replace(first, band_hz=(9.0, 18.0))), "holds 2 fits named 'fit'"),
        ((replace(first, parameters=(*first.parameters, whole)),), "`expected` with the values of k_total"),
    ):
        write_identification(tmp_path / "earlier.json", Identification(fits, version="1"))
        with pytest.raises(ConfigError) as refused:
            plan_files(plan, cast("OutputFolder", None))
        assert message in str(refused.value)


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
