"""Weighted output error of a model: residual, its Jacobian, and normal equations from small matrices line by
line.

An element (a, b) of a matrix K, C or M changes the response by an outer product: column a of Z^-1 times row b
of the response. The sum over the lines of products of two such derivatives is one product of (columns by
columns) and (rows by rows), for FRFs with independent noise, and for a covariance that is one matrix over the
responses times one over the forces, as of H1. The derivatives of all parameters on all lines are never made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations_with_replacement
from typing import Any, Generic, TypeVar

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.estimation.damping import FactorModel
from labpipe.estimation.descent import Linearisation, SquareSum, linearise_problem, triangle_of_products
from labpipe.estimation.leakage import expected_model
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import CACHED_ELEMENTS, ActingTerms, DynamicModel, ReceptanceModel, compliance
from labpipe.estimation.weights import (
    ProductWeights,
    Weights,
    fit_weights,
    is_short,
    short_weights,
    whiten_values,
    whitened_columns,
)

# By what a matrix of each kind stands in Z(w): factor and power of w.
FACTORS = {"stiffness": (1.0, 0), "damping": (1j, 1), "mass": (-1.0, 2)}

# From some lines to Z^-1 (n_line, n_dof, n_dof), the response (n_line, n_dof, n_input) and the residual, same
# shape.
LinesOf = Callable[[slice], tuple[ComplexArray, ComplexArray, ComplexArray]]


@dataclass(frozen=True)
class NormalEquations:
    """J^T J as *products* (n, n) and J^T r as *projected* (n,) [1 per parameter unit each], r^T r as *square*
    [1].
    """

    products: FloatArray
    projected: FloatArray
    square: float


def has_line_products(model: object, weights: Weights) -> bool:
    """Whether a model and *weights* (n_line, n, n) [N/m] have them: linear in K, C, M, short weights."""
    return isinstance(model, DynamicModel) and is_short(weights) and model.acting["force"] is None


def normal_equations(
    model: DynamicModel, omega: FloatArray, weights: Weights, lines_of: LinesOf, with_products: bool = True
) -> NormalEquations:
    """Of the columns Z^-1 Z_p H and the residual of *lines_of*, whitened by *weights*, diagonals (n_line, n)
    [N/m] or factors, at *omega* (n_line,) [rad/s]; J^T J only *with_products*. Equation (est-line-products).
    """
    n_dof = model.constant.force.shape[0]
    kinds = [kind for kind in FACTORS if model.acting[kind] is not None]
    exponents = np.array([FACTORS[kind][1] for kind in kinds])
    powers = sorted({int(first + second) for first, second in combinations_with_replacement(exponents, 2)})
    sums: dict[int, ComplexArray] = {
        power: np.zeros((n_dof * (n_dof + 1) // 2, n_dof**2), np.complex128) for power in powers
    }
    sides = np.zeros((len(kinds), n_dof**2), np.complex128)
    square = 0.0
    n_chunk = max(16, CACHED_ELEMENTS // n_dof**3)
    for start in range(0, omega.size, n_chunk):
        lines = slice(start, start + n_chunk)
        inverse, response, residual = lines_of(lines)
        if isinstance(weights, ProductWeights):
            here = weights.at(lines)
            inverse, response = here.outputs @ inverse, response @ here.inputs.swapaxes(1, 2)
            residual = here.whiten(residual)
            power = np.full(residual.shape, 2.0)
        else:
            power = 2 * np.abs(weights[lines].reshape(residual.shape)) ** 2
        weighted = power * residual
        square += float(np.sum((weighted * residual.conj()).real))
        side = inverse.conj().swapaxes(1, 2) @ weighted @ response.conj().swapaxes(1, 2)
        sides += omega[lines] ** exponents[:, None] @ side.reshape(-1, n_dof**2)
        if with_products and isinstance(weights, ProductWeights):
            _add_separable_products(inverse, response, omega[lines], sums)
        elif with_products:
            _add_products(inverse, response, power, omega[lines], sums)
    products = _gather(model, kinds, sums) if with_products else np.zeros((len(model.terms),) * 2)
    return NormalEquations(products, _project(model, dict(zip(kinds, sides, strict=True))), square)


def _add_products(
    inverse: ComplexArray,
    response: ComplexArray,
    power: FloatArray,
    omega: FloatArray,
    sums: dict[int, ComplexArray],
) -> None:
    """Add sum_li w^p conj(G_ia) G_ic sum_j power_ij conj(H_bj) H_dj, in the order (a <= c, bd), for the
    powers p of *sums*.
    """
    n_line, n_dof = inverse.shape[:2]
    first, second = _upper(n_dof)
    columns = (inverse[:, :, first].conj() * inverse[:, :, second]).reshape(-1, first.size)
    by_input = np.ascontiguousarray(response.swapaxes(1, 2))
    outer = (by_input.conj()[:, :, :, None] * by_input[:, :, None, :]).reshape(n_line, -1, n_dof**2)
    rows = (power @ outer.view(np.float64)).view(np.complex128)
    for exponent, total in sums.items():
        scaled = rows * (omega**exponent)[:, None, None] if exponent else rows
        total += columns.T @ scaled.reshape(-1, n_dof**2)


def _add_separable_products(
    inverse: ComplexArray, response: ComplexArray, omega: FloatArray, sums: dict[int, ComplexArray]
) -> None:
    """Add 2 sum_l w^p (sum_i conj(G_ia) G_ic) (sum_j conj(H_bj) H_dj), both whitened, in the order (a <= c,
    bd), for powers p as above.
    """
    n_line, n_dof = inverse.shape[0], inverse.shape[2]
    first, second = _upper(n_dof)
    columns = 2 * (inverse.conj().swapaxes(1, 2) @ inverse)[:, first, second].T
    rows = (response.conj() @ response.swapaxes(1, 2)).reshape(n_line, n_dof**2)
    for exponent, total in sums.items():
        total += (columns * omega**exponent) @ rows


def _gather(model: DynamicModel, kinds: list[str], sums: dict[int, ComplexArray]) -> FloatArray:
    products = np.zeros((len(model.terms),) * 2)
    whole = dict(zip(sums, _whole(np.array(list(sums.values())), model.constant.force.shape[0]), strict=True))
    for first, other in combinations_with_replacement(kinds, 2):
        (factor, exponent), (other_factor, other_exponent) = FACTORS[first], FACTORS[other]
        elements = np.conj(factor) * other_factor * whole[exponent + other_exponent]
        acting, other_acting = model.acting[first], model.acting[other]
        assert acting is not None and other_acting is not None
        # Re of conj(matrices)^T elements matrices: those of a loss factor are imaginary.
        combined = acting.combine(other_acting.combine(elements).T.conj()).T.real
        products[_block(acting, other_acting)] += combined
        if first != other:
            products[_block(other_acting, acting)] += combined.T
    return products


def _block(rows: ActingTerms, columns: ActingTerms) -> tuple[IntArray | slice, IntArray | slice]:
    if isinstance(rows.place, slice) or isinstance(columns.place, slice):
        return rows.place, columns.place
    return rows.place[:, None], columns.place


@lru_cache(maxsize=64)
def _upper(n_dof: int) -> tuple[IntArray, IntArray]:
    return np.triu_indices(n_dof)


def _whole(totals: ComplexArray, n_dof: int) -> ComplexArray:
    """Sums (n_sum, n_pair, n_dof^2) in the order (a <= c, bd) as matrices (ab, cd), (n_sum, n_dof^2,
    n_dof^2); those of (c, a) are the conjugates, b and d exchanged.
    """
    first, second = _upper(n_dof)
    part = totals.reshape(len(totals), -1, n_dof, n_dof)
    whole = np.empty((len(totals), *(n_dof,) * 4), np.complex128)
    whole[:, second, first] = part.conj().swapaxes(2, 3)
    whole[:, first, second] = part
    return whole.transpose(0, 1, 3, 2, 4).reshape(-1, n_dof**2, n_dof**2)


def _project(model: DynamicModel, sides: dict[str, ComplexArray]) -> FloatArray:
    projected = np.zeros(len(model.terms))
    for kind, side in sides.items():
        acting = model.acting[kind]
        assert acting is not None
        projected[acting.place] += acting.combine((np.conj(FACTORS[kind][0]) * side).conj()).real
    return projected


# Weighted output error of a model: residual, its Jacobian and its sum of squares, in real numbers.

Model = TypeVar("Model", bound=ReceptanceModel, covariant=True)


@dataclass(frozen=True)
class OutputError(SquareSum, Generic[Model]):
    """Measured minus modelled FRF, whitened by *whitener* (n_line, n, n) [N/m] in any of its forms."""

    measured: Measured
    model: Model
    whitener: Weights

    @classmethod
    def of(cls, measured: Measured, model: Any) -> OutputError[Any]:
        """Of a *model* as the data show it, weighted by their noise; FitError as of fit_weights."""
        return OutputError(measured, expected_model(measured, model), fit_weights(measured))

    @property
    def size(self) -> float:
        """Norm of the whitened measured FRF."""
        return float(np.linalg.norm(self.whiten(self.measured.matrix)))

    def whiten(self, values: ComplexArray) -> FloatArray:
        """FRFs (..., n_line, n_output, n_input) [m/N] whitened to real equations (..., n_equation) [1]."""
        return whiten_values(self.weights, values)

    @cached_property
    def weights(self) -> Weights:
        """The whitener, or its diagonals (n_line, n) [N/m] where all else is zero, or its factors."""
        return short_weights(self.whitener)

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Whitened residual (n_equation,) [1], of variance 1 for a correct model."""
        return self.whiten(self.measured.matrix - self.model.receptance(parameters, self.measured.omega))

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d residual / d p, (n_equation, n_parameter) [1 per parameter unit]."""
        columns = whitened_columns(self.weights, self.model.jacobian(parameters, self.measured.omega))
        return np.negative(columns, out=columns)

    def linearise(self, parameters: FloatArray) -> Linearisation:
        """The linearisation at *parameters* (n_parameter,) [parameter units], by line products if exact."""
        model: Any = self.model
        values, slopes = parameters, np.eye(parameters.size)
        if isinstance(model, FactorModel):
            model, values, slopes = model.expanded, model.expanded_values(values), model.slopes(values)
        if isinstance(model, DynamicModel) and has_line_products(model, self.weights):
            equations = self._normal_equations(model, values)
            factor = triangle_of_products(slopes.T @ equations.products @ slopes)
            if factor is not None:
                scale, triangle = factor
                projected = np.linalg.solve(triangle.T, (slopes.T @ equations.projected) / scale)
                return Linearisation(triangle, projected, scale, equations.square, self.measured.n_equation)
        return linearise_problem(self, parameters)

    def _normal_equations(self, model: DynamicModel, parameters: FloatArray) -> NormalEquations:
        measured, force = self.measured, model.whole(parameters).force

        def lines_of(lines: slice) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
            inverse = compliance(model, parameters, measured.omega[lines])
            response = inverse @ force
            return inverse, response, measured.matrix[lines] - response

        return normal_equations(model, measured.omega, self.weights, lines_of)
