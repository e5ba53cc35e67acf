"""Hammer hits: detection, windows, and rejection of overloads and double hits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource
from labpipe.spectra.reading import READ_SAMPLES, checked_blocks
from labpipe.spectra.settings import ImpactSettings

# Equal consecutive samples at the end of the range that count as an overload of the converter.
CLIPPED_RUN = 3
# Share of the double-hit level below which the contact has ended; a later rise above that level is a second contact.
ENDED = 0.5
# The force window falls from one to zero within this share of its length.
FLANK = 0.1


@dataclass(frozen=True)
class Hit:
    """One hit: *start* of its block [samples from the recording's start], samples (n_sample, n_channel) without offset [SI].

    *trigger*: sample of the block at which the force rises; *fault*: reason for rejection, empty for an accepted hit.
    """

    number: int
    start: int
    trigger: int
    samples: FloatArray
    fault: str = ""


def find_hits(source: SampleSource, force: int, n_sample: int, settings: ImpactSettings, first_number: int = 1) -> Iterator[Hit]:
    """The hits of a recording in order of time, accepted or rejected; *force* is the hammer's column, *n_sample* the block length.

    A hit begins where |force| exceeds the trigger, a share of the largest force in the recording, both relative to the zero level (the
    median of the first block); its block begins earlier by the pretrigger, or where the recording begins if it holds one block only, as
    an analyser stores it. The recording is read twice. DataError for a sample that is no number or a force that does not vary.
    """
    zero_level = float(np.median(next(iter(source.blocks(READ_SAMPLES)))[:, force]))
    level = settings.trigger * max(float(np.max(np.abs(block[:, force] - zero_level))) for block in checked_blocks(source))
    before = round(settings.pretrigger * n_sample)
    latest = source.n_sample - n_sample if source.n_sample - n_sample <= before else source.n_sample
    window = np.empty((0, len(source.channels)))
    # *window* begins at sample *begin*; the search for triggers goes on at sample *search*.
    begin = search = 0
    number = first_number
    for block in checked_blocks(source):
        window = np.concatenate([window, block])
        while True:
            above = np.flatnonzero(np.abs(window[search - begin :, force] - zero_level) >= level)
            if not above.size:
                search = begin + window.shape[0]
                break
            trigger = search + int(above[0])
            start = min(max(trigger - before, 0), latest)
            if start + n_sample > begin + window.shape[0]:
                search = trigger
                break
            samples = window[start - begin : start - begin + n_sample]
            yield _judged(number, start, samples, trigger - start, force, settings)
            number, search = number + 1, start + n_sample
        keep = max(min(search - before, latest, begin + window.shape[0]), begin)
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
    """Channels (n_channel,) of samples (n_sample, n_channel) [SI] with several equal consecutive samples at the largest or smallest value.

    Only values beyond half the peak count, so that the zero level is no overload.
    """
    peak = np.max(np.abs(samples), axis=0)
    clipped = np.zeros(samples.shape[1], bool)
    for end in (samples.max(axis=0), samples.min(axis=0)):
        at_end = (samples == end) & (np.abs(end) > peak / 2)
        run = np.lib.stride_tricks.sliding_window_view(at_end, CLIPPED_RUN, axis=0).all(axis=2)
        clipped |= run.any(axis=0)
    return clipped


def is_double(force: FloatArray, share: float) -> bool:
    """True for a double hit: |force| (n_sample,) [N] falls below half of *share* of its peak and rises above *share* again."""
    size = np.abs(force) / np.max(np.abs(force))
    above = np.flatnonzero(size >= share)
    gaps = np.flatnonzero(np.diff(above) > 1)
    return any(size[above[gap] : above[gap + 1]].min() < ENDED * share for gap in gaps)


def force_window(n_sample: int, trigger: int, length: float) -> FloatArray:
    """Force window: one up to *length* [samples] after the hit, then half a cosine to zero within a tenth of it, (n_sample,)."""
    past = np.arange(n_sample) - (trigger + length)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(past / (FLANK * length), 0.0, 1.0)))


def exponential_window(n_sample: int, constant: float) -> FloatArray:
    """exp(-t / constant) from the start of the block, (n_sample,) [1]; *constant* in samples.

    Applied to force and outputs alike, so that their FRF is exactly H(j w + 1/constant). Equation (frf-exponential).
    """
    return np.exp(-np.arange(n_sample) / constant)


def check_single_force(source: SampleSource) -> int:
    """The column of the hammer; DataError when the recording has not exactly one force."""
    forces = [number for number, channel in enumerate(source.channels) if channel.role == "input"]
    if len(forces) != 1:
        names = ", ".join(source.channels[number].name for number in forces)
        raise DataError(f"recording '{source.name}' of hits has {len(forces)} forces ({names})", hint="one hammer per recording")
    return forces[0]
