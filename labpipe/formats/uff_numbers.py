"""The numbers of a record 58 (fixed-width text) or 58b (IEEE binary of either byte order)."""

from __future__ import annotations

import mmap
import re
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray

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


def text_layout(begin: int, end: int, ordinate_type: int, n_value: int, even: bool) -> NumberLayout:
    """The layout of numbers as text; ValueError for an unknown ordinate type."""
    _check(ordinate_type)
    return NumberLayout(begin, end, n_value, _PARTS[ordinate_type], even, _TEXT_WIDTH[ordinate_type])


def binary_layout(buffer: mmap.mmap, begin: int, codes: list[str], ordinate_type: int, n_value: int, even: bool) -> NumberLayout:
    """The layout of binary numbers, up to the closing -1; ValueError when it is missing.

    The byte count of the 58b header is not used: some programs count complex values once. Some programs write the abscissa or single
    precision data as doubles, contrary to the format; the position of the -1 shows it.
    """
    _check(ordinate_type)
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


def _check(ordinate_type: int) -> None:
    if ordinate_type not in _PARTS:
        raise ValueError(f"unknown ordinate data type {ordinate_type}")


def read_numbers(buffer: mmap.mmap, layout: NumberLayout) -> tuple[FloatArray | None, FloatArray | ComplexArray]:
    """Abscissa (n_value,) or None, and ordinates (n_value,), real or complex [unit of the file].

    ValueError when their number differs from that of the header.
    """
    if layout.dtype is None:
        abscissa, ordinate = _text_numbers(buffer[layout.begin : layout.end], layout)
    else:
        values = np.frombuffer(buffer[layout.begin : layout.end], layout.dtype)
        abscissa, ordinate = (None if layout.even else values["x"].astype(np.float64)), values["y"].astype(np.float64)
    return abscissa, ordinate[:, 0] if layout.parts == 1 else ordinate[:, 0] + 1j * ordinate[:, 1]


def _text_numbers(text: bytes, layout: NumberLayout) -> tuple[FloatArray | None, FloatArray]:
    columns = layout.parts + (not layout.even)
    numbers = _split(text.upper().replace(b"D", b"E"), layout)
    if numbers.size != columns * layout.n_value:
        raise ValueError(f"{numbers.size // columns} values, {layout.n_value} are stated: it is cut off or damaged")
    table = numbers.reshape(-1, columns)
    return (None, table) if layout.even else (table[:, 0], table[:, 1:])


def _split(text: bytes, layout: NumberLayout) -> FloatArray:
    """Numbers separated by blanks or, where fields touch (long exponents), by their widths."""
    try:
        return np.array(text.split(), dtype=np.float64)
    except ValueError:
        widths = [] if layout.even else [_ABSCISSA_WIDTH]
        return np.array([field for line in text.splitlines() for field in _fields(line, [*widths, *[layout.width] * layout.parts])], float)


def _fields(line: bytes, widths: list[int]) -> list[bytes]:
    fields, position, n = [], 0, 0
    while line[position:].strip():
        width = widths[n % len(widths)]
        fields.append(line[position : position + width])
        position, n = position + width, n + 1
    return fields
