"""Variables of an HDF5 file by name, as in MATLAB 7.3 or plain HDF5: complex numbers, texts, cells, order of
dimensions.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from labpipe.errors import DataError
from labpipe.raw_files.table import check_in_child

# Elements read at once.
PART = 1 << 20


def check_hdf5(path: Path) -> None:
    """DataError for a file that a child process cannot read whole within its limits of time and memory."""
    check_in_child(path, "HDF5", touch)


def touch(path: Path) -> None:
    """Read all attributes and datasets of a file."""
    with h5py.File(path, "r") as file:
        dict(file.attrs.items())
        file.visititems(_touched)


def _touched(_: str, item: object) -> None:
    dict(item.attrs.items())  # type: ignore[attr-defined]
    if isinstance(item, h5py.Dataset) and item.shape and h5py.check_ref_dtype(item.dtype) is None:
        rows = max(1, PART * item.shape[0] // max(item.size, 1))
        for start in range(0, item.shape[0] if item.size else 0, rows):
            item[start : start + rows]


def load_hdf5_variables(path: Path, names: Iterable[str]) -> dict[str, Any]:
    """The variables of these names in the file, arrays in MATLAB's order of dimensions, texts as arrays of
    str.

    MATLAB stores columns first, so its dimensions are reversed; a complex number is a pair (real, imag), a
    text its UTF-16 codes, a cell references to its contents. Links into other files are not followed.
    DataError when the file is damaged.
    """
    check_hdf5(path)
    try:
        with h5py.File(path, "r") as file:
            return {name: _value(file, file[name]) for name in names if _is_own_dataset(file, name)}
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, UnicodeDecodeError) as error:
        reason = (str(error).splitlines() or ["damaged"])[0]
        raise DataError(f"is not a readable HDF5 file ({reason[:80]})", where=str(path)) from None


def hdf5_names(path: Path) -> tuple[str, ...]:
    """The data sets of an HDF5 file, "group/name"; DataError when the file is damaged."""
    names: list[str] = []

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            names.append(name)

    check_hdf5(path)
    try:
        with h5py.File(path, "r") as file:
            file.visititems(add)
    except (OSError, RuntimeError, KeyError) as error:
        reason = (str(error).splitlines() or ["damaged"])[0]
        raise DataError(f"is not a readable HDF5 file ({reason[:80]})", where=str(path)) from None
    return tuple(names)


def _is_own_dataset(file: h5py.File, name: str) -> bool:
    return isinstance(file.get(name, getlink=True), h5py.HardLink) and isinstance(file[name], h5py.Dataset)


def has_hdf5_variables(path: Path, names: Iterable[str]) -> bool:
    """True if a readable HDF5 file holds data sets of all these names."""
    check_hdf5(path)
    try:
        with h5py.File(path, "r") as file:
            return all(isinstance(file.get(name), h5py.Dataset) for name in names)
    except (OSError, RuntimeError, KeyError):
        return False


def _value(file: h5py.File, item: h5py.Dataset) -> Any:
    kind = item.attrs.get("MATLAB_class", b"")
    raw = item[()]
    if kind == b"char":
        return np.array("".join(map(chr, np.asarray(raw).T.ravel())))
    if h5py.check_ref_dtype(item.dtype) is not None:
        return np.array([_value(file, file[reference]) for reference in np.asarray(raw).T.ravel()], object)
    if h5py.check_string_dtype(item.dtype) is not None:
        return np.asarray(item.asstr()[()], object) if item.shape else np.array(item.asstr()[()])
    values = np.asarray(raw)
    if values.dtype.names == ("real", "imag"):
        values = values["real"] + 1j * values["imag"]
    return values.T if kind else values
