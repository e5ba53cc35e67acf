"""A rig: which column is which channel, in which unit, with which sensitivity, in which direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

from labpipe.records.recording import Channel

AXIS_ANGLES = {"x": 0.0, "y": math.pi / 2}


@dataclass(frozen=True)
class RigChannel:
    """One channel of a rig file.

    SI value = scale * (recorded value) + offset; *limits* are the recorded values (low and high, in the recorded unit) at
    which the logger clips, if known.
    """

    channel: Channel
    column: str
    unit: str
    scale: float
    offset: float = 0.0
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Rig:
    """The rig file: *sample_rate* [Hz] or the *time* column with its unit in seconds; *mass* [kg] or None."""

    name: str
    channels: tuple[RigChannel, ...]
    sample_rate: float | None = None
    time: str | None = None
    time_scale: float = 1.0
    mass: float | None = None
    description: str = ""
