"""A matrix of tests: coefficients at every level of every condition, repeats averaged, and the path of the
rest position.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import coverage_factor, f_tail, normal_tail, student_quantile
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.quantities import QUANTITIES
from labpipe.records import comparison
from labpipe.records.finding import WARNING, Finding, Parameter, of_level
from labpipe.records.identification import Fit, changes_of, dofs_of
from labpipe.registry import nearest
from labpipe.uncertainty.amounts import chance, change_in, holm, random_error
from labpipe.uncertainty.observations import amounts_of, check_single
from labpipe.uncertainty.settings import EquilibriumSettings, MatrixSettings, levels_of
from labpipe.uncertainty.weighted import weighted_mean


def repeat(parameters: Sequence[Parameter], given_dof: float = np.inf) -> comparison.Repeated:
    """The mean of parameters of one name and unit, weighted by their standard errors.

    Errors by noise, and by the scatter of recordings that a test is the mean of, are enlarged where the
    repeats scatter more; the mean of what stands in the full errors beyond these is common to them and does
    not shrink, with *given_dof* degrees of freedom behind it. Where a repeat has no error, the plain mean
    with the standard error of their scatter. Equation (comp-repeats).
    """
    values = np.array([parameter.value for parameter in parameters])
    if values.size == 1:
        return comparison.Repeated(parameters[0], 1)
    scatter = float(np.std(values, ddof=1))
    errors = np.array([_error_alone(parameter) for parameter in parameters])
    if not np.all(errors > 0):
        plain, error = float(np.mean(values)), scatter / float(np.sqrt(values.size))
        reach = float(student_quantile(0.975, values.size - 1) * error)
        parameter = _parameter(parameters[0], plain, error, error, reach)
        return comparison.Repeated(parameter, values.size, scatter=scatter)
    mean = weighted_mean(values, errors)
    full = np.array([parameter.full_error or 0.0 for parameter in parameters])
    common = float(np.mean(np.sqrt(np.maximum(full**2 - errors**2, 0.0))))
    noise = mean.std_error(0)
    whole = float(np.hypot(noise, common))
    # Student's quantile belongs to the part that was estimated from the scatter.
    reach = float(np.hypot(mean.quantile(0) * noise, coverage_factor(0.95, given_dof) * common))
    parameter = _parameter(parameters[0], float(mean.values[0]), noise, whole, reach)
    return comparison.Repeated(parameter, values.size, scatter=scatter, p_value=mean.p_value)


def _error_alone(parameter: Parameter) -> float:
    """Standard error by noise and by the scatter of a test's own recordings [unit of the parameter], which no
    other test shares; NaN where there is none.
    """
    recordings = 0.0 if parameter.interval is None else parameter.interval.repeats
    return float(np.hypot(np.nan if parameter.std_error is None else parameter.std_error, recordings))


def _given_dof(fit: Fit, name: str) -> float:
    """Degrees of freedom [1] behind what given numbers add to the uncertainty of a parameter."""
    if fit.budget is None or name not in fit.budget.names:
        return np.inf
    given = replace(fit.budget, random=np.zeros(len(fit.budget.names)))
    return float(given.dof[given.names.index(name)])


def _parameter(like: Parameter, value: float, noise: float, whole: float, reach: float) -> Parameter:
    if not whole > 0:
        without = replace(like, value=value, std_error=None, std_error_inflated=None, ci95=None)
        return replace(without, t_ratio=None, significant=None)
    return Parameter(
        like.name,
        value,
        like.unit,
        std_error=noise,
        t_ratio=value / whole,
        ci95=(value - reach, value + reach),
        significant=abs(value) > reach,
        derived=like.derived,
        std_error_inflated=whole if whole > noise else None,
    )


# Up to which amplitude of motion coefficients are those of small motions.

# A condition of this dimension and with a name that begins so is the size of the motion.
AMPLITUDES = ("amplitude", "orbit")


def amplitude_statement(matrix: comparison.ConditionMatrix, level: float) -> str:
    """The largest amplitude whose coefficients do not differ from those at the smallest, as a sentence; empty
    where none is tested.

    Each coefficient at each amplitude against that at the smallest, at equal other conditions, by the errors
    of noise, with Holm's correction over all of them, at *level* [1]. Equation
    (comp-validity).
    """
    sizes = [axis.unit == "m" and axis.name.lower().startswith(AMPLITUDES) for axis in matrix.axes]
    if True not in sizes:
        return ""
    place = sizes.index(True)
    # (level of the amplitude, coefficient, p-value against the smallest amplitude).
    pairs = [
        (point.place[place], name, p_value)
        for points in _along(matrix, place).values()
        for point, name in itertools.product(points[1:], matrix.names)
        if (p_value := _chance(points[0], point, name)) is not None
    ]
    if not pairs:
        return ""
    corrected = holm(np.array([chance for _, _, chance in pairs]))
    differing = [(number, name) for (number, name, _), p in zip(pairs, corrected, strict=True) if p < level]
    axis = matrix.axes[place]
    if not differing:
        return f"No coefficient differs up to {axis.text(axis.levels[-1])}"
    first = min(number for number, _ in differing)
    names = ", ".join(dict.fromkeys(name for number, name in differing if number == first))
    valid, changed = axis.text(axis.levels[first - 1]), axis.text(axis.levels[first])
    return f"The coefficients of small motions hold up to {valid}; at {changed} {names} differ"


def _along(
    matrix: comparison.ConditionMatrix, axis: int
) -> dict[tuple[int, ...], list[comparison.MatrixPoint]]:
    groups: dict[tuple[int, ...], list[comparison.MatrixPoint]] = {}
    for point in sorted(matrix.points, key=lambda point: point.place[axis]):
        groups.setdefault(point.place[:axis] + point.place[axis + 1 :], []).append(point)
    return groups


def _chance(first: comparison.MatrixPoint, other: comparison.MatrixPoint, name: str) -> float | None:
    pair = [value.parameter for point in (first, other) if (value := point.value(name)) is not None]
    errors = [parameter.std_error for parameter in pair if parameter.std_error is not None]
    if len(errors) < 2 or pair[0].derived or not any(errors):
        return None
    return 2 * normal_tail(abs(pair[1].value - pair[0].value) / float(np.linalg.norm(errors)))


# The path of the shaft's rest position over the static load, and its slope against the stiffness from
# shaking.

STIFFNESS = ("k_xx", "k_xy", "k_yx", "k_yy")


def equilibrium_paths(
    settings: EquilibriumSettings, matrix: comparison.ConditionMatrix, fits: Sequence[Fit]
) -> tuple[comparison.EquilibriumPath, ...]:
    """One path for every level of the other conditions that has two loads or more; *fits*: those of all tests
    of the matrix. ConfigError where x or y is not a displacement, or the load no force. Equation (comp-path).
    """
    number = [axis.name for axis in matrix.axes].index(settings.load)
    if matrix.axes[number].unit != QUANTITIES["force"].si_unit:
        what = (
            f"the condition '{settings.load}' is not a force but in {matrix.axes[number].unit or 'no unit'}"
        )
        raise SettingError("path", what, "write the load as a force, for example 50 N")
    axes = [axis for axis in matrix.axes if axis.name != settings.load]
    paths = []
    # In the order of the other conditions.
    for others, points in sorted(_along(matrix, number).items()):
        if len(points) > 1:
            loads = np.array([matrix.axes[number].levels[point.place[number]] for point in points])
            at = ", ".join(axis.text(axis.levels[n]) for axis, n in zip(axes, others, strict=True))
            path = _path(settings, loads, points, fits)
            paths.append(comparison.EquilibriumPath(at, path, settings.clearance))
    return tuple(paths)


def _path(
    settings: EquilibriumSettings,
    loads: FloatArray,
    points: Sequence[comparison.MatrixPoint],
    fits: Sequence[Fit],
) -> tuple[comparison.PathPoint, ...]:
    """Rest positions with the slope of the parabola through each point and its neighbours. At the ends, of
    the outer three.
    """
    rest = np.array([_rest(settings, point) for point in points])
    position, spread = rest[:, 0], rest[:, 1]
    count = np.array([len(point.tests) for point in points])
    # One scatter of the rest position at all loads; where no load is repeated it is not known.
    dof = int(np.sum(count - 1))
    scatter = np.sqrt((count - 1) @ spread**2 / dof) if dof else np.full(2, np.nan)
    error = scatter / np.sqrt(count)[:, None]
    path = []
    for n, point in enumerate(points):
        weights = _slope_weights(loads, n)
        slope = weights @ position
        slope_error = np.sqrt(weights**2 @ error**2)
        away = position[n] - np.array(settings.centre)
        there = comparison.PathPoint(
            float(loads[n]),
            _pair(away),
            _pair(error[n]),
            float(np.hypot(*away)),
            float(np.angle(np.exp(1j * (np.arctan2(away[1], away[0]) - settings.direction)))),
            statics=_pair(slope),
            statics_error=_pair(slope_error),
        )
        shaking = mean_compliance(settings, [fit for fit in fits if fit.test in point.tests])
        if shaking is not None:
            there = replace(
                there,
                shaking=_pair(shaking[0]),
                shaking_error=_pair(np.sqrt(np.diag(shaking[1]))),
                p_value=_chance_of_slopes(slope - shaking[0], np.diag(slope_error**2), shaking[1], dof),
            )
        path.append(there)
    return tuple(path)


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _rest(settings: EquilibriumSettings, point: comparison.MatrixPoint) -> list[list[float]]:
    beside = {entry.name: entry for entry in point.beside}
    entries = [beside[settings.x], beside[settings.y]]
    for entry in entries:
        if entry.unit != QUANTITIES["displacement"].si_unit:
            what = f"the condition '{entry.name}' is not a displacement but in {entry.unit}"
            raise ConfigError(what, hint="{channel: d_x}, its mean")
    return [[entry.value for entry in entries], [entry.scatter for entry in entries]]


def _slope_weights(loads: FloatArray, n: int) -> FloatArray:
    """Weights (n_load,) [1/N] of the positions in the slope at load n: derivative of the parabola through
    three loads, or of a line.
    """
    first = min(max(n - 1, 0), max(loads.size - 3, 0))
    near = loads[first : first + 3] - loads[n]
    weights: FloatArray = np.zeros(loads.size)
    # Over the range, powers of loads of any size are alike.
    powers = np.vander(near / np.ptp(near), increasing=True)
    weights[first : first + 3] = np.linalg.inv(powers)[1] / np.ptp(near)
    return weights


# One fit's displacement per force (2,) [m/N], its covariance (2, 2) by noise, and its change (2,) by every
# source.
_Compliance = tuple[FloatArray, FloatArray, dict[str, FloatArray]]


def mean_compliance(
    settings: EquilibriumSettings, fits: Sequence[Fit]
) -> tuple[FloatArray, FloatArray] | None:
    """Displacement per force along the load, (K + k_s I)^-1 u (2,) [m/N], mean of the repeats, and its
    covariance (2, 2); an error that repeats have in common does not shrink in it.
    """
    results = [result for fit in fits if (result := _compliance(settings, fit)) is not None]
    if not results:
        return None
    values, covariances, changes = zip(*results, strict=True)
    covariance = np.sum(covariances, axis=0) / len(results) ** 2
    for source in dict.fromkeys(source for of_fit in changes for source in of_fit):
        change = np.mean([of_fit.get(source, np.zeros(2)) for of_fit in changes], axis=0)
        covariance = covariance + np.outer(change, change)
    return np.mean(values, axis=0), covariance


def _compliance(settings: EquilibriumSettings, fit: Fit) -> _Compliance | None:
    """One fit's (K + k_s I)^-1 u with its errors, d(K^-1 u) = -K^-1 dK K^-1 u. None where a coefficient or an
    error is missing.
    """
    estimated = [parameter.name for parameter in fit.estimated]
    if not all(name in estimated for name in STIFFNESS):
        return None
    chosen = [fit.parameter(name) for name in STIFFNESS]
    # None, where there is no error, becomes NaN.
    errors = np.array([random_error(fit, parameter) for parameter in chosen], np.float64)
    stiffness = np.array([parameter.value for parameter in chosen]).reshape(2, 2)
    stiffness = stiffness + settings.support * np.eye(2)
    if not np.all(np.isfinite(errors)) or abs(np.linalg.det(stiffness)) == 0:
        return None
    inverse = np.linalg.inv(stiffness)
    displacement = inverse @ np.array([np.cos(settings.direction), np.sin(settings.direction)])
    slopes = np.column_stack([-inverse[:, row] * displacement[column] for row in (0, 1) for column in (0, 1)])
    places = [estimated.index(name) for name in STIFFNESS]
    covariance = fit.correlation[np.ix_(places, places)] * np.outer(errors, errors)
    changes = {
        of.source: slopes @ np.array([change_in(fit, of.source, key) for key in STIFFNESS])
        for of in (() if fit.budget is None else fit.budget.sources)
    }
    return displacement, slopes @ covariance @ slopes.T, changes


def _chance_of_slopes(
    difference: FloatArray, estimated: FloatArray, stated: FloatArray, dof: int
) -> float | None:
    """Probability of so large a difference (2,) [m/N] by its covariance (2, 2), of which a part was
    *estimated* from scatter with *dof* degrees of freedom. None without these, or where the whole is
    singular.
    """
    covariance = estimated + stated
    if dof == 0 or not np.linalg.det(covariance) > 0:
        return None
    whole_dof = dof * (np.trace(covariance) / np.trace(estimated)) ** 2 if np.any(estimated) else np.inf
    return f_tail(float(difference @ np.linalg.solve(covariance, difference)) / 2, 2, whole_dof)


# A matrix of tests: the coefficients of one fit at every level of every condition, their repeats averaged.

# From the conditions of a point and their SI units to the coefficients of a theory by name [SI]: those that
# it has there.
PointTheory = Callable[[tuple[float, ...], tuple[str, ...]], Mapping[str, float]]


def condition_matrix(
    settings: MatrixSettings,
    fits: Sequence[Fit],
    conditions: Mapping[str, Mapping[str, Any]],
    theory: PointTheory | None = None,
) -> comparison.ConditionMatrix:
    """The matrix of the settings; *conditions* of every test by its name. ConfigError for an unknown fit,
    coefficient or condition, FitError where no test has a result.
    """
    chosen = _choose(settings, fits)
    asked = dict.fromkeys((*settings.over, *settings.beside, *_of_path(settings)))
    amounts = {name: amounts_of(name, chosen, conditions) for name in asked}
    axes, places = _axes(settings, amounts)
    names = _names(settings, chosen)
    groups: dict[tuple[int, ...], list[int]] = {}
    for number, place in enumerate(places):
        groups.setdefault(place, []).append(number)
    points = tuple(
        _point(settings, place, [chosen[n] for n in members], members, names, amounts)
        for place, members in sorted(groups.items())
    )
    every = itertools.product(*(range(len(axis.levels)) for axis in axes))
    matrix = comparison.ConditionMatrix(
        name=settings.name,
        fit=settings.fit,
        axes=axes,
        names=names,
        points=points,
        missing=tuple(place for place in every if place not in groups),
    )
    if theory is not None:
        matrix = replace(matrix, points=tuple(_beside_theory(matrix, point, theory) for point in points))
    if settings.path is not None:
        matrix = replace(matrix, paths=equilibrium_paths(settings.path, matrix, chosen))
    return _judge(
        matrix, settings, [name for name in differing_words(points, conditions) if name not in asked]
    )


# A condition of all tests: its SI unit, and values (n_test,) in it.
_Amounts = tuple[str, FloatArray]


def _choose(settings: MatrixSettings, fits: Sequence[Fit]) -> list[Fit]:
    chosen = [fit for fit in fits if fit.name == settings.fit]
    if not chosen:
        raise FitError(f"no test has a fit '{settings.fit}'")
    check_single(chosen, "fit one band, of one FRF for each test")
    return chosen


def _of_path(settings: MatrixSettings) -> tuple[str, ...]:
    return () if settings.path is None else (settings.path.x, settings.path.y)


def _axes(
    settings: MatrixSettings, amounts: Mapping[str, _Amounts]
) -> tuple[tuple[comparison.ConditionAxis, ...], list[tuple[int, ...]]]:
    axes, numbers = [], []
    for name in settings.over:
        unit, values = amounts[name]
        # Temperatures compare as people write them: 20 and 25 degC are no level of 293 K.
        zero = 273.15 if unit == "K" else 0.0
        levels, number = levels_of(values - zero, settings.tolerance)
        levels = levels + zero
        axes.append(comparison.ConditionAxis(name, unit, tuple(levels.tolist())))
        numbers.append(number.tolist())
    return tuple(axes), list(zip(*numbers, strict=True))


def _names(settings: MatrixSettings, fits: Sequence[Fit]) -> tuple[str, ...]:
    names_of = [[parameter.name for parameter in fit.parameters] for fit in fits]
    for name in settings.parameters:
        if not any(name in names for names in names_of):
            what = f"fit '{settings.fit}' has no '{name}'"
            raise SettingError("parameters", what, nearest(name, names_of[0]))
    common = tuple(name for name in names_of[0] if all(name in names for names in names_of))
    return settings.parameters or common


def _point(
    settings: MatrixSettings,
    place: tuple[int, ...],
    fits: Sequence[Fit],
    members: Sequence[int],
    names: Sequence[str],
    amounts: Mapping[str, _Amounts],
) -> comparison.MatrixPoint:
    of_name = {name: [(fit, p) for fit in fits for p in fit.parameters if p.name == name] for name in names}
    beside = []
    for name in (*settings.beside, *_of_path(settings)):
        unit, measured = amounts[name]
        measured = measured[list(members)]
        scatter = float(np.std(measured, ddof=1)) if measured.size > 1 else 0.0
        beside.append(comparison.Beside(name, float(np.mean(measured)), scatter, unit))
    codes = dict.fromkeys(finding.code for fit in fits for finding in of_level(WARNING, fit.findings))
    values = tuple(_with_changes(name, pairs) for name, pairs in of_name.items() if pairs)
    return comparison.MatrixPoint(place, tuple(fit.test for fit in fits), values, tuple(beside), tuple(codes))


def _with_changes(name: str, pairs: Sequence[tuple[Fit, Parameter]]) -> comparison.Repeated:
    """The mean of a coefficient over its repeats, with what moves it and those of other points alike."""
    mean = repeat([parameter for _, parameter in pairs], min(_given_dof(fit, name) for fit, _ in pairs))
    each = [changes_of(fit, parameter) for fit, parameter in pairs]
    sources = dict.fromkeys(source for changes in each for source in changes)
    shared = {of: sum(changes.get(of, 0.0) for changes in each) / len(each) for of in sources}
    dofs = {source: dof for fit, _ in pairs for source, dof in dofs_of(fit).items()}
    return replace(mean, changes=shared, dofs=dofs)


def _beside_theory(
    matrix: comparison.ConditionMatrix, point: comparison.MatrixPoint, theory: PointTheory
) -> comparison.MatrixPoint:
    expected = theory(matrix.levels_of(point), tuple(axis.unit for axis in matrix.axes))
    values = tuple(replace(value, theory=expected.get(value.parameter.name)) for value in point.values)
    return replace(point, values=values)


def differing_words(
    points: Sequence[comparison.MatrixPoint], conditions: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Conditions in words, such as a design, that differ between tests of one point."""
    named = {name: None for point in points for test in point.tests for name in conditions.get(test, {})}
    return [
        name
        for name in named
        if any(
            len(said := {conditions.get(test, {}).get(name) for test in point.tests}) > 1
            and not all(re.match(r"[-+.\d]", str(value)) for value in said)
            for point in points
        )
    ]


def _judge(
    matrix: comparison.ConditionMatrix, settings: MatrixSettings, differing: Sequence[str]
) -> comparison.ConditionMatrix:
    values = [(point, value) for point in matrix.points for value in point.values]
    tested = [pair for pair in values if pair[1].p_value is not None and not pair[1].parameter.derived]
    corrected = holm(np.array([value.p_value for _, value in tested]))
    apart = [pair for pair, p in zip(tested, corrected, strict=True) if p < settings.level]
    holding = [value.holds_theory for _, value in values if value.holds_theory is not None]
    tests = sum(len(point.tests) for point in matrix.points)
    counted = {"points": matrix.points, "missing": matrix.missing, "repeats_apart": apart}
    amounts = [
        *(_largest_error(matrix, name) for name in matrix.names),
        *(Parameter(name, float(len(of)), "1", derived=True) for name, of in counted.items()),
        chance("theory_share", float(np.mean(holding)) if holding else None),
    ]
    grid = " x ".join(f"{len(axis.levels)} {axis.name}" for axis in matrix.axes)
    statement = f"{matrix.fit}: {tests} tests at {len(matrix.points)} points ({grid})"
    statement += f", {len(matrix.missing)} combinations without a test" if matrix.missing else ""
    if holding:
        statement += f"; the theory lies in {sum(holding)} of {len(holding)} 95 % intervals"
    amplitude = amplitude_statement(matrix, settings.level)
    whole = f"{statement}.{f' {amplitude}.' if amplitude else ''}"
    return replace(
        matrix, amounts=tuple(amounts), findings=_repeats_findings(matrix, apart, differing), statement=whole
    )


def _largest_error(matrix: comparison.ConditionMatrix, name: str) -> Parameter:
    values = [value.parameter for point in matrix.points if (value := point.value(name)) is not None]
    errors = [p.full_error / abs(p.value) for p in values if p.full_error is not None and p.value]
    return Parameter(f"{name}.largest_error", max(errors, default=float("nan")), "1", derived=True)


def _repeats_findings(
    matrix: comparison.ConditionMatrix,
    apart: Sequence[tuple[comparison.MatrixPoint, comparison.Repeated]],
    differing: Sequence[str],
) -> tuple[Finding, ...]:
    if not apart:
        return ()
    shares = [100 * (of.scatter or 0.0) / abs(of.parameter.value or 1.0) for _, of in apart]
    point, value = apart[int(np.argmax(shares))]
    worst = f"most at {matrix.text_of(point)}, where {value.parameter.name} scatters by {max(shares):.2g} %"
    cause = "Something changes between repeats: temperature, remounting, the setting of the condition"
    if differing:
        named = ", ".join(differing)
        cause = f"Tests of one point are no repeats, but differ in {named}: name it in `over`, as a number"
    message = (
        f"repeats scatter more than their standard errors for {len(apart)} coefficients at "
        f"{len({p.place for p, _ in apart})} of {len(matrix.points)} points, {worst}; the errors of the "
        f"means are enlarged accordingly. {cause}"
    )
    return (Finding("repeats-apart", message),)
