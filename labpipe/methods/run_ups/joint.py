"""One fit of the film's physical parameters to all complex responses at all loads and speeds, and its
predictions.

|r|^2 + sum ((Omega_th - Omega_meas) / s)^2 + sum (p / spread)^2 over the family's parameters p; r is the
residual of the responses over their standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.estimation.descent import minimise, sum_of_squares
from labpipe.estimation.statistics import Stated, combination_text, pulls_of, steps_by
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups.misfit import LoadRuns, rank_of, runs_by_speeds, sources_of
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import (
    BOUND,
    PARAMETERS,
    PRIOR,
    RPM,
    FilmFamily,
    RunUpRotor,
    as_matrices,
    searched_over,
)
from labpipe.records.uncertain import Uncertain, Uncertainty

MOST_SEARCHES = 25
SEARCH_TOLERANCE = 1e-9
# Half-width of the difference that gives the slope of the growth rate by speed, as a part of the speed.
SPEED_STEP = 1e-3
# Least slope [1/s per rad/s] of the growth rate that defines a threshold speed.
LEAST_SLOPE = 1e-4


class CoefficientFamily(Protocol):
    """The eight coefficients over load [N] and speed [rad/s] with parameters *values* (n_parameter,)."""

    def coefficients_and_slopes(
        self, values: FloatArray, load: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(n_point, 8) [N/m, N.s/m] and their derivatives (n_point, 8, n_parameter)."""
        ...

    def at_load(self, values: FloatArray, load: float) -> CoefficientsAtSpeed:
        """K [N/m] and C [N s/m] as functions of speed, of parameters (n_parameter,)."""
        ...


Family = TypeVar("Family", bound=CoefficientFamily)
Thresholds = tuple[tuple[float, Uncertain], ...]


@dataclass(frozen=True)
class RunUpProblem(Generic[Family]):
    """Residual and slopes of responses, thresholds and priors.

    *thresholds*: (load [N], speed [rad/s]); *spread* (n_parameter,): prior standard deviations of the
    parameters; *free* (n_parameter,): parameters that are fitted, the others stay at *fixed* (n_parameter,).
    """

    rig: RunUpRotor
    family: Family
    groups: tuple[LoadRuns, ...]
    thresholds: Thresholds
    spread: FloatArray
    free: BoolArray
    fixed: FloatArray

    @classmethod
    def of(
        cls,
        rig: RunUpRotor,
        family: Family,
        groups: tuple[LoadRuns, ...],
        thresholds: Thresholds,
        spread: FloatArray,
    ) -> RunUpProblem[Family]:
        """The problem with all parameters free; *spread* (n_parameter,) [-]: their prior standard
        deviations.
        """
        return cls(rig, family, groups, thresholds, spread, np.ones(spread.size, bool), np.zeros(spread.size))

    @property
    def size(self) -> float:
        """Signal-to-noise ratio of all responses together."""
        parts = (run.run.response / run.run.amplitude_error for group in self.groups for run in group.runs)
        return float(np.sqrt(sum(float(np.sum(np.abs(part) ** 2)) for part in parts)))

    def values(self, parameters: FloatArray) -> FloatArray:
        """All parameters (n_parameter,) [-] from the free parameters (n_free,)."""
        values = self.fixed.copy()
        values[self.free] = parameters
        return values

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Residual (n_equation,) [-] of responses, thresholds and priors, of the free parameters (n_free,).

        Equation (run-joint).
        """
        values = self.values(parameters)
        measured = [self._response(group, values)[0] for group in self.groups]
        return np.concatenate([*measured, self._thresholds(values)[0], values / self.spread])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivatives of the residual by the free parameters, (n_equation, n_free) [-]."""
        return np.concatenate([self.measured_slopes(parameters), np.diag(1 / self.spread)[:, self.free]])

    def measured_slopes(self, parameters: FloatArray) -> FloatArray:
        """Derivatives of the residual of responses and thresholds (n_datum, n_free) [-], without the
        priors.
        """
        values = self.values(parameters)
        measured = [self._response(group, values)[1] for group in self.groups]
        return np.concatenate([*measured, self._thresholds(values)[1]])[:, self.free]

    def residual_changes(self, sources: Sequence[Uncertainty]) -> FloatArray:
        """Changes (n_source, n_datum) [-] of the residual of responses and thresholds by one standard
        uncertainty of each source.
        """
        names = [source.source for source in sources]
        by_group = [group.residual_changes(names) for group in self.groups]
        measured = [changes.reshape(len(names), int(np.prod(changes.shape[1:]))) for changes in by_group]
        return np.concatenate([*measured, np.zeros((len(names), len(self.thresholds)))], axis=1)

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [-] of the residual at the free parameters (n_free,).

        Infinite where the residual cannot be computed.
        """
        return sum_of_squares(self.residual, parameters)

    def _response(self, group: LoadRuns, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        eight, by_parameter = self.family.coefficients_and_slopes(
            values, np.full(group.speed.size, group.load), group.speed
        )
        residual, slopes = group.residual_and_slopes(eight)
        return residual.ravel(), (slopes @ by_parameter).reshape(-1, values.size)

    def _thresholds(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = [
            threshold_row(self.rig, self.family, values, load, measured) for load, measured in self.thresholds
        ]
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows]).reshape(-1, values.size)


def measured_thresholds(groups: tuple[LoadRuns, ...]) -> Thresholds:
    """Measured thresholds [rad/s] with their loads [N]."""
    return tuple(
        (group.load, run.run.threshold)
        for group in groups
        for run in group.runs
        if run.run.threshold is not None
    )


def threshold_row(
    rig: RunUpRotor, family: CoefficientFamily, values: FloatArray, load: float, measured: Uncertain
) -> tuple[float, FloatArray]:
    """(Omega_th - Omega_meas) / s [-] and its derivatives by the parameters (n_parameter,).

    d Omega_th = -d growth / (d growth / d Omega) at the threshold. FitError where the search from the
    measured speed finds none. Equation (run-threshold).
    """
    speed, by_speed = nearby_threshold(rig, family.at_load(values, load), measured.value)
    eight, by_parameter = family.coefficients_and_slopes(values, np.array([load]), np.array([speed]))
    stiffness, damping = as_matrices(eight)
    mode = rig.stability.least_stable(speed, stiffness[0], damping[0])
    slopes = np.concatenate([mode.by_stiffness.ravel(), mode.by_damping.ravel()]) @ by_parameter[0]
    return (speed - measured.value) / measured.std_error, -slopes / (by_speed * measured.std_error)


def nearby_threshold(rig: RunUpRotor, coefficients: CoefficientsAtSpeed, start: float) -> tuple[float, float]:
    """The threshold [rad/s] by Newton's method from *start*, and the slope of the growth rate by speed there
    [1/s per rad/s]: that of the least stable mode, coefficients by central differences.
    """
    speed = start
    for _ in range(MOST_SEARCHES):
        stiffness, damping = coefficients(speed * np.array([1 - SPEED_STEP, 1.0, 1 + SPEED_STEP]))
        mode = rig.stability.least_stable(speed, stiffness[1], damping[1])
        moved = np.sum(mode.by_stiffness * (stiffness[2] - stiffness[0]))
        moved += np.sum(mode.by_damping * (damping[2] - damping[0]))
        by_speed = mode.by_speed + float(moved) / (2 * SPEED_STEP * speed)
        if by_speed < LEAST_SLOPE:
            break
        step = (mode.growth - GROWTH_TOLERANCE) / by_speed
        if abs(step) < SEARCH_TOLERANCE * start:
            return speed - step, by_speed
        speed = float(np.clip(speed - step, 0.7 * speed, 1.4 * speed))
    raise FitError(
        "the computed threshold of instability is far from the measured one",
        hint="check load, unit of speed and rotor file",
    )


# Chi-square probability below which the family is rejected.
REJECTED = 1e-3
# Tolerance of the range of fitted loads, relative.
LOAD_SLACK = 0.01
# Parameters that are exponents, not logarithms of factors.
EXPONENTS = ("viscosity_speed", "viscosity_load")
# Step of a difference, in standard errors along each axis of the covariance.
STEP = 0.5


@dataclass(frozen=True, kw_only=True)
class RunUpFit(Generic[Family]):
    """Parameters *values* (n_parameter,) and *covariance* (n_parameter, n_parameter) of the *family*; *loads*
    [N]: those of the fit.

    chi2, n_datum: of responses and thresholds; n_effective: parameters that the data determine against the
    priors; rank, condition: of the data, in units of the priors. systematic (n_source, n_parameter): changes
    by one standard uncertainty of each of the *sources*, uncertainties of probes; chi2 is without what these
    explain.
    """

    rig: RunUpRotor
    family: Family
    loads: tuple[float, ...]
    values: FloatArray
    covariance: FloatArray
    chi2: float
    n_datum: int
    n_effective: float
    rank: int
    condition: float
    steps: int
    sources: tuple[Uncertainty, ...]
    systematic: FloatArray

    @property
    def chi2_per_datum(self) -> float:
        """chi-square over degrees of freedom; near one where the bearing belongs to the family."""
        return self.chi2 / (self.n_datum - self.n_effective)

    @property
    def chi2_p(self) -> float:
        """Probability of a larger chi-square for a bearing of the family."""
        return chi2_tail(self.chi2, self.n_datum - self.n_effective)

    @property
    def rejected(self) -> bool:
        return self.chi2_p < REJECTED

    @property
    def widening(self) -> float:
        """Factor on all standard errors of predictions: sqrt(chi-square per datum), at least one."""
        return float(np.sqrt(max(1.0, self.chi2_per_datum)))

    def at_load(self, load: float) -> CoefficientsAtSpeed:
        """K and C (n_speed, 2, 2) as a function of speed [rad/s] under a *load* [N]."""
        return self.family.at_load(self.values, load)

    def extrapolated(self, load: float) -> str:
        """Warning on a *load* [N] outside those of the fit; empty within."""
        low, high = min(self.loads), max(self.loads)
        if low * (1 - LOAD_SLACK) <= load <= high * (1 + LOAD_SLACK):
            return ""
        return f"{load:.3g} N lies outside the loads of the fit ({low:.3g} to {high:.3g} N): "


def posterior(
    problem: RunUpProblem[Family], parameters: FloatArray, steps: int
) -> tuple[dict[str, Any], FloatArray]:
    """Fields of a RunUpFit at a minimum, and the slopes (n_datum, n_free) [-] of its data in units of the
    priors.
    """
    slopes, prior, free = problem.measured_slopes(parameters), problem.spread[problem.free], problem.free
    free_covariance = np.linalg.inv(slopes.T @ slopes + np.diag(prior**-2.0))
    residual = problem.residual(parameters)[: slopes.shape[0]]
    rank, condition = rank_of(slopes * prior)
    sources = sources_of(problem.groups)
    changes = problem.residual_changes(sources)
    covariance, systematic = np.zeros((free.size, free.size)), np.zeros((len(sources), free.size))
    covariance[np.ix_(free, free)] = free_covariance
    systematic[:, free] = steps_by(changes, slopes, free_covariance)
    explained = pulls_of(residual, Stated.of(changes), slopes, free_covariance).explained
    fields = {
        "rig": problem.rig,
        "family": problem.family,
        "loads": tuple(dict.fromkeys(group.load for group in problem.groups)),
        "values": problem.values(parameters),
        "covariance": covariance,
        "chi2": float(residual @ residual) - explained,
        "n_datum": slopes.shape[0],
        "n_effective": float(np.trace(free_covariance @ slopes.T @ slopes)),
        "rank": int(rank),
        "condition": float(condition),
        "steps": steps,
        "sources": sources,
        "systematic": systematic,
    }
    return fields, slopes * prior


@dataclass(frozen=True, kw_only=True)
class JointFit(RunUpFit[FilmFamily]):
    """Logarithms *values* (12,) of PARAMETERS about the rotor file's bearing; at_bound (12,).

    prior_dominated: combinations that the priors determine, as text; known: parameters that were not
    estimated.
    """

    at_bound: BoolArray
    prior_dominated: tuple[str, ...]
    known: tuple[str, ...] = ()

    @property
    def share_at_bound(self) -> float:
        return float(np.mean(self.at_bound))

    @property
    def std_error(self) -> FloatArray:
        """Posterior standard deviations of the logarithms (12,) [-], widened; NaN at a bound."""
        return np.where(self.at_bound, np.nan, np.sqrt(np.diag(self.whole_covariance)))

    @property
    def whole_covariance(self) -> FloatArray:
        """Of the logarithms (12, 12) [1]: by noise and priors, widened, and by the uncertainties of the
        probes.
        """
        return np.asarray(self.widening**2 * self.covariance + self.systematic.T @ self.systematic)

    def parameter(self, name: str) -> Uncertain:
        """The factor exp(value) on the rotor file's value, for the two slopes the exponent itself, with its
        standard error.
        """
        n = PARAMETERS.index(name)
        value, error = float(self.values[n]), float(self.std_error[n])
        if name in EXPONENTS:
            return Uncertain(value, error)
        return Uncertain(float(np.exp(value)), float(np.exp(value)) * error)

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The eight coefficients and their standard errors, (n_speed, 8) each [N/m, N s/m]."""
        speed = np.asarray(speed, np.float64)
        eight, slopes = self.family.coefficients_and_slopes(self.values, np.full(speed.size, load), speed)
        return eight, np.sqrt(np.einsum("nij,jk,nik->ni", slopes, self.whole_covariance, slopes))

    def critical_speed(self, load: float, plane: str = "") -> Uncertain:
        """Speed [rad/s] of the largest displacement under the known unbalance, at the last plane unless
        named.
        """
        return self._predict(lambda values: self.rig.critical_speed(self.family.at_load(values, load), plane))

    def threshold(self, load: float) -> Uncertain | None:
        """Onset speed of instability [rad/s].

        None when there is none up to twice the highest speed of the search.
        """
        if self.rig.threshold(self.at_load(load)) is None:
            return None
        return self._predict(lambda values: self._threshold_or_error(values, load))

    def _threshold_or_error(self, values: FloatArray, load: float) -> float:
        speed = self.rig.threshold(self.family.at_load(values, load))
        if speed is None:
            hint = f"it is above {self.rig.search.highest / RPM:.0f} rpm"
            raise FitError(
                "the threshold speed leaves the range of the search within its own uncertainty", hint=hint
            )
        return speed

    def caution(self, load: float) -> str:
        """Warning on a prediction at a *load* [N]: family rejected, load extrapolated; empty otherwise."""
        parts = []
        if self.rejected:
            parts.append(
                f"chi-square per datum is {self.chi2_per_datum:.1f}: the bearing is not of the fitted "
                "family, and no interval is given"
            )
        if outside := self.extrapolated(load):
            parts.append(
                f"{outside}the interval holds for bearings of the fitted family only; chi-square tests the "
                "measured loads only"
            )
        return "; ".join(parts)

    def _predict(self, predict: Callable[[FloatArray], float]) -> Uncertain:
        """A prediction with its standard error: central differences along the axes of the covariance."""
        sizes, axes = np.linalg.eigh(self.whole_covariance)
        variance = 0.0
        for size, axis in zip(np.sqrt(np.maximum(sizes, 0)), axes.T, strict=True):
            if size > 0:
                change = STEP * size * axis
                variance += (
                    (predict(self.values + change) - predict(self.values - change)) / (2 * STEP)
                ) ** 2
        return Uncertain(predict(self.values), float(np.sqrt(variance)))


MOST_REFITS = 12
# Tolerance of the second attempt, in standard errors: a bearing far outside the family converges slowly.
NEAR = 0.05


def family_about(rig: RunUpRotor, groups: Iterable[LoadRuns]) -> FilmFamily:
    """The family about the rotor file's bearing, its slopes about the middle of the loads and half the
    highest speed.
    """
    film = rig.place.film("a joint fit of the film's parameters")
    return FilmFamily(
        film, rig.search.high / 2, float(np.exp(np.mean(np.log(sorted({group.load for group in groups})))))
    )


def fit_jointly(
    rig: RunUpRotor, runs: Iterable[RunUp], use_thresholds: bool = True, known: Collection[str] = ()
) -> JointFit:
    """The twelve parameters from all runs; parameters that run into their bounds (`BOUND`) stay there and
    have no standard error.

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
            return _result(
                problem, minimum.values, minimum.steps, tuple(name for name in PARAMETERS if name in known)
            )
        fixed = np.clip(values, -BOUND, BOUND)
        problem = replace(problem, free=problem.free & ~beyond, fixed=fixed)
    raise FitError(
        "no minimum of the joint fit was found",
        hint="check unbalance, phases, standard errors and the rotor file",
    )


def _result(
    problem: RunUpProblem[FilmFamily], parameters: FloatArray, steps: int, known: tuple[str, ...]
) -> JointFit:
    fields, scaled = posterior(problem, parameters, steps)
    names = [name for name, is_free in zip(PARAMETERS, problem.free, strict=True) if is_free]
    _, singular, rows = np.linalg.svd(scaled, full_matrices=False)
    weight = PRIOR[problem.free]
    return JointFit(
        **fields,
        at_bound=~problem.free & np.array([name not in known for name in PARAMETERS]),
        prior_dominated=(
            tuple(
                combination_text(names, row * weight, 0.1)
                for row, size in list(zip(rows, singular, strict=True))[::-1]
                if size < 1
            )
        ),
        known=known,
    )
