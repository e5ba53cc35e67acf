"""The uncertainty budget of a floating-bearing fit: what noise and every given number leave of its
parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.estimation import statistics
from labpipe.estimation.derived import without_intervals
from labpipe.methods.floating_bearing.values import Valued
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import GivenUncertainty
from labpipe.records.identification import Goodness
from labpipe.records.uncertain import Budget, Uncertainty

# Share of a variance below which an independent error is not listed by itself and stays with the noise.
UNSEEN = 1e-3


def budgeted(
    valued: Sequence[Valued], uncertainties: Sequence[GivenUncertainty], dof: int
) -> tuple[tuple[Parameter, ...], Budget | None]:
    """The parameters with their systematic part, which may be zero, and the budget; none without
    uncertainties.
    """
    parameters = tuple(quantity.parameter for quantity in valued)
    slopes = np.stack([quantity.slopes for quantity in valued])
    whole = np.array([parameter.full_error or np.nan for parameter in parameters])
    sources, changes = [], []
    for uncertainty in uncertainties:
        for number, row in enumerate(uncertainty.changes, start=1):
            change = slopes @ row
            if len(uncertainty.changes) == 1 or np.nanmax(change**2 / whole**2) > UNSEEN:
                part = f" ({number})" if len(uncertainty.changes) > 1 else ""
                sources.append(
                    Uncertainty(uncertainty.source + part, uncertainty.std_error, uncertainty.unit)
                )
                changes.append(change)
    if not sources:
        return parameters, None
    systematic = np.sqrt(np.sum(np.square(changes), axis=0))
    random = np.sqrt(np.maximum(whole**2 - systematic**2, 0.0))
    budget = Budget(tuple(p.name for p in parameters), random, float(dof), tuple(sources), np.array(changes))
    stated = zip(parameters, systematic, strict=True)
    return tuple(
        p if p.full_error is None else replace(p, systematic=float(size)) for p, size in stated
    ), budget


def unconverged(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """The parameters of a fit that did not converge, which have no uncertainty."""
    plain = without_intervals(parameters)
    return tuple(replace(parameter, std_error_inflated=None, systematic=None) for parameter in plain)


def as_estimate(best: Any, gof: Goodness, amplification: FloatArray | None) -> statistics.Estimate:
    """A minimum of a balance as other fits state theirs; amplification (n_parameter,) [parameter units]."""
    return statistics.Estimate(
        values=best.values,
        covariance=best.covariance,
        scaled_design=best.design,
        gof=gof,
        dof=best.dof,
        converged=best.converged,
        iterations=best.steps,
        amplification=amplification,
    )
