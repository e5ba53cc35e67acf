"""Closed forms of small matrices against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra.matrices import (
    at_lines,
    definite_inverse,
    hermitian,
    inverse,
    lines_last,
    product,
    schur_complement,
)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_inverse_is_that_of_numpy(rng: np.random.Generator, n: int) -> None:
    matrix = rng.normal(size=(50, 4, n, n)) + 1j * rng.normal(size=(50, 4, n, n))
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(hermitian(matrix)[3, 1, 0], matrix[3, 1, :, 0].conj())


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_singular_matrix_is_refused(n: int) -> None:
    for of in (inverse, definite_inverse):
        with pytest.raises(np.linalg.LinAlgError):
            of(np.zeros((2, n, n), complex))


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_definite_inverse_and_product_are_those_of_numpy(rng: np.random.Generator, n: int) -> None:
    factor = rng.normal(size=(40, n, n)) + 1j * rng.normal(size=(40, n, n))
    matrix = factor @ hermitian(factor)
    result, pivots = definite_inverse(matrix)
    np.testing.assert_allclose(result, np.linalg.inv(matrix), rtol=1e-7)
    np.testing.assert_allclose(np.prod(pivots, axis=1), np.linalg.det(matrix).real, rtol=1e-9)
    np.testing.assert_allclose(product(factor, matrix[:, :, :1]), factor @ matrix[:, :, :1], rtol=1e-12)


def test_chosen_lines_stay_last_in_memory(rng: np.random.Generator) -> None:
    matrix = lines_last(5, 2, 3)
    matrix[...] = rng.normal(size=(5, 2, 3))
    chosen = np.array([True, False, True, True, False])
    np.testing.assert_array_equal(at_lines(matrix, chosen), matrix[chosen])
    assert at_lines(matrix, chosen).transpose(1, 2, 0).flags.c_contiguous
    assert at_lines(matrix, np.ones(5, bool)) is matrix


@pytest.mark.parametrize(("n_first", "n_rest"), [(1, 1), (2, 2), (3, 5)])
def test_schur_complement_is_exact_however_alike_the_first_channels_are(
    rng: np.random.Generator, n_first: int, n_rest: int
) -> None:
    # S = T D T^H of whole numbers, T lower triangular with ones on the diagonal: every number is exact, and
    # so is the remainder.
    n, n_line = n_first + n_rest, 700
    lower = np.tril(
        rng.integers(-20, 21, (n_line, n, n)) + 1j * rng.integers(-20, 21, (n_line, n, n)), -1
    ) + np.eye(n)
    pivots = rng.integers(1, 30, (n_line, n)).astype(float)
    # The first channels share nearly all of their power: D - (B^H A^-1) B by way of an inverse is wrong by
    # 2e8 to 6e11 eps here.
    pivots[:, 0] = 2.0**20
    matrix = (lower * pivots[:, None, :]) @ hermitian(lower)
    rest = lower[:, n_first:, n_first:]
    expected = (rest * pivots[:, None, n_first:]) @ hermitian(rest)
    result = schur_complement(matrix, n_first)
    power = np.einsum("laa->la", matrix).real[:, n_first:]
    error = np.abs(result - expected) / np.sqrt(power[:, :, None] * power[:, None, :])
    assert np.max(error) < 4 * n_first * np.finfo(float).eps
    np.testing.assert_array_equal(result, hermitian(result))
