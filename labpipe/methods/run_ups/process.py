"""The joint fit times smooth factors: a Gaussian process of the deviation from the film's family.

g_i(W, Omega), i one of the eight coefficients, are independent with mean zero and the covariance

    k = s^2 exp(-((W - W') / l_W)^2 / 2 - ((Omega - Omega') / l_Omega)^2 / 2)

(Rasmussen and Williams 2006, eq. 5.1). Between the places of the data they are g_i = b(W, Omega) z_i, z of
unit variance a priori, b from the eigenvectors of k over these places; the rest of the variance is
*unexplained*.

The cost of the joint fit plus sum z^2 is minimised over its parameters and z. Size and lengths maximise the
marginal likelihood of the responses, linearised about the last minimum (section 5.4.1), times log-normal
priors (HYPER).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.estimation.descent import minimise
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.posterior import Problem
from labpipe.methods.run_ups import rotor
from labpipe.methods.run_ups.joint import (
    JointFit,
    RunUpFit,
    family_about,
    measured_thresholds,
    run_up_problem,
)
from labpipe.methods.run_ups.misfit import LoadRuns, runs_by_load
from labpipe.methods.run_ups.records import RunUp

# Eigenvalues of the covariance below this part of the largest are left to the unexplained variance.
LEAST_EIGENVALUE = 1e-7


@dataclass(frozen=True)
class SquaredExponential:
    """*size* s [-], *load* l_W [N] and *speed* l_Omega [rad/s]."""

    size: float
    load: float
    speed: float

    def covariance(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """k (n_first, n_second) [-] between places (n, 2) [N, rad/s]. Equation (run-field)."""
        difference = (first[:, None, :] - second[None, :, :]) / np.array([self.load, self.speed])
        return self.size**2 * np.exp(-0.5 * np.sum(difference**2, axis=-1))


@dataclass(frozen=True)
class SmoothField:
    """On *places* (n_place, 2) [N, rad/s] by a *kernel*; weights (n_place, n_mode): U / sqrt(eigenvalue)."""

    kernel: SquaredExponential
    places: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, kernel: SquaredExponential, places: FloatArray) -> SmoothField:
        """On the *places* (n_place, 2) [N, rad/s] of the data."""
        sizes, vectors = np.linalg.eigh(kernel.covariance(places, places))
        significant = sizes > LEAST_EIGENVALUE * sizes[-1]
        return cls(kernel, places, vectors[:, significant] / np.sqrt(sizes[significant]))

    @property
    def n_mode(self) -> int:
        return int(self.weights.shape[1])

    def basis(self, places: FloatArray) -> FloatArray:
        """b (n_point, n_mode) [-] at places (n_point, 2) [N, rad/s]. Equation (run-field-basis)."""
        return self.kernel.covariance(places, self.places) @ self.weights

    def residual_covariance(self, places: FloatArray) -> FloatArray:
        """Covariance (n_point, n_point) [-] beyond the basis, at places (n_point, 2) [N, rad/s]."""
        basis = self.basis(places)
        return self.kernel.covariance(places, places) - basis @ basis.T


@dataclass(frozen=True)
class ProcessFamily:
    """The coefficients of a *family* times exp(g_i); parameters: its twelve, then z (8, n_mode) by rows."""

    family: rotor.FilmFamily
    field: SmoothField

    def factors(self, values: FloatArray, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """exp(g), (n_point, 8) [-]."""
        basis = self.field.basis(places_of(load, speed))
        return np.exp(basis @ values[len(rotor.PARAMETERS) :].reshape(8, -1).T)

    def coefficients(self, values: FloatArray, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight COEFFICIENTS (n_point, 8) [N/m, N s/m]; FitError outside the bearing's table."""
        eight = self.family.coefficients(values[: len(rotor.PARAMETERS)], load, speed)
        return eight * self.factors(values, load, speed)

    def coefficients_and_slopes(
        self, values: FloatArray, load: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`coefficients` [N/m, N s/m] and their derivatives by all parameters, (n_point, 8, n_parameter)."""
        of_family = values[: len(rotor.PARAMETERS)]
        film_eight, by_family = self.family.coefficients_and_slopes(of_family, load, speed)
        factors = self.factors(values, load, speed)
        eight = film_eight * factors
        by_field = np.einsum("pi,ij,pm->pijm", eight, np.eye(8), self.field.basis(places_of(load, speed)))
        by_factors = by_field.reshape(*eight.shape, -1)
        return eight, np.concatenate([by_family * factors[..., None], by_factors], axis=-1)

    def at_load(self, values: FloatArray, load: float) -> CoefficientsAtSpeed:
        """K [N/m] and C [N s/m], (n_speed, 2, 2), as a function of speed [rad/s]."""
        return lambda speed: rotor.as_matrices(self.coefficients(values, load, speed))


def places_of(load: FloatArray | float, speed: FloatArray) -> FloatArray:
    """Places (n_point, 2) of loads [N] and speeds [rad/s]."""
    return np.stack(np.broadcast_arrays(load, speed), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class ProcessFit(RunUpFit[ProcessFamily]):
    """A RunUpFit with smooth factors."""

    @cached_property
    def n_determined(self) -> int:
        """Combinations that the data tell better than the priors do."""
        return int(np.sum(np.linalg.svd(self.in_priors, compute_uv=False) > 1))

    @property
    def kernel(self) -> SquaredExponential:
        """Of the smooth factors."""
        return self.model.field.kernel

    @property
    def statement(self) -> str:
        kernel = self.kernel
        return (
            f"smooth factors with a standard deviation of {100 * kernel.size:.0f} %, correlated over "
            f"{kernel.load:.2g} N and {kernel.speed / rotor.RPM:.0f} rpm, on the joint fit; of "
            f"{self.values.size} parameters the data determine "
            f"{self.n_determined} combinations better than these assumptions do"
        )

    def field_covariance(self, load: float, speed: FloatArray) -> FloatArray:
        """Covariance (n_speed, n_speed) [-] of the factors' logarithms beyond those of the parameters."""
        return self.model.field.residual_covariance(places_of(load, speed))

    def caution(self, load: float) -> str:
        """Warning on a *load* [N] beyond those of the fit, or empty."""
        outside = self.extrapolation_warning(load)
        return outside and (
            f"{outside}the smooth factors are extrapolated, and the interval assumes their correlation over "
            f"{self.kernel.load:.2g} N"
        )


# Medians and standard deviations of the logarithms of size, and of lengths over the ranges of load and speed.
HYPER = ((0.15, 0.5), (0.8, 0.4), (0.4, 0.4))
ROUNDS = 2
# Tolerance of a minimum, in standard errors: curved valleys converge slowly.
NEAR = 0.1
# Factor on the lengths, because only four of eight combinations are measured: without it intervals on virtual
# rigs are too narrow.
CAUTION = 0.7
SEARCH = {"xatol": 0.02, "fatol": 0.05, "maxfev": 120}


def fit_with_process(
    rig: rotor.RunUpRotor, runs: Iterable[RunUp], joint: JointFit | None = None, use_thresholds: bool = True
) -> ProcessFit:
    """The fit with smooth factors on all eight coefficients, from a *joint* fit of the same runs or the rotor
    file's bearing. FitError when no minimum is found.
    """
    runs = list(runs)
    rig = rotor.with_search_range(rig, runs)
    groups = tuple(runs_by_load(rig, runs))
    thresholds = measured_thresholds(rig, groups) if use_thresholds else ()
    measured = [places_of(group.load, group.speed) for group in groups]
    places = np.concatenate(
        [*measured, *(places_of(end.load, np.array([end.speed.value])) for end in thresholds)]
    )
    extent = np.ptp(places, axis=0)
    ranges = np.where(extent > 0, extent, places[0])
    family = joint.model if joint is not None else family_about(rig, [group.load for group in groups])

    def problem_of(kernel: SquaredExponential) -> Problem[ProcessFamily]:
        field = SmoothField.of(kernel, places)
        spread = np.concatenate([rotor.PRIOR, np.ones(8 * field.n_mode)])
        return run_up_problem(ProcessFamily(family, field), groups, thresholds, spread)

    problem = problem_of(_kernel(np.log([median for median, _ in HYPER]), ranges))
    first = np.zeros(len(rotor.PARAMETERS)) if joint is None else joint.values
    values, steps = _minimum(problem, np.concatenate([first, np.zeros(8 * problem.model.field.n_mode)]))
    for _ in range(ROUNDS):
        linear = LinearData.at(problem, values, places)
        problem = problem_of(_likeliest(linear, places, ranges))
        # The same fields in another basis, by least squares
        new = problem.model.field
        n = len(rotor.PARAMETERS)
        field = linear.field.basis(linear.field.places) @ values[n:].reshape(8, -1).T
        basis = new.basis(new.places)
        z = np.linalg.solve(basis.T @ basis + 1e-6 * new.kernel.size**2 * np.eye(new.n_mode), basis.T @ field)
        values, more = _minimum(problem, np.concatenate([values[:n], z.T.ravel()]))
        steps += more
    return ProcessFit(problem=problem, values=values, rig=rig, steps=steps)


def _kernel(logarithms: FloatArray, ranges: FloatArray) -> SquaredExponential:
    size, load, speed = np.exp(logarithms)
    return SquaredExponential(float(size), float(load * ranges[0]), float(speed * ranges[1]))


def _minimum(problem: Problem[ProcessFamily], start: FloatArray) -> tuple[FloatArray, int]:
    minimum = minimise(problem, start, NEAR)
    if not minimum.converged:
        hint = "check unbalance, phases, standard errors, rotor file"
        raise FitError("no minimum of the fit with smooth factors was found", hint=hint)
    return minimum.values, minimum.steps


@dataclass(frozen=True)
class LinearData:
    """Responses and thresholds r = A q - y, linear in the logarithms q (n_place, 8) [-] of the coefficients:
    normal (n_place, 8, 8) = A^T A, side (n_place, 8) = A^T y, by_family (n_place, 8, 12): q by its
    parameters.
    """

    field: SmoothField
    normal: FloatArray
    side: FloatArray
    by_family: FloatArray

    @classmethod
    def at(cls, problem: Problem[ProcessFamily], values: FloatArray, places: FloatArray) -> LinearData:
        """About parameters *values* (n_parameter,) [-], at *places* (n_place, 2) [N, rad/s]."""
        n = len(rotor.PARAMETERS)
        eight, slopes = problem.model.coefficients_and_slopes(values, places[:, 0], places[:, 1])
        by_family = slopes[..., :n] / eight[..., None]
        now = np.log(problem.model.factors(values, places[:, 0], places[:, 1])) + by_family @ values[:n]
        rows = rows_by_place(problem, values, eight)
        normal = np.array([row.T @ row for _, row in rows])
        side = np.array(
            [row.T @ (row @ here - residual) for (residual, row), here in zip(rows, now, strict=True)]
        )
        return cls(problem.model.field, normal, side, by_family)

    def log_likelihood(self, field: SmoothField) -> float:
        """Of the data under another field, but for a constant: b^T M^-1 b / 2 - ln det M / 2 with M = 1 + B^T
        A^T A B.
        """
        basis = field.basis(field.places)
        scaled = self.by_family * rotor.PRIOR
        corner = np.einsum("pia,pij,pjb->ab", scaled, self.normal, scaled)
        beside = np.einsum("pia,pij,pm->ajm", scaled, self.normal, basis).reshape(len(rotor.PARAMETERS), -1)
        weighted = np.einsum("pij,pm->ijpm", self.normal, basis).reshape(64, basis.shape[0], -1)
        split = (weighted.swapaxes(1, 2) @ basis).reshape(8, 8, field.n_mode, field.n_mode)
        block = split.transpose(0, 2, 1, 3).reshape(beside.shape[1], -1)
        matrix = np.block([[corner, beside], [beside.T, block]])
        matrix[np.diag_indices_from(matrix)] += 1
        side = np.concatenate([np.einsum("pia,pi->a", scaled, self.side), (self.side.T @ basis).ravel()])
        factor = np.linalg.cholesky(matrix)
        reduced = scipy.linalg.solve_triangular(factor, side, lower=True)
        return float(reduced @ reduced / 2 - np.sum(np.log(np.diag(factor))))


def rows_by_place(
    problem: Problem[ProcessFamily], values: FloatArray, eight: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Residuals (n,) [1] of every place, and their slopes (n, 8) [1] by the logarithms of its coefficients
    *eight* (n_place, 8) [SI]; *values* (n_parameter,) of the family.
    """
    rows, first = [], 0
    field = problem.model.field
    for test in problem.tests:
        if isinstance(test, LoadRuns):
            group_eight = eight[first : first + test.speed.size]
            residual, slopes = test.residual_and_slopes(group_eight)
            rows += list(zip(residual, slopes * group_eight[:, None], strict=True))
            first += test.speed.size
            continue
        threshold, by_parameter = test.residual(problem.model, values)
        # A slope by z is the slope by ln coefficients times b.
        place = field.basis(field.places[[first]])[0]
        by_z = by_parameter()[0, len(rotor.PARAMETERS) :].reshape(8, field.n_mode)
        rows.append((threshold, (by_z @ place / (place @ place))[None]))
        first += 1
    return rows


def _likeliest(linear: LinearData, places: FloatArray, ranges: FloatArray) -> SquaredExponential:
    median, deviation = (np.array(column) for column in zip(*HYPER, strict=True))

    def cost(parts: FloatArray) -> float:
        field = SmoothField.of(_kernel(np.log(median) + deviation * parts, ranges), places)
        return float(parts @ parts) / 2 - linear.log_likelihood(field)

    options: Any = {"initial_simplex": np.concatenate([np.zeros((1, 3)), np.eye(3)]), **SEARCH}
    search = scipy.optimize.minimize(cost, np.zeros(3), method="Nelder-Mead", options=options)
    likeliest = _kernel(np.log(median) + deviation * search.x, ranges)
    return SquaredExponential(likeliest.size, CAUTION * likeliest.load, CAUTION * likeliest.speed)
