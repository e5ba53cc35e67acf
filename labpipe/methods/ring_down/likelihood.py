"""Maximum likelihood of decaying oscillations: y = offset + sum Re(C e^(lambda t)), pieces of the record,
start values, and whether what is left is white noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from scipy import fft
from scipy.linalg import solve_triangular

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.distributions import chi2_tail, f_tail
from labpipe.errors import FitError
from labpipe.records.finding import Finding, note
from labpipe.records.spectra import FreeDecay, FreeDecays
from labpipe.spectra.bands import lines_in

# Smooth terms along the lines of a band, which carry what modes outside it add.
SMOOTH_TERMS = 3
# Fewest lines of a decay in a band.
LEAST_LINES = 4 * SMOOTH_TERMS


@dataclass(frozen=True)
class Piece:
    """One decay whose rows carry white noise: *rows* (n_row, n_output) [unit of the outputs]. Without a band
    a row is a sample, and the *nuisance* (n_row, n) [1] is the offset. With a band the rows are the real and
    imaginary parts of its DFT *lines* (n_line,): white noise is white there as well, and a mode outside the
    band adds C (1 - z^n) / (1 - z e^-jw) [unit], which is smooth in it. time (n_sample,) [s].
    """

    time: FloatArray
    rows: FloatArray
    lines: IntArray | None
    nuisance: FloatArray

    @cached_property
    def _range(self) -> FloatArray:
        return np.linalg.qr(self.nuisance)[0]

    def free(self, rows: FloatArray) -> FloatArray:
        """*rows* (n_row, ...) [any unit] without what the nuisance explains."""
        return rows - self._range @ (self._range.T @ rows)

    def project(self, columns: FloatArray) -> FloatArray:
        """The rows (n_row, n) of functions of time (n_sample, n) [any unit]: orthonormal, so that noise keeps
        its size.
        """
        return _rows(columns, self.lines)

    def series(self, rows: FloatArray) -> ComplexArray:
        """Rows (n_row, n) [any unit] as a series (n, n) in time: the samples, or the band as a complex
        baseband.
        """
        if self.lines is None:
            return rows.astype(np.complex128)
        half = self.lines.size
        return fft.ifft(rows[:half] + 1j * rows[half:], axis=0) * np.sqrt(half)


def _rows(columns: FloatArray, lines: IntArray | None) -> FloatArray:
    if lines is None:
        return columns
    spectrum = fft.rfft(columns, axis=0)[lines] * np.sqrt(2 / columns.shape[0])
    return np.concatenate([spectrum.real, spectrum.imag])


def pieces_of(
    decays: Sequence[FreeDecay], columns: Sequence[int], rate: float, band: tuple[float, float] | None
) -> tuple[Piece, ...]:
    """The pieces of the decays' outputs *columns* at *rate* [Hz] in a *band* [Hz]. FitError where the band
    holds too few lines.
    """
    return tuple(_piece(decay.samples[:, list(columns)], rate, band) for decay in decays)


def _lines_of(n: int, rate: float, band: tuple[float, float]) -> IntArray:
    frequency = fft.rfftfreq(n, 1 / rate)
    return np.flatnonzero(lines_in(frequency, band) & (frequency > 0) & (frequency < rate / 2))


def long_enough(
    decays: FreeDecays, band: tuple[float, float] | None
) -> tuple[FreeDecays, tuple[Finding, ...]]:
    """The decays with the lines that a fit in the *band* [Hz] asks for, and a note of the others; all of them
    where none has them.
    """
    if band is None:
        return decays, ()
    kept: list[FreeDecay] = []
    short: list[FreeDecay] = []
    for decay in decays.decays:
        n_line = _lines_of(decay.samples.shape[0], decays.sample_rate, band).size
        (short if n_line < LEAST_LINES else kept).append(decay)
    if not kept or not short:
        return decays, ()
    places = ", ".join(f"{decay.start:.3f} s" for decay in short)
    what = f"of {len(decays.decays)} decays those at {places} are too short for the band and are left out"
    return replace(decays, decays=tuple(kept)), (note("repeat-left-out", what),)


def _piece(samples: FloatArray, rate: float, band: tuple[float, float] | None) -> Piece:
    n = samples.shape[0]
    time = np.arange(n) / rate
    if band is None:
        return Piece(time, samples, None, np.ones((n, 1)))
    lines = _lines_of(n, rate, band)
    if lines.size < LEAST_LINES:
        what = f"{lines.size} lines of a decay of {n / rate:g} s lie in the band {band[0]:g}-{band[1]:g} Hz"
        raise FitError(what, hint=f"widen the band to {LEAST_LINES} lines or more")
    powers = np.polynomial.legendre.legvander(np.linspace(-1, 1, lines.size), SMOOTH_TERMS - 1)
    empty = np.zeros_like(powers)
    return Piece(time, _rows(samples, lines), lines, np.block([[powers, empty], [empty, powers]]))


MOST_STEPS = 60
MOST_HALVINGS = 12
# The descent ends where a further step is this small against the standard errors.
NEGLIGIBLE = 1e-5
# Relative step at which rounding decides, for decays without noise.
ROUNDING = 1e-12


@dataclass(frozen=True)
class SolvedPiece:
    """One piece at given poles: amplitudes C (n_mode, n_output) [unit of the output], residual (n_row,
    n_output) [same unit]. range_ (n_row, n): orthonormal columns [1] of the piece's linear part. tangent
    (n_row, 2 n_mode): t e^(lambda t), real and imaginary parts [s], without what the linear part explains.
    """

    amplitudes: ComplexArray
    residual: FloatArray
    range_: FloatArray
    tangent: FloatArray


def rows_by_samples(piece: Piece, poles: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Rows (n_row, 2 n_mode) of e^(lambda t) [1] and t e^(lambda t) [s], real and imaginary parts, at *poles*
    (n_mode,) [rad/s].
    """
    # Poles far from any solution may grow beyond all numbers on the way.
    time = piece.time[:, None]
    course = np.exp(np.minimum(time * poles.real, 50.0) + 1j * time * poles.imag)
    moments = time * course
    modes, tangent = (np.concatenate([part.real, part.imag], axis=1) for part in (course, moments))
    return piece.project(modes), piece.project(tangent)


# Distance of a pole from a line [1] below which differences of sums lose digits.
ON_LINE = 1e-7


def rows_by_sums(piece: Piece, poles: ComplexArray) -> tuple[FloatArray, FloatArray] | None:
    """Rows (n_row, 2 n_mode) [1], [s] as of `rows_by_samples` in a band at *poles* (n_mode,) [rad/s], in a
    twentieth of the time. With q = e^(lambda dt - 2 pi j k / n) at line k sum q^m = (1 - q^n) / (1 - q), sum
    m q^m = (q sum q^m - n q^n) / (1 - q). None without a band, of poles on a line and of those that grow too
    far. Equation (decay-sums).
    """
    n, step = piece.time.size, piece.time[-1] / max(piece.time.size - 1, 1)
    if piece.lines is None or np.max(poles.real) * n * step > 1:
        return None
    pairs = np.concatenate([poles, poles.conj()])
    q = np.exp(pairs * step - 2j * np.pi * piece.lines[:, None] / n)
    if np.min(np.abs(1 - q)) < ON_LINE:
        return None
    last = np.exp(pairs * step * n)
    sums = (1 - last) / (1 - q)
    rows = []
    for part in (sums, step * (q * sums - n * last) / (1 - q)):
        pole, conjugate = np.split(part * np.sqrt(2 / n), 2, axis=1)
        spectrum = np.concatenate([(pole + conjugate) / 2, (pole - conjugate) / 2j], axis=1)
        rows.append(np.concatenate([spectrum.real, spectrum.imag]))
    return rows[0], rows[1]


def solve(piece: Piece, poles: ComplexArray) -> SolvedPiece:
    """Amplitudes and residual of a piece at *poles* (n_mode,) [rad/s]. Equation (decay-model)."""
    modes, tangent = rows_by_sums(piece, poles) or rows_by_samples(piece, poles)
    n_mode = poles.size
    range_, triangle = np.linalg.qr(np.concatenate([modes, piece.nuisance], axis=1))
    shares = range_.T @ piece.rows
    if np.min(np.abs(np.diag(triangle))) <= 1e-14 * np.max(np.abs(np.diag(triangle))):
        raise FitError("two modes of the decay became one")
    factors = solve_triangular(triangle, shares)
    return SolvedPiece(
        factors[:n_mode] - 1j * factors[n_mode : 2 * n_mode],
        piece.rows - range_ @ shares,
        range_,
        tangent - range_ @ (range_.T @ tangent),
    )


@dataclass(frozen=True)
class Decayed:
    """The fitted modes: *poles* (n_mode,) [rad/s] by ascending frequency, *covariance* (2 n_mode, 2 n_mode)
    [rad^2/s^2] of Re, Im of each. variance (n_piece, n_output) [unit^2 of the output]: of the noise of one
    row. dof: equations less parameters. *each* (n_piece, n_mode) [rad/s]: the poles of every piece where they
    are its own.
    """

    poles: ComplexArray
    covariance: FloatArray
    variance: FloatArray
    dof: int
    pieces: tuple[SolvedPiece, ...]
    converged: bool
    steps: int
    each: ComplexArray | None = None

    def poles_of(self, number: int) -> ComplexArray:
        """Poles (n_mode,) [rad/s] of the piece of this number."""
        return self.poles if self.each is None else self.each[number]

    @property
    def misfit(self) -> float:
        """Sum of n ln s^2, less is more likely [1]."""
        rows = np.array([solved.residual.shape[0] for solved in self.pieces])
        return float(np.sum(rows[:, None] * np.log(self.variance)))


def maximum_likelihood(pieces: Sequence[Piece], start: ComplexArray) -> Decayed:
    """The most likely poles from *start* (n_mode,) [rad/s] on, with the Cramer-Rao bound as their covariance.
    Gauss-Newton on the residual that is left when amplitudes and offsets are eliminated (Golub and Pereyra
    1973, with the Jacobian of Kaufman 1975): the Schur complement of the poles in the Fisher information. The
    noise of each decay and output is that of its residual. FitError where two modes become one. Equation
    (decay-likelihood).
    """
    poles, solved = start, [solve(piece, start) for piece in pieces]
    converged, steps = False, 0
    while steps < MOST_STEPS and not converged:
        steps += 1
        information, slope = _normal_equations(solved, _variances(solved, poles.size))
        step = np.linalg.lstsq(information, slope, rcond=1e-14)[0]
        size = float(np.sqrt(max(float(step @ information @ step), 0.0)))
        if size < NEGLIGIBLE or np.max(np.abs(step)) < ROUNDING * np.max(np.abs(poles)):
            converged = True
            break
        better = _shorter_until_better(pieces, solved, poles, step)
        if better is None:
            # No step is more likely: at the minimum to rounding, or stuck.
            converged = size < 100 * NEGLIGIBLE
            break
        poles, solved = better
    return _decay(poles, solved, converged, steps)


def energies(pieces: Sequence[Piece], fitted: Decayed) -> FloatArray:
    """Sum of squares (n_mode,) [1] of every mode over all pieces, each relative to its noise."""
    total = np.zeros(fitted.poles.size)
    for number, (piece, solved) in enumerate(zip(pieces, fitted.pieces, strict=True)):
        course = np.exp(piece.time[:, None] * fitted.poles_of(number))
        for amplitudes, variance in zip(solved.amplitudes.T, fitted.variance[number], strict=True):
            total += np.sum(piece.project((course * amplitudes).real) ** 2, axis=0) / variance
    return total


def noise_chance(pieces: Sequence[Piece], fitted: Decayed) -> FloatArray:
    """Chance (n_mode,) [1] by which noise alone would give a mode so much energy on one of all rows, at most.
    The amplitude of every output of every piece is free: chi-square with two degrees of freedom for each.
    """
    rows, dof = sum(piece.rows.size for piece in pieces), 2 * fitted.variance.size
    return np.array([rows * chi2_tail(energy, dof) for energy in energies(pieces, fitted).tolist()])


def _decay(poles: ComplexArray, solved: Sequence[SolvedPiece], converged: bool, steps: int) -> Decayed:
    order = np.argsort(poles.imag)
    variance = _variances(solved, poles.size)
    information, _ = _normal_equations(solved, variance)
    covariance = np.linalg.pinv(information, rcond=1e-15, hermitian=True)
    columns = np.concatenate([order, order + poles.size])
    places = columns.reshape(2, -1).T.ravel()
    equations = sum(part.residual.size for part in solved)
    linear = sum(part.range_.shape[1] * part.residual.shape[1] for part in solved)
    ordered = tuple(
        replace(part, amplitudes=part.amplitudes[order], tangent=part.tangent[:, columns]) for part in solved
    )
    dof = equations - linear - 2 * poles.size
    covariance = covariance[np.ix_(places, places)]
    return Decayed(poles[order], covariance, variance, dof, ordered, converged, steps)


def _variances(solved: Sequence[SolvedPiece], n_mode: int) -> FloatArray:
    """Noise variance (n_piece, n_output) of one row; the poles count as parameters in equal shares."""
    n_series = sum(part.residual.shape[1] for part in solved)
    variances, real = [], np.finfo(float)
    for part in solved:
        dof = max(part.residual.shape[0] - part.range_.shape[1] - 2 * n_mode / n_series, 1.0)
        # Decays without noise leave rounding, which has a size as well.
        floor = real.eps**2 * np.sum(np.abs(part.amplitudes) ** 2, axis=0) + real.tiny
        variances.append(np.maximum(np.sum(part.residual**2, axis=0) / dof, floor))
    return np.array(variances)


def _normal_equations(solved: Sequence[SolvedPiece], variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    n_mode = solved[0].amplitudes.shape[0]
    information, slope = np.zeros((2 * n_mode, 2 * n_mode)), np.zeros(2 * n_mode)
    for part, variances in zip(solved, variance, strict=True):
        gram, products = part.tangent.T @ part.tangent, part.tangent.T @ part.residual
        for output, of_output in enumerate(variances):
            amplitudes = part.amplitudes[:, output]
            p, q = np.diag(amplitudes.real), np.diag(-amplitudes.imag)
            chain = np.block([[p, q], [q, -p]])
            information += chain.T @ gram @ chain / of_output
            slope += chain.T @ products[:, output] / of_output
    return information, slope


def _shorter_until_better(
    pieces: Sequence[Piece], solved: Sequence[SolvedPiece], poles: ComplexArray, step: FloatArray
) -> tuple[ComplexArray, list[SolvedPiece]] | None:
    before = _misfit(solved)
    change = step[: poles.size] + 1j * step[poles.size :]
    for _ in range(MOST_HALVINGS):
        moved = poles + change
        if np.all(moved.imag > 0):
            attempt = [solve(piece, moved) for piece in pieces]
            if _misfit(attempt) < before:
                return moved, attempt
        change = change / 2
    return None


def _misfit(solved: Sequence[SolvedPiece]) -> float:
    tiny = np.finfo(float).tiny
    return sum(
        float(part.residual.shape[0] * np.sum(np.log(np.sum(part.residual**2, axis=0) + tiny)))
        for part in solved
    )


# Samples of the decimated record, series of them, and how many ranks beyond that of the modes are tried.
MOST_SAMPLES, MOST_SERIES = 600, 4
RANKS = (0, 1, 2, 4)
# Minima count as one when their -2 ln likelihood differs by less.
SAME = 1e-3
# The decimated rate over the highest frequency that stands out.
SAMPLES_PER_PERIOD = 4.0
# A line stands out when its power is this many times the median.
STANDS_OUT = 30.0
# Half length of the decimating filter in decimated samples; the ends of the record that it sees are dropped.
FILTER = 10


def most_likely(
    decays: Sequence[FreeDecay],
    columns: Sequence[int],
    pieces: Sequence[Piece],
    rate: float,
    band: tuple[float, float] | None,
    n_mode: int,
) -> Decayed:
    """The most likely fit from all starts; FitError where none leads to *n_mode* modes."""
    columns, band = list(columns), band and (band[0], min(band[1], rate / 2))
    strongest = sorted(decays, key=lambda decay: -float(np.max(np.var(decay.samples[:, columns], axis=0))))
    series = [decay.samples[:, column] for decay in strongest for column in columns][:MOST_SERIES]
    thinned, slower = _decimate(series, rate, band, n_mode)
    fits: list[Decayed] = []
    for extra in RANKS:
        start = pencil_poles(thinned, slower, n_mode, 2 * (n_mode + extra), band)
        if start is None:
            continue
        try:
            fit = _follow(pieces, start, round(MOST_SAMPLES * rate / slower), band)
        except FitError:
            continue
        if fit.converged and any(other.converged and abs(other.misfit - fit.misfit) < SAME for other in fits):
            break
        fits.append(fit)
    if not fits:
        what = f"no {n_mode} decaying oscillation(s) stand out of the noise"
        where = f" in {band[0]:g}-{band[1]:g} Hz" if band else ""
        raise FitError(what + where, hint="fewer `modes`, another `band`, or a decay that begins earlier")
    return min(fits, key=lambda fit: (not fit.converged, fit.misfit))


def _follow(
    pieces: Sequence[Piece], poles: ComplexArray, n_sample: int, band: tuple[float, float] | None
) -> Decayed:
    """Over pieces of doubling length, so that the phase of a long record is never lost by a whole turn."""
    longest = max(piece.time.size for piece in pieces)
    while band is None and n_sample < longest:
        first = slice(n_sample)
        parts = [Piece(of.time[first], of.rows[first], None, of.nuisance[first]) for of in pieces]
        poles = maximum_likelihood(parts, poles).poles
        n_sample *= 2
    return maximum_likelihood(pieces, poles)


def pencil_poles(
    series: Sequence[FloatArray], rate: float, n_mode: int, rank: int, band: tuple[float, float] | None = None
) -> ComplexArray | None:
    """The *n_mode* strongest oscillating poles (n_mode,) [rad/s] of series (n_sample,) [any unit] at *rate*
    [Hz]; None without so many. Matrix pencil (Hua and Sarkar 1990) in the form of a shift-invariant subspace:
    the first *rank* left singular vectors of the Hankel matrix of all series. Equation (decay-pencil).
    """
    rows = min(samples.size for samples in series) // 3
    if rows <= rank + 1:
        what = f"the decay is {3 * rows} samples of its highest frequency long"
        raise FitError(what, hint="a longer decay, or a wider `band`")
    windows = [np.lib.stride_tricks.sliding_window_view(samples, rows).T for samples in series]
    hankel = np.concatenate(windows, axis=1)
    vectors = np.linalg.eigh(hankel @ hankel.T)[1][:, -rank:]
    turns = np.linalg.eigvals(np.linalg.lstsq(vectors[:-1], vectors[1:], rcond=None)[0])
    turns = turns[(turns.imag > 1e-9) & (np.abs(turns) > 0)]
    poles = np.asarray(np.log(turns) * rate, np.complex128)
    low, high = 2 * np.pi * np.array(band or (0.0, np.inf))
    poles = poles[(poles.imag > low) & (poles.imag < high) & (np.abs(poles.real) < poles.imag)]
    if poles.size < n_mode:
        return None
    steps = poles / rate
    energy = np.zeros(steps.size)
    for samples in series:
        course = np.exp(np.arange(samples.size)[:, None] * (np.minimum(steps.real, 0.0) + 1j * steps.imag))
        both = np.concatenate([course.real, course.imag], axis=1)
        factors = np.linalg.lstsq(both, samples, rcond=None)[0]
        sizes = np.hypot(factors[: steps.size], factors[steps.size :])
        energy += sizes**2 * np.sum(np.abs(course) ** 2, axis=0)
    return poles[np.argsort(-energy)[:n_mode]]


def _decimate(
    series: Sequence[FloatArray], rate: float, band: tuple[float, float] | None, n_mode: int
) -> tuple[list[FloatArray], float]:
    """At the least rate [Hz] that shows their modes, without offset, at most MOST_SAMPLES of each."""
    centred = [_filter(samples - np.mean(samples), rate, band) for samples in series]
    factor = max(1, int(rate / (SAMPLES_PER_PERIOD * _highest(centred[0], rate, band, n_mode))))
    if factor == 1:
        return [samples[:MOST_SAMPLES] for samples in centred], rate
    slow = [scipy.signal.resample_poly(samples, 1, factor) for samples in centred]
    inside = [
        samples[FILTER:-FILTER][:MOST_SAMPLES] if samples.size > 4 * FILTER else samples for samples in slow
    ]
    return inside, rate / factor


def _filter(samples: FloatArray, rate: float, band: tuple[float, float] | None) -> FloatArray:
    if band is None:
        return samples
    frequency = fft.rfftfreq(samples.size, 1 / rate)
    edge = 0.2 * (band[1] - band[0])
    gain = np.clip(np.minimum(frequency - band[0] + edge, band[1] + edge - frequency) / edge, 0.0, 1.0)
    spoilt = min(int(rate / edge), samples.size // 4)
    whole = fft.irfft(fft.rfft(samples) * (3 - 2 * gain) * gain**2, samples.size)
    return whole[spoilt:-spoilt]


def _highest(samples: FloatArray, rate: float, band: tuple[float, float] | None, n_mode: int) -> float:
    if band is not None:
        return band[1]
    power = np.abs(fft.rfft(samples)) ** 2
    inner = power[1:-1]
    is_peak = (inner >= power[:-2]) & (inner >= power[2:]) & (inner > STANDS_OUT * np.median(power))
    peaks = np.flatnonzero(is_peak) + 1
    strongest = peaks[np.argsort(-power[peaks])][: 2 * n_mode]
    return 1.2 * max((int(np.max(strongest)) if strongest.size else power.size - 1), 1) * rate / samples.size


LAGS = 32
# Rows of a piece for each lag: what the parameters took of the residual must stay small against a lag.
ROWS_PER_LAG = 8
# Singular value of the columns of a test below which one of them is a sum of the others.
DEPENDENT = 1e-6
# Mean square of a residual at the end over that at the beginning from which it goes on.
GOES_ON = 0.5


@dataclass(frozen=True)
class Judged:
    """Chances of such a residual in white noise [1], and the frequency [Hz] at which most of it is left.
    amplitude: by terms that follow the amplitude of each mode (damping or frequency that depend on it).
    white: by likeness of neighbouring samples, and by the strongest line, the lesser times two. ending: mean
    square of the residual in the last third of the decays over that in the first third.
    """

    amplitude: float
    white: float
    strongest: float
    ending: float

    @property
    def goes_on(self) -> bool:
        """Whether the residual does not die away with the decay."""
        return self.ending > GOES_ON


def judge(pieces: Sequence[Piece], fitted: Decayed, rate: float) -> Judged:
    """The residuals of all *pieces* at *rate* [Hz] together."""
    rows = list(zip(pieces, fitted.pieces, strict=True))
    series = [piece.series(solved.residual) for piece, solved in rows]
    line, strongest = _strongest_line(list(zip(pieces, series, strict=True)), rate)
    alike = portmanteau(series, all(piece.lines is None for piece in pieces))
    white = min(1.0, 2 * min(alike, line))
    return Judged(_next_terms(rows, fitted.poles), white, strongest, ending_of(series))


def ending_of(residuals: Sequence[ComplexArray]) -> float:
    """Power of the last third of *residuals*, each (n_sample, n) [1], over that of the first [1]."""
    squares = np.zeros(3)
    for series in residuals:
        thirds = np.array_split(series / np.std(series, axis=0), 3)
        squares += [float(np.mean(np.abs(part) ** 2)) for part in thirds]
    return float(squares[2] / squares[0]) if squares[0] > 0 else 1.0


def _next_terms(rows: Sequence[tuple[Piece, SolvedPiece]], poles: ComplexArray) -> float:
    """F-test of |E| E and |E|^2 E, E = e^(lambda t), the first terms of a damping or frequency over
    amplitude; exact for white noise.
    """
    explained, left, numerator, denominator = 0.0, 0.0, 0, 0
    for piece, solved in rows:
        course = np.exp(piece.time[:, None] * poles)
        terms = np.concatenate([course * np.abs(course) ** power for power in (1, 2)], axis=1)
        columns = piece.project(np.concatenate([terms.real, terms.imag], axis=1))
        basis = np.concatenate([solved.range_, _orthonormal(solved.tangent)], axis=1)
        fresh = _orthonormal(columns - basis @ (basis.T @ columns), np.linalg.norm(columns, axis=0))
        scaled = solved.residual / np.sqrt(np.mean(solved.residual**2, axis=0))
        power = float(np.sum((fresh.T @ scaled) ** 2))
        explained += power
        left += float(np.sum(scaled**2)) - power
        numerator += fresh.shape[1] * scaled.shape[1]
        denominator += (piece.rows.shape[0] - basis.shape[1] - fresh.shape[1]) * scaled.shape[1]
    if numerator == 0 or denominator <= 0 or left <= 0:
        return 1.0
    return f_tail((explained / numerator) / (left / denominator), numerator, denominator)


def _orthonormal(columns: FloatArray, sizes: FloatArray | None = None) -> FloatArray:
    """Orthonormal columns of the same range; those that are nothing against *sizes* (n,) are left out."""
    scale = np.linalg.norm(columns, axis=0) if sizes is None else sizes
    vectors, singular, _ = np.linalg.svd(columns / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return vectors[:, singular > DEPENDENT]


def portmanteau(residuals: Sequence[ComplexArray], real: bool) -> float:
    """Chance [1] of so much likeness of neighbours in white noise, of series (n, n_output) [any unit]; *real*
    or complex ones. Q = n (n + 2) sum |r_d|^2 / (n - d) over lags d is chi-square with one degree of freedom
    per lag (Ljung and Box 1978), of complex circular series 2 Q with two. Equation (decay-portmanteau).
    """
    statistic, dof = 0.0, 0
    for series in residuals:
        n = series.shape[0]
        lags = min(LAGS, n // ROWS_PER_LAG)
        for column in series.T:
            likeness = fft.ifft(np.abs(fft.fft(column, 2 * n)) ** 2)[: lags + 1]
            ratios = np.abs(likeness[1:] / likeness[0].real) ** 2
            statistic += float(n * (n + 2) * np.sum(ratios / (n - np.arange(1, lags + 1))))
            dof += lags
    return chi2_tail(statistic, dof) if real else chi2_tail(2 * statistic, 2 * dof)


def _strongest_line(residuals: Sequence[tuple[Piece, ComplexArray]], rate: float) -> tuple[float, float]:
    """Chance of so strong a line among all, and its frequency [Hz] (Fisher 1929: (1 - g)^(m - 1) m
    at most).
    """
    chance, frequency, n_series = 1.0, 0.0, 0
    for piece, series in residuals:
        n = piece.time.size
        lines = np.arange(1, (n + 1) // 2) if piece.lines is None else piece.lines
        power = np.abs(fft.fft(series, axis=0)) ** 2
        power = power[1 : lines.size + 1] if piece.lines is None else power
        for column in power.T:
            n_series += 1
            share = float(np.max(column) / np.sum(column))
            p_value = min(1.0, lines.size * (1 - share) ** (lines.size - 1))
            if p_value < chance or frequency == 0.0:
                chance, frequency = min(chance, p_value), float(lines[np.argmax(column)] * rate / n)
    return min(1.0, chance * n_series), frequency
