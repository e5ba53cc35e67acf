"""MATLAB files of versions 4 to 7, and of 7.3 as HDF5; no content is executed or unpickled."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from labpipe.errors import DataError
from labpipe.formats.arrays_table import ArraysTable, columns_of, is_numeric, rate_of
from labpipe.formats.mat_check import check_elements

_HDF5 = b"\x89HDF\r\n\x1a\n"
_BROKEN = (
    ValueError, TypeError, OSError, KeyError, IndexError, EOFError, NotImplementedError, OverflowError, MemoryError, UnicodeDecodeError,
    struct.error, zlib.error, MatReadError,
)  # fmt: skip


def is_hdf5(path: Path) -> bool:
    """True for HDF5, as written by MATLAB 7.3 after a block of 512 bytes."""
    with path.open("rb") as stream:
        head = stream.read(520)
    return head.startswith(_HDF5) or head[512:] == _HDF5


def load_variables(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file up to version 7; DataError for an unreadable file."""
    if path.stat().st_size == 0:
        raise DataError("the file is empty", where=str(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check_elements(path)
            variables = loadmat(str(path), chars_as_strings=True, appendmat=False)
    except _BROKEN as error:
        reason = (str(error).splitlines() or ["damaged"])[0].rstrip(".")
        raise DataError(f"is not a readable MATLAB file ({reason[:80]})", where=str(path)) from None
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def _fields(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """(name, array) of a variable and of the fields of a structure ("run.x")."""
    names = getattr(getattr(value, "dtype", None), "names", None)
    if names and value.size == 1:
        for field in names:
            yield from _fields(f"{name}.{field}", value.flat[0][field])
    else:
        yield name, value


def load_fields(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file up to version 7, and the fields of its structures as "run.x"; DataError as `load_variables`."""
    return dict(entry for name, value in load_variables(path).items() for entry in _fields(name, value))


def mat_table(path: Path) -> ArraysTable:
    """The vectors of a MATLAB file as a table; a structure ``units`` with one text per vector gives their units."""
    if is_hdf5(path):
        from labpipe.formats.hdf5_table import hdf5_table

        return hdf5_table(path)
    arrays = load_fields(path)
    numeric = {name: value for name, value in arrays.items() if is_numeric(value)}
    units = {name.removeprefix("units."): text_of(value) for name, value in arrays.items() if name.startswith("units.")}
    columns = {name: column for key, value in numeric.items() for name, column in columns_of(key, value).items()}
    rate = rate_of({name: value.item() for name, value in numeric.items() if value.size == 1}, path)
    return ArraysTable(path, columns, units, rate)


def text_of(value: Any) -> str:
    """A char variable as text, '' for anything else."""
    array = np.asarray(value)
    return str(array.flat[0]) if array.dtype.kind == "U" and array.size == 1 else ""
