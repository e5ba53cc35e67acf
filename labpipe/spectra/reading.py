"""Blocks of a recording on their way to the spectra, with checks for missing samples and constant forces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource

# Samples of a block: a few blocks fit into the cache together with their spectra.
READ_SAMPLES = 1 << 17


def checked_blocks(source: SampleSource) -> Iterator[FloatArray]:
    """The recording's blocks (n, n_channel) [unit of the channel].

    DataError at the first sample that is no number, and at the end for a force that does not vary.
    """
    start = 0
    silent: dict[int, float] = {}
    for block in source.blocks(READ_SAMPLES):
        # The sum is not finite if any sample is missing; only then is the sample searched for.
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
    hint = "labpipe does not fill gaps; cut the recording there or record it again"
    raise DataError(f"channel '{source.channels[column].name}' of '{source.name}' has no number at {where}", hint=hint)
