"""Reported parameters of an estimate, with standard errors where they exist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.identify.corrections import Estimated, corrected
from labpipe.identify.derived import derived_parameters
from labpipe.identify.model import DynamicModel
from labpipe.identify.proportional import ProportionalModel
from labpipe.identify.setup import Setup
from labpipe.identify.statistics import Estimate, estimated, inflation_factors
from labpipe.records.identification import Parameter


def reported_parameters(
    estimate: Estimate, model: DynamicModel | ProportionalModel, setup: Setup, mismatch: float | None
) -> tuple[Parameter, ...]:
    """Estimated and derived parameters. *mismatch*: factor on the standard errors where the residual exceeds the noise, else None.

    Without convergence the values of the last step, without standard errors.
    """
    total = Estimated(model.names, model.units, estimate.values, estimate.covariance)
    dof = int(estimate.student_dof.min())
    parameters = [*_coefficients(estimate, corrected(total, setup.settings), model), *derived_parameters(total, model, setup, dof)]
    if not estimate.converged:
        return tuple(_without_std_error(parameter) for parameter in parameters)
    return tuple(parameters) if mismatch is None else tuple(_inflated(parameter, mismatch) for parameter in parameters)


def _coefficients(estimate: Estimate, reported: Estimated, model: DynamicModel | ProportionalModel) -> list[Parameter]:
    """The estimated parameters, followed by those tied to them."""
    vifs = inflation_factors(estimate.scaled_design)
    coefficients = [
        estimated(name, unit, reported.value(name), reported.std_error(name), int(dof), float(vif))
        for name, unit, vif, dof in zip(reported.names, reported.units, vifs, estimate.student_dof, strict=True)
    ]
    # alpha and beta of proportional damping come after the terms.
    pairs = zip(coefficients, model.terms, strict=False)
    return coefficients + [replace(parameter, name=alias, derived=True) for parameter, term in pairs for alias in term.aliases]


def _without_std_error(parameter: Parameter) -> Parameter:
    return replace(parameter, std_error=None, t_ratio=None, ci95=None, significant=None)


def _inflated(parameter: Parameter, factor: float) -> Parameter:
    error = parameter.std_error
    return replace(parameter, std_error_inflated=None if error is None else factor * error)


def mismatch_factor(estimate: Estimate, p_limit: float) -> float | None:
    """sqrt(chi-square per degree of freedom) where it is significantly above 1, else None."""
    reduced, p_value = estimate.gof.chi2_reduced, estimate.gof.chi2_p
    return float(np.sqrt(reduced)) if reduced is not None and p_value is not None and p_value < p_limit else None
