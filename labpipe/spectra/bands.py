"""Choosing frequency lines: a band, and what is left out of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Lines are multiples of a spacing computed in floating point: one that lies on a band's edge belongs to the band.
EDGE = 1e-9


def lines_in(
    frequency: NDArray[np.floating],
    band: tuple[float, float] | None,
    exclude: tuple[tuple[float, float], ...] = (),
) -> NDArray[np.bool_]:
    """Which lines (n_frequency,) [Hz] lie in the band, its edges included, and outside every excluded band."""
    chosen = np.ones(frequency.shape, bool)
    if band is not None:
        chosen &= _within(frequency, band)
    for gap in exclude:
        chosen &= ~_within(frequency, gap)
    return chosen


def _within(frequency: NDArray[np.floating], band: tuple[float, float]) -> NDArray[np.bool_]:
    low, high = band
    return (frequency >= low * (1 - EDGE)) & (frequency <= high * (1 + EDGE))
