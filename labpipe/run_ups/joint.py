"""One fit of the film's twelve physical parameters to all complex responses at all loads and speeds, and to the measured thresholds.

By Levenberg-Marquardt with analytic slopes (see `problem`); priors determine the combinations that run-ups do not (see `film_family`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import FitError
from labpipe.identify.combinations import combination_text
from labpipe.identify.systematic import explained, steps_by
from labpipe.optimise.levenberg import minimise
from labpipe.records.run_up import RunUp
from labpipe.rigs.film_family import BOUND, PARAMETERS, PRIOR, FilmFamily
from labpipe.rigs.run_up_rotor import RunUpRotor, searched_over
from labpipe.run_ups.joint_result import JointFit
from labpipe.run_ups.misfit import LoadRuns, rank_of, runs_by_speeds, sources_of
from labpipe.run_ups.problem import RunUpProblem, measured_thresholds

MOST_REFITS = 12
# Tolerance of the second attempt, in standard errors: a bearing far outside the family converges slowly.
NEAR = 0.05


def family_about(rig: RunUpRotor, groups: Iterable[LoadRuns]) -> FilmFamily:
    """The family about the rotor file's bearing, its slopes about the middle of the loads and half the highest speed."""
    film = rig.place.film("a joint fit of the film's parameters")
    return FilmFamily(film, rig.search.high / 2, float(np.exp(np.mean(np.log(sorted({group.load for group in groups}))))))


def fit_jointly(rig: RunUpRotor, runs: Iterable[RunUp], use_thresholds: bool = True, known: Collection[str] = ()) -> JointFit:
    """The twelve parameters from all runs; parameters that run into their bounds (`BOUND`) stay there and have no standard error.

    *known*: PARAMETERS that are those of the rotor file. FitError when no minimum is found.
    """
    runs = list(runs)
    rig = searched_over(rig, runs)
    groups = tuple(runs_by_speeds(rig, runs))
    thresholds = measured_thresholds(groups) if use_thresholds else ()
    problem = RunUpProblem.of(rig, family_about(rig, groups), groups, thresholds, PRIOR)
    problem = replace(problem, free=np.array([name not in known for name in PARAMETERS]))
    for _ in range(MOST_REFITS):
        minimum = minimise(problem, problem.values(problem.fixed[problem.free])[problem.free])
        if not minimum.converged:
            minimum = minimise(problem, minimum.values, NEAR)
        if not minimum.converged:
            break
        values = problem.values(minimum.values)
        beyond = np.abs(values) > BOUND * (1 + 1e-9)
        if not np.any(beyond):
            return _result(problem, minimum.values, minimum.steps, tuple(name for name in PARAMETERS if name in known))
        fixed = np.clip(values, -BOUND, BOUND)
        problem = replace(problem, free=problem.free & ~beyond, fixed=fixed)
    raise FitError("no minimum of the joint fit was found", hint="check unbalance, phases, standard errors and the rotor file")


def _result(problem: RunUpProblem[FilmFamily], parameters: FloatArray, steps: int, known: tuple[str, ...]) -> JointFit:
    slopes, prior = problem.measured_slopes(parameters), PRIOR[problem.free]
    covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    free_covariance = np.linalg.inv(slopes.T @ slopes + np.diag(prior**-2.0))
    covariance[np.ix_(problem.free, problem.free)] = free_covariance
    residual = problem.residual(parameters)[: slopes.shape[0]]
    rank, condition = rank_of(slopes * prior)
    n_threshold = len(problem.thresholds)
    sources = sources_of(problem.groups)
    changes = problem.residual_changes(sources)
    systematic = np.zeros((len(sources), len(PARAMETERS)))
    systematic[:, problem.free] = steps_by(changes, slopes, free_covariance)
    return JointFit(
        rig=problem.rig,
        family=problem.family,
        loads=tuple(dict.fromkeys(group.load for group in problem.groups)),
        values=problem.values(parameters),
        covariance=covariance,
        at_bound=~problem.free & np.array([name not in known for name in PARAMETERS]),
        chi2=float(residual @ residual) - explained(residual, changes, slopes, free_covariance),
        n_datum=slopes.shape[0],
        n_effective=float(np.trace(free_covariance @ slopes.T @ slopes)),
        threshold_chi2=float(np.sum(residual[residual.size - n_threshold :] ** 2)),
        n_threshold=n_threshold,
        rank=int(rank),
        condition=float(condition),
        prior_dominated=_prior_dominated(slopes * prior, problem.free),
        steps=steps,
        known=known,
        sources=sources,
        systematic=systematic,
    )


def _prior_dominated(scaled: FloatArray, free: BoolArray) -> tuple[str, ...]:
    """Combinations (logarithms, in units of the priors) that the priors determine better than the data do, the worst first."""
    names = [name for name, is_free in zip(PARAMETERS, free, strict=True) if is_free]
    _, singular, rows = np.linalg.svd(scaled, full_matrices=False)
    weight = PRIOR[free]
    return tuple(combination_text(names, row * weight, 0.1) for row, size in list(zip(rows, singular, strict=True))[::-1] if size < 1)
