"""WAV files: one column per track, 1 at full scale; the rig's sensitivity converts full scale."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import wavfile

from labpipe.arrays import FloatArray
from labpipe.errors import DataError

CHUNK_ROWS = 1 << 17


class WavTable:
    """The tracks "1", "2", ... of a WAV file as shares of full scale. Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        rate, self._samples = _read(path)
        if self._samples.shape[0] < 1:
            raise DataError("holds no samples", where=str(path))
        self.columns = tuple(str(n + 1) for n in range(self._samples.shape[1]))
        self.units = dict.fromkeys(self.columns, "1")
        self.sample_rate: float | None = float(rate)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [1], relative to full scale."""
        indices = [self.columns.index(name) for name in columns]
        for start in range(0, self._samples.shape[0], CHUNK_ROWS):
            yield _share(self._samples[start : start + CHUNK_ROWS, indices])


def _read(path: Path) -> tuple[int, NDArray[np.generic]]:
    """(rate [Hz], samples (n, n_track)), mapped from the file where its format (not 24 bit) permits it."""
    if path.stat().st_size == 0:
        raise DataError("the file is empty", where=str(path))
    _check_length(path)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                rate, samples = wavfile.read(str(path), mmap=True)
            except ValueError:
                rate, samples = wavfile.read(str(path))
    except (ValueError, TypeError, OSError, EOFError, struct.error, UnboundLocalError, ZeroDivisionError) as error:
        reason = (str(error).splitlines() or ["cut off"])[0].rstrip(".")
        raise DataError(f"is not a readable WAV file ({reason[:80]})", where=str(path)) from None
    if any("EOF" in str(warning.message) for warning in caught):
        raise DataError("ends before its last sample", where=str(path), hint="the file is truncated")
    if rate <= 0:
        raise DataError("has no sampling rate", where=str(path))
    return rate, samples.reshape(samples.shape[0], -1)


def _check_length(path: Path) -> None:
    """DataError where the header claims more samples than the file holds, before memory is asked for them."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        order = {b"RIFF": "<", b"RIFX": ">"}.get(stream.read(4))
        place = 12
        while order is not None and place + 8 <= size:
            stream.seek(place)
            name, length = struct.unpack(f"{order}4sI", stream.read(8))
            if name == b"data" and place + 8 + length > size:
                raise DataError("ends before its last sample", where=str(path), hint="the file is truncated")
            place += 8 + length + length % 2


def _share(samples: NDArray[np.generic]) -> FloatArray:
    """Samples by full scale: integers by 2^(bits - 1), bytes around 128; scipy gives 24 bit as the upper part of 32."""
    if samples.dtype.kind == "f":
        return samples.astype(np.float64)
    half = 2.0 ** (8 * samples.dtype.itemsize - 1)
    return (samples.astype(np.float64) - (half if samples.dtype.kind == "u" else 0.0)) / half
