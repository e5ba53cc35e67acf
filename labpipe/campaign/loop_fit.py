"""The unknowns of a control loop fitted to measured responses, and whether the loop as it is stated explains them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from labpipe.optimise.levenberg import Minimum, minimise
from labpipe.records.finding import Finding
from labpipe.records.identification import Parameter

STEP = 1e-5
# Beyond this condition number of the scaled slopes, rounding decides what two unknowns are.
UNDETERMINED = 1e6


# The response that a file predicts on the measured lines, with the (stiffness, damping) of the support.
Predict = Callable[[MagneticFile, tuple[float, float]], ComplexArray]


@dataclass(frozen=True)
class Held:
    """A *measured* response that a loop is held against: what a *file* predicts for it, and the *support* beside the bearings."""

    measured: Measured
    predict: Predict
    file: MagneticFile
    support: Support = Support()


@dataclass(frozen=True)
class LoopFit:
    """Unknowns with their doubt, how well the loop explains the lines, and whether the lines tell the unknowns apart.

    *parameters*: unknowns, without doubt where *determined* is false; *correlations* (name, name, value); *chi2_reduced* with *chi2_p*
    of the whole residual on *lines*; *condition_number* of the unknowns' scaled slopes; *alike*: the unknowns that cannot be told apart.
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
    def known(self) -> bool:
        """Whether there are unknowns, and values of them that can be used."""
        return bool(self.parameters) and self.determined and self.converged

    def values(self) -> dict[str, float]:
        return {parameter.name: parameter.value for parameter in self.parameters}


@dataclass(frozen=True)
class _Problem:
    """Whitened residual of all responses over u: unknowns as shares of their start, then the support's deviations in standard errors."""

    held: tuple[Held, ...]
    unknowns: tuple[Unknown, ...]
    support: tuple[tuple[int, float], ...]  # (0 for stiffness or 1 for damping, standard error)

    @cached_property
    def weights(self) -> list[ComplexArray]:
        return [whitener(each.measured) for each in self.held]

    @property
    def size(self) -> float:
        pairs = zip(self.held, self.weights, strict=True)
        return float(np.linalg.norm(np.concatenate([whitened(weight, each.measured.matrix) for each, weight in pairs])))

    def file_values(self, u: FloatArray) -> dict[str, float]:
        return {each.name: each.value * (1 + float(share)) for each, share in zip(self.unknowns, u, strict=False)}

    def residual(self, u: FloatArray) -> FloatArray:
        """(n_equation,): measured less predicted, then how far the support is from what was stated."""
        away = u[len(self.unknowns) :]
        found = []
        for each, weight in zip(self.held, self.weights, strict=True):
            stated = each.support
            support = [stated.stiffness.value, stated.damping.value]
            for (which, error), deviation in zip(self.support, away, strict=True):
                support[which] += error * float(deviation)
            predicted = each.predict(with_unknowns(each.file, self.file_values(u)), (support[0], support[1]))
            found.append(whitened(weight, each.measured.matrix - predicted))
        return np.concatenate([*found, away])

    def jacobian(self, u: FloatArray) -> FloatArray:
        """(n_equation, n_parameter) by centred differences."""
        return np.column_stack([(self.residual(u + STEP * each) - self.residual(u - STEP * each)) / (2 * STEP) for each in np.eye(u.size)])

    def chi2(self, u: FloatArray) -> float:
        """Infinite for values that no bearing can have."""
        try:
            residual = self.residual(u)
        except ConfigError:
            return float("inf")
        return float(residual @ residual)


def loop_fit(held: Sequence[Held], names: Sequence[str]) -> LoopFit:
    """Output error of all responses weighted by their noise; the support's uncertainty is fitted along within what was stated.

    With no *names* it only judges the loop as it is stated. ConfigError for unknown names, FitError where the noise is not known or
    the descent does not end.
    """
    if not all(has_noise(each.measured) for each in held):
        hint = "average several periods or blocks"
        raise FitError("the noise of the response is not known, so a loop cannot be held against it", hint=hint)
    unknowns = tuple(unknown(held[0].file, name) for name in names)
    stated = held[0].support
    errors = ((0, stated.stiffness.std_error), (1, stated.damping.std_error))
    problem = _Problem(tuple(held), unknowns, tuple((which, error) for which, error in errors if error > 0))
    start = np.zeros(len(unknowns) + len(problem.support))
    # An unknown that acts on nothing has no slope to descend on.
    idle = not start.size or bool(_silent(problem, problem.jacobian(start)))
    return _judged(problem, Minimum(start, True, 0) if idle else minimise(problem, start))


def _silent(problem: _Problem, jacobian: FloatArray) -> tuple[str, ...]:
    """The unknowns that change nothing."""
    lengths = np.linalg.norm(jacobian, axis=0)
    return tuple(each.name for each, length in zip(problem.unknowns, lengths, strict=False) if not length > 0)


def _judged(problem: _Problem, minimum: Minimum) -> LoopFit:
    equations = sum(each.measured.n_equation for each in problem.held)
    dof = equations - len(problem.unknowns)
    doubt = weight_doubt(problem.held[0].measured, dof)
    reduced = problem.chi2(minimum.values) / dof / doubt.excess
    lines = sum(each.measured.omega.size for each in problem.held)
    fitted = _parameters(problem, minimum, doubt.inflation, dof) if problem.unknowns else ((), (), 1.0, ())
    return LoopFit(*fitted[:2], reduced, doubt.p_value(reduced, dof), lines, *fitted[2:], minimum.converged)


def _parameters(
    problem: _Problem, minimum: Minimum, inflation: float, dof: int
) -> tuple[tuple[Parameter, ...], tuple[tuple[str, str, float], ...], float, tuple[str, ...]]:
    """Unknowns with errors from (J^T J)^-1, their correlations, the condition number and the names behind it."""
    jacobian = problem.jacobian(minimum.values)
    n = len(problem.unknowns)
    silent = _silent(problem, jacobian)
    if silent:
        return _undoubted(problem, minimum), (), float("inf"), silent
    length = np.linalg.norm(jacobian, axis=0)
    _, singular, turn = np.linalg.svd(jacobian / length, full_matrices=False)
    condition = float(singular[0] / max(singular[-1], 1e-300))
    alike = tuple(each.name for each, part in zip(problem.unknowns, turn[-1], strict=False) if abs(part) > 0.3)
    if condition >= UNDETERMINED or not minimum.converged:
        return _undoubted(problem, minimum), (), condition, alike
    covariance = inflation * (turn.T / singular**2) @ turn / np.outer(length, length)
    errors = np.sqrt(np.diag(covariance))
    limit = student_limit(dof)
    found = [
        with_error(each.name, each.unit, float(each.value * (1 + share)), float(abs(each.value) * error), limit)
        for each, share, error in zip(problem.unknowns, minimum.values, errors, strict=False)
    ]
    names = [each.name for each in problem.unknowns]
    signs = np.sign([each.value for each in problem.unknowns])
    pairs = tuple(
        (names[i], names[j], float(signs[i] * signs[j] * covariance[i, j] / (errors[i] * errors[j]))) for i in range(n) for j in range(i)
    )
    return tuple(found), pairs, condition, alike


def _undoubted(problem: _Problem, minimum: Minimum) -> tuple[Parameter, ...]:
    """Where no doubt can be given: the values of the last step, without anything that looks like a result."""
    return tuple(
        Parameter(each.name, float(each.value * (1 + minimum.values[number])), each.unit) for number, each in enumerate(problem.unknowns)
    )


def goodness(fitted: LoopFit) -> list[Parameter]:
    """chi-square of all lines with its p-value, and how well the unknowns are told apart."""
    found = [Parameter("chi2_reduced", fitted.chi2_reduced, "1", derived=True), chance("chi2_p", fitted.chi2_p)]
    return [*found, Parameter("condition_number", fitted.condition_number, "1", derived=True)] if fitted.parameters else found


def apart(fitted: LoopFit) -> list[Finding]:
    """Warnings: unknowns that the lines do not tell apart, or hardly, or a fit that did not end."""
    if not fitted.parameters:
        return []
    together = " and ".join(fitted.alike)
    if not fitted.determined:
        what = f"{together} cannot be told apart by this response (condition number {fitted.condition_number:.2g}): no value is given doubt"
        return [Finding("collinear", f"{what}. Fit one of them, and state the other.")]
    if not fitted.converged:
        return [Finding("no-convergence", "the fit of the loop's unknowns did not end; its values are those of the last step")]
    if fitted.condition_number > COLLINEAR_CONDITION:
        what = f"{together} are hardly told apart (condition number {fitted.condition_number:.3g}, limit {COLLINEAR_CONDITION:g})"
        return [Finding("collinear", f"{what}: their errors are large and go together")]
    return []


def told(fitted: LoopFit) -> str:
    """How all lines fit the loop, as a sentence."""
    chance_of = f"chi² per degree of freedom {fitted.chi2_reduced:.3f}, p = {fitted.chi2_p:.2g}"
    said = f"All {fitted.lines} lines against the loop{' with its fitted unknowns' if fitted.parameters else ''}: {chance_of}."
    if fitted.parameters and not fitted.determined:
        said += f" {' and '.join(fitted.alike)} cannot be told apart, so none is given."
    return said
