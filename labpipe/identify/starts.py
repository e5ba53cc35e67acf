"""Start values of an output-error fit: estimates without start values of their own, the best one first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.identify.model import ResponseModel
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import least_squares, solve_scaled

REWEIGHTINGS = 12
# Share of the lowest chi-square that a useful pass must fall below.
WORTHWHILE = 0.99


@dataclass(frozen=True, eq=False)
class Start:
    """Start values (n_parameter,) [parameter units], the name of their method, and their chi-square."""

    name: str
    values: FloatArray
    chi2: float


def starts(problem: OutputError[ResponseModel]) -> list[Start]:
    """The start of the lowest chi-square, then others: the last pass, plain least squares, the first pass.

    Plain least squares is biased by noise; reweighting the equation error by Z^-1 of the last iterate (Sanathanan and Koerner 1963)
    makes it nearly an output error and needs no good start. It ends after two successive passes with hardly lower chi-square.
    """
    linear, model = problem.model.linear, problem.model
    values = least_squares(problem.measured, linear).values
    attempts = [_start(problem, "least squares", model.from_linear(values))]
    idle = 0
    for number in range(1, REWEIGHTINGS + 1):
        try:
            values = _reweighted(problem, values)
        except (FitError, np.linalg.LinAlgError):
            break
        lowest = min(start.chi2 for start in attempts)
        attempts.append(_start(problem, f"reweighted least squares (pass {number})", model.from_linear(values)))
        idle = 0 if attempts[-1].chi2 < WORTHWHILE * lowest else idle + 1
        if idle == 2:
            break
    best = min(attempts, key=lambda start: start.chi2)
    return list(dict.fromkeys([best, attempts[-1], attempts[0], attempts[min(1, len(attempts) - 1)]]))


def _start(problem: OutputError[ResponseModel], name: str, values: FloatArray) -> Start:
    return Start(name, values, problem.chi2(values))


def _reweighted(problem: OutputError[ResponseModel], last: FloatArray) -> FloatArray:
    """Least squares of the whitened equation error times Z_last^-1."""
    measured, linear = problem.measured, problem.model.linear
    terms = linear.filtered(last, linear.equation_terms(measured.matrix, measured.omega), measured.omega)
    right_side = linear.filtered(last, linear.equation_constant(measured.matrix, measured.omega)[None], measured.omega)[0]
    return solve_scaled(problem.whitened(terms).T, problem.whitened(right_side))[0]
