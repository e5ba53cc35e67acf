"""Where a descent begins: the matrices by weighted linear least squares, for every shape parameter of a grid at once."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.dynamic_stiffness.forms import FORMS, StiffnessModel
from labpipe.dynamic_stiffness.likelihood import Balance, Whitened, times, whitened

# Descents from the best places of a grid of shape parameters.
MOST_DESCENTS = 3
REWEIGHTED = 2
# Added to the unit diagonal of scaled normal equations, for forms that hold another one within themselves.
RIDGE = 1e-10


def starts(balance: Balance, model: StiffnessModel) -> list[FloatArray]:
    """Values (n_parameter,) [parameter units] to begin with, the most promising first; one for a model without shape parameters."""
    weights = _weights(balance, model.symmetry)
    grid = model.form.starts(balance.omega)
    linear, misfit = solved(balance, model, grid, weights)
    order = np.argsort(misfit)[:MOST_DESCENTS]
    return [np.concatenate([linear[number], grid[number]]) for number in order]


def _weights(balance: Balance, symmetry: str) -> Whitened:
    """Weights by the noise of the balance: first all lines alike, then twice with the K, C and M that come out."""
    model = StiffnessModel(FORMS["kcm"], symmetry)
    weights = _alike(balance)
    for _ in range(REWEIGHTED):
        values = solved(balance, model, np.empty((1, 0)), weights)[0][0]
        weights = whitened(balance, model.stiffness(values, balance.omega))
    return weights


def _alike(balance: Balance) -> Whitened:
    """Weights that are the same for all lines."""
    ones = np.ones(balance.right.shape[:2])
    return Whitened(balance.right, balance.motion, ones, np.zeros_like(ones, np.complex128), ones)


def solved(balance: Balance, model: StiffnessModel, grid: FloatArray, weights: Whitened) -> tuple[FloatArray, FloatArray]:
    """The matrices' elements (n_start, n_linear) [their units] of least squares with fixed weights, and what they leave (n_start,) [1].

    grid (n_start, n_shape) of shape parameters. The normal equations of all starts come from the same sums over runs and components,
    line by line, since the functions g_k are the same for all elements of a matrix.
    """
    moved = weights.whiten(times(model.elements[:, None, None], balance.motion))
    side = weights.whiten(balance.right)
    n_element, n_line = moved.shape[:2]
    rows = moved.transpose(1, 0, 2, 3).reshape(n_line, n_element, -1)
    # (n_line, n_element, n_element) and (n_line, n_element): sums over runs and components.
    products = (rows.conj() @ rows.swapaxes(-1, -2)).reshape(n_line, -1)
    forced = np.einsum("lcr,lr->lc", rows.conj(), side.reshape(n_line, -1))
    basis = np.stack([model.form.basis(theta, balance.omega) for theta in grid])
    n_start, n_matrix = basis.shape[:2]
    pairs = (basis.conj()[:, :, None] * basis[:, None]).reshape(-1, n_line)
    normal = (pairs @ products).real.reshape(n_start, n_matrix, n_matrix, n_element, n_element)
    normal = normal.transpose(0, 1, 3, 2, 4).reshape(n_start, model.n_linear, model.n_linear)
    right = (basis.conj() @ forced).real.reshape(n_start, model.n_linear)
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), np.finfo(float).tiny))
    scaled = normal / (scale[:, :, None] * scale[:, None]) + RIDGE * np.eye(model.n_linear)
    linear = np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale
    return linear, float(np.sum(np.abs(side) ** 2)) - np.sum(right * linear, axis=1)
