"""A run-up judged: slow roll, critical speeds with amplification factors and separation margins (those of API
617 and 684 of labpipe.methods.rotor.theory), sensitivity to a stated unbalance, each by its interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.methods.rotor.theory import KEPT, UNDECIDED, Critical, decision
from labpipe.methods.run_ups.measured import check_moving, rational_fit
from labpipe.spectra.orders import OrderTrack

# Draws of the readings' noise, and their seed; speeds on which the curve through them is looked at.
DRAWS, SEED, FINE = 200, 20261126, 2000
# Stiffnesses of smoothing that are tried, for speeds from 0 to 1 and weights of mean 1.
STIFFNESSES = np.geomspace(1e-12, 1.0, 37)
# A peak rises this many standard uncertainties, and this share of the largest amplitude, above its dips.
CLEAR, SMALL = 8.0, 0.05
# Fewest speeds for a curve, and in the band of the slow roll.
FEWEST, FEWEST_SLOW = 12, 4
# Standard size of what damping adds to the rise of slow speeds, twice the damping ratio, as a share of it.
TURNED = 0.3
# What half as many readings change is at least so many times the error of a cubic spline through all of them.
HALVED = 8.0
# Half-power widths beside the half-power speeds in which one mode is fitted, fewest readings and largest
# chi-square per datum there; points of its curve.
BESIDE, ENOUGH, FITS, POINTS = 1.5, 10, 2.0, 801
# The most that is asked for above the speed range.
MOST_ABOVE = 0.26
# (df/dt) (AF / f)^2, time of ringing over that in the half-power width (times pi), up to which a peak
# is that of a steady rotor.
STEADY = 0.2
# Of one mode (AF 5 to 40) run up and down to that limit: what is left of the delay of its peak, as a share of
# it, and what its half-power width changes by, as a share of that quotient, and its amplitude, as one of its
# square. Standard uncertainties.
LATE, WIDER, LOWER = 0.1, 0.2, 0.3
# Times that a mode is fitted and that what its readings are behind is found anew.
PASSES = 6


@dataclass(frozen=True)
class IntervalEstimate:
    """A *value* with its 95 % interval, in the unit of the value."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class JudgedPeak:
    """A critical speed as one *probe* shows it: *speed* [Hz], *amplification* [1], None without half-power
    speeds in the run, *amplitude* [unit of the probe], separation *margin* that there is, and *asked* [%];
    *outcome* with the *probability* that it is kept. fast: passed too fast for a steady peak.
    """

    probe: str
    speed: IntervalEstimate
    amplification: IntervalEstimate | None
    amplitude: IntervalEstimate
    margin: IntervalEstimate | None
    asked: IntervalEstimate | None
    outcome: str
    probability: float | None
    fast: bool


@dataclass(frozen=True)
class Sensitivity:
    """Local sensitivity of ISO 21940-31: change of a *probe*'s 1x amplitude per unbalance, the largest in the
    speed range [unit of the probe per kg m], at *speed* [Hz].
    """

    probe: str
    size: IntervalEstimate
    speed: float


@dataclass(frozen=True)
class RunUpJudgement:
    """What a run-up shows [m, or the unit of the probes]: *slow_roll* (n_probe,) that was taken out, with its
    variance E|ds|^2, peaks, sensitivities; *curve* (n_fine, n_probe) of amplitudes over *fine* (n_fine,) [Hz]
    with the *ends* (2, n_fine, n_probe) of its 95 % interval; *speed_range* [Hz].
    """

    probes: tuple[str, ...]
    slow_roll: ComplexArray | None
    peaks: tuple[JudgedPeak, ...]
    sensitivities: tuple[Sensitivity, ...]
    fine: FloatArray
    curve: FloatArray
    ends: FloatArray
    speed_range: tuple[float, float] | None
    slow_roll_variance: FloatArray | float = 0.0

    @property
    def accepted(self) -> bool:
        """Whether the speed range was run and every margin is kept."""
        if self.speed_range is None:
            return True
        low, high = self.speed_range
        run = self.fine[0] <= low and high <= self.fine[-1]
        return bool(run) and all(peak.outcome == KEPT for peak in self.peaks)

    @property
    def not_run(self) -> str:
        """Speeds of operation, or at which a critical one would break a margin, that were not run."""
        if self.speed_range is None:
            return ""
        (low, high), first, last = self.speed_range, self.fine[0], self.fine[-1]
        asked, parts = (1 + MOST_ABOVE) * high, []
        if low < first or high > last:
            run = f"{60 * first:.0f} to {60 * last:.0f} rpm"
            parts.append(f"the speed range is not accepted: the run goes from {run} only")
        if last < asked:
            ends = f"{60 * last:.0f} to {60 * asked:.0f} rpm"
            parts.append(f"critical speeds from {ends}, beyond the run, are not judged")
        return "; ".join(parts)


def judge(
    track: OrderTrack,
    *,
    slow_roll: tuple[float, float] | None = None,
    speed_range: tuple[float, float] | None = None,
    unbalance: float = 0.0,
    baseline: OrderTrack | None = None,
) -> RunUpJudgement:
    """The 1x track of a run judged; bands in [Hz], *unbalance* [kg m] of which the motion is the response:
    what was added since the *baseline* run, or all there is. DataError for too few speeds, or a dead probe.

    Peaks by one mode where one fits, else by smoothing splines of the readings' parts over speed, less the
    delay by which a rotor that passes them shows them; intervals by draws of the readings' noise, enlarged to
    what they scatter by. Equations (run-judged) and (run-late).
    """
    check_moving(track, "the run-up", range(len(track.ports)))
    speed, readings, deviation = _sort_by_speed(track)
    rng = np.random.default_rng(SEED)
    smooth = _Smooth(speed, readings, deviation)
    # The first is the reading itself.
    curves = recorded = np.concatenate([smooth.fitted[None], smooth.draw(rng)])
    rolled, unknown = None, 0.0
    if slow_roll is not None:
        whole = np.abs(smooth.fitted)
        tops = [
            at
            for course in whole.T
            for at in scipy.signal.find_peaks(course, prominence=SMALL * course.max())[0]
        ]
        offsets = _slow_roll(speed, readings, slow_roll, smooth.fine[min(tops, default=-1)], rng)
        rolled, curves = offsets[0], curves - offsets[:, None, :]
        unknown = np.mean(np.abs(offsets[1:] - rolled) ** 2, axis=0)
    amplitude = np.abs(curves)
    labels = tuple(port.label for port in track.ports)
    rate = np.gradient(track.speed, track.time)
    halves = _Smooth(speed[::2], readings[::2], smooth.deviation[::2], smooth.fine).fitted
    halved = np.abs(halves - (0.0 if rolled is None else rolled))
    judged_peaks = []
    for probe, label in enumerate(labels):
        for peak, drawn in _peaks(smooth.fine, amplitude[..., probe], halved[:, probe]):
            offset = None if rolled is None else offsets[:, probe]
            passed, quotient = _passing_rate(peak, track.speed, rate)
            mode = _fit_one_mode(peak, speed, readings[:, probe], deviation[:, probe], offset, passed, rng)
            peak, drawn = mode or _steady_peak(peak, drawn, passed, rng)
            judged_peaks.append(_judged_peak(peak, drawn, label, speed_range, quotient > STEADY))
    # The slow roll of a run and of its baseline is the same.
    moved = curves if baseline is None else recorded
    sensitivities = (
        tuple(_sensitivities(smooth.fine, moved, labels, unbalance, speed_range, baseline, rng))
        if unbalance
        else ()
    )
    ends = np.percentile(amplitude[1:], (2.5, 97.5), axis=0)
    judged = tuple(judged_peaks), sensitivities, smooth.fine, amplitude[0], ends, speed_range
    return RunUpJudgement(labels, rolled, *judged, unknown)


def _sort_by_speed(track: OrderTrack) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """Rising speeds [Hz], readings, deviation of their parts; of equal speeds the first."""
    speed, order = np.unique(np.round(track.speed, 6), return_index=True)
    if speed.size < FEWEST:
        hint = f"{FEWEST} at least"
        raise DataError(f"{speed.size} different speeds are too few to judge a run-up", hint=hint)
    return speed, track.amplitude[order], np.sqrt(np.maximum(track.variance[order], 1e-300) / 2)


class _Smooth:
    """Natural smoothing splines g = (W + lambda Q R^-1 Q^T)^-1 W y (Reinsch 1967) through the parts of
    readings (n_speed, n_probe), lambda by generalised cross-validation: *fitted* at *fine* [Hz]. The
    *deviation* of each part grows to what the readings scatter by.
    """

    def __init__(
        self, speed: FloatArray, readings: ComplexArray, deviation: FloatArray, fine: FloatArray | None = None
    ) -> None:
        self.fine = np.linspace(speed[0], speed[-1], FINE) if fine is None else fine
        n, n_probe = readings.shape
        between = scipy.interpolate.CubicSpline(speed, np.eye(n), bc_type="natural")(self.fine)
        rough = _roughness((speed - speed[0]) / np.ptp(speed))
        rows = np.empty((n_probe, n, n))
        for probe in range(n_probe):
            weight = deviation[:, probe] ** -2.0
            smoothers = [
                np.linalg.solve(np.diag(weight) + stiffness * weight.mean() * rough, np.diag(weight))
                for stiffness in STIFFNESSES
            ]
            rows[probe] = min(
                smoothers, key=lambda smoother: _cross_validation(smoother, readings[:, probe], weight)
            )
        self._matrices = between @ rows
        self.fitted = np.einsum("pfn,np->fp", self._matrices, readings)
        dof = np.maximum(n - np.trace(rows, axis1=1, axis2=2), 1.0)
        left = readings - np.einsum("pmn,np->mp", rows, readings)
        chi2 = np.sum(np.abs(left) ** 2 / (2 * deviation**2), axis=0) / dof
        self.deviation = deviation * np.sqrt(np.maximum(chi2, 1.0))

    def draw(self, rng: np.random.Generator) -> ComplexArray:
        """With noise once more, (DRAWS, n_fine, n_probe) [unit of the readings]."""
        shape = (DRAWS, *self.deviation.shape)
        noise = self.deviation * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        return self.fitted + np.stack(
            [noise[..., probe] @ matrix.T for probe, matrix in enumerate(self._matrices)], axis=-1
        )


def _roughness(x: FloatArray) -> FloatArray:
    """Q R^-1 Q^T (n, n): the integral of g''^2 of a natural cubic spline through g (n,) at x."""
    n, step = x.size, np.diff(x)
    second, gram = np.zeros((n, n - 2)), np.zeros((n - 2, n - 2))
    for at in range(n - 2):
        second[at : at + 3, at] = 1 / step[at], -1 / step[at] - 1 / step[at + 1], 1 / step[at + 1]
        gram[at, at] = (step[at] + step[at + 1]) / 3
        if at:
            gram[at, at - 1] = gram[at - 1, at] = step[at] / 6
    return second @ np.linalg.solve(gram, second.T)


def _cross_validation(smoother: FloatArray, readings: ComplexArray, weight: FloatArray) -> float:
    """Generalised cross-validation: |y - A y|^2_W / (n - tr A)^2 of readings y (n,) and A (n, n)."""
    left = readings - smoother @ readings
    return float(np.sum(weight * np.abs(left) ** 2) / max(weight.size - np.trace(smoother), 1e-9) ** 2)


def _slow_roll(
    speed: FloatArray,
    readings: ComplexArray,
    band: tuple[float, float],
    critical: float,
    rng: np.random.Generator,
) -> ComplexArray:
    """s of z = s + a Omega^2 / (1 - Omega^2 / Omega_c^2) in the band, below the first *critical* speed [Hz]
    or the end of the run, and what damping adds in first order, and draws of it, (1 + DRAWS, n_probe).
    """
    slow = (speed >= band[0]) & (speed <= band[1])
    if slow.sum() < FEWEST_SLOW:
        hint = f"{FEWEST_SLOW} at least; the run begins at {60 * speed[0]:.0f} rpm"
        raise ConfigError(f"--slow-roll: {int(slow.sum())} stretches of the run lie in it", hint=hint)
    ratio = speed[slow] / critical
    # A peak so near to slow speeds that it has made a force half as much again is none to go by.
    left = 1 - ratio**2 if ratio[-1] ** 2 < 1 / 3 else 1.0
    design = np.column_stack([np.ones(ratio.size), ratio**2 / left, ratio**3 / left**2])
    rise, scatter = np.linalg.lstsq(design[:, :2], readings[slow], rcond=None)[:2]
    variance = np.maximum(scatter / (ratio.size - 2), 1e-300)
    # Damping and modes near by turn the rise by no more than a share of it, which readings may tell.
    precision = np.zeros((variance.size, 3, 3))
    precision[:, 2, 2] = variance / np.maximum(TURNED * np.abs(rise[1]), 1e-300) ** 2
    inverse = np.linalg.inv(design.T @ design + precision)
    middle = np.einsum("pj,jp->p", inverse[:, 0], design.T @ readings[slow])
    variance = variance * inverse[:, 0, 0]
    shape = (DRAWS, readings.shape[1])
    noise = np.sqrt(variance / 2) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    # Few stretches tell their own scatter: Student's t.
    dof = 2 * (int(slow.sum()) - 2)
    noise = noise * np.sqrt(dof / rng.chisquare(dof, shape))
    return np.concatenate([middle[None], middle + noise])


def _estimate(value: float, draws: Sequence[float]) -> IntervalEstimate:
    low, high = np.percentile(draws, (2.5, 97.5))
    return IntervalEstimate(value, min(float(low), value), max(float(high), value))


def _peaks(
    fine: FloatArray, amplitude: FloatArray, halved: FloatArray
) -> Iterator[tuple[Critical, list[Critical]]]:
    """Clear peaks of the reading, each with those of the draws, (1 + DRAWS, n_fine): their scatter, and what
    a curve through every other reading, *halved* (n_fine,), changes.
    """
    spread = float(np.median(np.std(amplitude[1:], axis=0)))
    clear = max(CLEAR * spread, SMALL * float(amplitude[0].max()))
    tops, sizes = scipy.signal.find_peaks(amplitude[0], prominence=clear)
    for top, left, right in zip(tops, sizes["left_bases"], sizes["right_bases"], strict=True):
        # Between the dips, and no further than the next peak's.
        first = max([int(left), *((a + top) // 2 for a in tops if a < top)])
        last = min([int(right), *((a + top) // 2 for a in tops if a > top)])
        rows = [_peak(fine, row, first, last) for row in amplitude]
        coarse = _peak(fine, halved, first, last)
        if rows[0] is not None:
            yield rows[0], [_move(row, rows[0], coarse, n) for n, row in enumerate(rows[1:]) if row]


def _peak(fine: FloatArray, amplitude: FloatArray, first: int, last: int) -> Critical | None:
    """By parabola, half-power speeds by lines of 1 / amplitude^2."""
    top = first + int(np.argmax(amplitude[first : last + 1]))
    if not 0 < top < fine.size - 1:
        return None
    flat = amplitude**-2.0
    below, middle, above = flat[top - 1 : top + 2]
    bend = below - 2 * middle + above
    shift = 0.5 * (below - above) / bend if bend > 0 else 0.0
    height = max(middle - 0.25 * (below - above) * shift, middle / 2)
    ends: list[float | None] = []
    for numbers in (range(top, -1, -1), range(top, fine.size)):
        beyond = next((n for n in numbers if flat[n] > 2 * height), None)
        if beyond is None:
            ends.append(None)
            continue
        inner = beyond + (1 if numbers.step < 0 else -1)
        share = (2 * height - flat[inner]) / (flat[beyond] - flat[inner])
        ends.append(float(fine[inner] + share * (fine[beyond] - fine[inner])))
    step = fine[1] - fine[0]
    return Critical(float(fine[top] + shift * step), float(height**-0.5), 0, ends[0], ends[1])


def _fit_one_mode(
    peak: Critical,
    speed: FloatArray,
    readings: ComplexArray,
    deviation: FloatArray,
    offsets: ComplexArray | None,
    rate: float,
    rng: np.random.Generator,
) -> tuple[Critical, list[Critical]] | None:
    """The peak and those of the draws by z = Omega^2 (a + b Omega) / (1 + c Omega + d Omega^2), to which the
    readings come by what they are behind at *rate* [Hz/s]; None where the half-power speeds are not in the
    run, readings are few, or one mode does not fit.
    """
    if peak.low is None or peak.high is None:
        return None
    room = BESIDE * (peak.high - peak.low)
    near = (speed >= peak.low - room) & (speed <= peak.high + room)
    if near.sum() < ENOUGH:
        return None
    x = (speed[near] - peak.speed) / (peak.high - peak.low)
    place = np.linspace(x[0], x[-1], POINTS)
    fine = peak.speed + (peak.high - peak.low) * place
    scale = (speed[near] / peak.speed) ** 2

    def fit(values: ComplexArray, at: FloatArray) -> ComplexArray:
        return rational_fit(x, (values / scale)[:, None], (deviation[near] / scale)[:, None], at)[:, 0]

    shifts = np.zeros(1 + DRAWS, complex) if offsets is None else offsets
    middle, steady = readings[near] - shifts[0], peak
    behind = np.zeros(x.size, complex)
    turned = (fine / peak.speed) ** 2
    for _ in range(PASSES):
        curve = turned * fit(middle + behind, place)
        steady = _peak(fine, np.abs(curve), 0, POINTS - 1) or steady
        if steady.low == steady.high is not None:
            # What the readings are behind has run away.
            return None
        if steady.amplification is not None:
            behind = np.interp(x, place, _lag(curve, fine, rate, steady))
    middle = middle + behind
    left = (middle - scale * fit(middle, x)) / deviation[near]
    # Four complex coefficients.
    dof = 2 * int(near.sum()) - 8
    chi2 = float(np.sum(np.abs(left) ** 2)) / dof
    if chi2 > FITS:
        return None
    # Within a stretch a motion that changes counts as noise: what the readings scatter by is less, and
    # Student's t.
    size = deviation[near] * np.sqrt(chi2)
    critical = []
    for number, shift in enumerate(shifts):
        noise = size * (rng.standard_normal(x.size) + 1j * rng.standard_normal(x.size))
        noise = noise * np.sqrt(dof / rng.chisquare(dof)) if number else 0.0 * noise
        amplitude = turned * np.abs(fit(readings[near] - shift + behind + noise, place))
        critical.append(_peak(fine, amplitude, 0, POINTS - 1))
    return None if critical[0] is None else (critical[0], [peak for peak in critical[1:] if peak is not None])


def _lag(curve: ComplexArray, speed: FloatArray, rate: float, peak: Critical) -> ComplexArray:
    """What the amplitude A of a mode that is passed at *rate* [Hz/s] is behind that of a steady rotor, A_s,
    *curve* (n,) at *speed* (n,) [Hz]. z = A exp(j angle) in the equation of motion: A_s - A of D A_s (1 - j a
    / W^2) = (D + j a) A + 2 (j W + zeta w0) dA/dt + d2A/dt2, D = w0^2 - W^2 + 2 j zeta w0 W, a = dW/dt. Of
    the peak w0^2 = N_c^2 cos(p), zeta = sin(p / 2), tan(p) = N_c^2 (N_1^-2 - N_2^-2) / 2: 1 / |A|^2 is u^2 -
    2 (1 - 2 zeta^2) u + 1 in u = (w0 / W)^2.
    """
    omega, acceleration = 2 * np.pi * speed, 2 * np.pi * rate
    assert peak.low is not None and peak.high is not None
    turned = np.arctan(peak.speed**2 * (peak.low**-2 - peak.high**-2) / 2)
    zeta, resonance = np.sin(turned / 2), 2 * np.pi * peak.speed * np.sqrt(np.cos(turned))
    stiffness = resonance**2 - omega**2 + 2j * zeta * resonance * omega
    if not acceleration:
        return np.zeros_like(curve)
    # In time: dA/dt = decay (driven - A), all but d2A/dt2, which the passes add.
    way = slice(None, None, 1 if rate > 0 else -1)
    inertia = 2 * (1j * omega + zeta * resonance)
    decay = (stiffness + 1j * acceleration) / inertia
    force, moving = stiffness * curve * (1 - 1j * acceleration / omega**2), curve
    step = np.abs(np.diff(omega[way]) / acceleration)
    along = (decay[way][1:] + decay[way][:-1]) / 2 * step
    kept = np.exp(-along)
    for _ in range(PASSES):
        second = acceleration**2 * np.gradient(np.gradient(moving, omega), omega)
        driven = ((force - second) / (decay * inertia))[way]
        change = np.diff(driven)
        added = change - change * (1 - kept) / along
        lag = [-change[0] / along[0]]
        for share, up, more in zip(kept, change, added, strict=True):
            lag.append(share * lag[-1] + more - up)
        moving = (driven + np.array(lag))[way]
    return curve - moving


def _passing_rate(peak: Critical, speed: FloatArray, rate: FloatArray) -> tuple[float, float]:
    """The mean *rate* (n,) [Hz/s] between the half-power speeds, zero where these are not known or passed so
    fast that the peak is not that of a steady rotor; and that quotient, |rate| / (N_2 - N_1)^2.
    """
    if peak.low is None or peak.high is None:
        return 0.0, 0.0
    within = rate[(speed >= peak.low) & (speed <= peak.high)]
    quotient = float(np.mean(np.abs(within))) / (peak.high - peak.low) ** 2 if within.size else 0.0
    return (float(np.mean(within)) if 0 < quotient <= STEADY else 0.0), quotient


def _steady_peak(
    peak: Critical, drawn: list[Critical], rate: float, rng: np.random.Generator
) -> tuple[Critical, list[Critical]]:
    """The peak and its draws at speeds of a steady rotor: at *rate* [Hz/s] it stands 2 rate / (pi (N_2 -
    N_1)) late, the first order of dA/dt = -(pi (N_2 - N_1) + 2 pi j (N - N_c)) A + f.
    """
    if peak.low is None or peak.high is None:
        return peak, drawn
    width, moved = peak.high - peak.low, []
    for number, one in enumerate((peak, *drawn)):
        left, wider = rng.standard_normal(2) * (LATE, WIDER) if number else (0.0, 0.0)
        speed = one.speed - 2 * rate / (np.pi * width) * (1 + left)
        ends = [
            None if end is None else speed + (end - one.speed) * (1 + wider * rate / width**2)
            for end in (one.low, one.high)
        ]
        amplitude = one.amplitude * (1 + LOWER / WIDER * wider * (rate / width**2) ** 2)
        moved.append(replace(one, speed=speed, amplitude=amplitude, low=ends[0], high=ends[1]))
    return moved[0], moved[1:]


def _move(peak: Critical, middle: Critical, coarse: Critical | None, number: int) -> Critical:
    """A draw's peak, moved to one side or the other by the error of the curve between readings."""
    if coarse is None:
        return peak
    by = (1 if number % 2 else -1) / HALVED

    def off(at_peak: float | None, fine: float | None, rough: float | None) -> float | None:
        return at_peak if at_peak is None or fine is None or rough is None else at_peak * (rough / fine) ** by

    return Critical(
        float(off(peak.speed, middle.speed, coarse.speed) or 0.0),
        float(off(peak.amplitude, middle.amplitude, coarse.amplitude) or 0.0),
        0,
        off(peak.low, middle.low, coarse.low),
        off(peak.high, middle.high, coarse.high),
    )


def _judged_peak(
    peak: Critical, drawn: Sequence[Critical], label: str, speed_range: tuple[float, float] | None, fast: bool
) -> JudgedPeak:
    speed = _estimate(peak.speed, [draw.speed for draw in drawn])
    amplitude = _estimate(peak.amplitude, [draw.amplitude for draw in drawn])
    factors = [draw.amplification for draw in drawn if draw.amplification is not None]
    factor = peak.amplification
    whole = factor is not None and len(factors) > DRAWS / 2
    amplification = _estimate(float(factor or 0.0), factors) if whole else None
    fast = fast and whole
    judged = JudgedPeak(label, speed, amplification, amplitude, None, None, "none asked", None, fast)
    if speed_range is None:
        return judged
    there, asked = peak.margin_of(speed_range)
    pairs = [draw.margin_of(speed_range) for draw in drawn if draw.amplification is not None]
    if amplification is None or asked is None or len(drawn) < DRAWS / 2:
        margin = _estimate(there, [draw.margin_of(speed_range)[0] for draw in drawn])
        return replace(judged, amplification=None, margin=margin, outcome=UNDECIDED)
    kept = float(np.mean([have >= (ask or 0.0) for have, ask in pairs]))
    return replace(
        judged,
        margin=_estimate(there, [have for have, _ in pairs]),
        asked=_estimate(asked, [ask or 0.0 for _, ask in pairs]),
        outcome=UNDECIDED if fast else decision(kept),
        probability=kept,
    )


def _sensitivities(
    fine: FloatArray,
    curves: ComplexArray,
    labels: tuple[str, ...],
    unbalance: float,
    speed_range: tuple[float, float] | None,
    baseline: OrderTrack | None,
    rng: np.random.Generator,
) -> Iterator[Sensitivity]:
    if baseline is not None:
        smooth = _Smooth(*_sort_by_speed(baseline))
        others = np.concatenate([smooth.fitted[None], smooth.draw(rng)])
        common = (fine >= smooth.fine[0]) & (fine <= smooth.fine[-1])
        fine = fine[common]
        curves = curves[:, common] - scipy.interpolate.interp1d(smooth.fine, others, axis=1)(fine)
    inside = np.ones(fine.size, bool)
    if speed_range is not None:
        inside = (fine >= speed_range[0]) & (fine <= speed_range[1])
    if not inside.any():
        if baseline is not None:
            raise DataError("the run and its baseline have no speed of operation in common")
        return
    for probe, label in enumerate(labels):
        size = np.abs(curves[:, inside, probe]) / unbalance
        at = int(np.argmax(size[0]))
        yield Sensitivity(
            label, _estimate(float(size[0, at]), size[1:, at].tolist()), float(fine[inside][at])
        )
