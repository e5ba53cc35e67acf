"""Long records as few points that look the same when they are drawn."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray

MOST_STRETCHES = 700


def trace(time: FloatArray, *series: FloatArray) -> tuple[FloatArray, ...]:
    """Time (n,) [s] and series (n,) [any unit] as the least and largest value of MOST_STRETCHES stretches; short ones whole."""
    if time.size <= 2 * MOST_STRETCHES:
        return (time, *series)
    length = -(-time.size // MOST_STRETCHES)
    whole = time.size // length * length
    middle = time[:whole].reshape(-1, length)[:, [length // 4, (3 * length) // 4]].reshape(-1)
    shown = []
    for values in series:
        parts = values[:whole].reshape(-1, length)
        shown.append(np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).reshape(-1))
    return (middle, *shown)
