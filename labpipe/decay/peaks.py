"""The logarithmic decrement as it is read off a screen, for comparison: from the peaks, one per period."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from labpipe.arrays import FloatArray

# Peaks count down to this share of the first.
DOWN_TO = 0.1


def peak_decrement(samples: FloatArray, rate: float, frequency: float) -> float | None:
    """Slope of the logarithm of the peaks of *samples* (n_sample,) [any unit] per period [1]; None with less than three peaks.

    rate, frequency [Hz]. The largest value of every period is sought, down to a tenth of the first: noise makes small peaks too large, and
    the decrement too small. Equation (decay-peaks).
    """
    period = rate / frequency
    count = int(samples.size / period)
    ends = np.rint(np.arange(count + 1) * period).astype(int)
    peaks = np.array([np.max(samples[low:high]) for low, high in pairwise(ends)])
    small = np.flatnonzero(peaks <= DOWN_TO * peaks[:1])
    peaks = peaks[: small[0]] if small.size else peaks
    if peaks.size < 3:
        return None
    slope = np.polynomial.polynomial.polyfit(np.arange(peaks.size), np.log(peaks), 1)[1]
    return -float(slope)
