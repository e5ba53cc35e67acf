"""Windows that data or FRFs have already when they come from an analyser."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting


@dataclass(frozen=True)
class WindowedSettings(Settings):
    """Windows that hits, or the FRFs of hits, have already."""

    exponential: float = setting("value", "time constant of the exponential window that an analyser applied", unit="s")

    def __post_init__(self) -> None:
        if self.exponential <= 0:
            raise ConfigError("'exponential' must be positive")
