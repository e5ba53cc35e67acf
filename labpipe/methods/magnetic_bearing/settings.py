"""The models magnet and block: their settings, and their entries in the table of models."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from labpipe.errors import SettingError
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import Settings, choice, flag, quantity, setting
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Uncertain
from labpipe.spectra.settings import SPECTRA

DIRECT, BEARING, FULL = "direct", "bearing", "full"
AUTO = "auto"
ORDERS = (AUTO, "0", "1", "2", "3")


@dataclass(frozen=True)
class MagnetSettings(Settings):
    """What of K_i and K_s is estimated, what is known of the rotor, and the current between samples."""

    coupling: str = choice(
        "terms of K_i and K_s: all; those of one bearing; none but direct ones",
        (BEARING, FULL, DIRECT),
        BEARING,
    )
    _: KW_ONLY
    passive_damping: bool = flag("estimate the damping at the magnets as well")
    inertia: Uncertain | None = setting(
        "uncertain",
        "rigid rotor on two bearings: transverse moment of inertia about its centre of gravity",
        "kg.m^2",
        None,
    )
    centre: float = quantity(
        "place of the centre of gravity, from where the channels' positions are", "m", 0.0
    )
    hold: float | None = quantity(
        "rate of the recording, where no filter stands between the held output of a controller and the "
        "samples; default: a smooth current",
        "Hz",
        None,
    )
    amplifier_bandwidth: float | None = quantity(
        "with hold: -3 dB bandwidth of the amplifier behind the held output; default: unlimited", "Hz", None
    )

    band_confidence: float = quantity(
        "probability that the band for robust control design holds the true plant at all lines", "1", 0.95
    )

    def __post_init__(self) -> None:
        self.require_share("band_confidence")
        self.require_positive("hold", "amplifier_bandwidth", "inertia")
        if self.amplifier_bandwidth is not None and self.hold is None:
            raise SettingError("amplifier_bandwidth", "'amplifier_bandwidth' goes with hold", "hold: 20 kHz")


@dataclass(frozen=True)
class BlockSettings(Settings):
    """The order of the low-pass: of one real pole (1), a pair (2), both (3)."""

    order: str = choice("order of the low-pass; auto: the one of the least BIC", ORDERS, AUTO)


def _fit_magnet(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.magnetic_bearing.fit import magnet_fits

    return magnet_fits(spectra, settings)


def _fit_block(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.magnetic_bearing.fit import block_fits

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
    _fit_block,
    "block",
    BlockSettings,
    "block: {order: auto}",
    optional=True,
    keys=("input", "output", "bands"),
    estimators=("ml",),
)
