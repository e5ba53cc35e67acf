"""Where an output-error fit begins: estimates that need no start of their own, the best one first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import least_squares, solve_scaled

REWEIGHTINGS = 12
# A pass that leaves more than this share of the lowest chi-square was idle.
WORTHWHILE = 0.99


@dataclass(frozen=True, eq=False)
class Start:
    """Parameters to start from, and how they were found."""

    name: str
    values: FloatArray
    chi2: float


def starts(problem: OutputError) -> list[Start]:
    """The start of the lowest chi-square, then others that lie elsewhere: the last pass, plain least squares, the first pass.

    Plain least squares is biased by noise; reweighting the equation error by Z^-1 of the last iterate (Sanathanan and Koerner 1963)
    makes it nearly an output error and needs no good start itself. It ends when two passes running hardly lower chi-square.
    """
    linear, model = problem.model.linear, problem.model
    values = least_squares(problem.measured, linear).values
    found = [_start(problem, "least squares", model.from_linear(values))]
    idle = 0
    for number in range(1, REWEIGHTINGS + 1):
        try:
            values = _reweighted(problem, values)
        except (FitError, np.linalg.LinAlgError):
            break
        lowest = min(start.chi2 for start in found)
        found.append(_start(problem, f"reweighted least squares (pass {number})", model.from_linear(values)))
        idle = 0 if found[-1].chi2 < WORTHWHILE * lowest else idle + 1
        if idle == 2:
            break
    best = min(found, key=lambda start: start.chi2)
    return list(dict.fromkeys([best, found[-1], found[0], found[min(1, len(found) - 1)]]))


def _start(problem: OutputError, name: str, values: FloatArray) -> Start:
    return Start(name, values, problem.chi2(values))


def _reweighted(problem: OutputError, last: FloatArray) -> FloatArray:
    """Least squares of Z_last^-1 times the equation error, whitened."""
    measured, linear = problem.measured, problem.model.linear
    terms = linear.filtered(last, linear.equation_terms(measured.matrix, measured.omega), measured.omega)
    known = linear.filtered(last, linear.equation_known(measured.matrix, measured.omega)[None], measured.omega)[0]
    return solve_scaled(problem.whitened(terms).T, problem.whitened(known))[0]
