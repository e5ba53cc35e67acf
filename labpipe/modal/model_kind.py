"""The model modal as an entry of the table of models. What fits is imported by the first fit."""

from __future__ import annotations

from labpipe.identify.model_kinds import ModelKind
from labpipe.identify.settings import FitSettings
from labpipe.modal.settings import ModalSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse


def _fit(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.modal.fit import modal_fit

    return (modal_fit(response, settings),)


MODAL = ModelKind(
    _fit, "modal", ModalSettings, "modal: {order: 60}", optional=True, times_mass=True, keys=("mass", "input", "output"), estimators=("ml",)
)
