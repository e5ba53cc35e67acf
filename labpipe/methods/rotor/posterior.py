"""What was measured on a rotor, with priors, as one sum of squares over the unknowns of a model, and the
normal posterior about its minimum.

The model is the rotor with all that carries it, or the coefficients of its one bearing over load and speed;
every test is an evidence: a weighted residual of that model with its derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.estimation.descent import sum_of_squares

Model = TypeVar("Model")
Predicted = TypeVar("Predicted", contravariant=True)
# A residual, and what computes its Jacobian, which only the steps of a descent that are kept need.
Residual = tuple[FloatArray, Callable[[], FloatArray]]
# Relative singular value that counts as zero: far above rounding, far below measured sensitivities.
RANK_TOLERANCE = 1e-7


class ResidualEvidence(Protocol[Predicted]):
    """What was measured, as the weighted residual (n,) [1] of a model with its Jacobian (n, n_unknown)."""

    def residual(self, model: Predicted, values: FloatArray) -> Residual:
        """Residual (n,) [1] at *values* (n_unknown,), and what computes its Jacobian (n, n_unknown) [1 over
        the unknown's unit].
        """
        ...


@dataclass(frozen=True)
class Problem(Generic[Model]):
    """Residuals of the *tests* of a *model* and of the priors N(*means*, *errors*^2) (n_unknown,) [unit of
    each] of its unknowns, to be minimised over the *free* ones (n_unknown,); the others stay at *base*
    (n_unknown,).

    moved: added to the residual [1]. size: signal-to-noise ratio of all tests together.
    """

    model: Model
    tests: tuple[ResidualEvidence[Model], ...]
    means: FloatArray
    errors: FloatArray
    free: BoolArray
    base: FloatArray
    moved: FloatArray | float = 0.0
    size: float = 1.0

    def whole(self, parameters: FloatArray) -> FloatArray:
        """All unknowns (n_unknown,) [unit of each] from the free ones (n_free,)."""
        values = self.base.copy()
        values[self.free] = parameters
        return values

    @cached_property
    def _last(self) -> dict[bytes, list[Residual]]:
        return {}

    def parts(self, values: FloatArray) -> list[Residual]:
        """Residual (n,) [1] and what gives the Jacobian (n, n_unknown) of every test at *values*
        (n_unknown,).
        """
        key = values.tobytes()
        if key not in self._last:
            parts = (test.residual(self.model, values) for test in self.tests)
            self._last.clear()
            self._last[key] = [(residual, cache(jacobian)) for residual, jacobian in parts]
        return self._last[key]

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Residual (n_equation,) [1] of tests and priors at the free unknowns (n_free,). Equation
        (run-joint).
        """
        values = self.whole(parameters)
        prior = (values - self.means) / self.errors
        return np.concatenate([*(part for part, _ in self.parts(values)), prior]) + self.moved

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivatives (n_equation, n_free) [1 over the unknown's unit] of the residual."""
        slopes = [part() for _, part in self.parts(self.whole(parameters))]
        return np.concatenate([*slopes, np.diag(1 / self.errors)])[:, self.free]

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [1] at the free unknowns (n_free,); infinite where there is no residual."""
        return sum_of_squares(self.residual, parameters)


@dataclass(frozen=True, kw_only=True)
class Posterior(Generic[Model]):
    """N(*values* (n_unknown,), covariance) [unit of each] about the minimum of a *problem*."""

    problem: Problem[Model]
    values: FloatArray

    @property
    def model(self) -> Model:
        return self.problem.model

    @property
    def errors(self) -> FloatArray:
        """Standard uncertainties (n_unknown,) [unit of each] of the priors as they were used."""
        return self.problem.errors

    @cached_property
    def by_test(self) -> list[tuple[FloatArray, FloatArray]]:
        """Residual (n,) [1] and slopes (n, n_free) by the free unknowns [1 over the unknown's unit] of every
        test.
        """
        free = self.problem.free
        return [(residual, slopes()[:, free]) for residual, slopes in self.problem.parts(self.values)]

    @property
    def residual(self) -> FloatArray:
        """Of all tests, (n_datum,) [1]."""
        return np.concatenate([part for part, _ in self.by_test])

    @property
    def slopes(self) -> FloatArray:
        """Of that residual by the free unknowns, (n_datum, n_free) [1 over the unknown's unit]."""
        return np.concatenate([part for _, part in self.by_test])

    @cached_property
    def _information(self) -> FloatArray:
        information = np.diag(self.errors[self.problem.free] ** -2.0)
        for _, slopes in self.by_test:
            information = information + slopes.T @ slopes
        return information

    @cached_property
    def free_covariance(self) -> FloatArray:
        """(sum J^T J + P)^-1 of the free unknowns, (n_free, n_free) [products of their units]."""
        scale = np.sqrt(np.diag(self._information))
        covariance = np.linalg.inv(self._information / np.outer(scale, scale)) / np.outer(scale, scale)
        return (covariance + covariance.T) / 2

    @cached_property
    def covariance(self) -> FloatArray:
        """Of all unknowns, (n_unknown, n_unknown) [products of their units], zero where one is held."""
        free, whole = self.problem.free, np.zeros((self.values.size,) * 2)
        whole[np.ix_(free, free)] = self.free_covariance
        return whole

    @property
    def n_datum(self) -> int:
        return sum(residual.size for residual, _ in self.by_test)

    @property
    def n_effective(self) -> float:
        """Number of unknowns that the tests determine against the priors, tr(V J^T J) [1]."""
        return float(np.trace(self.free_covariance @ self.slopes.T @ self.slopes))

    @property
    def in_priors(self) -> FloatArray:
        """The slopes in units of the priors, (n_datum, n_free) [1]."""
        return self.slopes * self.errors[self.problem.free]

    @property
    def rank(self) -> int:
        """Number of directions that the tests tell at all, whatever the priors."""
        return int(rank_of(self.in_priors)[0])

    @property
    def condition(self) -> float:
        """Condition number [1] of the tests within that rank, in units of the priors."""
        return float(rank_of(self.in_priors)[1])

    @property
    def ln_evidence(self) -> float:
        """Logarithm of the probability of the data under model and priors, up to a constant of the data:
        -chi^2 / 2 - sum ln u - ln det(V^-1) / 2, chi^2 with the priors (MacKay 1992).
        """
        off = float(np.sum(((self.values - self.problem.means) / self.errors) ** 2))
        cost = off + sum(float(residual @ residual) for residual, _ in self.by_test)
        return (
            -cost / 2
            - float(np.sum(np.log(self.errors)))
            - float(np.linalg.slogdet(self._information)[1]) / 2
        )


def root_of(covariance: FloatArray) -> FloatArray:
    """R (n, n) of a *covariance* R R^T (n, n) [products of units]: a column along each of its axes, in the
    units of the standard deviations.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    sizes, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0))


def rank_of(slopes: FloatArray) -> tuple[IntArray, FloatArray]:
    """Rank (...) and condition number (...) [-] within that rank of Jacobians (..., n_equation, n_parameter).
    Equation (run-rank).
    """
    singular = np.linalg.svd(slopes, compute_uv=False)
    rank = (singular > RANK_TOLERANCE * singular[..., :1]).sum(axis=-1)
    smallest = np.take_along_axis(singular, rank[..., None] - 1, axis=-1)[..., 0]
    return rank, singular[..., 0] / smallest
