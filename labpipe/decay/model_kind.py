"""The model decay as an entry of the table of models. What fits is imported by the first fit."""

from __future__ import annotations

from labpipe.decay.settings import DecaySettings
from labpipe.identify.model_kinds import ModelKind
from labpipe.identify.settings import FitSettings
from labpipe.records.free_decay import FreeDecays
from labpipe.records.identification import Fit
from labpipe.spectra.settings import DECAYS


def _fit(decays: FreeDecays, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.decay.fit import decay_fit

    return (decay_fit(decays, settings),)


DECAY = ModelKind(
    _fit,
    "decay",
    DecaySettings,
    "decay: {modes: 1}",
    optional=True,
    of=DECAYS,
    times_mass=True,
    keys=("mass", "output"),
    estimators=("ml",),
)
