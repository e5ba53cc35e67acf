"""Hits of a hammer: where they are, how they are windowed, and which of them are good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource
from labpipe.spectra.reading import READ_SAMPLES, checked_blocks
from labpipe.spectra.settings import ImpactSettings

# Equal samples in a row at the end of the range: the converter was overloaded.
CLIPPED_RUN = 3
# Share of the peak below which the force has ended; a later rise above the double-hit level is a second push.
ENDED = 0.5
# The force window falls from one to zero within this share of its length.
FLANK = 0.1


@dataclass(frozen=True)
class Hit:
    """One hit: *start* of its block [samples from the recording's start], samples (n_sample, n_channel) free of their offset [SI].

    *trigger* is the sample of the block at which the force rose; *fault* says why it is not used, empty for a good hit.
    """

    number: int
    start: int
    trigger: int
    samples: FloatArray
    fault: str = ""


def find_hits(source: SampleSource, force: int, n_sample: int, settings: ImpactSettings, first_number: int = 1) -> Iterator[Hit]:
    """The hits of a recording in their order, judged; *force* is the column of the hammer, *n_sample* the length of a block.

    A hit begins where |force| rises above the trigger, a share of the largest one in the recording, both taken from the level at
    which the sensor rests (the median of the first block); the hit's block begins earlier by the pretrigger. The recording is read
    twice. DataError for a sample that is no number or a force that does not vary.
    """
    rest = float(np.median(next(iter(source.blocks(READ_SAMPLES)))[:, force]))
    level = settings.trigger * max(float(np.max(np.abs(block[:, force] - rest))) for block in checked_blocks(source))
    before = round(settings.pretrigger * n_sample)
    window = np.empty((0, len(source.channels)))
    # *window* begins at sample *begin*; triggers are looked for from sample *search* on.
    begin = search = 0
    number = first_number
    for block in checked_blocks(source):
        window = np.concatenate([window, block])
        while True:
            above = np.flatnonzero(np.abs(window[search - begin :, force] - rest) >= level)
            if not above.size:
                search = begin + window.shape[0]
                break
            trigger = search + int(above[0])
            start = max(trigger - before, 0)
            if start + n_sample > begin + window.shape[0]:
                search = trigger
                break
            samples = window[start - begin : start - begin + n_sample]
            yield _judged(number, start, samples, trigger - start, force, settings)
            number, search = number + 1, start + n_sample
        keep = max(min(search - before, begin + window.shape[0]), begin)
        window, begin = window[keep - begin :], keep


def _judged(number: int, start: int, raw: FloatArray, trigger: int, force: int, settings: ImpactSettings) -> Hit:
    offset = np.median(raw[: max(trigger, 1)], axis=0) if trigger >= 4 else np.zeros(raw.shape[1])
    samples = raw - offset
    if number in settings.reject:
        fault = "left out by hand"
    elif overloaded(samples).any():
        fault = f"overload of channel {int(np.argmax(overloaded(samples))) + 1}"
    elif is_double(samples[:, force], settings.double_hit):
        fault = "double hit"
    else:
        fault = ""
    return Hit(number, start, trigger, samples, fault)


def overloaded(samples: FloatArray) -> BoolArray:
    """Which channels (n_channel,) of samples (n_sample, n_channel) stand at their largest or smallest value several times in a row.

    The end on which the signal rests is no overload: only values beyond half the peak count.
    """
    peak = np.max(np.abs(samples), axis=0)
    found = np.zeros(samples.shape[1], bool)
    for end in (samples.max(axis=0), samples.min(axis=0)):
        at_end = (samples == end) & (np.abs(end) > peak / 2)
        run = np.lib.stride_tricks.sliding_window_view(at_end, CLIPPED_RUN, axis=0).all(axis=2)
        found |= run.any(axis=0)
    return found


def is_double(force: FloatArray, share: float) -> bool:
    """Whether the hammer touched twice: |force| (n_sample,) falls below half of *share* of its peak and rises above *share* again."""
    size = np.abs(force) / np.max(np.abs(force))
    above = np.flatnonzero(size >= share)
    gaps = np.flatnonzero(np.diff(above) > 1)
    return any(size[above[gap] : above[gap + 1]].min() < ENDED * share for gap in gaps)


def force_window(n_sample: int, trigger: int, length: float) -> FloatArray:
    """One up to *length* [samples] after the hit, then half a cosine to zero within a tenth of it, (n_sample,)."""
    past = np.arange(n_sample) - (trigger + length)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(past / (FLANK * length), 0.0, 1.0)))


def exponential_window(n_sample: int, constant: float) -> FloatArray:
    """exp(-t / constant) from the block's start, (n_sample,); *constant* in samples.

    Force and response are both multiplied with it, so that their FRF is exactly H(j w + 1/constant).
    """
    return np.exp(-np.arange(n_sample) / constant)


def check_single_force(source: SampleSource) -> int:
    """The column of the hammer; DataError when the recording has not exactly one force."""
    forces = [number for number, channel in enumerate(source.channels) if channel.role == "input"]
    if len(forces) != 1:
        names = ", ".join(source.channels[number].name for number in forces)
        raise DataError(f"recording '{source.name}' of hits has {len(forces)} forces ({names})", hint="one hammer per recording")
    return forces[0]
