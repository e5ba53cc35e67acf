"""The model worn-bearing as an entry of the table of models. What fits is imported by the first fit."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.identify.model_kinds import ModelKind
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.wear.settings import WearSettings


def _fit(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.wear.fit import worn_fit

    return (worn_fit(response, settings),)


def _earlier(settings: FitSettings) -> str:
    wear: WearSettings = settings.model_settings
    return wear.prior


def _begin(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    if not _earlier(settings):
        return settings
    from labpipe.wear.prior import with_prior

    return with_prior(settings, fits)


WORN_BEARING = ModelKind(
    _fit, "wear", WearSettings, "wear: {rotor: ../configs/rotors/FILE.yaml}", earlier=_earlier, begin=_begin, keys=(), estimators=("ml",)
)
