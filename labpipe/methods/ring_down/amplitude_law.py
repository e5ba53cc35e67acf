"""Damping and frequency of a decay over its amplitude, and two close modes that look like it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.estimation.descent import linearised, minimise, sum_of_squares
from labpipe.methods.ring_down.likelihood import Decayed, Piece
from labpipe.methods.ring_down.residual_test import portmanteau
from labpipe.records.fit_details import AmplitudeLaw, OverAmplitude

# The law A' = -w (z0 + z1 A) A, phase' = w + s A of one mode, fitted to its decays.

SHARED = 4
# Step of the differences, in parameters scaled to order one: their rounding and their curvature both stay
# below 1e-5 of a slope.
STEP = 1e-5


@dataclass(frozen=True)
class FittedLaw:
    """The law with the covariance (4, 4) of zeta_rest [1], zeta_slope [1/unit], frequency_slope [rad/s/unit],
    omega [rad/s]; converged.

    squares: sum of the squares of what it leaves [1], over the variances that the exponential fit leaves.
    """

    law: AmplitudeLaw
    covariance: FloatArray
    converged: bool
    squares: float


def amplitude(time: FloatArray, first: float, omega: float, rest: float, slope: float) -> FloatArray:
    """A(t) (n_sample,) [unit of *first*] of A' = -w (z0 + z1 A) A from A(0) = *first* at *time* (n_sample,)
    [s].

    A = z0 A0 E / (z0 + z1 A0 (1 - E)), E = exp(-z0 w t): the solution of a Bernoulli equation. Equation
    (decay-law).
    """
    decay = np.exp(-rest * omega * time)
    return np.asarray(first * decay / (1 + slope * first * omega * time * _relative(rest * omega * time)))


def _relative(x: FloatArray) -> FloatArray:
    """(1 - e^-x) / x, 1 at x = 0."""
    safe = np.where(np.abs(x) < 1e-12, 1.0, x)
    return np.where(np.abs(x) < 1e-12, 1.0, -np.expm1(-safe) / safe)


def travelled(time: FloatArray, first: float, omega: float, rest: float, slope: float) -> FloatArray:
    """The integral of A over *time* (n_sample,) [unit of *first* times s]: ln(1 + z1 A0 (1 - E) / z0) / (w
    z1). Equation (decay-phase).
    """
    linear = first * time * _relative(rest * omega * time)
    bent = slope * omega * linear
    safe = np.where(np.abs(bent) < 1e-9, 1.0, bent)
    return np.asarray(
        linear * np.where(np.abs(bent) < 1e-9, 1.0, np.log1p(np.maximum(safe, -0.999999)) / safe)
    )


class _Problem:
    """Whitened residual of one mode's law over z0, z1, s and w relative to the exponential fit, then ln A0
    and phase of every piece.
    """

    def __init__(self, pieces: Sequence[Piece], fitted: Decayed, mode: int, output: int) -> None:
        self.pole = fitted.poles[mode]
        self.omega = abs(self.pole)
        self.zeta = -self.pole.real / self.omega
        self.pieces, self.deviation = pieces, np.sqrt(fitted.variance[:, output])
        self.amplitudes: ComplexArray = np.array(
            [solved.amplitudes[mode, output] for solved in fitted.pieces]
        )
        self.largest = float(np.max(np.abs(self.amplitudes)))
        self.ranges = [np.linalg.qr(piece.nuisance)[0] for piece in pieces]
        self.targets = [
            self._target(piece, number, fitted, mode, output) for number, piece in enumerate(pieces)
        ]
        self.size = float(
            np.sqrt(sum(np.sum((t / d) ** 2) for t, d in zip(self.targets, self.deviation, strict=True)))
        )

    def _target(self, piece: Piece, number: int, fitted: Decayed, mode: int, output: int) -> FloatArray:
        """The rows of one output without the other modes."""
        others = np.arange(fitted.poles.size) != mode
        course = (
            np.exp(piece.time[:, None] * fitted.poles_of(number)[others])
            @ fitted.pieces[number].amplitudes[others, output]
        )
        return self._free(number, piece.rows[:, output] - piece.project(course.real[:, None])[:, 0])

    def _free(self, number: int, rows: FloatArray) -> FloatArray:
        range_ = self.ranges[number]
        return np.asarray(rows - range_ @ (range_.T @ rows))

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
        """The model of one piece (n_row,) without its nuisance, whitened."""
        rest, slope, turn, omega = self.physical(parameters)
        log_first, phase = parameters[SHARED + 2 * number : SHARED + 2 * number + 2]
        first, piece = float(np.exp(min(log_first, 700.0))), self.pieces[number]
        size = amplitude(piece.time, first, omega, rest, slope)
        angle = omega * piece.time + turn * travelled(piece.time, first, omega, rest, slope) + phase
        return (
            self._free(number, piece.project((size * np.cos(angle))[:, None])[:, 0]) / self.deviation[number]
        )

    def residual(self, parameters: FloatArray) -> FloatArray:
        pairs = zip(self.targets, self.deviation, strict=True)
        return np.concatenate(
            [self.course(n, parameters) - target / deviation for n, (target, deviation) in enumerate(pairs)]
        )

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Central differences; amplitude and phase of a piece act on its own rows."""
        blocks = []
        for number in range(len(self.pieces)):
            block = np.zeros((self.targets[number].size, parameters.size))
            for column in (*range(SHARED), SHARED + 2 * number, SHARED + 2 * number + 1):
                step = STEP * self.zeta if column == SHARED - 1 else STEP
                change = np.zeros(parameters.size)
                change[column] = step
                block[:, column] = (
                    self.course(number, parameters + change) - self.course(number, parameters - change)
                ) / (2 * step)
            blocks.append(block)
        return np.concatenate(blocks)

    def chi2(self, parameters: FloatArray) -> float:
        return sum_of_squares(self.residual, parameters)


def fitted_law(pieces: Sequence[Piece], fitted: Decayed, mode: int, output: int) -> FittedLaw:
    """The law of a mode from all pieces of one output, from the exponential fit on.

    Standard errors from the residual it leaves.
    """
    problem = _Problem(pieces, fitted, mode, output)
    minimum = minimise(problem, problem.start, near=1e-4)
    linear = linearised(problem, minimum.values)
    inverse = np.linalg.pinv(linear.triangle * linear.scale, rcond=1e-15)
    nuisance = sum(range_.shape[1] for range_ in problem.ranges)
    noise = linear.chi2 / max(linear.n_equation - minimum.values.size - nuisance, 1)
    covariance = (inverse @ inverse.T)[:SHARED, :SHARED] * noise * np.outer(problem.units, problem.units)
    rest, slope, turn, omega = (float(value) for value in problem.physical(minimum.values))
    ends = np.cumsum([target.size for target in problem.targets])[:-1]
    parts = np.split(problem.residual(minimum.values), ends)
    series = [piece.series(part[:, None]) for piece, part in zip(pieces, parts, strict=True)]
    p_value = portmanteau(series, all(piece.lines is None for piece in pieces))
    return FittedLaw(
        AmplitudeLaw(omega, rest, slope, turn, p_value), covariance, minimum.converged, float(linear.chi2)
    )


# Damping and frequency of a decay over its amplitude: piece by piece, and as a law.

# Stretches of one decay at most, periods of one at least, and amplitudes over their standard error below
# which nothing is seen.
MOST_STRETCHES, LEAST_PERIODS, LEAST_RATIO = 16, 3.0, 10.0


@dataclass(frozen=True)
class Stretches:
    """A mode of one decay stretch by stretch: middle (n,) [s], complex amplitudes (n,) that decay, std_error
    (n,) [unit of the output].
    """

    middle: FloatArray
    amplitudes: ComplexArray
    std_error: FloatArray


def stretches(piece: Piece, fitted: Decayed, number: int, mode: int, output: int) -> Stretches:
    """Amplitudes of a mode of the piece of this *number* on stretches of its rows in time, everything else
    subtracted as fitted.

    Each is a least-squares fit of C e^(lambda t) with the fitted lambda to one stretch: what differs from a
    constant C is what one exponential does not say.
    """
    solved, pole = fitted.pieces[number], fitted.poles_of(number)[mode]
    n = piece.time.size
    count = int(
        min(
            MOST_STRETCHES,
            n * pole.imag / (2 * np.pi * LEAST_PERIODS) * (piece.time[-1] / n if n > 1 else 0.0),
        )
    )
    # The residual in time: of a band without what lies outside it.
    left = _in_time(piece, solved.residual[:, output])
    amplitude = solved.amplitudes[mode, output]
    course = np.exp(pole * piece.time)
    parts = [part for part in np.array_split(np.arange(n), max(count, 1)) if part.size > 4]
    variance = float(fitted.variance[number, output])
    middles, values, errors = [], [], []
    for part in parts:
        columns = np.stack([course[part].real, -course[part].imag], axis=1)
        change, _, rank, _ = np.linalg.lstsq(columns, left[part], rcond=None)
        if rank < 2:
            continue
        middle = float(np.mean(piece.time[part]))
        size = abs(np.exp(pole * middle))
        middles.append(middle)
        values.append((amplitude + change[0] + 1j * change[1]) * size)
        errors.append(np.sqrt(variance * np.trace(np.linalg.inv(columns.T @ columns)) / 2) * size)
    return Stretches(np.array(middles), np.array(values), np.array(errors))


def _in_time(piece: Piece, residual: FloatArray) -> FloatArray:
    """Rows (n_row,) of a residual as samples (n_sample,) [unit of the output]."""
    if piece.lines is None:
        return residual
    half = piece.lines.size
    spectrum = np.zeros(piece.time.size // 2 + 1, np.complex128)
    spectrum[piece.lines] = (residual[:half] + 1j * residual[half:]) * np.sqrt(piece.time.size / 2)
    return np.asarray(np.fft.irfft(spectrum, piece.time.size))


# Pairs of stretches that show what the values of one decay scatter by, and least degrees of freedom that they
# count as, since they are held against the fit and not against their mean.
FEWEST_STRETCHES, LEAST_DOF = 1, 2


def over_amplitude(pieces: Sequence[Piece], fitted: Decayed, mode: int, output: int) -> OverAmplitude:
    """Damping ratio and frequency between neighbouring stretches of all pieces, in ascending amplitude.

    ln(A_1 / A_2) / (w dt) and the turn of the phase between them; first-order standard errors. Equation
    (decay-stretches).
    """
    rows: list[tuple[float, ...]] = []
    for number, piece in enumerate(pieces):
        omega = abs(fitted.poles_of(number)[mode])
        course = stretches(piece, fitted, number, mode, output)
        size = np.abs(course.amplitudes)
        seen = int(np.argmin(np.append(size > LEAST_RATIO * course.std_error, False)))
        for k in range(seen - 1):
            span = course.middle[k + 1] - course.middle[k]
            spread = float(np.hypot(course.std_error[k] / size[k], course.std_error[k + 1] / size[k + 1]))
            turn = float(np.angle(course.amplitudes[k + 1] / course.amplitudes[k]))
            rows.append(
                (
                    float(np.sqrt(size[k] * size[k + 1])),
                    float(np.log(size[k] / size[k + 1])) / (omega * span),
                    spread / (omega * span),
                    (omega + turn / span) / (2 * np.pi),
                    spread / span / (2 * np.pi),
                )
            )
    table = np.array(sorted(rows)).reshape(-1, 5).T
    return OverAmplitude(*table)


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
    logs = (
        (
            np.log(2 * np.pi * curve.frequency[seen] / size),
            (curve.frequency_std_error / curve.frequency)[seen],
        ),
        (np.log(-curve.damping[seen] * size / pole.real), (curve.damping_std_error / curve.damping)[seen]),
    )
    spreads = []
    for off, error in logs:
        weight = 1 / (error**2 + np.median(error) ** 2)
        spreads.append(float(np.sqrt(max(np.average(off**2 - error**2, weights=weight), 0.0))))
    return spreads[0], spreads[1], max(n - 1, LEAST_DOF)


# One mode more than a fit has, where it explains better what looks like damping over amplitude: two close
# modes beat.

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
    is *better* [1].

    white: whether it leaves white noise; otherwise neither it nor the law explains the decay, and a law of
    another form may be as good.
    """

    mode: int
    frequencies: tuple[float, ...]
    better: float
    white: bool


def missing_mode(
    pieces: Sequence[Piece],
    fitted: Decayed,
    richer: Decayed,
    laws: dict[int, FittedLaw],
    strongest: dict[int, tuple[int, int]],
    *,
    white: bool,
) -> MissingMode | None:
    """What *richer*, with a mode more than *fitted*, explains better than the *laws* by their mode; None
    where it does not.

    *white*: whether it leaves white noise; otherwise it must leave less than the share LEFT of what the law
    leaves.

    N ln(S) + p ln(N) of both, S the squares left in the output in which the mode is strongest: a law has two
    parameters more than an exponential, a mode two more and two in every piece. Equation (decay-missing).
    """
    if not richer.converged or np.any(richer.poles.real >= 0):
        return None
    for mode, law in laws.items():
        output = strongest[mode][1]
        count = sum(piece.rows.shape[0] for piece in pieces)
        left = sum(
            _squares(solved.residual[:, output], fitted.variance[n, output])
            for n, solved in enumerate(richer.pieces)
        )
        better = count * float(np.log(law.squares / left)) - 2 * len(pieces) * float(np.log(count))
        if better > STRONG and (white or left < LEFT * law.squares):
            near = np.argsort(np.abs(richer.poles - fitted.poles[mode]))[:2]
            return MissingMode(
                mode, tuple(sorted(float(abs(richer.poles[n])) / (2 * np.pi) for n in near)), better, white
            )
    return None


def _squares(residual: FloatArray, variance: float) -> float:
    return float(np.sum(residual**2)) / float(variance)
