"""The end of a loop's fit: what noise and systematic sources leave of its parameters, to first order and where that bends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.loop_problem import LoopProblem
from labpipe.errors import ConfigError
from labpipe.identify.systematic import explained, steps_by
from labpipe.records.doubt import Doubt

# Condition number of the scaled Jacobian beyond which rounding determines the unknowns.
UNDETERMINED = 1e6
# Second order is looked for so many combined standard errors away.
REACH = 2.0
# An end of an interval is known to this share of a combined standard error, in so many steps, each halved so often to stay possible.
# It is approached in stages, so that none is far.
CLOSE, MOST_STEPS, MOST_HALVINGS, STAGES = 1e-2, 30, 12, 3


@dataclass(frozen=True)
class LoopMinimum:
    """The problem at the end *u* (n_parameter,) [1] of its descent.

    residual (n_equation,) [1], jacobian (n_equation, n_parameter) [1], inverse (n_parameter, n_parameter) [1] of J^T J; sources and
    their changes (n_source, n_equation) [1] of the residual.
    """

    problem: LoopProblem
    u: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    inverse: FloatArray
    sources: tuple[Doubt, ...]
    changes: FloatArray

    @classmethod
    def of(cls, problem: LoopProblem, u: FloatArray) -> LoopMinimum:
        """The problem at u (n_parameter,) [1]."""
        jacobian = problem.jacobian(u)
        length = np.linalg.norm(jacobian, axis=0)
        length[length == 0] = 1.0
        _, singular, turn = np.linalg.svd(jacobian / length, full_matrices=False)
        # What the responses do not tell has no step.
        determined = singular > singular.max(initial=0.0) / UNDETERMINED
        inverse = (turn[determined].T / singular[determined] ** 2) @ turn[determined] / np.outer(length, length)
        return cls(problem, u, problem.residual(u), jacobian, inverse, *problem.changes(u))

    def chi2(self, excess: float) -> float:
        """Chi-square for weights that are too large by *excess*, without what systematic errors explain of it."""
        scale = np.sqrt(excess)
        # At the edge of what a bearing can have, the residual still has a part that the unknowns would take away.
        across = self.residual - self.jacobian @ (self.inverse @ (self.jacobian.T @ self.residual))
        by_doubts = explained(across / scale, self.changes / scale, self.jacobian, self.inverse)
        return float(self.residual @ self.residual) / excess - by_doubts

    @property
    def steps(self) -> FloatArray:
        """Change (n_source, n_parameter) [1] of u by one standard uncertainty of every source, those of the support the last."""
        n = len(self.problem.unknowns)
        return np.vstack([steps_by(self.changes, self.jacobian, self.inverse), self.inverse[n:]])

    def random(self, inflation: float) -> FloatArray:
        """Covariance (n_parameter, n_parameter) [1] of u by the noise of the responses, without what the support's doubt adds."""
        of_support = self.inverse[:, len(self.problem.unknowns) :]
        return np.asarray(inflation * (self.inverse - of_support @ of_support.T))

    def combined(self, inflation: float) -> FloatArray:
        """Covariance (n_parameter, n_parameter) [1] of u by noise, weights *inflation* [1] too light, and by all sources."""
        steps = self.steps
        return self.random(inflation) + steps.T @ steps

    def end(self, column: int, distance: float, inflation: float) -> float | None:
        """The share of an unknown, a parameter's number *column*, from which its estimate lies -*distance* combined standard errors away.

        None where none is found. The step of Gauss-Newton from the truth to its estimate is normal whatever the course of the response
        between the two. Equation (comp-end).
        """
        here: LoopMinimum = self
        for stage in range(1, STAGES + 1):
            here, ended = here.at_distance(column, distance * stage / STAGES, inflation)
        aside = (here.u[column] - self.u[column]) * distance < 0
        return None if aside or not ended else float(here.u[column])

    def at_distance(self, column: int, distance: float, inflation: float) -> tuple[LoopMinimum, bool]:
        """The problem where the step to its estimate is *distance* combined standard errors of a parameter long, begun from here.

        At the edge of what a bearing can have, the problem there. False where the search did not end.
        """
        here: LoopMinimum = self
        for _ in range(MOST_STEPS):
            covariance = here.combined(inflation)
            error = float(np.sqrt(covariance[column, column]))
            move = steps_by(here.residual[None], here.jacobian, here.inverse)[0] + distance * covariance[:, column] / error
            there = here.moved(move)
            if there is None or abs(there.u[column] - here.u[column]) < CLOSE * error:
                return here, True
            here = there
        return here, False

    def moved(self, move: FloatArray) -> LoopMinimum | None:
        """The problem *move* (n_parameter,) [1] away, as much of it as is possible; None where nothing is."""
        for halving in range(MOST_HALVINGS):
            try:
                return LoopMinimum.of(self.problem, self.u + move / 2**halving)
            except ConfigError:
                continue
        return None

    def bent(self, covariance: FloatArray) -> FloatArray:
        """Second order over first order (n_unknown,) [1] of each unknown, REACH combined standard errors away.

        covariance (n_parameter, n_parameter) [1] of u, combined. Equation (comp-bent).
        """
        bends: FloatArray = np.zeros(len(self.problem.unknowns))
        errors = np.sqrt(np.diag(covariance))
        for column in range(bends.size):
            for sign in (1.0, -1.0):
                away = sign * REACH * covariance[:, column] / errors[column]
                try:
                    beyond = self.problem.residual(self.u + away) - self.residual - self.jacobian @ away
                except ConfigError:
                    return np.full(bends.size, np.inf)
                shift = steps_by(beyond[None], self.jacobian, self.inverse)[0]
                bends = np.maximum(bends, np.abs(shift / errors)[: bends.size] / REACH)
        return bends
