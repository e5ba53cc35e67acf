"""The colours of all documents: the palette of series, grey, and the scale of heat maps."""

from __future__ import annotations

import math

from labpipe.report.chart import PALETTE_SIZE

# Okabe and Ito's colours, distinguishable for colour-blind readers and in grey print; amber and sky darker, so that thin lines reach a
# contrast of 3:1 with white (WCAG 2.1, criterion 1.4.11).
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B97F00", "#3A94D0", "#000000")
GREY_TONE = "#808080"
# From -1 to 1 in equal steps: orange, white, violet, of one lightness at both ends (ColorBrewer's PuOr).
HEAT = ("#7f3b08", "#b35806", "#e08214", "#fdb863", "#fee0b6", "#f7f7f7", "#d8daeb", "#b2abd2", "#8073ac", "#542788", "#2d004b")
DARK = 128.0


def tone(colour: int) -> str:
    """The colour of a series by its number as #rrggbb."""
    return PALETTE[colour % PALETTE_SIZE] if colour >= 0 else GREY_TONE


def heat(value: float) -> str:
    """The colour of a cell of value -1 to 1 (beyond: the ends; NaN: white) as #rrggbb, between two steps of the scale by their distance."""
    if not math.isfinite(value):
        return "#ffffff"
    place = (min(max(value, -1.0), 1.0) + 1) / 2 * (len(HEAT) - 1)
    step = min(int(place), len(HEAT) - 2)
    parts = zip(_parts(HEAT[step]), _parts(HEAT[step + 1]), strict=True)
    return "#" + "".join(f"{round(first + (place - step) * (second - first)):02x}" for first, second in parts)


def ink_on(ground: str) -> str:
    """The colour of letters on a ground: white on dark, black on light."""
    red, green, blue = _parts(ground)
    return "#ffffff" if 0.3 * red + 0.59 * green + 0.11 * blue < DARK else "#000000"


def _parts(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of #rrggbb, 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
