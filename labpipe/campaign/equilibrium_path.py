"""The path of the shaft's rest position over the static load, and its slope against the stiffness from shaking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.common_sources import change_in, random_error
from labpipe.campaign.matrix_settings import EquilibriumSettings
from labpipe.distributions import chi2_tail
from labpipe.errors import ConfigError
from labpipe.quantities import QUANTITIES
from labpipe.records.condition_matrix import ConditionMatrix, EquilibriumPath, MatrixPoint, PathPoint
from labpipe.records.identification import Fit

STIFFNESS = ("k_xx", "k_xy", "k_yx", "k_yy")


def equilibrium_paths(settings: EquilibriumSettings, matrix: ConditionMatrix, fits: Sequence[Fit]) -> tuple[EquilibriumPath, ...]:
    """One path for every level of the other conditions that has two loads or more; *fits*: those of all tests of the matrix.

    ConfigError where x or y is no displacement. Equation (comp-path).
    """
    number = [axis.name for axis in matrix.axes].index(settings.load)
    groups: dict[tuple[int, ...], list[MatrixPoint]] = {}
    for point in matrix.points:
        groups.setdefault(point.place[:number] + point.place[number + 1 :], []).append(point)
    paths = []
    for others, points in groups.items():
        if len(points) > 1:
            ordered = sorted(points, key=lambda point: point.place[number])
            loads = np.array([matrix.axes[number].levels[point.place[number]] for point in ordered])
            paths.append(EquilibriumPath(_at(matrix, number, others), _path(settings, loads, ordered, fits), settings.clearance))
    return tuple(paths)


def _at(matrix: ConditionMatrix, number: int, others: tuple[int, ...]) -> str:
    axes = [axis for n, axis in enumerate(matrix.axes) if n != number]
    return ", ".join(axis.text(axis.levels[n]) for axis, n in zip(axes, others, strict=True))


def _path(settings: EquilibriumSettings, loads: FloatArray, points: Sequence[MatrixPoint], fits: Sequence[Fit]) -> tuple[PathPoint, ...]:
    """Rest positions with the slope of the parabola through each point and its neighbours; at the ends, of the outer three."""
    rest = [_rest(settings, point) for point in points]
    position = np.array([place for place, _ in rest])
    error = np.array([spread for _, spread in rest])
    path = []
    for n, point in enumerate(points):
        weights = _slope_weights(loads, n)
        slope = weights @ position
        slope_error = np.sqrt(weights**2 @ error**2)
        away = position[n] - np.array(settings.centre)
        shaking = _shaken(settings, [fit for fit in fits if fit.test in point.tests])
        path.append(
            PathPoint(
                float(loads[n]),
                _pair(away),
                _pair(error[n]),
                float(np.hypot(*away)),
                float(np.angle(np.exp(1j * (np.arctan2(away[1], away[0]) - settings.direction)))),
                statics=_pair(slope),
                statics_error=_pair(slope_error),
                shaking=() if shaking is None else _pair(shaking[0]),
                shaking_error=() if shaking is None else _pair(np.sqrt(np.diag(shaking[1]))),
                p_value=None if shaking is None else _chance(slope - shaking[0], np.diag(slope_error**2) + shaking[1]),
            )
        )
    return tuple(path)


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _rest(settings: EquilibriumSettings, point: MatrixPoint) -> tuple[list[float], list[float]]:
    """Mean position (x, y) [m] and its standard errors from the scatter of the repeats."""
    beside = {entry.name: entry for entry in point.beside}
    for name in (settings.x, settings.y):
        if beside[name].unit != QUANTITIES["displacement"].si_unit:
            raise ConfigError(f"the condition '{name}' is no displacement but in {beside[name].unit}", hint="{channel: d_x}, its mean")
    entries = [beside[settings.x], beside[settings.y]]
    return [entry.value for entry in entries], [entry.scatter / np.sqrt(len(point.tests)) for entry in entries]


def _slope_weights(loads: FloatArray, n: int) -> FloatArray:
    """Weights (n_load,) [1/N] of the positions in the slope at load n: derivative of the parabola through three loads, or of a line."""
    first = min(max(n - 1, 0), max(loads.size - 3, 0))
    members = np.arange(first, min(first + 3, loads.size))
    weights: FloatArray = np.zeros(loads.size)
    for i in members:
        others = [j for j in members if j != i]
        below = np.prod([loads[i] - loads[j] for j in others])
        weights[i] = sum(np.prod([loads[n] - loads[k] for k in others if k != j]) for j in others) / below
    return weights


@dataclass(frozen=True)
class _Compliance:
    """One fit's displacement per force *value* (2,) [m/N], its covariance (2, 2) by noise, and its change (2,) by every source."""

    value: FloatArray
    covariance: FloatArray
    changes: Mapping[str, FloatArray]


def _shaken(settings: EquilibriumSettings, fits: Sequence[Fit]) -> tuple[FloatArray, FloatArray] | None:
    """Displacement per force along the load, (K + k_s I)^-1 u (2,) [m/N], mean of the repeats, and its covariance (2, 2).

    Noise is independent from repeat to repeat; an error that repeats have in common does not shrink in their mean.
    """
    results = [result for fit in fits if (result := _compliance(settings, fit)) is not None]
    if not results:
        return None
    mean = np.mean([result.value for result in results], axis=0)
    covariance = sum(result.covariance for result in results) / len(results) ** 2
    for source in dict.fromkeys(source for result in results for source in result.changes):
        change = sum(result.changes.get(source, np.zeros(2)) for result in results) / len(results)
        covariance = covariance + np.outer(change, change)
    return np.asarray(mean), np.asarray(covariance)


def _compliance(settings: EquilibriumSettings, fit: Fit) -> _Compliance | None:
    """One fit's (K + k_s I)^-1 u with its errors, d(K^-1 u) = -K^-1 dK K^-1 u; None where a coefficient or an error is missing."""
    estimated = [parameter.name for parameter in fit.parameters if not parameter.derived]
    if not all(name in estimated for name in STIFFNESS):
        return None
    chosen = [fit.parameter(name) for name in STIFFNESS]
    errors = np.array([np.nan if (error := random_error(fit, parameter)) is None else error for parameter in chosen])
    stiffness = np.array([parameter.value for parameter in chosen]).reshape(2, 2) + settings.support * np.eye(2)
    if not np.all(np.isfinite(errors)) or abs(np.linalg.det(stiffness)) == 0:
        return None
    inverse = np.linalg.inv(stiffness)
    displacement = inverse @ np.array([np.cos(settings.direction), np.sin(settings.direction)])
    slopes = np.column_stack([-inverse[:, row] * displacement[column] for row in (0, 1) for column in (0, 1)])
    places = [estimated.index(name) for name in STIFFNESS]
    covariance = fit.correlation[np.ix_(places, places)] * np.outer(errors, errors)
    sources = () if fit.budget is None else fit.budget.sources
    changes = {source.source: slopes @ np.array([change_in(fit, source.source, name) for name in STIFFNESS]) for source in sources}
    return _Compliance(displacement, slopes @ covariance @ slopes.T, changes)


def _chance(difference: FloatArray, covariance: FloatArray) -> float | None:
    """Probability of so large a difference (2,) [m/N] by its covariance (2, 2); None where that is singular."""
    if not np.linalg.det(covariance) > 0:
        return None
    return chi2_tail(float(difference @ np.linalg.solve(covariance, difference)), 2)
