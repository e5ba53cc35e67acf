"""Levels of a condition: set values that differ by less than a tolerance are one."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray, IntArray


def levels_of(values: FloatArray, tolerance: float) -> tuple[FloatArray, IntArray]:
    """Levels (n_level,) [as the values], the means of their members, and the level of every value, (n,).

    In ascending order a value begins a new level where it exceeds the one before by more than *tolerance* [1] of the largest magnitude.
    Equation (comp-levels).
    """
    order = np.argsort(values, kind="stable")
    step = np.diff(values[order], prepend=values[order[:1]])
    number = np.empty(values.size, np.intp)
    number[order] = np.cumsum(step > tolerance * np.max(np.abs(values), initial=0.0))
    levels = np.bincount(number, values) / np.bincount(number)
    return levels, number
