"""Text tables with automatic detection of delimiter, decimal sign, header and units.

Read in blocks by pyarrow.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from labpipe.arrays import FloatArray
from labpipe.artefacts.parquet import numpy_array
from labpipe.artefacts.writing import text_of
from labpipe.errors import DataError, LabpipeError, shorten
from labpipe.quantities import UnitError, parse_unit

PACKED = (".gz", ".zst")


def plain_suffix(path: Path) -> str:
    """The suffix that determines a file's kind: run.csv.gz -> .csv."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix in PACKED else suffix


def open_unpacked(path: Path) -> BinaryIO:
    """The bytes of a file, decompressed according to its suffix."""
    if path.suffix.lower() in PACKED:
        compression = "gzip" if path.suffix.lower() == ".gz" else "zstd"
        stream: BinaryIO = pa.input_stream(str(path), compression=compression)
        return stream
    return path.open("rb")


@contextmanager
def open_text(path: Path, encoding: str = "utf-8") -> Iterator[io.TextIOWrapper]:
    """The lines of a file, unpacked if need be; what is not a text of the *encoding* is marked."""
    with open_unpacked(path) as stream, io.TextIOWrapper(stream, encoding, errors="replace") as lines:
        yield lines


def not_readable(path: Path, kind: str, error: object) -> DataError:
    """The error of a file of a *kind* for which its library has none of its own."""
    reason = (str(error).splitlines() or ["damaged"])[0].rstrip(".")
    return DataError(f"is not a readable {kind} ({reason[:80]})", path)


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """DataError for whatever a library raises inside the block for a damaged file of a *kind*."""
    try:
        yield
    except LabpipeError:
        raise
    except Exception as error:
        raise not_readable(path, kind, error) from None


def check_filled(path: Path) -> None:
    """DataError for a file without a byte."""
    if path.stat().st_size == 0:
        raise DataError("the file is empty", path)


def damaged_error(path: Path, error: Exception) -> DataError:
    """The error of a compressed file that cannot be decompressed."""
    what = f"cannot be unpacked ({str(error).splitlines()[0][:80]})"
    return DataError(what, path, "the file is damaged or cut off")


LINES = 1 << 14


class SqueezedBlanks(io.RawIOBase):
    """UTF-8 bytes of *stream* (text in *encoding*), line by line without blanks at the ends and with one
    between fields.
    """

    def __init__(self, stream: BinaryIO, encoding: str) -> None:
        # Line feeds only end a line, as for whoever counts the lines of the header.
        self._lines = io.TextIOWrapper(stream, encoding=encoding, errors="replace", newline="\n")
        self._rest = b""

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        """At most *size* bytes; none at the end."""
        while size < 0 or len(self._rest) < size:
            lines = list(islice(self._lines, LINES))
            if not lines:
                break
            self._rest += "".join(" ".join(line.split()) + "\n" for line in lines).encode()
        wanted = self._rest if size < 0 else self._rest[:size]
        self._rest = self._rest[len(wanted) :]
        return wanted

    def close(self) -> None:
        self._lines.close()
        super().close()


DAY = 86400.0
_STAMP = re.compile(
    r"\s*\"?(?:(?P<date>\d{1,4}[-./]\d{1,2}[-./]\d{1,4})[T ]\s*)?"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<second>\d{2}(?:[.,]\d+)?)"
    r"\s*(?P<half>[AP]M)?\s*(?:Z|[+-]\d\d:?\d\d)?\"?\s*",
    re.IGNORECASE,
)


def is_stamp(field: str) -> bool:
    """True for 10:00:00.5, 2024-03-01 10:00:00,5, 3/1/2024 10:00:00 AM, 2024-03-01T10:00:00Z."""
    return _STAMP.fullmatch(field) is not None


class StampClock:
    """Seconds since the midnight before the first stamp. Days follow one another, so that no order of day and
    month is guessed.
    """

    def __init__(self, column: str) -> None:
        self._column = column
        self._date: str | None = None
        self._last = -np.inf
        self._midnight = 0.0

    def seconds(self, stamps: Iterable[str | None]) -> FloatArray:
        """The next stamps in seconds (n,) [s], NaN for a missing one. DataError for a date that is not the
        next day.
        """
        return np.array([self._second(stamp) for stamp in stamps], np.float64)

    def _second(self, stamp: str | None) -> float:
        match = _STAMP.fullmatch(stamp or "")
        if match is None:
            return float("nan")
        hour = int(match["hour"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"].upper() == "PM" else 0)
        second = hour * 3600 + int(match["minute"]) * 60 + float(match["second"].replace(",", "."))
        earlier = second < self._last - DAY / 2
        if earlier if match["date"] is None else self._date not in (None, match["date"]):
            if second > self._last:
                what = f"the column '{self._column}' leaves out time between {self._date} and {stamp}"
                raise DataError(what, hint="split the file there")
            self._midnight += DAY
        self._date, self._last = match["date"], second
        return self._midnight + second


HEAD_BYTES = 1 << 18
# Lines analysed from either end of the head; no header is longer.
SAMPLE_LINES = 200
# Blanks: any number of them stands between two fields.
BLANKS = " "
DELIMITERS = ("\t", ";", ",", "|", BLANKS)
MISSING = frozenset(("", "nan", "NaN", "NAN", "NA", "N/A", "#N/A", "null", "-", "--", "---"))
_COMMENT = re.compile(r"^\s*(?:[#%!]|//)+\s?")
LONGEST_UNIT = 100
_BRACKETS = re.compile(r"[\[(]([^\])]+)[\])]\s*$")


IsNumber = Callable[[str, str], bool]


@dataclass(frozen=True)
class TextLayout:
    """*names* has one entry per field of a data row (empty after a trailing delimiter); *first_line* is
    0-based. *stamps*: the fields that hold times of day or dates; *texts*: those that hold no numbers.
    """

    encoding: str
    delimiter: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    first_line: int
    stamps: tuple[int, ...] = ()
    texts: tuple[int, ...] = ()


def is_cell(field: str, decimal: str) -> bool:
    """True if a field is one number with this decimal sign, or a time of day."""
    return is_number(field, decimal) or (":" in field and is_stamp(field))


def is_number(field: str, decimal: str) -> bool:
    """True if a field is one number with this decimal sign."""
    if "_" in field or (decimal == "," and "." in field):
        return False
    text = field.strip().strip('"')
    try:
        float(text.replace(",", ".") if decimal == "," else text)
    except ValueError:
        return False
    return True


def is_missing(field: str) -> bool:
    """True if a field is a known mark for a missing number."""
    return field.strip().strip('"') in MISSING


def fields_of(line: str, delimiter: str) -> list[str]:
    """The fields of a line; a delimiter in quotation marks is none."""
    if delimiter == BLANKS:
        return line.split()
    return next(csv.reader([line], delimiter=delimiter)) if '"' in line else line.split(delimiter)


@dataclass(frozen=True)
class _Candidate:
    """A way to take lines apart: the numbers of the lines that are *rows* of *n_field* fields, of which
    *numeric* hold numbers.
    """

    delimiter: str
    decimal: str
    rows: list[int]
    n_field: int
    numeric: tuple[int, ...]

    def holds(self, line: str, number: IsNumber) -> bool:
        """Whether a line is one of the rows."""
        fields = fields_of(line, self.delimiter)
        return len(fields) == self.n_field and _all_numbers(
            [fields[n] for n in self.numeric], self.decimal, number
        )

    def filled_fields(self, lines: list[str]) -> tuple[int, ...]:
        """The fields that are missing in some rows at most."""
        rows = [fields_of(lines[n], self.delimiter) for n in self.rows]
        return tuple(n for n in range(self.n_field) if not all(is_missing(row[n]) for row in rows))

    def holds_beside(self, line: str, filled: Sequence[int], number: IsNumber) -> bool:
        """Whether a line has numbers in the *filled* fields and remarks in others, which rows leave empty."""
        fields = fields_of(line, self.delimiter)
        return len(fields) == self.n_field > len(filled) and all(
            number(fields[n], self.decimal) for n in filled
        )

    @property
    def rank(self) -> int:
        """Number of rows on a coarse scale, so that a few faulty rows do not determine the delimiter."""
        return len(self.rows).bit_length()

    def splits_numbers(self, lines: list[str]) -> bool:
        """Whether 0,0125 is taken for two whole numbers: none begins with a zero."""
        rows = [fields_of(lines[n], self.delimiter) for n in self.rows]
        return (
            (self.delimiter, self.n_field) == (",", 2)
            and all(
                re.fullmatch(r"\s*[-+]?\d+", whole) and re.fullmatch(r"\d+\s*", rest) for whole, rest in rows
            )
            and any(re.match(r"0\d", rest) for _, rest in rows)
        )

    def header_fits(self, lines: list[str]) -> bool:
        """Whether the line above the first row names its fields."""
        above = [line for line in lines[: self.rows[0]] if line.strip()] if self.rows else []
        return bool(above) and len(fields_of(above[-1], self.delimiter)) in self.widths(lines)

    def widths(self, lines: list[str]) -> range:
        """The numbers of fields that a header may have: rows may end in a delimiter that it lacks."""
        ends = self.delimiter != BLANKS and not fields_of(lines[self.rows[0]], self.delimiter)[-1].strip()
        return range(self.n_field - ends, self.n_field + 1)


def find_layout(path: Path, number: IsNumber = is_cell) -> TextLayout:
    """The layout of a text table; DataError when it is empty, no text, or has no rows of numbers. *number*
    knows what a number is.
    """
    encoding, lines = _head(path)
    sample = [
        n
        for n, line in enumerate(lines)
        if not SAMPLE_LINES <= n < len(lines) - SAMPLE_LINES and line.strip()
    ]
    best = _best_candidate(lines, sample, number, _numeric_rows)
    if best is None or 2 * len(best.rows) < len(sample):
        best = _best_candidate(lines, sample, number, _rows_with_text) or best
    if best is None:
        raise DataError("no row of numbers in it", path, "a table of numbers below one header line is needed")
    delimiter, decimal = best.delimiter, best.decimal
    first, filled = (
        next(n for n, line in enumerate(lines) if best.holds(line, number)),
        best.filled_fields(lines),
    )
    # Remarks beside the first rows, in columns without a number, make no header of them.
    while first and best.holds_beside(lines[first - 1], filled, number):
        first -= 1
    names, units = header_of(lines[:first], delimiter, best.widths(lines), filled)
    stamps = tuple(n for n, field in enumerate(fields_of(lines[first], delimiter)) if is_stamp(field))
    # Times of day are read as seconds, whatever stands in brackets.
    units |= {names[n]: "s" for n in stamps if names[n]}
    texts = tuple(n for n in range(best.n_field) if n not in best.numeric)
    return TextLayout(encoding, delimiter, decimal, names, units, first, stamps, texts)


# Bytes of the end of a file, and rows there, of equal decimals and of any, with which the last is compared.
TAIL_BYTES, EQUAL_ROWS, ANY_ROWS = 1 << 16, 10, 200


def check_last_number(path: Path, layout: TextLayout) -> None:
    """DataError where the last line has no end, and its last number fewer decimals than all before: what is
    left of a number that was cut reads as another one.
    """
    if path.suffix.lower() in PACKED:
        return
    with path.open("rb") as stream:
        stream.seek(-min(TAIL_BYTES, path.stat().st_size), io.SEEK_END)
        *rows, last = stream.read().decode(layout.encoding, errors="ignore").split("\n")
    n_field, after = len(layout.names), f"{re.escape(layout.decimal)}(.*)"
    ends = (*rows[1:], last) if last.strip() else ()
    fields = [fields_of(row.rstrip("\r"), layout.delimiter) for row in ends]
    matches = [re.search(after, row[-1].strip()) for row in fields if len(row) == n_field and row[-1].strip()]
    *before, ending = [len(match[1]) if match else 0 for match in matches] or [0]
    enough = EQUAL_ROWS if len(set(before)) == 1 else ANY_ROWS
    if len(before) >= enough and len(fields[-1]) == n_field and ending < min(before):
        what = f"ends within its last number, '{fields[-1][-1].strip()[:40]}'"
        raise DataError(what, path, "the file is cut off; copy it again, or delete its last line")


def rows_of_fields(path: Path, layout: TextLayout) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of every row. DataError for other fields than names, or one that is cut."""
    check_last_number(path, layout)
    with open_text(path, layout.encoding) as lines:
        for number, line in enumerate(lines, 1):
            if number <= layout.first_line or not line.strip():
                continue
            fields = fields_of(line.rstrip("\r\n"), layout.delimiter)
            if len(fields) != len(layout.names):
                what = f"{len(fields)} fields, {len(layout.names)} are needed as in the rows before"
                raise DataError(what, f"{path}:{number}")
            yield number, fields


def _best_candidate(
    lines: list[str], sample: list[int], number: IsNumber, rows_of: Callable[..., _Candidate]
) -> _Candidate | None:
    # One of the delimiters that no line has stands for all of them: a line is one field.
    present = [d for d in DELIMITERS if d == BLANKS or any(d in lines[n] for n in sample)]
    absent = [d for d in DELIMITERS if d not in present][:1]
    quoted = any('"' in lines[n] for n in sample)
    candidates = [
        rows_of(lines, sample, delimiter, decimal, number)
        for delimiter in (*absent, *present)
        for decimal in (".", ",")
        if delimiter != decimal or quoted
    ]
    # Of equal rows blanks delimit none: they stand beside other delimiters, too.
    delimited = (c.rank for c in candidates if c.delimiter != BLANKS and c.n_field > 1)
    most = max(delimited, default=0)
    layouts = [
        c
        for c in candidates
        if c.rows and (c.delimiter != BLANKS or c.rank > most) and not c.splits_numbers(lines)
    ]
    return max(layouts, key=lambda c: (c.rank, c.header_fits(lines), len(c.numeric)), default=None)


def _head(path: Path) -> tuple[str, list[str]]:
    try:
        with open_unpacked(path) as stream:
            head = stream.read(HEAD_BYTES)
    except OSError as error:
        raise damaged_error(path, error) if path.suffix.lower() in PACKED else error from None
    if not head.strip():
        raise DataError("the file is empty", path)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif b"\0" in head:
        raise DataError("is not a text file", path)
    else:
        encoding = "utf-8"
        try:
            head[:-4].decode() if len(head) == HEAD_BYTES else head.decode()
        except UnicodeDecodeError:
            encoding = "latin-1"
        encoding = "utf-8-sig" if head.startswith(codecs.BOM_UTF8) else encoding
    # Not splitlines(): pyarrow, which skips the header by its number of lines, counts line feeds only.
    lines = [line.rstrip("\r") for line in head.decode(encoding, errors="ignore").split("\n")]
    return encoding, lines[:-1] if len(head) == HEAD_BYTES else lines


def _all_numbers(fields: list[str], decimal: str, number: IsNumber) -> bool:
    """Whether fields are numbers, or missing ones beside at least one."""
    if decimal == "." and not any("_" in field for field in fields):
        # What most lines are, and what every kind of number holds, is seen at once.
        try:
            return bool([float(field) for field in fields])
        except ValueError:
            pass
    numbers = [number(field, decimal) for field in fields]
    return any(numbers) and all(
        is_value or is_missing(field) for is_value, field in zip(numbers, fields, strict=True)
    )


def _numeric_rows(
    lines: list[str], sample: list[int], delimiter: str, decimal: str, number: IsNumber
) -> _Candidate:
    rows: dict[int, list[int]] = {}
    for n in sample:
        fields = fields_of(lines[n], delimiter)
        if _all_numbers(fields, decimal, number):
            rows.setdefault(len(fields), []).append(n)
    n_field = max(rows, key=lambda n: (len(rows[n]), n), default=0)
    return _Candidate(delimiter, decimal, rows.get(n_field, []), n_field, tuple(range(n_field)))


def _rows_with_text(
    lines: list[str], sample: list[int], delimiter: str, decimal: str, number: IsNumber
) -> _Candidate:
    """Rows that are alike in which of their fields hold numbers, most of all lines: prose has numbers, too.
    Blanks delimit none: texts hold them.
    """
    rows: dict[tuple[bool, ...], list[int]] = {}
    for n in sample if delimiter != BLANKS else ():
        are_numbers = tuple(number(field, decimal) for field in fields_of(lines[n], delimiter))
        rows.setdefault(are_numbers, []).append(n)
    alike = max(rows, key=lambda kind: len(rows[kind]), default=())
    if not any(alike) or len(rows[alike]) < max(2, len(sample) / 2):
        return _Candidate(delimiter, decimal, [], 0, ())
    return _Candidate(
        delimiter,
        decimal,
        rows[alike],
        len(alike),
        tuple(n for n, is_number in enumerate(alike) if is_number),
    )


# What a logger writes ahead of its row of units.
UNIT_ROW = re.compile(r"(units?|einheit(en)?)\W*$", re.IGNORECASE)


def header_of(
    above: list[str], delimiter: str, widths: range, filled: Sequence[int] = ()
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Names and units from the lines above the numbers, the names of as many fields as *widths* allow of;
    columns without a header are called 1, 2, ... A row that leaves some of the *filled* fields without a name
    is a row of remarks where one above it names them all.
    """
    n_field = widths[-1]
    rows = [
        [text_of(field.strip().strip('"').strip()) for field in fields_of(_COMMENT.sub("", line), delimiter)]
        for line in above
    ]
    # A header may end in a delimiter that no row has.
    rows = [row[:n_field] if not any(row[n_field:]) else row for row in rows]
    titles = [row + [""] * (n_field - len(row)) for row in rows if len(row) in widths and any(row)]
    if not titles:
        return tuple(str(n + 1) for n in range(n_field)), {}
    names, unit_row = titles[-1], [""] * n_field
    if len(titles) > 1 and all(not field or _unit_of(field) or UNIT_ROW.match(field) for field in names):
        # Loggers put ranges and offsets between names and units.
        named = [
            row
            for row in titles[:-1]
            if len(set(row)) == n_field and not any(re.fullmatch(r"[-+]?[\d.]+", field) for field in row)
        ]
        unit_row, names = [_unit_of(field) for field in names], (named or titles[:-1])[-1]
    elif not all(names[n] for n in filled):
        names = next((row for row in titles[::-1] if all(row[n] for n in filled)), names)
    units = {name: unit or bracketed_unit(name) for name, unit in zip(names, unit_row, strict=True)}
    return tuple(names), {name: unit for name, unit in units.items() if unit}


def _unit_of(field: str) -> str:
    text = field.strip().strip("[]()").strip()
    try:
        parse_unit(text)
    except UnitError:
        return ""
    return text


def bracketed_unit(name: str) -> str:
    """ "x [um]" -> "um"; '' when the brackets hold no unit."""
    # No unit is longer; a search through a long row of brackets would take its square.
    match = _BRACKETS.search(name[-LONGEST_UNIT:])
    return _unit_of(match[1]) if match else ""


# Read ahead, a few times over: larger blocks are no faster and cost memory.
BLOCK_BYTES = 1 << 21


class CsvTable:
    """A text table of numbers. Satisfies RawTable; a faulty row is reported with its line number."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.layout = find_layout(path)
        named = [(name, n in self.layout.texts) for n, name in enumerate(self.layout.names) if name]
        self.columns = tuple(name for name, is_text in named if not is_text)
        self.texts = tuple(name for name, is_text in named if is_text)
        self.units = self.layout.units
        self.sample_rate: float | None = None
        # Of lines that are appended: times of day go on.
        self._clocks: dict[str, StampClock] | None = None

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], a column beside the other. DataError names
        line and column of the first row that is not numbers, or a last number that is cut.
        """
        check_last_number(self.path, self.layout)
        try:
            with self._bytes() as source:
                yield from self._rows(source, columns, self.layout.first_line, self._new_clocks())
        except pa.ArrowInvalid as error:
            raise self._locate(columns, str(error)) from None
        except UnicodeError as error:
            what = (
                f"is not {self.layout.encoding.upper()} text as its first bytes say ({shorten(str(error))})"
            )
            raise DataError(what, self.path, "the file is damaged or cut off") from None
        except OSError as error:
            raise damaged_error(self.path, error) if self.path.suffix.lower() in PACKED else error from None

    def rows_of(self, text: bytes, columns: Sequence[str]) -> FloatArray:
        """The numbers (n, n_column) [unit of the file] of whole lines that follow in a file that grows."""
        self._clocks = self._clocks or self._new_clocks()
        source: Any = io.BytesIO(text)
        if self.layout.delimiter == BLANKS:
            source = SqueezedBlanks(source, self.layout.encoding)
        try:
            rows = list(self._rows(source, columns, 0, self._clocks))
        except pa.ArrowInvalid as error:
            reason = shorten(str(error).splitlines()[0])
            raise DataError(f"a line that was appended cannot be read: {reason}", self.path) from None
        return np.concatenate([np.empty((0, len(columns))), *rows])

    def _new_clocks(self) -> dict[str, StampClock]:
        return {str(n): StampClock(self.layout.names[n]) for n in self.layout.stamps}

    def _rows(
        self, source: Any, columns: Sequence[str], skipped: int, clocks: dict[str, StampClock]
    ) -> Iterator[FloatArray]:
        fields = [str(self.layout.names.index(name)) for name in columns]
        for batch in self._open(source, fields, skipped):
            if batch.num_rows:
                read = ((batch.column(field), clocks.get(field)) for field in fields)
                yield np.array([c.seconds(a.to_pylist()) if c else numpy_array(a) for a, c in read]).T

    def _open(self, source: Any, fields: list[str], skipped: int) -> pc.CSVStreamingReader:
        layout = self.layout
        plain = layout.encoding.startswith("utf-8") or layout.delimiter == BLANKS
        types = {field: pa.string() if int(field) in layout.stamps else pa.float64() for field in fields}
        return pc.open_csv(
            source,
            pc.ReadOptions(
                block_size=BLOCK_BYTES,
                skip_rows=skipped,
                column_names=[str(n) for n in range(len(layout.names))],
                encoding="utf8" if plain else layout.encoding,
            ),
            pc.ParseOptions(delimiter=layout.delimiter),
            pc.ConvertOptions(
                column_types=types,
                include_columns=fields,
                null_values=sorted(MISSING),
                decimal_point=layout.decimal,
            ),
        )

    @contextmanager
    def _bytes(self) -> Iterator[Any]:
        if self.layout.delimiter == BLANKS:
            with SqueezedBlanks(open_unpacked(self.path), self.layout.encoding) as stream:
                yield stream
        elif self.path.suffix.lower() in PACKED:
            with open_unpacked(self.path) as stream:
                yield stream
        else:
            yield self.path

    def _locate(self, columns: Sequence[str], reason: str) -> DataError:
        places = [(name, self.layout.names.index(name)) for name in columns]
        for number, fields in rows_of_fields(self.path, self.layout):
            for name, place in places:
                if not (is_missing(fields[place]) or is_cell(fields[place], self.layout.decimal)):
                    what = f"column '{name}': '{fields[place].strip()[:40]}' is not a number"
                    return DataError(what, f"{self.path}:{number}")
        return DataError(f"cannot be read: {reason.splitlines()[0]}", self.path)
