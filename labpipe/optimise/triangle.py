"""The triangular factor of tall matrices, from the products of their columns where that is as good as Householder's way."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray

# Condition number up to which the products of columns tell the factor to about half of all digits.
WELL_CONDITIONED = 1e4


def scaled_triangle(columns: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """(lengths S of the columns [any unit], R (n, n) [1] of columns S^-1 = Q R, True if R comes from their products).

    *columns* (n_row, n) [any unit]; a column of zeros keeps its length 1. Products of columns (Cholesky) cost a fraction of Householder's
    QR and are as accurate while the condition number is far below 1 / sqrt(rounding); QR is used beyond that.
    """
    triangle = triangle_of_products(columns.T @ columns)
    if triangle is not None:
        return *triangle, True
    lengths = np.linalg.norm(columns, axis=0)
    scale = np.where(lengths > 0, lengths, 1.0)
    return scale, np.asarray(np.linalg.qr(columns / scale, mode="r")), False


def triangle_of_products(products: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """(lengths S of the columns [any unit], R (n, n) [1]) from the products (n, n) of columns with each other; None where R is too inexact.

    Products of zero keep the length 1.
    """
    scale = np.sqrt(np.diag(products))
    scale = np.where(scale > 0, scale, 1.0)
    try:
        triangle: FloatArray = np.linalg.cholesky(products / np.outer(scale, scale)).T
    except np.linalg.LinAlgError:
        return None
    singular = np.linalg.svd(triangle, compute_uv=False)
    return (scale, triangle) if singular[0] < WELL_CONDITIONED * singular[-1] else None
