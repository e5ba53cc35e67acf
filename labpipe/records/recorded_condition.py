"""A condition of a test that was recorded with it: the mean of a channel, or the speed that a tacho shows."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting


@dataclass(frozen=True)
class RecordedCondition(Settings):
    """Where a condition is taken from."""

    channel: str = setting("text", "channel whose mean is the condition", default="")
    tacho: str = setting("text", "channel with tacho pulses, whose mean speed is the condition", default="")
    pulses: int = setting("integer", "pulses of the tacho per revolution", default=1)

    def __post_init__(self) -> None:
        if bool(self.channel) == bool(self.tacho):
            raise ConfigError("one of 'channel' and 'tacho' is needed", hint="channel: load_cell, or tacho: key")
        if self.pulses < 1:
            raise ConfigError("'pulses' must be at least 1")
