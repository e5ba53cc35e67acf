"""The law A' = -w (z0 + z1 A) A, phase' = w + s A of one mode, fitted to its decays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.decay.likelihood import Decayed
from labpipe.decay.pieces import Piece
from labpipe.decay.residual_test import portmanteau
from labpipe.optimise.levenberg import linearised, minimise, sum_of_squares
from labpipe.records.ring_down import AmplitudeLaw

SHARED = 4
# Step of the differences, in parameters scaled to order one: their rounding and their curvature both stay below 1e-5 of a slope.
STEP = 1e-5


@dataclass(frozen=True)
class FittedLaw:
    """The law with the covariance (4, 4) of zeta_rest [1], zeta_slope [1/unit], frequency_slope [rad/s/unit], omega [rad/s]; converged.

    squares: sum of the squares of what it leaves [1], over the variances that the exponential fit leaves.
    """

    law: AmplitudeLaw
    covariance: FloatArray
    converged: bool
    squares: float


def amplitude(time: FloatArray, first: float, omega: float, rest: float, slope: float) -> FloatArray:
    """A(t) (n_sample,) [unit of *first*] of A' = -w (z0 + z1 A) A from A(0) = *first* at *time* (n_sample,) [s].

    A = z0 A0 E / (z0 + z1 A0 (1 - E)), E = exp(-z0 w t): the solution of a Bernoulli equation. Equation (decay-law).
    """
    decay = np.exp(-rest * omega * time)
    return np.asarray(first * decay / (1 + slope * first * omega * time * _relative(rest * omega * time)))


def _relative(x: FloatArray) -> FloatArray:
    """(1 - e^-x) / x, 1 at x = 0."""
    safe = np.where(np.abs(x) < 1e-12, 1.0, x)
    return np.where(np.abs(x) < 1e-12, 1.0, -np.expm1(-safe) / safe)


def travelled(time: FloatArray, first: float, omega: float, rest: float, slope: float) -> FloatArray:
    """The integral of A over *time* (n_sample,) [unit of *first* times s]: ln(1 + z1 A0 (1 - E) / z0) / (w z1). Equation (decay-phase)."""
    linear = first * time * _relative(rest * omega * time)
    bent = slope * omega * linear
    safe = np.where(np.abs(bent) < 1e-9, 1.0, bent)
    return np.asarray(linear * np.where(np.abs(bent) < 1e-9, 1.0, np.log1p(np.maximum(safe, -0.999999)) / safe))


class _Problem:
    """Whitened residual of one mode's law over z0, z1, s and w relative to the exponential fit, then ln A0 and phase of every piece."""

    def __init__(self, pieces: Sequence[Piece], fitted: Decayed, mode: int, output: int) -> None:
        self.pole = fitted.poles[mode]
        self.omega = abs(self.pole)
        self.zeta = -self.pole.real / self.omega
        self.pieces, self.deviation = pieces, np.sqrt(fitted.variance[:, output])
        self.amplitudes: ComplexArray = np.array([solved.amplitudes[mode, output] for solved in fitted.pieces])
        self.largest = float(np.max(np.abs(self.amplitudes)))
        self.ranges = [np.linalg.qr(piece.nuisance)[0] for piece in pieces]
        self.targets = [self._target(piece, number, fitted, mode, output) for number, piece in enumerate(pieces)]
        self.size = float(np.sqrt(sum(np.sum((t / d) ** 2) for t, d in zip(self.targets, self.deviation, strict=True))))

    def _target(self, piece: Piece, number: int, fitted: Decayed, mode: int, output: int) -> FloatArray:
        """The rows of one output without the other modes."""
        others = np.arange(fitted.poles.size) != mode
        course = np.exp(piece.time[:, None] * fitted.poles[others]) @ fitted.pieces[number].amplitudes[others, output]
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
        return np.array([self.zeta, self.zeta / self.largest, self.zeta * self.omega / self.largest, self.omega])

    def course(self, number: int, parameters: FloatArray) -> FloatArray:
        """The model of one piece (n_row,) without its nuisance, whitened."""
        rest, slope, turn, omega = self.physical(parameters)
        log_first, phase = parameters[SHARED + 2 * number : SHARED + 2 * number + 2]
        first, piece = float(np.exp(min(log_first, 700.0))), self.pieces[number]
        size = amplitude(piece.time, first, omega, rest, slope)
        angle = omega * piece.time + turn * travelled(piece.time, first, omega, rest, slope) + phase
        return self._free(number, piece.project((size * np.cos(angle))[:, None])[:, 0]) / self.deviation[number]

    def residual(self, parameters: FloatArray) -> FloatArray:
        pairs = zip(self.targets, self.deviation, strict=True)
        return np.concatenate([self.course(n, parameters) - target / deviation for n, (target, deviation) in enumerate(pairs)])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Central differences; amplitude and phase of a piece act on its own rows."""
        blocks = []
        for number in range(len(self.pieces)):
            block = np.zeros((self.targets[number].size, parameters.size))
            for column in (*range(SHARED), SHARED + 2 * number, SHARED + 2 * number + 1):
                step = STEP * self.zeta if column == SHARED - 1 else STEP
                change = np.zeros(parameters.size)
                change[column] = step
                block[:, column] = (self.course(number, parameters + change) - self.course(number, parameters - change)) / (2 * step)
            blocks.append(block)
        return np.concatenate(blocks)

    def chi2(self, parameters: FloatArray) -> float:
        return sum_of_squares(self.residual, parameters)


def fitted_law(pieces: Sequence[Piece], fitted: Decayed, mode: int, output: int) -> FittedLaw:
    """The law of a mode from all pieces of one output, from the exponential fit on; standard errors from the residual it leaves."""
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
    return FittedLaw(AmplitudeLaw(omega, rest, slope, turn, p_value), covariance, minimum.converged, float(linear.chi2))
