"""The end of a loop's fit at the edge of what a bearing can have: an unknown that fits best at zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.campaign.loop_problem import LoopProblem
from labpipe.optimise.levenberg import Minimum, minimise

# An unknown less than this share of its start value above zero stands at the edge where no bearing can have one below.
NEAR = 1e-2
# The share of its start value that makes an unknown zero.
ZERO = -1.0


@dataclass(frozen=True)
class HeldProblem:
    """The problem over some of its parameters, *free* (n_parameter,), the others held at u (n_parameter,) [1]."""

    problem: LoopProblem
    u: FloatArray
    free: BoolArray

    @property
    def size(self) -> float:
        return self.problem.size

    def whole(self, values: FloatArray) -> FloatArray:
        """All parameters (n_parameter,) [1] from the free ones."""
        u = self.u.copy()
        u[self.free] = values
        return u

    def residual(self, values: FloatArray) -> FloatArray:
        """(n_equation,) [1] at the free parameters [1]."""
        return self.problem.residual(self.whole(values))

    def jacobian(self, values: FloatArray) -> FloatArray:
        """(n_equation, n_free) [1] of the free parameters."""
        return self.problem.jacobian(self.whole(values))[:, self.free]

    def chi2(self, values: FloatArray) -> float:
        """Sum of squares [1] at the free parameters (n_free,) [1]; infinite for values that no bearing can have."""
        return self.problem.chi2(self.whole(values))


def at_edge(problem: LoopProblem, u: FloatArray) -> BoolArray:
    """(n_parameter,): the unknowns that would go below zero if a bearing could have that; u (n_parameter,) [1]."""
    gradient = problem.jacobian(u).T @ problem.residual(u)
    at_zero = np.zeros(u.size, dtype=bool)
    for number in range(len(problem.unknowns)):
        falling = u[number] < ZERO + NEAR and gradient[number] > 0
        below = u.copy()
        below[number] = ZERO - NEAR
        at_zero[number] = falling and problem.residual_within(below) is None
    return at_zero


def along_the_edge(problem: LoopProblem, minimum: Minimum) -> Minimum:
    """The minimum with the unknowns at zero that a descent stopped at; *minimum* as it is where it stopped for another reason."""
    if minimum.converged:
        return minimum
    at_zero = at_edge(problem, minimum.values)
    if not at_zero.any():
        return minimum
    start = np.where(at_zero, ZERO, minimum.values)
    if problem.residual_within(start) is None:
        return minimum
    along = HeldProblem(problem, start, ~at_zero)
    end = Minimum(start[~at_zero], True, 0) if at_zero.all() else minimise(along, start[~at_zero])
    values = along.whole(end.values)
    # Left to itself an unknown that is held must still want to go below zero.
    stays = bool(np.all(at_edge(problem, values)[at_zero]))
    return Minimum(values, end.converged and stays, minimum.steps + end.steps)
