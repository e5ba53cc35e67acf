"""Where things stand in a drawing of a chart: boxes of panels and scales of axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray

# Places beyond this [pt] are drawn here: outside every panel, and no longer number than needed.
FAR = 3000.0


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
    """A panel in a drawing: its *box* and the scales of its axes."""

    box: Box
    x: Scale
    y: Scale
