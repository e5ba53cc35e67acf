"""Lines of the shaft speed and its harmonics, excluded from a response."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.shaft import shaft_motion

# Half width of the mask [lines]: a window's main lobe for random data; periodic data do not leak where the speed lies on a line.
LOBE = {"periodic": 0.5, "random": 2.0, "impact": 2.0}


def masked_bands(sources: Sequence[SampleSource], settings: FrfSettings) -> tuple[tuple[float, float], ...]:
    """Bands (low, high) [Hz] around 1x, 2x, ... of every recording: slowest to fastest speed, extended by the mask's width."""
    if settings.mask is None:
        return ()
    width = _usual_width(settings) if settings.mask.width is None else settings.mask.width
    ranges = dict.fromkeys(shaft_motion(source, settings.mask).speed_range for source in sources)
    return tuple(
        (max(order * low - width, 0.0), order * high + width) for low, high in ranges for order in range(1, settings.mask.harmonics + 1)
    )


def _usual_width(settings: FrfSettings) -> float:
    length = settings.period or settings.block
    assert length is not None
    return LOBE[settings.excitation] / length


def mask_findings(bands: Sequence[tuple[float, float]]) -> tuple[Finding, ...]:
    """A note on the excluded bands."""
    if not bands:
        return ()
    named = ", ".join(f"{low:.6g}-{high:.6g} Hz" for low, high in bands)
    return (note("masked", f"lines of the shaft speed are left out: {named}"),)
