"""Start values of an output-error fit: estimates without start values of their own, the best one first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.identify.line_products import NormalEquations, has_line_products, normal_equations
from labpipe.identify.model import ResponseModel, compliance
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import equation_solution, regression, solve_scaled
from labpipe.optimise.triangle import triangle_of_products

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
    model = problem.model
    values = _least_squares(problem)
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


def _least_squares(problem: OutputError[ResponseModel]) -> FloatArray:
    """Least squares of the equation of motion, all lines alike."""
    linear = problem.model.linear
    values = _by_line_products(problem, None) if has_line_products(linear, problem.weights) else None
    return equation_solution(regression(problem.measured, linear, "none"), linear)[0] if values is None else values


def _reweighted(problem: OutputError[ResponseModel], last: FloatArray) -> FloatArray:
    """Least squares of the whitened equation error times Z_last^-1."""
    measured, linear = problem.measured, problem.model.linear
    if has_line_products(linear, problem.weights):
        values = _by_line_products(problem, last)
        if values is not None:
            return values
    terms = linear.filtered(last, linear.equation_terms(measured.matrix, measured.omega), measured.omega)
    right_side = linear.filtered(last, linear.equation_constant(measured.matrix, measured.omega)[None], measured.omega)[0]
    return solve_scaled(problem.whitened(terms).T, problem.whitened(right_side))[0]


def _by_line_products(problem: OutputError[ResponseModel], last: FloatArray | None) -> FloatArray | None:
    """The same from products line by line, without weights and Z_last^-1 where there is no *last*; None where they are too inexact."""
    measured, linear = problem.measured, problem.model.linear
    weights = np.ones((measured.omega.size, measured.matrix[0].size), np.complex128) if last is None else problem.weights

    def equations_at(values: FloatArray, products: bool) -> NormalEquations:
        def lines_of(lines: slice) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
            omega, response = measured.omega[lines], measured.matrix[lines]
            none = np.broadcast_to(np.eye(response.shape[1], dtype=np.complex128), (omega.size, *(response.shape[1:2] * 2)))
            inverse = none if last is None else compliance(linear, last, omega)
            return inverse, response, inverse @ (linear.whole(values).force - linear.dynamic_stiffness(values, omega) @ response)

        return normal_equations(linear, measured.omega, weights, lines_of, products)

    values = np.zeros(len(linear.terms))
    equations = equations_at(values, True)
    factor = triangle_of_products(equations.products)
    if factor is None:
        return None
    scale, triangle = factor
    for projected in (equations.projected, None):
        # The second round is the one refinement of the seminormal equations.
        side = equations_at(values, False).projected if projected is None else projected
        values = values + np.linalg.solve(triangle, np.linalg.solve(triangle.T, side / scale)) / scale
    return values
