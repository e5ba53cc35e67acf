"""Optimum designs: criteria, shares of the power on candidates, and the certificate that none is better.

By the equivalence theorem: Kiefer and Wolfowitz 1960; Fedorov 1972, Theory of Optimal Experiments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import FitError

D, A, MINIMAX = "D", "A", "minimax"
CRITERIA = (MINIMAX, A, D)
# Variances within this of the largest one count as largest.
ACTIVE = 2e-3


@dataclass(frozen=True)
class DesignCertificate:
    """Efficiency of a design, the least it can be against the best of all: 1 where none is better.

    weights (n_coefficient, n_coefficient) [1]: W.
    """

    efficiency: float
    weights: FloatArray


def variances(information: FloatArray, wanted: FloatArray | None = None) -> FloatArray:
    """r I^-1 r^T of combinations *wanted* (n_wanted, n_coefficient) [1], (n_wanted,) [1]; of all coefficients
    unless given. Equation (plan-variances).
    """
    inverse = np.linalg.inv(information)
    return np.diagonal(inverse) if wanted is None else _along(inverse, wanted)


def _along(inverse: FloatArray, wanted: FloatArray) -> FloatArray:
    return np.einsum("wi,ij,wj->w", wanted, inverse, wanted)


def weights_of(inverse: FloatArray, multipliers: FloatArray, wanted: FloatArray) -> FloatArray:
    """W = I^-1 R^T diag(q) R I^-1 (n, n) [1] of the *inverse* I^-1 (n, n) [1], q (n_wanted,) [1] and
    combinations R (n_wanted, n) [1]. Equation (plan-gradient).
    """
    rows = wanted @ inverse
    return rows.T @ (multipliers[:, None] * rows)


def certificate(
    criterion: str, information: FloatArray, design: FloatArray, wanted: FloatArray
) -> DesignCertificate:
    """That of a design with information *design* (n, n) [1/s] among candidates *information* (n_candidate, n,
    n) [1/s].

    wanted (n_wanted, n) [1]: combinations of coefficients that A and minimax look at; D takes all
    coefficients. Efficiencies are of variances, of D of det(I)^(1/n). Equation (plan-certificate).
    """
    inverse = np.linalg.inv(design)
    v = _along(inverse, wanted)
    q = _multipliers(inverse, information, wanted) if criterion == MINIMAX else np.ones(v.size)
    weights = inverse if criterion == D else weights_of(inverse, q, wanted)
    greatest, total = float(_scores(weights, information).max()), float(q @ v)
    efficiency = {
        D: len(design) / greatest,
        A: total**2 / greatest / total,
        MINIMAX: total**2 / (greatest * float(q.sum())) / float(v.max()),
    }
    return DesignCertificate(efficiency[criterion], weights)


def _multipliers(inverse: FloatArray, information: FloatArray, wanted: FloatArray) -> FloatArray:
    """q >= 0 of the largest variances, sum q v = 1, of least max d: the linear programme of the bound."""
    v = _along(inverse, wanted)
    active = np.flatnonzero(v >= (1 - ACTIVE) * v.max())
    rows = wanted[active] @ inverse
    gains = np.einsum("ij,ajk,ik->ai", rows, information, rows) * v.max()
    unit = v[active] / v.max()
    bounds = np.hstack([gains / unit.max() / v.max(), -np.ones((len(gains), 1))])
    cost = np.zeros(active.size + 1)
    cost[-1] = 1.0
    solved = scipy.optimize.linprog(cost, bounds, np.zeros(len(bounds)), np.append(unit, 0.0)[None], [1.0])
    q = np.zeros(v.size)
    q[active] = np.maximum(solved.x[:-1], 0.0) if solved.x is not None else 1.0 / active.size
    return q


def _scores(weights: FloatArray, information: FloatArray) -> FloatArray:
    return np.einsum("ij,aij->a", weights, information)


START_STEPS = 300
ROUNDS = 40
ENOUGH = 0.9997
# Candidates with less than this share of the largest do not remain.
NEGLIGIBLE = 1e-3
# Of more candidates every second, third ... begins, with so many promising ones: time grows with their cube.
MOST_AT_ONCE, PROMISING = 100, 20
# Least share on the way, where matrices may be singular without.
TRACE = 1e-8
EXPONENT = {D: 1.0, A: 0.5, MINIMAX: 0.35}
LARGEST_NORM = 25.0


@dataclass(frozen=True)
class Design:
    """Shares (n_candidate,) [1] of a unit cost, their information (n, n) [1/s], and the certificate."""

    shares: FloatArray
    information: FloatArray
    certificate: DesignCertificate


def optimum(
    criterion: str, information: FloatArray, wanted: FloatArray | None = None, floor: FloatArray | None = None
) -> Design:
    """The best shares of a unit cost among candidates *information* (n_candidate, n, n) [1/s].

    wanted (n_wanted, n) [1]: combinations of coefficients that A and minimax look at, by default each by
    itself. *floor* (n_candidate,) [1]: shares, of sum below 1, that the design has whatever else; the
    certificate is then among all designs with that floor. FitError where no design is regular. Equation
    (plan-multiplicative).
    """
    n_candidate, n = len(information), information.shape[-1]
    wanted = np.eye(n) if wanted is None else wanted
    floor = np.zeros(n_candidate) if floor is None else floor
    free = 1 - float(floor.sum())
    # With the floor inside every candidate the problem is again one of shares that sum to one.
    whole = free * information + np.einsum("a,aij->ij", floor, information)
    _check_regular(whole)
    shares = _multiply(criterion, whole, wanted)
    certified = certificate(criterion, whole, _sum(shares, whole), wanted)
    best, best_shares = certified, shares
    for _ in range(ROUNDS):
        if best.efficiency >= ENOUGH:
            break
        remaining = np.flatnonzero(shares > NEGLIGIBLE * shares.max())
        remaining = remaining[:: 1 + remaining.size // MOST_AT_ONCE]
        promising = np.argsort(_scores(certified.weights, whole))[-PROMISING:]
        shares = _polish(criterion, whole, wanted, np.union1d(remaining, promising), shares)
        certified = certificate(criterion, whole, _sum(shares, whole), wanted)
        if certified.efficiency > best.efficiency:
            best, best_shares = certified, shares
    return Design(floor + free * best_shares, _sum(best_shares, whole), best)


def _check_regular(information: FloatArray) -> None:
    total = information.mean(axis=0)
    root = np.sqrt(np.diagonal(total))
    if np.any(root == 0) or np.linalg.cond(total / np.outer(root, root)) > 1e13:
        what = "no excitation of these lines and directions determines all coefficients"
        raise FitError(what, hint="more lines or directions of force")


def _sum(shares: FloatArray, information: FloatArray) -> FloatArray:
    return np.tensordot(shares, information, 1)


def _multiply(criterion: str, information: FloatArray, wanted: FloatArray) -> FloatArray:
    """Start by w <- w (d / f)^g; minimax by p-norms of the variances, p rising to 25."""
    shares = np.full(len(information), 1 / len(information))
    for step in range(START_STEPS):
        inverse = np.linalg.inv(_sum(shares, information))
        if criterion == D:
            weights = inverse
        else:
            v = _along(inverse, wanted)
            p = 1.0 if criterion == A else 1 + (LARGEST_NORM - 1) * step / START_STEPS
            weights = weights_of(inverse, (v / v.max()) ** (p - 1), wanted)
        d = _scores(weights, information)
        shares = shares * (d / float(shares @ d)) ** EXPONENT[criterion]
        shares /= shares.sum()
    return shares


def _polish(
    criterion: str, information: FloatArray, wanted: FloatArray, chosen: IntArray, start: FloatArray
) -> FloatArray:
    """The best shares on the *chosen* candidates by sequential quadratic programming, zero elsewhere."""
    some = information[chosen]
    begin = np.maximum(start[chosen], 1e-3 / chosen.size)
    begin /= begin.sum()
    solve = _least_largest if criterion == MINIMAX else _least_smooth
    polished = np.maximum(solve(criterion, some, wanted, begin), 0.0)
    shares = np.zeros(len(information))
    shares[chosen] = polished / polished.sum()
    return shares


def _least_smooth(
    criterion: str, information: FloatArray, wanted: FloatArray, begin: FloatArray
) -> FloatArray:
    scale = float(variances(_sum(begin, information), wanted).sum())

    def value(shares: FloatArray) -> tuple[float, FloatArray]:
        design = _sum(np.maximum(shares, 0), information)
        inverse = np.linalg.inv(design)
        if criterion == D:
            return -float(np.linalg.slogdet(design)[1]), -_scores(inverse, information)
        weights = weights_of(inverse, np.ones(len(wanted)), wanted)
        total = float(np.einsum("wi,ij,wj->", wanted, inverse, wanted))
        return total / scale, -_scores(weights, information) / scale

    sums = {"type": "eq", "fun": lambda shares: shares.sum() - 1, "jac": np.ones_like}
    bounds = [(0, 1)] * begin.size
    return scipy.optimize.minimize(value, begin, bounds=bounds, constraints=[sums], **_BY_SQP).x


_BY_SQP: dict[str, Any] = {"jac": True, "method": "SLSQP", "options": {"maxiter": 200, "ftol": 1e-12}}


def _least_largest(
    _criterion: str, information: FloatArray, wanted: FloatArray, begin: FloatArray
) -> FloatArray:
    """Shares and the level t of least t with v_i <= t, in logarithms: ln v_i <= t."""

    def logarithms(unknowns: FloatArray) -> FloatArray:
        return np.log(variances(_sum(np.maximum(unknowns[:-1], 0), information), wanted))

    def slopes(unknowns: FloatArray) -> FloatArray:
        rows = wanted @ np.linalg.inv(_sum(np.maximum(unknowns[:-1], 0), information))
        gains = np.einsum("ij,ajk,ik->ia", rows, information, rows)
        return -gains / np.einsum("wi,wi->w", rows, wanted)[:, None]

    unit, begun = np.append(np.zeros(begin.size), 1.0), np.append(begin, 0.0)
    level = float(logarithms(begun).max())
    below = {
        "type": "ineq",
        "fun": lambda unknowns: unknowns[-1] + level - logarithms(unknowns),
        "jac": lambda unknowns: np.hstack([-slopes(unknowns), np.ones((len(wanted), 1))]),
    }
    sums: Any = {"type": "eq", "fun": lambda unknowns: unknowns[:-1].sum() - 1, "jac": lambda _: 1 - unit}
    bounds = [(TRACE, 1)] * begin.size + [(None, None)]
    solved = scipy.optimize.minimize(
        lambda unknowns: (unknowns[-1], unit), begun, bounds=bounds, constraints=[below, sums], **_BY_SQP
    )
    return solved.x[:-1]
