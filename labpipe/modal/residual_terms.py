"""What modes outside the band leave inside it: a few smooth terms with complex factors for every FRF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class Lines:
    """FRFs on the lines: omega (n_line,) [rad/s], matrix (n_line, n_output, n_input) [unit of the FRF], *power* p of s of their form.

    weight (n_line,) [1]: reciprocal of the noise along the lines, the same for every element; all sums over lines are weighted with it.
    """

    omega: FloatArray
    matrix: ComplexArray
    power: int
    weight: FloatArray

    @property
    def s(self) -> ComplexArray:
        """j omega (n_line,) [rad/s]."""
        return 1j * self.omega

    @property
    def n_element(self) -> int:
        return self.matrix.shape[1] * self.matrix.shape[2]

    @property
    def weighted(self) -> ComplexArray:
        """The FRFs times the weight, (n_line, n_output, n_input) [unit of the FRF]."""
        return np.asarray(self.matrix * self.weight[:, None, None])


@dataclass(frozen=True)
class ResidualTerms:
    """Smooth terms and the FRFs that they are taken out of, both times the weight of the *lines*:

    *lower* terms s^-2, s^-4 ... (modes below the band) and *upper* terms 1, s^2, s^4 ... (above), times s^power.

    The upper ones are Chebyshev polynomials of omega^2 over the band: the same space, without the powers' likeness. Their error falls
    like q^-K with K terms, q = x + sqrt(x^2 - 1), x the mode's omega^2 where the band is [-1, 1]. Equation (modal-terms).
    """

    lines: Lines
    lower: int
    upper: int

    @property
    def count(self) -> int:
        return self.lower + self.upper

    @cached_property
    def basis(self) -> ComplexArray:
        """Orthonormal columns (n_line, n_term) [1]."""
        omega, power = self.lines.omega, self.lines.power
        square = omega**2
        middle, half = (square[-1] + square[0]) / 2, max((square[-1] - square[0]) / 2, np.finfo(float).tiny)
        upper = np.polynomial.chebyshev.chebvander((square - middle) / half, max(self.upper - 1, 0))[:, : self.upper]
        lower = (square[0] / square)[:, None] ** np.arange(1, self.lower + 1)
        columns = np.hstack([lower, upper]) * ((1j * omega / omega[-1]) ** power * self.lines.weight)[:, None]
        return np.asarray(np.linalg.qr(columns)[0])

    def without(self, values: ComplexArray) -> ComplexArray:
        """*values* (n_line, n) [any unit] less what the terms can make of them with complex factors."""
        return np.asarray(values - self.basis @ (self.basis.conj().T @ values))

    @cached_property
    def remainder(self) -> ComplexArray:
        """The data (n_line, n_output, n_input) [unit of the FRF] without the terms."""
        weighted = self.lines.weighted
        return self.without(weighted.reshape(weighted.shape[0], -1)).reshape(weighted.shape)

    @cached_property
    def size(self) -> FloatArray:
        """Sum over the lines of |remainder|^2, (n_output, n_input) [square of the FRF's unit]."""
        return np.asarray(np.sum(np.abs(self.remainder) ** 2, axis=0))
