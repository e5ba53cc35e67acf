"""Choice of frequency lines: inside a band, outside excluded bands."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import DataError

# Lines are multiples of a spacing computed in floating point: one that lies on a band's edge belongs to the band.
EDGE = 1e-9
# A block of fewer samples is read before it is held against the recording, which says more.
MANY_SAMPLES = 1 << 22


def lines_in(
    frequency: FloatArray,
    band: tuple[float, float] | None,
    exclude: tuple[tuple[float, float], ...] = (),
) -> BoolArray:
    """Lines (n_frequency,) [Hz] inside the band (edges included) and outside every excluded band, as a mask (n_frequency,)."""
    chosen = np.ones(frequency.shape, bool)
    if band is not None:
        chosen &= _within(frequency, band)
    for gap in exclude:
        chosen &= ~_within(frequency, gap)
    return chosen


def line_range(n_sample: int, sample_rate: float, band: tuple[float, float] | None, length: int | None = None) -> slice:
    """Range of DFT lines of *n_sample* samples at *sample_rate* [Hz] inside the band, without the line at 0 Hz.

    Cross-spectra are formed on these lines only. DataError when the band holds no line, and for a long block or period of which the
    recording of *length* samples does not hold one: before anything of its size is made.
    """
    if length is not None and n_sample > max(length, MANY_SAMPLES):
        what = f"a block or period of {n_sample / sample_rate:g} s is longer than the recording of {length / sample_rate:g} s"
        raise DataError(what, hint="check `block` or `period`, and the sampling rate")
    frequency = np.arange(1, n_sample // 2 + 1) * (sample_rate / n_sample)
    inside = np.flatnonzero(lines_in(frequency, band))
    if not inside.size:
        hint = f"the recording has lines every {frequency[0]:g} Hz up to {frequency[-1]:g} Hz"
        raise DataError("no line lies in the band", hint=hint)
    return slice(int(inside[0]) + 1, int(inside[-1]) + 2)


def _within(frequency: FloatArray, band: tuple[float, float]) -> BoolArray:
    low, high = band
    return (frequency >= low * (1 - EDGE)) & (frequency <= high * (1 + EDGE))
