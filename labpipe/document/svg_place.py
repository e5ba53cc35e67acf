"""Where things stand in a drawing: boxes of panels, scales of axes, and paths through points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.document.svg_text import PER_POINT

# Places beyond this [pt] are drawn here: outside every panel, and no longer number than needed.
FAR = 3000.0
# Points per unit of the width beyond which only the outermost of each unit are drawn.
CROWDED = 4


@dataclass(frozen=True)
class Box:
    """The inside of a panel: left and right from the left edge of the drawing, top and bottom from its upper edge [pt]."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def width(self) -> float:
        """From left to right [pt]."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """From top to bottom [pt]."""
        return self.bottom - self.top

    @property
    def middle(self) -> tuple[float, float]:
        """Its centre (x, y) [pt]."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2


@dataclass(frozen=True)
class Scale:
    """An axis from *limits* [its unit] to places from *start* to *end* [pt]."""

    limits: tuple[float, float]
    logarithmic: bool
    start: float
    end: float

    def places(self, values: FloatArray) -> FloatArray:
        """(n,) [pt] places of values (n,) [unit of the axis], NaN where they are; no logarithm: beyond the start."""
        low, high = self._straight(np.array(self.limits))
        with np.errstate(invalid="ignore"):
            part = (self._straight(values) - low) / ((high - low) or 1.0)
            return np.asarray(np.clip(self.start + part * (self.end - self.start), -FAR, FAR))

    def _straight(self, values: FloatArray) -> FloatArray:
        if not self.logarithmic:
            return values
        positive = np.where(values > 0, values, 1.0)
        return np.where(values > 0, np.log10(positive), np.where(np.isnan(values), np.nan, -np.inf))


@dataclass(frozen=True)
class Place:
    """A panel in the drawing; *name*: what its own definitions are called by, different for every panel of a page."""

    box: Box
    x: Scale
    y: Scale
    name: str

    def points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(n, 2) [units of 0.1 pt] whole numbers, NaN where nothing is shown, of values (n,) [units of the axes]."""
        points = np.rint(PER_POINT * np.column_stack([self.x.places(x), self.y.places(y)]))
        points[~np.isfinite(points).all(axis=1)] = np.nan
        return points


def runs(there: FloatArray) -> list[slice]:
    """Where an array (n, m) [units of 0.1 pt] has no NaN, as slices one after the other."""
    finite = np.concatenate([[False], np.isfinite(there).all(axis=1), [False]])
    edges = np.flatnonzero(finite[1:] != finite[:-1])
    return [slice(first, last) for first, last in zip(edges[0::2].tolist(), edges[1::2].tolist(), strict=True)]


def joined(points: FloatArray) -> str:
    """The path through points (n, 2) [units of 0.1 pt], broken where they are NaN."""
    return "".join(_through(_thinned(points[run].astype(np.int64))) for run in runs(points))


def closed(points: FloatArray) -> str:
    """The path around an outline (n, 2) [units of 0.1 pt] of whole numbers."""
    return _through(points.astype(np.int64)) + "z" if len(points) else ""


def stamped(points: FloatArray, shape: str) -> str:
    """One *shape*, a path by steps which ends where it began, at each of the points (n, 2) [units of 0.1 pt], those of one place once."""
    there = np.unique(points[np.isfinite(points).all(axis=1)].astype(np.int64), axis=0)
    if not there.size:
        return ""
    steps = np.diff(there, axis=0, prepend=0).tolist()
    return "".join(f"m{across} {down}{shape}" for across, down in steps).replace(" -", "-")


def _through(points: IntArray) -> str:
    """Whole numbers (n, 2) as a path by steps."""
    steps = np.diff(points, axis=0)
    steps = steps[(steps != 0).any(axis=1)]
    first = f"M{points[0, 0]} {points[0, 1]}"
    return (first + ("l" + " ".join(map(str, steps.ravel().tolist())) if steps.size else "h0")).replace(" -", "-")


def _thinned(points: IntArray) -> IntArray:
    """Points (n, 2); where many of them, rising from left to right, stand in one unit of the width, its first, outermost and last."""
    across = points[:, 0]
    if len(points) < CROWDED * (int(np.ptp(across)) + 1) or np.any(np.diff(across) < 0):
        return points
    begins = np.flatnonzero(np.diff(across, prepend=across[0] - 1))
    lasts = np.append(begins[1:], len(points)) - 1
    order = np.lexsort((points[:, 1], across))
    return points[np.unique(np.concatenate([begins, lasts, order[begins], order[lasts]]))]
