"""The least-squares problem of run-ups: a family of coefficients against complex responses, thresholds and priors.

|r|^2 + sum ((Omega_th - Omega_meas) / s)^2 + sum (p / spread)^2 over the family's parameters p; r is the residual of the responses over
their standard errors. Thresholds are computed by Newton's method from the measured speeds, their slopes by the modes' left and right
eigenvectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import FitError
from labpipe.optimise.levenberg import sum_of_squares
from labpipe.records.doubt import Doubt
from labpipe.records.settings import Uncertain
from labpipe.rigs.film_family import as_matrices
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.rotors.modes import GROWTH_TOLERANCE
from labpipe.rotors.threshold import CoefficientsAtSpeed
from labpipe.run_ups.misfit import LoadRuns

MOST_SEARCHES = 25
SEARCH_TOLERANCE = 1e-9
# Half-width of the difference that gives the slope of the growth rate by speed, as a part of the speed.
SPEED_STEP = 1e-3
# Least slope [1/s per rad/s] of the growth rate that defines a threshold speed.
LEAST_SLOPE = 1e-4


class CoefficientFamily(Protocol):
    """The eight coefficients over load [N] and speed [rad/s] with parameters *values* (n_parameter,)."""

    def coefficients_and_slopes(self, values: FloatArray, load: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
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

    *thresholds*: (load [N], speed [rad/s]); *spread* (n_parameter,): prior standard deviations of the parameters;
    *free* (n_parameter,): parameters that are fitted, the others stay at *fixed* (n_parameter,).
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
        cls, rig: RunUpRotor, family: Family, groups: tuple[LoadRuns, ...], thresholds: Thresholds, spread: FloatArray
    ) -> RunUpProblem[Family]:
        """The problem with all parameters free; *spread* (n_parameter,) [-]: their prior standard deviations."""
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
        """Residual (n_equation,) [-] of responses, thresholds and priors, of the free parameters (n_free,). Equation (run-joint)."""
        values = self.values(parameters)
        measured = [self._response(group, values)[0] for group in self.groups]
        return np.concatenate([*measured, self._thresholds(values)[0], values / self.spread])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivatives of the residual by the free parameters, (n_equation, n_free) [-]."""
        return np.concatenate([self.measured_slopes(parameters), np.diag(1 / self.spread)[:, self.free]])

    def measured_slopes(self, parameters: FloatArray) -> FloatArray:
        """Derivatives of the residual of responses and thresholds (n_datum, n_free) [-], without the priors."""
        values = self.values(parameters)
        measured = [self._response(group, values)[1] for group in self.groups]
        return np.concatenate([*measured, self._thresholds(values)[1]])[:, self.free]

    def residual_changes(self, sources: Sequence[Doubt]) -> FloatArray:
        """Changes (n_source, n_datum) [-] of the residual of responses and thresholds by one standard uncertainty of each source."""
        names = [source.source for source in sources]
        by_group = [group.residual_changes(names) for group in self.groups]
        measured = [changes.reshape(len(names), int(np.prod(changes.shape[1:]))) for changes in by_group]
        return np.concatenate([*measured, np.zeros((len(names), len(self.thresholds)))], axis=1)

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [-] of the residual at the free parameters (n_free,); infinite where the residual cannot be computed."""
        return sum_of_squares(self.residual, parameters)

    def _response(self, group: LoadRuns, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        eight, by_parameter = self.family.coefficients_and_slopes(values, np.full(group.speed.size, group.load), group.speed)
        residual, slopes = group.residual_and_slopes(eight)
        return residual.ravel(), (slopes @ by_parameter).reshape(-1, values.size)

    def _thresholds(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = [threshold_row(self.rig, self.family, values, load, measured) for load, measured in self.thresholds]
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows]).reshape(-1, values.size)


def measured_thresholds(groups: tuple[LoadRuns, ...]) -> Thresholds:
    """Measured thresholds [rad/s] with their loads [N]."""
    return tuple((group.load, run.run.threshold) for group in groups for run in group.runs if run.run.threshold is not None)


def threshold_row(
    rig: RunUpRotor, family: CoefficientFamily, values: FloatArray, load: float, measured: Uncertain
) -> tuple[float, FloatArray]:
    """(Omega_th - Omega_meas) / s [-] and its derivatives by the parameters (n_parameter,).

    d Omega_th = -d growth / (d growth / d Omega) at the threshold. FitError where the search from the measured speed finds none.
    Equation (run-threshold).
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
