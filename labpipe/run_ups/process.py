"""The joint fit times smooth factors: a Gaussian process of the deviation from the film's family, for a rejected joint fit.

Minimises |r|^2 + sum ((Omega_th - Omega_meas) / s)^2 + sum (p / prior)^2 + sum z^2 over the family's twelve parameters p and the fields'
z (see `process_field`), started at the joint fit. Size and lengths of the fields maximise the marginal likelihood of the responses,
linearised about the last minimum (Rasmussen and Williams 2006, section 5.4.1), times log-normal priors of these three (HYPER).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg, optimize

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.identify.systematic import explained, steps_by
from labpipe.optimise.levenberg import minimise
from labpipe.records.run_up import RunUp
from labpipe.rigs.film_family import PARAMETERS, PRIOR
from labpipe.rigs.run_up_rotor import RunUpRotor, searched_over
from labpipe.run_ups.joint import family_about
from labpipe.run_ups.joint_result import JointFit
from labpipe.run_ups.misfit import LoadRuns, rank_of, runs_by_load, sources_of
from labpipe.run_ups.problem import RunUpProblem, Thresholds, measured_thresholds, threshold_row
from labpipe.run_ups.process_field import ProcessFamily, SmoothField, SquaredExponential, places_of
from labpipe.run_ups.process_result import ProcessFit

# Medians and standard deviations of the logarithms of size, and of the lengths as parts of the ranges of load and speed.
HYPER = ((0.15, 0.5), (0.8, 0.4), (0.4, 0.4))
ROUNDS = 2
# Tolerance of a minimum, in standard errors: curved valleys converge slowly.
NEAR = 0.1
# Factor on the lengths, because only four of eight combinations are measured. On virtual rigs with arbitrary smooth factors
# the coefficients come nearer to the truth by a tenth to a third, and their intervals cover it; without it they are too narrow.
CAUTION = 0.7
SEARCH = {"xatol": 0.02, "fatol": 0.05, "maxfev": 120}


def fit_with_process(rig: RunUpRotor, runs: Iterable[RunUp], joint: JointFit | None = None, use_thresholds: bool = True) -> ProcessFit:
    """The fit with smooth factors on all eight coefficients, from a *joint* fit of the same runs or from the rotor file's bearing.

    FitError when no minimum is found.
    """
    runs = list(runs)
    rig = searched_over(rig, runs)
    groups = tuple(runs_by_load(rig, runs))
    thresholds = measured_thresholds(groups) if use_thresholds else ()
    places = _places(groups, thresholds)
    ranges = _ranges(places)
    family = joint.family if joint is not None else family_about(rig, groups)

    def problem_of(kernel: SquaredExponential) -> RunUpProblem[ProcessFamily]:
        field = SmoothField.of(kernel, places)
        spread = np.concatenate([PRIOR, np.ones(8 * field.n_mode)])
        return RunUpProblem.of(rig, ProcessFamily(family, field), groups, thresholds, spread)

    problem = problem_of(_kernel(np.log([median for median, _ in HYPER]), ranges))
    first = np.zeros(len(PARAMETERS)) if joint is None else joint.values
    values, steps = _minimum(problem, np.concatenate([first, np.zeros(8 * problem.family.field.n_mode)]))
    for _ in range(ROUNDS):
        linear = LinearData.at(problem, values, places)
        problem = problem_of(_likeliest(linear, places, ranges))
        values, more = _minimum(problem, _carried(values, linear.field, problem.family.field))
        steps += more
    return _result(problem, values, steps)


def _places(groups: tuple[LoadRuns, ...], thresholds: Thresholds) -> FloatArray:
    measured = [places_of(group.load, group.speed) for group in groups]
    return np.concatenate([*measured, *(places_of(load, np.array([speed.value])) for load, speed in thresholds)])


def _ranges(places: FloatArray) -> FloatArray:
    """Ranges of load and speed; of a single load the load itself."""
    extent = np.ptp(places, axis=0)
    return np.where(extent > 0, extent, places[0])


def _kernel(logarithms: FloatArray, ranges: FloatArray) -> SquaredExponential:
    size, load, speed = np.exp(logarithms)
    return SquaredExponential(float(size), float(load * ranges[0]), float(speed * ranges[1]))


def _minimum(problem: RunUpProblem[ProcessFamily], start: FloatArray) -> tuple[FloatArray, int]:
    minimum = minimise(problem, start, NEAR)
    if not minimum.converged:
        raise FitError("no minimum of the fit with smooth factors was found", hint="check unbalance, phases, standard errors, rotor file")
    return minimum.values, minimum.steps


def _carried(values: FloatArray, old: SmoothField, new: SmoothField) -> FloatArray:
    """The same fields in another basis, by least squares at the places of the data."""
    n = len(PARAMETERS)
    field = old.basis(old.places) @ values[n:].reshape(8, -1).T
    basis = new.basis(new.places)
    z = np.linalg.solve(basis.T @ basis + 1e-6 * new.kernel.size**2 * np.eye(new.n_mode), basis.T @ field)
    return np.concatenate([values[:n], z.T.ravel()])


@dataclass(frozen=True)
class LinearData:
    """Responses and thresholds, linear in the logarithms q (n_place, 8) [-] of the coefficients about a minimum: r = A q - y.

    normal (n_place, 8, 8) and side (n_place, 8): A^T A and A^T y; by_family (n_place, 8, 12): q by the family's parameters.
    """

    field: SmoothField
    normal: FloatArray
    side: FloatArray
    by_family: FloatArray

    @classmethod
    def at(cls, problem: RunUpProblem[ProcessFamily], values: FloatArray, places: FloatArray) -> LinearData:
        """Linearisation about parameters *values* (n_parameter,) [-], at the *places* (n_place, 2) [N, rad/s] of the data."""
        n = len(PARAMETERS)
        eight, slopes = problem.family.coefficients_and_slopes(values, places[:, 0], places[:, 1])
        by_family = slopes[..., :n] / eight[..., None]
        now = np.log(problem.family.factors(values, places[:, 0], places[:, 1])) + by_family @ values[:n]
        rows = _rows_by_place(problem, values, eight)
        normal = np.array([row.T @ row for _, row in rows])
        side = np.array([row.T @ (row @ here - residual) for (residual, row), here in zip(rows, now, strict=True)])
        return cls(problem.family.field, normal, side, by_family)

    def log_likelihood(self, field: SmoothField) -> float:
        """Log likelihood of the data under another field, up to a constant: b^T M^-1 b / 2 - ln det M / 2, M = 1 + B^T A^T A B."""
        basis = field.basis(field.places)
        scaled = self.by_family * PRIOR
        corner = np.einsum("pia,pij,pjb->ab", scaled, self.normal, scaled)
        beside = np.einsum("pia,pij,pm->ajm", scaled, self.normal, basis).reshape(len(PARAMETERS), -1)
        weighted = np.einsum("pij,pm->ijpm", self.normal, basis).reshape(64, basis.shape[0], -1)
        block = (weighted.swapaxes(1, 2) @ basis).reshape(8, 8, field.n_mode, field.n_mode).transpose(0, 2, 1, 3)
        matrix = np.block([[corner, beside], [beside.T, block.reshape(beside.shape[1], -1)]]) + np.eye(corner.shape[0] + beside.shape[1])
        side = np.concatenate([np.einsum("pia,pi->a", scaled, self.side), (self.side.T @ basis).ravel()])
        factor = np.linalg.cholesky(matrix)
        reduced = linalg.solve_triangular(factor, side, lower=True)
        return float(reduced @ reduced / 2 - np.sum(np.log(np.diag(factor))))


def _rows_by_place(problem: RunUpProblem[ProcessFamily], values: FloatArray, eight: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Residual (n_equation,) and its slopes by ln coefficients (n_equation, 8) at every place of the data."""
    rows, first = [], 0
    for group in problem.groups:
        group_eight = eight[first : first + group.speed.size]
        residual, slopes = group.residual_and_slopes(group_eight)
        rows += [(equations, slope * here) for equations, slope, here in zip(residual, slopes, group_eight, strict=True)]
        first += group.speed.size
    field = problem.family.field
    for number, (load, measured) in enumerate(problem.thresholds):
        threshold, by_parameter = threshold_row(problem.rig, problem.family, values, load, measured)
        # A slope by z is the slope by ln coefficients times b.
        place = field.basis(field.places[[first + number]])[0]
        by_z = by_parameter[len(PARAMETERS) :].reshape(8, field.n_mode)
        rows.append((np.array([threshold]), (by_z @ place / (place @ place))[None]))
    return rows


def _likeliest(linear: LinearData, places: FloatArray, ranges: FloatArray) -> SquaredExponential:
    median, deviation = (np.array(column) for column in zip(*HYPER, strict=True))

    def cost(parts: FloatArray) -> float:
        field = SmoothField.of(_kernel(np.log(median) + deviation * parts, ranges), places)
        return float(parts @ parts) / 2 - linear.log_likelihood(field)

    options: Any = {"initial_simplex": np.concatenate([np.zeros((1, 3)), np.eye(3)]), **SEARCH}
    search = optimize.minimize(cost, np.zeros(3), method="Nelder-Mead", options=options)
    likeliest = _kernel(np.log(median) + deviation * search.x, ranges)
    return SquaredExponential(likeliest.size, CAUTION * likeliest.load, CAUTION * likeliest.speed)


def _result(problem: RunUpProblem[ProcessFamily], values: FloatArray, steps: int) -> ProcessFit:
    slopes, spread = problem.measured_slopes(values), problem.spread
    covariance = np.linalg.inv(slopes.T @ slopes + np.diag(spread**-2.0))
    residual = problem.residual(values)[: slopes.shape[0]]
    rank, condition = rank_of(slopes * spread)
    singular = np.linalg.svd(slopes * spread, compute_uv=False)
    sources = sources_of(problem.groups)
    changes = problem.residual_changes(sources)
    return ProcessFit(
        rig=problem.rig,
        family=problem.family,
        loads=tuple(group.load for group in problem.groups),
        values=values,
        covariance=covariance,
        chi2=float(residual @ residual) - explained(residual, changes, slopes, covariance),
        n_datum=slopes.shape[0],
        n_effective=float(np.trace(covariance @ slopes.T @ slopes)),
        rank=int(rank),
        condition=float(condition),
        n_determined=int(np.sum(singular > 1)),
        steps=steps,
        sources=sources,
        systematic=steps_by(changes, slopes, covariance),
    )
