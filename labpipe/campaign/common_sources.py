"""Errors that tests have in common: the doubt of one sensor, one mass, which no repetition shows and which a ratio may not carry."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.identification import Fit
from labpipe.records.listed import random_part
from labpipe.records.parameter import Parameter


def random_error(fit: Fit, parameter: Parameter) -> float | None:
    """Standard error [unit of the parameter] without what given numbers add; None where there is none."""
    return parameter.full_error if (random := random_part(fit, parameter)) is None else random


def common_changes(fits: Sequence[Fit], change_of: Callable[[Fit, str], float]) -> FloatArray:
    """Changes (n_source, n_fit) of one quantity of every fit [unit of the quantity] by one standard uncertainty of every source.

    *change_of*: of a fit and a source. Sources of one name are one error; none gives (0, n_fit).
    """
    sources = dict.fromkeys(source.source for fit in fits if fit.budget is not None for source in fit.budget.sources)
    return np.array([[change_of(fit, source) for fit in fits] for source in sources]).reshape(len(sources), len(fits))


def parameter_changes(fits: Sequence[Fit], name: str) -> FloatArray:
    """Changes (n_source, n_fit) [unit of the parameter] of the parameter *name* of every fit."""
    return common_changes(fits, lambda fit, source: change_in(fit, source, name))


def change_in(fit: Fit, source: str, name: str) -> float:
    """Change of a parameter [its unit] by one standard uncertainty of a source; zero where the fit has no such source or parameter."""
    if fit.budget is None or name not in fit.budget.names:
        return 0.0
    return fit.budget.change_by(source, name)


def matrix_of(changes: Sequence[Mapping[str, float]]) -> FloatArray:
    """Changes (n_source, n) [unit as given] from those of every value by source; zero where a value does not have a source."""
    sources = dict.fromkeys(source for of_value in changes for source in of_value)
    return np.array([[of_value.get(source, 0.0) for of_value in changes] for source in sources]).reshape(len(sources), len(changes))


def joint_errors(errors: FloatArray, changes: FloatArray) -> FloatArray:
    """Standard errors (n,) of independent values, or the covariance (n, n) where *changes* (n_source, n) are common to them.

    V = diag(s^2) + sum over sources of c c^T [unit^2 of the values]. Equations (unc-common) and (comp-covariance).
    """
    return errors if not np.any(changes) else np.diag(errors**2) + changes.T @ changes
