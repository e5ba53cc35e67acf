"""Frequency responses of other programs. FRF_READERS by suffix."""

from __future__ import annotations

from pathlib import Path

from labpipe.errors import DataError
from labpipe.raw_files.table import guarded
from labpipe.raw_files.text_table import plain_suffix
from labpipe.records.response import FrequencyResponse
from labpipe.registry import Registry

MATRIX_SUFFIXES = (".mat", ".h5", ".hdf5", ".hdf")
FRF_READERS = Registry("frf-reader")


def read_frf_file(path: Path, name: str = "") -> FrequencyResponse:
    """The response of a file by its suffix; DataError for an unknown kind of file."""
    suffix = plain_suffix(path)
    if suffix not in FRF_READERS.names():
        suffixes = ", ".join((*FRF_READERS.names(), ".frf.parquet"))
        raise DataError(
            f"FRF files with the ending '{suffix}' cannot be read", where=str(path), hint=f"known: {suffixes}"
        )
    response: FrequencyResponse = guarded(FRF_READERS.load(suffix), path, name)
    return response
