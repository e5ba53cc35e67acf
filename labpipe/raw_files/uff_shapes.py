"""The mode shapes of a universal file: its records 55, data at nodes, of normal and complex modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, handed_over, modal_assurance
from labpipe.errors import DataError
from labpipe.raw_files.uff import records_55

# Analysis types of record 6: a normal mode, complex eigenvalues of first and of second order.
NORMAL, COMPLEX = 2, (3, 7)
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class FileShapes:
    """Mode shapes (n_point, n_mode) [1] of a file at its *points* ('12.z'), with frequency (n_mode,) [Hz] and
    damping_ratio (n_mode,) [1].

    others: records that are no modes, or of other nodes than the first one.
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
            raise DataError(what, where=str(path), hint="export the shapes again") from None
    modes = [mode for mode in sets if mode.analysis in (NORMAL, *COMPLEX)]
    alike = [mode for mode in modes if (mode.nodes, mode.width) == (modes[0].nodes, modes[0].width)]
    if not alike:
        return None
    axes = AXES[: alike[0].width] if alike[0].width <= len(AXES) else tuple(map(str, range(alike[0].width)))
    points = tuple(f"{node}.{axis}" for node in alike[0].nodes for axis in axes)
    matrix = np.stack([mode.shape for mode in alike], axis=1)
    pairs = np.array([mode.pole for mode in alike])
    return FileShapes(points, pairs[:, 0], pairs[:, 1], handed_over(matrix), len(sets) - len(alike))


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
        parts = {2: 1, 4: 1, 5: 2, 6: 2}.get(kind[4], 0)
        count = [int(field) for field in lines[6].split()]
        at = 6 + -(-(2 + count[0]) // 8)
        numbers, at = _fields(lines, at, count[1])
        if not parts or kind[5] < 1 or (len(lines) - at) % (1 + -(-parts * kind[5] // 6)):
            raise ValueError
        nodes: list[int] = []
        values: list[float] = []
        while at < len(lines):
            nodes.append(int(lines[at]))
            of_node, at = _fields(lines, at + 1, parts * kind[5])
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


def _fields(lines: Sequence[str], at: int, count: int) -> tuple[list[float], int]:
    """*count* numbers, six of 13 letters in a line from line *at* on, and the line after them."""
    stop = at - (-count // 6)
    row = [line[n : n + 13] for line in lines[at:stop] for n in range(0, len(line.rstrip()), 13)]
    if len(row) != count:
        raise ValueError
    return [float(field.upper().replace("D", "E")) for field in row], stop
