"""The section calibrate: tables of set and measured values -> straight lines and planes with their
uncertainty, and the range in which they hold.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import chance_text
from labpipe.distributions import f_tail
from labpipe.errors import ConfigError, DataError, FitError, SettingError, locate_errors
from labpipe.estimation.regression import solve_scaled
from labpipe.estimation.statistics import appraise, condition_number, correlation
from labpipe.quantities import Unit, locate_units, may_agree, parse_unit
from labpipe.raw_files.table import RawTable, check_columns, open_table
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import PLANE, STRAIGHT_LINE, Fit, Goodness
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import Settings, flag, integer, quantity, setting, text

CURVATURE_P = 0.01
# Residuals below this part of the points are rounding.
ROUNDING = 1e-13


@dataclass(frozen=True)
class Line:
    """y = slope x (+ slope_beside z) + intercept: values (n_p,) and covariance (n_p, n_p) in this order (no
    intercept through the origin), residual (n_point,). Units: slopes [y unit / x unit], [y unit / z unit],
    intercept and residual [y unit].
    """

    values: FloatArray
    covariance: FloatArray
    residual: FloatArray
    r2: float
    dof: int
    condition_number: float

    @property
    def slope(self) -> float:
        return float(self.values[0])


def fit_line(
    x: FloatArray, y: FloatArray, *, through_origin: bool = False, beside: FloatArray | None = None
) -> Line:
    """Least-squares line through points x, y (n_point,) [any unit], or plane over x and *beside* (n_point,)
    [any unit]; standard errors from the residual. R^2 about the mean, or about zero through the origin.
    Raises FitError with fewer points than parameters + 1, when x does not vary, or x and *beside* only
    together. Equation (spec-line).
    """
    given = [x] if beside is None else [x, beside]
    columns = np.column_stack(given if through_origin else [*given, np.ones_like(x)])
    n_parameter = columns.shape[1]
    if x.size <= n_parameter:
        what = (
            f"{x.size} points cannot determine a {'line' if beside is None else 'plane'} with its uncertainty"
        )
        raise FitError(what, hint=f"at least {n_parameter + 1} are needed")
    if not np.ptp(x) > 0:
        raise FitError("all points have the same x")
    try:
        values, inverse = solve_scaled(columns, y)
    except FitError:
        hint = "a grid: several values of the one at each value of the other"
        raise FitError("x and beside change together, or beside does not vary", hint=hint) from None
    residual = y - columns @ values
    dof = x.size - n_parameter
    total = float(np.sum(y**2) if through_origin else np.sum((y - y.mean()) ** 2))
    r2 = 1 - float(residual @ residual) / total if total > 0 else 0.0
    covariance = inverse * float(residual @ residual) / dof
    condition = condition_number(columns / np.linalg.norm(columns, axis=0))
    return Line(values, covariance, residual, r2, dof, condition)


def curvature_p(
    x: FloatArray, y: FloatArray, residual: FloatArray, n_line: int, beside: FloatArray | None
) -> float | None:
    """p-value [1] of the *residual* of a line of *n_line* parameters through points x, y, all (n_point,),
    against that of a parabola, of a plane beside *beside* (n_point,) against a surface of the third degree
    (F-test); None with too few points, or values of x. Equation (spec-curvature).
    """
    centred = [(given - given.mean()) / np.ptp(given) for given in ([x] if beside is None else [x, beside])]
    degrees = [min(2 if beside is None else 3, np.unique(given).size - 1) for given in centred]
    powers = [power for power in np.ndindex(*(degree + 1 for degree in degrees)) if sum(power) <= 3]
    columns = np.prod(
        [
            np.power.outer(given, powers_of)
            for given, powers_of in zip(centred, np.transpose(powers), strict=True)
        ],
        axis=0,
    )
    dof = x.size - columns.shape[1]
    n_more = columns.shape[1] - n_line
    if dof < 2 or n_more < 1 or max(degrees) < 2:
        return None
    bent = y - columns @ solve_scaled(columns, y)[0]
    least = float(bent @ bent)
    if least <= (ROUNDING * float(np.linalg.norm(y))) ** 2:
        return None
    return f_tail(max(float(residual @ residual) / least - 1, 0.0) * dof / n_more, n_more, dof)


def linear_range(positions: FloatArray, slopes: FloatArray, tolerance: float) -> float:
    """Largest |position| [unit of positions] up to which every slope is within *tolerance* [1] of that at the
    smallest |position|.

    positions, slopes (n_position,).
    """
    sizes = np.abs(positions)
    centre = slopes[np.argmin(sizes)]
    beyond = np.abs(slopes - centre) > tolerance * abs(centre)
    # Of two positions at one distance both have to be within.
    return float(np.max(sizes[sizes < np.min(sizes[beyond], initial=np.inf)], initial=np.min(sizes)))


def linear_range_of_curve(x: FloatArray, y: FloatArray, tolerance: float) -> float:
    """Largest range of x [its unit], from the smallest up, with a slope within *tolerance* [1] of the line
    through the first third.

    x, y (n_point,). FitError where no point lies beyond the first line.
    """
    order = np.argsort(x)
    x, y = x[order], y[order]
    # Two values of x at least are in every line, however often each was set.
    width = max(3, x.size // 3, 1 + int(np.max(np.unique(x, return_counts=True)[1])))
    if width >= x.size:
        raise FitError(f"{x.size} points do not show where a line ends", hint="more of them, or no tolerance")
    lines = [slice(end - width, end) for end in range(width, x.size + 1)]
    slopes = np.array([fit_line(x[line], y[line]).slope for line in lines])
    beyond = np.flatnonzero(np.abs(slopes - slopes[0]) > tolerance * abs(slopes[0]))
    last = int(beyond[0]) - 1 if beyond.size else len(lines) - 1
    return float(x[lines[last].stop - 1] - x[0])


def line_fit(
    name: str,
    test: str,
    line: Line,
    units: Sequence[str],
    x: FloatArray,
    y: FloatArray,
    beside: FloatArray | None = None,
) -> Fit:
    """A line through x, y (n_point,), or plane over x and *beside*, as a Fit: slopes and intercept [*units*],
    a warning for curved points.
    """
    names = ("slope", "intercept") if beside is None else ("slope", "slope_beside", "intercept")
    std_errors = np.sqrt(np.diag(line.covariance))
    columns = zip(names, units, line.values.tolist(), std_errors.tolist(), strict=False)
    parameters = tuple(appraise(*column, line.dof, None) for column in columns)
    n, p_value = x.size, curvature_p(x, y, line.residual, line.values.size, beside)
    findings: tuple[Finding, ...] = ()
    if p_value is not None and p_value < CURVATURE_P:
        share = 100 * np.max(np.abs(line.residual)) / np.ptp(y)
        whole = line.values.size == len(names)
        bent, through = ("bend", "") if whole else ("bend, or miss zero", " through zero")
        shape = "straight line" if beside is None else "plane"
        what = f"the points {bent} ({chance_text(p_value)} for a {shape}{through})"
        what += f"; the largest deviation is {share:.2g} % of the range"
        findings = (Finding("model-mismatch", what),)
    return Fit(
        name=name,
        model=STRAIGHT_LINE if beside is None else PLANE,
        estimator="ls",
        band_hz=(0.0, 0.0),
        lines=n,
        equations=n,
        dof=line.dof,
        gof=Goodness(line.r2, 1 - (1 - line.r2) * (n - 1) / line.dof),
        parameters=parameters,
        condition_number=line.condition_number,
        correlation=correlation(line.covariance),
        findings=findings,
        test=test,
    )


@dataclass(frozen=True)
class CalibrationSettings(Settings):
    """One straight-line fit: a table's column *y* over its column *x*, once per value of *group* if given; a
    plane over *x* and *beside* where there is such a column.
    """

    table: str = setting("file", "table file (CSV), relative to this file", file_kind="path", into="path")
    x: str = setting("text", "column of the known or set value")
    y: str = setting("text", "column of the answer")
    _: KW_ONLY
    x_unit: str = text("unit of x; default: in brackets behind the column's name")
    y_unit: str = text("unit of y; default: in brackets behind the column's name")
    beside: str = text("column of a second set value: a plane y = slope x + slope_beside beside + intercept")
    beside_unit: str = text("unit of beside; default: in brackets behind the column's name")
    group: str = text("column by which the table falls into several lines")
    x_power: int = integer("x enters as this power: 2 for a string's force over its frequency", 1)
    through_origin: bool = flag("force the line through the origin")
    tolerance: float | None = quantity("slope change allowed in the linear range", "1", None)
    name: str = ""
    path: Path = Path()

    def __post_init__(self) -> None:
        self.require_positive("tolerance", "x_power")
        taken = {self.x}
        for name in ("y", "beside", "group"):
            if (column := getattr(self, name)) in taken:
                raise SettingError(name, f"'{column}' is a column of the line already")
            taken |= {column} - {""}
        if self.beside and self.tolerance is not None:
            raise SettingError(
                "tolerance", "the linear range is that of a line", "leave out `tolerance`, or `beside`"
            )
        if self.beside_unit and not self.beside:
            raise SettingError("beside_unit", "there is no column `beside`")


# Values (n_row,) [SI] of a column and their unit.
Column = tuple[FloatArray, str]


def calibrate(calibrations: Iterable[CalibrationSettings]) -> list[Fit]:
    """The straight-line fits of all calibrations; LabpipeError names the table."""
    fits: list[Fit] = []
    for settings in calibrations:
        with locate_errors(settings.path):
            fits.extend(_fits_of_table(settings))
    return fits


def _fits_of_table(settings: CalibrationSettings) -> list[Fit]:
    table = open_table(settings.path)
    names = [name for name in (settings.x, settings.y, settings.beside, settings.group) if name]
    check_columns(table, names)
    columns = dict(zip(names, np.concatenate(list(table.chunks(names))).T, strict=True))
    x = _column(table, settings.x, columns[settings.x], settings.x_unit, settings.x_power)
    y = _column(table, settings.y, columns[settings.y], settings.y_unit)
    known = [x]
    if settings.beside:
        known.append(_column(table, settings.beside, columns[settings.beside], settings.beside_unit))
    if settings.group:
        group = _column(table, settings.group, columns[settings.group])
        return _group(settings, known, y, group, settings.group in table.units)
    fit = _line_of(settings, "", known, y)
    if settings.tolerance is None:
        return [fit]
    return [_with_range(fit, linear_range_of_curve(x[0], y[0], settings.tolerance), x[1])]


def _line_of(settings: CalibrationSettings, test: str, known: list[Column], y: Column) -> Fit:
    (x, _), beside = known[0], known[1][0] if len(known) > 1 else None
    units = [f"{y[1]}{_per(unit)}" for _, unit in known]
    try:
        line = fit_line(x, y[0], through_origin=settings.through_origin, beside=beside)
    except FitError as error:
        error.what = f"{test}: {error.what}" if test else error.what
        raise
    return line_fit(settings.name, test, line, (*units, y[1]), x, y[0], beside)


def _per(unit: str) -> str:
    return "" if unit == "1" else f"/({unit})" if "/" in unit else f"/{unit}"


def _with_range(fit: Fit, reach: float, unit: str) -> Fit:
    stated = Parameter("linear_range", reach, unit, derived=True)
    return replace(fit, parameters=(*fit.parameters, stated))


def _group(
    settings: CalibrationSettings, known: list[Column], y: Column, group: Column, share: bool
) -> list[Fit]:
    (positions, unit), label = group, settings.group.split(" [")[0]
    values, fits = np.unique(positions), []
    for value in values:
        inside = positions == value
        # A share is read in percent, the number of a sensor as it stands.
        at = f"{value:.12g} {unit}" if unit != "1" else f"{100 * value:.12g} %" if share else f"{value:.12g}"
        test = f"{label} {at}"
        of_value = [(column[inside], of) for column, of in known]
        fits.append(_line_of(settings, test, of_value, (y[0][inside], y[1])))
    if settings.tolerance is None:
        return fits
    slopes = np.array([fit.parameter("slope").value for fit in fits])
    reach = linear_range(values, slopes, settings.tolerance)
    return [_with_range(fit, reach, unit) for fit in fits]


def _column(table: RawTable, name: str, values: FloatArray, stated: str = "", power: int = 1) -> Column:
    header = table.units.get(name, "")
    with locate_units("", before=f"unit of column '{name}': "):
        unit = parse_unit(stated or header or "1")
    if header and stated and not may_agree(stated, header):
        what = f"column '{name}' is in {header} by the file's own header, in {stated} by the entry"
        raise ConfigError(what, hint="leave the unit out of the entry, or correct it")
    si = si_name(unit)
    with np.errstate(over="ignore"):
        powered = (values * unit.factor + unit.offset) ** power
    if not np.all(np.isfinite(powered)):
        row = int(np.argmin(np.isfinite(powered)))
        of_power = f" to the power {power}" if np.isfinite(values[row]) else ""
        raise DataError(f"column '{name}'{of_power} has no number in row {row + 1}")
    if power > 1 and si != "1":
        si = f"({si})^{power}" if "/" in si else f"{si}^{power}"
    return powered, si


_SI_NAMES = ("m", "N", "V", "A", "kg", "s", "Hz", "rad", "K", "1", "Pa", "m/s", "m/s^2", "N/m", "N.s/m", "T")


def si_name(unit: Unit) -> str:
    """The SI name of a unit's dimension; ConfigError for one that calibrations do not know."""
    for name in _SI_NAMES:
        if parse_unit(name).dimension == unit.dimension:
            return name
    hint = f"known dimensions: {', '.join(_SI_NAMES)}"
    raise ConfigError("a calibration column has an unusual unit", hint=hint)


CALIBRATE = PipelineSection(
    words="One entry per straight line, or plane, to be fitted.",
    settings=CalibrationSettings,
    named=True,
    standalone=True,
    run=lambda settings, _work: calibrate(settings),
    fits=True,
)
