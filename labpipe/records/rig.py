"""A rig: which column is which channel, in which unit, with which sensitivity, in which direction."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError, DataError, SettingError
from labpipe.quantities import UnitError, parse_value
from labpipe.records.recording import Channel
from labpipe.records.settings import Settings, integer, quantity, text
from labpipe.records.uncertain import Uncertain

AXIS_ANGLES = {"x": 0.0, "y": math.pi / 2}


# msec, microseconds, and "seconds since 2024-03-01" of HDF5 files.
_WORDS = (("( since .*| )", ""), ("milli", "m"), ("micro", "u"), ("nano", "n"), ("sec(ond)?s?$", "s"))


def time_scale(column: str | None, units: Mapping[str, str], where: Path | str = "") -> float:
    """Seconds per unit of a time column: by the *units* that its file states, else in brackets behind its
    name; 1 without one. DataError for a unit that is none of time.
    """
    behind = re.search(r"[\[(]([^\])]+)[\])]\s*$", column or "")
    stated = units.get(column or "") or (behind[1] if behind else "s")
    unit = stated
    for word, short in _WORDS:
        unit = re.sub(word, short, unit, flags=re.IGNORECASE)
    try:
        return parse_value(f"1 {unit}", "s")
    except UnitError:
        what, hint = f"'{column}' is in {stated}, which is not a unit of time", "known: s, ms, us, ns, min, h"
        raise DataError(what, where, f"{hint}; or give sample_rate instead of time") from None


@dataclass(frozen=True)
class RigChannel:
    """One channel of a rig file.

    SI value = scale * (recorded value) + offset; *limits* are the recorded values (low and high, in the
    recorded unit) at which the logger clips, if known.
    """

    channel: Channel
    column: str
    unit: str
    scale: float
    offset: float = 0.0
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Rig:
    """The rig file: *sample_rate* [Hz] or the *time* column, or the rate [Hz] to *resample* channels of
    several rates to; *mass* [kg] or None.

    derived: channels that are sums of recorded ones. mass_uncertainty: the mass with its standard
    uncertainty, if it has one.
    """

    name: str
    channels: tuple[RigChannel, ...]
    sample_rate: float | None = None
    time: str | None = None
    mass: float | None = None
    description: str = ""
    derived: tuple[Channel, ...] = ()
    mass_uncertainty: Uncertain | None = None
    resample: float | None = None

    @property
    def columns(self) -> list[str]:
        """What a file must hold: the time column, if there is one, then the columns of the channels."""
        return [*filter(None, [self.time]), *(channel.column for channel in self.channels)]

    @property
    def time_scale(self) -> float:
        """Seconds per unit of the time column by its name alone."""
        return time_scale(self.time, {})

    @property
    def all_channels(self) -> tuple[Channel, ...]:
        """The channels of a calibrated recording: the recorded ones, then sums of them."""
        return (*(channel.channel for channel in self.channels), *self.derived)

    @property
    def sums(self) -> FloatArray:
        """Factors (n_derived, n_channel) [SI unit of the sum per SI unit of the channel] of the recorded
        channels in every sum.
        """
        names = [channel.channel.name for channel in self.channels]
        factors = np.zeros((len(self.derived), len(names)))
        for row, channel in enumerate(self.derived):
            for term in channel.terms:
                factors[row, names.index(term.channel)] = term.factor
        return factors


# A condition of a test that was recorded with it: the mean of a channel, or the speed that a tacho shows.


@dataclass(frozen=True)
class RecordedCondition(Settings):
    """Where a condition is taken from."""

    channel: str = text("channel whose mean is the condition")
    tacho: str = text("channel with tacho pulses, whose mean speed is the condition")
    pulses: int = integer("pulses of the tacho per revolution", 1)

    def __post_init__(self) -> None:
        if bool(self.channel) == bool(self.tacho):
            what = "one of 'channel' and 'tacho' is needed"
            raise ConfigError(what, hint="channel: load_cell, or tacho: key")
        self.require_positive("pulses")


@dataclass(frozen=True)
class Span(Settings):
    """The part of a recording that counts; times from its first sample on."""

    start: float = quantity("what comes before does not count; times from the first sample on", "s", 0.0)
    end: float | None = quantity("what comes after does not count; default: the end of the file", "s", None)

    def __post_init__(self) -> None:
        self.require_not_negative("start")
        if self.end is not None and self.end <= self.start:
            raise SettingError("end", "'end' must come after 'start'")

    @property
    def is_whole(self) -> bool:
        """Whether nothing is left out."""
        return self == Span()


AXES = "xyz"
# "12.x", "12:-y", "12z", or "x" alone on a structure of one point.
_DIRECTED = re.compile(r"^(?P<point>.*?)[.:\s]?(?P<sign>[+-]?)(?P<axis>[xyzXYZ])$")
# Points named in a message.
MOST_NAMES = 8


@dataclass(frozen=True)
class Geometry:
    """names of the points, positions (n_point, 3) [m] along x, y, z, and lines (n_line, 2): numbers of the
    points that each joins.
    """

    names: tuple[str, ...]
    positions: FloatArray
    lines: IntArray

    def check_points(self) -> Geometry:
        """The same; DataError for no point, one that stands twice, or a position that is not a number."""
        repeated = [name for n, name in enumerate(self.names) if name in self.names[:n]]
        if repeated:
            raise DataError(f"point '{repeated[0]}' stands twice")
        if not self.names:
            raise DataError("holds no point")
        if not np.all(np.isfinite(self.positions)):
            raise DataError("a position is not a number")
        return self

    def motion(self, dofs: Sequence[str], shapes: ComplexArray) -> ComplexArray:
        """How every point moves in each mode, (n_mode, n_point, 3) [1], from *shapes* (n_dof, n_mode) at the
        *dofs*; 0 where unmeasured.

        DataError for a dof whose point is not in the geometry.
        """
        moved = np.zeros((shapes.shape[1], len(self.names), 3), complex)
        for dof, row in zip(dofs, shapes, strict=True):
            point, direction = self.place(dof)
            moved[:, point] += row[:, None] * direction
        return moved

    @classmethod
    def of_dofs(cls, dofs: Sequence[str]) -> Geometry:
        """The points that *dofs* name, all in one place, for what needs no positions.

        Directions alone ("x") are of one point, "".
        """
        directed = [_DIRECTED.match(dof) for dof in dofs]
        points = dict.fromkeys(
            match["point"] if match else dof for match, dof in zip(directed, dofs, strict=True)
        )
        return cls(tuple(points), np.zeros((len(points), 3)), np.empty((0, 2), int))

    def check(self, dofs: Sequence[str]) -> None:
        """DataError for a dof whose point is not in the geometry."""
        for dof in dofs:
            self.place(dof)

    def place(self, dof: str) -> tuple[int, FloatArray]:
        """(number of the point, unit vector (3,) [1] of the direction) of a dof.

        A dof without a direction moves along z.
        """
        if dof in self.names:
            return self.names.index(dof), np.array([0.0, 0.0, 1.0])
        directed = _DIRECTED.match(dof)
        point = directed["point"] if directed else dof
        alone = not point and len(self.names) == 1
        if directed is None or not (alone or point in self.names):
            names = ", ".join(self.names[:MOST_NAMES]) + (", ..." if len(self.names) > MOST_NAMES else "")
            what = f"the geometry has no point '{point or dof}', of the dof '{dof}'"
            raise DataError(what, hint=f"its points: {names}")
        vector = np.zeros(3)
        vector[AXES.index(directed["axis"].lower())] = -1.0 if directed["sign"] == "-" else 1.0
        return (0 if alone else self.names.index(point)), vector
