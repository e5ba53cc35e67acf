"""Mode shapes as a universal file: units (164), nodes (15) and lines (82) of the structure, one record 55 per mode.

Layout: I-DEAS universal datasets 15, 82 and 55 (complex eigenvalue of first order, translations, displacement).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import DataError
from labpipe.formats.uff_write import UNITS
from labpipe.records.geometry import Geometry
from labpipe.records.identification import Fit
from labpipe.records.modes import Modes

_STRUCTURAL, _COMPLEX_EIGENVALUE, _TRANSLATIONS, _DISPLACEMENT, _COMPLEX, _VALUES = 1, 3, 2, 8, 5, 3
_TITLE_WIDTH = 80
TILTS = ("bx", "by", "bz")


def write_shapes_uff(path: Path, fits: Sequence[Fit]) -> None:
    """Write the modes of all *fits*; nodes are numbered as their points are named, or from 1 where names are no numbers.

    Records 55 are of translations: without a geometry, tilts of a body (bx, by, bz) are left out. DataError where nothing else moves.
    """
    text = [UNITS.format(1.0, 0.0)]
    for first, fit in enumerate(fits):
        assert fit.modes is not None
        moving = [n for n, dof in enumerate(fit.modes.dofs) if fit.modes.geometry or dof not in TILTS]
        if not moving:
            raise DataError(f"fit '{fit.name}' has tilts only", hint="records 55 are written of translations")
        dofs = [fit.modes.dofs[n] for n in moving]
        geometry = fit.modes.geometry or Geometry.of_dofs(dofs)
        labels = _labels(geometry)
        if first == 0:
            text += [_nodes(geometry, labels), *([_lines(geometry, labels)] if geometry.lines.size else [])]
        motion = geometry.motion(dofs, fit.modes.shapes[moving])
        text += [_mode(fit, fit.modes, n, labels, motion[n]) for n in range(fit.modes.frequency.size)]
    path.write_text("".join(text), encoding="ascii", errors="replace", newline="\n")


def _labels(geometry: Geometry) -> list[int]:
    numbers = [int(name) if name.isdigit() else 0 for name in geometry.names]
    return numbers if min(numbers) > 0 and len(set(numbers)) == len(numbers) else list(range(1, len(numbers) + 1))


def _dataset(number: int, lines: Sequence[str]) -> str:
    return "\n".join(["    -1", f"{number:6d}", *lines, "    -1"]) + "\n"


def _nodes(geometry: Geometry, labels: Sequence[int]) -> str:
    rows = zip(labels, geometry.positions.tolist(), strict=True)
    return _dataset(15, [f"{label:10d}{0:10d}{0:10d}{11:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for label, (x, y, z) in rows])


def _lines(geometry: Geometry, labels: Sequence[int]) -> str:
    """One trace line that lifts the pen (0) ahead of every pair."""
    trace = [label for a, b in geometry.lines.tolist() for label in (0, labels[a], labels[b])]
    rows = ["".join(f"{label:10d}" for label in trace[n : n + 8]) for n in range(0, len(trace), 8)]
    return _dataset(82, [f"{1:10d}{len(trace):10d}{11:10d}", "lines of the structure", *rows])


def _mode(fit: Fit, modes: Modes, n: int, labels: Sequence[int], motion: ComplexArray) -> str:
    w, zeta = 2 * np.pi * modes.frequency[n], modes.damping_ratio[n]
    eigenvalue = -zeta * w, w * np.sqrt(max(1 - zeta**2, 0.0))
    head = [
        f"mode {n + 1}: {modes.frequency[n]:.6g} Hz, damping ratio {modes.damping_ratio[n]:.4g}"[:_TITLE_WIDTH],
        (f"fit {fit.name}" + (f", test {fit.test}" if fit.test else ""))[:_TITLE_WIDTH],
        *["NONE"] * 3,
        "".join(f"{value:10d}" for value in (_STRUCTURAL, _COMPLEX_EIGENVALUE, _TRANSLATIONS, _DISPLACEMENT, _COMPLEX, _VALUES)),
        "".join(f"{value:10d}" for value in (2, 6, 1, n + 1)),
        # Modal A and B are left zero: they need a driving point.
        "".join(f"{value:13.5E}" for value in (*eigenvalue, 0.0, 0.0, 0.0, 0.0)),
    ]
    rows = [
        line
        for label, moved in zip(labels, motion, strict=True)
        for line in (f"{label:10d}", "".join(f"{part:13.5E}" for value in moved for part in (value.real, value.imag)))
    ]
    return _dataset(55, [*head, *rows])
