"""NumPy's .npy and .npz files; nothing in them is unpickled."""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.errors import DataError
from labpipe.formats.arrays_table import ArraysTable, columns_of, is_numeric, rate_of

_BROKEN = (
    ValueError, TypeError, OSError, EOFError, KeyError, SyntaxError, OverflowError, MemoryError, NotImplementedError,
    tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def load_arrays(path: Path) -> dict[str, Any]:
    """The arrays of a .npz file by name, that of a .npy file under ''; DataError for a damaged file or one of pickled objects."""
    if path.stat().st_size == 0:
        raise DataError("the file is empty", where=str(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            stored = np.load(path, allow_pickle=False, mmap_mode="r" if path.suffix.lower() == ".npy" else None)
            if isinstance(stored, np.ndarray):
                return {"": stored}
            with stored:
                return {name: stored[name] for name in stored.files}
    except _BROKEN as error:
        reason = (str(error).splitlines() or ["damaged"])[0]
        raise DataError(f"is not a readable NumPy file of numbers ({reason[:80]})", where=str(path)) from None


def numpy_table(path: Path) -> ArraysTable:
    """The vectors of a NumPy file, or the columns of its matrices: 1, 2, ... in a .npy file; fields of a structured array by name."""
    arrays: dict[str, Any] = {}
    for name, array in load_arrays(path).items():
        if array.dtype.names:
            arrays |= {".".join(filter(None, (name, field))): array[field] for field in array.dtype.names}
        else:
            arrays[name] = array
    numeric = {name: array for name, array in arrays.items() if is_numeric(array)}
    columns = {part.strip("_") or "1": column for name, array in numeric.items() for part, column in columns_of(name, array).items()}
    scalars = {name: float(array) for name, array in arrays.items() if array.size == 1 and array.dtype.kind in "iuf"}
    return ArraysTable(path, columns, {}, rate_of(scalars, path))
