"""The weighted output error of a model: residual, its slopes and its square, in real numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.measured import Measured
from labpipe.identify.model import ResponseModel
from labpipe.identify.weights import whitened
from labpipe.optimise.levenberg import sum_of_squares


@dataclass(frozen=True)
class OutputError:
    """Measured minus modelled FRF, whitened by *whitener* (n_line, n, n) [N/m]."""

    measured: Measured
    model: ResponseModel
    whitener: ComplexArray

    @property
    def size(self) -> float:
        """Length of the whitened measured FRF."""
        return float(np.linalg.norm(self.whitened(self.measured.matrix)))

    def whitened(self, values: ComplexArray) -> FloatArray:
        """(..., n_line, n_output, n_input) -> (..., n_equation)."""
        return whitened(self.whitener, values)

    def residual(self, parameters: FloatArray) -> FloatArray:
        """(n_equation,), of variance 1 for a right model."""
        return self.whitened(self.measured.matrix - self.model.receptance(parameters, self.measured.omega))

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of the squared residual; infinite where the model has no finite response."""
        return sum_of_squares(self.residual, parameters)

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d residual / d p, (n_equation, n_parameter)."""
        return -self.whitened(self.model.jacobian(parameters, self.measured.omega)).T
