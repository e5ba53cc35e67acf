"""Universal files: the records 58, 58b and 164, located without reading their numbers; units; time records as
a table.

Layout: I-DEAS universal dataset 58, records 1-12, and its binary header 58b.
"""

from __future__ import annotations

import itertools
import mmap
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, freeze_bases, modal_assurance
from labpipe.errors import DataError
from labpipe.raw_files.text_table import check_filled

UFF_SUFFIXES = (".uff", ".unv", ".uf")
TIME, FRF, COHERENCE = 1, 4, 6
_MARK = re.compile(rb"^[ \t]*-1[ \t]*\r?$", re.MULTILINE)
# After binary numbers the closing -1 need not begin a line.
_CLOSING = re.compile(rb"\s*-1[ \t]*\r?(?:\n|\Z)")
_HEADER_LINES = 11
_POINT = (5, 10, 5, 10, 11, 10, 4, 11, 10, 4)
_FORM = (10, 10, 10, 13, 13, 13)
_AXIS = (10, 5, 5, 5, 21, 21)
# Ordinate data types of record 7: width of a text field, bytes of a binary number, numbers per value.
_TEXT_WIDTH = {2: 13, 4: 20, 5: 13, 6: 20}
_BYTES = {2: 4, 4: 8, 5: 4, 6: 8}
_PARTS = {2: 1, 4: 1, 5: 2, 6: 2}
_ABSCISSA_WIDTH = 13
_BYTE_ORDER = {"1": "<", "2": ">"}
_IEEE = "2"
_END = re.compile(rb"\s*-1\s")


@dataclass(frozen=True)
class NumberLayout:
    """Position of the numbers (bytes *begin* to *end*) and parts of one value; *dtype* is None for text."""

    begin: int
    end: int
    n_value: int
    parts: int
    even: bool
    width: int
    dtype: np.dtype[np.void] | None = None


@dataclass(frozen=True)
class UffPoint:
    """Point of measurement or excitation: entity name ('' for none), node, direction (0 scalar, 1..3 x y z,
    4..6 about them).
    """

    name: str
    node: int
    direction: int


@dataclass(frozen=True)
class UffAxis:
    """An axis of a record: specific data type (8 displacement, 11 velocity, 12 acceleration, 13 force, ...),
    label and unit label.
    """

    kind: int
    label: str
    unit: str


@dataclass(frozen=True)
class UffScale:
    """The factors of a 164 record: SI value = value / factor."""

    length: float
    force: float


@dataclass(frozen=True)
class UffRecord:
    """One record 58 or 58b. *start* and *step* of its abscissa, or an abscissa beside the numbers where
    *even* is false.
    """

    number: int
    title: str
    function: int
    response: UffPoint
    reference: UffPoint
    n_value: int
    even: bool
    start: float
    step: float
    abscissa: UffAxis
    ordinate: UffAxis
    denominator: UffAxis
    scale: UffScale | None
    layout: NumberLayout

    @property
    def where(self) -> str:
        return f"record {self.number} ({self.title or 'without a title'})"


class _Lines:
    def __init__(self, path: Path, buffer: mmap.mmap) -> None:
        self.path, self.buffer, self.position = path, buffer, 0

    def next(self) -> str | None:
        if self.position >= len(self.buffer):
            return None
        end = self.buffer.find(b"\n", self.position)
        end = len(self.buffer) if end < 0 else end
        line = self.buffer[self.position : end].rstrip(b"\r")
        self.position = end + 1
        return _decode(line)

    def take(self, count: int) -> list[str]:
        """The next lines; DataError at the end of the file."""
        lines = [self.next() for _ in range(count)]
        complete = [line for line in lines if line is not None]
        if len(complete) < count:
            raise DataError("ends within the header of a record", self.path, "the file is truncated")
        return complete

    def mark(self) -> re.Match[bytes] | None:
        """The -1 here, or the next line that is one."""
        return _CLOSING.match(self.buffer, self.position) or _MARK.search(self.buffer, self.position)


def _decode(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def open_uff(path: Path) -> mmap.mmap:
    """The bytes of a file, mapped; DataError when it is empty."""
    check_filled(path)
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def read_uff(path: Path) -> tuple[UffRecord, ...]:
    """All records 58 and 58b of a universal file. DataError for another or truncated file, or without such a
    record.
    """
    with open_uff(path) as buffer:
        records = tuple(_records(_Lines(path, buffer)))
    if not records:
        shapes = len(records_55(path))
        if shapes:
            what = f"holds {shapes} mode shape(s) in records 55, and no recording or FRF"
            raise DataError(what, path, "`labpipe inspect` shows them")
        raise DataError("holds no record 58", path, "records 58 and 58b are read, and shapes in records 55")
    return records


def records_55(path: Path) -> list[list[str]]:
    """The lines of every record 55 of a file without a record 58; nothing of one with."""
    shapes: list[list[str]] = []
    with open_uff(path) as buffer:
        lines = _Lines(path, buffer)
        for kind in _kinds(lines):
            begin = lines.position
            if kind.startswith("58"):
                return []
            if kind.strip() == "55":
                mark = lines.mark()
                text = _decode(buffer[begin : mark.start() if mark else begin])
                shapes.append([row for row in text.splitlines() if row.strip()])
    return shapes


def _kinds(lines: _Lines) -> Iterator[str]:
    """The first line of each record, behind which *lines* stand then; they may be moved on within it."""
    while (line := lines.next()) is not None:
        if not line.strip(" \t\r\0\x1a"):
            continue
        if line.strip() != "-1":
            what = f"is not a universal file: '-1' is required, not '{line.strip()[:30]!s}'"
            raise DataError(what, lines.path)
        kind = lines.take(1)[0]
        yield kind
        mark = lines.mark()
        if mark is None:
            raise DataError(f"the record {kind.strip()[:6]} has no end", lines.path, "the file is truncated")
        lines.position = mark.end() + 1


def _records(lines: _Lines) -> Iterator[UffRecord]:
    scale: UffScale | None = None
    number = 0
    for kind in _kinds(lines):
        if kind[:6].strip() == "58":
            number += 1
            yield _record(lines, kind, number, scale)
        elif kind.strip() == "164":
            scale = _scale(lines)


def _scale(lines: _Lines) -> UffScale:
    text = " ".join(lines.take(2)[1:]).upper().replace("D", "E")
    try:
        length, force = (float(text[n : n + 25]) for n in (0, 25))
    except ValueError:
        length = force = 0.0
    if not (length > 0 and force > 0):
        raise DataError("the factors of the units record 164 cannot be read", lines.path)
    return UffScale(length, force)


def _record(lines: _Lines, kind: str, number: int, scale: UffScale | None) -> UffRecord:
    header = lines.take(_HEADER_LINES)
    title = _name(header[0])
    try:
        point, form = _columns(header[5], _POINT), _columns(header[6], _FORM)
        function, ordinate_type, n_value = _integer(point[0]), _integer(form[0]), _integer(form[1])
        even, start, step = _integer(form[2]) == 1, real(form[3]), real(form[4])
        ends = _point(point[4:7]), _point(point[7:10])
        abscissa, ordinate, per = (
            UffAxis(_integer(f[0]), _name(f[4]), _name(f[5]))
            for f in (_columns(h, _AXIS) for h in header[7:10])
        )
        layout = _layout(lines, kind, ordinate_type, n_value, even)
    except ValueError as error:
        raise DataError(f"record {number} ({title}): {error}", lines.path) from None
    lines.position = layout.end
    return UffRecord(
        number, title, function, *ends, n_value, even, start, step, abscissa, ordinate, per, scale, layout
    )


def _layout(lines: _Lines, kind: str, ordinate_type: int, n_value: int, even: bool) -> NumberLayout:
    if n_value < 1:
        raise ValueError("holds no values")
    if "b" in kind.lower():
        codes = kind[kind.lower().index("b") + 1 :].split()
        return _binary_layout(lines.buffer, lines.position, codes, ordinate_type, n_value, even)
    mark = lines.mark()
    end = len(lines.buffer) if mark is None else mark.start()
    _check_type(ordinate_type)
    parts, width = _PARTS[ordinate_type], _TEXT_WIDTH[ordinate_type]
    return NumberLayout(lines.position, end, n_value, parts, even, width)


def _columns(line: str, widths: tuple[int, ...]) -> list[str]:
    ends = [0, *itertools.accumulate(widths)]
    return [line[begin:end].strip() for begin, end in itertools.pairwise(ends)]


def _integer(field: str) -> int:
    return int(field or 0)


def real(field: str) -> float:
    """A number as Fortran writes it, with D as its exponent; 0 for none."""
    return float(field.upper().replace("D", "E") or 0)


def _name(field: str) -> str:
    text = field.strip().strip("\0")
    return "" if text.upper() == "NONE" else text


def _point(fields: list[str]) -> UffPoint:
    direction = _integer(fields[2])
    if abs(direction) > 6:
        raise ValueError(f"unknown direction {direction}")
    return UffPoint(_name(fields[0]), _integer(fields[1]), direction)


def _binary_layout(
    buffer: mmap.mmap, begin: int, codes: list[str], ordinate_type: int, n_value: int, even: bool
) -> NumberLayout:
    """The layout of binary numbers, up to the closing -1; ValueError when it is missing. Not by the byte
    count of the header, in which some programs count complex values once; some write doubles contrary to the
    format, which the -1 shows.
    """
    _check_type(ordinate_type)
    if len(codes) < 2 or codes[0] not in _BYTE_ORDER or codes[1] != _IEEE:
        raise ValueError("the byte order or number format of the 58b header is unknown")
    order, parts = _BYTE_ORDER[codes[0]], _PARTS[ordinate_type]
    for abscissa, ordinate in ((4, _BYTES[ordinate_type]), (8, 8)):
        fields = [] if even else [("x", f"{order}f{abscissa}")]
        dtype = np.dtype([*fields, ("y", f"{order}f{ordinate}", (parts,))])
        end = begin + n_value * dtype.itemsize
        if _END.match(buffer[end : end + 16] + b"\n"):
            return NumberLayout(begin, end, n_value, parts, even, 0, dtype)
    raise ValueError(f"the closing -1 does not follow its {n_value} values: it is cut off or damaged")


def _check_type(ordinate_type: int) -> None:
    if ordinate_type not in _PARTS:
        raise ValueError(f"unknown ordinate data type {ordinate_type}")


def read_numbers(
    buffer: mmap.mmap, layout: NumberLayout
) -> tuple[FloatArray | None, FloatArray | ComplexArray]:
    """Abscissa (n_value,) or None, and ordinates (n_value,), real or complex [unit of the file]. ValueError
    when their number differs from that of the header.
    """
    if layout.dtype is None:
        abscissa, ordinate = _text_numbers(buffer[layout.begin : layout.end], layout)
    else:
        values = np.frombuffer(buffer[layout.begin : layout.end], layout.dtype)
        abscissa = None if layout.even else values["x"].astype(np.float64)
        ordinate = values["y"].astype(np.float64)
    return abscissa, ordinate[:, 0] if layout.parts == 1 else ordinate[:, 0] + 1j * ordinate[:, 1]


def _text_numbers(text: bytes, layout: NumberLayout) -> tuple[FloatArray | None, FloatArray]:
    columns = layout.parts + (not layout.even)
    numbers = _split_numbers(text.upper().replace(b"D", b"E"), layout)
    if numbers.size != columns * layout.n_value:
        what = f"{numbers.size // columns} values, {layout.n_value} are stated: it is cut off or damaged"
        raise ValueError(what)
    table = numbers.reshape(-1, columns)
    return (None, table) if layout.even else (table[:, 0], table[:, 1:])


def _split_numbers(text: bytes, layout: NumberLayout) -> FloatArray:
    """Numbers separated by blanks or, where fields touch (long exponents), by their widths."""
    try:
        return np.array(text.split(), dtype=np.float64)
    except ValueError:
        widths = [*([] if layout.even else [_ABSCISSA_WIDTH]), *[layout.width] * layout.parts]
        return np.array([field for line in text.splitlines() for field in _fields(line, widths)], float)


def _fields(line: bytes, widths: list[int]) -> list[bytes]:
    fields, position, n = [], 0, 0
    while line[position:].strip():
        width = widths[n % len(widths)]
        fields.append(line[position : position + width])
        position, n = position + width, n + 1
    return fields


NORMAL, COMPLEX = 2, (3, 7)
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class FileShapes:
    """Mode shapes (n_point, n_mode) [1] of a file at its *points* ('12.z'), with frequency (n_mode,) [Hz] and
    damping_ratio (n_mode,) [1]. others: records that are no modes, or of other nodes.
    """

    points: tuple[str, ...]
    frequency: FloatArray
    damping_ratio: FloatArray
    shapes: ComplexArray
    others: int

    @property
    def mac(self) -> FloatArray:
        """Modal assurance criterion (n_mode, n_mode) [1], |a^H b|^2 / (a^H a b^H b)."""
        return modal_assurance(self.shapes.T, self.shapes.T)


def read_shapes_uff(path: Path) -> FileShapes | None:
    """The mode shapes of a universal file; None without any. DataError for a damaged record."""
    sets = []
    for number, lines in enumerate(records_55(path), 1):
        try:
            sets.append(_Mode.of_lines(lines))
        except (ValueError, IndexError):
            what = f"the record 55 number {number} is cut off or damaged"
            raise DataError(what, path, "export the shapes again") from None
    modes = [mode for mode in sets if mode.analysis in (NORMAL, *COMPLEX)]
    alike = [mode for mode in modes if (mode.nodes, mode.width) == (modes[0].nodes, modes[0].width)]
    if not alike:
        return None
    axes = AXES[: alike[0].width] if alike[0].width <= len(AXES) else tuple(map(str, range(alike[0].width)))
    points = tuple(f"{node}.{axis}" for node in alike[0].nodes for axis in axes)
    matrix = np.stack([mode.shape for mode in alike], axis=1)
    pairs = np.array([mode.pole for mode in alike])
    return FileShapes(points, pairs[:, 0], pairs[:, 1], freeze_bases(matrix), len(sets) - len(alike))


@dataclass(frozen=True)
class _Mode:
    """A record: *analysis* type, numbers that tell its pole, *shape* (n_node * width,) at its *nodes*."""

    analysis: int
    numbers: tuple[float, ...]
    nodes: tuple[int, ...]
    width: int
    shape: ComplexArray

    @classmethod
    def of_lines(cls, lines: Sequence[str]) -> _Mode:
        """The record of its lines; ValueError or IndexError where they are not as it says."""
        kind = [int(field) for field in lines[5].split()]
        parts = _PARTS.get(kind[4], 0)
        count = [int(field) for field in lines[6].split()]
        at = 6 + -(-(2 + count[0]) // 8)
        numbers, at = _next_fields(lines, at, count[1])
        if not parts or kind[5] < 1 or (len(lines) - at) % (1 + -(-parts * kind[5] // 6)):
            raise ValueError
        nodes: list[int] = []
        values: list[float] = []
        while at < len(lines):
            nodes.append(int(lines[at]))
            of_node, at = _next_fields(lines, at + 1, parts * kind[5])
            values += of_node
        shape = np.array(values).reshape(-1, parts) @ np.array([1, 1j])[:parts]
        if not nodes or not np.all(np.isfinite(shape)) or not np.all(np.isfinite(numbers)):
            raise ValueError
        return cls(kind[1], tuple(numbers), tuple(nodes), kind[5], np.asarray(shape, np.complex128))

    @property
    def pole(self) -> tuple[float, float]:
        """Natural frequency [Hz] and damping ratio [1]."""
        if self.analysis == NORMAL:
            return self.numbers[0], self.numbers[2]
        size = abs(complex(*self.numbers[:2]))
        return size / (2 * np.pi), -self.numbers[0] / size if size else 0.0


def _next_fields(lines: Sequence[str], at: int, count: int) -> tuple[list[float], int]:
    """*count* numbers, six of 13 letters in a line from line *at* on, and the line after them."""
    stop = at - (-count // 6)
    row = [line[n : n + 13] for line in lines[at:stop] for n in range(0, len(line.rstrip()), 13)]
    if len(row) != count:
        raise ValueError
    return list(map(real, row)), stop
