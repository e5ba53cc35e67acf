"""The model decay: its settings, and its entry in the table of models."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.records.identification import Fit
from labpipe.records.settings import Settings, setting
from labpipe.records.spectra import FreeDecays
from labpipe.spectra.settings import DECAYS

MOST_MODES = 8


@dataclass(frozen=True)
class DecaySettings(Settings):
    """What a free decay consists of."""

    modes: int = setting("integer", "modes that decay together", default=1)
    repeats: str = setting(
        "choice",
        "several decays: each fitted, and their mean; or pool, one fit of all",
        choices=("each", "pool"),
        default="each",
    )

    def __post_init__(self) -> None:
        if not 1 <= self.modes <= MOST_MODES:
            raise ConfigError(f"'modes' is {self.modes}", hint=f"1 to {MOST_MODES}", field="modes")


def _fit(decays: FreeDecays, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.ring_down.fit import decay_fit

    return (decay_fit(decays, settings),)


DECAY = ModelKind(
    _fit,
    "decay",
    DecaySettings,
    "decay: {modes: 1}",
    optional=True,
    of=DECAYS,
    times_mass=True,
    keys=("mass", "output", "repeats"),
    estimators=("ml",),
)
