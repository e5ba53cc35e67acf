"""Mode shapes on the structure: its points and lines, and how each mode moves them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.records.fit_details import Modes
from labpipe.records.rig import Geometry
from labpipe.report.chart import WIDTH, Drawing
from labpipe.report.document import Figure

KIND = "mode-shapes"
# Modes of one drawing, one row each.
AT_ONCE = 4
ROW_HEIGHT = 1.75
# The largest motion is drawn as this share of the structure's size.
REACH = 0.15
# Views of the drawing: name, azimuth and elevation [rad] of the eye.
VIEWS = (("oblique", -0.9, 0.5), ("front (x, z)", 0.0, 0.0), ("top (x, y)", 0.0, np.pi / 2))


@dataclass(frozen=True, eq=False)
class ShapeSketch:
    """names and lines (n_line, 2) of the points, positions (n_point, 3) [1] about their middle, the structure
    1 in size.

    titles of the modes; motion (n_mode, n_point, 3) [1], complex, the largest of each REACH.
    """

    names: tuple[str, ...]
    positions: FloatArray
    lines: IntArray
    titles: tuple[str, ...]
    motion: ComplexArray

    def extremes(self, mode: int) -> tuple[FloatArray, FloatArray]:
        """The points (n_point, 3) [1] at the two turns of a mode.

        A complex shape turns where its points together move farthest.
        """
        moved = self.motion[mode]
        turned = (moved * np.exp(-0.5j * np.angle(np.sum(moved**2)))).real
        return self.positions + turned, self.positions - turned


def project(points: FloatArray, azimuth: float, elevation: float) -> FloatArray:
    """*points* (n_point, 3) as an eye sees them that is turned by *azimuth* about z and raised by *elevation*
    [rad], (n_point, 2) [1].
    """
    x, y, z = points.T
    across = np.cos(azimuth) * x + np.sin(azimuth) * y
    away = np.cos(azimuth) * y - np.sin(azimuth) * x
    return np.stack([across, np.cos(elevation) * z + np.sin(elevation) * away], axis=-1)


def shape_figures(title: str, modes: Modes) -> list[Figure]:
    """The shapes on the structure, a few modes in each figure; nothing without a geometry. *title*: of the
    fit.
    """
    if modes.geometry is None:
        return []
    return [
        _figure(title, _sketch(modes, modes.geometry, range(n, min(n + AT_ONCE, modes.frequency.size))))
        for n in _starts(modes)
    ]


def _starts(modes: Modes) -> range:
    return range(0, modes.frequency.size, AT_ONCE)


def _sketch(modes: Modes, geometry: Geometry, chosen: range) -> ShapeSketch:
    middle = (geometry.positions.max(axis=0) + geometry.positions.min(axis=0)) / 2
    size = float(np.max(np.ptp(geometry.positions, axis=0))) or 1.0
    motion = geometry.motion(modes.dofs, modes.shapes)[list(chosen)]
    largest = np.max(np.linalg.norm(motion, axis=-1), axis=-1)
    titles = tuple(
        f"{n + 1}: {modes.frequency[n]:.4g} Hz, {100 * modes.damping_ratio[n]:.3g} %" for n in chosen
    )
    return ShapeSketch(
        geometry.names,
        (geometry.positions - middle) / size,
        geometry.lines,
        titles,
        REACH * motion / largest[:, None, None],
    )


def _figure(title: str, sketch: ShapeSketch) -> Figure:
    caption = (
        f"{title}: mode shapes on the structure at their two turns, grey at rest; natural frequency and "
        "damping ratio above. Points without a measured dof stand still."
    )
    drawing = Drawing(KIND, sketch, (WIDTH, ROW_HEIGHT * len(sketch.titles)))
    return Figure(
        drawing, caption, f"Mode shapes of fit {title} on the structure: {'; '.join(sketch.titles)}"
    )
