"""A raw file that is measured as it is read: calibrated, screened and digested block by block, without a
calibrated copy on disk.

For files of which a reading costs no more than reading that copy would, and of which single columns can be
read. Others go through `ingest`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.digest import DigestAlong, file_sha256
from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.recording_file import read_ahead
from labpipe.project.ingest import (
    Calibration,
    changed_while_read,
    channel_screen,
    check_table,
    is_recording,
    stated_rate,
)
from labpipe.raw_files.screening import ChannelScreen, TimeAxisScreen
from labpipe.raw_files.table import QuickTable, as_quick, open_table
from labpipe.records.finding import Finding
from labpipe.records.rig import Rig

# A file younger than this [ns] may have been changed without another time of change: clocks of file systems
# tick.
YOUNG = 2_000_000_000


def raw_recording(source: Path, rig: Rig, base: Path) -> RawRecording | None:
    """The recording of a raw file that can be measured as it is read; None for one that needs `ingest`.
    Raises DataError as that does.

    *base* is the folder to which the path in its reference is relative.
    """
    if is_recording(source) or rig.resample is not None:
        return None
    quick = as_quick(open_table(source))
    return None if quick is None else RawRecording(quick, rig, base)


class RawRecording:
    """The channels of a raw file [SI]. Satisfies SampleSource.

    *findings* and digest are those of the first whole reading.
    """

    def __init__(self, table: QuickTable, rig: Rig, base: Path) -> None:
        self.path, self.rig, self.n_sample, self.name = table.path, rig, table.n_row, table.path.stem
        self._state, self._began = _state_of(self.path), time.time_ns()
        self._columns = check_table(table, rig)[1 if rig.time else 0 :]
        self.channels = rig.all_channels
        self._table, self._base, self._calibration = table, base, Calibration(rig)
        self._findings: tuple[Finding, ...] | None = None
        self._sha256 = ""

    @cached_property
    def sample_rate(self) -> float:
        """Rate [Hz] as the rig file or the raw file states it, or by the time column, which is read first, by
        itself.
        """
        if not self.rig.time:
            return stated_rate(self._table, self.rig)
        screen = TimeAxisScreen(self.rig.time)
        for (times,) in self._table.column_chunks([self.rig.time]):
            screen.add(np.asarray(times, np.float64) * self.rig.time_scale)
        return screen.sample_rate()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found in the samples; the file is read where it has not been."""
        if self._findings is None:
            for _ in self._screened():
                pass
        assert self._findings is not None
        return self._findings

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, (n, n_channel) [SI]."""
        return read_ahead(self._blocks_in_turn(n_sample))

    def _blocks_in_turn(self, n_sample: int) -> Iterator[FloatArray]:
        for columns in self._screened() if self._findings is None else self._record():
            block = self._calibration.with_sums(self._calibration.in_rows(columns))
            for start in range(0, block.shape[0], n_sample):
                yield block[start : start + n_sample]

    def _record(self) -> Iterator[list[FloatArray]]:
        """The columns of the measured channels, each (n,) [unit of the file]."""
        return self._table.column_chunks(self._columns)

    def _screened(self) -> Iterator[list[FloatArray]]:
        """The same, looked at for faults and digested on the way.

        What comes of it holds when all was read.
        """
        screen = channel_screen(self.rig)
        with DigestAlong(self.path) as digest:
            for columns in self._record():
                self._screen(screen, columns)
                if not self._sha256:
                    digest.advance(screen.n_sample / self.n_sample)
                yield columns
            self._findings = screen.findings()
            self._sha256 = self._sha256 or digest.hexdigest()

    def _screen(self, screen: ChannelScreen, columns: Sequence[FloatArray]) -> None:
        """Look at the next columns, each (n,) [unit of the file]: at their extremes, which calibration keeps,
        then where those say so.
        """
        calibrated = self._calibration.of_channel
        ends = np.array(
            [[calibrated(n, end) for end in (column.min(), column.max())] for n, column in enumerate(columns)]
        )
        if not screen.add_between(
            ends.min(axis=1), ends.max(axis=1), columns[0].size, lambda n: calibrated(n, columns[n])
        ):
            screen.add(self._calibration.in_rows(columns))

    def source_ref(self) -> SourceRef:
        """The reference by which a result names the raw file."""
        self._sha256 = self._sha256 or file_sha256(self.path)
        return source_ref(self.path, self._base, self._sha256)

    def check_unchanged(self) -> None:
        """DataError where the file is no longer the one that was opened."""
        changed = _state_of(self.path) != self._state
        if not changed and self._began - self._state[0] < YOUNG:
            changed = file_sha256(self.path) != self._sha256
        if changed:
            raise changed_while_read(self.path)


def _state_of(path: Path) -> tuple[int, int, int]:
    """What changes with a file's content: time of change [ns], size [byte], number."""
    status = os.stat(path)
    return status.st_mtime_ns, status.st_size, status.st_ino
