"""Lines of a turning shaft that are left out of a response."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.shaft import shaft_motion

# Half width of the mask [lines]: a window's main lobe for random data; a period's lines do not leak where the speed lies on one.
LOBE = {"periodic": 0.5, "random": 2.0, "impact": 2.0}


def masked_bands(sources: Sequence[SampleSource], settings: FrfSettings) -> tuple[tuple[float, float], ...]:
    """The bands (low, high) [Hz] around 1x, 2x, ... in every recording: slowest to fastest speed, the mask's width to either side."""
    if settings.mask is None:
        return ()
    length = settings.period or settings.block
    assert length is not None
    width = LOBE[settings.excitation] / length if settings.mask.width is None else settings.mask.width
    ranges = dict.fromkeys(shaft_motion(source, settings.mask).speed_range for source in sources)
    return tuple(
        (max(order * low - width, 0.0), order * high + width) for low, high in ranges for order in range(1, settings.mask.harmonics + 1)
    )


def mask_findings(bands: Sequence[tuple[float, float]]) -> tuple[Finding, ...]:
    """What was left out, in words."""
    if not bands:
        return ()
    named = ", ".join(f"{low:.6g}-{high:.6g} Hz" for low, high in bands)
    return (note("masked", f"lines of the shaft speed are left out: {named}"),)
