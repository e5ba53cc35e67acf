"""Recordings of a structure that is left to itself -> its free decays: where each begins and ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.quantities import QUANTITIES
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.records.spectra import FreeDecay, FreeDecays
from labpipe.spectra.channels import refuse_missing
from labpipe.spectra.ports import left_out, response_ports, source_findings
from labpipe.spectra.settings import FrfSettings

BLOCK = 1 << 16
# A hit makes the response this many times what it was within a period; a beat stays below 4.
JUMP = 6.0
# A release from a steady state is where the response was last this share of its largest.
STILL_FULL = 0.95
# A decay ends where its rms is this many times that of the quietest stretches, and this share of it later.
QUIET, BEYOND = 1.5, 0.5
# Part of the largest rms below which a channel stands still: no sensor has so little noise.
STILL = 1e-6
# Stretches of noise in a row that end a decay: longer than the nodes of a beat.
SILENCE = 8
# The largest rms over that of the quietest stretches below which nothing decays, and least samples of one.
LEAST_RATIO = 4.0
LEAST_STRETCH = 64
# Whole periods over which the mean is taken out, so that a drifting rest position is not a response.
STEADY_PERIODS = 2
LEAST_PERIODS = 3.0


@dataclass(frozen=True)
class _Levels:
    """All outputs together, each over its rms; period and stretch [samples], rms of the noise."""

    size: FloatArray
    period: int
    stretch: int
    floor: float


def free_decays(
    sources: Sequence[SampleSource],
    settings: FrfSettings,
    *,
    name: str = "",
    conditions: dict[str, Any] | None = None,
) -> FreeDecays:
    """All free decays of the recordings; inputs are not looked at. A decay begins one period after the
    largest value that follows a hit or a release (or at `start`), and ends at the next hit, at the end of the
    recording, or where it is lost in the noise (or at `end`). A recording without a decay is left out by
    name, beside others that hold one. DataError for different rates, and where nothing decays.
    """
    ports, columns, channels = response_ports(sources)
    rate = sources[0].sample_rate
    decays: list[FreeDecay] = []
    findings: list[Finding] = list(source_findings(sources))
    without: list[DataError] = []
    for source, chosen in zip(sources, columns, strict=True):
        samples = np.concatenate([block[:, list(chosen)] for block in source.blocks(BLOCK)])
        refuse_missing(source, samples, chosen)
        try:
            spans = _spans(samples, rate, settings, source.name)
        except DataError as error:
            without.append(error)
            findings.append(left_out(source, "it holds no free decay that stands out of its noise"))
            continue
        decays.extend(FreeDecay(source.name, start / rate, samples[start:end]) for start, end in spans)
        spans_text = ", ".join(f"{start / rate:.4g} s to {end / rate:.4g} s" for start, end in spans)
        whole = f"recording '{source.name}' of {samples.shape[0] / rate:.4g} s"
        findings.append(note("free-decay", f"{whole}: {len(spans)} free decay(s), {spans_text}"))
    if not decays:
        raise without[0]
    units = tuple(QUANTITIES[channel.quantity].si_unit for channel in channels)
    return FreeDecays(
        rate,
        ports,
        units,
        tuple(decays),
        name=name,
        findings=tuple(findings),
        conditions=dict(conditions or {}),
    )


def _spans(samples: FloatArray, rate: float, settings: FrfSettings, name: str) -> list[tuple[int, int]]:
    decay = settings.decay
    if decay.start is not None:
        end = samples.shape[0] if decay.end is None else round(decay.end * rate)
        spans = [(round(decay.start * rate), min(end, samples.shape[0]))]
    else:
        levels = _levels(samples, name)
        settle = levels.period if decay.settle is None else round(decay.settle * rate)
        spans = _spans_of_decay(levels, decay.trigger, settle)
        if decay.end is not None:
            spans = [(start, min(end, round(decay.end * rate))) for start, end in spans]
        spans = [span for span in spans if span[1] - span[0] >= LEAST_PERIODS * levels.period]
    if not spans or spans[0][1] - spans[0][0] < 2:
        what = f"recording '{name}' holds no free decay"
        raise DataError(what, hint="say where it is with `decay: {start: ..., end: ...}`")
    return spans


def _levels(samples: FloatArray, name: str) -> _Levels:
    centred = samples - np.median(samples, axis=0)
    deviation = np.std(centred, axis=0)
    moving = (deviation > 0) & np.isfinite(deviation)
    if not np.any(moving) or samples.shape[0] < 16:
        raise DataError(f"recording '{name}' does not move", hint="check the channels of the rig file")
    scaled = centred[:, moving] / deviation[moving]
    # Of the strongest line of the velocity: a drift or a step is not an oscillation.
    spectrum = np.sum(np.abs(scipy.fft.rfft(scaled, axis=0)) ** 2, axis=1)
    strongest = int(np.argmax(np.arange(spectrum.size) ** 2 * spectrum))
    period = max(2, round(len(scaled) / max(strongest, 1)))
    swinging = _swinging(scaled, STEADY_PERIODS * period)
    size = np.sqrt(np.sum((swinging / np.std(swinging, axis=0)) ** 2, axis=1))
    stretch = period * -(-LEAST_STRETCH // period)
    rms = _rms(size, stretch)
    # A channel that stands still for a while (saturated, switched off) says nothing about its noise.
    moving_rms = rms[rms > STILL * np.max(rms, initial=0.0)]
    quiet = float(np.quantile(moving_rms, 0.05)) if moving_rms.size else float("inf")
    if not rms.size or np.max(rms) < LEAST_RATIO * quiet:
        what = f"in recording '{name}' no decay stands out of the noise"
        raise DataError(what, hint="excite it more, or name `start` and `end`")
    return _Levels(size, period, stretch, quiet)


def _swinging(samples: FloatArray, length: int) -> FloatArray:
    """Distance (n_sample, n_output) from the mean over *length* samples before every sample or after it,
    whichever is nearer. A mean that reaches across a hit carries some of it to where nothing moves yet, and
    the hit is not a jump any more.
    """
    rest = _rest(samples, length)
    number = np.arange(samples.shape[0])
    parts = [
        samples - rest[np.clip(number + shift, 0, len(rest) - 1)] for shift in (-(length // 2), length // 2)
    ]
    return np.where(np.abs(parts[0]) < np.abs(parts[1]), parts[0], parts[1])


def _rest(samples: FloatArray, length: int) -> FloatArray:
    """The mean over *length* samples about every sample, near the ends that of the first or last so many."""
    if samples.shape[0] <= length:
        return np.mean(samples, axis=0, keepdims=True)

    half = length // 2
    inner = scipy.ndimage.uniform_filter1d(samples, length, axis=0)[half : samples.shape[0] - half]
    return np.pad(inner, ((half, half), (0, 0)), mode="edge")


def _rms(size: FloatArray, stretch: int) -> FloatArray:
    whole = size[: size.size // stretch * stretch].reshape(-1, stretch)
    return np.sqrt(np.mean(whole**2, axis=1))


def _spans_of_decay(levels: _Levels, trigger: float, settle: int) -> list[tuple[int, int]]:
    hits = _hits(levels, trigger)
    spans = []
    for hit, following in zip(hits, [*hits[1:], levels.size.size + levels.period], strict=True):
        start = hit + int(np.argmax(levels.size[hit : hit + 2 * levels.period])) + settle
        limit = min(following - levels.period, levels.size.size)
        spans.append((start, _end(levels, start, limit)))
    return [(start, end) for start, end in spans if end > start]


def _hits(levels: _Levels, trigger: float) -> list[int]:
    half = max(1, levels.period // 2)
    count = levels.size.size // half
    peaks = np.max(levels.size[: count * half].reshape(count, half), axis=1)
    largest = float(np.max(peaks))
    following = np.maximum(peaks, np.append(peaks[1:], 0.0))
    before = np.maximum(np.append([np.inf], peaks[:-1]), np.append([np.inf, np.inf], peaks[:-2]))
    jumps = np.flatnonzero((following > JUMP * before) & (following > trigger * largest))
    first = [int(jump) for n, jump in enumerate(jumps) if n == 0 or jump > jumps[n - 1] + 2]
    top = int(np.flatnonzero(peaks >= STILL_FULL * largest)[-1])
    if not first or first[0] > top:
        first = [max(top - 1, 0), *first]
    return [jump * half for jump in first]


def _end(levels: _Levels, start: int, limit: int) -> int:
    rms = _rms(levels.size[start:limit], levels.stretch)
    # Of five neighbouring stretches the median, so that a single loud one does not count.
    smooth = (
        np.median(np.lib.stride_tricks.sliding_window_view(np.pad(rms, 2, mode="edge"), 5), axis=1)
        if rms.size
        else rms
    )
    loud = np.flatnonzero(smooth > QUIET * levels.floor)
    # What is loud again after a long silence is something else: a hit too weak to be seen as one, a step, a
    # touch.
    silence = np.flatnonzero(np.diff(loud) > SILENCE)
    last = loud[silence[0] if silence.size else -1] if loud.size else -1
    length = (int(last) + 1) * levels.stretch
    return min(limit, start + round((1 + BEYOND) * length))
