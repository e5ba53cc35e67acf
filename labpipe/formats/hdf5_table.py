"""HDF5 files (and MATLAB 7.3): the longest data sets of equal length are the channels, read block by block."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from labpipe.errors import DataError
from labpipe.formats.arrays_table import ArraysTable, columns_of, is_numeric, rate_of
from labpipe.formats.hdf5_probe import check_hdf5

_UNITS = ("unit", "units", "unit_string")


def hdf5_table(path: Path) -> ArraysTable:
    """The data sets of an HDF5 file by name ("group/name"); units and rates also from attributes. DataError when it is damaged.

    Links into other files are not followed.
    """
    if path.stat().st_size == 0:
        raise DataError("the file is empty", where=str(path))
    check_hdf5(path)
    try:
        file = h5py.File(path, "r")
        sets = _numeric_sets(file)
        scalars = {name: float(np.asarray(item[()]).item()) for name, item in sets.items() if item.size == 1}
        scalars |= _rate_attributes(file, sets)
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise DataError(f"is not a readable HDF5 file ({str(error).splitlines()[0][:80]})", where=str(path)) from None
    columns = {name: column for key, item in sets.items() if item.size > 1 for name, column in columns_of(key, item).items()}
    units = {name: _unit(sets, name) for name in columns}
    return ArraysTable(path, columns, units, rate_of(scalars, path))


def _numeric_sets(file: h5py.File) -> dict[str, Any]:
    sets: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        is_text = getattr(item, "attrs", {}).get("MATLAB_class", b"") in (b"char", b"cell")
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and not is_text:
            if item.shape == ():
                if item.dtype.kind in "iuf":
                    sets[name] = item
            elif item.shape and is_numeric(item):
                sets[name] = item

    file.visititems(add)
    return sets


def _rate_attributes(file: h5py.File, sets: dict[str, Any]) -> dict[str, float]:
    """Numeric attributes of the file and of its data sets, by place and name."""
    rates: dict[str, float] = {}
    for place, item in {"": file, **sets}.items():
        for name, value in item.attrs.items():
            if np.size(value) == 1 and np.asarray(value).dtype.kind in "iuf":
                rates[f"{place}/{name}"] = float(np.asarray(value).item())
    return rates


def _unit(sets: dict[str, Any], name: str) -> str:
    item: Any = sets.get(name)
    if item is None:
        item = sets.get(name.rpartition("_")[0])
    for key in _UNITS if item is not None else ():
        if key in item.attrs:
            value = item.attrs[key]
            return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    return ""
