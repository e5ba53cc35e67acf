"""What modes outside the band leave inside it: a few smooth terms with complex factors for every FRF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class ResidualTerms:
    """Smooth terms on *omega* (n_line,) [rad/s] and the FRFs *matrix* (n_line, n_output, n_input) [any unit] that they are taken out of:

    *lower* terms s^-2, s^-4 ... (modes below the band) and *upper* terms 1, s^2, s^4 ... (above), times s^power.

    The upper ones are Chebyshev polynomials of omega^2 over the band: the same space, without the powers' likeness. Their error falls
    like q^-K with K terms, q = x + sqrt(x^2 - 1), x the mode's omega^2 where the band is [-1, 1].
    """

    omega: FloatArray
    matrix: ComplexArray
    power: int
    lower: int
    upper: int

    @property
    def count(self) -> int:
        return self.lower + self.upper

    @cached_property
    def basis(self) -> ComplexArray:
        """Orthonormal columns (n_line, n_term) [1]."""
        square = self.omega**2
        middle, half = (square[-1] + square[0]) / 2, max((square[-1] - square[0]) / 2, np.finfo(float).tiny)
        upper = np.polynomial.chebyshev.chebvander((square - middle) / half, max(self.upper - 1, 0))[:, : self.upper]
        lower = (square[0] / square)[:, None] ** np.arange(1, self.lower + 1)
        columns = np.hstack([lower, upper]) * ((1j * self.omega / self.omega[-1]) ** self.power)[:, None]
        return np.asarray(np.linalg.qr(columns)[0])

    def without(self, values: ComplexArray) -> ComplexArray:
        """*values* (n_line, n) [any unit] less what the terms can make of them with complex factors."""
        return np.asarray(values - self.basis @ (self.basis.conj().T @ values))

    @cached_property
    def remainder(self) -> ComplexArray:
        """The data (n_line, n_output, n_input) [unit of the FRF] without the terms."""
        return self.without(self.matrix.reshape(self.omega.size, -1)).reshape(self.matrix.shape)

    @cached_property
    def size(self) -> FloatArray:
        """Sum over the lines of |remainder|^2, (n_output, n_input) [square of the FRF's unit]."""
        return np.asarray(np.sum(np.abs(self.remainder) ** 2, axis=0))
