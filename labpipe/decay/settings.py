"""Settings of a fit of free decays: the section `decay:` of a fit with model decay."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting

MOST_MODES = 8


@dataclass(frozen=True)
class DecaySettings(Settings):
    """What a free decay consists of."""

    modes: int = setting("integer", "modes that decay together", default=1)

    def __post_init__(self) -> None:
        if not 1 <= self.modes <= MOST_MODES:
            raise ConfigError(f"'modes' is {self.modes}", hint=f"1 to {MOST_MODES}", field="modes")
