"""Elements of a drawing in SVG: words, paths and rectangles."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.document.chart_place import Place
from labpipe.document.letters import LEADING

# Places are whole numbers, so many of them to the point (1/72 in): as finely as print shows them.
PER_POINT = 10
# Points per unit of the width beyond which only the outermost of each unit are drawn.
CROWDED = 4


@dataclass(frozen=True)
class NamedPlace(Place):
    """A panel in a drawing in SVG; *name*: what its own definitions are called by, different for every panel of a page."""

    name: str

    def points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(n, 2) [units of 0.1 pt] whole numbers, NaN where nothing is shown, of values (n,) [units of the axes]."""
        points = np.rint(PER_POINT * np.column_stack([self.x.places(x), self.y.places(y)]))
        points[~np.isfinite(points).all(axis=1)] = np.nan
        return points


def words(text: str, x: float, y: float, size: float, anchor: str = "middle", *, turned: float = 0.0, colour: str = "") -> str:
    """A text whose foot (of several lines: that of the last) stands at (x, y) [pt], turned clockwise by an angle [deg]."""
    lines = text.split("\n")
    across, down, letters = (round(PER_POINT * value) for value in (x, y, size))
    look = f' text-anchor="{anchor}"' if anchor != "start" else ""
    look += f' transform="rotate({turned:g} {across} {down})"' if turned else ""
    look += f' style="fill:{colour}"' if colour else ""
    above = [round(LEADING * letters * number) for number in range(len(lines) - 1, -1, -1)]
    spans = [escape(line, quote=False) for line in lines]
    if len(lines) > 1:
        spans = [f'<tspan x="{across}" y="{down - step}">{line}</tspan>' for line, step in zip(spans, above, strict=True)]
    return f'<text x="{across}" y="{down}" font-size="{letters}"{look}>{"".join(spans)}</text>'


def path(data: str, look: str) -> str:
    """A path with the attributes *look*; nothing where it has no data."""
    return f'<path {look} d="{data}"/>' if data else ""


def rectangle(left: float, top: float, width: float, height: float, look: str) -> str:
    """A rectangle [pt] with the attributes *look*."""
    x, y, right, bottom = (round(PER_POINT * value) for value in (left, top, left + width, top + height))
    return f'<rect x="{x}" y="{y}" width="{right - x}" height="{bottom - y}" {look}/>'


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
