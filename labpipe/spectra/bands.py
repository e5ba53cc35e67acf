"""Choice of frequency lines: inside a band, outside excluded bands and harmonics of the shaft speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.shaft import shaft_motion

# Lines are multiples of a spacing computed in floating point: one that lies on a band's edge belongs to the
# band.
EDGE = 1e-9
# A period of fewer samples is read before it is compared with the recording, which says more.
MANY_SAMPLES = 1 << 22
# Frequencies of the mains [Hz].
MAINS = (50.0, 60.0)


def lines_in(
    frequency: FloatArray, band: tuple[float, float] | None, exclude: tuple[tuple[float, float], ...] = ()
) -> BoolArray:
    """Lines (n_frequency,) [Hz] inside the band (edges included) and outside every excluded band, as a mask
    (n_frequency,).
    """
    chosen = np.ones(frequency.shape, bool)
    if band is not None:
        chosen &= _within(frequency, band)
    for gap in exclude:
        chosen &= ~_within(frequency, gap)
    return chosen


# Share of a band that may lie beyond all lines unsaid: rounded ends are no slip.
MOST_BEYOND = 0.1


def settings_findings(frequency: FloatArray, settings: FrfSettings) -> tuple[Finding, ...]:
    """Notes where the settings' band reaches far beyond the lines *frequency* (n_line,) [Hz] and what is
    excluded beside them, or, without one, where an excluded band lies beyond.
    """
    bands = [gap for gap in settings.exclude if gap[0] > frequency[-1]]
    if settings.band is not None:
        bands, frequency = [settings.band], np.sort([*frequency[[0, -1]], *np.ravel(settings.exclude)])
    return tuple(finding for band in bands for finding in beyond_finding(frequency, band))


def beyond_finding(frequency: FloatArray, band: tuple[float, float]) -> tuple[Finding, ...]:
    """A note where a *band* [Hz] reaches far beyond the lines *frequency* (n_line,) [Hz]."""
    low, high = float(frequency[0]), float(frequency[-1])
    if max(low - band[0], band[1] - high) <= MOST_BEYOND * (band[1] - band[0]):
        return ()
    what = f"lines lie from {low:g} to {high:g} Hz, and the band {band[0]:g}-{band[1]:g} Hz reaches beyond"
    return (note("band-beyond", f"{what}: nothing is known of the model there"),)


def block_samples(source: SampleSource, block: float, least: int = 4) -> int:
    """Samples of a *block* [s] of a recording; DataError for fewer than *least*, and for more than it has."""
    n_sample = round(block * source.sample_rate)
    if n_sample < least:
        what = f"a block of {block:g} s holds {n_sample} samples of '{source.name}', {least} are needed"
        raise DataError(what, hint="lengthen `block`")
    if n_sample > source.n_sample:
        what = f"'{source.name}' is {source.n_sample / source.sample_rate:g} s long"
        raise DataError(f"{what}, too short for one block of {block:g} s", hint="shorten `block`")
    return n_sample


def line_range(
    n_sample: int, sample_rate: float, band: tuple[float, float] | None, length: int | None = None
) -> slice:
    """Range of DFT lines of *n_sample* samples at *sample_rate* [Hz] inside the band, without the line at 0
    Hz. DataError when the band holds no line, and for a long period of which the recording of *length*
    samples does not hold one: before anything of its size is made.
    """
    if length is not None and n_sample > max(length, MANY_SAMPLES):
        what = (
            f"a period of {n_sample / sample_rate:g} s is longer than the recording of "
            f"{length / sample_rate:g} s"
        )
        raise DataError(what, hint="check `period` and the sampling rate")
    frequency = np.arange(1, n_sample // 2 + 1) * (sample_rate / n_sample)
    inside = np.flatnonzero(lines_in(frequency, band))
    if not inside.size:
        hint = f"the recording has lines every {frequency[0]:g} Hz up to {frequency[-1]:g} Hz"
        raise DataError("no line lies in the band", hint=hint)
    return slice(int(inside[0]) + 1, int(inside[-1]) + 2)


def _within(frequency: FloatArray, band: tuple[float, float]) -> BoolArray:
    low, high = band
    return (frequency >= low * (1 - EDGE)) & (frequency <= high * (1 + EDGE))


# Half width of the mask [lines]: a window's main lobe for random data; periodic data do not leak where the
# speed lies on a line.
LOBE = {"periodic": 0.5, "random": 2.0, "impact": 2.0}


def masked_bands(
    sources: Sequence[SampleSource], settings: FrfSettings
) -> tuple[tuple[tuple[float, float], ...], tuple[Finding, ...]]:
    """Bands (low, high) [Hz] around 1x, 2x, ... of every recording: slowest to fastest speed, extended by the
    mask's width; findings on the tacho.
    """
    if settings.mask is None:
        return (), ()
    width = settings.mask.width
    if width is None:
        length = settings.period or settings.block
        assert length is not None
        width = LOBE[settings.excitation] / length
    motions = [shaft_motion(source, settings.mask) for source in sources]
    bands = tuple(
        (max(order * low - width, 0.0), order * high + width)
        for low, high in dict.fromkeys(motion.speed_range for motion in motions)
        for order in range(1, settings.mask.harmonics + 1)
    )
    return bands, tuple(finding for motion in motions for finding in motion.findings)


def mask_findings(
    bands: Sequence[tuple[float, float]], of: tuple[float, float] | None
) -> tuple[Finding, ...]:
    """A note on the masked *bands* [Hz] in the band *of* the response, None for all of it."""
    least, most = of or (0.0, np.inf)
    named = ", ".join(f"{low:.6g}-{high:.6g} Hz" for low, high in bands if low <= most and high >= least)
    what = f"lines of the shaft speed are left out: {named}" if named else "the band has no line of the shaft"
    return (note("masked", what),) if bands else ()
