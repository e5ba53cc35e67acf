"""A matrix of tests: the coefficients of one fit at every level of every condition, their repeats averaged."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.amounts import chance
from labpipe.campaign.bandwise import holm
from labpipe.campaign.equilibrium_path import equilibrium_paths
from labpipe.campaign.levels import levels_of
from labpipe.campaign.matrix_settings import MatrixSettings
from labpipe.campaign.repeats import repeated
from labpipe.campaign.validity import amplitude_statement
from labpipe.errors import ConfigError, FitError
from labpipe.quantities import UnitError, si_amount
from labpipe.records.condition_matrix import Beside, ConditionAxis, ConditionMatrix, MatrixPoint, Repeated
from labpipe.records.finding import WARNING, Finding, of_level
from labpipe.records.identification import Fit
from labpipe.records.parameter import Parameter
from labpipe.registry import nearest

# From the conditions of a point and their SI units to the coefficients of a theory by name [SI]: those that it has there.
PointTheory = Callable[[tuple[float, ...], tuple[str, ...]], Mapping[str, float]]


def condition_matrix(
    settings: MatrixSettings, fits: Sequence[Fit], conditions: Mapping[str, Mapping[str, Any]], theory: PointTheory | None = None
) -> ConditionMatrix:
    """The matrix of the settings; *conditions* of every test by its name.

    ConfigError for an unknown fit, coefficient or condition, FitError where no test has a result.
    """
    chosen = _chosen(settings, fits)
    amounts = {name: _amounts(name, chosen, conditions) for name in dict.fromkeys((*settings.over, *settings.beside, *_of_path(settings)))}
    axes, places = _axes(settings, amounts)
    names = _names(settings, chosen)
    groups: dict[tuple[int, ...], list[int]] = {}
    for number, place in enumerate(places):
        groups.setdefault(place, []).append(number)
    cells = ((place, [chosen[n] for n in members], members) for place, members in sorted(groups.items()))
    points = tuple(_point(settings, place, of_place, members, names, amounts) for place, of_place, members in cells)
    matrix = ConditionMatrix(name=settings.name, fit=settings.fit, axes=axes, names=names, points=points, missing=_missing(axes, groups))
    if theory is not None:
        matrix = replace(matrix, points=tuple(_beside_theory(matrix, point, theory) for point in points))
    if settings.path is not None:
        matrix = replace(matrix, paths=equilibrium_paths(settings.path, matrix, chosen))
    return _judged(matrix, settings)


@dataclass(frozen=True)
class Amounts:
    """A condition of all tests: its unit and values (n_test,) [unit, an SI unit]."""

    unit: str
    values: FloatArray


def _chosen(settings: MatrixSettings, fits: Sequence[Fit]) -> list[Fit]:
    """The fit of every test; ConfigError where a test has several."""
    chosen = [fit for fit in fits if fit.name == settings.fit]
    if not chosen:
        raise FitError(f"no test has a fit '{settings.fit}'")
    tests = [fit.test for fit in chosen]
    twice = next((test for test in tests if tests.count(test) > 1), None)
    if twice is not None:
        raise ConfigError(f"fit '{settings.fit}' has several results in test '{twice}'", hint="fit one band")
    return chosen


def _of_path(settings: MatrixSettings) -> tuple[str, ...]:
    return () if settings.path is None else (settings.path.x, settings.path.y)


def _amounts(name: str, fits: Sequence[Fit], conditions: Mapping[str, Mapping[str, Any]]) -> Amounts:
    """A condition of every test in SI; ConfigError for a test that lacks it, or has it in another dimension."""
    pairs = []
    for fit in fits:
        of_test = conditions.get(fit.test, {})
        if name not in of_test:
            hint = nearest(name, of_test) if of_test else "write it under the test's `conditions`"
            raise ConfigError(f"test '{fit.test}' has no condition '{name}'", hint=hint)
        try:
            pairs.append(si_amount(of_test[name]))
        except UnitError as error:
            raise ConfigError(f"condition {name} of test '{fit.test}': {error.what}", hint=error.hint) from None
    units = sorted({unit for _, unit in pairs})
    if len(units) > 1:
        raise ConfigError(f"the condition '{name}' has the units {', '.join(units)}", hint="write it in one dimension")
    return Amounts(units[0], np.array([value for value, _ in pairs]))


def _axes(settings: MatrixSettings, amounts: Mapping[str, Amounts]) -> tuple[tuple[ConditionAxis, ...], list[tuple[int, ...]]]:
    """The axes with their levels, and the place of every test on them."""
    axes, numbers = [], []
    for name in settings.over:
        levels, number = levels_of(amounts[name].values, settings.tolerance)
        axes.append(ConditionAxis(name, amounts[name].unit, tuple(levels.tolist())))
        numbers.append(number.tolist())
    return tuple(axes), list(zip(*numbers, strict=True))


def _names(settings: MatrixSettings, fits: Sequence[Fit]) -> tuple[str, ...]:
    """The coefficients of the matrix: those named, or those that all tests have."""
    common = [p.name for p in fits[0].parameters if all(any(q.name == p.name for q in fit.parameters) for fit in fits)]
    for name in settings.parameters:
        if not any(parameter.name == name for fit in fits for parameter in fit.parameters):
            names = [parameter.name for parameter in fits[0].parameters]
            raise ConfigError(f"fit '{settings.fit}' has no '{name}'", hint=nearest(name, names), field="parameters")
    return settings.parameters or tuple(common)


def _point(
    settings: MatrixSettings,
    place: tuple[int, ...],
    fits: Sequence[Fit],
    members: Sequence[int],
    names: Sequence[str],
    amounts: Mapping[str, Amounts],
) -> MatrixPoint:
    of_name = {name: [p for fit in fits for p in fit.parameters if p.name == name] for name in names}
    beside = []
    for name in (*settings.beside, *_of_path(settings)):
        measured = amounts[name].values[list(members)]
        scatter = float(np.std(measured, ddof=1)) if measured.size > 1 else 0.0
        beside.append(Beside(name, float(np.mean(measured)), scatter, amounts[name].unit))
    codes = dict.fromkeys(finding.code for fit in fits for finding in of_level(WARNING, fit.findings))
    values = tuple(repeated(parameters) for parameters in of_name.values() if parameters)
    return MatrixPoint(place, tuple(fit.test for fit in fits), values, tuple(beside), tuple(codes))


def _missing(axes: Sequence[ConditionAxis], places: Mapping[tuple[int, ...], Any]) -> tuple[tuple[int, ...], ...]:
    every = itertools.product(*(range(len(axis.levels)) for axis in axes))
    return tuple(place for place in every if place not in places)


def _beside_theory(matrix: ConditionMatrix, point: MatrixPoint, theory: PointTheory) -> MatrixPoint:
    expected = theory(matrix.levels_of(point), tuple(axis.unit for axis in matrix.axes))
    values = tuple(replace(value, theory=expected.get(value.parameter.name)) for value in point.values)
    return replace(point, values=values)


def _judged(matrix: ConditionMatrix, settings: MatrixSettings) -> ConditionMatrix:
    """The matrix with its amounts, findings and statement."""
    values = [(point, value) for point in matrix.points for value in point.values]
    tested = [(point, value) for point, value in values if value.p_value is not None and not value.parameter.derived]
    corrected = holm(np.array([value.p_value for _, value in tested]))
    apart = [pair for pair, p in zip(tested, corrected, strict=True) if p < settings.level]
    holding = [value.holds_theory for _, value in values if value.holds_theory is not None]
    tests = sum(len(point.tests) for point in matrix.points)
    amounts = [
        *(_largest_error(matrix, name) for name in matrix.names),
        Parameter("points", float(len(matrix.points)), "1", derived=True),
        Parameter("missing", float(len(matrix.missing)), "1", derived=True),
        Parameter("repeats_apart", float(len(apart)), "1", derived=True),
        chance("theory_share", float(np.mean(holding)) if holding else None),
    ]
    grid = " x ".join(f"{len(axis.levels)} {axis.name}" for axis in matrix.axes)
    statement = f"{matrix.fit}: {tests} tests at {len(matrix.points)} points ({grid})"
    statement += f", {len(matrix.missing)} combinations without a test" if matrix.missing else ""
    if holding:
        statement += f"; the theory lies in {sum(holding)} of {len(holding)} 95 % intervals"
    amplitude = amplitude_statement(matrix, settings.level)
    whole = f"{statement}.{f' {amplitude}.' if amplitude else ''}"
    return replace(matrix, amounts=tuple(amounts), findings=_repeats_findings(matrix, apart), statement=whole)


def _largest_error(matrix: ConditionMatrix, name: str) -> Parameter:
    """The largest standard error of a coefficient relative to its value over all points."""
    values = [value.parameter for point in matrix.points if (value := point.value(name)) is not None]
    errors = [p.full_error / abs(p.value) for p in values if p.full_error is not None and p.value]
    return Parameter(f"{name}.largest_error", max(errors, default=float("nan")), "1", derived=True)


def _repeats_findings(matrix: ConditionMatrix, apart: Sequence[tuple[MatrixPoint, Repeated]]) -> tuple[Finding, ...]:
    """One warning of all points whose repeats scatter more than their errors."""
    if not apart:
        return ()
    point, value = max(apart, key=lambda pair: (pair[1].scatter or 0.0) / abs(pair[1].parameter.value or 1.0))
    share = 100 * (value.scatter or 0.0) / abs(value.parameter.value or 1.0)
    worst = f"most at {matrix.text_of(point)}, where {value.parameter.name} scatters by {share:.2g} %"
    message = (
        f"repeats scatter more than their standard errors for {len(apart)} coefficients at "
        f"{len({p.place for p, _ in apart})} of {len(matrix.points)} points, {worst}; the errors of the means are enlarged accordingly. "
        "Something changes between repeats: temperature, remounting, the setting of the condition"
    )
    return (Finding("repeats-apart", message),)
