"""The geometry of a structure from a file: CSV, or the nodes, trace lines and elements of a universal file.

Layout: I-DEAS universal datasets; numbers are read as words, since writers differ in their widths.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from labpipe.errors import DataError, locate_errors
from labpipe.quantities import locate_units, parse_value
from labpipe.raw_files.uff import UFF_SUFFIXES, real
from labpipe.records.rig import AXES, Geometry
from labpipe.records.settings import FileKind

NODES, DOUBLE_NODES, TRACE, ELEMENTS, UNITS = 15, 2411, 82, 2412, 164
# Label, two coordinate systems, colour, x, y, z.
_NODE_WORDS = 7
# Elements of two nodes whose nodes stand on a third line (rods and beams).
_BEAMS = (11, 21, 22, 23, 24)


def read_geometry_uff(path: Path) -> Geometry:
    """All nodes as points named by their labels, joined along trace lines and around elements. DataError
    where there are none.
    """
    nodes: dict[int, list[float]] = {}
    pairs: list[tuple[int, int]] = []
    length = 1.0
    for number, lines in _datasets(path):
        try:
            if number in (NODES, DOUBLE_NODES):
                _add_nodes(nodes, lines, path)
            elif number == TRACE:
                labels = [int(word) for word in " ".join(lines[2:]).split()]
                pairs += [(a, b) for a, b in pairwise(labels) if a and b]
            elif number == ELEMENTS:
                pairs += _elements(lines)
            elif number == UNITS:
                length = real(lines[1].split()[0])
        except (ValueError, IndexError):
            what = f"the record {number} cannot be read"
            raise DataError(what, path, "numbers are missing, or are none") from None
    if not nodes:
        raise DataError("holds no nodes", path, "records 15 or 2411 are needed")
    if not length > 0:
        raise DataError("the factors of the units record 164 cannot be read", path)
    place = {label: n for n, label in enumerate(nodes)}
    lost = [label for pair in pairs for label in pair if label not in place]
    if lost:
        raise DataError(f"a line leads to node {lost[0]}, which is not in the file", path)
    lines_between = np.array(sorted({(place[a], place[b]) for a, b in pairs if a != b}), int).reshape(-1, 2)
    return Geometry(
        tuple(str(label) for label in nodes), np.array(list(nodes.values())) / length, lines_between
    )


def _datasets(path: Path) -> Iterator[tuple[int, list[str]]]:
    text = path.read_bytes().decode("latin-1")
    for block in re.split(r"^[ \t]*-1[ \t]*\r?$", text, flags=re.MULTILINE)[1::2]:
        lines = [line for line in block.splitlines() if line.strip()]
        kind = lines[0].split()[0] if lines else ""
        if kind.isascii() and kind.isdigit():
            yield int(kind), lines[1:]


def _add_nodes(nodes: dict[int, list[float]], lines: list[str], path: Path) -> None:
    words = " ".join(lines).split()
    if len(words) % _NODE_WORDS:
        raise ValueError
    for n in range(0, len(words), _NODE_WORDS):
        label, position = int(words[n]), list(map(real, words[n + 4 : n + 7]))
        if nodes.setdefault(label, position) != position:
            raise DataError(f"node {label} lies at two places", path, "leave one of them out")


def _elements(lines: list[str]) -> list[tuple[int, int]]:
    pairs: list[tuple[int, int]] = []
    n = 0
    while n < len(lines):
        head = [int(word) for word in lines[n].split()]
        n += 2 if head[1] in _BEAMS else 1
        labels: list[int] = []
        while len(labels) < head[5]:
            labels += [int(word) for word in lines[n].split()]
            n += 1
        closed = [*labels, labels[0]] if len(labels) > 2 else labels
        pairs += pairwise(closed)
    return pairs


POINT, JOINED = "point", "to"
HEADER = "point, x [mm], y [mm], z [mm], to"
_COLUMN = re.compile(r"^\s*(?P<name>[A-Za-z]+)\s*(?:\[(?P<unit>[^\]]*)\])?\s*$")


def read_geometry(path: Path) -> Geometry:
    """The points and lines of a file; DataError with the place of a fault."""
    if not path.exists():
        raise DataError("no such file", path)
    with locate_errors(path):
        return (
            read_geometry_uff(path) if path.suffix.lower() in UFF_SUFFIXES else read_geometry_csv(path)
        ).check_points()


def read_geometry_csv(path: Path) -> Geometry:
    """Points as rows under `point, x [mm], y [mm], z [mm], to`; *to*: points that a line joins to, separated
    by blanks. Without z all lie at 0, without a unit coordinates are in metres; rows that begin with # are
    comments.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise DataError("is not a text in UTF-8", path, "save the table as CSV") from None
    delimiter = next((mark for mark in ";\t" if any(mark in line for line in lines)), ",")
    numbered = enumerate(csv.reader(lines, delimiter=delimiter), 1)
    rows = [
        (number, row)
        for number, row in numbered
        if any(map(str.strip, row)) and not row[0].lstrip().startswith("#")
    ]
    if not rows:
        raise DataError("holds no point", path)
    columns = _columns(rows[0][1], f"{path}:{rows[0][0]}")
    names: list[str] = []
    positions: list[list[float]] = []
    joined: list[tuple[int, int, str]] = []
    for number, row in rows[1:]:
        if any(map(str.strip, row[len(columns) :])):
            hint = f"the points of '{JOINED}' stand between blanks"
            raise DataError("a row has more cells than there are columns", f"{path}:{number}", hint)
        cells = dict(zip(columns, [*row, *[""] * len(columns)], strict=False))
        names.append(cells[POINT].strip())
        positions.append(
            [_coordinate(cells.get(axis, "0"), columns.get(axis, ""), f"{path}:{number}") for axis in AXES]
        )
        joined += [(number, len(names) - 1, other) for other in cells.get(JOINED, "").split()]
    for number, _, other in joined:
        if other not in names:
            raise DataError(f"there is no point '{other}' to draw a line to", f"{path}:{number}")
    pairs = [(point, names.index(other)) for _, point, other in joined]
    return Geometry(
        tuple(names), np.array(positions, float).reshape(-1, 3), np.array(pairs, int).reshape(-1, 2)
    )


def _columns(header: Sequence[str], where: str) -> dict[str, str]:
    columns: dict[str, str] = {}
    for cell in header:
        column = _COLUMN.match(cell)
        name = column["name"].lower() if column else cell.strip()
        if column is None or name not in (POINT, JOINED, *AXES) or name in columns:
            raise DataError(f"column '{cell.strip()}' is unknown or stands twice", where, f"known: {HEADER}")
        columns[name] = column["unit"] or "m"
    missing = [name for name in (POINT, "x", "y") if name not in columns]
    if missing:
        raise DataError(f"column '{missing[0]}' is missing", where, f"the header is {HEADER}")
    return columns


def _coordinate(text: str, unit: str, where: str) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"the coordinate '{text.strip()}' is not a number", where)
    with locate_units(where, DataError):
        return parse_value(f"{value!r} {unit or 'm'}", "m")


GEOMETRY_FILE = FileKind(read_geometry)
