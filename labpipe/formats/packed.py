"""Text tables, plain or compressed with gzip or Zstandard; decompressed while reading."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import pyarrow as pa

from labpipe.errors import DataError

PACKED = (".gz", ".zst")


def plain_suffix(path: Path) -> str:
    """The suffix that determines a file's kind: run.csv.gz -> .csv."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix in PACKED else suffix


def open_unpacked(path: Path) -> BinaryIO:
    """The bytes of a file, decompressed according to its suffix."""
    if path.suffix.lower() in PACKED:
        stream: BinaryIO = pa.input_stream(str(path), compression="gzip" if path.suffix.lower() == ".gz" else "zstd")
        return stream
    return path.open("rb")


def damaged(path: Path, error: Exception) -> DataError:
    """The error of a compressed file that cannot be decompressed."""
    return DataError(f"cannot be unpacked ({str(error).splitlines()[0][:80]})", where=str(path), hint="the file is damaged or cut off")
