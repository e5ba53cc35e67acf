"""A model with residual terms: a smooth complex curve per FRF for the modes outside the band, which a local model leaves out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.measured import Measured
from labpipe.identify.model import ReceptanceModel


@dataclass(frozen=True)
class OutsideModes:
    """H(w) = model + sum_n C_n T_n(x): T_n the Chebyshev polynomials of the frequency mapped on -1 ... 1, C_n complex, one per FRF.

    Parameters: the *n_own* ones of *model*, then Re C, then Im C, each (n_term, n_element), in units of *size* (n_element,) [m/N].
    *curves* (n_line, n_term) [1] on the lines of the fit. C is complex since modes outside the band need not be real (Ewins 2000, 4.6).
    Equation (est-outside).
    """

    model: ReceptanceModel
    n_own: int
    curves: FloatArray
    size: FloatArray

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H [m/N] at *parameters* (n_parameter,), (n_line, n_dof, n_input); *omega* (n_line,) [rad/s]."""
        receptance = self.model.receptance(parameters[: self.n_own], omega)
        amounts = parameters[self.n_own :].reshape(2, self.curves.shape[1], -1)
        return receptance + (self.curves @ ((amounts[0] + 1j * amounts[1]) * self.size)).reshape(receptance.shape)

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        jacobian = self.model.jacobian(parameters[: self.n_own], omega)
        # Parameters last in memory, as the fit wants them.
        slopes = np.empty((*jacobian.shape[1:], parameters.size), np.complex128)
        slopes[..., : self.n_own] = jacobian.transpose(1, 2, 3, 0)
        slopes[..., self.n_own :] = self._of_terms.reshape(*jacobian.shape[1:], -1)
        return slopes.transpose(3, 0, 1, 2)

    @cached_property
    def _of_terms(self) -> ComplexArray:
        """dH/dC of all terms, which no parameter changes, (n_line, n_element, 2 n_term n_element) [m/N]."""
        n_line, n_term = self.curves.shape
        terms = self.curves[:, None, :, None] * np.diag(self.size)[:, None, :]
        real = terms.reshape(n_line, self.size.size, n_term * self.size.size)
        return np.concatenate([real, 1j * real], axis=2)

    def start(self, values: FloatArray) -> FloatArray:
        """Start values (n_parameter,) [parameter units]: those of the model (n_own,) without residual terms."""
        return np.concatenate([values, np.zeros(2 * self.curves.shape[1] * self.size.size)])


def with_outside_modes(model: ReceptanceModel, measured: Measured, n_own: int, n_term: int) -> OutsideModes:
    """*model* of *n_own* parameters with *n_term* residual terms on the lines of *measured*."""
    w = measured.omega
    place = (2 * w - w[0] - w[-1]) / (w[-1] - w[0])
    size = np.sqrt(np.mean(np.abs(measured.matrix.reshape(w.size, -1)) ** 2, axis=0))
    return OutsideModes(model, n_own, np.polynomial.chebyshev.chebvander(place, n_term - 1), size)
