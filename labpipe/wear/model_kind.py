"""The model worn-bearing as an entry of the table of models."""

from __future__ import annotations

from labpipe.identify.model_kinds import ModelKind
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.wear.fit import worn_fit
from labpipe.wear.prior import with_prior
from labpipe.wear.settings import WearSettings


def _fit(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    return (worn_fit(response, settings),)


def _earlier(settings: FitSettings) -> str:
    wear: WearSettings = settings.model_settings
    return wear.prior


WORN_BEARING = ModelKind(_fit, "wear", WearSettings, "wear: {rotor: ../configs/rotors/FILE.yaml}", earlier=_earlier, begin=with_prior)
