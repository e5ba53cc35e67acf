"""Recordings without what is synchronous with their shaft, where the settings name it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.spectra.between_periods import smooth_motion, without_runout
from labpipe.spectra.settings import FrfSettings, ShaftLines
from labpipe.spectra.shaft import at_rest, shaft_motion
from labpipe.spectra.synchronous import without_synchronous

# A shaft turns steadily where its fastest is at most this many times its slowest; pulses of noise at rest are not steady.
STEADY = 1.2


def without_shaft(sources: Sequence[SampleSource], settings: FrfSettings) -> tuple[list[SampleSource], FrfSettings, tuple[Finding, ...]]:
    """The recordings, each without its synchronous part where `remove` is given, and the settings without the lines that it falls on."""
    remove = settings.remove
    if remove is None:
        return list(sources), settings, ()
    resting = [at_rest(source, remove) for source in sources]
    findings = [
        note("synchronous-removed", f"{source.name}: the tacho {remove.tacho} shows no revolution, nothing was taken out")
        for source, rests in zip(sources, resting, strict=True)
        if rests
    ]
    cleaned: list[SampleSource] = []
    bands: dict[tuple[float, float], None] = {}
    for source, rests in zip(sources, resting, strict=True):
        if rests:
            cleaned.append(source)
        elif settings.excitation == "random":
            cleaned.append(without_synchronous(source, remove))
        else:
            without = without_runout(source, settings)
            cleaned.append(without.source)
            bands |= dict.fromkeys(without.bands)
            findings.extend(without.findings)
    return cleaned, dataclasses.replace(settings, exclude=(*settings.exclude, *bands)), tuple(findings)


def lines_of_shaft(sources: Sequence[SampleSource], settings: FrfSettings, frequency: FloatArray) -> tuple[Finding, ...]:
    """Warnings for measured lines, *frequency* (n_line,) [Hz], that lie on 1x or 2x of the shaft by a tacho that no setting names.

    The scatter between periods does not show a runout there. The tacho is taken to give a pulse per revolution.
    """
    if settings.excitation != "periodic" or settings.mask is not None or settings.remove is not None:
        return ()
    findings = []
    for source in sources:
        tacho = next((channel.name for channel in source.channels if channel.quantity == "tacho"), None)
        if tacho is None or at_rest(source, ShaftLines(tacho=tacho)):
            continue
        low, high = smooth_motion(shaft_motion(source, ShaftLines(tacho=tacho)), source.sample_rate).speed_range
        if high > STEADY * low:
            continue
        width = source.sample_rate / source.n_sample
        for order in (1, 2):
            hit = frequency[(frequency > order * low - width) & (frequency < order * high + width)]
            if hit.size:
                named = ", ".join(f"{line:g} Hz" for line in hit[:3])
                what = (
                    f"{source.name}: the excited line {named} lies on {order}x of the shaft's {np.mean([low, high]):.6g} Hz by {tacho}, so "
                )
                cure = f"its runout counts as response there; remove: {{tacho: {tacho}, harmonics: 2}} takes it out and drops the line"
                findings.append(Finding("shaft-line", what + cure))
    return tuple(findings)
