"""Choosing frequency lines: a band, and what is left out of it."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import DataError

# Lines are multiples of a spacing computed in floating point: one that lies on a band's edge belongs to the band.
EDGE = 1e-9


def lines_in(
    frequency: FloatArray,
    band: tuple[float, float] | None,
    exclude: tuple[tuple[float, float], ...] = (),
) -> BoolArray:
    """Which lines (n_frequency,) [Hz] lie in the band, its edges included, and outside every excluded band."""
    chosen = np.ones(frequency.shape, bool)
    if band is not None:
        chosen &= _within(frequency, band)
    for gap in exclude:
        chosen &= ~_within(frequency, gap)
    return chosen


def line_range(n_sample: int, sample_rate: float, band: tuple[float, float] | None) -> slice:
    """The DFT lines of *n_sample* samples at *sample_rate* [Hz] from the first to the last one in the band, without the mean value.

    Products of channels are formed on these only. DataError when the band holds no line.
    """
    frequency = np.arange(1, n_sample // 2 + 1) * (sample_rate / n_sample)
    inside = np.flatnonzero(lines_in(frequency, band))
    if not inside.size:
        hint = f"the recording has lines every {frequency[0]:g} Hz up to {frequency[-1]:g} Hz"
        raise DataError("no line lies in the band", hint=hint)
    return slice(int(inside[0]) + 1, int(inside[-1]) + 2)


def _within(frequency: FloatArray, band: tuple[float, float]) -> BoolArray:
    low, high = band
    return (frequency >= low * (1 - EDGE)) & (frequency <= high * (1 + EDGE))
