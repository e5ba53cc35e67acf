"""Eight coefficients per load and speed from the planes' amplitudes alone: the way of Falah and Khorshid.

Per point factors on the coefficients of the rotor file's bearing minimise F = sum over planes (a_measured -
a_computed)^2, a the largest displacement of the orbit (their equation 12), by a generalised pattern search
(Torczon 1997; Lewis and Torczon 1999 for bounds): from the best point x the objective is evaluated at all 2 n
neighbours x +- m e_i; the lowest one, if lower than at x, becomes x and the mesh m doubles, else m halves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.posterior import rank_of
from labpipe.methods.run_ups import rotor
from labpipe.methods.run_ups.misfit import ExcitedRun, LoadRuns, displacement_slopes, runs_by_load, scales
from labpipe.methods.run_ups.records import RunUp

# Objective (n_trial, n_chosen) of points (n_trial, n_chosen, n_parameter) of problems (n_chosen,).
Objective = Callable[[FloatArray, IntArray], FloatArray]


@dataclass(frozen=True)
class SearchLimits:
    """Limits of a search: meshes as shares of the box's width, the target as one of the first objective."""

    first_mesh: float = 0.25
    smallest_mesh: float = 1e-4
    largest_mesh: float = 0.5
    most_evaluations: int = 4000
    target_share: float = 1e-9


USUAL = SearchLimits()


@dataclass(frozen=True)
class SearchHistory:
    """Evaluations, lowest objective [its unit], mesh [-] or NaN, (n_iteration, n_problem) each."""

    evaluations: IntArray
    objective: FloatArray
    mesh: FloatArray

    def at(self, rows: BoolArray | slice, problems: IntArray | slice) -> SearchHistory:
        """Rows (n_row,) of problems (n_problem,) [units as before]."""
        return SearchHistory(
            self.evaluations[rows, problems], self.objective[rows, problems], self.mesh[rows, problems]
        )

    def of(self, problem: int) -> SearchHistory:
        """Rows of one problem (n_iteration, 1), without those after its end."""
        rows = np.diff(self.evaluations[:, problem], prepend=0) > 0
        return self.at(rows, slice(problem, problem + 1))


@dataclass(frozen=True)
class SearchResult:
    """The lowest points (n_problem, n_parameter) [parameter units], their objective, mesh and evaluations
    (n_problem,); capped (n_problem,): ended by the limit of evaluations.
    """

    values: FloatArray
    objective: FloatArray
    mesh: FloatArray
    evaluations: IntArray
    capped: BoolArray
    history: SearchHistory


def compass_search(
    objective: Objective,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    limits: SearchLimits = USUAL,
) -> SearchResult:
    """From *start* (n_problem, n_parameter) [parameter units] between *lower* and *upper*, same shape."""
    values, width = np.array(start, np.float64), upper - lower
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
    objective: Objective,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    limits: SearchLimits = USUAL,
) -> SearchResult:
    """By COBYQA (Ragonneau 2022), without a mesh (NaN); *start*, *lower*, *upper* (n_problem, n_parameter)
    [parameter units].
    """
    width = upper - lower
    traces = [_trace(objective, n, start[n], lower[n], width[n], limits) for n in range(start.shape[0])]
    points, objectives, capped = zip(*traces, strict=True)
    best = np.array([of[np.argmin(values)] for of, values in zip(points, objectives, strict=True)])
    counts = np.array([len(values) for values in objectives], np.intp)
    length = counts.max()
    columns = [
        np.pad(np.minimum.accumulate(values), (0, length - values.size), "edge") for values in objectives
    ]
    evaluations = np.minimum(np.arange(1, length + 1)[:, None], counts)
    lowest = np.stack(columns, axis=1)
    mesh = np.full(lowest.shape, np.nan)
    history = SearchHistory(evaluations, lowest, mesh)
    return SearchResult(lower + best * width, lowest[-1], mesh[-1], counts, np.array(capped), history)


def _trace(
    objective: Objective,
    problem: int,
    start: FloatArray,
    lower: FloatArray,
    width: FloatArray,
    limits: SearchLimits,
) -> tuple[FloatArray, FloatArray, bool]:
    points: list[FloatArray] = []
    objectives: list[float] = []
    number = np.array([problem])

    def scale(parts: FloatArray) -> float:
        inside = np.clip(parts, 0, 1)
        points.append(inside)
        objectives.append(float(objective((lower + inside * width)[None, None], number)[0, 0]))
        return objectives[-1] / (objectives[0] or 1.0)

    radii = {"initial_tr_radius": limits.first_mesh, "final_tr_radius": limits.smallest_mesh}
    options: Any = {**radii, "maxfev": limits.most_evaluations, "f_target": limits.target_share}
    bounds = scipy.optimize.Bounds(np.zeros(start.size), np.ones(start.size))
    outcome = scipy.optimize.minimize(
        scale, (start - lower) / width, method="COBYQA", bounds=bounds, options=options
    )
    return np.array(points), np.array(objectives), not outcome.success


SEARCHES: dict[str, Callable[..., SearchResult]] = {"pattern": compass_search, "cobyqa": cobyqa_search}
BOUND = 0.3
SEED = 20260101
# Distance from a bound, as a part of the box, below which a factor counts as at its bound.
AT_BOUND = 1e-3


@dataclass(frozen=True, kw_only=True)
class SpeedwiseFit:
    """The coefficients (n_speed, 8) [N/m, N s/m] of one *load* [N] at *speed* (n_speed,) [rad/s], *start* and
    at_bound alike; rank, condition (n_speed,): of the data alone; chi2 of n_datum real data.
    """

    load: float
    speed: FloatArray
    start: FloatArray
    coefficients: FloatArray
    at_bound: BoolArray
    rank: IntArray
    condition: FloatArray
    chi2: float
    n_datum: int

    def at_speed(self) -> CoefficientsAtSpeed:
        """K and C over speed, linear between the points; beyond them K and Omega C stay constant."""

        def between(speed: FloatArray) -> FloatArray:
            return np.stack([np.interp(speed, self.speed, column) for column in self.coefficients.T], axis=-1)

        return rotor.extend_over_speed(between, float(self.speed[0]), float(self.speed[-1]))


@dataclass(frozen=True, kw_only=True)
class AmplitudeFit(SpeedwiseFit):
    """A fit to amplitudes alone: objective, measured (n_speed,), sums of squares [m^2]; of its search
    evaluations, capped (n_speed,) and history; every start's factors (n_start, n_speed, 8) and
    objectives (n_start, n_speed), from the rotor file's coefficients first.
    """

    objective: FloatArray
    measured: FloatArray
    evaluations: IntArray
    capped: BoolArray
    history: SearchHistory
    factors: FloatArray
    objectives: FloatArray

    @property
    def n_effective(self) -> float:
        """Number of combinations that the amplitudes determine."""
        return float(np.sum(self.rank))

    @property
    def misfit(self) -> FloatArray:
        """Computed against measured amplitudes, relative, (n_speed,) [-]."""
        return np.sqrt(self.objective / self.measured)


def fit_amplitudes(
    rig: rotor.RunUpRotor,
    runs: Iterable[RunUp],
    bound: float = BOUND,
    method: str = "pattern",
    starts: int = 1,
    seed: int = SEED,
    limits: SearchLimits = USUAL,
) -> list[AmplitudeFit]:
    """One AmplitudeFit per load, by the *method* of SEARCHES: the lowest of the *starts*, of which the first
    is the rotor file's bearing, others are drawn evenly from the box. Equation (run-amplitudes).
    """
    rng = np.random.default_rng(seed)
    return [_fit_load(rig, group, bound, method, starts, rng, limits) for group in runs_by_load(rig, runs)]


def _fit_load(
    rig: rotor.RunUpRotor,
    group: LoadRuns,
    bound: float,
    method: str,
    starts: int,
    rng: np.random.Generator,
    limits: SearchLimits,
) -> AmplitudeFit:
    start = rotor.as_eight(*rig.start_coefficients(group.load, group.speed))
    n = group.speed.size
    drawn = rng.uniform(1 - bound, 1 + bound, (starts, n, 8))
    drawn[0] = 1.0
    first = drawn.reshape(-1, 8)
    low, high = np.full_like(first, 1 - bound), np.full_like(first, 1 + bound)
    amplitudes = Amplitudes.of(group)
    search = SEARCHES[method](amplitudes.objective(start), first, low, high, limits)
    objectives = search.objective.reshape(starts, n)
    best = np.argmin(objectives, axis=0) * n + np.arange(n)
    eight = start * search.values[best]
    misfit = amplitudes.compute(eight, np.arange(n)) - amplitudes.measured
    rank, condition = rank_of(amplitudes.slopes(eight) * scales(start)[:, None, :])
    return AmplitudeFit(
        load=group.load,
        speed=group.speed,
        start=start,
        coefficients=eight,
        at_bound=np.abs(search.values[best] - 1) >= bound * (1 - AT_BOUND),
        rank=rank,
        condition=condition,
        objective=search.objective[best],
        measured=np.sum(amplitudes.measured**2, axis=-1),
        chi2=float(np.sum((misfit / amplitudes.error) ** 2)),
        n_datum=amplitudes.measured.size,
        evaluations=search.evaluations[best],
        capped=search.capped[best],
        history=search.history.at(slice(None), best),
        factors=search.values.reshape(starts, n, 8),
        objectives=objectives,
    )


@dataclass(frozen=True)
class Amplitudes:
    """Largest displacements *measured* in all *runs* of a load, with errors, (n_speed, n_plane) [m]."""

    runs: tuple[ExcitedRun, ...]
    measured: FloatArray
    error: FloatArray

    @classmethod
    def of(cls, group: LoadRuns) -> Amplitudes:
        measured = [rotor.largest_displacement(run.run.response) for run in group.runs]
        errors = [_error(run.run) for run in group.runs]
        return cls(group.runs, np.concatenate(measured, axis=1), np.concatenate(errors, axis=1))

    def compute(self, eight: FloatArray, chosen: IntArray) -> FloatArray:
        """(..., n_chosen, n_plane) [m] by coefficients (..., n_chosen, 8) [N/m, N s/m] at *chosen* speeds."""
        matrices, sizes = rotor.as_matrices(eight), []
        for run in self.runs:
            response = run.condensed.at(chosen).response(*matrices)
            sizes.append(rotor.largest_displacement(response.reshape(*response.shape[:-1], -1, 2)))
        return np.concatenate(sizes, axis=-1)

    def objective(self, start: FloatArray) -> Objective:
        """F [m^2] of factors on *start* (n_speed, 8); problem number n belongs to speed n modulo n_speed."""

        def squares(factors: FloatArray, chosen: IntArray) -> FloatArray:
            place = chosen % start.shape[0]
            misfit = self.compute(start[place] * factors, place) - self.measured[place]
            return np.sum(misfit**2, axis=-1)

        return squares

    def slopes(self, eight: FloatArray) -> FloatArray:
        """Derivatives (n_speed, n_plane, 8) by coefficients (n_speed, 8) [N/m, N s/m], over the errors."""
        matrices = rotor.as_matrices(eight)
        parts = [displacement_slopes(*run.condensed.response_and_slopes(*matrices)) for run in self.runs]
        return np.concatenate(parts, axis=1) / self.error[..., None]


def _error(run: RunUp) -> FloatArray:
    """Standard error of the largest displacement (n_speed, n_plane) [m], to first order."""
    x, y = run.response[..., 0], run.response[..., 1]
    forward, backward = ((x + turn * y).conj() / np.abs(x + turn * y) for turn in (1j, -1j))
    unit = run.response / np.abs(run.response)
    by = np.stack([forward + backward, 1j * (forward - backward)], axis=-1) / 2 * unit
    along, across = by.real * run.amplitude_error, by.imag * np.abs(run.response) * run.phase_error
    return np.sqrt(np.sum(along**2 + across**2, axis=-1))


def perfect_but_wrong(fits: Sequence[AmplitudeFit]) -> str:
    misfit = float(np.sqrt(np.mean(np.concatenate([fit.misfit for fit in fits]) ** 2)))
    share = float(np.mean(np.concatenate([fit.at_bound.ravel() for fit in fits])))
    ranks = sorted({int(rank) for fit in fits for rank in fit.rank})
    return (
        f"the amplitudes are met within {100 * misfit:.2g} % (rms), yet they determine only "
        f"{' or '.join(map(str, ranks))} combinations of the eight coefficients; {100 * share:.0f} % of the "
        "factors are at a bound, the others depend on the search's start"
    )
