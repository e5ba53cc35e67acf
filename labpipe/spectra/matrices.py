"""Small complex matrices, one per line: (n_frequency, n, n)."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray

# Numbers of matrices that are worked on together: a part of the cache.
CACHED_NUMBERS = 1 << 15


def hermitian(matrix: ComplexArray) -> ComplexArray:
    """The conjugate transposes (..., m, n) of matrices (..., n, m) [any unit]."""
    return matrix.conj().swapaxes(-1, -2)


def lines_last(n_line: int, n_row: int, n_column: int) -> ComplexArray:
    """An empty array (n_line, n_row, n_column) [any unit], lines last in memory: work on its elements then
    runs over long rows.
    """
    return np.empty((n_row, n_column, n_line), np.complex128).transpose(2, 0, 1)


def product(left: ComplexArray, right: ComplexArray) -> ComplexArray:
    """left right of matrices (n_line, n, m) and (n_line, m, k) [any unit], (n_line, n, k); lines are last
    in memory.
    """
    result = lines_last(left.shape[0], left.shape[1], right.shape[2])
    np.einsum("fij,fjk->fik", left, right, out=result)
    return result


def at_lines(matrix: ComplexArray, chosen: BoolArray) -> ComplexArray:
    """The *chosen* lines (n_line,) of matrices (n_line, n, m) [any unit]."""
    if np.all(chosen):
        return matrix
    return np.compress(chosen, matrix.transpose(1, 2, 0), axis=2).transpose(2, 0, 1)


def inverse(matrix: ComplexArray) -> ComplexArray:
    """The inverses of matrices (..., n, n) [any unit]; numpy.linalg.LinAlgError when one is singular."""
    n = matrix.shape[-1]
    if n > 2:
        return np.linalg.inv(matrix)
    determinant = matrix[..., 0, 0]
    if n == 2:
        determinant = determinant * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    if np.any(determinant == 0):
        raise np.linalg.LinAlgError("Singular matrix")
    result = np.empty_like(matrix, np.complex128)
    reciprocal = 1.0 / determinant
    if n == 1:
        result[..., 0, 0] = reciprocal
        return result
    for i, j in np.ndindex(2, 2):
        sign = 1 if i == j else -1
        np.multiply(matrix[..., 1 - j, 1 - i], sign * reciprocal, out=result[..., i, j])
    return result


def definite_inverse(matrix: ComplexArray) -> tuple[ComplexArray, FloatArray]:
    """The inverses of Hermitian positive definite matrices (n_line, n, n) [any unit], and their pivots
    (n_line, n) [any unit]. The determinant is the product of the pivots. numpy.linalg.LinAlgError when a
    pivot is not positive.
    """
    n_line, n = matrix.shape[:2]
    work = lines_last(n_line, n, n)
    work[...] = matrix
    pivots = np.empty((n, n_line)).T
    for k in range(n):
        pivots[:, k] = work[:, k, k].real
        if not np.all(pivots[:, k] > 0):
            raise np.linalg.LinAlgError("Singular matrix")
        work[:, k, k] = 1.0
        work[:, k] /= pivots[:, k, None]
        for row in range(n):
            if row != k:
                factor = work[:, row, k].copy()
                work[:, row, k] = 0.0
                work[:, row] -= factor[:, None] * work[:, k]
    return work, pivots


def schur_complement(matrix: ComplexArray, n_first: int) -> ComplexArray:
    """D - B^H A^-1 B of Hermitian positive definite matrices [[A, B], [B^H, D]] (n_line, n, n) [any unit], A
    (n_line, n_first, n_first). (n_line, n - n_first, n - n_first), lines last in memory. Elimination below
    the diagonal: the condition of A does not enter; exactly Hermitian, and a diagonal that rounding makes
    negative is 0.
    """
    n_line, n = matrix.shape[:2]
    rest = lines_last(n_line, n - n_first, n - n_first)
    n_chunk = max(1, CACHED_NUMBERS // (n * n_first))
    for start in range(0, n_line, n_chunk):
        lines = slice(start, start + n_chunk)
        columns, factors = _eliminate(matrix[lines, :, :n_first])
        conjugates = columns.conj()
        for row in range(n - n_first):
            left = matrix[lines, n_first + row, n_first : n_first + row + 1].T.copy()
            for k, factor in enumerate(factors[n_first + row]):
                left -= factor * conjugates[n_first : n_first + row + 1, k]
            left[row] = np.maximum(left[row].real, 0.0)
            rest[lines, row, : row + 1] = left.T
            rest[lines, :row, row] = left[:row].conj().T
    return rest


def _eliminate(first: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Columns of all rows as elimination leaves them, and those over their pivots, (n, n_first, n_line)."""
    columns = np.array(first.transpose(1, 2, 0), order="C")
    factors = np.zeros_like(columns)
    for k in range(columns.shape[1]):
        factors[k:, k] = columns[k:, k] / columns[k, k].real
        for column in range(k + 1, columns.shape[1]):
            columns[column:, column] -= factors[column:, k] * columns[column, k].conj()
    return columns, factors


def without_rounding(covariance: ComplexArray) -> ComplexArray:
    """The Hermitian part of covariances (..., n, n) [any unit], diagonals real and not negative: removes
    rounding errors.
    """
    covariance = (covariance + hermitian(covariance)) / 2
    diagonal = np.einsum("...ii->...i", covariance)
    diagonal[...] = np.maximum(diagonal.real, 0.0)
    return covariance
