"""Is the loop closed? Whether a force is fed back from the response, from the records alone, where no
reference was named. Random data: by the impulse response before the force (Haugh, J. Am. Stat. Assoc. 71,
1976: lags of either sign). Periodic data: by S_wu / G, w = y - G u of what does not repeat, which is complex.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft, linalg, special

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.spectra.bands import MAINS
from labpipe.spectra.channels import checked_blocks
from labpipe.spectra.matrices import definite_inverse, product
from labpipe.spectra.period_average import LineSpectrum
from labpipe.spectra.ports import Layout

BIASED = "The FRF is biased towards minus the inverse of the controller by an amount that cannot be known"
WEIGHTED = (
    "Without its reference the lines are chosen and weighted by a force whose noise is that of the response, "
    "so that fits are biased by an amount that cannot be known"
)
# Chance of a false alarm that is taken, over all pairs of force and response.
LEVEL = 1e-3
# Chance from which a reference that is moved forward is in order: far above that of a feedback hardly seen.
IN_ORDER = 0.05
# Most samples of a recording that are looked at, and fewest that tell anything.
MOST_SAMPLES, FEWEST_SAMPLES = 1 << 15, 1 << 10
# Fewest lines of the whole record in the excited band.
FEWEST_LINES = 1000
# Lags before the force that are tested, in intervals of 1 / (2 f), f the upper edge of the excited band: the
# nearest belong to that edge.
LAGS = range(2, 21)
# Share of its peak that an impulse response may have before the force by leakage, or sensors that differ.
FLOOR = 0.03
# Share of the band above which what is in quadrature is that of its upper edge, as the accelerance of an
# infinite plate is, j w / (8 sqrt(B m)) (Cremer and Heckl, Structure-Borne Sound, 1988), and how well it is
# known: tried .5, 1 and 2, of which 1 tells all loops and calls no plate one.
EDGE, UNSURE = 0.8, 1.0
# Share of the record over which it fades at its ends.
ENDS = 0.1
# Samples of a short piece of a record; times their median up to which mean squares are silent between hits;
# times the noise's standard deviation that hits reach; times its power down to which hits excite.
PIECE, SILENT, STRUCK, CLEAR = 64, 3.0, 10.0, 4.0
# Noise of a force over the force, below which it is rounding of a computed one.
ROUNDED = 1e-10
# Lines to either side over which spectra are averaged, order of the filter that takes resonances out.
HALF_WIDTH, ORDER = 12, 20
# The excited band ends where the force's power falls to the first share within a quarter more frequency, but
# for one coherent with the response, or to the third share of its peak; that strongly excited to the fourth.
CLIFF, CLIFF_WIDTH, DARK, DIM, COHERENT = 0.1, 1.25, 1e-4, 0.03, 0.9
COARSE_BANDS, LOG_BANDS = 200, 60
# Least share of the lines that the strongly excited band must have of the others.
LEAST_SHARE = 0.1
# Added to the power of forces of unit level, so that forces that are one can be told apart from none.
RIDGE = 1e-9
# Times the median of the noise from which hum stands out, and times its reach that it is left out.
OUTSTANDING, REACH = 2.0, 3.0
# First over last line above which too much of the band is missing below it to tell of lags.
LOWEST_EDGE = 0.15


def feedback_of_records(
    sources: Sequence[SampleSource], reference: Sequence[str], forces: Sequence[str], responses: Sequence[str]
) -> tuple[Finding, ...]:
    """A warning where *responses* come before the *forces* that should make them, or before what is named as
    the *reference*, all by their channels' names. None for records too short, or excited in a narrow band, to
    tell. Only the first MOST_SAMPLES of a recording are looked at. A reference that was recorded late, with
    which all is in order once it is moved forward, is the warning `reference-lag` instead.
    """
    chances: dict[str, float] = {}
    late: dict[str, float] = {}
    for source in sources:
        samples, names = _first_samples(source), [channel.name for channel in source.channels]
        references, acting, rows = (
            [names.index(name) for name in dict.fromkeys(some) if name in names]
            for some in (reference, forces, responses)
        )
        driving = [n for n in references or acting if np.any(samples[:, n] != samples[0, n])]
        if not driving or not rows or samples.shape[0] < FEWEST_SAMPLES:
            continue
        name, lag = ", ".join(names[column] for column in driving), 0
        before, after = samples[:, driving], samples[:, rows]
        chance = min(chance_of_order(before, after) * len(sources), 1.0)
        if references and acting and chance < LEVEL:
            lag = lag_of_reference(before, samples[:, acting], after)
        if lag:
            late[name] = lag / source.sample_rate
        else:
            chances[name] = min(chance, chances.get(name, 1.0))
    lags = (
        Finding(
            "reference-lag",
            f"the reference {name} lags by {1e3 * lag:.3g} ms: forces and responses precede it, and follow "
            f"it once it is moved forward. State `delay: {1e3 * lag:.3g} ms` of that channel, or record "
            "all on one clock; blocks must be long beside the lag, since their ends tear the reference from "
            "what it moves",
        )
        for name, lag in late.items()
    )
    return (*_findings(chances, reference), *lags)


def lag_of_reference(references: FloatArray, forces: FloatArray, responses: FloatArray) -> int:
    """Samples [1] by which *references* (n_sample, n_reference) [SI] were recorded later than they act; 0
    where the order tells nothing or a lag does not explain it. What is injected acts on the *forces*
    (n_sample, n_force) at once, by the sum that it is added to: the highest correlation gives the lag. Moved
    forward by it a reference from outside comes before the forces and the *responses* (n_sample, n_response);
    one that the loop makes does not. Equation (frf-lag).
    """
    if chance_of_order(references, forces) >= LEVEL:
        return 0
    n = references.shape[0]
    taper = _tukey(n)[:, None]
    driving, driven = (fft.rfft(part * taper, axis=0) for part in (references, forces))
    power = _average(np.abs(driving) ** 2).real
    weight = np.where(power > DARK * np.max(power, axis=0), 1 / np.maximum(power, np.finfo(float).tiny), 0.0)
    crossed = np.abs(
        fft.irfft(driven[:, :, None] * (driving.conj() * weight)[:, None, :], n, axis=0).reshape(n, -1)
    )
    place = int(np.argmax(np.max(crossed / np.max(crossed, axis=0), axis=1) * (np.arange(n) > n // 2)))
    lag = n - place
    if lag > n // 2 or np.max(crossed[place] / np.max(crossed, axis=0)) < 1:
        return 0
    others = np.column_stack([forces, responses])[:-lag]
    return lag if chance_of_order(references[lag:], others) >= IN_ORDER else 0


def _findings(chances: dict[str, float], reference: Sequence[str], what: str = BIASED) -> tuple[Finding, ...]:
    named = min(chances, key=lambda name: chances[name], default="")
    if not chances or chances[named] >= LEVEL:
        return ()
    p_text = f"p < {LEVEL / 1e4:.0e}" if chances[named] < LEVEL / 1e4 else f"p = {chances[named]:.1g}"
    follows = f"follows the responses ({p_text})"
    if reference:
        message = (
            f"the loop is closed around the reference {named} too: it {follows}, so it does not open the "
            f"loop. {what}. Name what is injected from outside, as it leaves the generator"
        )
    else:
        force = named if named == "force" else f"force {named}"
        message = (
            f"the loop is closed: the {force} {follows}, as of a levitated rotor, under a controller, or "
            f"where the motion is what is driven. {what}, and coherence does not show it. Record what is "
            "injected into the loop, with role: reference, and name it: `frf: {reference: ...}`"
        )
    return (Finding("feedback", message),)


def _first_samples(source: SampleSource) -> FloatArray:
    pieces: list[FloatArray] = []
    for block in checked_blocks(source):
        pieces.append(block)
        if sum(piece.shape[0] for piece in pieces) >= MOST_SAMPLES:
            break
    return np.concatenate(pieces)[:MOST_SAMPLES]


def chance_of_order(forces: FloatArray, responses: FloatArray) -> float:
    """p-value [1] of the part of the impulse responses before the *forces* (n_sample, n_input) in *responses*
    (n_sample, n_output) [SI]. For the worst of all pairs in two bands, all that is excited and what is
    excited most (Bonferroni); 1 where these tell nothing.
    """
    n_input = forces.shape[1]
    # Lines are last in memory, as everywhere below.
    both = np.vstack([forces.T, responses.T])
    both = both - np.mean(both, axis=1, keepdims=True)
    taper = _tukey(both.shape[1])
    spectra = fft.rfft(both * taper)[:, 1:]
    spectra = spectra[np.any(spectra != 0, axis=1)].T
    noise = _noise_of_hits(both, n_input) * np.sum(taper**2)
    scale = float(np.sum(taper**4) * taper.size / np.sum(taper**2) ** 2)
    # Bands tell of lags where there are enough lines, and not the lower part of the band is missing.
    bands = dict.fromkeys(
        (first, last)
        for first, last in _excited_bands(spectra[:, :n_input], spectra[:, n_input:], noise)
        if last >= FEWEST_LINES and first <= LOWEST_EDGE * last
    )
    chances = [p_value for band in bands for p_value in _chances_in(spectra, n_input, band, scale)]
    return float(min(min(chances) * len(chances), 1.0)) if chances else 1.0


def _chances_in(spectra: ComplexArray, n_input: int, band: tuple[int, int], scale: float) -> list[float]:
    """p-values of all pairs in lines first ... last; *scale*: what the taper raises variances by."""
    first, last = band
    u, y = spectra[:last, :n_input], spectra[:last, n_input:]
    w = np.pi * np.arange(1, last + 1) / last
    fade = _fade(w, first)
    degree = 1 + int(np.ceil(2 * len(LAGS) * first / last))
    level, size = _level(u), np.sqrt(np.mean(np.abs(u) ** 2, axis=0))
    u = u / level
    inverted, _ = definite_inverse(_average(u[:, :, None] * u[:, None, :].conj()) + RIDGE * np.eye(n_input))
    spread = np.maximum(np.einsum("lii->li", inverted).real, 0.0) / level**2
    free = (2 * HALF_WIDTH + 1) / max(2 * HALF_WIDTH + 1 - n_input, 1)
    chances = []
    for output in y.T:
        crossed = output[:, None] * u.conj()
        s_yu, power = _average(crossed), _average(np.abs(output) ** 2).real
        response = product(s_yu[:, None, :], inverted)[:, 0]
        noise = np.maximum(power - np.sum(response * s_yu.conj(), axis=1).real, 0.0) * free
        white = fade * _whitening(power)
        at_once, edge = 1j * w * white, w > EDGE * np.pi
        raw = white[:, None] * product(crossed[:, None, :], inverted)[:, 0] / level * size
        impulse = _at_lags(raw, 2 * raw.shape[0]).real
        # What is in quadrature at the upper edge, as the accelerance of a plate where it is struck, reaches
        # before the force once the band is cut there: its lags are taken off, known to UNSURE of their size.
        reach = np.sum((raw[edge] * at_once[edge, None].conj()).real, axis=0) / np.sum(
            np.abs(at_once[edge]) ** 2
        )
        leaving = reach * _at_lags(at_once, LAGS.stop).real[:, None]
        before = impulse[: LAGS.stop] - leaving
        after = impulse[-np.arange(LAGS.stop)]
        # What one force leaves of another's spectrum is small against the larger of their effects.
        floor = FLOOR * float(np.max(np.abs(after)))
        variance = scale * (np.abs(white) ** 2 * noise)[:, None] * spread * size**2
        unsure = UNSURE * leaving
        chances += [
            _chance_of_lags(before[:, i], variance[:, i], floor, degree, unsure[:, i]) for i in range(n_input)
        ]
    return chances


def _fade(w: FloatArray, first: int) -> FloatArray:
    """Weights of lines at *w*: in from line *first* to twice that, out over all of the band, so that an
    accelerance or a stiffness reaches one lag before the force and no further.
    """
    rising = np.clip(np.arange(w.size) / max(first, 1) - 1, 0.0, 1.0) if first else np.ones(w.size)
    return 0.25 * (1 + np.cos(w)) * (1 - np.cos(np.pi * rising))


def _level(u: ComplexArray) -> FloatArray:
    """Amplitude (n_line, n) over bands of equal ratio: divided by it a steep spectrum is flat."""
    n = u.shape[0]
    edges = np.unique(np.round(np.geomspace(1, n + 1, LOG_BANDS)).astype(int)) - 1
    power = np.add.reduceat(np.abs(u) ** 2, edges[:-1], axis=0) / np.diff(edges)[:, None]
    power = np.maximum(power, np.finfo(float).eps ** 2 * np.max(power, axis=0))
    middle, lines = np.log((edges[1:] + edges[:-1] + 1) / 2), np.log(np.arange(1, n + 1))
    return np.exp(0.5 * np.column_stack([np.interp(lines, middle, column) for column in np.log(power).T]))


def _chance_of_lags(
    lags: FloatArray, variance: FloatArray, floor: float, degree: int, unsure: FloatArray
) -> float:
    """p-value of the *lags* before 0 by an FRF's *variance* (n_line,) and what they are *unsure* by (n_lag,)
    together, but for a slow curve of a *degree*.
    """
    before = np.array(LAGS)
    lags = lags[LAGS.start :]
    covariance = linalg.toeplitz(_at_lags(variance, before.size).real / 2)
    covariance = covariance + np.eye(before.size) * floor**2
    covariance = covariance + np.outer(unsure[LAGS.start :], unsure[LAGS.start :])
    lower = np.linalg.cholesky(covariance)
    white = np.linalg.solve(lower, lags)
    # What lies below the lowest excited line is missing on both sides, as a slow curve.
    place = np.linspace(-1, 1, before.size)
    slow = np.linalg.qr(np.linalg.solve(lower, np.polynomial.legendre.legvander(place, degree)))[0]
    white = white - slow @ (slow.T @ white)
    return float(special.chdtrc(before.size - slow.shape[1], white @ white))


def _noise_of_hits(both: FloatArray, n_input: int) -> FloatArray:
    """Power by sample (n_line, n_input) [SI] of the noise of hits, the first of the signals *both*
    (n_signal, n_sample) [SI], between them: what no response is coherent with. 0 of other forces.
    """
    window, n = np.hanning(PIECE + 2)[1:-1], both.shape[1]
    pieces = both[:, : n // PIECE * PIECE].reshape(both.shape[0], -1, PIECE)
    noise = np.zeros((n // 2, n_input))
    for i, force in enumerate(pieces[:n_input]):
        square = np.mean(force**2, axis=1)
        silent = square <= SILENT * np.median(square)
        if np.max(np.abs(force)) > STRUCK * np.sqrt(np.mean(square[silent])):
            parts = fft.rfft(pieces[:, silent] * window)
            power = np.mean(np.abs(parts) ** 2, axis=1)
            crossed = np.abs(np.mean(parts[n_input:] * parts[i].conj(), axis=1)) ** 2
            coherent = np.max(crossed / np.maximum(power[n_input:], np.finfo(float).tiny), axis=0)
            alone = (power[i] - coherent) / np.sum(window**2)
            noise[:, i] = np.interp(np.arange(1, n // 2 + 1) / n, np.arange(alone.size) / PIECE, alone)
    return noise


def _excited_bands(u: ComplexArray, y: ComplexArray, noise: FloatArray) -> list[tuple[int, int]]:
    n = u.shape[0]
    edges = np.unique(np.linspace(0, n, COARSE_BANDS + 1).astype(int))
    coarse = np.add.reduceat(np.abs(u) ** 2, edges[:-1], axis=0) / np.diff(edges)[:, None]
    # Beyond, H1 falls with the force's share of its spectrum, and what is even in time comes before as after.
    above = np.arange(coarse.shape[0])[:, None] > np.argmax(coarse, axis=0)
    coarse[above & (coarse < CLEAR * noise[edges[:-1]])] = 0.0
    coarse = coarse / np.maximum(np.max(coarse, axis=0), np.finfo(float).tiny)
    coherence = np.add.reduceat(_largest_coherence(u, y), edges[:-1]) / np.diff(edges)
    bands = []
    lower, upper = edges_of(coarse, coherence)
    for dark in (DARK, DIM):
        lit = np.all(coarse > dark, axis=1)
        lit[:lower], lit[upper:] = False, False
        if np.any(lit):
            bands.append((int(edges[np.argmax(lit)]), int(edges[lit.size - np.argmax(lit[::-1])])))
    # A sliver at the foot of a steep spectrum tells nothing.
    return [band for band in bands if band[1] > LEAST_SHARE * bands[0][1]]


def edges_of(coarse: FloatArray, coherence: FloatArray) -> tuple[int, int]:
    """First of the *coarse* bands (n_band, n_input) [1] of a *coherence* (n_band,) [1], and first above,
    between cliffs in the power of a force.
    """
    first, last = 0, coarse.shape[0]
    here = np.arange(last)[:, None]
    other = here.T
    above = (other > here) & (other <= np.ceil(CLIFF_WIDTH * (here + 0.5)))
    below = (other < here) & (other >= ((here + 0.5) / CLIFF_WIDTH).astype(int) - 1)
    for column in coarse.T:
        strongest = int(np.argmax(column))
        # A row per band, and in it those at which the power has fallen.
        fallen = (column < CLIFF * column[:, None]) & (coherence < COHERENT)
        ends = np.flatnonzero(np.any(fallen & above, axis=1)[strongest : last - 1])
        if ends.size:
            last = min(last, int(np.argmax((fallen & above)[strongest + ends[0]])))
        begins = np.flatnonzero(np.any(fallen & below, axis=1)[first + 1 : strongest + 1])
        if begins.size:
            first = max(first, 1 + int(np.flatnonzero((fallen & below)[first + 1 + begins[-1]])[-1]))
    return first, last


def _largest_coherence(u: ComplexArray, y: ComplexArray) -> FloatArray:
    force, largest, conjugate = _average(np.abs(u) ** 2).real, np.zeros(u.shape[0]), u.conj()
    for output in y.T:
        # One response at a time stays in the cache.
        crossed = np.abs(_average(output[:, None] * conjugate)) ** 2
        power = _average(np.abs(output) ** 2).real[:, None] * force
        share = np.divide(crossed, power, out=np.zeros_like(crossed), where=power > 0)
        np.maximum(largest, np.max(share, axis=1), out=largest)
    return largest


def _average(values: ComplexArray | FloatArray) -> ComplexArray:
    rows = np.moveaxis(values, 0, -1)
    number = np.arange(rows.shape[-1])
    count = np.minimum(number, HALF_WIDTH) + np.minimum(number[::-1], HALF_WIDTH) + 1
    total = np.empty((*rows.shape[:-1], number.size + 2 * HALF_WIDTH + 1), rows.dtype)
    total[..., : HALF_WIDTH + 1] = 0.0
    np.cumsum(rows, axis=-1, out=total[..., HALF_WIDTH + 1 : HALF_WIDTH + 1 + number.size])
    total[..., HALF_WIDTH + 1 + number.size :] = total[..., HALF_WIDTH + number.size, None]
    mean = total[..., 2 * HALF_WIDTH + 1 :] - total[..., : number.size]
    mean /= count
    return np.moveaxis(mean, -1, 0)


def _whitening(power: FloatArray) -> ComplexArray:
    """A(w) = 1 - sum a_k e^{-j w k} (n_line,) of a signal's autoregression: causal, as its inverse."""
    covariance = _at_lags(power, ORDER + 1).real
    covariance[0] *= 1 + 1e-4
    coefficients = linalg.solve_toeplitz(covariance[:-1], covariance[1:])
    return fft.rfft(np.concatenate([[1.0], -coefficients]), 2 * power.size)[1:]


def _at_lags(values: ComplexArray | FloatArray, number: int) -> ComplexArray:
    """Sum over lines k = 1 ... n of values (n, ...) times e^{-j pi k t / n}, t = 0 ... *number* - 1."""
    n = values.shape[0]
    padded = np.concatenate([np.zeros((1, *values.shape[1:])), values])
    transform = fft.fft if np.iscomplexobj(padded) else fft.rfft
    return transform(padded, 2 * n, axis=0)[:number]


def _tukey(n: int) -> FloatArray:
    """1 with cosine ends, each ENDS / 2 of the record, (n,)."""
    place = np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) / (ENDS / 2 * n)
    return np.where(place < 1, 0.5 * (1 - np.cos(np.pi * np.minimum(place, 1.0))), 1.0)


def feedback_of_periods(
    spectra: Sequence[LineSpectrum], matrix: ComplexArray, inverse: ComplexArray, layout: Layout
) -> tuple[Finding, ...]:
    """A warning where what does not repeat from period to period is fed back; *spectra* at the lines of H =
    *matrix* (n_line, n_o, n_i), responses times the *inverse* (n_line, n_run, n_i) of the forces. In SI units
    [SI]; the noise of *spectra* must be that of single lines, not smoothed.
    """
    chances: dict[str, float] = {}
    n_input = len(layout.inputs)
    gain = np.sum(np.abs(inverse) ** 2, axis=1)
    for number, spectrum in enumerate(spectra):
        if spectrum.noise is None or spectrum.dof < 2:
            continue
        noise = layout.pad(number, spectrum.noise, 2)
        for force in range(n_input):
            clear = ~lines_of_hum(spectrum.frequency, noise[:, force, force].real)
            values = [
                chance_of_phase(
                    noise[clear][:, [force, n_input + o]][:, :, [force, n_input + o]],
                    matrix[clear, o, force],
                    gain[clear, force],
                    spectrum.dof,
                )
                # A sensor in force and response gives both its noise: no controller is needed.
                for o, sensor in enumerate(layout.output_sensors)
                if not sensor.sensors & layout.input_sensors[force].sensors
            ]
            name = layout.inputs[force].label
            if not values:
                continue
            chances[name] = min(min(values) * len(values) * n_input * len(spectra), chances.get(name, 1.0))
    return _findings(chances, (), WEIGHTED)


def lines_of_hum(frequency: FloatArray, variance: FloatArray) -> BoolArray:
    """Lines (n_line,) of a *frequency* [Hz] beside a multiple of the mains whose hum stands out of the
    *variance* (n_line,) [SI] of the noise: hum in the sensors of force and response looks as if one followed
    the other. It falls as 1 / distance^2 and is left out to REACH times where it stands out.
    """
    loud, hum = variance > OUTSTANDING * np.median(variance), np.zeros(frequency.shape, bool)
    for base in MAINS:
        for multiple in np.arange(base, frequency.max(initial=0.0) + base, base):
            away = np.abs(frequency - multiple)
            order = np.argsort(away)
            here = order[: int(np.argmin(np.append(loud[order], False)))]
            hum |= away <= REACH * away[here].max(initial=0.0)
    return hum


def chance_of_phase(noise: ComplexArray, response: ComplexArray, gain: FloatArray, dof: float) -> float:
    """p-value [1] that S_wu / G, w = y - G u, is real: *noise* (n_line, 2, 2) [SI] of u and y in their means,
    G = *response* (n_line,) [SI], which follows from the response by the square root of *gain* (n_line,)
    [1/SI^2], 1 / |u|^2 of one force. By line a t test of *dof* complex degrees of freedom, over all lines the
    sum of ln p (Fisher). Equation (frf-feedback).
    """
    s_uu, s_yu, s_yy = noise[:, 0, 0].real, noise[:, 1, 0], noise[:, 1, 1].real
    s_wu = s_yu - response * s_uu
    s_ww = s_yy - 2 * (response.conj() * s_yu).real + np.abs(response) ** 2 * s_uu
    measured = (s_uu * gain > ROUNDED**2) | (gain == 0)
    there = measured & (s_uu > 0) & (s_ww > 0) & (np.abs(response) > 0)
    if not np.any(there):
        return 1.0
    s_uu, s_wu, s_ww, response = s_uu[there], s_wu[there], s_ww[there], response[there]
    turned = (s_wu * response.conj()).imag / np.abs(response)
    rest = np.maximum(s_ww - np.abs(s_wu) ** 2 / s_uu, np.finfo(float).tiny)
    free = 2 * dof - 2
    square = free * turned**2 / s_uu / rest / (1 + dof * s_uu * gain[there])
    chance = np.maximum(2 * special.stdtr(free, -np.sqrt(square)), np.finfo(float).tiny)
    return float(special.chdtrc(2 * chance.size, -2 * np.sum(np.log(chance))))
