"""Model order: rational fits with an increasing number of modes, and the singular values of the FRF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.measured import Measured
from labpipe.identify.weights import has_noise, whitened
from labpipe.optimise.levenberg import minimise, sum_of_squares

PASSES = 8
# The descent ends where a further full step would lower chi-square by a small part of its expectation per equation only: differences
# in AIC count from 10, and a surplus mode creeps long through noise before it converges.
NEAR = 0.2
# Bound of each descent of a comparison: a structure that contradicts the data, or surplus modes, may have no minimum to reach.
MOST_STEPS = 40
# Least ratio of a motion's singular value to the largest one of noise alone.
STANDS_OUT = 1.5


@dataclass(frozen=True)
class RationalFit:
    """Elements of H as B_e(s) / A(s) with one common denominator: A of degree 2 n for n modes, B_e of degree 2 n - 2.

    Receptances of n modes have this form; coefficients of powers of s = j w / *unit*, A with 1 at s^2n. *whitener*
    (n_line, n_element, n_element) [N/m]. Parameters: 2 n of A, then 2 n - 1 of every element.
    """

    measured: Measured
    whitener: ComplexArray
    modes: int

    @property
    def unit(self) -> float:
        return float(np.max(self.measured.omega))

    @cached_property
    def elements(self) -> ComplexArray:
        """Elements of H, (n_line, n_element), relative to the largest [1]."""
        flat = self.measured.matrix.reshape(self.measured.omega.size, -1)
        return flat / float(np.max(np.abs(flat)))

    @cached_property
    def powers(self) -> ComplexArray:
        """s^0 ... s^2n, (n_line, 2 n + 1) [1]."""
        return np.asarray(np.vander(1j * self.measured.omega / self.unit, 2 * self.modes + 1, increasing=True))

    @property
    def n_parameter(self) -> int:
        return 2 * self.modes + (2 * self.modes - 1) * self.elements.shape[1]

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self._whitened(self.elements)))

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Whitened residual (n_equation,) [1] at *parameters* (n_parameter,)."""
        denominator, numerators = self._polynomials(parameters)
        return self._whitened(self.elements - numerators / denominator[:, None])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d residual / d p = -(d B_e - H_e d A) / A, (n_equation, n_parameter) [1]."""
        denominator, numerators = self._polynomials(parameters)
        return -self._equation(numerators / denominator[:, None], 1 / denominator)

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [1] of the residual at *parameters* (n_parameter,); infinite without finite response."""
        return sum_of_squares(self.residual, parameters)

    def start(self) -> FloatArray:
        """Start values (n_parameter,) [1] by the equation error weighted with 1 / A of the last pass (Sanathanan and Koerner 1963).

        Of all passes the one with the lowest chi-square.
        """
        weight: ComplexArray = np.ones(self.measured.omega.size, np.complex128)
        best: FloatArray = np.zeros(self.n_parameter)
        lowest = float("inf")
        for _ in range(PASSES):
            right_side = self._whitened(self.elements * (self.powers[:, -1] * weight)[:, None])
            columns = self._equation(self.elements, weight)
            triangle = np.asarray(np.linalg.qr(np.column_stack([columns, right_side]), mode="r"))
            values = np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=None)[0]
            denominator, _ = self._polynomials(values)
            if np.any(denominator == 0):
                break
            weight = 1 / denominator
            if (chi2 := self.chi2(values)) < lowest:
                best, lowest = values, chi2
        return best

    def _polynomials(self, parameters: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """A (n_line,) and B (n_line, n_element)."""
        powers, n = self.powers, 2 * self.modes
        denominator = powers[:, :n] @ parameters[:n] + powers[:, n]
        return denominator, powers[:, : n - 1] @ parameters[n:].reshape(-1, n - 1).T

    def _equation(self, elements: ComplexArray, weight: ComplexArray) -> FloatArray:
        """Columns of B_e - H_e (a_0 + a_1 s + ...) = H_e s^2n times the weight, whitened, (n_equation, n_parameter)."""
        powers, n = (self.powers * weight[:, None]).T, 2 * self.modes
        n_element = elements.shape[1]
        columns = np.zeros((self.n_parameter, *elements.shape), np.complex128)
        columns[:n] = -elements * powers[:n, :, None]
        for e in range(n_element):
            columns[n + e * (n - 1) : n + (e + 1) * (n - 1), :, e] = powers[: n - 1]
        return self._whitened(columns).T

    def _whitened(self, values: ComplexArray) -> FloatArray:
        """(..., n_line, n_element) -> (..., n_equation), back in the unit of the FRF."""
        return whitened(self.whitener, float(np.max(np.abs(self.measured.matrix))) * values[..., None])


def modal_chi2(measured: Measured, whitener: ComplexArray, modes: int) -> tuple[float, int] | None:
    """Chi-square [1] and number of parameters of the best rational fit with *modes* modes; None without convergence in MOST_STEPS.

    *whitener* (n_line, n_element, n_element) [N/m].
    """
    fit = RationalFit(measured, whitener, modes)
    if measured.n_equation <= fit.n_parameter:
        return None
    minimum = minimise(fit, fit.start(), near=NEAR, most_steps=MOST_STEPS)
    return (fit.chi2(minimum.values), fit.n_parameter) if minimum.converged else None


def independent_motions(measured: Measured) -> tuple[FloatArray, int]:
    """Singular values (n_output,) [1] of the FRF in units of its noise, and the number of them above the noise.

    The matrix has outputs as columns, lines and forces as rows. Circular noise of variance 1 has singular values up to sqrt(n_row) +
    sqrt(n_column) (Geman 1980). Only the variance of each output is used, not their covariance: a common factor of the outputs is a
    motion, whatever its noise.
    """
    n_line, n_output, n_input = measured.matrix.shape
    assert measured.covariance is not None
    noise = np.sqrt(np.mean(np.einsum("lii->li", measured.covariance).real.reshape(n_line, n_output, n_input), axis=(0, 2)))
    rows = (measured.matrix / noise[None, :, None]).transpose(0, 2, 1).reshape(-1, n_output)
    values = np.linalg.svd(rows, compute_uv=False)
    limit = np.sqrt(rows.shape[0]) + np.sqrt(rows.shape[1])
    return values, int(np.sum(values > STANDS_OUT * limit))


def motion_notes(measured: Measured) -> tuple[str, ...]:
    """A note where fewer independent motions than outputs are above the noise."""
    if len(measured.outputs) < 2 or not has_noise(measured):
        return ()
    values, count = independent_motions(measured)
    if count >= values.size:
        return ()
    value_list = ", ".join(f"{value:.3g}" for value in values)
    moving = "one independent motion" if count == 1 else f"{count} independent motions"
    return (f"The {values.size} responses hold {moving}: singular values of the FRF in units of its noise {value_list}.",)
