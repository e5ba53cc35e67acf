"""One fit of the film's physical parameters p to all complex responses: least |r|^2 + sum ((Omega_th -
Omega_meas) / s)^2 + sum (p / spread)^2, r the residual of the responses over their standard errors.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.estimation.descent import minimise
from labpipe.estimation.statistics import Stated, combination_text, pulls_of, steps_by
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.posterior import Posterior, Problem, Residual
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups import misfit, rotor
from labpipe.methods.run_ups.records import OUTSIDE, RunUp
from labpipe.records.uncertain import Uncertain, Uncertainty

MOST_SEARCHES = 25
SEARCH_TOLERANCE = 1e-9
# Half-width of the difference that gives the slope of the growth rate by speed, as a part of the speed.
SPEED_STEP = 1e-3
# Least slope [1/s per rad/s] of the growth rate that defines a threshold speed.
LEAST_SLOPE = 1e-4


Family = TypeVar("Family", bound=rotor.CoefficientFamily)


def run_up_problem(
    family: Family,
    groups: tuple[misfit.LoadRuns, ...],
    thresholds: tuple[MeasuredThreshold, ...],
    spread: FloatArray,
    free: BoolArray | None = None,
) -> Problem[Family]:
    """Responses, thresholds and priors of a *family* about zero with standard deviations *spread*
    (n_parameter,) [-]; *free* (n_parameter,): parameters that are fitted, all by default.
    """
    parts = (run.run.response / run.run.amplitude_error for group in groups for run in group.runs)
    size = float(np.sqrt(sum(float(np.sum(np.abs(part) ** 2)) for part in parts)))
    none, fitted = np.zeros(spread.size), np.ones(spread.size, bool) if free is None else free
    return Problem(family, (*groups, *thresholds), none, spread, fitted, none, size=size)


@dataclass(frozen=True)
class MeasuredThreshold:
    """The measured threshold of instability *speed* [rad/s] of a *rig* under a *load* [N]."""

    rig: rotor.RunUpRotor
    load: float
    speed: Uncertain

    def residual(self, model: rotor.CoefficientFamily, values: FloatArray) -> Residual:
        """(Omega_th - Omega_meas) / s (1,) [-] and its derivatives by the parameters (1, n_parameter), by d
        Omega_th = -d growth / (d growth / d Omega). FitError as `nearby_threshold`. Equation (run-threshold).
        """
        speed, by_speed = nearby_threshold(self.rig, model.at_load(values, self.load), self.speed.value)
        eight, by_parameter = model.coefficients_and_slopes(values, np.array([self.load]), np.array([speed]))
        stiffness, damping = rotor.as_matrices(eight)
        mode = self.rig.stability.least_stable(speed, stiffness[0], damping[0])
        slopes = np.concatenate([mode.by_stiffness.ravel(), mode.by_damping.ravel()]) @ by_parameter[0]
        error = self.speed.std_error
        return np.array([(speed - self.speed.value) / error]), lambda: -slopes[None] / (by_speed * error)


def measured_thresholds(
    rig: rotor.RunUpRotor, groups: tuple[misfit.LoadRuns, ...]
) -> tuple[MeasuredThreshold, ...]:
    """Each once: files of one load may state the same measurement."""
    stated = dict.fromkeys((group.load, run.run.threshold) for group in groups for run in group.runs)
    return tuple(MeasuredThreshold(rig, load, speed) for load, speed in stated if speed is not None)


def nearby_threshold(
    rig: rotor.RunUpRotor, coefficients: CoefficientsAtSpeed, start: float
) -> tuple[float, float]:
    """The threshold [rad/s] by Newton's method from *start*, and the slope of the least stable mode's growth
    rate by speed there [1/s per rad/s]; FitError where there is none near.
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
    hint = "check load, unit of speed and rotor file"
    raise FitError("the computed threshold of instability is far from the measured one", hint=hint)


# Chi-square probability below which the family is rejected.
REJECTED = 1e-3
# Tolerance of the range of fitted loads, relative.
LOAD_SLACK = 0.01
# Parameters that are exponents, not logarithms of factors.
EXPONENTS = ("viscosity_speed", "viscosity_load")
# Half-width of the differences that give the bend of a peak, as a part of its speed.
PEAK_STEP = 5e-3


def outside(load: float, low: float, high: float, of: str) -> str:
    """Words on a *load* [N] beyond *low* and *high* [N]; empty within."""
    if low * (1 - LOAD_SLACK) <= load <= high * (1 + LOAD_SLACK):
        return ""
    return f"{load:.3g} N lies {OUTSIDE} of {of} ({low:.3g} to {high:.3g} N)"


@dataclass(frozen=True, kw_only=True)
class RunUpFit(Posterior[Family]):
    """The posterior of a family's parameters by all run-ups of a *rig*, after so many *steps*."""

    rig: rotor.RunUpRotor
    steps: int

    @property
    def groups(self) -> list[misfit.LoadRuns]:
        return [test for test in self.problem.tests if isinstance(test, misfit.LoadRuns)]

    @property
    def loads(self) -> tuple[float, ...]:
        """Loads of the fit [N]."""
        return tuple(dict.fromkeys(group.load for group in self.groups))

    @property
    def sources(self) -> tuple[Uncertainty, ...]:
        return misfit.sources_of(self.groups)

    @cached_property
    def covariance(self) -> FloatArray:
        """V + V E V of all parameters (n_parameter, n_parameter) [1], E the `shared_noise` of the runs."""
        covariance = super().covariance
        return (
            covariance
            + covariance @ misfit.shared_noise(self._residuals_by_baselines(), len(covariance)) @ covariance
        )

    def _residuals_by_baselines(self) -> Iterator[tuple[RunUp, FloatArray]]:
        for group in self.groups:
            eight, by_parameter = self.with_slopes(group.load, group.speed)
            for excited in (excited for excited in group.runs if excited.run.baseline is not None):
                slopes = excited.residual_and_slopes(eight)[1] @ by_parameter
                yield from ((excited.run, part) for part in excited.by_baseline(slopes))

    @cached_property
    def changes(self) -> FloatArray:
        """Of the residual by one standard uncertainty of each source, (n_source, n_datum) [1]."""
        names = [source.source for source in self.sources]
        by_group = [group.residual_changes(names).reshape(len(names), -1) for group in self.groups if names]
        measured = np.concatenate([np.zeros((len(names), 0)), *by_group], axis=1)
        return np.pad(measured, ((0, 0), (0, self.n_datum - measured.shape[1])))

    @cached_property
    def systematic(self) -> FloatArray:
        """Of the parameters by one standard uncertainty of each source, (n_source, n_parameter) [1]."""
        systematic = np.zeros((len(self.sources), self.values.size))
        systematic[:, self.problem.free] = steps_by(self.changes, self.slopes, self.free_covariance)
        return systematic

    @cached_property
    def chi2(self) -> float:
        """Of responses and thresholds, without what the sources explain [1]."""
        pulls = pulls_of(self.residual, Stated.of(self.changes), self.slopes, self.free_covariance)
        return float(self.residual @ self.residual) - pulls.explained

    @property
    def chi2_per_datum(self) -> float:
        """Near one where the bearing belongs to the family."""
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
        return self.model.at_load(self.values, load)

    def with_slopes(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The eight coefficients (n_speed, 8) [N/m, N s/m] and their derivatives by the parameters."""
        return self.model.coefficients_and_slopes(self.values, np.full(speed.size, load), speed)

    @property
    def whole_covariance(self) -> FloatArray:
        """Of all parameters (n_parameter, n_parameter) [1]: noise and priors, widened, and the probes."""
        return self.widening**2 * self.covariance + self.systematic.T @ self.systematic

    def field_covariance(self, load: float, speed: FloatArray) -> FloatArray:  # noqa: ARG002
        """Covariance (n_speed, n_speed) [-] of the logarithms of each coefficient beyond the parameters."""
        return np.zeros((speed.size, speed.size))

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The eight coefficients and their standard errors, (n_speed, 8) each [N/m, N s/m]."""
        eight, slopes = self.with_slopes(load, speed)
        variance = np.einsum("nij,jk,nik->ni", slopes, self.whole_covariance, slopes)
        beyond = np.maximum(np.diagonal(self.field_covariance(load, speed)), 0)[:, None] * eight**2
        return eight, np.sqrt(variance + self.widening**2 * beyond)

    def critical_speed(self, load: float, plane: str = "") -> Uncertain:
        """Speed [rad/s] of the largest displacement at a plane, or the last one; its error from d Omega =
        -d(A') / A'', A the displacement at the peak and a little to both sides.
        """
        speed = self.rig.critical_speed(self.at_load(load), plane)
        step = PEAK_STEP * speed
        around = speed + step * np.array([-1.0, 0.0, 1.0])
        number = self.rig.plane_names.index(plane) if plane else -1
        response, slopes = self.rig.condense(around, self.rig.known_unbalance).response_and_slopes(
            *self.at_load(load)(around)
        )
        size = rotor.largest_displacement(response.reshape(3, -1, 2))[:, number]
        bend = (size[0] - 2 * size[1] + size[2]) / step**2
        sides = np.array([1.0, 0.0, -1.0])[:, None] / (2 * step * bend)
        by_eight = misfit.displacement_slopes(response, slopes)[:, number] * sides
        return Uncertain(speed, self._error(load, around, by_eight))

    def threshold(self, load: float) -> Uncertain | None:
        """Onset speed of instability [rad/s], if there is one within the search."""
        onset = self.rig.threshold(self.at_load(load))
        if onset is None:
            return None
        speed, by_speed = nearby_threshold(self.rig, self.at_load(load), onset)
        stiffness, damping = self.at_load(load)(np.array([speed]))
        mode = self.rig.stability.least_stable(speed, stiffness[0], damping[0])
        by_eight = -np.concatenate([mode.by_stiffness.ravel(), mode.by_damping.ravel()]) / by_speed
        return Uncertain(speed, self._error(load, np.array([speed]), by_eight[None]))

    def extrapolation_warning(self, load: float) -> str:
        """Warning on a *load* [N] beyond those of the fit, or empty."""
        beyond = outside(load, min(self.loads), max(self.loads), "the fit")
        return beyond and f"{beyond}: "

    def _error(self, load: float, speed: FloatArray, weights: FloatArray) -> float:
        """Of a prediction with slopes *weights* (n_speed, 8) by coefficients at *speed*."""
        eight, slopes = self.with_slopes(load, speed)
        by_parameter, by_field = np.einsum("ni,nij->j", weights, slopes), weights * eight
        beyond = np.einsum("ni,nm,mi->", by_field, self.field_covariance(load, speed), by_field)
        variance = by_parameter @ self.whole_covariance @ by_parameter
        return float(np.sqrt(variance + self.widening**2 * max(float(beyond), 0.0)))


@dataclass(frozen=True, kw_only=True)
class JointFit(RunUpFit[rotor.FilmFamily]):
    """Logarithms *values* (12,) of PARAMETERS about the rotor file's bearing but those *known*."""

    known: Collection[str] = ()

    @property
    def at_bound(self) -> BoolArray:
        """Parameters that ran into their bounds (12,)."""
        return ~self.problem.free & np.array([name not in self.known for name in rotor.PARAMETERS])

    @property
    def prior_dominated(self) -> tuple[str, ...]:
        """Combinations that the priors determine, as text."""
        free = self.problem.free
        names = [name for name, is_free in zip(rotor.PARAMETERS, free, strict=True) if is_free]
        _, singular, rows = np.linalg.svd(self.in_priors, full_matrices=False)
        return tuple(
            combination_text(names, row * rotor.PRIOR[free], 0.1)
            for row, size in zip(rows[::-1], singular[::-1], strict=True)
            if size < 1
        )

    @property
    def share_at_bound(self) -> float:
        return float(np.mean(self.at_bound))

    @property
    def std_error(self) -> FloatArray:
        """Posterior standard deviations of the logarithms (12,) [-], widened; NaN at a bound."""
        return np.where(self.at_bound, np.nan, np.sqrt(np.diag(self.whole_covariance)))

    def parameter(self, name: str) -> Uncertain:
        """The factor exp(value) on the rotor file's value; of the two slopes the exponent itself."""
        n = rotor.PARAMETERS.index(name)
        value, error = float(self.values[n]), float(self.std_error[n])
        if name in EXPONENTS:
            return Uncertain(value, error)
        return Uncertain(float(np.exp(value)), float(np.exp(value)) * error)

    def caution(self, load: float) -> str:
        """Warning on a rejected family and on a *load* [N] beyond those of the fit, or empty."""
        excess = f"chi-square per datum is {self.chi2_per_datum:.1f}"
        rejected = f"{excess}: the bearing is not of the fitted family, and no interval is given"
        only = "the interval holds for bearings of the fitted family only; "
        only += "chi-square tests the measured loads only"
        beyond = self.extrapolation_warning(load)
        return "; ".join(([rejected] if self.rejected else []) + ([f"{beyond}{only}"] if beyond else []))


MOST_REFITS = 12
# Tolerance of the second attempt, in standard errors: a bearing far outside the family converges slowly.
NEAR = 0.05


def family_about(
    rig: rotor.RunUpRotor, loads: Iterable[float], what: str = "a joint fit of the film's parameters"
) -> rotor.FilmFamily:
    """The family about the rotor file's bearing, its slopes about middle *loads* [N] and speeds."""
    middle = float(np.exp(np.mean(np.log(sorted(set(loads))))))
    return rotor.FilmFamily(rig.place.film(what), rig.search.high / 2, middle)


def fit_jointly(
    rig: rotor.RunUpRotor, runs: Iterable[RunUp], use_thresholds: bool = True, known: Collection[str] = ()
) -> JointFit:
    """The PARAMETERS but those *known* from all runs; those that run into their bounds (`BOUND`) stay there,
    without a standard error. FitError when no minimum is found.
    """
    runs = list(runs)
    rig = rotor.with_search_range(rig, runs)
    groups = tuple(misfit.runs_by_speeds(rig, runs))
    thresholds = measured_thresholds(rig, groups) if use_thresholds else ()
    free = np.array([name not in known for name in rotor.PARAMETERS])
    family = family_about(rig, [group.load for group in groups])
    problem = run_up_problem(family, groups, thresholds, rotor.PRIOR, free)
    for _ in range(MOST_REFITS):
        minimum = minimise(problem, problem.base[problem.free])
        if not minimum.converged:
            minimum = minimise(problem, minimum.values, NEAR)
        if not minimum.converged:
            break
        values = problem.whole(minimum.values)
        beyond = np.abs(values) > rotor.BOUND * (1 + 1e-9)
        if not np.any(beyond):
            return JointFit(problem=problem, values=values, rig=rig, steps=minimum.steps, known=known)
        problem = replace(
            problem, free=problem.free & ~beyond, base=np.clip(values, -rotor.BOUND, rotor.BOUND)
        )
    hint = "check unbalance, phases, standard errors and the rotor file"
    raise FitError("no minimum of the joint fit was found", hint=hint)
