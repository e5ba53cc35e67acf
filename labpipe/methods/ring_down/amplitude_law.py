"""Damping and frequency of a decay over its amplitude, two close modes that look like it, jumps in the time
of a record, and findings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.display import chance_text
from labpipe.distributions import normal_tail
from labpipe.errors import FitError
from labpipe.estimation.descent import SquareSum, linearise_problem, minimise
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.ring_down import likelihood
from labpipe.records.finding import Finding
from labpipe.records.fit_details import AmplitudeLaw, OverAmplitude
from labpipe.records.spectra import FreeDecay, FreeDecays

SHARED = 4
# Step of the differences, in parameters scaled to order one: their rounding and their curvature both stay
# below 1e-5 of a slope.
STEP = 1e-5


@dataclass(frozen=True)
class FittedLaw:
    """The law with the covariance (4, 4) of zeta_rest [1], zeta_slope [1/unit], frequency_slope [rad/s/unit],
    omega [rad/s]; converged. squares: sum of the squares of what it leaves [1], over the variances that the
    exponential fit leaves.
    """

    law: AmplitudeLaw
    covariance: FloatArray
    converged: bool
    squares: float


def amplitude(time: FloatArray, first: float, omega: float, rest: float, slope: float) -> FloatArray:
    """A(t) (n_sample,) [unit of *first*] of A' = -w (z0 + z1 A) A from A(0) = *first* at *time* (n_sample,)
    [s]. A = z0 A0 E / (z0 + z1 A0 (1 - E)), E = exp(-z0 w t): the solution of a Bernoulli equation. Equation
    (decay-law).
    """
    decay = np.exp(-rest * omega * time)
    return first * decay / (1 + slope * first * omega * time * _relative(rest * omega * time))


def _relative(x: FloatArray) -> FloatArray:
    """(1 - e^-x) / x, 1 at x = 0."""
    safe = np.where(np.abs(x) < 1e-12, 1.0, x)
    return np.where(np.abs(x) < 1e-12, 1.0, -np.expm1(-safe) / safe)


def travel(time: FloatArray, first: float, omega: float, rest: float, slope: float) -> FloatArray:
    """The integral of A over *time* (n_sample,) [unit of *first* times s]: ln(1 + z1 A0 (1 - E) / z0) / (w
    z1). Equation (decay-phase).
    """
    linear = first * time * _relative(rest * omega * time)
    bent = slope * omega * linear
    safe = np.where(np.abs(bent) < 1e-9, 1.0, bent)
    share = np.where(np.abs(bent) < 1e-9, 1.0, np.log1p(np.maximum(safe, -0.999999)) / safe)
    return linear * share


class _LawProblem(SquareSum):
    """Whitened residual of one mode's law over z0, z1, s and w relative to the exponential fit, then ln A0
    and phase of every piece.
    """

    def __init__(
        self, pieces: Sequence[likelihood.Piece], fitted: likelihood.Decayed, mode: int, output: int
    ) -> None:
        self.pole = fitted.poles[mode]
        self.omega = abs(self.pole)
        self.zeta = -self.pole.real / self.omega
        self.pieces, self.deviation = pieces, np.sqrt(fitted.variance[:, output])
        amplitudes = [solved.amplitudes[mode, output] for solved in fitted.pieces]
        self.amplitudes: ComplexArray = np.array(amplitudes)
        self.largest = float(np.max(np.abs(self.amplitudes)))
        self.targets = []
        others = np.arange(fitted.poles.size) != mode
        for number, piece in enumerate(pieces):
            course = np.exp(piece.time[:, None] * fitted.poles_of(number)[others])
            course = (course @ fitted.pieces[number].amplitudes[others, output]).real
            rows = piece.rows[:, output] - piece.project(course[:, None])[:, 0]
            self.targets.append(piece.free(rows))

    @property
    def size(self) -> float:
        parts = [target / d for target, d in zip(self.targets, self.deviation, strict=True)]
        return float(np.sqrt(sum(np.sum(part**2) for part in parts)))

    @property
    def start(self) -> FloatArray:
        local = np.stack([np.log(np.abs(self.amplitudes)), np.angle(self.amplitudes)], axis=1)
        return np.concatenate([[1.0, 0.0, 0.0, self.pole.imag / self.omega], local.reshape(-1)])

    def physical(self, parameters: FloatArray) -> FloatArray:
        """z0 [1], z1 [1/unit], s [rad/s/unit], w [rad/s] as (4,)."""
        return parameters[:SHARED] * self.units

    @property
    def units(self) -> FloatArray:
        return np.array(
            [self.zeta, self.zeta / self.largest, self.zeta * self.omega / self.largest, self.omega]
        )

    def course(self, number: int, parameters: FloatArray) -> FloatArray:
        rest, slope, turn, omega = self.physical(parameters)
        log_first, phase = parameters[SHARED + 2 * number : SHARED + 2 * number + 2]
        first, piece = float(np.exp(min(log_first, 700.0))), self.pieces[number]
        size = amplitude(piece.time, first, omega, rest, slope)
        angle = omega * piece.time + turn * travel(piece.time, first, omega, rest, slope) + phase
        rows = piece.project((size * np.cos(angle))[:, None])[:, 0]
        return piece.free(rows) / self.deviation[number]

    def residual(self, parameters: FloatArray) -> FloatArray:
        pairs = zip(self.targets, self.deviation, strict=True)
        return np.concatenate(
            [self.course(n, parameters) - target / deviation for n, (target, deviation) in enumerate(pairs)]
        )

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        blocks = []
        for number in range(len(self.pieces)):
            block = np.zeros((self.targets[number].size, parameters.size))
            for column in (*range(SHARED), SHARED + 2 * number, SHARED + 2 * number + 1):
                step = STEP * self.zeta if column == SHARED - 1 else STEP
                change = np.zeros(parameters.size)
                change[column] = step
                above, below = (self.course(number, parameters + sign * change) for sign in (1, -1))
                block[:, column] = (above - below) / (2 * step)
            blocks.append(block)
        return np.concatenate(blocks)


def fitted_law(
    pieces: Sequence[likelihood.Piece], fitted: likelihood.Decayed, mode: int, output: int
) -> FittedLaw:
    """The law of a mode from all pieces of one output, from the exponential fit on."""
    problem = _LawProblem(pieces, fitted, mode, output)
    minimum = minimise(problem, problem.start, near=1e-4)
    linear = linearise_problem(problem, minimum.values)
    inverse = np.linalg.pinv(linear.triangle * linear.scale, rcond=1e-15)
    nuisance = sum(piece.nuisance.shape[1] for piece in pieces)
    noise = linear.chi2 / max(linear.n_equation - minimum.values.size - nuisance, 1)
    covariance = (inverse @ inverse.T)[:SHARED, :SHARED] * noise * np.outer(problem.units, problem.units)
    rest, slope, turn, omega = (float(value) for value in problem.physical(minimum.values))
    ends = np.cumsum([target.size for target in problem.targets])[:-1]
    parts = np.split(problem.residual(minimum.values), ends)
    series = [piece.series(part[:, None]) for piece, part in zip(pieces, parts, strict=True)]
    p_value = likelihood.portmanteau(series, all(piece.lines is None for piece in pieces))
    law = AmplitudeLaw(omega, rest, slope, turn, p_value)
    return FittedLaw(law, covariance, minimum.converged, float(linear.chi2))


# Stretches of one decay at most, periods of one at least, and amplitudes over their standard error below
# which nothing is seen.
MOST_STRETCHES, LEAST_PERIODS, LEAST_RATIO = 16, 3.0, 10.0
# Values of noise in a stretch beyond which it says how large the noise is.
LEAST_ROWS = 6


@dataclass(frozen=True)
class Stretches:
    """A mode of one decay stretch by stretch: middle (n,) [s], complex amplitudes (n,) that decay, std_error
    (n,) [unit of the output].
    """

    middle: FloatArray
    amplitudes: ComplexArray
    std_error: FloatArray


def stretches(
    piece: likelihood.Piece, fitted: likelihood.Decayed, number: int, mode: int, output: int
) -> Stretches:
    """Amplitudes of a mode of the piece of this *number* on stretches of its rows in time, everything else
    subtracted as fitted.
    """
    solved, pole = fitted.pieces[number], fitted.poles_of(number)[mode]
    n = piece.time.size
    periods = n * pole.imag / (2 * np.pi * LEAST_PERIODS) * (piece.time[-1] / n if n > 1 else 0.0)
    count = int(min(MOST_STRETCHES, periods))
    # The residual in time: of a band without what lies outside it.
    left = _time_residual(piece, solved.residual[:, output])
    amplitude = solved.amplitudes[mode, output]
    course = np.exp(pole * piece.time)
    # White noise of a band has as many values in a sample as it has of the lines, and within 1 / width of
    # either end a band lacks what begins or stops there.
    share, edge = (1.0, 0) if piece.lines is None else (2 * piece.lines.size / n, n // piece.lines.size)
    inside = np.arange(edge, n - edge)
    parts = [part for part in np.array_split(inside, max(count, 1)) if part.size > 4]
    rows, variances = [], []
    for part in parts:
        columns = np.stack([course[part].real, -course[part].imag], axis=1)
        change, _, rank, _ = np.linalg.lstsq(columns, left[part], rcond=None)
        if rank < 2:
            continue
        middle = float(np.mean(piece.time[part]))
        size = abs(np.exp(pole * middle))
        error = np.sqrt(np.trace(np.linalg.inv(columns.T @ columns)) / 2) * size
        rows.append((middle, (amplitude + change[0] + 1j * change[1]) * size, error))
        if part.size * share > LEAST_ROWS:
            variances.append(np.sum((left[part] - columns @ change) ** 2) / (part.size * share - 2))
    middles, values, errors = np.array(rows, np.complex128).reshape(-1, 3).T
    # The fit's own variance holds the course of damping and frequency, which is what stretches are to show.
    variance = float(np.median(variances)) if variances else float(fitted.variance[number, output])
    return Stretches(middles.real, values, errors.real * np.sqrt(variance))


def _time_residual(piece: likelihood.Piece, residual: FloatArray) -> FloatArray:
    if piece.lines is None:
        return residual
    half = piece.lines.size
    spectrum = np.zeros(piece.time.size // 2 + 1, np.complex128)
    spectrum[piece.lines] = (residual[:half] + 1j * residual[half:]) * np.sqrt(piece.time.size / 2)
    return np.fft.irfft(spectrum, piece.time.size)


def evaluate_over_amplitude(
    pieces: Sequence[likelihood.Piece], fitted: likelihood.Decayed, mode: int, output: int
) -> OverAmplitude:
    """Damping ratio and frequency between neighbouring stretches of all pieces, in ascending amplitude.
    ln(A_1 / A_2) / (w dt) and the turn of the phase between them; first-order standard errors. Equation
    (decay-stretches).
    """
    parts = []
    for number, piece in enumerate(pieces):
        omega = abs(fitted.poles_of(number)[mode])
        course = stretches(piece, fitted, number, mode, output)
        is_seen = np.abs(course.amplitudes) > LEAST_RATIO * course.std_error
        seen = slice(int(np.argmin(np.append(is_seen, False))))
        values, span = course.amplitudes[seen], np.diff(course.middle[seen])
        size = np.abs(values)
        error = course.std_error[seen] / size
        spread, turn = np.hypot(error[:-1], error[1:]), np.angle(values[1:] / values[:-1])
        damping = np.log(size[:-1] / size[1:]) / (omega * span)
        frequency = (omega + turn / span) / (2 * np.pi)
        errors = spread / (omega * span), spread / span / (2 * np.pi)
        parts.append([np.sqrt(size[:-1] * size[1:]), damping, errors[0], frequency, errors[1]])
    table = np.concatenate(parts, axis=1)
    return OverAmplitude(*table[:, np.argsort(table[0])])


# Pairs of stretches that show what the values of one decay scatter by, and least degrees of freedom that they
# count as, since they are compared with the fit and not against their mean.
FEWEST_STRETCHES, LEAST_DOF = 1, 2


def course_spread(curve: OverAmplitude, pole: complex) -> tuple[float, float, int] | None:
    """By how much ln f and ln zeta of the stretches of a decay scatter about the fit's *pole* [rad/s] beyond
    their noise, standard deviations [1], and their degrees of freedom; None of fewer than FEWEST_STRETCHES.
    tau^2 = max(sum w ((x_j - x)^2 - u_j^2) / sum w, 0), w = 1 / (u_j^2 + median u^2). Equation
    (decay-course).
    """
    size = abs(pole)
    seen = curve.damping > 0
    n = int(np.count_nonzero(seen))
    if n < FEWEST_STRETCHES or pole.real >= 0:
        return None
    frequency_error = (curve.frequency_std_error / curve.frequency)[seen]
    logs = (
        (np.log(2 * np.pi * curve.frequency[seen] / size), frequency_error),
        (np.log(-curve.damping[seen] * size / pole.real), (curve.damping_std_error / curve.damping)[seen]),
    )
    spreads = []
    for off, error in logs:
        weight = 1 / (error**2 + np.median(error) ** 2)
        spreads.append(float(np.sqrt(max(np.average(off**2 - error**2, weights=weight), 0.0))))
    return spreads[0], spreads[1], max(n - 1, LEAST_DOF)


# Share of its first amplitude from which on a decay is fitted once more where the law leaves more than noise.
LATER = 0.5


def law_spread(
    decays: FreeDecays,
    columns: Sequence[int],
    fitted: likelihood.Decayed,
    band: tuple[float, float] | None,
    place: tuple[int, int],
    law: FittedLaw,
) -> FloatArray | None:
    """Model errors (3,) of zeta_rest [1], zeta_slope [1/unit], frequency slope [rad/s/unit] of a *law* that
    leaves more than noise, at *place* (mode, output): how far the law of the decays from the share LATER of
    their amplitude on (half of a shorter one) lies from it, and the standard error of that one. A law follows
    the largest amplitudes, which have the energy. None of too short decays. Equation (decay-law-later).
    """
    mode, output = place
    skipped = round(-np.log(LATER) / -fitted.poles[mode].real * decays.sample_rate)
    later = [
        replace(decay, samples=decay.samples[min(skipped, len(decay.samples) // 2) :])
        for decay in decays.decays
    ]
    try:
        pieces = likelihood.pieces_of(later, columns, decays.sample_rate, band)
        other = fitted_law(pieces, likelihood.maximum_likelihood(pieces, fitted.poles), mode, output)
    except (FitError, np.linalg.LinAlgError):
        return None
    first, second = (
        np.array([of.zeta_rest, of.zeta_slope, of.frequency_slope]) for of in (law.law, other.law)
    )
    errors = np.sqrt(np.diag(other.covariance)[:3])
    return np.hypot(second - first, errors) if other.converged else None


# Difference of the Bayesian information criterion beyond which the better model is chosen: strong evidence
# (Kass and Raftery 1995, J. Am. Stat. Assoc. 90, 3.2).
STRONG = 10.0
# Share of what the law leaves that the richer fit may leave to be named at all where it does not leave white
# noise either: a softening bearing, whose law is another one, is fitted by two modes to 60 %, a beam with two
# modes to 35 % (docs/pages/validation/measured.md).
LEFT = 0.5


@dataclass(frozen=True)
class MissingMode:
    """The fit with a mode more: *frequencies* [Hz] that take the place of *mode*, by how much its criterion
    is *better* [1]. white: whether it leaves white noise; otherwise neither it nor the law explains the
    decay, and a law of another form may be as good.
    """

    mode: int
    frequencies: tuple[float, ...]
    better: float
    white: bool


def missing_mode(
    pieces: Sequence[likelihood.Piece],
    fitted: likelihood.Decayed,
    richer: likelihood.Decayed,
    laws: dict[int, FittedLaw],
    outputs: Sequence[int],
    *,
    white: bool,
) -> MissingMode | None:
    """What *richer*, with a mode more than *fitted*, explains better than the *laws* by their mode; None
    where it does not. *outputs* (n_mode,) in which each mode is strongest. *white*: whether it leaves white
    noise; otherwise it must leave less than the share LEFT of what the law leaves. N ln(S) + p ln(N) of both,
    S the squares left in the output in which the mode is strongest: a law has two parameters more than an
    exponential, a mode two more and two in every piece. Equation (decay-missing).
    """
    if not richer.converged or np.any(richer.poles.real >= 0):
        return None
    for mode, law in laws.items():
        output = outputs[mode]
        count = sum(piece.rows.shape[0] for piece in pieces)
        squares = [np.sum(solved.residual[:, output] ** 2) for solved in richer.pieces]
        left = float(np.sum(np.array(squares) / fitted.variance[:, output]))
        better = count * float(np.log(law.squares / left)) - 2 * len(pieces) * float(np.log(count))
        if better > STRONG and (white or left < LEFT * law.squares):
            near = richer.poles[np.argsort(np.abs(richer.poles - fitted.poles[mode]))[:2]]
            frequencies = np.sort(np.abs(near)) / (2 * np.pi)
            return MissingMode(mode, tuple(frequencies.tolist()), better, white)
    return None


# Places of a jump that are tried first, and the shares of a decay between which they lie.
PLACES, FIRST, LAST = 24, 0.04, 0.8
BETTER = 20.0
# Missing samples leave the amplitude as it is to this share, and are a whole number to this part of one.
EVEN, WHOLE = 0.1, 0.25


@dataclass(frozen=True)
class Jump:
    """A decay as two, *pieces* of the same poles, with the finding that says why."""

    decays: FreeDecays
    pieces: tuple[likelihood.Piece, ...]
    fitted: likelihood.Decayed
    finding: Finding


def jump_of(
    decays: FreeDecays, columns: Sequence[int], fitted: likelihood.Decayed, band: tuple[float, float] | None
) -> Jump | None:
    """The jump with which nothing but noise is left of a decay; None where there is none, or
    several decays.
    """
    if len(decays.decays) != 1:
        return None
    count = decays.decays[0].samples.shape[0]
    places = np.linspace(FIRST * count, LAST * count, PLACES).astype(int)
    tried = {int(place): _part(decays, columns, fitted, band, int(place)) for place in places}
    step = int(places[1] - places[0])
    while step > 1:
        step = -(-step // 3)
        near = _best(tried)
        for place in (near - 2 * step, near - step, near + step, near + 2 * step):
            if place not in tried and FIRST * count < place < LAST * count:
                tried[place] = _part(decays, columns, fitted, band, place)
    place = _best(tried)
    best = tried[place]
    if best is None:
        return None
    parts, pieces, parted = best
    free = (2 * fitted.poles.size + 1) * len(columns) + 1
    gain = fitted.misfit - parted.misfit - free * np.log(count * len(columns))
    left = likelihood.judge(pieces, parted, decays.sample_rate)
    if gain < BETTER or min(left.white, left.amplitude) < MISMATCH_P:
        return None
    return Jump(replace(decays, decays=parts), pieces, parted, _finding(parted, parts, decays.sample_rate))


Parted = tuple[tuple[FreeDecay, ...], tuple[likelihood.Piece, ...], likelihood.Decayed]


def _part(
    decays: FreeDecays,
    columns: Sequence[int],
    fitted: likelihood.Decayed,
    band: tuple[float, float] | None,
    place: int,
) -> Parted | None:
    (whole,) = decays.decays
    parts = (
        replace(whole, samples=whole.samples[:place]),
        replace(whole, start=whole.start + place / decays.sample_rate, samples=whole.samples[place:]),
    )
    try:
        pieces = likelihood.pieces_of(parts, columns, decays.sample_rate, band)
        return parts, pieces, likelihood.maximum_likelihood(pieces, fitted.poles)
    except (FitError, np.linalg.LinAlgError):
        return None


def _best(tried: dict[int, Parted | None]) -> int:
    return min(tried, key=lambda place: np.inf if (part := tried[place]) is None else part[2].misfit)


def _finding(parted: likelihood.Decayed, parts: tuple[FreeDecay, ...], rate: float) -> Finding:
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


def depends_on_amplitude(law: FittedLaw) -> bool:
    """Whether a slope of the law differs significantly from zero, and the law is no worse than its noise
    allows to tell.
    """
    errors = np.sqrt(np.diag(law.covariance))
    slopes = np.array([law.law.zeta_slope, law.law.frequency_slope])
    ratios = np.divide(np.abs(slopes), errors[1:3], out=np.zeros(2), where=errors[1:3] > 0)
    return law.converged and 4 * normal_tail(float(np.max(ratios))) < MISMATCH_P


def decay_findings(
    fitted: likelihood.Decayed,
    tested: likelihood.Judged,
    laws: dict[int, FittedLaw],
    amplitudes: dict[int, float],
    missing: MissingMode | None,
) -> tuple[Finding, ...]:
    """Warnings: no convergence, growing oscillations, damping over amplitude (*laws* and first *amplitudes*
    by mode), other residuals. *missing*: the mode that explains the residual better than a law.
    """
    warnings = []
    if not fitted.converged:
        steps = f"the fit of the decay did not converge in {fitted.steps} steps"
        warnings.append(Finding("no-convergence", f"{steps}; its numbers are not a result"))
    decay, errors = -fitted.poles.real, np.sqrt(np.diag(fitted.covariance)[0::2])
    lasting = _places(fitted, (decay > 0) & (decay < 2 * errors))
    if lasting:
        what = f"the damping ratio at {lasting} cannot be told from zero at 95 %"
        cause = "hum, an excitation that goes on, or too short a decay"
        warnings.append(Finding("insignificant", f"{what}: {cause}"))
    growing = _places(fitted, decay <= 0)
    if growing:
        cause = "energy enters the structure, or it is an excitation"
        warnings.append(Finding("unphysical", f"the oscillation at {growing} does not decay: {cause}"))
    beats = missing.mode if missing is not None else None
    of_amplitude = [
        _amplitude_finding(mode, law, amplitudes[mode], missing if mode == beats else None)
        for mode, law in laws.items()
    ]
    gaining = [mode for mode, law in laws.items() if law.law.zeta_rest < -2 * np.sqrt(law.covariance[0, 0])]
    of_amplitude += [_gaining(mode, laws[mode].law.zeta_rest) for mode in gaining]
    if missing is not None and missing.white:
        of_amplitude.append(_beating(missing, fitted.poles.size))
    explained = laws and all(law.law.p_value >= MISMATCH_P for law in laws.values())
    mismatch = () if explained else _mismatch(tested)
    # What goes on to the end is not a decay: a law over the amplitude follows a part of it.
    return (*warnings, *mismatch, *of_amplitude) if tested.goes_on else (*warnings, *of_amplitude, *mismatch)


def _mismatch(tested: likelihood.Judged) -> tuple[Finding, ...]:
    p_value = min(tested.white, tested.amplitude)
    if p_value >= MISMATCH_P:
        return ()
    # What rings down with the decay is of the model, what does not is of something else.
    cause = (
        "it goes on to the end: a force that does not stop, such as wind or hum, dry friction, or "
        "coloured noise"
        if tested.goes_on
        else "another mode or hum, forced motion at the start, or coloured noise"
    )
    message = (
        f"what the fit leaves is not white noise ({chance_text(p_value)}), most of it near "
        f"{tested.strongest:.4g} Hz: {cause}. Intervals hold what the stretches of the decay scatter by. "
        "Raise `modes`, name a `band` around the mode, or begin later (`frf: {decay: {start: ...}}`)."
    )
    return (Finding("model-mismatch", message),)


def _places(fitted: likelihood.Decayed, chosen: BoolArray) -> str:
    return ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in fitted.poles[chosen])


def _amplitude_finding(mode: int, fitted: FittedLaw, first: float, missing: MissingMode | None) -> Finding:
    law = fitted.law
    change = 100 * law.frequency_slope * first / law.omega
    message = (
        f"mode {mode + 1}: damping or frequency depend on the amplitude, so zeta_{mode + 1} is a mean over "
        f"this decay, whose interval holds what its stretches scatter by. Damping ratio {law.zeta_rest:.4g} "
        f"at rest, {law.zeta_rest + law.zeta_slope * first:.4g} at the largest amplitude "
        f"(zeta_rest_{mode + 1}, zeta_slope_{mode + 1}); the frequency differs by {change:.2g} % there. "
        "Compare decays of one amplitude."
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
