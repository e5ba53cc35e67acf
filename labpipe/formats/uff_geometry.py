"""Nodes (15, 2411), trace lines (82), elements (2412) and units (164) of a universal file as a geometry.

Layout: I-DEAS universal datasets; numbers are read as words, since writers differ in their widths.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from labpipe.errors import DataError
from labpipe.records.geometry import Geometry

NODES, DOUBLE_NODES, TRACE, ELEMENTS, UNITS = 15, 2411, 82, 2412, 164
# Label, two coordinate systems, colour, x, y, z.
_NODE_WORDS = 7
# Elements of two nodes whose nodes stand on a third line (rods and beams).
_BEAMS = (11, 21, 22, 23, 24)


def read_geometry_uff(path: Path) -> Geometry:
    """All nodes as points named by their labels, joined along trace lines and around elements; DataError where there are none."""
    nodes: dict[int, list[float]] = {}
    pairs: list[tuple[int, int]] = []
    length = 1.0
    for number, lines in _datasets(path):
        try:
            if number in (NODES, DOUBLE_NODES):
                nodes |= _nodes(lines)
            elif number == TRACE:
                pairs += _trace(lines)
            elif number == ELEMENTS:
                pairs += _elements(lines)
            elif number == UNITS:
                length = _real(lines[1].split()[0])
        except (ValueError, IndexError):
            raise DataError(f"the record {number} cannot be read", where=str(path), hint="numbers are missing, or are none") from None
    if not nodes:
        raise DataError("holds no nodes", where=str(path), hint="records 15 or 2411 are needed")
    if not length > 0:
        raise DataError("the factors of the units record 164 cannot be read", where=str(path))
    place = {label: n for n, label in enumerate(nodes)}
    lost = [label for pair in pairs for label in pair if label not in place]
    if lost:
        raise DataError(f"a line leads to node {lost[0]}, which is not in the file", where=str(path))
    lines_between = np.array(sorted({(place[a], place[b]) for a, b in pairs if a != b}), int).reshape(-1, 2)
    return Geometry(tuple(str(label) for label in nodes), np.array(list(nodes.values())) / length, lines_between)


def _datasets(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(number, lines) of every dataset of text; datasets of binary numbers are passed over."""
    text = path.read_bytes().decode("latin-1")
    for block in re.split(r"^[ \t]*-1[ \t]*\r?$", text, flags=re.MULTILINE)[1::2]:
        lines = [line for line in block.splitlines() if line.strip()]
        kind = lines[0].split()[0] if lines else ""
        if kind.isascii() and kind.isdigit():
            yield int(kind), lines[1:]


def _real(word: str) -> float:
    return float(word.upper().replace("D", "E"))


def _nodes(lines: list[str]) -> dict[int, list[float]]:
    words = " ".join(lines).split()
    if len(words) % _NODE_WORDS:
        raise ValueError
    return {int(words[n]): [_real(word) for word in words[n + 4 : n + 7]] for n in range(0, len(words), _NODE_WORDS)}


def _trace(lines: list[str]) -> list[tuple[int, int]]:
    """Pairs of neighbours along a trace line; 0 lifts the pen."""
    labels = [int(word) for word in " ".join(lines[2:]).split()]
    return [(a, b) for a, b in pairwise(labels) if a and b]


def _elements(lines: list[str]) -> list[tuple[int, int]]:
    """Pairs of neighbours around every element, in the order of its nodes."""
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
