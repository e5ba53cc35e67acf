"""Detection of a text table's layout: encoding, delimiter, decimal sign, header, unit row, first row of numbers."""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from labpipe.errors import DataError
from labpipe.formats.packed import PACKED, damaged, open_unpacked
from labpipe.formats.time_stamps import is_stamp
from labpipe.quantities import UnitError, parse_unit
from labpipe.spreadsheet_cells import text_of

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
class Layout:
    """*names* has one entry per field of a data row (empty after a trailing delimiter); *first_line* is 0-based.

    *stamps*: the fields that hold times of day or dates.
    """

    encoding: str
    delimiter: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    first_line: int
    stamps: tuple[int, ...] = ()


def is_cell(field: str, decimal: str) -> bool:
    """True if a field is one number with this decimal sign, or a time of day."""
    return is_number(field, decimal) or (":" in field and is_stamp(field))


def is_number(field: str, decimal: str) -> bool:
    """True if a field is one number with this decimal sign."""
    text = field.strip().strip('"')
    if decimal == "," and "." in text:
        return False
    try:
        float(text.replace(",", ".") if decimal == "," else text)
    except ValueError:
        return False
    return "_" not in text


def is_number_or_missing(field: str, decimal: str, number: IsNumber = is_cell) -> bool:
    """True if a field is a number or a known mark for a missing one."""
    return is_missing(field) or number(field, decimal)


def is_missing(field: str) -> bool:
    """True if a field is a known mark for a missing number."""
    return field.strip().strip('"') in MISSING


def fields_of(line: str, delimiter: str) -> list[str]:
    """The fields of a line."""
    return line.split() if delimiter == BLANKS else line.split(delimiter)


def find_layout(path: Path, number: IsNumber = is_cell) -> Layout:
    """The layout of a text table; DataError when it is empty, no text, or has no rows of numbers; *number* knows what a number is."""
    encoding, lines = _head(path)
    sample = _sample(len(lines))
    candidates = [
        (delimiter, decimal, *_numeric_rows(lines, sample, delimiter, decimal, number))
        for delimiter in DELIMITERS
        for decimal in (".", ",")
        if delimiter != decimal
    ]
    # Of equal rows blanks delimit none: they stand beside other delimiters, too.
    delimited = (_rank(c[2]) for c in candidates if c[0] != BLANKS and c[3] > 1)
    most = max(delimited, default=0)
    layouts = [c for c in candidates if c[0] != BLANKS or _rank(c[2]) > most]
    delimiter, decimal, rows, n_field = max(layouts, key=lambda c: (_rank(c[2]), _header_fits(lines, c), c[3]))
    if not rows:
        raise DataError("no row of numbers in it", where=str(path), hint="a table of numbers below one header line is needed")
    first = next(
        n for n, line in enumerate(lines) if len(fields_of(line, delimiter)) == n_field and _is_numeric(line, delimiter, decimal, number)
    )
    names, units = header_of(lines[:first], delimiter, n_field)
    stamps = tuple(n for n, field in enumerate(fields_of(lines[first], delimiter)) if is_stamp(field))
    return Layout(encoding, delimiter, decimal, names, units, first, stamps)


def _head(path: Path) -> tuple[str, list[str]]:
    try:
        with open_unpacked(path) as stream:
            head = stream.read(HEAD_BYTES)
    except OSError as error:
        raise damaged(path, error) if path.suffix.lower() in PACKED else error from None
    if not head.strip():
        raise DataError("the file is empty", where=str(path))
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif b"\0" in head:
        raise DataError("is not a text file", where=str(path))
    else:
        encoding = "utf-8-sig" if head.startswith(codecs.BOM_UTF8) else _utf8_or_latin(head)
    # Not splitlines(): pyarrow, which skips the header by its number of lines, counts line feeds only.
    lines = [line.rstrip("\r") for line in head.decode(encoding, errors="ignore").split("\n")]
    return encoding, lines[:-1] if len(head) == HEAD_BYTES else lines


def _utf8_or_latin(head: bytes) -> str:
    try:
        head[:-4].decode("utf-8") if len(head) == HEAD_BYTES else head.decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _sample(n_line: int) -> list[int]:
    """The lines analysed for every layout: all of a short file, the first and the last ones of a long one."""
    if n_line <= 2 * SAMPLE_LINES:
        return list(range(n_line))
    return [*range(SAMPLE_LINES), *range(n_line - SAMPLE_LINES, n_line)]


def _is_numeric(line: str, delimiter: str, decimal: str, number: IsNumber) -> bool:
    """True if a line is a row of numbers, some of which may be missing."""
    numbers = 0
    for field in fields_of(line, delimiter):
        if number(field, decimal):
            numbers += 1
        elif not is_missing(field):
            return False
    return numbers > 0


def _numeric_rows(lines: list[str], sample: list[int], delimiter: str, decimal: str, is_cell: IsNumber) -> tuple[list[int], int]:
    """The lines of the sample that are rows of numbers, and their number of fields (the most frequent one)."""
    counts: dict[int, list[int]] = {}
    for number in sample:
        if _is_numeric(lines[number], delimiter, decimal, is_cell):
            counts.setdefault(len(fields_of(lines[number], delimiter)), []).append(number)
    n_field = max(counts, key=lambda n: (len(counts[n]), n), default=0)
    return counts.get(n_field, []), n_field


def _rank(rows: list[int]) -> float:
    """Number of numeric rows on a coarse scale, so that a few faulty rows do not determine the delimiter."""
    return round(len(rows).bit_length(), 0)


def _header_fits(lines: list[str], candidate: tuple[str, str, list[int], int]) -> bool:
    delimiter, _, rows, n_field = candidate
    above = [line for line in lines[: rows[0]] if line.strip()] if rows else []
    return bool(above) and len(fields_of(above[-1], delimiter)) in (n_field, n_field - 1)


def header_of(above: list[str], delimiter: str, n_field: int) -> tuple[tuple[str, ...], dict[str, str]]:
    """Names and units from the lines above the numbers; columns without a header are called 1, 2, ..."""
    rows = [[text_of(field.strip().strip('"').strip()) for field in fields_of(_COMMENT.sub("", line), delimiter)] for line in above]
    # A data row may end in a delimiter that its header lacks.
    fewest = n_field if delimiter == BLANKS else n_field - 1
    titles = [row + [""] * (n_field - len(row)) for row in rows if fewest <= len(row) <= n_field and any(row)]
    if not titles:
        return tuple(str(n + 1) for n in range(n_field)), {}
    names, unit_row = titles[-1], [""] * n_field
    if len(titles) > 1 and all(not field or _unit_of(field) for field in names):
        names, unit_row = titles[-2], [_unit_of(field) for field in names]
    units = {name: unit or bracketed_unit(name) for name, unit in zip(names, unit_row, strict=True)}
    return tuple(names), {name: unit for name, unit in units.items() if unit}


def _unit_of(field: str) -> str:
    """The unit in a field of a unit row, '' for none."""
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
