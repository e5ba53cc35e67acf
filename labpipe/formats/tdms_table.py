"""TDMS files of National Instruments, read block by block; scaling properties are applied by npTDMS."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nptdms import TdmsFile
from nptdms.log import log_manager

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.names import unique

CHUNK_ROWS = 1 << 17
_UNITS = ("unit_string", "NI_UnitDescription", "unit")
_SAME = 1e-6
_BROKEN = (ValueError, TypeError, OSError, KeyError, IndexError, EOFError, OverflowError, MemoryError, NotImplementedError, struct.error)


class TdmsTable:
    """The channels that are as long as the longest, called by name, or "group/name" where a name comes twice. Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # What npTDMS says of a damaged file would stand beside our one message.
        log_manager.set_level(logging.ERROR)
        if path.stat().st_size == 0:
            raise DataError("the file is empty", where=str(path))
        try:
            with path.open("rb") as stream, TdmsFile.open(stream) as file:
                _check_whole(file, path)
                known = [channel for group in file.groups() for channel in group.channels() if _is_numeric(channel)]
                self._keep(known)
        except _BROKEN as error:
            raise self._damaged(error) from None

    def _keep(self, known: list[Any]) -> None:
        length = max((len(channel) for channel in known), default=0)
        if length < 1:
            raise DataError("holds no channel of numbers", where=str(self.path))
        kept = [channel for channel in known if len(channel) == length]
        names = [channel.name for channel in kept]
        self.columns = unique([c.name if names.count(c.name) == 1 else f"{c.group_name}/{c.name}" for c in kept])
        self._places = {name: (c.group_name, c.name) for name, c in zip(self.columns, kept, strict=True)}
        self._length = length
        self.units = {name: unit for name, channel in zip(self.columns, kept, strict=True) if (unit := _unit(channel))}
        self.sample_rate = _rate(kept, self.path)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, len(columns)), scaled; DataError when the file is damaged."""
        try:
            with self.path.open("rb") as stream, TdmsFile.open(stream) as file:
                channels = [file[group][name] for group, name in (self._places[column] for column in columns)]
                for start in range(0, self._length, CHUNK_ROWS):
                    yield np.column_stack([np.asarray(c.read_data(start, CHUNK_ROWS), np.float64) for c in channels])
        except _BROKEN as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> DataError:
        reason = (str(error).splitlines() or ["cut off"])[0].rstrip(".")
        return DataError(f"is not a readable TDMS file ({reason[:80]})", where=str(self.path))


def _check_whole(file: TdmsFile, path: Path) -> None:
    if file.file_status.incomplete_final_segment:
        raise DataError("its last segment is cut off", where=str(path), hint="the logger was interrupted, or the file was not copied whole")


def _is_numeric(channel: Any) -> bool:
    return len(channel) > 0 and np.dtype(channel.dtype).kind in "iuf"


def _unit(channel: Any) -> str:
    return next((str(channel.properties[key]) for key in _UNITS if channel.properties.get(key)), "")


def _rate(channels: list[Any], path: Path) -> float | None:
    """The rate [Hz] of all channels by their wf_increment; DataError when they differ."""
    steps = {channel.name: float(channel.properties["wf_increment"]) for channel in channels if channel.properties.get("wf_increment")}
    if not steps:
        return None
    low, high = min(steps.values()), max(steps.values())
    if low <= 0 or high > low * (1 + _SAME):
        raise DataError(f"its channels are {low:g} s to {high:g} s from sample to sample", where=str(path), hint="one rate is needed")
    rate = 1 / low
    return float(round(rate)) if abs(round(rate) / rate - 1) < _SAME else rate
