"""Consistency check of a MATLAB 5 file's elements: some damaged files would crash scipy's reader and with it the program."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_TYPES = frozenset((1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 14, 15, 16, 17, 18))
_CLASSES = range(1, 18)
_NUMERIC, _COMPLEX = range(6, 16), 0x800
_FLAGS, _DIMENSIONS = 6, 5


def check_elements(path: Path) -> None:
    """ValueError for an element longer than its container, of unknown type, or a matrix without flags and size.

    Compressed elements are unpacked (zlib.error for a wrong checksum). Versions 4 and 7.3 are checked by their readers.
    """
    content = path.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is not None and 0 not in content[:4]:
        _check(memoryview(content), _HEADER, len(content), order, top=True)


def _check(content: memoryview, begin: int, end: int, order: str, top: bool = False) -> int:
    """Check the elements from *begin* to *end*, including those inside matrices; their number."""
    number = 0
    while begin < end:
        kind, start, size, following = _element(content, begin, end, order)
        if top and kind not in (_MATRIX, _COMPRESSED):
            raise ValueError(f"an element of type {kind} is no variable")
        if kind == _COMPRESSED:
            inner = zlib.decompress(content[start : start + size])
            _check(memoryview(inner), 0, len(inner), order)
        if kind == _MATRIX and size:
            _check_matrix(content, start, start + size, order)
        begin, number = following, number + 1
    return number


def _element(content: memoryview, begin: int, end: int, order: str) -> tuple[int, int, int, int]:
    """(type, first byte, number of bytes, first byte after it) of the element at *begin*."""
    if begin + 8 > end:
        raise ValueError("an element is cut off")
    kind, size = struct.unpack(f"{order}II", content[begin : begin + 8])
    start = begin + 8
    if kind >> 16:
        kind, size, start, following = kind & 0xFFFF, kind >> 16, begin + 4, begin + 8
    else:
        following = start + size + (0 if kind == _COMPRESSED else -size % 8)
    if kind not in _TYPES or start + size > end or (start == begin + 4 and size > 4):
        raise ValueError("an element is damaged or cut off")
    return kind, start, size, following


def _check_matrix(content: memoryview, begin: int, end: int, order: str) -> None:
    kind, start, size, following = _element(content, begin, end, order)
    flags = struct.unpack(f"{order}I", content[start : start + 4])[0] if (kind, size) == (_FLAGS, 8) else 0
    if flags & 0xFF not in _CLASSES:
        raise ValueError("a variable has no flags")
    kind, _, size, following = _element(content, following, end, order)
    if kind != _DIMENSIONS or size < 8 or size % 4:
        raise ValueError("a variable has no size")
    parts = _check(content, following, end, order) - 1
    if flags & 0xFF in _NUMERIC and parts != (2 if flags & _COMPLEX else 1):
        raise ValueError("a variable lacks its numbers")
