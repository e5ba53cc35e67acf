"""Closed forms of small matrices against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra.matrices import hermitian, inverse


@pytest.mark.parametrize("n", [1, 2, 3])
def test_inverse_is_that_of_numpy(rng: np.random.Generator, n: int) -> None:
    matrix = rng.normal(size=(50, 4, n, n)) + 1j * rng.normal(size=(50, 4, n, n))
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(hermitian(matrix)[3, 1, 0], matrix[3, 1, :, 0].conj())


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_singular_matrix_is_refused(n: int) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        inverse(np.zeros((2, n, n), complex))
