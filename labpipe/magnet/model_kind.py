"""The models magnet and block as entries of the table of models. What fits is imported by the first fit."""

from __future__ import annotations

from labpipe.identify.model_kinds import ModelKind
from labpipe.identify.settings import FitSettings
from labpipe.magnet.settings import BlockSettings, MagnetSettings
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.settings import SPECTRA


def _fit_magnet(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.magnet.fit import magnet_fits

    return magnet_fits(spectra, settings)


def _fit_block(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.magnet.block import block_fits

    return block_fits(response, settings)


MAGNET = ModelKind(
    _fit_magnet,
    "magnet",
    MagnetSettings,
    "magnet: {coupling: direct}",
    optional=True,
    of=SPECTRA,
    estimators=("ml",),
)
BLOCK = ModelKind(
    _fit_block, "block", BlockSettings, "block: {order: auto}", optional=True, keys=("input", "output", "bands"), estimators=("ml",)
)
