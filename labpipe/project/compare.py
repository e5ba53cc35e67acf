"""The sections compare and matrix: fits of all tests against each other or theory, or by conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.kinds import BearingCoefficients
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.project.bearing_file import open_bearing
from labpipe.project.judging import comparison_outcome, matrix_outcome
from labpipe.project.marked_yaml import set_entry
from labpipe.project.pipeline_file import read_comparison, read_matrix
from labpipe.project.work import COMPARE_PREFIX, Work
from labpipe.quantities import locate_units, name_of_dimension, parse_unit, parse_value
from labpipe.raw_files.table import open_table
from labpipe.records.comparison import (
    Comparison,
    Comparisons,
    ConditionMatrices,
    ConditionMatrix,
    findings,
    matrix_findings,
    names,
)
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Failed, ListedParameter
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import COEFFICIENT_UNITS
from labpipe.registry import nearest
from labpipe.report.comparison import comparison_sections
from labpipe.report.condition_matrix import matrix_sections
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.matrix import PointTheory, condition_matrix
from labpipe.uncertainty.settings import CompareSettings, MatrixSettings, comparison_kind, levels_of


def run_comparisons(settings: Sequence[CompareSettings], work: Work) -> Comparisons:
    """The section compare: every comparison in its order. One that lacks a failed test is named among the
    work's failures. Otherwise LabpipeError names the comparison.
    """
    evidence = Evidence(
        tuple(work.fits),
        tuple(work.responses),
        work.pipeline.fits,
        conditions=work.conditions,
        spectra=tuple(work.spectra),
        folder=work.pipeline.path.parent,
    )

    def tests_of(comparison: Comparison) -> Iterable[str]:
        return (point.test for point in comparison.points)

    return _make_each(settings, COMPARE_PREFIX, work, lambda entry: compare(entry, evidence), tests_of)


def _make_each(
    settings: Sequence[Any],
    prefix: str,
    work: Work,
    make: Callable[[Any], Any],
    tests_of: Callable[[Any], Iterable[str]],
) -> tuple[Any, ...]:
    records = []
    for entry in settings:
        try:
            record = make(entry)
            _check_copies(dict.fromkeys(tests_of(record)), work)
            records.append(record)
        except LabpipeError as error:
            error.where = error.where or f"{work.pipeline.path}: {prefix}{entry.name}"
            if not work.failed:
                raise
            work.failed.append(Failed(prefix + entry.name, str(error)))
    return tuple(records)


def _check_copies(tests: Iterable[str], work: Work) -> None:
    first: dict[Any, str] = {}
    for test in tests:
        of_test = (fit for fit in work.fits if fit.test == test)
        values = tuple((fit.name, p.name, p.value, p.std_error) for fit in of_test for p in fit.parameters)
        other = first.setdefault((work.digests.get(test, test), values), test)
        if other != test:
            what = f"the tests '{other}' and '{test}' are of the same recordings"
            raise ConfigError(what, hint="a recording counts once; leave one of them out")


MATRIX_PREFIX = "matrix."
# Stands for a condition that the theory does not know.
NO_ENTRY = "none"
# Dofs of bearings that are the x and y of a rig, where a theory names none.
DEFAULT_AXES = (("x", "y"), ("y", "z"))


def run_matrices(settings: Sequence[MatrixSettings], work: Work) -> ConditionMatrices:
    """Every matrix in its order. Failures as of `run_comparisons`."""

    def matrix(entry: MatrixSettings) -> ConditionMatrix:
        theory = point_theory(entry, work.pipeline.folder)
        return condition_matrix(entry, work.fits, work.conditions, theory)

    def tests_of(matrix: ConditionMatrix) -> Iterable[str]:
        return (test for point in matrix.points for test in point.tests)

    return _make_each(settings, MATRIX_PREFIX, work, matrix, tests_of)


def point_theory(settings: MatrixSettings, folder: Path) -> PointTheory | None:
    """What a bearing file or a table in the *folder* of the pipeline says of coefficients at conditions [SI];
    None without. DataError, ConfigError for a file that does not fit.
    """
    if settings.theory is None:
        return None
    if settings.theory.bearing:
        theory, path = settings.theory, folder / settings.theory.bearing
        theories: dict[tuple[float, ...], Mapping[str, float]] = {}

        def at(conditions: tuple[float, ...], units: tuple[str, ...]) -> Mapping[str, float]:
            if conditions not in theories:
                file = open_bearing(path)
                for entry, value, unit in zip(theory.entries, conditions, units, strict=True):
                    if entry != NO_ENTRY:
                        set_entry(file.tree, f"{entry}={value!r} {unit}")
                (coefficients,) = file.coefficients([file.settings()])
                theories[conditions] = turn_to_rig_axes(coefficients, theory.axes)
            return theories[conditions]

        return at
    return _table_theory(folder / settings.theory.table, settings.over, settings.tolerance)


def turn_to_rig_axes(coefficients: BearingCoefficients, axes: tuple[str, ...]) -> Mapping[str, float]:
    """k_xx ... c_yy along *axes*: the bearing's dofs that are the rig's x and y, -y for the other way."""
    named = axes or next(
        (pair for pair in DEFAULT_AXES if set(pair) <= set(coefficients.dofs)), DEFAULT_AXES[0]
    )
    dofs = [axis.lstrip("-") for axis in named]
    unknown = next((dof for dof in dofs if dof not in coefficients.dofs), None)
    if unknown is not None:
        raise ConfigError(f"the bearing has no dof '{unknown}'", hint=nearest(unknown, coefficients.dofs))
    places = [coefficients.dofs.index(dof) for dof in dofs]
    signs = [-1.0 if axis.startswith("-") else 1.0 for axis in named]
    return {
        f"{letter}_{'xy'[i]}{'xy'[j]}": signs[i] * signs[j] * float(matrix[places[i], places[j]])
        for letter, matrix in (("k", coefficients.stiffness), ("c", coefficients.damping))
        for i in (0, 1)
        for j in (0, 1)
    }


def _table_theory(path: Path, over: Sequence[str], tolerance: float) -> PointTheory:
    """Coefficients of another program: linear between the rows of a table along the first condition, at the
    level of all others; none outside. Columns have their unit in brackets, or SI. DataError where the column
    of a condition is missing, or a unit does not fit.
    """
    columns = _columns(path)
    for name in over:
        if name not in columns:
            raise DataError(f"has no column of the condition '{name}'", path, nearest(name, columns))

    def in_si(name: str, unit: str | None) -> FloatArray:
        values, text = columns[name]
        with locate_units(path, DataError, f"column '{name}': "):
            factor, offset = _to_si(text, unit) if text else (1.0, 0.0)
        return values * factor + offset

    coefficients = {
        name: in_si(name, COEFFICIENT_UNITS.get(name[0]) if name[1:2] == "_" else None)
        for name in columns
        if name not in over
    }

    def at(conditions: tuple[float, ...], units: tuple[str, ...]) -> Mapping[str, float]:
        places = [in_si(name, unit) for name, unit in zip(over, units, strict=True)]
        matching = np.ones(places[0].size, bool)
        for values, condition in zip(places[1:], conditions[1:], strict=True):
            _, number = levels_of(np.append(values, condition), tolerance)
            matching &= number[:-1] == number[-1]
        order = np.flatnonzero(matching)[np.argsort(places[0][matching], kind="stable")]
        x = places[0][order]
        if np.any(twice := np.diff(x) == 0):
            what = f"has several rows at {over[0]} {x[:-1][twice][0]:.6g} {units[0]}"
            raise DataError(what, path, "one row for each point; other conditions belong in over:")
        reach = tolerance * float(np.max(np.abs(x), initial=0.0))
        if not x.size or not x[0] - reach <= conditions[0] <= x[-1] + reach:
            return {}
        theory = {
            name: float(np.interp(conditions[0], x, values[order])) for name, values in coefficients.items()
        }
        return {name: value for name, value in theory.items() if np.isfinite(value)}

    return at


def _to_si(text: str, si_unit: str | None) -> tuple[float, float]:
    si_unit = si_unit or name_of_dimension(parse_unit(text).dimension)
    offset = parse_value(f"0 {text}", si_unit)
    return parse_value(f"1 {text}", si_unit) - offset, offset


def _columns(path: Path) -> dict[str, tuple[FloatArray, str]]:
    table = open_table(path)
    values = np.concatenate(list(table.chunks(table.columns)))
    columns: dict[str, tuple[FloatArray, str]] = {}
    for column, numbers in zip(table.columns, values.T, strict=True):
        name, _, rest = map(str.strip, column.partition("["))
        if name in columns:
            raise DataError(f"has several columns of '{name}'", path, "leave one out")
        columns[name] = numbers, rest.rstrip("] ").strip() or table.units.get(column, "")
    return columns


def listed_amounts(comparisons: Comparisons) -> Iterator[ListedParameter]:
    """Every amount under the name of its comparison."""
    for comparison in comparisons:
        codes = tuple(dict.fromkeys(finding.code for finding in of_level(WARNING, comparison.findings)))
        for amount in comparison.amounts:
            name, kind = comparison.name, comparison.kind
            yield ListedParameter(fit=name, parameter=amount, model=kind, warnings=codes)


def listed_points(matrices: ConditionMatrices) -> Iterator[ListedParameter]:
    """Every coefficient at every point under its matrix's name, as of test "speed 3000 rpm, load 1 kN"."""
    for matrix in matrices:
        for point in matrix.points:
            place = matrix.text_of(point)
            for value in point.values:
                yield ListedParameter(
                    fit=matrix.name,
                    parameter=value.parameter,
                    test=place,
                    model="matrix",
                    warnings=point.warnings,
                    random=value.error_alone,
                    changes=value.changes,
                    dofs=value.dofs,
                )


def statement_lines(records: Comparisons | ConditionMatrices) -> Iterator[str]:
    return (f"{record.name}: {record.statement}" for record in records)


COMPARE = PipelineSection(
    words="One entry per question to tests that differ in a condition, under a name of your choice.",
    settings=CompareSettings,
    named=True,
    read=read_comparison,
    run=run_comparisons,
    record=Comparisons,
    entry="comparisons",
    names=names,
    verdicts=lambda comparisons: ((of.name, comparison_kind(of.kind).verdicts) for of in comparisons),
    outcome=comparison_outcome,
    findings=findings,
    parameters=listed_amounts,
    report=comparison_sections,
    terminal=statement_lines,
)
MATRIX = PipelineSection(
    words="One entry per matrix of tests: the coefficients of a fit over two conditions or more, under a "
    "name of your choice.",
    settings=MatrixSettings,
    named=True,
    read=read_matrix,
    run=run_matrices,
    record=ConditionMatrices,
    entry="matrices",
    names=names,
    outcome=matrix_outcome,
    findings=matrix_findings,
    parameters=listed_points,
    report=matrix_sections,
    terminal=statement_lines,
)
