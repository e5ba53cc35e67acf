"""The section calibrate: tables of set and measured values -> straight lines with their uncertainty, and the
range in which they hold.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.methods.calibration.line import fit_line, line_fit, linear_range, linear_range_of_curve
from labpipe.project.work import Work
from labpipe.quantities import Unit, UnitError, parse_unit
from labpipe.raw_files.table import Table, check_columns, open_table
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.settings import Settings, setting
from labpipe.sections import PipelineSection

# The ``calibrate:`` section: straight lines through calibration tables.


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
    tolerance: float | None = setting(
        "value", "slope change allowed in the linear range", unit="1", default=None
    )
    name: str = ""
    path: Path = Path()


# calibrate: tables of set and measured values -> straight lines with their uncertainty, and the range in
# which they hold.


@dataclass(frozen=True)
class _Column:
    """A table's column in SI units, with the name of its SI unit."""

    values: FloatArray
    unit: str


def run_calibrations(settings: Iterable[CalibrationSettings], work: Work) -> list[Fit]:  # noqa: ARG001 (one signature for all sections)
    """The section calibrate: the straight lines of all its entries."""
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
    x = _powered(_column(table, settings.x, settings.x_unit, values[:, 0]), settings.x_power)
    y = _column(table, settings.y, settings.y_unit, values[:, 1])
    if settings.group:
        return _grouped(settings, x, y, _column(table, settings.group, "", values[:, 2]))
    line = fit_line(x.values, y.values, through_origin=settings.through_origin)
    extra: tuple[Parameter, ...] = ()
    if settings.tolerance is not None:
        reach = linear_range_of_curve(x.values, y.values, settings.tolerance)
        extra = (Parameter("linear_range", reach, x.unit, derived=True),)
    return [line_fit(settings.name, "", line, _units(x, y), x.values, y.values, extra)]


def _grouped(settings: CalibrationSettings, x: _Column, y: _Column, group: _Column) -> list[Fit]:
    """One line per value of the group column, each with the linear range over the groups."""
    positions = np.unique(group.values)
    fits = []
    for position in positions:
        in_group = group.values == position
        line = fit_line(x.values[in_group], y.values[in_group], through_origin=settings.through_origin)
        test = f"{settings.group.split(' [')[0]} {_shown(position, group.unit)}"
        fits.append(line_fit(settings.name, test, line, _units(x, y), x.values[in_group], y.values[in_group]))
    if settings.tolerance is not None:
        slopes = np.array([fit.parameter("slope").value for fit in fits])
        reach = Parameter(
            "linear_range", linear_range(positions, slopes, settings.tolerance), group.unit, derived=True
        )
        fits = [replace(fit, parameters=(*fit.parameters, reach)) for fit in fits]
    return fits


def _shown(position: float, unit: str) -> str:
    return f"{100 * position:g} %" if unit == "1" else f"{position:g} {unit}"


def _column(table: Table, name: str, stated: str, values: FloatArray) -> _Column:
    """A column in SI: its unit as stated in the settings, or by the table itself.

    A pure number where neither says any.
    """
    text = stated or table.units.get(name, "1")
    try:
        unit = parse_unit(text)
    except UnitError as error:
        raise ConfigError(f"unit of column '{name}': {error.what}", hint=error.hint) from None
    return _Column(values * unit.factor + unit.offset, si_name(unit))


def _powered(x: _Column, power: int) -> _Column:
    """The column to a power of at least 1."""
    if power < 1:
        raise ConfigError("'x_power' must be at least 1")
    return x if power == 1 else _Column(x.values**power, x.unit if x.unit == "1" else f"{x.unit}^{power}")


def _units(x: _Column, y: _Column) -> tuple[str, str]:
    """Units of slope and intercept."""
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
