"""The model dynamic-stiffness as an entry of the table of models."""

from __future__ import annotations

from labpipe.dynamic_stiffness.baseline import with_baseline
from labpipe.dynamic_stiffness.fit import dynamic_stiffness_fits
from labpipe.dynamic_stiffness.settings import DynamicStiffnessSettings
from labpipe.identify.model_kinds import SPECTRA, ModelKind
from labpipe.identify.settings import FitSettings


def _earlier(settings: FitSettings) -> str:
    own: DynamicStiffnessSettings = settings.model_settings
    return own.baseline


DYNAMIC_STIFFNESS = ModelKind(
    dynamic_stiffness_fits,
    "dynamic_stiffness",
    DynamicStiffnessSettings,
    "dynamic_stiffness: {form: kcm}",
    optional=True,
    earlier=_earlier,
    begin=with_baseline,
    of=SPECTRA,
)
