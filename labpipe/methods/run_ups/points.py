"""Eight coefficients per load and speed from complex amplitudes in both directions: bounded least squares
with a ridge.

Per point, in parts t of the coefficients' sizes from the start values, |t| <= bound:  min |r(t)|^2 + |t|^2 /
ridge^2, r the residual over its standard errors. The data determine four combinations of the eight; the ridge
keeps the others at the start values, included in the standard deviations. All points are solved at once by a
projected Gauss-Newton iteration.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.errors import ConfigError, FitError
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.run_ups.film_family import as_eight, carried_beyond
from labpipe.methods.run_ups.misfit import LoadRuns, rank_of, runs_by_load, scales, sources_of
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import RunUpRotor

BOUND = 0.3
RIDGE = 0.15
MOST_STEPS = 60
TOLERANCE = 1e-6
LEAST_DAMPING = 1e-9


@dataclass(frozen=True, kw_only=True)
class PointFit:
    """The coefficients of one *load* [N] at every *speed* (n_speed,) [rad/s].

    coefficients, start, std_error (n_speed, 8) [N/m, N s/m], with the uncertainties of probes; at_bound
    (n_speed, 8): there the standard error is NaN; rank, condition (n_speed,): of the data alone; chi2,
    n_datum, n_effective: sum of squares, real data, and parameters that the data determine.
    """

    load: float
    speed: FloatArray
    start: FloatArray
    coefficients: FloatArray
    std_error: FloatArray
    at_bound: BoolArray
    rank: IntArray
    condition: FloatArray
    chi2: float
    n_datum: int
    n_effective: float

    @property
    def chi2_per_datum(self) -> float:
        """chi-square over degrees of freedom, at least one; near one when model and noise are right."""
        return self.chi2 / max(self.n_datum - self.n_effective, 1.0)

    @property
    def share_at_bound(self) -> float:
        return float(np.mean(self.at_bound))

    def at_speed(self) -> CoefficientsAtSpeed:
        """K and C as a function of speed, linear between the points.

        Beyond them K and Omega C stay constant.
        """

        def between(speed: FloatArray) -> FloatArray:
            return np.stack([np.interp(speed, self.speed, column) for column in self.coefficients.T], axis=-1)

        return carried_beyond(between, float(self.speed[0]), float(self.speed[-1]))


def fit_points(
    rig: RunUpRotor, runs: Iterable[RunUp], bound: float = BOUND, ridge: float = RIDGE
) -> list[PointFit]:
    """One PointFit per load; *bound* and *ridge* are parts of the coefficients' sizes (see `scales`).
    ConfigError unless positive.

    Equation (run-points).
    """
    if not (bound > 0 and ridge > 0):
        raise ConfigError(
            "bound and ridge of the coefficients are positive", hint="for example 30 % and 15 %"
        )
    return [_fit_load(rig, group, bound, ridge) for group in runs_by_load(rig, runs)]


def _fit_load(rig: RunUpRotor, group: LoadRuns, bound: float, ridge: float) -> PointFit:
    start = as_eight(*rig.start_coefficients(group.load, group.speed))
    unit = scales(start)
    parts = _descend(group, start, unit, bound, ridge)
    residual, slopes = group.residual_and_slopes(start + unit * parts)
    slopes = slopes * unit[:, None, :]
    at_bound = np.abs(parts) >= bound
    free = slopes * ~at_bound[:, None, :]
    covariance = np.linalg.inv(_normal(free) + np.eye(8) / ridge**2)
    of_probes = np.zeros_like(start)
    names = [source.source for source in sources_of([group])]
    for change in group.residual_changes(names):
        of_probes += np.einsum("nij,nkj,nk->ni", covariance, free, change) ** 2
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2) + of_probes) * unit
    rank, condition = rank_of(slopes)
    return PointFit(
        load=group.load,
        speed=group.speed,
        start=start,
        coefficients=start + unit * parts,
        std_error=np.where(at_bound, np.nan, deviation),
        at_bound=at_bound,
        rank=rank,
        condition=condition,
        chi2=float(np.sum(residual**2)),
        n_datum=residual.size,
        n_effective=float(np.einsum("nij,nji->", covariance, _normal(free))),
    )


def _normal(slopes: FloatArray) -> FloatArray:
    return np.asarray(slopes.swapaxes(1, 2) @ slopes)


def _descend(group: LoadRuns, start: FloatArray, unit: FloatArray, bound: float, ridge: float) -> FloatArray:
    """The minimum of every point (n_speed, 8), damped where a step does not lower its sum of squares."""
    parts, damping = np.zeros_like(start), np.full(start.shape[0], 1e-6)
    residual, slopes = group.residual_and_slopes(start)
    cost = _cost(residual, parts, ridge)
    for _ in range(MOST_STEPS):
        trial = _step(residual, slopes * unit[:, None, :], parts, damping, bound, ridge)
        new_residual, new_slopes = group.residual_and_slopes(start + unit * trial)
        new_cost = _cost(new_residual, trial, ridge)
        better = new_cost < cost
        if np.max(np.abs(trial - parts)) < TOLERANCE or not np.any(better | (damping < 1e6)):
            return parts
        damping = np.where(better, np.maximum(damping / 10, LEAST_DAMPING), damping * 10)
        parts = np.where(better[:, None], trial, parts)
        cost = np.where(better, new_cost, cost)
        residual = np.where(better[:, None], new_residual, residual)
        slopes = np.where(better[:, None, None], new_slopes, slopes)
    raise FitError(
        f"the coefficients under {group.load:.4g} N were not found in {MOST_STEPS} steps",
        hint="check unbalance, phases, standard errors",
    )


def _cost(residual: FloatArray, parts: FloatArray, ridge: float) -> FloatArray:
    return np.asarray(np.sum(residual**2, axis=1) + np.sum(parts**2, axis=1) / ridge**2)


def _step(
    residual: FloatArray,
    slopes: FloatArray,
    parts: FloatArray,
    damping: FloatArray,
    bound: float,
    ridge: float,
) -> FloatArray:
    """A Gauss-Newton step within the box: coefficients beyond a bound are set to it, and the others are
    solved again.

    Values on a bound that the gradient pushes outwards stay there from the outset.
    """
    gradient = (slopes.swapaxes(1, 2) @ residual[..., None])[..., 0] + parts / ridge**2
    fixed_mask = ((parts >= bound) & (gradient < 0)) | ((parts <= -bound) & (gradient > 0))
    normal = _normal(slopes) + np.eye(8) / ridge**2
    normal = normal + damping[:, None, None] * np.eye(8) * np.diagonal(normal, axis1=1, axis2=2)[:, None, :]
    step = np.zeros_like(parts)
    for _ in range(8):
        free = ~fixed_mask
        fixed = step * fixed_mask
        reduced = normal * (free[:, :, None] & free[:, None, :]) + np.eye(8) * fixed_mask[:, None, :]
        side = (gradient + (normal @ fixed[..., None])[..., 0]) * free
        step = fixed - np.linalg.solve(reduced, side[..., None])[..., 0]
        beyond = np.abs(parts + step) > bound * (1 + 1e-12)
        if not np.any(beyond):
            break
        step = np.clip(parts + step, -bound, bound) - parts
        fixed_mask = fixed_mask | beyond
    return np.clip(parts + step, -bound, bound)
