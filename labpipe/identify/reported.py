"""Reported parameters of an estimate, with standard errors where they exist."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import coverage_factor
from labpipe.identify.corrections import Estimated, corrected
from labpipe.identify.derived import BandModel, derived_parameters
from labpipe.identify.setup import Setup
from labpipe.identify.statistics import Estimate, estimated, inflation_factors, widened
from labpipe.records.budget import Budget
from labpipe.records.identification import Parameter

# Probability of the intervals of parameters.
INTERVAL = 0.95
# Sides of an interval that differ by less than this share are alike.
EVEN = 1e-3


def reported_parameters(estimate: Estimate, model: BandModel, setup: Setup) -> tuple[Parameter, ...]:
    """Estimated and derived parameters with the doubt that noise leaves them.

    Without convergence the values of the last step, without standard errors.
    """
    total = Estimated(model.names, model.units, estimate.values, estimate.covariance)
    dof = int(estimate.student_dof.min())
    parameters = (*_coefficients(estimate, corrected(total, setup.settings), model), *derived_parameters(total, model, setup, dof))
    return parameters if estimate.converged else without_intervals(parameters)


def _coefficients(estimate: Estimate, reported: Estimated, model: BandModel) -> list[Parameter]:
    """The estimated parameters, followed by those tied to them."""
    vifs = inflation_factors(estimate.scaled_design)
    coefficients = [
        estimated(name, unit, reported.value(name), reported.std_error(name), int(dof), float(vif))
        for name, unit, vif, dof in zip(reported.names, reported.units, vifs, estimate.student_dof, strict=True)
    ]
    # alpha and beta of proportional damping come after the terms.
    pairs = zip(coefficients, model.terms, strict=False)
    return coefficients + [replace(parameter, name=alias, derived=True) for parameter, term in pairs for alias in term.aliases]


def without_intervals(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """The values alone."""
    return tuple(replace(parameter, std_error=None, t_ratio=None, ci95=None, significant=None) for parameter in parameters)


def widened_parameters(parameters: Sequence[Parameter], plain: Sequence[Parameter], wide: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Intervals and significance as much wider as the standard errors of *wide* are than those of *plain*, all in the same order.

    None becomes narrower: where errors of two parameters compensate, that of a derived one could.
    """
    factors = [(after.std_error or 0.0) / (before.std_error or np.inf) for before, after in zip(plain, wide, strict=True)]
    return tuple(
        widened(parameter, max(factor, 1.0)) if factor > 0 else parameter for parameter, factor in zip(parameters, factors, strict=True)
    )


def with_systematic(parameters: Sequence[Parameter], budget: Budget, dof: FloatArray | None = None) -> tuple[Parameter, ...]:
    """The parameters with combined standard uncertainties and expanded intervals, by Student's t with the effective degrees of freedom.

    An interval that is lopsided by itself is widened on each side by the square sum of that side and the systematic part's.
    dof (n_parameter,) [1]: effective ones, by default those of the budget. Equation (unc-interval).
    """
    return tuple(
        _expanded(parameter, float(systematic), float(of_parameter))
        for parameter, systematic, of_parameter in zip(parameters, budget.systematic, budget.dof if dof is None else dof, strict=True)
    )


def _expanded(parameter: Parameter, systematic: float, dof: float) -> Parameter:
    noise = parameter.full_error
    if noise is None or systematic == 0:
        return parameter
    combined = math.hypot(noise, systematic)
    reach = combined * coverage_factor(INTERVAL, dof)
    value, interval = parameter.value, parameter.ci95
    if interval is not None:
        sides = value - interval[0], interval[1] - value
        even = math.isclose(*sides, rel_tol=EVEN)
        low, high = (reach, reach) if even else (math.hypot(side, reach * systematic / combined) for side in sides)
        interval = value - low, value + high
    return replace(
        parameter,
        std_error_inflated=combined,
        systematic=systematic,
        ci95=interval,
        t_ratio=None if parameter.t_ratio is None else value / combined,
        significant=None if parameter.significant is None or interval is None else not interval[0] <= 0 <= interval[1],
    )
