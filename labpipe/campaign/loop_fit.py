"""Fit of a control loop's unknowns to measured responses, and goodness of fit of the loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.campaign.amounts import chance, with_error
from labpipe.campaign.loop_file import Unknown, unknown, with_unknowns
from labpipe.errors import ConfigError, FitError
from labpipe.identify.diagnostics import COLLINEAR_CONDITION
from labpipe.identify.measured import Measured
from labpipe.identify.settings import Support
from labpipe.identify.statistics import student_limit
from labpipe.identify.weights import has_noise, weight_doubt, whitened, whitener
from labpipe.optimise.levenberg import Minimum, linearised, minimise
from labpipe.records.finding import Finding
from labpipe.records.identification import Parameter

STEP = 1e-5
# Condition number of the scaled Jacobian beyond which rounding determines the unknowns.
UNDETERMINED = 1e6
# Distance to the minimum in standard errors at which a descent that can go no further has ended.
SETTLED = 0.5


# Predicted response of a file on the measured lines, with the (stiffness, damping) of the support.
Predict = Callable[[MagneticFile, tuple[float, float]], ComplexArray]


@dataclass(frozen=True)
class LoopObservation:
    """A *measured* response of a loop, the prediction by a *file* on the same lines, and the *support* beside the bearings.

    *nuisance*: real numbers that the prediction takes from the measurement.
    """

    measured: Measured
    predict: Predict
    file: MagneticFile
    support: Support = Support()
    nuisance: int = 0


@dataclass(frozen=True, kw_only=True)
class LoopFit:
    """Unknowns with standard errors, goodness of fit, and identifiability.

    *parameters*: unknowns, without standard errors unless *determined*; *correlations* (name, name, value); *chi2_reduced* with *chi2_p*
    of the residual on *lines*; *condition_number* of the scaled Jacobian; *alike*: unknowns that are not separately identifiable.
    """

    parameters: tuple[Parameter, ...]
    correlations: tuple[tuple[str, str, float], ...]
    chi2_reduced: float
    chi2_p: float
    lines: int
    condition_number: float
    alike: tuple[str, ...]
    converged: bool

    @property
    def determined(self) -> bool:
        return self.condition_number < UNDETERMINED

    @property
    def usable(self) -> bool:
        """True if there are unknowns with determined, converged values."""
        return bool(self.parameters) and self.determined and self.converged

    def values(self) -> dict[str, float]:
        return {parameter.name: parameter.value for parameter in self.parameters}


@dataclass(frozen=True)
class _Problem:
    """Whitened residual of all responses over u: unknowns as shares of their start, then the support's deviations in standard errors."""

    observations: tuple[LoopObservation, ...]
    unknowns: tuple[Unknown, ...]
    support: tuple[tuple[int, float], ...]  # (0 for stiffness or 1 for damping, standard error)

    @cached_property
    def weights(self) -> list[ComplexArray]:
        return [whitener(observation.measured) for observation in self.observations]

    @property
    def size(self) -> float:
        pairs = zip(self.observations, self.weights, strict=True)
        return float(np.linalg.norm(np.concatenate([whitened(weight, loop.measured.matrix) for loop, weight in pairs])))

    def file_values(self, u: FloatArray) -> dict[str, float]:
        return {entry.name: entry.value * (1 + float(share)) for entry, share in zip(self.unknowns, u, strict=False)}

    def residual(self, u: FloatArray) -> FloatArray:
        """(n_equation,): measured minus predicted, then the support's deviations from its nominal values."""
        deviations = u[len(self.unknowns) :]
        residuals = []
        for observation, weight in zip(self.observations, self.weights, strict=True):
            nominal = observation.support
            support = [nominal.stiffness.value, nominal.damping.value]
            for (which, error), deviation in zip(self.support, deviations, strict=True):
                support[which] += error * float(deviation)
            predicted = observation.predict(with_unknowns(observation.file, self.file_values(u)), (support[0], support[1]))
            residuals.append(whitened(weight, observation.measured.matrix - predicted))
        return np.concatenate([*residuals, deviations])

    def jacobian(self, u: FloatArray) -> FloatArray:
        """(n_equation, n_parameter) by centred differences."""
        steps = STEP * np.eye(u.size)
        return np.column_stack([(self.residual(u + step) - self.residual(u - step)) / (2 * STEP) for step in steps])

    def chi2(self, u: FloatArray) -> float:
        """Sum of squares; infinite for values that no bearing can have."""
        try:
            residual = self.residual(u)
        except ConfigError:
            return float("inf")
        return float(residual @ residual)


def loop_fit(observations: Sequence[LoopObservation], names: Sequence[str]) -> LoopFit:
    """Output-error fit of all responses weighted by their noise; the support is fitted as well, within its uncertainty.

    Without *names* only the goodness of fit of the loop as it is. ConfigError for unknown names, FitError for responses without noise
    estimate. Equation (comp-loop).
    """
    if not all(has_noise(observation.measured) for observation in observations):
        hint = "average several periods or blocks"
        raise FitError("the noise of the response is not known, so a loop cannot be compared with it", hint=hint)
    unknowns = tuple(unknown(observations[0].file, name) for name in names)
    support = observations[0].support
    errors = ((0, support.stiffness.std_error), (1, support.damping.std_error))
    problem = _Problem(tuple(observations), unknowns, tuple((which, error) for which, error in errors if error > 0))
    start = np.zeros(len(unknowns) + len(problem.support))
    # An unknown without influence on the response has no gradient.
    idle = not start.size or bool(_without_influence(problem, problem.jacobian(start)))
    return _loop_fit(problem, Minimum(start, True, 0) if idle else _settled(problem, minimise(problem, start)))


def _settled(problem: _Problem, minimum: Minimum) -> Minimum:
    """Converged as well where the descent ended within SETTLED standard errors.

    The current sampled when a held command arrives has a kink over the delay, where no step lowers chi-square further.
    """
    if minimum.converged:
        return minimum
    linear = linearised(problem, minimum.values)
    left = float(np.linalg.norm(linear.projected)) / np.sqrt(linear.chi2 / linear.n_equation)
    return Minimum(minimum.values, left < SETTLED, minimum.steps)


def _without_influence(problem: _Problem, jacobian: FloatArray) -> tuple[str, ...]:
    """Unknowns without influence on the response."""
    lengths = np.linalg.norm(jacobian, axis=0)
    return tuple(entry.name for entry, length in zip(problem.unknowns, lengths, strict=False) if not length > 0)


def _loop_fit(problem: _Problem, minimum: Minimum) -> LoopFit:
    equations = sum(observation.measured.n_equation - observation.nuisance for observation in problem.observations)
    dof = equations - len(problem.unknowns)
    doubt = weight_doubt(_weighed(problem.observations[0]), dof)
    reduced = problem.chi2(minimum.values) / dof / doubt.excess
    lines = sum(observation.measured.omega.size for observation in problem.observations)
    estimates = _parameters(problem, minimum, doubt.inflation, dof) if problem.unknowns else ((), (), 1.0, ())
    parameters, correlations, condition, alike = estimates
    return LoopFit(
        parameters=parameters,
        correlations=correlations,
        chi2_reduced=reduced,
        chi2_p=doubt.p_value(reduced, dof),
        lines=lines,
        condition_number=condition,
        alike=alike,
        converged=minimum.converged,
    )


def _weighed(observation: LoopObservation) -> Measured:
    """The measurement with as many outputs as count: a complex unknown of every line takes one of them."""
    taken = observation.nuisance // (2 * observation.measured.omega.size)
    return replace(observation.measured, matrix=observation.measured.matrix[:, taken:]) if taken else observation.measured


def _parameters(
    problem: _Problem, minimum: Minimum, inflation: float, dof: int
) -> tuple[tuple[Parameter, ...], tuple[tuple[str, str, float], ...], float, tuple[str, ...]]:
    """Unknowns with standard errors from (J^T J)^-1, their correlations, the condition number and the unknowns that cause it."""
    jacobian = problem.jacobian(minimum.values)
    n = len(problem.unknowns)
    idle = _without_influence(problem, jacobian)
    if idle:
        return _last_step(problem, minimum), (), float("inf"), idle
    length = np.linalg.norm(jacobian, axis=0)
    _, singular, turn = np.linalg.svd(jacobian / length, full_matrices=False)
    condition = float(singular[0] / max(singular[-1], 1e-300))
    alike = tuple(entry.name for entry, part in zip(problem.unknowns, turn[-1], strict=False) if abs(part) > 0.3)
    if condition >= UNDETERMINED or not minimum.converged:
        return _last_step(problem, minimum), (), condition, alike
    covariance = inflation * (turn.T / singular**2) @ turn / np.outer(length, length)
    errors = np.sqrt(np.diag(covariance))
    limit = student_limit(dof)
    parameters = [
        with_error(entry.name, entry.unit, float(entry.value * (1 + share)), float(abs(entry.value) * error), limit)
        for entry, share, error in zip(problem.unknowns, minimum.values, errors, strict=False)
    ]
    names = [entry.name for entry in problem.unknowns]
    signs = np.sign([entry.value for entry in problem.unknowns])
    pairs = tuple(
        (names[i], names[j], float(signs[i] * signs[j] * covariance[i, j] / (errors[i] * errors[j]))) for i in range(n) for j in range(i)
    )
    return tuple(parameters), pairs, condition, alike


def _last_step(problem: _Problem, minimum: Minimum) -> tuple[Parameter, ...]:
    """The values of the last step without standard errors."""
    return tuple(
        Parameter(entry.name, float(entry.value * (1 + minimum.values[number])), entry.unit)
        for number, entry in enumerate(problem.unknowns)
    )


def goodness(fit: LoopFit) -> list[Parameter]:
    """chi-square of all lines with its p-value, and the condition number of the unknowns."""
    amounts = [Parameter("chi2_reduced", fit.chi2_reduced, "1", derived=True), chance("chi2_p", fit.chi2_p)]
    return [*amounts, Parameter("condition_number", fit.condition_number, "1", derived=True)] if fit.parameters else amounts


def identifiability_findings(fit: LoopFit) -> list[Finding]:
    """Warnings: unknowns that are not, or hardly, separately identifiable, or a fit without convergence."""
    if not fit.parameters:
        return []
    together = " and ".join(fit.alike)
    if not fit.determined:
        what = (
            f"{together} cannot be told apart by this response (condition number {fit.condition_number:.2g}): standard errors are omitted"
        )
        return [Finding("collinear", f"{what}. Fit one of them, and state the other.")]
    if not fit.converged:
        return [Finding("no-convergence", "the fit of the loop's unknowns did not converge; its values are those of the last step")]
    if fit.condition_number > COLLINEAR_CONDITION:
        what = f"{together} are hardly told apart (condition number {fit.condition_number:.3g}, limit {COLLINEAR_CONDITION:g})"
        return [Finding("collinear", f"{what}: their errors are large and correlated")]
    return []


def fit_statement(fit: LoopFit) -> str:
    """Goodness of fit of all lines as a sentence."""
    chance_of = f"chi² per degree of freedom {fit.chi2_reduced:.3f}, p = {fit.chi2_p:.2g}"
    statement = f"All {fit.lines} lines against the loop{' with its fitted unknowns' if fit.parameters else ''}: {chance_of}."
    if fit.parameters and not fit.determined:
        statement += f" {' and '.join(fit.alike)} cannot be told apart, so none is given."
    return statement
