"""The model dynamic-stiffness as an entry of the table of models. What fits is imported by the first fit."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.dynamic_stiffness.settings import DynamicStiffnessSettings
from labpipe.identify.model_kinds import ModelKind
from labpipe.identify.settings import FitSettings
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.identification import Fit
from labpipe.spectra.settings import SPECTRA


def _fit(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.dynamic_stiffness.fit import dynamic_stiffness_fits

    return dynamic_stiffness_fits(spectra, settings)


def _earlier(settings: FitSettings) -> str:
    stiffness_settings: DynamicStiffnessSettings = settings.model_settings
    return stiffness_settings.baseline


def _begin(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    if not _earlier(settings):
        return settings
    from labpipe.dynamic_stiffness.baseline import with_baseline

    return with_baseline(settings, fits)


DYNAMIC_STIFFNESS = ModelKind(
    _fit,
    "dynamic_stiffness",
    DynamicStiffnessSettings,
    "dynamic_stiffness: {form: kcm}",
    optional=True,
    earlier=_earlier,
    begin=_begin,
    of=SPECTRA,
    keys=("mass", "input", "output", "bands", "compare"),
    by_likelihood=("compare",),
    estimators=("ml", "ls"),
)
