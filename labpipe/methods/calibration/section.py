"""The section calibrate: tables of set and measured values -> straight lines with their uncertainty, and the
range in which they hold.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import student_tail
from labpipe.errors import ConfigError, DataError, FitError, LabpipeError, SettingError
from labpipe.estimation.regression import solve_scaled
from labpipe.estimation.statistics import condition_number, correlation, estimated
from labpipe.project.work import Work
from labpipe.quantities import Unit, UnitError, may_agree, parse_unit
from labpipe.raw_files.table import Table, check_columns, open_table
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import STRAIGHT_LINE, Fit, Goodness
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import Settings, quantity, setting

CURVATURE_P = 0.01


@dataclass(frozen=True)
class Line:
    """y = slope x + intercept: values (1 or 2,) and covariance (2, 2) in this order (slope alone through the
    origin), residual (n_point,).

    Units: slope [y unit / x unit], intercept and residual [y unit].
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


def fit_line(x: FloatArray, y: FloatArray, *, through_origin: bool = False) -> Line:
    """Least-squares line through points x, y (n_point,) [any unit]; standard errors from the residual.

    R^2 about the mean, or about zero through the origin. Raises FitError with fewer points than parameters +
    1, or when x does not vary. Equation (spec-line).
    """
    columns = x[:, None] if through_origin else np.column_stack([x, np.ones_like(x)])
    n_parameter = columns.shape[1]
    if x.size <= n_parameter:
        raise FitError(
            f"{x.size} points cannot determine a line with its uncertainty",
            hint=f"at least {n_parameter + 1} are needed",
        )
    if not np.ptp(x) > 0:
        raise FitError("all points have the same x")
    values, inverse = solve_scaled(columns, y)
    residual = y - columns @ values
    dof = x.size - n_parameter
    total = float(np.sum(y**2) if through_origin else np.sum((y - y.mean()) ** 2))
    r2 = 1 - float(residual @ residual) / total if total > 0 else 0.0
    scaled = columns / np.linalg.norm(columns, axis=0)
    return Line(
        values, inverse * float(residual @ residual) / dof, residual, r2, dof, condition_number(scaled)
    )


def curvature_p(x: FloatArray, y: FloatArray) -> float | None:
    """p-value [1] of a quadratic term beside the line (t-test) for points x, y (n_point,); None with too few
    points.

    Equation (spec-curvature).
    """
    if x.size < 5:
        return None
    centred = (x - x.mean()) / np.ptp(x)
    columns = np.column_stack([centred**2, centred, np.ones_like(x)])
    values, inverse = solve_scaled(columns, y)
    residual = y - columns @ values
    variance = float(residual @ residual) / (x.size - 3)
    if variance == 0:
        return None
    return 2 * student_tail(abs(values[0]) / np.sqrt(variance * inverse[0, 0]), x.size - 3)


def linear_range(positions: FloatArray, slopes: FloatArray, tolerance: float) -> float:
    """Largest |position| [unit of positions] up to which every slope is within *tolerance* [1] of that at the
    smallest |position|.

    positions, slopes (n_position,).
    """
    order = np.argsort(np.abs(positions))
    beyond = np.abs(slopes[order] - slopes[order[0]]) > tolerance * abs(slopes[order[0]])
    reach = int(np.argmax(beyond)) if np.any(beyond) else beyond.size
    return float(np.abs(positions[order[reach - 1]]))


def linear_range_of_curve(x: FloatArray, y: FloatArray, tolerance: float) -> float:
    """Largest range of x [its unit], from the smallest up, with a slope within *tolerance* [1] of the line
    through the first third.

    x, y (n_point,).
    """
    order = np.argsort(x)
    x, y = x[order], y[order]
    start = max(3, x.size // 3)
    reference = fit_line(x[:start], y[:start]).slope
    reach = start
    for end in range(start + 1, x.size + 1):
        local = fit_line(x[end - start : end], y[end - start : end]).slope
        if abs(local / reference - 1) > tolerance:
            break
        reach = end
    return float(x[reach - 1] - x[0])


def line_fit(
    name: str,
    test: str,
    line: Line,
    units: tuple[str, str],
    x: FloatArray,
    y: FloatArray,
    extra: tuple[Parameter, ...] = (),
) -> Fit:
    """A line through x, y (n_point,) as a Fit: slope and intercept [*units*], a warning for curved points."""
    names = ("slope", "intercept")[: line.values.size]
    std_errors = np.sqrt(np.diag(line.covariance))
    parameters = tuple(
        estimated(parameter, unit, float(value), float(error), line.dof, None)
        for parameter, unit, value, error in zip(names, units, line.values, std_errors, strict=False)
    )
    n = x.size
    return Fit(
        name=name,
        model=STRAIGHT_LINE,
        estimator="ls",
        band_hz=(0.0, 0.0),
        lines=n,
        equations=n,
        dof=line.dof,
        gof=Goodness(line.r2, 1 - (1 - line.r2) * (n - 1) / line.dof),
        parameters=(*parameters, *extra),
        condition_number=line.condition_number,
        correlation=correlation(line.covariance),
        findings=_curvature_findings(curvature_p(x, y), line, y),
        test=test,
    )


def _curvature_findings(p_value: float | None, line: Line, y: FloatArray) -> tuple[Finding, ...]:
    if p_value is None or p_value >= CURVATURE_P:
        return ()
    share = 100 * np.max(np.abs(line.residual)) / np.ptp(y)
    bent = f"the points bend (p = {p_value:.2g} for a straight line)"
    what = f"{bent}; the largest deviation is {share:.2g} % of the range"
    return (Finding("model-mismatch", what),)


@dataclass(frozen=True)
class CalibrationSettings(Settings):
    """One straight-line fit: a table's column *y* over its column *x*, once per value of *group* if given."""

    table: str = setting("file", "table file (CSV), relative to this file", file_kind="path", into="path")
    x: str = setting("text", "column of the known or set value")
    y: str = setting("text", "column of the answer")
    _: KW_ONLY
    x_unit: str = setting("text", "unit of x; default: in brackets behind the column's name", default="")
    y_unit: str = setting("text", "unit of y; default: in brackets behind the column's name", default="")
    group: str = setting("text", "column by which the table falls into several lines", default="")
    x_power: int = setting(
        "integer", "x enters as this power: 2 for a string's force over its frequency", default=1
    )
    through_origin: bool = setting("flag", "force the line through the origin", default=False)
    tolerance: float | None = quantity("slope change allowed in the linear range", "1", None)
    name: str = ""
    path: Path = Path()

    def __post_init__(self) -> None:
        self.require_positive("tolerance", "x_power")
        if len({self.x, self.y, self.group}) < 3:
            name = "y" if self.x == self.y else "group"
            raise SettingError(name, f"'{getattr(self, name)}' is a column of the line already")


@dataclass(frozen=True)
class _Column:
    values: FloatArray
    unit: str


def run_calibrations(
    settings: Iterable[CalibrationSettings],
    work: Work,  # noqa: ARG001 (one signature for all sections)
) -> list[Fit]:
    return calibrate(settings)


def calibrate(calibrations: Iterable[CalibrationSettings]) -> list[Fit]:
    """The straight-line fits of all calibrations; LabpipeError names the table."""
    fits: list[Fit] = []
    for settings in calibrations:
        try:
            fits.extend(_fits_of_table(settings))
        except LabpipeError as error:
            error.where = error.where or str(settings.path)
            raise
    return fits


def _fits_of_table(settings: CalibrationSettings) -> list[Fit]:
    table = open_table(settings.path)
    names = [settings.x, settings.y, *([settings.group] if settings.group else [])]
    check_columns(table, names)
    values = np.concatenate(list(table.chunks(names)))
    if not np.all(np.isfinite(values)):
        row, column = (int(n) for n in np.argwhere(~np.isfinite(values))[0])
        raise DataError(f"column '{names[column]}' has no number in row {row + 1}")
    x, power = _column(table, settings.x, settings.x_unit, values[:, 0]), settings.x_power
    if power > 1:
        x = _Column(x.values**power, x.unit if x.unit == "1" else f"{x.unit}^{power}")
    y = _column(table, settings.y, settings.y_unit, values[:, 1])
    if settings.group:
        return _group(settings, x, y, _column(table, settings.group, "", values[:, 2]))
    line = fit_line(x.values, y.values, through_origin=settings.through_origin)
    extra: tuple[Parameter, ...] = ()
    if settings.tolerance is not None:
        reach = linear_range_of_curve(x.values, y.values, settings.tolerance)
        extra = (Parameter("linear_range", reach, x.unit, derived=True),)
    return [line_fit(settings.name, "", line, _units(x, y), x.values, y.values, extra)]


def _group(settings: CalibrationSettings, x: _Column, y: _Column, group: _Column) -> list[Fit]:
    positions = np.unique(group.values)
    fits = []
    for position in positions:
        in_group = group.values == position
        line = fit_line(x.values[in_group], y.values[in_group], through_origin=settings.through_origin)
        at = f"{100 * position:g} %" if group.unit == "1" else f"{position:g} {group.unit}"
        test = f"{settings.group.split(' [')[0]} {at}"
        fits.append(line_fit(settings.name, test, line, _units(x, y), x.values[in_group], y.values[in_group]))
    if settings.tolerance is not None:
        slopes = np.array([fit.parameter("slope").value for fit in fits])
        reach = linear_range(positions, slopes, settings.tolerance)
        stated = Parameter("linear_range", reach, group.unit, derived=True)
        fits = [replace(fit, parameters=(*fit.parameters, stated)) for fit in fits]
    return fits


def _column(table: Table, name: str, stated: str, values: FloatArray) -> _Column:
    header = table.units.get(name, "")
    try:
        unit = parse_unit(stated or header or "1")
    except UnitError as error:
        raise ConfigError(f"unit of column '{name}': {error.what}", hint=error.hint) from None
    if header and stated and not may_agree(stated, header):
        what = f"column '{name}' is in {header} by the file's own header, in {stated} by the entry"
        raise ConfigError(what, hint="leave the unit out of the entry, or correct it")
    return _Column(values * unit.factor + unit.offset, si_name(unit))


def _units(x: _Column, y: _Column) -> tuple[str, str]:
    if x.unit == "1":
        return y.unit, y.unit
    return (f"{y.unit}/{x.unit}" if "/" not in x.unit else f"{y.unit}/({x.unit})"), y.unit


_SI_NAMES = ("m", "N", "V", "A", "kg", "s", "Hz", "rad", "K", "1", "Pa", "m/s", "m/s^2", "N/m", "N.s/m", "T")


def si_name(unit: Unit) -> str:
    """The SI name of a unit's dimension; ConfigError for one that calibrations do not know."""
    for name in _SI_NAMES:
        if parse_unit(name).dimension == unit.dimension:
            return name
    raise ConfigError(
        "a calibration column has an unusual unit", hint=f"known dimensions: {', '.join(_SI_NAMES)}"
    )


CALIBRATE = PipelineSection(
    words="One entry per straight line to be fitted.",
    settings=CalibrationSettings,
    named=True,
    standalone=True,
    run=run_calibrations,
    fits=True,
)
