"""Recordings of swept sines -> FRF matrix line by line, with the covariance from repeated sweeps, or from the
lines around each line.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.spectra.bands import lines_in
from labpipe.spectra.channels import checked_blocks
from labpipe.spectra.covariance import covariance_of_parts, noise_levels, pooled_residual
from labpipe.spectra.impact import without_force_noise
from labpipe.spectra.local import LocalNoise, check_half_width, local_noise, usual_half_width
from labpipe.spectra.matrices import hermitian
from labpipe.spectra.period_average import neighbourhood_mean
from labpipe.spectra.ports import Layout, Parts, coherence_findings, select_lines
from labpipe.spectra.quality import force_inverse
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.sweeps import MARGIN_SHARE, FoundSweep, cuts, find_sweeps, loudest_sweeps, rate_findings

# Leakage counts where its power exceeds that of the noise in its estimate by this factor, and by so many
# standard errors.
LEAKING, SURELY = 1.2, 3.0
# Variance of the leakage over that of the noise above which a line, swept at an end, cannot be told from it.
LARGEST_SPREAD = 1.0
# Degrees of freedom of the noise up to which it is averaged over neighbouring lines.
ENOUGH_DOF = 48.0
# A response is at rest where half a period of the lowest frequency has no more of its r.m.s., and of noise.
AT_REST, NOISE_ALONE = 0.02, 1.5
# Share of the force's usual level, over lines around, below which nothing is measured.
LEAST_SHARE, AROUND = 0.1, 101


# Share of the widest band below which a sweep is left out: the record begins or ends within it (ends are
# found to some per cent in noise). Share of the longest block above which one counts as whole.
WIDE, WHOLE = 0.8, 0.9


# Lines to either side over which two sweeps are coherent but for noise, pairs that are looked at, and the
# correlation of their forces from which on one repeats the other: that of noise as large as the force.
COHERENT, MOST_PAIRS, REPEATED = 8, 12, 0.5
# Times of a block and lines to either side by which its zeros are told.
TIMES, FURTHEST = 512, 8


# Parts of a block; a burst is one with this share of its noise, and this many times the usual power (white
# noise: 1.2 times, a rotor that touches its stop: 35 to 60). Noise below this share of a response hides
# nothing; what a smooth FRF leaves is noise up to this many times that of the local fit.
PARTS, BURST_SHARE, BURST_POWER, LEAST_NOISE, MOST_EXCESS = 32, 0.3, 8.0, 0.05, 3.0


@dataclass(frozen=True)
class _Swept:
    """A recording's *name*, its *sweeps*, the *cuts* between them, its *samples* (n_sample, n_channel), and
    sweeps *left_out*, which the record cuts.
    """

    name: str
    sweeps: list[FoundSweep]
    cuts: list[tuple[int, int]]
    samples: FloatArray
    left_out: list[FoundSweep]


@dataclass(frozen=True)
class _Spectra:
    """Transforms *blocks* (n_block, n_line, n_channel) [unit of the channel] of all sweeps, forces first, on
    *frequency* (n_line,) [Hz]; *filled* (n_block,) [1] of each before its zeros. local: noise and leakage of
    the same lines by a local fit; leaking: whether leakage was found, and taken out of the responses; hidden:
    power (n_line, n_output) [unit^2] of what may be left of it in a block.
    """

    frequency: FloatArray
    blocks: ComplexArray
    filled: FloatArray
    local: LocalNoise
    leaking: bool = False
    hidden: FloatArray | None = None

    def select(self, lines: BoolArray) -> _Spectra:
        """The chosen lines (n_line,)."""
        local = replace(
            self.local,
            **{
                name: getattr(self.local, name)[lines] for name in ("noise", "leakage", "spread", "of_blocks")
            },
        )
        return replace(self, frequency=self.frequency[lines], blocks=self.blocks[:, lines], local=local)


def sweep_parts(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> Parts:
    """The FRF H = Y pinv(U) from transforms of every sweep with all that rings after it, on the lines that
    all of them pass. Leakage of a response that has not come to rest is estimated by a local rational fit and
    taken out. DataError for recordings without sweeps, with fewer sweeps than forces, or without a band in
    common. Equations (frf-sweep) and (frf-zeros).
    """
    rate = sources[0].sample_rate
    swept = [_read_sweeps(source, layout.input_columns[number]) for number, source in enumerate(sources)]
    sweeps = [sweep for run in swept for sweep in run.sweeps]
    n_input = len(layout.inputs)
    if len(sweeps) < n_input:
        names = ", ".join(port.label for port in layout.inputs)
        what = f"{len(sweeps)} sweep(s) cannot separate {n_input} forces ({names})"
        raise DataError(what, hint="one sweep or more for each force")
    every = [pair for run in swept for pair in zip(run.sweeps, run.cuts, strict=True)]
    n_sample = max(*(sweep.stop - start for sweep, (start, _) in every), min(b - a for _, (a, b) in every))
    blocks = np.concatenate(
        [layout.pad(number, _transforms(run, n_sample), 1) for number, run in enumerate(swept)]
    )
    band = max(sweep.low for sweep in sweeps) * rate, min(sweep.high for sweep in sweeps) * rate
    if band[0] >= band[1]:
        raise DataError("the sweeps have no band in common", hint="one test for each band")
    filled = np.array([(stop - start) / n_sample for _, (start, stop) in every])
    filled[filled > WHOLE] = 1.0
    spectra = _in_band(blocks, filled, rate / n_sample, band, n_input, settings)
    level = np.linalg.norm(spectra.blocks[:, :, :n_input], axis=0)
    usual = scipy.ndimage.median_filter(level, size=(min(AROUND, level.shape[0]), 1))
    driven = np.all(level >= LEAST_SHARE * usual, axis=1)
    spectra = spectra.select(select_lines(spectra.frequency, settings) & driven)
    leakage: tuple[Finding, ...] = ()
    ends = [
        (sweep.last * rate, np.sqrt(2) * sweep.level * rate)
        for sweep, (_, stop) in every
        if stop - sweep.stop < MARGIN_SHARE * (sweep.stop - sweep.start)
    ]
    # The noise of one sweep is what the local fit leaves, beside its leakage.
    if len(sweeps) <= n_input or not _at_rest(swept, layout, spectra.local, n_sample):
        spectra, leakage = _without_leakage(spectra, n_input, ends)
    recorded = np.repeat(np.arange(len(swept)), [len(run.cuts) for run in swept])
    parts = _parts(spectra, layout, recorded)
    if n_input == 1 and len(sweeps) > 1:
        parts = replace(
            parts,
            hits=np.swapaxes(spectra.blocks[:, :, 1:] / spectra.blocks[:, :, :1], 0, 1)[..., None],
            hit_numbers=tuple(range(1, len(sweeps) + 1)),
            hit_peaks=tuple(sweep.level for sweep in sweeps),
            hit_shares=None if np.all(filled == 1) else filled,
        )
    assert parts.multiple_coherence is not None
    rates = rate_findings(
        spectra.frequency,
        parts.matrix,
        sweeps,
        rate,
        n_sample,
        parts.multiple_coherence,
        leaking=spectra.leaking,
    )
    lines = np.rint(spectra.frequency * n_sample / rate).astype(int)
    bursts = _bursts(spectra, lines, every, layout, n_sample, rate)
    low = _low_by_noise(spectra.blocks, lines, layout, n_sample)
    what, hint = "in repeated sweeps makes H low by", "use a better sensor, or more force"
    parts = replace(parts, findings=(*_notes(swept, n_sample, rate), *leakage, *parts.findings))
    parts = without_force_noise(parts, low, layout, what, hint, taken_off=True)
    return replace(parts, findings=(*parts.findings, *bursts, *rates))


def _read_sweeps(source: SampleSource, input_columns: Sequence[int]) -> _Swept:
    samples = np.concatenate(list(checked_blocks(source)))
    try:
        sweeps = loudest_sweeps([find_sweeps(samples[:, column]) for column in input_columns if column >= 0])
    except DataError as error:
        raise DataError(f"'{source.name}': {error.what}", hint=error.hint) from None
    places = cuts(sweeps, samples.shape[0])
    widest = max(sweep.high - sweep.low for sweep in sweeps)
    whole = [n for n, sweep in enumerate(sweeps) if sweep.high - sweep.low >= WIDE * widest]
    kept, left_out = [sweeps[n] for n in whole], [s for n, s in enumerate(sweeps) if n not in whole]
    return _Swept(source.name, kept, [places[n] for n in whole], samples, left_out)


def _transforms(swept: _Swept, n_sample: int) -> ComplexArray:
    """DFT of every sweep and what follows it, (n_block, n_line, n_channel), lines above 0 Hz and below half
    the rate. What ends before *n_sample* is followed by zeros: what rings on there is leakage.
    """
    blocks = np.zeros((len(swept.cuts), n_sample, swept.samples.shape[1]))
    for block, (start, stop) in zip(blocks, swept.cuts, strict=True):
        part = swept.samples[start : min(stop, start + n_sample)]
        block[: part.shape[0]] = part - part.mean(axis=0)
    return scipy.fft.rfft(blocks, axis=1)[:, 1 : (n_sample + 1) // 2]


def _at_rest(swept: Sequence[_Swept], layout: Layout, local: LocalNoise, n_sample: int) -> bool:
    """Whether every response moves no more than noise at both ends of every block: no leakage."""
    noise = np.sqrt(np.einsum("loo->lo", local.noise).real.mean(axis=0) / n_sample)
    for number, run in enumerate(swept):
        present = [(at, column) for at, column in enumerate(layout.output_columns[number]) if column >= 0]
        half_period = int(np.ceil(0.5 / min(sweep.low for sweep in run.sweeps)))
        for start, stop in run.cuts:
            block = run.samples[start : min(stop, start + n_sample), [column for _, column in present]]
            block = block - block.mean(axis=0)
            level = np.sqrt(np.mean(block**2, axis=0))
            limit = np.minimum(AT_REST * level, NOISE_ALONE * noise[[at for at, _ in present]])
            ends = (block[:half_period], block[-half_period:])
            if any(np.any(np.sqrt(np.mean(end**2, axis=0)) > limit) for end in ends):
                return False
    return True


def _in_band(
    blocks: ComplexArray,
    filled: FloatArray,
    spacing: float,
    band: tuple[float, float],
    n_input: int,
    settings: FrfSettings,
) -> _Spectra:
    n_block, n_line, _ = blocks.shape
    # One line more than for polynomials alone makes up for the pole.
    # As wide as for one sweep of every force: each has leakage of its own.
    usual = 1 + usual_half_width(min(n_block, n_input), n_input, settings.degree)
    half_width = settings.half_width or usual
    check_half_width(half_width, n_block, n_input, settings.degree, 1)
    # Of the shortest block so many lines are independent.
    half_width = round(half_width / float(filled.min()))
    frequency = np.arange(1, n_line + 1) * spacing
    inside = lines_in(frequency, band) & lines_in(frequency, settings.band)
    inside[:half_width] = inside[n_line - half_width :] = False
    numbers = np.flatnonzero(inside)
    if numbers.size < 2 * half_width + 1:
        what = (
            f"{numbers.size} lines every {spacing:.3g} Hz lie in the swept band of "
            f"{band[0]:.6g}-{band[1]:.6g} Hz"
        )
        raise DataError(what, hint="a wider `band`, or longer sweeps")
    around = blocks[:, numbers[0] - half_width : numbers[-1] + half_width + 1]
    local = local_noise(around[:, :, :n_input], around[:, :, n_input:], settings.degree, half_width, filled)
    return _Spectra(frequency[inside], blocks[:, inside], filled, local)


def _without_leakage(
    spectra: _Spectra, n_input: int, ends: Sequence[_End]
) -> tuple[_Spectra, tuple[Finding, ...]]:
    """The spectra without the leakage of their responses where there is some, and a note on it. A sweep at
    the very end of a record looks like leakage itself: its lines keep it, in their noise.
    """
    local = spectra.local
    is_determined = np.all(local.spread < LARGEST_SPREAD, axis=(1, 2))
    leaking = _leaks(spectra.select(is_determined))
    if leaking and np.count_nonzero(is_determined) < 2:
        what = "the responses ring on at the ends of the record, and no line can be told from that"
        raise DataError(what, hint="pauses between sweeps")
    taken = is_determined & leaking
    blocks = spectra.blocks.copy()
    blocks[:, taken, n_input:] -= local.leakage[taken].swapaxes(0, 1)
    hidden = _hidden_leakage(spectra, is_determined, n_input) if leaking else 0.0
    hidden = np.maximum(hidden, _of_ends(spectra, n_input, ends)) * ~is_determined[:, None]
    spectra = replace(
        spectra,
        blocks=blocks,
        leaking=leaking,
        hidden=hidden,
        local=replace(local, spread=local.spread * taken[:, None, None]),
    )
    if not leaking:
        return spectra, ()
    message = (
        "the responses had not come to rest before a sweep, or at the end of the record: this leakage is "
        "estimated over the lines and taken out"
    )
    if not np.all(is_determined):
        message += (
            f"; on {np.count_nonzero(~is_determined)} lines swept next to its ends it cannot be told from "
            "the response, and their uncertainty holds what it may be"
        )
    return spectra, (note("sweep-leakage", message),)


def _hidden_leakage(spectra: _Spectra, is_determined: BoolArray, n_input: int) -> FloatArray:
    """Power of the leakage of lines that do not tell it: its share of the response on the nearest that do."""
    local, numbers = spectra.local, np.flatnonzero(is_determined)
    response = np.mean(np.abs(spectra.blocks[:, :, n_input:]) ** 2, axis=0)
    noise = np.einsum("loo->lo", local.noise).real[:, None] * local.spread
    excess = np.mean(np.abs(local.leakage) ** 2 - noise, axis=1)
    near = max(AROUND, numbers.size // 8)
    shares = [
        np.maximum(excess[lines].mean(axis=0), 0.0) / response[lines].mean(axis=0)
        for lines in (numbers[:near], numbers[-near:])
    ]
    is_low = np.arange(response.shape[0]) < numbers.mean()
    return np.where(is_low[:, None], *shares) * response


# The end of a sweep that ends with its block: its frequency [Hz], and its amplitude [N] by the rate [Hz].
_End = tuple[float, float]


def _of_ends(spectra: _Spectra, n_input: int, ends: Sequence[_End]) -> FloatArray:
    """Power (n_line, n_output) [unit^2] of the leakage of a steady sine that ends with the block. (H(w) -
    H(w_end)) u / 2 over w - w_end: what a response still owes to its force. Of one force only.
    """
    power = np.zeros((spectra.frequency.size, spectra.blocks.shape[2] - n_input))
    if n_input > 1:
        return power
    h = np.mean(spectra.blocks[:, :, 1:] / spectra.blocks[:, :, :1], axis=0)
    for frequency, amplitude in ends:
        away = np.abs(spectra.frequency - frequency)
        at_end = h[np.argsort(away)[: spectra.local.width]].mean(axis=0)
        # Nearer than the lines of that mean the quotient is its slope.
        away = np.maximum(away, np.sort(away)[min(spectra.local.width, away.size) - 1])
        power += np.abs(h - at_end) ** 2 * (amplitude / 2 / (2 * np.pi * away[:, None])) ** 2
    return power / max(len(ends), 1)


def _leaks(spectra: _Spectra) -> bool:
    local = spectra.local
    n_line, n_block, _ = local.leakage.shape
    if n_line == 0:
        return True
    noise = np.einsum("loo->lo", local.noise).real[:, None, :] * local.spread
    power = np.abs(local.leakage) ** 2
    ratio = np.divide(power, noise, out=np.where(power > 0, np.inf, 0.0), where=noise > 0)
    # A ratio of two estimates of the noise: F, with 2 and 2 dof degrees of freedom; lines within a window
    # share theirs.
    mean = np.mean(ratio, axis=(0, 1)) * (local.dof - 1) / local.dof
    error = np.sqrt(2.0 * local.width / (n_line * n_block))
    return bool(np.any(mean > max(LEAKING, 1 + SURELY * error)))


def _parts(spectra: _Spectra, layout: Layout, recorded: IntArray) -> Parts:
    """The FRF by least squares over blocks, of recordings with the numbers *recorded* (n_block,)."""
    n_input, n_block, local = len(layout.inputs), len(spectra.blocks), spectra.local
    filled = spectra.filled
    channels = spectra.blocks.transpose(1, 2, 0)
    forces, responses = channels[:, :n_input], channels[:, n_input:]
    inverse = force_inverse(forces, layout)
    matrix = responses @ inverse
    # Of noise s (n_block,) beside what is common to all (free - 2 shared diag(P) + shared |P|^2) s is left.
    projection = inverse @ forces
    leverage = np.einsum("lbb->lb", projection).real
    shared = (local.free.sum() - local.dof) / n_input
    remaining = np.diag(local.free - 2 * shared * leverage.mean(axis=0))
    remaining += shared * np.mean(abs(projection) ** 2, axis=0)
    of_blocks = np.linalg.solve(remaining, local.of_blocks) * (local.dof * filled / filled.sum())[:, None]
    # Blocks by their recording, and the force that is at its strongest.
    size = np.mean(np.abs(forces) ** 2, axis=0)
    strongest = np.argmax(size / np.max(size, axis=1, keepdims=True), axis=0)
    groups = np.unique(n_input * recorded + strongest, return_inverse=True)[1]
    blocks_of = np.eye(groups.max() + 1)[groups]
    levels = noise_levels(
        of_blocks.swapaxes(1, 2) @ blocks_of, filled @ blocks_of / filled.sum() * local.dof / local.width
    )
    noise, per_line, width = _noise(spectra, responses - matrix @ forces, n_input)
    if n_block > n_input:
        scale = np.sqrt((n_block - n_input) / (((1 - leverage) * filled) @ blocks_of @ levels.T))
        noise, per_line = noise * scale[:, :, None] * scale[:, None, :], per_line * float(filled.mean())
    half_width = next(n for n in range(1000) if per_line * _n_averaged_lines(width, n) >= ENOUGH_DOF)
    noise = pooled_residual(noise, matrix, half_width)
    if spectra.hidden is not None:
        # As a rule alike in all sweeps: more of them do not average it.
        noise = noise + n_block / n_input * spectra.hidden[:, :, None] * np.eye(matrix.shape[1])
    noisy = filled[:, None] * blocks_of
    spread = np.einsum("lbi,lbj,be->leij", inverse, inverse.conj(), noisy, optimize=True)
    covariance = covariance_of_parts(noise, spread, levels)
    weights = np.mean(np.abs(inverse) ** 2, axis=0).T * filled * (blocks_of @ levels.mean(axis=0))
    correlation, gains = _shared_lines(filled, weights, matrix.shape)
    power: FloatArray = np.mean(np.abs(responses) ** 2, axis=2)
    noise_power = np.einsum("loo->lo", noise).real * filled.mean()
    coherence: FloatArray = np.clip(
        1 - np.divide(noise_power, power, out=np.ones_like(power), where=power > 0), 0.0, 1.0
    )
    return Parts(
        frequency=spectra.frequency,
        matrix=matrix,
        covariance=covariance,
        averages=1 + per_line,
        dof=per_line * min(_n_averaged_lines(width, half_width), spectra.frequency.size),
        findings=coherence_findings(coherence, power, layout),
        coherence=coherence[:, :, None] if n_input == 1 else None,
        multiple_coherence=coherence,
        line_correlation=correlation,
        line_gains=gains,
    )


def _shared_lines(
    filled: FloatArray, weights: FloatArray, shape: tuple[int, ...]
) -> tuple[tuple[complex, ...], ComplexArray | None]:
    """Correlation and gains of lines, as of Parts, of noise in *filled* (n_block,) [1] of every block: white
    in time there, zero after. *weights* (n_input, n_block): shares of the blocks in the noise of the FRFs of
    every force; *shape* of the matrix.
    """
    if np.all(filled == 1):
        return (), None
    time, number = (np.arange(TIMES) + 0.5) / TIMES - 0.5, np.arange(FURTHEST + 1)
    of_force = weights / weights.sum(axis=1, keepdims=True) / filled @ (np.abs(time) < filled[:, None] / 2)
    whole, waves = of_force.mean(axis=0), np.cos(2 * np.pi * time[:, None] * number) / TIMES
    correlation = tuple(complex(value) for value in (whole @ waves)[1:])
    if len(weights) == 1:
        return correlation, None
    half = np.sqrt(of_force / whole) @ waves
    gains = np.concatenate([half[:, :0:-1], half], axis=1)
    size = TIMES * (half * np.where(number, 2, 1)) @ waves.T
    gains /= np.sqrt(np.mean(size**2 * whole, axis=1))[:, None]
    shape = shape[0], gains.shape[1], *shape[1:]
    return correlation, np.broadcast_to(gains.T[:, None], shape).astype(np.complex128)


def _noise(spectra: _Spectra, residual: ComplexArray, n_input: int) -> tuple[ComplexArray, float, int]:
    """Noise (n_line, n_output, n_output) [unit^2] of the responses in one block, its complex degrees of
    freedom per line, lines it is of. residual (n_line, n_output, n_block) [unit] beside the common FRF:
    nothing is left of it with no more sweeps than forces.
    """
    n_block, local = spectra.blocks.shape[0], spectra.local
    if n_block <= n_input:
        return local.noise, local.dof / local.width, local.width
    # What was taken out as leakage holds its share of the noise.
    dof = (n_block - n_input) * (1 - float(np.mean(local.spread)) if spectra.leaking else 1.0)
    return residual @ hermitian(residual) / dof, dof, 1


def _bursts(
    spectra: _Spectra,
    lines: IntArray,
    sweeps: list[tuple[FoundSweep, tuple[int, int]]],
    layout: Layout,
    n_sample: int,
    rate: float,
) -> tuple[Finding, ...]:
    """A warning where most of what one force leaves comes in one short part of a sweep, as from a contact."""
    force, responses = spectra.blocks[:, :, 0], spectra.blocks[:, :, 1:]
    noise = spectra.blocks.shape[0] * np.einsum("loo->o", spectra.local.noise).real
    window = 2 * spectra.local.width + 1
    if len(layout.inputs) > 1 or spectra.frequency.size < window:
        return ()
    noisy = np.flatnonzero(noise > LEAST_NOISE * np.sum(np.abs(responses) ** 2, axis=(0, 1)))
    if not noisy.size:
        return ()
    responses, noise = responses[:, :, noisy], noise[noisy]
    ratio = np.einsum("blo,bl->lo", responses, force.conj()) / np.sum(np.abs(force) ** 2, axis=0)[:, None]
    smooth = partial(scipy.signal.savgol_filter, window_length=window, polyorder=3, axis=0)
    rest = responses - (smooth(ratio.real) + 1j * smooth(ratio.imag)) * force[:, :, None]
    # Beside a sharp resonance a smooth FRF leaves more than noise.
    excess = np.sum(np.abs(rest) ** 2, axis=(0, 1)) / noise
    spectrum = np.zeros((rest.shape[0], n_sample // 2 + 1, rest.shape[2]), np.complex128)
    spectrum[:, lines] = rest
    length = n_sample // PARTS
    motion = scipy.fft.irfft(spectrum, n=n_sample, axis=1)[:, : PARTS * length]
    power = np.sum(motion.reshape(rest.shape[0], PARTS, length, -1) ** 2, axis=2)
    share = power / np.sum(power, axis=1, keepdims=True)
    share[(power < BURST_POWER * np.median(power, axis=1, keepdims=True)) | (excess > MOST_EXCESS)] = 0.0
    block, part, output = np.unravel_index(np.argmax(share), share.shape)
    if share[block, part, output] < BURST_SHARE:
        return ()
    sweep, (begin, _) = sweeps[block]
    ends = [begin + int(part + n) * length for n in range(2)]
    low, high = sorted(rate * sweep.frequency_at(end) for end in ends)
    label, percent = layout.outputs[noisy[output]].label, 100 * share[block, part, output]
    what = (
        f"response {label}: {percent:.0f} % of the power that the force does not explain comes from "
        f"{ends[0] / rate:.4g} to {ends[1] / rate:.4g} s, while the force passes {low:.3g} to {high:.3g} Hz: "
        "a contact, a knock or a limit reached there makes other frequencies ring, and hides their "
        "resonances; lower the force there, or sweep the others alone"
    )
    return (Finding("burst", what),)


def _low_by_noise(blocks: ComplexArray, lines: IntArray, layout: Layout, n_sample: int) -> list[FloatArray]:
    """How low least squares make H by noise n in the power s + n of a recording's force, (n_line,) [1] each:
    (1 - 1 / n_block) n / (s + n). Repeated sweeps, alike but for a delay by the correlation of their forces,
    one of them backwards in time if it falls where the other rises, have the coherence s / (s + n) over lines
    around; 0 without any, and where several forces act.
    """
    forces = blocks[:, :, : len(layout.inputs)]
    size, every = np.sum(np.abs(forces) ** 2, axis=1), np.ones(lines.size, bool)
    low: dict[int, FloatArray] = {}
    for force, of_force in enumerate((size == size.sum(axis=1, keepdims=True)).T):
        pairs = itertools.combinations(np.flatnonzero(of_force), 2)
        of_pairs = []
        for pair in itertools.islice(pairs, MOST_PAIRS):
            u, v = forces[list(pair), :, force]
            cross = np.zeros((2, n_sample), np.complex128)
            cross[:, lines] = u * v.conj(), u * v
            correlation = n_sample * np.abs(scipy.fft.ifft(cross))
            way, late = np.unravel_index(np.argmax(correlation), correlation.shape)
            # Sweeps of other speeds share no more than a part of their lines at any delay.
            if correlation[way, late] < REPEATED * np.linalg.norm(u) * np.linalg.norm(v):
                continue
            cross = cross[way, lines] * np.exp(2j * np.pi * lines * late / n_sample)
            means = (neighbourhood_mean(x, every, COHERENT) for x in (cross, np.abs(u) ** 2, np.abs(v) ** 2))
            shared, one, other = means
            of_pairs.append(1 - np.abs(shared) / np.sqrt(one * other))
        if of_pairs:
            low[force] = np.mean(of_pairs, axis=0) * (1 - 1 / np.count_nonzero(of_force))
    nothing = np.zeros(lines.size)
    return [low.get(force, nothing) for force in layout.acting]


def _n_averaged_lines(width: int, half_width: int) -> float:
    """Independent lines among 2 *half_width* + 1 values that are each of *width* lines."""
    weights = np.convolve(np.ones(width), np.ones(2 * half_width + 1))
    return float(np.sum(weights) ** 2 / np.sum(weights**2))


def _notes(swept: Sequence[_Swept], n_sample: int, rate: float) -> tuple[Finding, ...]:
    notes = []
    for run in swept:
        bands = ", ".join(f"{sweep.low * rate:.3g}-{sweep.high * rate:.3g} Hz" for sweep in run.left_out)
        message = (
            f"'{run.name}': {len(run.sweeps)} sweep(s): "
            f"{'; '.join(dict.fromkeys(_description(sweep, rate) for sweep in run.sweeps))}; "
            f"{n_sample / rate:.4g} s of each with what follows it are transformed, lines every "
            f"{rate / n_sample:.3g} Hz{bands and f'; left out, since the record cuts it: {bands}'}"
        )
        notes.append(note("sweeps", message))
    return tuple(notes)


def _description(sweep: FoundSweep, rate: float) -> str:
    speed = (
        f"{sweep.growth * rate**2:.3g} Hz/s"
        if sweep.law == "linear"
        else f"{sweep.growth * rate / np.log(2) * 60:.3g} octaves/min"
    )
    return f"{sweep.first * rate:.3g} to {sweep.last * rate:.3g} Hz, {sweep.law}, {speed}"
