"""What makes a design good, and the certificate that none is better. CRITERIA by name.

With d_a = tr(W I_a) of a candidate of unit cost, by the equivalence theorem (Kiefer and Wolfowitz 1960; Fedorov 1972, Theory of Optimal
Experiments): D-optimality with W = I^-1 has efficiency at least n / max d; a weighted sum f = sum q_i v_i of the variances with
W = I^-1 diag(q) I^-1 at least f / max d; and the largest variance, for any q >= 0 with lambda_i = q_i v_i, at least
(sum lambda)^2 / (max d sum q) over it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from labpipe.arrays import BoolArray, FloatArray

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


def variances(information: FloatArray) -> FloatArray:
    """Diagonal of I^-1, (n_coefficient,) [1]."""
    return np.asarray(np.diagonal(np.linalg.inv(information)))


def certificate(criterion: str, information: FloatArray, design: FloatArray, wanted: BoolArray) -> Certificate:
    """That of a design with information *design* (n, n) [1/s] among candidates *information* (n_candidate, n, n) [1/s].

    wanted (n,): coefficients of A and minimax; D takes all. Efficiencies are of variances, of D of det(I)^(1/n).
    """
    inverse = np.linalg.inv(design)
    n = len(design)
    if criterion == D:
        weights, level = inverse, float(n)
        scores = _scores(weights, information)
        greatest = float(scores.max())
        return Certificate(D, level / greatest, weights, greatest, int(scores.argmax()))
    v = np.diagonal(inverse)
    q = wanted.astype(float) if criterion == A else _multipliers(inverse, information, wanted)
    weights = inverse @ (q[:, None] * inverse)
    scores = _scores(weights, information)
    greatest = float(scores.max())
    total = float(q @ v)
    bound = total**2 / greatest if criterion == A else total**2 / (greatest * float(q.sum()))
    value = total if criterion == A else float(v[wanted].max())
    return Certificate(criterion, bound / value, weights, greatest, int(scores.argmax()))


def _multipliers(inverse: FloatArray, information: FloatArray, wanted: BoolArray) -> FloatArray:
    """q >= 0 of the largest variances with sum q v = 1 that makes max d least: the linear programme of the tightest bound."""
    v = np.diagonal(inverse)
    active = np.flatnonzero(wanted & (v >= (1 - ACTIVE) * v[wanted].max()))
    told = np.einsum("ij,ajk,ki->ai", inverse[active], information, inverse[:, active]) * v[wanted].max()
    unit = v[active] / v[wanted].max()
    rows = np.hstack([told / unit.max() / v[wanted].max(), -np.ones((len(told), 1))])
    cost = np.zeros(active.size + 1)
    cost[-1] = 1.0
    solved = linprog(cost, rows, np.zeros(len(rows)), np.append(unit, 0.0)[None], [1.0])
    q = np.zeros(v.size)
    q[active] = np.maximum(solved.x[:-1], 0.0) if solved.x is not None else 1.0 / active.size
    return q


def _scores(weights: FloatArray, information: FloatArray) -> FloatArray:
    """d_a = tr(W I_a), (n_candidate,)."""
    return np.asarray(np.einsum("ij,aij->a", weights, information))
