"""The models magnet and block as entries of the table of models."""

from __future__ import annotations

from labpipe.identify.model_kinds import SPECTRA, ModelKind
from labpipe.magnet.block import BlockSettings, block_fits
from labpipe.magnet.fit import magnet_fits
from labpipe.magnet.settings import MagnetSettings

MAGNET = ModelKind(magnet_fits, "magnet", MagnetSettings, "magnet: {coupling: direct}", optional=True, of=SPECTRA)
BLOCK = ModelKind(block_fits, "block", BlockSettings, "block: {order: auto}", optional=True)
