"""Where the values of a TDMS channel stand in the file, so that they are read as they lie there, once, and no more of them than asked for.

npTDMS reads whole chunks of a segment: of a file that was defragmented into one segment that is a channel from its first value to its
last, however few are wanted. Its index, private to it, names the places; where that index is another, or the values are interleaved or
of DAQmx, there is no layout, and npTDMS reads.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from nptdms.base_segment import RawChannelDataChunk
from nptdms.common import toc_properties

from labpipe.arrays import FloatArray

# Values read at once: they stay in the cache until they are converted.
READ_VALUES = 1 << 15


@dataclass(frozen=True)
class _Run:
    """*n_chunk* chunks of *n_value* values each, the first value at byte *place*, chunks *step* bytes apart; *first*: its row."""

    first: int
    n_chunk: int
    n_value: int
    place: int
    step: int
    kind: np.dtype[Any]

    def parts(self, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """(row, byte, values) of each stretch of rows *start* to *stop* that lie side by side."""
        row, end = max(start, self.first), min(stop, self.first + self.n_chunk * self.n_value)
        while row < end:
            chunk, within = divmod(row - self.first, self.n_value)
            count = min(self.n_value - within, end - row, READ_VALUES)
            yield row, self.place + chunk * self.step + within * self.kind.itemsize, count
            row += count


class ChannelLayout:
    """The places of a channel's values, all segments in order."""

    def __init__(self, runs: Sequence[_Run], scaling: Any) -> None:
        self._runs, self._scaling = tuple(runs), scaling
        self._buffer = bytearray(READ_VALUES * 8)
        self._next = 0

    def read_into(self, out: FloatArray, descriptor: int, start: int) -> None:
        """Put the values from row *start* on, scaled, into *out* (n,) [unit of the file]; EOFError where the file ends before them.

        To be called with rising *start*: runs that lie before it are not looked at again.
        """
        while self._runs[self._next].first + self._runs[self._next].n_chunk * self._runs[self._next].n_value <= start:
            self._next += 1
        for run in self._runs[self._next :]:
            if run.first >= start + out.size:
                break
            for row, place, count in run.parts(start, start + out.size):
                out[row - start : row - start + count] = self._scaled(self._read(descriptor, run.kind, place, count))

    def _read(self, descriptor: int, kind: np.dtype[Any], place: int, count: int) -> Any:
        wanted = memoryview(self._buffer)[: count * kind.itemsize]
        n_read = 0
        while n_read < len(wanted):
            more = os.preadv(descriptor, [wanted[n_read:]], place + n_read)
            if not more:
                raise EOFError("cut off")
            n_read += more
        return np.frombuffer(wanted, kind)

    def _scaled(self, values: Any) -> Any:
        return values if self._scaling is None else self._scaling.scale(RawChannelDataChunk.channel_data(values))


def channel_layouts(file: Any, channels: Sequence[Any]) -> list[ChannelLayout] | None:
    """The layout of each of the *channels* of an opened TdmsFile; None where the index does not say that values lie side by side."""
    if not hasattr(os, "preadv"):
        return None
    try:
        runs = _runs(file._reader._segments, {channel.path for channel in channels})
        layouts = [ChannelLayout(runs[channel.path], channel._scaling) for channel in channels]
    except (AttributeError, KeyError, TypeError):
        # Another version of npTDMS, or values of another kind.
        return None
    whole = all(sum(run.n_chunk * run.n_value for run in runs[channel.path]) == len(channel) for channel in channels)
    return layouts if whole else None


def _runs(segments: Sequence[Any], paths: set[str]) -> dict[str, list[_Run]]:
    """The runs of every channel by its path; TypeError for a segment whose values do not lie side by side."""
    runs: dict[str, list[_Run]] = {path: [] for path in paths}
    length = dict.fromkeys(paths, 0)
    for segment in segments:
        objects = [item for item in segment.ordered_objects if item.has_data]
        if not objects or not segment.num_chunks:
            continue
        if segment.toc_mask & (toc_properties["kTocInterleavedData"] | toc_properties["kTocDAQmxRawData"]):
            raise TypeError("interleaved")
        if segment.final_chunk_lengths_override is not None:
            raise TypeError("cut off")
        order = ">" if segment.toc_mask & toc_properties["kTocBigEndian"] else "<"
        place = segment.data_position
        step = sum(item.data_size for item in objects)
        for item in objects:
            if item.path in paths and item.number_values:
                kind = np.dtype(item.data_type.nptype).newbyteorder(order)
                runs[item.path].append(_Run(length[item.path], segment.num_chunks, item.number_values, place, step, kind))
                length[item.path] += segment.num_chunks * item.number_values
            place += item.data_size
    return runs
