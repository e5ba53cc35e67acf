"""A jump within a free decay, of samples that are missing or of a second hit: the parts before and after it
as two decays of the same poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.errors import FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.ring_down.likelihood import Decayed, Piece, maximum_likelihood, pieces_of
from labpipe.methods.ring_down.residual_test import judged
from labpipe.records.finding import Finding
from labpipe.records.spectra import FreeDecay, FreeDecays

# Places of a jump that are tried first, and the shares of a decay between which they lie.
PLACES, FIRST, LAST = 24, 0.04, 0.8
# Difference of BIC from which a jump is said.
BETTER = 20.0
# Missing samples leave the amplitude as it is to this share, and are a whole number to this part of one.
EVEN, WHOLE = 0.1, 0.25


@dataclass(frozen=True)
class Jump:
    """A decay as two, *pieces* of the same poles, with the finding that says why."""

    decays: FreeDecays
    pieces: tuple[Piece, ...]
    fitted: Decayed
    finding: Finding


def jump_of(
    decays: FreeDecays, columns: Sequence[int], fitted: Decayed, band: tuple[float, float] | None
) -> Jump | None:
    """The jump with which nothing but noise is left of a decay; None where there is none, or several
    decays.
    """
    if len(decays.decays) != 1:
        return None
    count = decays.decays[0].samples.shape[0]
    places = np.linspace(FIRST * count, LAST * count, PLACES).astype(int)
    tried = {int(place): _parted(decays, columns, fitted, band, int(place)) for place in places}
    step = int(places[1] - places[0])
    while step > 1:
        step = -(-step // 3)
        near = _best(tried)
        for place in (near - 2 * step, near - step, near + step, near + 2 * step):
            if place not in tried and FIRST * count < place < LAST * count:
                tried[place] = _parted(decays, columns, fitted, band, place)
    place = _best(tried)
    found = tried[place]
    if found is None:
        return None
    parts, pieces, parted = found
    free = (2 * fitted.poles.size + 1) * len(columns) + 1
    gain = fitted.misfit - parted.misfit - free * np.log(count * len(columns))
    left = judged(pieces, parted, decays.sample_rate)
    if gain < BETTER or min(left.white, left.amplitude) < MISMATCH_P:
        return None
    return Jump(replace(decays, decays=parts), pieces, parted, _finding(parted, parts, decays.sample_rate))


Parted = tuple[tuple[FreeDecay, ...], tuple[Piece, ...], Decayed]


def _parted(
    decays: FreeDecays, columns: Sequence[int], fitted: Decayed, band: tuple[float, float] | None, place: int
) -> Parted | None:
    """The decay in two at a sample, fitted."""
    (whole,) = decays.decays
    parts = (
        replace(whole, samples=whole.samples[:place]),
        replace(whole, start=whole.start + place / decays.sample_rate, samples=whole.samples[place:]),
    )
    try:
        pieces = pieces_of(parts, columns, decays.sample_rate, band)
        return parts, pieces, maximum_likelihood(pieces, fitted.poles)
    except (FitError, np.linalg.LinAlgError):
        return None


def _best(tried: dict[int, Parted | None]) -> int:
    return min(tried, key=lambda place: np.inf if (found := tried[place]) is None else found[2].misfit)


def _finding(parted: Decayed, parts: tuple[FreeDecay, ...], rate: float) -> Finding:
    """Missing samples where the motion goes on with another phase, else a second hit."""
    before, after = parted.pieces
    time, when = len(parts[0].samples) / rate, parts[1].start
    mode, output = np.unravel_index(int(np.argmax(np.abs(after.amplitudes))), after.amplitudes.shape)
    pole = parted.poles[mode]
    ratio = after.amplitudes[mode, output] / (before.amplitudes[mode, output] * np.exp(pole * time))
    ahead = float(np.angle(ratio)) % (2 * np.pi) / abs(pole.imag)
    lost = ahead * rate
    even = abs(abs(ratio) / np.exp(pole.real * ahead) - 1) < EVEN
    values = "Values and intervals are those of the parts before and after it together"
    if even and round(lost) >= 1 and abs(lost - round(lost)) < WHOLE:
        period = 2 * np.pi / abs(pole.imag) * rate
        what = (
            f"{round(lost)} samples are missing at {when:.4g} s, or as many more as fill whole periods "
            f"({period:.4g} samples each): the phase of the motion at {abs(pole) / (2 * np.pi):.4g} Hz jumps "
            f"by {np.degrees(np.angle(ratio)):.3g} deg, its amplitude does not. {values}"
        )
        return Finding("lost-samples", f"{what}. Look for what interrupts the recording")
    what = (
        f"the motion jumps at {when:.4g} s, its amplitude to {abs(ratio):.3g} times what it was: a second "
        f"hit, or something let go. {values}"
    )
    return Finding("second-hit", f"{what}. Strike once and let it ring")
