"""Findings of a fit of free decays, and jumps in the time of a record: samples that are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.distributions import normal_tail
from labpipe.errors import FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.ring_down.amplitude_law import FittedLaw, MissingMode
from labpipe.methods.ring_down.likelihood import Decayed, Piece, maximum_likelihood, pieces_of
from labpipe.methods.ring_down.residual_test import Judged, judged
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


# Mean square of a residual at the end over that at the beginning from which it goes on.
GOES_ON = 0.5


def depends_on_amplitude(law: FittedLaw) -> bool:
    """Whether a slope of the law differs significantly from zero, and the law is no worse than its noise
    allows to tell.
    """
    errors = np.sqrt(np.diag(law.covariance))
    slopes = np.array([law.law.zeta_slope, law.law.frequency_slope])
    ratios = np.divide(np.abs(slopes), errors[1:3], out=np.zeros(2), where=errors[1:3] > 0)
    return law.converged and 4 * normal_tail(float(np.max(ratios))) < MISMATCH_P


def decay_findings(
    fitted: Decayed,
    tested: Judged,
    laws: dict[int, FittedLaw],
    amplitudes: dict[int, float],
    missing: MissingMode | None,
) -> tuple[Finding, ...]:
    """Warnings: no convergence, growing oscillations, damping over amplitude (*laws* and first *amplitudes*
    by mode), other residuals.

    *missing*: the mode that explains the residual better than a law.
    """
    warnings = []
    if not fitted.converged:
        message = (
            f"the fit of the decay did not converge in {fitted.steps} steps; its numbers are not a result"
        )
        warnings.append(Finding("no-convergence", message))
    lasting = _lasting(fitted)
    if lasting:
        where = ", ".join(f"{frequency:.4g} Hz" for frequency in lasting)
        what = (
            f"the damping ratio at {where} cannot be told from zero at 95 %: hum, an excitation that "
            "goes on, or too short a decay"
        )
        warnings.append(Finding("insignificant", what))
    growing = fitted.poles[fitted.poles.real >= 0]
    if growing.size:
        where = ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in growing)
        warnings.append(
            Finding(
                "unphysical",
                f"the oscillation at {where} does not decay: energy enters the structure, or it is an "
                "excitation",
            )
        )
    beats = missing.mode if missing is not None else None
    warnings.extend(
        _over_amplitude(mode, law, amplitudes[mode], missing if mode == beats else None)
        for mode, law in laws.items()
    )
    gaining = [mode for mode, law in laws.items() if law.law.zeta_rest < -2 * np.sqrt(law.covariance[0, 0])]
    warnings.extend(_gaining(mode, laws[mode].law.zeta_rest) for mode in gaining)
    if missing is not None and missing.white:
        warnings.append(_beating(missing, fitted.poles.size))
    explained = laws and all(law.law.p_value >= MISMATCH_P for law in laws.values())
    if not explained and min(tested.white, tested.amplitude) < MISMATCH_P:
        p_value = min(tested.white, tested.amplitude)
        # What rings down with the decay is of the model, what does not is of something else.
        goes_on = tested.ending > GOES_ON
        cause = (
            "it goes on to the end: a force that does not stop, such as wind or hum, dry friction, or "
            "coloured noise"
            if goes_on
            else "another mode or hum, forced motion at the start, or coloured noise"
        )
        message = (
            f"what the fit leaves is not white noise (p = {p_value:.2g}), most of it near "
            f"{tested.strongest:.4g} Hz: {cause}. "
            "No interval is given, since those for white noise do not hold. Raise `modes`, name a `band` "
            "around the mode, or begin later (`frf: {decay: {start: ...}}`)."
        )
        warnings.append(Finding("model-mismatch", message))
    return tuple(warnings)


def _lasting(fitted: Decayed) -> list[float]:
    """Frequencies [Hz] of the modes that decay, but by less than two standard errors of their decay."""
    errors = np.sqrt(np.diag(fitted.covariance)[0::2])
    lasting = (fitted.poles.real < 0) & (-fitted.poles.real < 2 * errors)
    return [float(abs(pole) / (2 * np.pi)) for pole in fitted.poles[lasting]]


def _over_amplitude(mode: int, fitted: FittedLaw, first: float, missing: MissingMode | None) -> Finding:
    law = fitted.law
    change = 100 * law.frequency_slope * first / law.omega
    message = (
        f"mode {mode + 1}: damping or frequency depend on the amplitude, so zeta_{mode + 1} is a mean over "
        f"this decay without an interval. Damping ratio {law.zeta_rest:.4g} at rest, "
        f"{law.zeta_rest + law.zeta_slope * first:.4g} at the largest amplitude (zeta_rest_{mode + 1}, "
        f"zeta_slope_{mode + 1}); the frequency differs by {change:.2g} % there. Compare decays of one "
        "amplitude."
    )
    if missing is not None:
        where = " and ".join(f"{frequency:.5g}" for frequency in missing.frequencies)
        message += (
            f" Two modes in its place, at {where} Hz, explain more of the decay than this law (difference of "
            f"BIC {missing.better:.3g}), but not all: they may beat. Try one more in `modes`."
        )
    return Finding("amplitude-dependent", message)


def _beating(missing: MissingMode, n_mode: int) -> Finding:
    first, second = missing.frequencies
    message = (
        f"mode {missing.mode + 1} looks as if its damping or frequency depended on the amplitude, but two "
        f"modes in its place, at {first:.5g} and {second:.5g} Hz, explain the decay better (difference of "
        f"BIC {missing.better:.3g}): they beat. Set `modes: {n_mode + 1}`."
    )
    return Finding("missing-mode", message)


def _gaining(mode: int, zeta_rest: float) -> Finding:
    message = (
        f"mode {mode + 1}: the law over the amplitude has a damping ratio of {zeta_rest:.4g} at rest "
        f"(zeta_rest_{mode + 1}), and a structure at rest gains no energy. The amplitude is not what it "
        "depends on: two close modes that beat look like this. Raise `modes`."
    )
    return Finding("unphysical", message)
