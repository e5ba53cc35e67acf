"""The geometry of a structure from a file: CSV, or the nodes, trace lines and elements of a universal file."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from labpipe.errors import DataError
from labpipe.formats.uff import UFF_SUFFIXES
from labpipe.formats.uff_geometry import read_geometry_uff
from labpipe.quantities import UnitError, parse_value
from labpipe.records.file_kind import FileKind
from labpipe.records.geometry import AXES, Geometry

POINT, JOINED = "point", "to"
HEADER = "point, x [mm], y [mm], z [mm], to"
_COLUMN = re.compile(r"^\s*(?P<name>[A-Za-z]+)\s*(?:\[(?P<unit>[^\]]*)\])?\s*$")


def read_geometry(path: Path) -> Geometry:
    """The points and lines of a file; DataError with the place of a fault."""
    if not path.exists():
        raise DataError("no such file", where=str(path))
    try:
        return (read_geometry_uff(path) if path.suffix.lower() in UFF_SUFFIXES else read_geometry_csv(path)).checked()
    except DataError as error:
        error.where = error.where or str(path)
        raise


def read_geometry_csv(path: Path) -> Geometry:
    """Points as rows under `point, x [mm], y [mm], z [mm], to`; *to*: points that a line joins to, separated by blanks.

    Without a column z all points lie at 0; a coordinate without a unit is in metres; rows that begin with # are comments.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise DataError("is no text in UTF-8", where=str(path), hint="save the table as CSV") from None
    delimiter = next((mark for mark in ";\t" if any(mark in line for line in lines)), ",")
    numbered = enumerate(csv.reader(lines, delimiter=delimiter), 1)
    rows = [(number, row) for number, row in numbered if any(map(str.strip, row)) and not row[0].lstrip().startswith("#")]
    if not rows:
        raise DataError("holds no point", where=str(path))
    columns = _columns(rows[0][1], f"{path}:{rows[0][0]}")
    names: list[str] = []
    positions: list[list[float]] = []
    joined: list[tuple[int, int, str]] = []
    for number, row in rows[1:]:
        cells = dict(zip(columns, [*row, *[""] * len(columns)], strict=False))
        names.append(cells[POINT].strip())
        positions.append([_coordinate(cells.get(axis, "0"), columns.get(axis, ""), f"{path}:{number}") for axis in AXES])
        joined += [(number, len(names) - 1, other) for other in cells.get(JOINED, "").split()]
    pairs = [(point, _number_of(other, names, f"{path}:{number}")) for number, point, other in joined]
    return Geometry(tuple(names), np.array(positions, float).reshape(-1, 3), np.array(pairs, int).reshape(-1, 2))


def _columns(header: Sequence[str], where: str) -> dict[str, str]:
    """Column -> its unit; DataError for an unknown or missing one."""
    columns: dict[str, str] = {}
    for cell in header:
        column = _COLUMN.match(cell)
        name = column["name"].lower() if column else cell.strip()
        if column is None or name not in (POINT, JOINED, *AXES) or name in columns:
            raise DataError(f"column '{cell.strip()}' is unknown or stands twice", where=where, hint=f"known: {HEADER}")
        columns[name] = column["unit"] or "m"
    missing = [name for name in (POINT, "x", "y") if name not in columns]
    if missing:
        raise DataError(f"column '{missing[0]}' is missing", where=where, hint=f"the header is {HEADER}")
    return columns


def _coordinate(text: str, unit: str, where: str) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"the coordinate '{text.strip()}' is no number", where=where)
    try:
        return parse_value(f"{value!r} {unit or 'm'}", "m")
    except UnitError as error:
        raise DataError(error.what, where=where, hint=error.hint) from None


def _number_of(point: str, names: Sequence[str], where: str) -> int:
    if point not in names:
        raise DataError(f"there is no point '{point}' to draw a line to", where=where)
    return names.index(point)


GEOMETRY_FILE = FileKind(read_geometry)
