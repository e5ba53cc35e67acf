"""Maximum likelihood of decaying oscillations: y = offset + sum Re(C e^(lambda t)), offset and C eliminated (variable projection)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.decay.pieces import Piece
from labpipe.errors import FitError

MOST_STEPS = 60
MOST_HALVINGS = 12
# The descent ends where a further step is this small against the standard errors.
NEGLIGIBLE = 1e-5
# Relative step at which rounding decides, for decays without noise.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Solved:
    """One piece at given poles: amplitudes C (n_mode, n_output) [unit of the output], residual (n_row, n_output) [same unit].

    range_ (n_row, n): orthonormal columns [1] of the piece's linear part. tangent (n_row, 2 n_mode): t e^(lambda t), real and imaginary
    parts [s], without what the linear part explains.
    """

    amplitudes: ComplexArray
    residual: FloatArray
    range_: FloatArray
    tangent: FloatArray


def solve(piece: Piece, poles: ComplexArray) -> Solved:
    """Amplitudes and residual of a piece at *poles* (n_mode,) [rad/s]. Equation (decay-model)."""
    # Poles far from any solution may grow beyond all numbers on the way.
    course = np.exp(np.minimum((piece.time[:, None] * poles.real), 50.0) + 1j * piece.time[:, None] * poles.imag)
    n_mode = poles.size
    modes = piece.project(np.concatenate([course.real, course.imag], axis=1))
    range_, triangle = np.linalg.qr(np.concatenate([modes, piece.nuisance], axis=1))
    shares = range_.T @ piece.rows
    if np.min(np.abs(np.diag(triangle))) <= 1e-14 * np.max(np.abs(np.diag(triangle))):
        raise FitError("two modes of the decay became one")
    factors = solve_triangular(triangle, shares)
    moments = piece.time[:, None] * course
    tangent = piece.project(np.concatenate([moments.real, moments.imag], axis=1))
    return Solved(
        factors[:n_mode] - 1j * factors[n_mode : 2 * n_mode],
        piece.rows - range_ @ shares,
        range_,
        tangent - range_ @ (range_.T @ tangent),
    )


@dataclass(frozen=True)
class Decayed:
    """The fitted modes: *poles* (n_mode,) [rad/s] by ascending frequency, *covariance* (2 n_mode, 2 n_mode) [rad^2/s^2] of Re, Im of each.

    variance (n_piece, n_output) [unit^2 of the output]: of the noise of one row. dof: equations less parameters.
    """

    poles: ComplexArray
    covariance: FloatArray
    variance: FloatArray
    dof: int
    pieces: tuple[Solved, ...]
    converged: bool
    steps: int

    @property
    def misfit(self) -> float:
        """Sum of n ln s^2, less is more likely [1]."""
        rows = np.array([solved.residual.shape[0] for solved in self.pieces])
        return float(np.sum(rows[:, None] * np.log(self.variance)))


def maximum_likelihood(pieces: Sequence[Piece], start: ComplexArray) -> Decayed:
    """The most likely poles from *start* (n_mode,) [rad/s] on, with the Cramer-Rao bound as their covariance.

    Gauss-Newton on the residual that is left when amplitudes and offsets are eliminated (Golub and Pereyra 1973, with the Jacobian of
    Kaufman 1975): the Schur complement of the poles in the Fisher information. The noise of each decay and output is that of its residual.
    FitError where two modes become one. Equation (decay-likelihood).
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
    return _decayed(poles, solved, converged, steps)


def energies(pieces: Sequence[Piece], fitted: Decayed) -> FloatArray:
    """Sum of squares (n_mode,) [1] of every mode over all pieces, each relative to its noise."""
    total = np.zeros(fitted.poles.size)
    for piece, solved, variance in zip(pieces, fitted.pieces, fitted.variance, strict=True):
        course = np.exp(piece.time[:, None] * fitted.poles)
        for amplitudes, variance_of_output in zip(solved.amplitudes.T, variance, strict=True):
            total += np.sum(piece.project((course * amplitudes).real) ** 2, axis=0) / variance_of_output
    return total


def _decayed(poles: ComplexArray, solved: Sequence[Solved], converged: bool, steps: int) -> Decayed:
    order = np.argsort(poles.imag)
    variance = _variances(solved, poles.size)
    information, _ = _normal_equations(solved, variance)
    covariance = np.linalg.pinv(information, rcond=1e-15, hermitian=True)
    places = np.concatenate([order, order + poles.size]).reshape(2, -1).T.reshape(-1)
    equations = sum(part.residual.size for part in solved)
    linear = sum(part.range_.shape[1] * part.residual.shape[1] for part in solved)
    return Decayed(
        poles[order],
        covariance[np.ix_(places, places)],
        variance,
        equations - linear - 2 * poles.size,
        tuple(_sorted(part, order) for part in solved),
        converged,
        steps,
    )


def _sorted(solved: Solved, order: IntArray) -> Solved:
    tangent = solved.tangent[:, np.concatenate([order, order + order.size])]
    return Solved(solved.amplitudes[order], solved.residual, solved.range_, tangent)


def _variances(solved: Sequence[Solved], n_mode: int) -> FloatArray:
    """Noise variance (n_piece, n_output) of one row; the poles count as parameters in equal shares."""
    n_series = sum(part.residual.shape[1] for part in solved)
    rows = [
        np.sum(part.residual**2, axis=0) / max(part.residual.shape[0] - part.range_.shape[1] - 2 * n_mode / n_series, 1.0)
        for part in solved
    ]
    # Decays without noise leave rounding, which has a size as well.
    floor = [np.finfo(float).eps ** 2 * np.sum(np.abs(part.amplitudes) ** 2, axis=0) + np.finfo(float).tiny for part in solved]
    return np.maximum(rows, floor)


def _normal_equations(solved: Sequence[Solved], variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information (2 n_mode, 2 n_mode) of (Re lambda, Im lambda) and its right side, in 1 / (rad/s)."""
    n_mode = solved[0].amplitudes.shape[0]
    information, slope = np.zeros((2 * n_mode, 2 * n_mode)), np.zeros(2 * n_mode)
    for part, variances in zip(solved, variance, strict=True):
        gram, products = part.tangent.T @ part.tangent, part.tangent.T @ part.residual
        for output, of_output in enumerate(variances):
            chain = _chain(part.amplitudes[:, output])
            information += chain.T @ gram @ chain / of_output
            slope += chain.T @ products[:, output] / of_output
    return information, slope


def _chain(amplitudes: ComplexArray) -> FloatArray:
    """What multiplies the tangent columns for d/dRe and d/dIm of every pole: Re(C t e^(lambda t)), Re(jC t e^(lambda t))."""
    p, q = np.diag(amplitudes.real), np.diag(-amplitudes.imag)
    return np.block([[p, q], [q, -p]])


def _shorter_until_better(
    pieces: Sequence[Piece], solved: Sequence[Solved], poles: ComplexArray, step: FloatArray
) -> tuple[ComplexArray, list[Solved]] | None:
    """The poles after the step, halved until they are more likely; None where none is."""
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


def _misfit(solved: Sequence[Solved]) -> float:
    tiny = np.finfo(float).tiny
    return sum(float(part.residual.shape[0] * np.sum(np.log(np.sum(part.residual**2, axis=0) + tiny))) for part in solved)
