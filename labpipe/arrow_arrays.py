"""numpy arrays <-> pyarrow arrays, by their buffers: pyarrow's own conversions import pandas, a third of the start of a command."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


def arrow_array(values: Any) -> pa.Array:
    """The numbers of an array (n,) [any unit] as a pyarrow array that shares them, or texts and other cells as a copy."""
    numbers = np.ascontiguousarray(values) if isinstance(values, np.ndarray) else None
    if numbers is None or numbers.ndim != 1 or numbers.dtype.kind not in "iuf":
        return pa.array(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(numbers.dtype), numbers.size, [None, pa.py_buffer(numbers)])


def numpy_array(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """The values (n,) [unit of the column]; those of one chunk of numbers without a missing one are shared and read-only."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if array.null_count or not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
        return array.to_numpy(zero_copy_only=False)
    if not len(array):
        return np.empty(0, array.type.to_pandas_dtype())
    values = np.frombuffer(array.buffers()[1], array.type.to_pandas_dtype())
    return values[array.offset : array.offset + len(array)]
