"""One fit of the film's twelve physical parameters to all complex responses at all loads and speeds, and to the measured thresholds.

Minimises |r|^2 + sum ((Omega_th - Omega_meas) / s)^2 + sum (p / prior)^2 by Levenberg-Marquardt with analytic slopes; r is the residual of
the responses over their standard errors. Thresholds are followed by Newton's method from the measured ones, their slopes by the modes'
left and right eigenvectors; the priors hold what no run-up can tell (see `unbalance_film`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import FitError
from labpipe.optimise.levenberg import minimise, sum_of_squares
from labpipe.records.run_up import RunUp
from labpipe.records.settings import Uncertain
from labpipe.rigs.film_family import BOUND, PARAMETERS, PRIOR, FilmFamily, as_matrices
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.rotors.modes import GROWTH_TOLERANCE
from labpipe.rotors.threshold import CoefficientsAtSpeed
from labpipe.run_ups.joint_result import JointFit
from labpipe.run_ups.misfit import LoadRuns, in_words, rank_of, runs_by_load

MOST_SEARCHES = 25
SEARCH_TOLERANCE = 1e-9
# Half-width of the difference that gives the slope of the growth rate by speed, as a part of the speed.
SPEED_STEP = 1e-3
# Least slope [1/s per rad/s]: a growth rate that hardly changes says little about the speed.
LEAST_SLOPE = 1e-4
# Reference of the slopes of the viscosity.
REFERENCE_SPEED = 50 * np.pi
MOST_REFITS = 12
# Distance to a minimum, in standard errors, that does where the steps get small too slowly: a bearing far outside the family.
NEAR = 0.05

Array = NDArray[np.floating]


class CoefficientFamily(Protocol):
    """Coefficients over load and speed with parameters."""

    def coefficients_and_slopes(self, values: Array, load: Array, speed: Array) -> tuple[Array, Array]: ...
    def at_load(self, values: Array, load: float) -> CoefficientsAtSpeed: ...


@dataclass(frozen=True)
class JointProblem:
    """Residual and slopes of everything measured and of the priors; *free* (12,): parameters that are fitted, the others at *fixed*."""

    rig: RunUpRotor
    family: FilmFamily
    groups: tuple[LoadRuns, ...]
    thresholds: tuple[tuple[float, Uncertain], ...]
    free: NDArray[np.bool_]
    fixed: Array

    @property
    def size(self) -> float:
        """Signal over noise of all responses."""
        parts = (run.run.response / run.run.amplitude_error for group in self.groups for run in group.runs)
        return float(np.sqrt(sum(float(np.sum(np.abs(part) ** 2)) for part in parts)))

    def values(self, parameters: Array) -> Array:
        """All twelve from the free ones."""
        values = self.fixed.copy()
        values[self.free] = parameters
        return values

    def residual(self, parameters: Array) -> Array:
        values = self.values(parameters)
        measured = [self._response(group, values)[0] for group in self.groups]
        return np.concatenate([*measured, self._thresholds(values)[0], values / PRIOR])

    def jacobian(self, parameters: Array) -> Array:
        return np.concatenate([self.data_slopes(parameters), np.diag(1 / PRIOR)[:, self.free]])

    def data_slopes(self, parameters: Array) -> Array:
        """Of responses and thresholds by the free parameters, without the priors."""
        values = self.values(parameters)
        measured = [self._response(group, values)[1] for group in self.groups]
        return np.concatenate([*measured, self._thresholds(values)[1]])[:, self.free]

    def chi2(self, parameters: Array) -> float:
        return sum_of_squares(self.residual, parameters)

    def _response(self, group: LoadRuns, values: Array) -> tuple[Array, Array]:
        eight, by_parameter = self.family.coefficients_and_slopes(values, np.full(group.speed.size, group.load), group.speed)
        residual, slopes = group.residual_and_slopes(eight)
        return residual.ravel(), (slopes @ by_parameter).reshape(-1, len(PARAMETERS))

    def _thresholds(self, values: Array) -> tuple[Array, Array]:
        rows = [threshold_row(self.rig, self.family, values, load, measured) for load, measured in self.thresholds]
        residual = np.array([row[0] for row in rows])
        return residual, np.array([row[1] for row in rows]).reshape(-1, len(PARAMETERS))


def threshold_row(rig: RunUpRotor, family: CoefficientFamily, values: Array, load: float, measured: Uncertain) -> tuple[float, Array]:
    """(Omega_th - Omega_meas) / s and its slopes (n_parameter,): d Omega_th = -d growth / (d growth / d Omega) at the threshold itself.

    FitError where the search from the measured speed finds none.
    """
    speed, by_speed = nearby_threshold(rig, family.at_load(values, load), measured.value)
    eight, by_parameter = family.coefficients_and_slopes(values, np.array([load]), np.array([speed]))
    stiffness, damping = as_matrices(eight)
    mode = rig.stability.least_stable(speed, stiffness[0], damping[0])
    slopes = np.concatenate([mode.by_stiffness.ravel(), mode.by_damping.ravel()]) @ by_parameter[0]
    return (speed - measured.value) / measured.std_error, -slopes / (by_speed * measured.std_error)


def nearby_threshold(rig: RunUpRotor, coefficients: CoefficientsAtSpeed, start: float) -> tuple[float, float]:
    """The threshold [rad/s] by Newton's method from *start*, and the slope of the growth rate by speed there [1/s per rad/s]."""
    speed = start
    for _ in range(MOST_SEARCHES):
        around = speed * np.array([1 - SPEED_STEP, 1.0, 1 + SPEED_STEP])
        before, here, after = rig.stability.growth(around, *coefficients(around)).tolist()
        by_speed = (after - before) / (2 * SPEED_STEP * speed)
        if by_speed < LEAST_SLOPE:
            break
        step = (here - GROWTH_TOLERANCE) / by_speed
        if abs(step) < SEARCH_TOLERANCE * start:
            return speed - step, by_speed
        speed = float(np.clip(speed - step, 0.7 * speed, 1.4 * speed))
    raise FitError("the computed threshold of instability is far from the measured one", hint="check load, unit of speed and rotor file")


def family_about(rig: RunUpRotor, groups: Iterable[LoadRuns]) -> FilmFamily:
    """The family about the rotor file's bearing, its slopes about the middle of the loads."""
    return FilmFamily(rig.place.bearing, REFERENCE_SPEED, float(np.exp(np.mean([np.log(group.load) for group in groups]))))


def fit_jointly(rig: RunUpRotor, runs: Iterable[RunUp], use_thresholds: bool = True) -> JointFit:
    """The twelve parameters from all runs; parameters that run into their bounds (`BOUND`) stay there and have no standard error.

    FitError when no minimum is found.
    """
    groups = tuple(runs_by_load(rig, runs))
    family = family_about(rig, groups)
    measured = tuple((group.load, run.run.threshold) for group in groups for run in group.runs if run.run.threshold is not None)
    n = len(PARAMETERS)
    problem = JointProblem(rig, family, groups, measured if use_thresholds else (), np.ones(n, bool), np.zeros(n))
    for _ in range(MOST_REFITS):
        minimum = minimise(problem, problem.values(problem.fixed[problem.free])[problem.free])
        if not minimum.converged:
            minimum = minimise(problem, minimum.values, NEAR)
        if not minimum.converged:
            break
        values = problem.values(minimum.values)
        beyond = np.abs(values) > BOUND * (1 + 1e-9)
        if not np.any(beyond):
            return _result(problem, minimum.values, minimum.steps)
        fixed = np.clip(values, -BOUND, BOUND)
        problem = JointProblem(rig, family, groups, problem.thresholds, problem.free & ~beyond, fixed)
    raise FitError("no minimum of the joint fit was found", hint="check unbalance, phases, standard errors and the rotor file")


def _result(problem: JointProblem, parameters: Array, steps: int) -> JointFit:
    slopes, prior = problem.data_slopes(parameters), PRIOR[problem.free]
    covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    own = np.linalg.inv(slopes.T @ slopes + np.diag(prior**-2.0))
    covariance[np.ix_(problem.free, problem.free)] = own
    residual = problem.residual(parameters)[: slopes.shape[0]]
    rank, condition = rank_of(slopes * prior)
    n_threshold = len(problem.thresholds)
    return JointFit(
        problem.rig,
        problem.family,
        tuple(group.load for group in problem.groups),
        problem.values(parameters),
        covariance,
        ~problem.free,
        float(residual @ residual),
        slopes.shape[0],
        float(np.trace(own @ slopes.T @ slopes)),
        float(np.sum(residual[residual.size - n_threshold :] ** 2)),
        n_threshold,
        int(rank),
        float(condition),
        _held_by_priors(slopes * prior, problem.free),
        steps,
    )


def _held_by_priors(scaled: Array, free: NDArray[np.bool_]) -> tuple[str, ...]:
    """Combinations (logarithms, in units of the priors) that the data say less about than the priors do, the worst first."""
    names = [name for name, kept in zip(PARAMETERS, free, strict=True) if kept]
    _, singular, rows = np.linalg.svd(scaled, full_matrices=False)
    weight = PRIOR[free]
    return tuple(in_words(names, row * weight, 0.1) for row, size in list(zip(rows, singular, strict=True))[::-1] if size < 1)
