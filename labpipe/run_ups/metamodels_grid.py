"""Coefficients on a grid of loads and speeds, to which metamodels are fitted, and the coded coordinates of the fit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import DataError

# Relative difference below which two loads are the same.
SAME_LOAD = 1e-6


class Fitted(Protocol):
    """Coefficients (n_speed, 8) [N/m, N s/m] of one load [N] at speeds (n_speed,) [rad/s]."""

    @property
    def load(self) -> float: ...
    @property
    def speed(self) -> FloatArray:
        """Speeds (n_speed,) [rad/s]."""
        ...

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients (n_speed, 8) [N/m, N s/m]."""
        ...


class Queried(Protocol):
    """A fit with coefficients (n_speed, 8) and their errors at any load and speed."""

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients and standard errors (n_speed, 8) [N/m, N s/m] at a *load* [N] and speeds (n_speed,) [rad/s]."""
        ...


@dataclass(frozen=True)
class Grid:
    """load [N] and speed [rad/s] (n_point,), eight (n_point, 8) [N/m, N s/m]; DataError for other shapes or impossible values."""

    load: FloatArray
    speed: FloatArray
    eight: FloatArray

    def __post_init__(self) -> None:
        n = np.size(self.load)
        if np.shape(self.load) != np.shape(self.speed) or np.shape(self.eight) != (n, 8) or n == 0:
            raise DataError("a metamodel needs one load, one speed and eight coefficients per point")
        if not (np.all(np.isfinite(self.eight)) and np.all(np.asarray(self.load) > 0) and np.all(np.asarray(self.speed) > 0)):
            raise DataError("loads and speeds of a metamodel are positive and its coefficients finite")

    @classmethod
    def of(cls, fits: Iterable[Fitted]) -> Grid:
        """From one fit per load, such as a PointFit or an AmplitudeFit."""
        all_fits = list(fits)
        if not all_fits:
            raise DataError("there is no fit to make a metamodel of")
        load = np.concatenate([np.full(fit.speed.size, fit.load) for fit in all_fits])
        return cls(load, np.concatenate([fit.speed for fit in all_fits]), np.concatenate([fit.coefficients for fit in all_fits]))

    @classmethod
    def sampled(cls, fit: Queried, loads: Iterable[float], speed: FloatArray) -> Grid:
        """From a fit at any load, such as a JointFit or a ProcessFit, at *loads* [N] and *speed* (n_speed,) [rad/s]."""
        parts = [(np.full(np.size(speed), load), np.asarray(speed), fit.coefficients(load, speed)[0]) for load in loads]
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    @property
    def loads(self) -> tuple[float, ...]:
        """Its different loads [N], rising."""
        distinct: list[float] = []
        for load in np.sort(self.load).tolist():
            if not distinct or load > distinct[-1] * (1 + SAME_LOAD):
                distinct.append(load)
        return tuple(distinct)

    def _at(self, load: float) -> BoolArray:
        return np.abs(self.load / load - 1) <= SAME_LOAD

    def only(self, load: float) -> Grid:
        """The points of one load."""
        chosen = self._at(load)
        return Grid(self.load[chosen], self.speed[chosen], self.eight[chosen])

    def without(self, load: float) -> Grid:
        """The points of all other loads."""
        chosen = ~self._at(load)
        return Grid(self.load[chosen], self.speed[chosen], self.eight[chosen])


@dataclass(frozen=True)
class Extent:
    """Lowest and highest *loads* [N] and *speeds* [rad/s] of a grid; places are coded to -1 to 1 between them."""

    loads: tuple[float, float]
    speeds: tuple[float, float]

    @classmethod
    def of(cls, grid: Grid) -> Extent:
        ends = [(float(np.min(axis)), float(np.max(axis))) for axis in (grid.load, grid.speed)]
        return cls(ends[0], ends[1])

    def coded(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Coded coordinates (n_point, 2) [-] of loads [N] and speeds [rad/s]."""
        columns = []
        for places, (low, high) in ((load, self.loads), (speed, self.speeds)):
            half = (high - low) / 2 or 1.0
            columns.append((np.asarray(places, np.float64) - (low + high) / 2) / half)
        return np.stack(np.broadcast_arrays(*columns), axis=-1).reshape(-1, 2)

    def to_entries(self) -> dict[str, Any]:
        return {"loads": list(self.loads), "speeds": list(self.speeds)}

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> Extent:
        (first, last), (low, high) = entries["loads"], entries["speeds"]
        return cls((float(first), float(last)), (float(low), float(high)))
