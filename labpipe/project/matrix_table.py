"""Matrices of tests as tables: for people and data frames, and for rotor codes over speed and whirl."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.artefacts.writing import with_endings, write_table_csv
from labpipe.errors import DataError
from labpipe.project.exports import TEXT, result_of
from labpipe.quantities import to_display
from labpipe.raw_files.table import load_extra
from labpipe.records.comparison import ConditionMatrix, MatrixPoint, condition_unit
from labpipe.records.identification import Fit, Identification
from labpipe.uncertainty.weighted import weighted_mean

AXES = ("xx", "xy", "yx", "yy")
# Coefficients of a rotor code by our names.
ROTOR_NAMES = {f"{letter}_{axes}": f"{letter}{axes}" for letter in "kc" for axes in AXES}
# Whirl frequencies of a rotor table where the fit's band does not give them.
N_WHIRL = 9


@with_endings(*TEXT)
def write_matrix_csv(artefact: Path, target: Path) -> None:
    """The matrices of a result as CSV: one row for every point and coefficient."""
    write_table_csv(matrix_table(_matrices(artefact)[1]), target)


@with_endings(".parquet")
def write_matrix_parquet(artefact: Path, target: Path) -> None:
    """The matrix as Parquet, as `write_matrix_csv` writes it."""
    matrix_table(_matrices(artefact)[1]).to_parquet(target, index=False)


def _matrices(artefact: Path) -> tuple[Identification, tuple[ConditionMatrix, ...]]:
    identification = result_of(artefact, "holds no matrix of tests")
    matrices: tuple[ConditionMatrix, ...] = identification.sections.get("matrix", ())
    if not matrices:
        raise DataError("holds no matrix of tests", artefact, "the pipeline needs a section matrix:")
    return identification, matrices


def matrix_table(matrices: tuple[ConditionMatrix, ...]) -> pd.DataFrame:
    """One row per point and coefficient: conditions, value, uncertainty, repeats, theory [SI]."""
    rows = []
    for matrix in matrices:
        for point in matrix.points:
            # Columns have the same names whatever the levels, so no prefix that suits them.
            units = [condition_unit(axis.name, axis.unit) for axis in matrix.axes]
            conditions = {
                f"{axis.name} [{unit}]": to_display(level, unit)
                for axis, unit, level in zip(matrix.axes, units, matrix.levels_of(point), strict=True)
            }
            beside = {f"{entry.name} [{entry.unit}]": entry.value for entry in point.beside}
            for value in point.values:
                parameter = value.parameter
                low, high = parameter.ci95 or (None, None)
                row = {"matrix": matrix.name, "fit": matrix.fit, **conditions, **beside}
                row |= {"coefficient": parameter.name, "value": parameter.value, "unit": parameter.unit}
                row |= {"std_error": parameter.full_error, "std_error_random": parameter.std_error}
                row |= {"ci95_low": low, "ci95_high": high, "repeats": value.repeats}
                row |= {"scatter": value.scatter, "theory": value.theory}
                rows.append({**row, "warnings": " ".join(point.warnings)})
    return pd.DataFrame(rows)


@with_endings(".xlsx")
def write_rotor_xlsx(artefact: Path, target: Path) -> None:
    """Tables that rotor codes read, columns kxx ... cyy [N/m, N.s/m] over `speed` or `frequency` [rad/s], as
    sheets of an Excel file: of every level of the other conditions one over the `speed` with the coefficients
    at whirl in step with it (synchronous), and one for every speed over the whirl `frequency`. DataError
    where no condition is a speed, or coefficients are missing.
    """
    load_extra("openpyxl", "excel", artefact)
    sheets = dict(rotor_sheets(*_matrices(artefact)))
    with pd.ExcelWriter(target, engine="openpyxl") as writer:
        for name, table in sheets.items():
            table.to_excel(writer, sheet_name=name, index=False)


@with_endings(*TEXT)
def write_rotor_csv(artefact: Path, target: Path) -> None:
    """The same tables below each other as CSV, the name of the sheet in the first column."""
    sheets = rotor_sheets(*_matrices(artefact))
    whole = pd.concat([table.assign(sheet=name) for name, table in sheets])
    write_table_csv(whole.set_index("sheet").reset_index(), target)


def rotor_sheets(
    identification: Identification, matrices: tuple[ConditionMatrix, ...]
) -> Iterator[tuple[str, pd.DataFrame]]:
    """Name and table of every sheet."""
    number = 0
    for matrix in matrices:
        units = [condition_unit(axis.name, axis.unit) for axis in matrix.axes]
        if "rpm" not in units:
            what = f"matrix '{matrix.name}' has no speed among its conditions"
            raise DataError(what, hint="over: [speed, ...]")
        place = units.index("rpm")
        groups: dict[tuple[int, ...], list[MatrixPoint]] = {}
        for point in matrix.points:
            groups.setdefault(point.place[:place] + point.place[place + 1 :], []).append(point)
        for points in groups.values():
            number += 1
            levels = list(zip(matrix.axes, matrix.levels_of(points[0]), strict=True))
            others = [axis.text(level) for axis, level in (*levels[:place], *levels[place + 1 :])]
            speeds = [matrix.levels_of(point)[place] for point in points]
            courses = [_course(identification, matrix, point) for point in points]
            pairs = list(zip(speeds, courses, strict=True))
            in_step = [_coefficients(course, np.array([speed])) for speed, course in pairs]
            table = _table("speed", np.array(speeds), np.concatenate(in_step), others)
            yield _sheet(number, "synchronous"), table
            for speed, course in pairs:
                whirl = np.linspace(course[0][0], course[0][-1], N_WHIRL)
                table = _table("frequency", whirl, _coefficients(course, whirl), others)
                yield _sheet(number, f"{60 * speed:.0f} rpm"), table


def _sheet(number: int, what: str) -> str:
    return f"{number} {what}"[:31]


# Frequency (n,) [Hz] and dynamic stiffness H (n, 2, 2) [N/m] over it.
Course = tuple[FloatArray, ComplexArray]


def _course(identification: Identification, matrix: ConditionMatrix, point: MatrixPoint) -> Course:
    fits = [fit for fit in identification.fits if fit.name == matrix.fit and fit.test in point.tests]
    drawn = [(fit, detail.course) for fit in fits for detail in fit.details if detail.course is not None]
    if drawn:
        shown, courses = [fit for fit, _ in drawn], [course for _, course in drawn]
        low, high = (end(course[0][place] for course in courses) for end, place in ((max, 0), (min, -1)))
        frequency = np.linspace(low, high, N_WHIRL)
        each = np.array([_interpolate(*course, frequency) for course in courses])
        k, c = (np.array([_weights(shown, f"{letter}_{axes}") for axes in AXES]).T for letter in "kc")
        real, imaginary = (of.reshape(-1, 1, 2, 2) * part for of, part in ((k, each.real), (c, each.imag)))
        return frequency, np.sum(real + 1j * imaginary, axis=0)
    return _coefficient_course(matrix, point, fits)


def _weights(fits: Sequence[Fit], name: str) -> FloatArray:
    """Weights (n_fit,) [1] of the repeats in the mean of a coefficient, as that of the matrix has them, of
    sum one; alike where one of them does not have it, or no error.
    """
    coefficients = [parameter for fit in fits for parameter in fit.parameters if parameter.name == name]
    errors = np.array([parameter.std_error for parameter in coefficients], np.float64)
    if len(coefficients) < len(fits) or not np.all(errors > 0):
        return np.full(len(fits), 1 / len(fits))
    spread = weighted_mean(np.array([parameter.value for parameter in coefficients]), errors).spread
    weights = 1 / (errors**2 + spread)
    return np.asarray(weights / np.sum(weights))


def _coefficient_course(matrix: ConditionMatrix, point: MatrixPoint, fits: list[Fit]) -> Course:
    missing = [name for name in ROTOR_NAMES if point.value(name) is None]
    if missing:
        what = f"matrix '{matrix.name}' lacks {', '.join(missing)}"
        raise DataError(what, hint="a rotor code needs K and C whole")
    stiffness, damping, mass = (_square(point, letter) for letter in "kcm")
    frequency = np.linspace(*(fits[0].band_hz if fits else (0.0, 0.0)), N_WHIRL)
    jw = 2j * np.pi * frequency[:, None, None]
    return frequency, np.asarray(stiffness + jw * damping + jw**2 * mass)


def _square(point: MatrixPoint, letter: str) -> FloatArray:
    values = [point.value(f"{letter}_{axes}") for axes in AXES]
    return np.array([0.0 if value is None else value.parameter.value for value in values]).reshape(2, 2)


def _interpolate(frequency: FloatArray, matrix: ComplexArray, at: FloatArray) -> ComplexArray:
    columns = [np.interp(at, frequency, column) for column in matrix.reshape(frequency.size, -1).T]
    return np.stack(columns, axis=1).reshape(at.size, 2, 2)


def _coefficients(course: Course, frequency: FloatArray) -> FloatArray:
    """k = Re H, c = Im H / w (n, 8) [SI] at (n,) [Hz]; beyond the measured band those of its end."""
    within = np.clip(frequency, course[0][0], course[0][-1])
    stiffness = _interpolate(*course, within).reshape(-1, 4)
    return np.hstack([stiffness.real, stiffness.imag / (2 * np.pi * within[:, None])])


def _table(over: str, frequency: FloatArray, coefficients: FloatArray, others: list[str]) -> pd.DataFrame:
    """Rows over 2 pi *frequency* (n,) [rad/s], a column named *over*, of *coefficients* (n, 8) [SI], and the
    other conditions in words. ROSS takes either name for one axis up to version 2; from version 3 on
    `frequency` is that of the whirl alone.
    """
    columns = {over: 2 * np.pi * frequency, **dict(zip(ROTOR_NAMES.values(), coefficients.T, strict=True))}
    return pd.DataFrame({**columns, "at": ", ".join(others)})
