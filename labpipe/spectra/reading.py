"""Blocks of a recording on their way to the spectra: a sample that is no number stops them, a silent force as well."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource

# Samples of a block: a few of them stay in the cache together with the spectra they give.
READ_SAMPLES = 1 << 16


def checked_blocks(source: SampleSource) -> Iterator[FloatArray]:
    """The recording's blocks (n, n_channel); DataError at the first sample that is no number, and at the end for a silent force."""
    start = 0
    silent: dict[int, float] = {}
    for block in source.blocks(READ_SAMPLES):
        # One sum tells of a missing number anywhere in the block; it is searched for only then.
        with np.errstate(over="ignore", invalid="ignore"):
            total = block.sum()
        if not np.isfinite(total):
            _refuse_missing(source, block, start)
        if start == 0:
            silent = {column: block[0, column] for column, channel in enumerate(source.channels) if channel.role == "input"}
        silent = {column: level for column, level in silent.items() if np.all(block[:, column] == level)}
        start += block.shape[0]
        yield block
    for column in silent:
        what = f"the force channel '{source.channels[column].name}' of '{source.name}' does not vary"
        raise DataError(what, hint="is the sensor connected?")


def _refuse_missing(source: SampleSource, block: FloatArray, start: int) -> None:
    missing = np.argwhere(~np.isfinite(block))
    if not missing.size:
        return
    sample, column = (int(n) for n in missing[0])
    where = f"sample {start + sample} ({(start + sample) / source.sample_rate:g} s)"
    hint = "labpipe fills no gaps; cut the recording there or record it again"
    raise DataError(f"channel '{source.channels[column].name}' of '{source.name}' has no number at {where}", hint=hint)
