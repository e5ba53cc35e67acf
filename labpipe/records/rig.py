"""A rig: which column is which channel, in which unit, with which sensitivity, in which direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.records.recording import Channel
from labpipe.records.settings import Settings, setting
from labpipe.records.uncertain import Uncertain

# A rig: which column is which channel, in which unit, with which sensitivity, in which direction.

AXIS_ANGLES = {"x": 0.0, "y": math.pi / 2}


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
    """The rig file: *sample_rate* [Hz] or the *time* column with its unit in seconds, or the rate [Hz] to
    *resample* channels of several rates to; *mass* [kg] or None.

    derived: channels that are sums of recorded ones. mass_uncertainty: the mass with its standard
    uncertainty, if it has one.
    """

    name: str
    channels: tuple[RigChannel, ...]
    sample_rate: float | None = None
    time: str | None = None
    time_scale: float = 1.0
    mass: float | None = None
    description: str = ""
    derived: tuple[Channel, ...] = ()
    mass_uncertainty: Uncertain | None = None
    resample: float | None = None

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

    channel: str = setting("text", "channel whose mean is the condition", default="")
    tacho: str = setting("text", "channel with tacho pulses, whose mean speed is the condition", default="")
    pulses: int = setting("integer", "pulses of the tacho per revolution", default=1)

    def __post_init__(self) -> None:
        if bool(self.channel) == bool(self.tacho):
            raise ConfigError(
                "one of 'channel' and 'tacho' is needed", hint="channel: load_cell, or tacho: key"
            )
        if self.pulses < 1:
            raise ConfigError("'pulses' must be at least 1")
