"""Small complex matrices, one per line: (n_frequency, n, n)."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray


def hermitian(matrix: ComplexArray) -> ComplexArray:
    """The conjugate transposes (..., m, n) of matrices (..., n, m) [any unit]."""
    return matrix.conj().swapaxes(-1, -2)


def inverse(matrix: ComplexArray) -> ComplexArray:
    """The inverses of matrices (..., n, n) [any unit]; numpy.linalg.LinAlgError when one is singular. Closed form for n = 2."""
    if matrix.shape[-1] != 2:
        return np.linalg.inv(matrix)
    a, b, c, d = (matrix[..., row, column] for row in (0, 1) for column in (0, 1))
    determinant = a * d - b * c
    if np.any(determinant == 0):
        raise np.linalg.LinAlgError("Singular matrix")
    adjugate = np.empty(matrix.shape, np.complex128)
    for (row, column), minor in (((0, 0), d), ((0, 1), -b), ((1, 0), -c), ((1, 1), a)):
        adjugate[..., row, column] = minor / determinant
    return adjugate


def without_rounding(covariance: ComplexArray) -> ComplexArray:
    """The Hermitian part of covariances (..., n, n) [any unit], diagonals real and not negative: removes rounding errors."""
    covariance = (covariance + hermitian(covariance)) / 2
    diagonal = np.einsum("...ii->...i", covariance)
    diagonal[...] = np.maximum(diagonal.real, 0.0)
    return covariance
