"""What makes a design good, and the certificate that none is better. CRITERIA by name.

With d_a = tr(W I_a) of a candidate of unit cost, by the equivalence theorem (Kiefer and Wolfowitz 1960; Fedorov 1972, Theory of Optimal
Experiments): D-optimality with W = I^-1 has efficiency at least n / max d; a weighted sum f = sum q_i v_i of the variances with
W = I^-1 diag(q) I^-1 at least f / max d; and the largest variance, for any q >= 0 with lambda_i = q_i v_i, at least
(sum lambda)^2 / (max d sum q) over it. Variances are those of single coefficients or of combinations r of them: v = r I^-1 r^T, with
W = sum q_i I^-1 r_i^T r_i I^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from labpipe.arrays import FloatArray

D, A, MINIMAX = "D", "A", "minimax"
CRITERIA = (MINIMAX, "A", "D")
# Variances within this of the largest one count as largest.
ACTIVE = 2e-3


@dataclass(frozen=True)
class Certificate:
    """Efficiency of a design, the least it can be against the best of all: 1 where none is better.

    weights (n_coefficient, n_coefficient) [1]: W; greatest: max d over the candidates, at candidate number *candidate*.
    """

    criterion: str
    efficiency: float
    weights: FloatArray
    greatest: float
    candidate: int


def variances(information: FloatArray, wanted: FloatArray | None = None) -> FloatArray:
    """r I^-1 r^T of combinations *wanted* (n_wanted, n_coefficient) [1], (n_wanted,) [1]; of all coefficients unless given.

    Equation (plan-variances).
    """
    inverse = np.linalg.inv(information)
    if wanted is None:
        return np.asarray(np.diagonal(inverse))
    return np.asarray(np.einsum("wi,ij,wj->w", wanted, inverse, wanted))


def weights_of(inverse: FloatArray, multipliers: FloatArray, wanted: FloatArray) -> FloatArray:
    """W = I^-1 R^T diag(q) R I^-1 (n, n) [1] of the *inverse* I^-1 (n, n) [1], q (n_wanted,) [1] and combinations R (n_wanted, n) [1].

    Equation (plan-gradient).
    """
    rows = wanted @ inverse
    return np.asarray(rows.T @ (multipliers[:, None] * rows))


def certificate(criterion: str, information: FloatArray, design: FloatArray, wanted: FloatArray) -> Certificate:
    """That of a design with information *design* (n, n) [1/s] among candidates *information* (n_candidate, n, n) [1/s].

    wanted (n_wanted, n) [1]: combinations of coefficients that A and minimax look at; D takes all coefficients. Efficiencies are of
    variances, of D of det(I)^(1/n). Equation (plan-certificate).
    """
    inverse = np.linalg.inv(design)
    if criterion == D:
        scores = _scores(inverse, information)
        greatest = float(scores.max())
        return Certificate(D, len(design) / greatest, inverse, greatest, int(scores.argmax()))
    v = variances(design, wanted)
    q = np.ones(v.size) if criterion == A else _multipliers(inverse, information, wanted)
    weights = weights_of(inverse, q, wanted)
    scores = _scores(weights, information)
    greatest = float(scores.max())
    total = float(q @ v)
    bound = total**2 / greatest if criterion == A else total**2 / (greatest * float(q.sum()))
    value = total if criterion == A else float(v.max())
    return Certificate(criterion, bound / value, weights, greatest, int(scores.argmax()))


def _multipliers(inverse: FloatArray, information: FloatArray, wanted: FloatArray) -> FloatArray:
    """q >= 0 of the largest variances with sum q v = 1 that makes max d least: the linear programme of the tightest bound."""
    v = np.einsum("wi,ij,wj->w", wanted, inverse, wanted)
    active = np.flatnonzero(v >= (1 - ACTIVE) * v.max())
    rows = wanted[active] @ inverse
    gains = np.einsum("ij,ajk,ik->ai", rows, information, rows) * v.max()
    unit = v[active] / v.max()
    bounds = np.hstack([gains / unit.max() / v.max(), -np.ones((len(gains), 1))])
    cost = np.zeros(active.size + 1)
    cost[-1] = 1.0
    solved = linprog(cost, bounds, np.zeros(len(bounds)), np.append(unit, 0.0)[None], [1.0])
    q = np.zeros(v.size)
    q[active] = np.maximum(solved.x[:-1], 0.0) if solved.x is not None else 1.0 / active.size
    return q


def _scores(weights: FloatArray, information: FloatArray) -> FloatArray:
    """d_a = tr(W I_a), (n_candidate,)."""
    return np.asarray(np.einsum("ij,aij->a", weights, information))
