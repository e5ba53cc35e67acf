"""Slow readable twins: least squares and instrumental variables written line by line, one row of the
equations after the other.
"""

from __future__ import annotations

import numpy as np

Pair = tuple[np.ndarray, np.ndarray]


def literal_ls(h: np.ndarray, omega: np.ndarray, mass: np.ndarray) -> Pair:
    """Symmetric K, C from Z H = I with known mass: A x = b, real and imaginary parts of every line and entry
    one below the other.
    """
    a, b = _equations(h, h, omega, mass)
    return _matrices(np.linalg.lstsq(a, b, rcond=None)[0], len(mass))


def literal_iv(h: np.ndarray, omega: np.ndarray, mass: np.ndarray, tolerance: float = 1e-4) -> Pair:
    """V^T A x = V^T b, V from the model's own H; started from least squares."""
    k, c = literal_ls(h, omega, mass)
    a, b = _equations(h, h, omega, mass)
    before = None
    for _ in range(25):
        model = np.array([np.linalg.inv(k + 1j * w * c - w**2 * mass) for w in omega])
        v, _ = _equations(model, h, omega, mass)
        k_new, c_new = _matrices(np.linalg.solve(v.T @ a, v.T @ b), len(mass))
        change = np.linalg.norm(np.r_[k_new - k, c_new - c]) / np.linalg.norm(np.r_[k, c])
        settled = before is not None and np.linalg.norm(model - before) / np.linalg.norm(before) < tolerance
        k, c, before = k_new, c_new, model
        if change < tolerance or settled:
            break
    return k, c


def _equations(regressor: np.ndarray, h: np.ndarray, omega: np.ndarray, mass: np.ndarray) -> Pair:
    n = len(mass)
    places = [(i, j) for i in range(n) for j in range(i, n)]
    rows, side = [], []
    for line, w in enumerate(omega):
        for row in range(n):
            for column in range(h.shape[2]):
                entries = []
                for factor in (1.0, 1j * w):
                    for i, j in places:
                        entry = 0.0
                        if i == row:
                            entry = entry + regressor[line, j, column]
                        if j == row and i != j:
                            entry = entry + regressor[line, i, column]
                        entries.append(factor * entry)
                known = (1.0 if row == column else 0.0) + w**2 * (mass[row] @ h[line, :, column])
                rows.append([np.real(entry) for entry in entries])
                rows.append([np.imag(entry) for entry in entries])
                side.extend([np.real(known), np.imag(known)])
    return np.array(rows), np.array(side)


def _matrices(x: np.ndarray, n: int) -> Pair:
    k, c = np.zeros((n, n)), np.zeros((n, n))
    rows, columns = np.triu_indices(n)
    k[rows, columns] = k[columns, rows] = x[: rows.size]
    c[rows, columns] = c[columns, rows] = x[rows.size :]
    return k, c
