"""Weighted output error of a model: residual, its Jacobian and its sum of squares, in real numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Generic, TypeVar

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.line_products import NormalEquations, has_line_products, normal_equations
from labpipe.identify.measured import Measured
from labpipe.identify.model import CACHED_ELEMENTS, DynamicModel, ReceptanceModel, compliance
from labpipe.identify.product_weights import ProductWeights
from labpipe.identify.proportional import ProportionalModel
from labpipe.identify.weights import Weights, is_short, short_weights, weights_at, whitened, whitened_columns
from labpipe.optimise.levenberg import Linearisation, linearised, sum_of_squares
from labpipe.optimise.triangle import triangle_of_products

Model = TypeVar("Model", bound=ReceptanceModel, covariant=True)


@dataclass(frozen=True)
class OutputError(Generic[Model]):
    """Measured minus modelled FRF, whitened by *whitener* (n_line, n, n) [N/m], its diagonals (n_line, n), or its factors."""

    measured: Measured
    model: Model
    whitener: Weights

    @property
    def size(self) -> float:
        """Norm of the whitened measured FRF."""
        return float(np.linalg.norm(self.whitened(self.measured.matrix)))

    def whitened(self, values: ComplexArray) -> FloatArray:
        """FRFs (..., n_line, n_output, n_input) [m/N] whitened to real equations (..., n_equation) [1]."""
        return whitened(self.weights, values)

    @cached_property
    def weights(self) -> Weights:
        """The whitener, or its diagonals (n_line, n) [N/m] where all else is zero, or its factors."""
        return self.whitener if isinstance(self.whitener, ProductWeights) else short_weights(self.whitener)

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Whitened residual (n_equation,) [1], of variance 1 for a correct model."""
        return self.whitened(self.measured.matrix - self.model.receptance(parameters, self.measured.omega))

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [1] of the residual at *parameters* (n_parameter,); infinite where the model has no finite response."""
        measured, n_chunk = self.measured, max(16, CACHED_ELEMENTS // self.measured.matrix[0].size)
        if not (isinstance(self.model, DynamicModel) and is_short(self.weights)):
            return sum_of_squares(self.residual, parameters)
        # A few lines at a time stay in the cache.
        chunks = [slice(start, start + n_chunk) for start in range(0, measured.omega.size, n_chunk)]
        return sum(sum_of_squares(partial(self._residual_of, lines), parameters) for lines in chunks)

    def _residual_of(self, lines: slice, parameters: FloatArray) -> FloatArray:
        measured = self.measured
        return whitened(weights_at(self.weights, lines), measured.matrix[lines] - self.model.receptance(parameters, measured.omega[lines]))

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d residual / d p, (n_equation, n_parameter) [1 per parameter unit]."""
        columns = whitened_columns(self.weights, self.model.jacobian(parameters, self.measured.omega))
        return np.negative(columns, out=columns)

    def linearised(self, parameters: FloatArray) -> Linearisation:
        """The linearisation at *parameters* (n_parameter,) [parameter units], from products of small matrices where these tell it."""
        linear = self._linear_at(parameters)
        if linear is not None and has_line_products(linear[0], self.weights):
            model, values, slopes = linear
            equations = self._normal_equations(model, values)
            factor = triangle_of_products(slopes.T @ equations.products @ slopes)
            if factor is not None:
                scale, triangle = factor
                projected = np.linalg.solve(triangle.T, (slopes.T @ equations.projected) / scale)
                return Linearisation(triangle, projected, scale, equations.square, self.measured.n_equation)
        return linearised(self, parameters)

    def _linear_at(self, parameters: FloatArray) -> tuple[DynamicModel, FloatArray, FloatArray] | None:
        """A model linear in its parameters, their values (n,) and derivatives by *parameters* (n, n_parameter) [their units]; or None."""
        if isinstance(self.model, ProportionalModel):
            return self.model.expanded, self.model.expanded_values(parameters), self.model.slopes(parameters)
        return (self.model, parameters, np.eye(parameters.size)) if isinstance(self.model, DynamicModel) else None

    def _normal_equations(self, model: DynamicModel, parameters: FloatArray) -> NormalEquations:
        measured, force = self.measured, model.whole(parameters).force

        def lines_of(lines: slice) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
            inverse = compliance(model, parameters, measured.omega[lines])
            response = inverse @ force
            return inverse, response, measured.matrix[lines] - response

        return normal_equations(model, measured.omega, self.weights, lines_of)
