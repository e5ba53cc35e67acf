"""What a child process does with an HDF5 file to see that it can be read; see formats/probe.py."""

from __future__ import annotations

from pathlib import Path

import h5py

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
