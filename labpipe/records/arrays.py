"""Checking and freezing of the arrays that records hold."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labpipe.errors import DataError


def frozen_array(values: ArrayLike, dtype: type, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Read-only array of *values* (n, ...) [any unit] with the given dtype and shape; DataError on another shape or NaN."""
    array: NDArray[Any] = np.array(values, dtype=dtype)
    if array.shape != shape:
        raise DataError(f"{name} has the shape {array.shape}, {shape} is needed")
    if not np.all(np.isfinite(array)):
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise DataError(f"{name} is not finite at index {index}")
    array.flags.writeable = False
    return array
