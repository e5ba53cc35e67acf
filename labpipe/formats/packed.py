"""Text tables as they are or packed with gzip or Zstandard; unpacked as they are read."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import pyarrow as pa

from labpipe.errors import DataError

PACKED = (".gz", ".zst")


def plain_suffix(path: Path) -> str:
    """The ending by which a file's kind is known: run.csv.gz -> .csv."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix in PACKED else suffix


def open_unpacked(path: Path) -> BinaryIO:
    """The bytes of a file, unpacked by its ending."""
    if path.suffix.lower() in PACKED:
        stream: BinaryIO = pa.input_stream(str(path), compression="gzip" if path.suffix.lower() == ".gz" else "zstd")
        return stream
    return path.open("rb")


def damaged(path: Path, error: Exception) -> DataError:
    """What is said of a packed file that cannot be unpacked."""
    return DataError(f"cannot be unpacked ({str(error).splitlines()[0][:80]})", where=str(path), hint="the file is damaged or cut off")
