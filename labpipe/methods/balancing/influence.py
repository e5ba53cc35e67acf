"""Balancing by influence coefficients: vibration z = z_0 + sum_q alpha_q w_q of every reading.

The weights are those of the least expected square of what is left, which do not trust an influence that is
hardly known; without noise -pinv(alpha) z_0 (Goodman 1964; Darlow 1989). What a model of the rotor says of
z_0 and alpha is a prior and runs are data: the model alone, runs alone and both are one estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.methods.rotor.posterior import root_of

# Draws of z_0 and alpha by which intervals are stated, and their seed.
DRAWS, SEED = 4000, 20261125
# Truths over which one more run is looked at.
TRIED = 200
COVERED = (2.5, 97.5)
# Rounds of reweighting, degrees of freedom and width of the draws about their result; the 95 % quantile of
# chi-square of one number.
REWEIGHTED, TAILS, WIDER, PROFILE = 10, 4, 2.0, 3.841


@dataclass(frozen=True)
class BalanceRun:
    """One run: added *weights* (n_plane,) [kg m], complex, as all angles in the direction of spin, and
    *readings* (n_line,), complex, NaN where there is none.
    """

    name: str
    weights: ComplexArray
    readings: ComplexArray


@dataclass(frozen=True)
class ReadingNoise:
    """Standard uncertainties of a reading when nothing is changed: *floor* [unit of the reading] of each of
    its two parts, *share* [1] of its amplitude of both together.
    """

    floor: float
    share: float

    def variance(self, readings: ComplexArray) -> FloatArray:
        """Of the complex readings, both components together, (n_run,) [unit of the reading squared]."""
        return 2 * self.floor**2 + (self.share * np.abs(readings)) ** 2


@dataclass(frozen=True)
class Influence:
    """z_0 and alpha of every line: *mean* (n_line, n_plane + 1) [unit of the readings, per kg m], *joint*
    covariance (n, n) of all real, then all imaginary parts, row by row; *misfit* chi-square of the readings,
    its *dof*; *modelled* by a rotor. narrow: without what the uncertainty of the model has widened, for lower
    ends.
    """

    mean: ComplexArray
    joint: FloatArray
    misfit: float = 0.0
    dof: int = 0
    modelled: bool = False
    narrow: Influence | None = None

    @cached_property
    def covariance(self) -> ComplexArray:
        """E[e e^H] of the errors e of each line, (n_line, n_plane + 1, n_plane + 1) [units of the mean]."""
        parts, turn = self.joint.reshape(2, *self.mean.shape, 2, *self.mean.shape), np.array([1, 1j])
        return np.einsum("p,pliqlj,q->lij", turn, parts, turn.conj())

    def variance_with(self, whole: ComplexArray) -> FloatArray:
        """Of z_0 + alpha w (n_line,) [unit of the readings squared], *whole* (1, w)."""
        return (self.covariance @ whole.conj() @ whole).real

    @property
    def square(self) -> ComplexArray:
        """Q (n_plane + 1, n_plane + 1) of the expected square (1, w)^H Q (1, w) [unit of the readings] with
        weights w [kg m].
        """
        return square_of(self.mean[None]) + self.covariance.sum(axis=0).T

    def draws(self, n: int = DRAWS) -> ComplexArray:
        """Drawn z_0 and alpha, (n, n_line, n_plane + 1) [unit of the readings, per kg m]."""
        normal = np.random.default_rng(SEED).standard_normal((n, 2 * self.mean.size))
        real, imaginary = np.split(normal @ root_of(self.joint).T, 2, axis=1)
        return self.mean + (real + 1j * imaginary).reshape(n, *self.mean.shape)

    def move(self, gain: FloatArray, surprise: ComplexArray) -> Influence:
        """With the mean moved by *gain* (n, 2 n_reading) [1, per kg m] times the *surprise* (..., n_reading)
        [unit of the readings].
        """
        moved = np.concatenate([surprise.real, surprise.imag], axis=-1) @ gain.T
        real, imaginary = np.split(moved, 2, axis=-1)
        at = (*surprise.shape[:-1], *self.mean.shape)
        return replace(self, mean=self.mean + (real + 1j * imaginary).reshape(at))

    def gain(
        self, weights: ComplexArray, variance: FloatArray, lines: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of a run with *weights* (n_plane,) [kg m] and readings of the *variance* (n_reading,) [unit of the
        readings squared] on *lines*: gain (n, 2 n_reading), covariance (n, n) after it, that of what
        surprises.
        """
        whole, places = np.concatenate([[1.0], weights]), np.arange(lines.size)
        seen = np.zeros((2, lines.size, 2, *self.mean.shape))
        seen[:, places, :, lines] = [[whole.real, -whole.imag], [whole.imag, whole.real]]
        seen = seen.reshape(2 * lines.size, -1)
        spread = seen @ self.joint @ seen.T + np.diag(np.tile(variance / 2, 2))
        gain = np.linalg.solve(spread, seen @ self.joint).T
        return gain, self.joint - gain @ spread @ gain.T, spread

    def after(self, run: BalanceRun, noise: ReadingNoise) -> Influence:
        """What is known after one more run, whose readings are linear in z_0 and alpha."""
        lines = np.flatnonzero(np.isfinite(run.readings))
        readings = run.readings[lines]
        gain, joint, spread = self.gain(run.weights, noise.variance(readings), lines)
        surprise = readings - self.mean[lines] @ np.concatenate([[1.0], run.weights])
        parts = np.concatenate([surprise.real, surprise.imag])
        misfit = self.misfit + float(parts @ np.linalg.solve(spread, parts))
        narrow = None if self.narrow is None else self.narrow.after(run, noise)
        moved = self.move(gain, surprise)
        return replace(moved, joint=joint, misfit=misfit, dof=self.dof + parts.size, narrow=narrow)


def influence(runs: Sequence[BalanceRun], noise: ReadingNoise, prior: Influence | None = None) -> Influence:
    """z_0 and alpha by all runs on a *prior*, or by weighted least squares line by line; DataError where the
    runs do not determine them then.
    """
    if prior is not None:
        return reduce(lambda knowledge, run: knowledge.after(run, noise), runs, prior)
    design = np.array([np.concatenate([[1.0], run.weights]) for run in runs])
    readings = np.array([run.readings for run in runs])
    n_line, n_unknown = readings.shape[1], design.shape[1]
    means = np.empty((n_line, n_unknown), np.complex128)
    joint = np.zeros((2, n_line, n_unknown, 2, n_line, n_unknown))
    misfit, dof = 0.0, 0
    scale = np.max(np.abs(design), axis=0)
    for line in range(n_line):
        there = np.isfinite(readings[:, line])
        rows, z = design[there] / np.where(scale > 0, scale, 1.0), readings[there, line]
        if np.linalg.matrix_rank(rows, tol=1e-6) < n_unknown:
            raise DataError(
                f"{len(z)} runs with readings do not determine the influence of {n_unknown - 1} plane(s)",
                hint="a run as found, and one for each plane with a trial weight there",
            )
        weight = 1 / noise.variance(z)
        information = (rows.conj().T * weight) @ rows
        inverse = np.linalg.inv(information)
        mean = inverse @ (rows.conj().T @ (weight * z))
        residual = z - rows @ mean
        misfit += float(2 * np.sum(weight * np.abs(residual) ** 2))
        dof += 2 * (len(z) - n_unknown)
        means[line] = mean / scale
        half = inverse / np.outer(scale, scale) / 2
        joint[0, line, :, 0, line] = joint[1, line, :, 1, line] = half.real
        joint[1, line, :, 0, line], joint[0, line, :, 1, line] = half.imag, -half.imag
    return Influence(means, joint.reshape(2 * means.size, -1), misfit, dof)


def square_of(drawn: ComplexArray) -> ComplexArray:
    """Q of draws of z_0 and alpha (n, n_line, n_plane + 1) [unit of the readings, per kg m], summed."""
    rows = drawn.reshape(-1, drawn.shape[-1])
    return rows.conj().T @ rows


def best_weights(square: ComplexArray) -> ComplexArray:
    """w = -A^-1 b (..., n_plane) [kg m] of the blocks of a *square* (..., n_plane + 1, n_plane + 1), which
    they make least. Equation (system-balance).
    """
    return -np.linalg.solve(square[..., 1:, 1:], square[..., 1:, :1])[..., 0]


def remaining_rms(drawn: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Root mean square over lines (...) [unit of the readings] of drawn z_0 + alpha w, (..., n_line, n_plane
    + 1), with *weights* w (n_plane,) [kg m].
    """
    left = drawn @ np.concatenate([[1.0], weights])
    return np.sqrt(np.mean(np.abs(left) ** 2, axis=-1))


@dataclass(frozen=True)
class Places:
    """Of weights in a plane: *angles* (n_place,) [rad] at *radius* [m], at most *largest* [kg] in each."""

    angles: FloatArray
    radius: float
    largest: float = np.inf


def placed_weights(knowledge: Influence, places: Sequence[Places]) -> list[FloatArray]:
    """Masses [kg] in every place of every plane, (n_place,) each: the least expected square that they can
    reach, by as little mass as that takes.
    """
    square, linear = knowledge.square[1:, 1:], knowledge.square[1:, 0]
    directions = [place.radius * np.exp(1j * place.angles) for place in places]
    root = np.linalg.cholesky(square).conj().T
    rows, side = root @ scipy.linalg.block_diag(*directions), -np.linalg.solve(root.conj().T, linear)
    numbers = [place.angles.size for place in places]
    largest = np.repeat([place.largest for place in places], numbers)
    scale = float(np.max(np.abs(rows)))
    reached = scipy.optimize.lsq_linear(
        np.concatenate([rows.real, rows.imag]) / scale,
        np.concatenate([side.real, side.imag]) / scale,
        (0.0, largest),
        method="bvls",
        tol=1e-14,
        max_iter=1000,
    ).x
    # Many masses make one vector: the least of them stand in two places, and in those that are full.
    masses = []
    for direction, place, found in zip(
        directions, places, np.split(reached, np.cumsum(numbers)[:-1]), strict=True
    ):
        target = direction @ found
        least = scipy.optimize.linprog(
            np.ones(direction.size),
            A_eq=np.array([direction.real, direction.imag]) / place.radius,
            b_eq=np.array([target.real, target.imag]) / place.radius,
            bounds=(0.0, place.largest),
        )
        masses.append(least.x if least.success else found)
    return masses


@dataclass(frozen=True)
class RemainingVibration:
    """What the weights are expected to leave: *rms* over the lines with its 95 % interval, of what was
    *before*; amplitudes (n_line,) with theirs [unit of the readings]; *unbalance* (n_plane,) [kg m], upper
    ends of 95 %.
    """

    rms: float
    interval: tuple[float, float]
    before: float
    amplitudes: FloatArray
    low: FloatArray
    high: FloatArray
    unbalance: FloatArray


def residual_of(knowledge: Influence, weights: ComplexArray, noise: ReadingNoise) -> RemainingVibration:
    """The vibration with *weights* (n_plane,) [kg m] set, as a reading shows it, by draws."""
    drawn = knowledge.draws()
    left = _drawn_residual(knowledge, drawn, np.concatenate([[1.0], weights]))
    rng = np.random.default_rng(SEED + 1)
    spread = np.sqrt(noise.variance(left) / 2)
    left = left + spread * (rng.standard_normal(left.shape) + 1j * rng.standard_normal(left.shape))
    sizes = np.abs(left)
    low, high = np.percentile(sizes, COVERED, axis=0)
    first, last = np.percentile(np.sqrt(np.mean(sizes**2, axis=1)), COVERED).tolist()
    before = float(np.sqrt(np.mean(np.abs(knowledge.mean[:, 0]) ** 2)))
    if weights.size < knowledge.mean.shape[0] and not knowledge.modelled:
        upper = most_unbalance(knowledge, weights)
    else:
        upper = np.percentile(np.abs(_made_by_planes(drawn[:400]) + weights), 95, axis=0)
    if knowledge.narrow is not None:
        below = residual_of(knowledge.narrow, weights, noise)
        first, low = min(first, below.interval[0]), np.minimum(low, below.low)
    rms, amplitudes = float(np.sqrt(np.mean(sizes**2))), np.sqrt(np.mean(sizes**2, axis=0))
    return RemainingVibration(rms, (first, last), before, amplitudes, low, high, upper)


def _made_by_planes(drawn: ComplexArray) -> ComplexArray:
    """pinv(alpha) z_0 of draws, (n, n_plane) [kg m]."""
    return (np.linalg.pinv(drawn[..., 1:]) @ drawn[..., :1])[..., 0]


def most_unbalance(knowledge: Influence, weights: ComplexArray) -> FloatArray:
    """Upper ends (n_plane,) [kg m] of |u + w| with *weights* w (n_plane,) [kg m], by runs alone and more
    lines than planes: those of the 95 % profile interval of the unbalance u in the planes, by draws about it.

    -ln p(u) = sum |z_0 - alpha u|^2 / s^2 over the lines, s^2 the variance of z_0 - alpha u, larger by what
    no u explains. Draws of alpha would tell u too well where planes act nearly alike, since noise makes their
    small difference larger. Equation (balance-unbalance).
    """
    z, alpha = knowledge.mean[:, 0], knowledge.mean[:, 1:]
    n_line, n_plane = alpha.shape
    deviation = np.ones(n_line)
    for _ in range(REWEIGHTED):
        rows = alpha / deviation[:, None]
        middle = np.linalg.lstsq(rows, z / deviation, rcond=None)[0]
        deviation = np.sqrt(knowledge.variance_with(np.concatenate([[1.0], -middle])))
    rng = np.random.default_rng(SEED + 4)
    normal = rng.standard_normal((2, DRAWS, n_plane)) / np.sqrt(rng.chisquare(TAILS, (DRAWS, 1)) / TAILS)
    root = np.linalg.inv(np.linalg.cholesky(rows.conj().T @ rows)).conj().T
    made = np.vstack([middle, middle + WIDER / np.sqrt(2) * (normal[0] + 1j * normal[1]) @ root.T])
    whole = np.column_stack([np.ones(len(made)), -made])
    variance = np.einsum("lij,di,dj->dl", knowledge.covariance, whole, whole.conj()).real
    square = np.sum(np.abs(whole @ knowledge.mean.T) ** 2 / variance, axis=1)
    least = float(np.min(square))
    likely = 2 * (square - least) <= PROFILE * max(1.0, least / (n_line - n_plane))
    return np.asarray(np.max(np.abs(made[likely] + weights), axis=0))


def _drawn_residual(knowledge: Influence, drawn: ComplexArray, whole: ComplexArray) -> ComplexArray:
    """z_0 + alpha w of the *drawn* z_0 and alpha, (n, n_line). What weights in these planes cannot change of
    the estimate is noise as far as its size is that of noise (empirical Bayes).
    """
    middle = knowledge.mean @ whole
    errors = drawn @ whole - middle
    n_line, n_plane = middle.size, whole.size - 1
    if n_line <= n_plane or knowledge.modelled:
        return middle + errors
    basis = np.linalg.svd(knowledge.mean[:, 1:], full_matrices=False)[0]
    within = errors @ basis.conj() @ basis.T
    beyond, fixed = errors - within, middle - basis @ (basis.conj().T @ middle)
    # Their common variance, by its posterior under a prior flat in the logarithm.
    n_free = n_line - n_plane
    noise = float(np.mean(np.sum(np.abs(beyond) ** 2, axis=1))) / n_free
    size = np.sum(np.abs(fixed) ** 2) / np.random.default_rng(SEED + 3).gamma(n_free, size=drawn.shape[0])
    share = np.maximum(1 - noise / np.maximum(size, 1e-300), 0.0)[:, None]
    return middle - fixed + within + share * fixed + np.sqrt(share) * beyond


def _unreachable_part(knowledge: Influence) -> ComplexArray:
    """What no weights change (n_line,) [unit of the readings], its square less that of noise, or zero."""
    whole = np.concatenate([[1.0], best_weights(knowledge.square)])
    deviation, n_free = np.sqrt(knowledge.variance_with(whole)), len(knowledge.mean) - whole.size + 1
    scaled = knowledge.mean / deviation[:, None]
    left = scaled @ np.concatenate([[1.0], -np.linalg.pinv(scaled[:, 1:]) @ scaled[:, 0]])
    excess = float(np.sum(np.abs(left) ** 2))
    if n_free < 1 or excess <= n_free:
        return 0 * left
    return left * deviation * np.sqrt(1 - n_free / excess)


def next_runs(
    knowledge: Influence, noise: ReadingNoise, candidates: Mapping[str, ComplexArray]
) -> dict[str, float]:
    """Expected root mean square of what is left as a reading shows it [unit of the readings] if one more run
    with the weights (n_plane,) [kg m] of each candidate came first: over draws of the truth, whose readings
    move the mean and narrow z_0 and alpha (preposterior analysis).
    """
    n_line = knowledge.mean.shape[0]
    rng = np.random.default_rng(SEED + 2)
    truths = knowledge.draws(TRIED)
    if not knowledge.modelled:
        # Unbalance in the planes, and what they cannot make.
        made = (truths[..., 1:] @ _made_by_planes(truths)[..., None])[..., 0]
        truths[..., 0] = made + _unreachable_part(knowledge)
    scatter = (rng.standard_normal((TRIED, n_line)) + 1j * rng.standard_normal((TRIED, n_line))) / np.sqrt(2)
    expected = {}
    for name, weights in candidates.items():
        whole = np.concatenate([[1.0], weights])
        square = np.abs(knowledge.mean @ whole) ** 2 + knowledge.variance_with(whole)
        variance = noise.variance(np.sqrt(square))
        gain, joint, _ = knowledge.gain(weights, variance, np.arange(n_line))
        means = knowledge.move(gain, (truths - knowledge.mean) @ whole + np.sqrt(variance) * scatter).mean
        spread = replace(knowledge, joint=joint).covariance.sum(axis=0).T
        chosen = best_weights(means.conj().swapaxes(-1, -2) @ means + spread)
        left = (truths[..., 1:] @ chosen[..., None])[..., 0] + truths[..., 0]
        squares = np.sum(np.abs(left) ** 2 + noise.variance(left), axis=-1)
        expected[name] = float(np.sqrt(np.mean(squares) / n_line))
    return expected
