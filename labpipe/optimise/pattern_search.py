"""Compass search within bounds: many small problems in parallel, each polled along its axes on a mesh that halves or doubles.

Generalised pattern search (Torczon 1997; Lewis and Torczon 1999 for bounds): from the best point x the objective is evaluated at all
2 n neighbours x +- m e_i; the lowest one, if lower than at x, becomes x and the mesh m doubles, otherwise m halves. Neighbours beyond
a bound are moved onto it. No gradients, and no standard errors of the minimum. COBYQA of scipy is the alternative by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.errors import ConfigError
from labpipe.registry import nearest

# Objective (n_trial, n_chosen) of points (n_trial, n_chosen, n_parameter) of the problems *chosen* (n_chosen,).
Objective = Callable[[FloatArray, IntArray], FloatArray]


@dataclass(frozen=True)
class SearchLimits:
    """Limits of a search; meshes are shares of the box's width, *target_share* is a share of the objective at the start."""

    first_mesh: float = 0.25
    smallest_mesh: float = 1e-4
    largest_mesh: float = 0.5
    most_evaluations: int = 4000
    target_share: float = 1e-9

    def __post_init__(self) -> None:
        if not 0 < self.smallest_mesh <= self.first_mesh <= self.largest_mesh <= 1:
            raise ConfigError("meshes of a pattern search rise: smallest, first, largest, up to 1", hint="for example 1e-4, 0.25, 0.5")
        if self.most_evaluations < 1 or not 0 <= self.target_share < 1:
            raise ConfigError("a search needs one evaluation or more, and a target below the first objective")


@dataclass(frozen=True)
class SearchHistory:
    """One row per iteration, (n_iteration, n_problem) each: evaluations, lowest objective [its unit], mesh [-] (NaN without a mesh).

    A problem that has ended keeps its last row.
    """

    evaluations: IntArray
    objective: FloatArray
    mesh: FloatArray

    def of(self, problem: int) -> SearchHistory:
        """Rows of one problem (n_iteration, 1), without those after its end."""
        column = self.evaluations[:, problem]
        rows = np.concatenate([[True], np.diff(column) > 0])
        return SearchHistory(*(getattr(self, name)[rows][:, [problem]] for name in ("evaluations", "objective", "mesh")))


@dataclass(frozen=True)
class SearchResult:
    """The lowest points (n_problem, n_parameter) [parameter units]; objective, mesh, evaluations (n_problem,).

    capped (n_problem,): ended by the limit of evaluations, neither by the mesh nor by the target of the objective.
    """

    values: FloatArray
    objective: FloatArray
    mesh: FloatArray
    evaluations: IntArray
    capped: BoolArray
    history: SearchHistory


def compass_search(
    objective: Objective, start: FloatArray, lower: FloatArray, upper: FloatArray, limits: SearchLimits | None = None
) -> SearchResult:
    """Searches from *start* (n_problem, n_parameter) [parameter units] between *lower* and *upper*, same shape; deterministic.

    ConfigError where a start lies outside its box.
    """
    limits = limits or SearchLimits()
    values, width = _checked(start, lower, upper)
    n_problem, n_parameter = values.shape
    problems = np.arange(n_problem)
    lowest = objective(values[None], problems)[0]
    target = limits.target_share * lowest
    mesh, evaluations = np.full(n_problem, limits.first_mesh), np.ones(n_problem, np.intp)
    rows = [(evaluations.copy(), lowest.copy(), mesh.copy())]
    compass = np.concatenate([np.eye(n_parameter), -np.eye(n_parameter)])[:, None, :]
    unfinished = np.full(n_problem, True)
    while (active := problems[unfinished & (evaluations < limits.most_evaluations)]).size:
        trial = values[active] + compass * (mesh[active, None] * width[active])
        trial = np.clip(trial, lower[active], upper[active])
        values_of_trial = objective(trial, active)
        best = np.argmin(values_of_trial, axis=0)
        least = values_of_trial[best, np.arange(active.size)]
        better = least < lowest[active]
        values[active[better]] = trial[best[better], np.flatnonzero(better)]
        lowest[active[better]] = least[better]
        mesh[active] = np.where(better, np.minimum(2 * mesh[active], limits.largest_mesh), mesh[active] / 2)
        evaluations[active] += 2 * n_parameter
        unfinished = (mesh >= limits.smallest_mesh) & (lowest > target)
        rows.append((evaluations.copy(), lowest.copy(), mesh.copy()))
    history = SearchHistory(*(np.array(column) for column in zip(*rows, strict=True)))
    return SearchResult(values, lowest, mesh, evaluations, unfinished, history)


def cobyqa_search(
    objective: Objective, start: FloatArray, lower: FloatArray, upper: FloatArray, limits: SearchLimits | None = None
) -> SearchResult:
    """Searches by COBYQA (Ragonneau 2022; scipy 1.14 or newer), one problem after the other; its trust region has no mesh (NaN).

    *start*, *lower*, *upper* (n_problem, n_parameter) [parameter units]. The objective is scaled by its value at the start, parameters by
    the box. ConfigError without COBYQA in the installed scipy.
    """
    limits = limits or SearchLimits()
    values, width = _checked(start, lower, upper)
    traces = [_trace(objective, n, values[n], lower[n], width[n], limits) for n in range(values.shape[0])]
    length = max(trace.objective.size for trace in traces)
    best = np.array([trace.points[np.argmin(trace.objective)] for trace in traces])
    columns = [np.pad(np.minimum.accumulate(trace.objective), (0, length - trace.objective.size), "edge") for trace in traces]
    counts = np.array([trace.objective.size for trace in traces], np.intp)
    evaluations = np.minimum(np.arange(1, length + 1)[:, None], counts)
    lowest = np.stack(columns, axis=1)
    mesh = np.full(lowest.shape, np.nan)
    history = SearchHistory(evaluations, lowest, mesh)
    return SearchResult(lower + best * width, lowest[-1], mesh[-1], counts, np.array([trace.capped for trace in traces]), history)


@dataclass(frozen=True)
class _Trace:
    """All evaluations of one COBYQA run, points as shares of its box."""

    points: FloatArray
    objective: FloatArray
    capped: bool


def _trace(objective: Objective, problem: int, start: FloatArray, lower: FloatArray, width: FloatArray, limits: SearchLimits) -> _Trace:
    points: list[FloatArray] = []
    objectives: list[float] = []
    number = np.array([problem])

    def scaled(parts: FloatArray) -> float:
        inside = np.clip(parts, 0, 1)
        points.append(inside)
        objectives.append(float(objective((lower + inside * width)[None, None], number)[0, 0]))
        return objectives[-1] / (objectives[0] or 1.0)

    radii = {"initial_tr_radius": limits.first_mesh, "final_tr_radius": limits.smallest_mesh}
    options: Any = {**radii, "maxfev": limits.most_evaluations, "f_target": limits.target_share}
    bounds = optimize.Bounds(np.zeros(start.size), np.ones(start.size))
    try:
        outcome = optimize.minimize(scaled, (start - lower) / width, method="COBYQA", bounds=bounds, options=options)
    except ValueError as error:
        if "Unknown solver" not in str(error):
            raise
        raise ConfigError("this scipy has no COBYQA", hint="install scipy 1.14 or newer, or search by method: pattern") from error
    return _Trace(np.array(points), np.array(objectives), not outcome.success)


SEARCHES = {"pattern": compass_search, "cobyqa": cobyqa_search}


def search_named(name: str) -> Callable[..., SearchResult]:
    """One of SEARCHES; ConfigError with the nearest known name on a miss."""
    if name not in SEARCHES:
        raise ConfigError(f"no search '{name}'", hint=nearest(name, SEARCHES))
    return SEARCHES[name]


def _checked(start: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A copy of the starts and the widths of their boxes."""
    if not np.all((lower < upper) & (start >= lower) & (start <= upper)):
        raise ConfigError("a search starts within its bounds, the lower ones below the upper ones")
    return np.array(start, np.float64), upper - lower
