"""Fit of a control loop's unknowns to measured responses, its end at an edge, and goodness of fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.display import chance_text
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.causes import stated_findings
from labpipe.estimation.descent import Minimum, linearise_problem, minimise
from labpipe.estimation.diagnostics import COLLINEAR_CONDITION, MISMATCH_P
from labpipe.estimation.statistics import SAYS_NOTHING, Pulls, correlation, steps_by, student_limit
from labpipe.estimation.weights import has_noise, weight_uncertainty
from labpipe.methods.magnetic_bearing.loop_problem import LoopObservation, LoopProblem, unknown
from labpipe.records.finding import Finding, Parameter
from labpipe.records.uncertain import Budget
from labpipe.uncertainty.amounts import chance, with_budget, with_error

# An unknown less than this share of its start value above zero is at the edge of what a bearing can have.
NEAR = 1e-2
# The share of its start value that makes an unknown zero.
ZERO = -1.0


@dataclass(frozen=True)
class HeldProblem:
    """The problem over its *free* parameters (n_parameter,), the others held at u (n_parameter,) [1]."""

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
        """Sum of squares [1] at the free parameters (n_free,) [1]; infinite for what no bearing can have."""
        return self.problem.chi2(self.whole(values))

    def minimum(self) -> Minimum:
        """All parameters at the least sum of squares over the free ones."""
        if not self.free.any():
            return Minimum(self.u, True, 0)
        end = minimise(self, self.u[self.free])
        return replace(end, values=self.whole(end.values))


def at_edge(problem: LoopProblem, u: FloatArray) -> BoolArray:
    """(n_parameter,): the unknowns that would go below zero if a bearing could; u (n_parameter,) [1]."""
    gradient = problem.jacobian(u).T @ problem.residual(u)
    at_zero = (u < ZERO + NEAR) & (gradient > 0) & (np.arange(u.size) < len(problem.unknowns))
    for number in np.flatnonzero(at_zero):
        below = u.copy()
        below[number] = ZERO - NEAR
        at_zero[number] = problem.residual_within(below) is None
    return at_zero


def along_the_edge(problem: LoopProblem, minimum: Minimum) -> Minimum:
    """The minimum with the unknowns at zero that a descent stopped at."""
    if minimum.converged:
        return minimum
    at_zero = at_edge(problem, minimum.values)
    if not at_zero.any():
        return minimum
    start = np.where(at_zero, ZERO, minimum.values)
    if problem.residual_within(start) is None:
        return minimum
    end = HeldProblem(problem, start, ~at_zero).minimum()
    # Left to itself an unknown that is held must still want to go below zero.
    stays = bool(np.all(at_edge(problem, end.values)[at_zero]))
    return Minimum(end.values, end.converged and stays, minimum.steps + end.steps)


# Condition number of the scaled Jacobian beyond which rounding determines the unknowns.
UNDETERMINED = 1e6
# Second order is looked for so many combined standard errors away.
REACH = 2.0
# An end of an interval is known to this share of a combined standard error, in so many steps, each halved so
# often to stay possible. It is approached in stages, so that none is far.
CLOSE, MOST_STEPS, MOST_HALVINGS, STAGES = 1e-2, 30, 12, 3


@dataclass(frozen=True)
class LoopMinimum:
    """The problem at the end *u* (n_parameter,) [1] of its descent. residual (n_equation,) [1], jacobian
    (n_equation, n_parameter) [1], inverse (n_parameter, n_parameter) [1] of J^T J.
    """

    problem: LoopProblem
    u: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    inverse: FloatArray

    @classmethod
    def of(cls, problem: LoopProblem, u: FloatArray) -> LoopMinimum:
        """The problem at u (n_parameter,) [1]."""
        jacobian = problem.jacobian(u)
        length = np.linalg.norm(jacobian, axis=0)
        length[length == 0] = 1.0
        _, singular, turn = np.linalg.svd(jacobian / length, full_matrices=False)
        # What the responses do not tell has no step.
        determined = singular > singular.max(initial=0.0) / UNDETERMINED
        inverse = (
            (turn[determined].T / singular[determined] ** 2) @ turn[determined] / np.outer(length, length)
        )
        return cls(problem, u, problem.residual(u), jacobian, inverse)

    def chi2(self, excess: float) -> float:
        n = self.residual.size - len(self.problem.sources)
        return float(self.residual[:n] @ self.residual[:n] / excess + self.residual[n:] @ self.residual[n:])

    @property
    def pulls(self) -> Pulls:
        """What the responses say of the numbers that were stated."""
        n = len(self.problem.unknowns)
        posterior = np.diag(self.inverse)[n:]
        by_data = 1 - posterior
        share = np.where(by_data > SAYS_NOTHING, by_data, np.inf)
        error = np.sqrt(np.maximum(posterior, 0.0) / np.maximum(by_data, SAYS_NOTHING**2))
        return Pulls(self.u[n:], self.u[n:] / share, error, 0.0)

    @property
    def steps(self) -> FloatArray:
        """Change (n_source, n_parameter) [1] of u by one standard uncertainty of every source."""
        return self.inverse[len(self.problem.unknowns) :]

    def random(self, inflation: float) -> FloatArray:
        """Covariance (n_parameter, n_parameter) [1] of u by noise, its weights *inflation* too light."""
        return inflation * (self.inverse - self.steps.T @ self.steps)

    def combined_covariance(self, inflation: float) -> FloatArray:
        """Covariance (n_parameter, n_parameter) [1] of u by noise and by all sources."""
        return self.random(inflation) + self.steps.T @ self.steps

    def end(self, column: int, distance: float, inflation: float) -> float | None:
        """The share of an unknown, a parameter's number *column*, from which its estimate lies -*distance*
        combined standard errors away. None where none is found. Equation (comp-end).
        """
        here: LoopMinimum = self
        for stage in range(1, STAGES + 1):
            here, ended = here.at_distance(column, distance * stage / STAGES, inflation)
        aside = (here.u[column] - self.u[column]) * distance < 0
        return None if aside or not ended else float(here.u[column])

    def at_distance(self, column: int, distance: float, inflation: float) -> tuple[LoopMinimum, bool]:
        """The problem where the step to its estimate is *distance* combined standard errors of a parameter
        long, begun from here.

        At the edge of what a bearing can have, the problem there. False where the search did not end.
        """
        here: LoopMinimum = self
        for _ in range(MOST_STEPS):
            covariance = here.combined_covariance(inflation)
            error = float(np.sqrt(covariance[column, column]))
            move = (
                steps_by(here.residual[None], here.jacobian, here.inverse)[0]
                + distance * covariance[:, column] / error
            )
            there = here.move(move)
            if there is None or abs(there.u[column] - here.u[column]) < CLOSE * error:
                return here, True
            here = there
        return here, False

    def move(self, move: FloatArray) -> LoopMinimum | None:
        """The problem *move* (n_parameter,) [1] away, as much of it as is possible."""
        for halving in range(MOST_HALVINGS):
            try:
                return LoopMinimum.of(self.problem, self.u + move / 2**halving)
            except ConfigError:
                continue
        return None

    def curvature(self, covariance: FloatArray) -> FloatArray:
        """Second over first order (n_unknown,) [1], REACH standard errors away. Equation (comp-bent)."""
        bends = np.zeros(len(self.problem.unknowns))
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


# Distance to the minimum in standard errors at which a descent that can go no further has ended.
SETTLED = 0.5
# Shares of first order above which second order is followed by intervals, and above which it is said.
CURVED, BENT = 0.1, 0.25


@dataclass(frozen=True, kw_only=True)
class LoopFit:
    """Unknowns with standard errors, goodness of fit, and identifiability.

    *parameters*: unknowns, without standard errors unless *determined*; *correlations* (name, name, value) by
    noise and sources; *chi2_reduced* with *chi2_p* of the residual on *lines*, without what systematic errors
    explain; *condition_number* of the scaled Jacobian; *alike*: unknowns that are not separately
    identifiable. covariance (n, n) [units of the unknowns]: by noise alone; budget: of the unknowns, None
    where no source moves them; bent: second over first order of each; at_zero: unknowns that fit best
    there; contradicted: findings on stated numbers that the responses contradict.
    """

    parameters: tuple[Parameter, ...]
    correlations: tuple[tuple[str, str, float], ...]
    chi2_reduced: float
    chi2_p: float
    lines: int
    condition_number: float
    alike: tuple[str, ...]
    converged: bool
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    budget: Budget | None = None
    bent: tuple[tuple[str, float], ...] = ()
    at_zero: tuple[str, ...] = ()
    contradicted: tuple[Finding, ...] = ()

    @property
    def determined(self) -> bool:
        return self.condition_number < UNDETERMINED

    @property
    def usable(self) -> bool:
        """True if there are unknowns with determined, converged values."""
        return bool(self.parameters) and self.determined and self.converged

    @property
    def changes(self) -> FloatArray:
        """Changes (n_source, n) [units of the unknowns] by the sources of the budget."""
        return np.zeros((0, len(self.parameters))) if self.budget is None else self.budget.changes

    def values(self) -> dict[str, float]:
        return {parameter.name: parameter.value for parameter in self.parameters}


# A step to where magnets outgrow all numbers is not taken.
@np.errstate(over="ignore", invalid="ignore")
def loop_fit(observations: Sequence[LoopObservation], names: Sequence[str]) -> LoopFit:
    """Output-error fit of all responses weighted by their noise; every number with an uncertainty, the
    support's among them, is fitted within it. Without *names* only the goodness of fit of the loop as it is.
    ConfigError for unknown names, FitError for responses without noise estimate. Equation (comp-loop).
    """
    if not all(has_noise(observation.measured) for observation in observations):
        what = "the noise of the response is not known, so a loop cannot be compared with it"
        raise FitError(what, hint="average several periods or blocks")
    unknowns = tuple(unknown(observations[0].file, name) for name in names)
    support = observations[0].support
    errors = enumerate((support.stiffness.std_error, support.damping.std_error))
    of_support = tuple((which, error) for which, error in errors if error > 0)
    problem = LoopProblem(tuple(observations), unknowns, of_support)
    start = problem.start
    if not np.isfinite(problem.chi2(start)):
        raise FitError("the loop outgrows all numbers", hint="check negative_stiffness and mass")
    if start.size and not _find_without_influence(problem, problem.jacobian(start)):
        return _loop_fit(problem, _settle(problem, along_the_edge(problem, minimise(problem, start))))
    # An unknown without influence on the response has no gradient.
    free = np.arange(start.size) >= len(unknowns)
    return _loop_fit(problem, HeldProblem(problem, start, free).minimum())


def _settle(problem: LoopProblem, minimum: Minimum) -> Minimum:
    """Converged as well where the descent ended within SETTLED standard errors. The current sampled when a
    held command arrives has a kink over the delay, where no step lowers chi-square further.
    """
    if minimum.converged:
        return minimum
    linear = linearise_problem(problem, minimum.values)
    left = float(np.linalg.norm(linear.projected)) / np.sqrt(linear.chi2 / linear.n_equation)
    return Minimum(minimum.values, left < SETTLED, minimum.steps)


def _find_without_influence(problem: LoopProblem, jacobian: FloatArray) -> tuple[str, ...]:
    lengths = np.linalg.norm(jacobian, axis=0)
    return tuple(
        entry.name for entry, length in zip(problem.unknowns, lengths, strict=False) if not length > 0
    )


def _loop_fit(problem: LoopProblem, minimum: Minimum) -> LoopFit:
    observations = problem.observations
    equations = sum(loop.measured.n_equation - loop.nuisance for loop in observations)
    dof = equations - len(problem.unknowns)
    measured = observations[0].measured
    # As many outputs as count: a complex unknown of every line takes one of them.
    taken = observations[0].nuisance // (2 * measured.omega.size)
    uncertainty = weight_uncertainty(replace(measured, matrix=measured.matrix[:, taken:]), dof)
    at_end = LoopMinimum.of(problem, minimum.values)
    reduced = at_end.chi2(uncertainty.excess) / dof
    # By the responses themselves: a source that is known better from elsewhere hides no unknown.
    condition, alike = _identifiable(problem, at_end.jacobian[:, : problem.n_shared])
    shares = list(zip(problem.unknowns, minimum.values, strict=False))
    whole = LoopFit(
        parameters=tuple(
            Parameter(entry.name, float(entry.value * (1 + share)), entry.unit) for entry, share in shares
        ),
        correlations=(),
        chi2_reduced=reduced,
        chi2_p=uncertainty.p_value(reduced, dof),
        lines=sum(loop.measured.omega.size for loop in observations),
        condition_number=condition,
        alike=alike,
        converged=minimum.converged,
        at_zero=tuple(entry.name for entry, share in shares if share == ZERO),
    )
    if not whole.at_zero:
        # An unknown that is held pulls at all numbers beside it.
        whole = replace(whole, contradicted=tuple(stated_findings(problem.sources, at_end.pulls, {})))
    if not whole.usable:
        return whole
    # What a model does not explain widens the intervals as if all noise were larger.
    misfit = max(reduced, 1.0) if whole.chi2_p < MISMATCH_P else 1.0
    curved = misfit == 1.0 or bool(whole.at_zero)
    return _with_errors(whole, at_end, misfit * uncertainty.inflation, dof, curved=curved)


def _identifiable(problem: LoopProblem, jacobian: FloatArray) -> tuple[float, tuple[str, ...]]:
    idle = _find_without_influence(problem, jacobian)
    if idle or not problem.unknowns:
        return float("inf") if idle else 1.0, idle
    _, singular, turn = np.linalg.svd(jacobian / np.linalg.norm(jacobian, axis=0), full_matrices=False)
    condition = float(singular[0] / max(singular[-1], 1e-300))
    return condition, tuple(
        entry.name for entry, part in zip(problem.unknowns, turn[-1], strict=False) if abs(part) > 0.3
    )


def _with_errors(fit: LoopFit, at_end: LoopMinimum, inflation: float, dof: int, *, curved: bool) -> LoopFit:
    """With errors by noise, changes by sources, and where *curved* ends that follow the response."""
    problem = at_end.problem
    n, values = len(problem.unknowns), np.array([entry.value for entry in problem.unknowns])
    random, steps = at_end.random(inflation), at_end.steps
    whole = at_end.combined_covariance(inflation)
    covariance = np.outer(values, values) * random[:n, :n]
    limit = student_limit(dof)
    plain = [
        with_error(parameter.name, parameter.unit, parameter.value, float(error), limit)
        for parameter, error in zip(fit.parameters, np.sqrt(np.diag(covariance)), strict=True)
    ]
    # A number that the responses contradict counts with its distance, in uncertainties of both: where they
    # say little of it, what they ask for is far off by chance.
    pulls = at_end.pulls
    changes = steps[:, :n] * values * np.where(pulls.far, pulls.sizes, 1.0)[:, None]
    first = {source.source: source for source in reversed(problem.sources)}
    rows = [changes[[origin.source == name for origin in problem.sources]].sum(axis=0) for name in first]
    of_sources = np.array(rows).reshape(len(first), n)
    parameters, budget = with_budget(plain, list(first.values()), of_sources, dof)
    related = correlation(np.outer(values, values) * whole[:n, :n])
    pairs = tuple((plain[i].name, plain[j].name, float(related[i, j])) for i in range(n) for j in range(i))
    bent = tuple((p.name, float(size)) for p, size in zip(plain, at_end.curvature(whole), strict=True))
    if curved and max(size for _, size in bent) > CURVED:
        at_zero = bool(fit.at_zero)
        parameters = tuple(
            _curve(parameter, at_end, number, inflation, limit, at_zero)
            for number, parameter in enumerate(parameters)
        )
    parameters = tuple(replace(p, at_bound=p.name in fit.at_zero) for p in parameters)
    return replace(
        fit, parameters=parameters, correlations=pairs, covariance=covariance, budget=budget, bent=bent
    )


def _curve(
    parameter: Parameter, at_end: LoopMinimum, number: int, inflation: float, limit: float, at_zero: bool
) -> Parameter:
    factor = parameter.coverage_factor or limit
    ends = [at_end.end(number, sign * factor, inflation) for sign in (-1.0, 1.0)]
    if ends[0] is None or ends[1] is None:
        return parameter
    start = at_end.problem.unknowns[number].value
    low, high = sorted(start * (1 + end) for end in ends if end is not None)
    if at_zero:
        # Beyond what a bearing can have no truth gives such data, and the ends meet: no less is stated than
        # to first order.
        reach = factor * (parameter.combined or parameter.full_error or 0.0)
        low = min(low, parameter.value - reach if parameter.value else 0.0)
        high = max(high, parameter.value + reach)
    return replace(parameter, ci95=(low, high), significant=not low <= 0 <= high)


def goodness(fit: LoopFit) -> list[Parameter]:
    """chi-square of all lines with its p-value, and the condition number of the unknowns."""
    amounts = [Parameter("chi2_reduced", fit.chi2_reduced, "1", derived=True), chance("chi2_p", fit.chi2_p)]
    if fit.parameters:
        amounts.append(Parameter("condition_number", fit.condition_number, "1", derived=True))
    return amounts


def identifiability_findings(fit: LoopFit) -> list[Finding]:
    """Warnings: unknowns hardly told apart, no convergence, an end at zero, errors beyond first order."""
    if not fit.parameters:
        return list(fit.contradicted)
    together, number = " and ".join(fit.alike), fit.condition_number
    if not fit.determined:
        what = f"{together} cannot be told apart by this response (condition number {number:.2g})"
        cure = "standard errors are omitted. Fit one of them, and state the other."
        return [Finding("collinear", f"{what}: {cure}")]
    if not fit.converged:
        what = "the fit of the loop's unknowns did not converge; its values are those of the last step"
        return [Finding("no-convergence", what)]
    findings = []
    if number > COLLINEAR_CONDITION:
        limit = f"condition number {number:.3g}, limit {COLLINEAR_CONDITION:g}"
        what = f"{together} are hardly told apart ({limit}): their errors are large and correlated"
        findings.append(Finding("collinear", what))
    if fit.at_zero:
        names = " and ".join(fit.at_zero)
        what = f"{names} would fit best below zero, which no bearing has, and is held at zero"
        cure = "correct delays and gains of the channels, or state their uncertainties"
        findings.append(Finding("at-bound", f"{what}: {cure}"))
    bent = " and ".join(name for name, size in fit.bent if size > BENT)
    if bent:
        largest = max(size for _, size in fit.bent)
        far = f"it bends by {100 * largest:.0f} % of the way"
        far = far if np.isfinite(largest) else "no bearing can have such values"
        what = (
            f"two standard errors away from the fitted {bent} the response is not linear in them ({far}): "
            "standard errors, and what the fitted loop says, are approximate; intervals of the unknowns "
            "follow the response itself, as far as it determines their ends"
        )
        findings.append(Finding("first-order", what))
    return [*findings, *fit.contradicted]


def fit_statement(fit: LoopFit) -> str:
    loop = "loop with its fitted unknowns" if fit.parameters else "loop"
    chance_of = f"chi² per degree of freedom {fit.chi2_reduced:.3f}, {chance_text(fit.chi2_p)}"
    statement = f"All {fit.lines} lines against the {loop}: {chance_of}."
    if fit.parameters and not fit.determined:
        statement += f" {' and '.join(fit.alike)} cannot be told apart, so none is given."
    return statement
