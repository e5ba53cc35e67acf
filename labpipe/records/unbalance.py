"""The directional response of a rotor to its unbalance over speed, healthy and with wear."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class PeakChange:
    """Changes of the largest radii [m] and of their speeds [Hz], with their sign, by one standard uncertainty of a *source*."""

    source: str
    forward_peak: float
    forward_speed: float
    backward_peak: float
    backward_speed: float


@dataclass(frozen=True)
class UnbalanceCase:
    """One state of the bearing: wear *depth* [m] at *angle* [rad]; radii [m] of the forward and the backward circle at every speed.

    changes: of the largest of them by the doubts of the bearings' numbers.
    """

    name: str
    depth: float
    angle: float
    forward: tuple[float, ...]
    backward: tuple[float, ...]
    changes: tuple[PeakChange, ...] = ()

    def error(self, name: str) -> float | None:
        """Standard uncertainty of a largest radius [m] or its speed [Hz] by all sources, such as `forward_peak`; None without any."""
        return math.sqrt(sum(getattr(change, name) ** 2 for change in self.changes)) if self.changes else None


@dataclass(frozen=True)
class UnbalanceRuns:
    """All cases of one rotor over the same *speed* [Hz]; *node*: of the displacements; *bearing*: the worn bearing."""

    rotor: str
    bearing: str
    node: int
    speed: tuple[float, ...]
    cases: tuple[UnbalanceCase, ...]

    def values(self, case: UnbalanceCase) -> dict[str, tuple[float, str]]:
        """The largest radii [m] of a case and their speeds [Hz], by name, each with its unit."""
        peaks = {}
        for name, radius in (("forward", case.forward), ("backward", case.backward)):
            largest = max(radius)
            peaks[f"{name}_peak"] = (largest, "m")
            peaks[f"{name}_speed"] = (self.speed[radius.index(largest)], "Hz")
        return peaks
