"""Weighted output error of a model: residual, its Jacobian and its sum of squares, in real numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.measured import Measured
from labpipe.identify.model import ReceptanceModel
from labpipe.identify.weights import whitened, whitened_columns
from labpipe.optimise.levenberg import sum_of_squares

Model = TypeVar("Model", bound=ReceptanceModel, covariant=True)


@dataclass(frozen=True)
class OutputError(Generic[Model]):
    """Measured minus modelled FRF, whitened by *whitener* (n_line, n, n) [N/m]."""

    measured: Measured
    model: Model
    whitener: ComplexArray

    @property
    def size(self) -> float:
        """Norm of the whitened measured FRF."""
        return float(np.linalg.norm(self.whitened(self.measured.matrix)))

    def whitened(self, values: ComplexArray) -> FloatArray:
        """FRFs (..., n_line, n_output, n_input) [m/N] whitened to real equations (..., n_equation) [1]."""
        return whitened(self.whitener, values)

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Whitened residual (n_equation,) [1], of variance 1 for a correct model."""
        return self.whitened(self.measured.matrix - self.model.receptance(parameters, self.measured.omega))

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [1] of the residual at *parameters* (n_parameter,); infinite where the model has no finite response."""
        return sum_of_squares(self.residual, parameters)

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d residual / d p, (n_equation, n_parameter) [1 per parameter unit]."""
        return -whitened_columns(self.whitener, self.model.jacobian(parameters, self.measured.omega))
