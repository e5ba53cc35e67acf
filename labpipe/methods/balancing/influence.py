"""Balancing by influence coefficients: vibration z = z_0 + sum_q alpha_q w_q of every reading.

The weights are those of the least expected square of what is left, which do not trust an influence that is
hardly known; without noise -pinv(alpha) z_0 (Goodman 1964; Darlow 1989). What a model of the rotor says of
z_0 and alpha is a prior and runs are data: the model alone, runs alone and both are one estimate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
# Rounds of reweighting, and the 95 % quantile of chi-square of one number.
REWEIGHTED, PROFILE = 10, 3.841
# Directions and steps of a profile, and its end in standard deviations of both parts of a weight together.
DIRECTIONS, STEPS, FARTHEST = 48, 201, 4.0
# Rounds of least squares in which errors of the weights are weighed.
ROUNDS = 4


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
    its two parts, *share* [1] of its amplitude of both together. *weight*: that of a weight that is set, as
    a vector, as a share of it [1]; all readings of a run have its error in common.
    """

    floor: float
    share: float
    weight: float = 0.0

    def variance(self, readings: ComplexArray) -> FloatArray:
        """Of the complex readings, both components together, (n_run,) [unit of the reading squared]."""
        return 2 * self.floor**2 + (self.share * np.abs(readings)) ** 2

    def covariance(self, readings: ComplexArray, alpha: ComplexArray, weights: ComplexArray) -> ComplexArray:
        """E[e e^H] (n_reading, n_reading) [unit of the readings squared] of the readings of a run with
        *weights* (n_plane,) [kg m] under influences *alpha* (n_reading, n_plane) [unit of the readings, per
        kg m]. Equation (balance-errors).
        """
        by_weights = self.weight * alpha * np.abs(weights)
        return np.diag(self.variance(readings)).astype(np.complex128) + by_weights @ by_weights.conj().T

    def draws(
        self, readings: ComplexArray, alpha: ComplexArray, weights: ComplexArray, seed: int
    ) -> ComplexArray:
        """Drawn errors of the *readings* (n, n_reading) of a run with *weights* (n_plane,) [kg m] under
        influences *alpha* (n, n_reading, n_plane).
        """
        rng = np.random.default_rng(seed)
        error = _circular(rng, readings.shape) * np.sqrt(self.variance(readings))
        if not self.weight:
            return error
        turned = self.weight * weights * _circular(rng, (len(readings), weights.size))
        return error + (alpha @ turned[..., None])[..., 0]


def _circular(rng: np.random.Generator, shape: tuple[int, ...]) -> ComplexArray:
    """Circular normal numbers of E|e|^2 = 1."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


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
    def covariance_of_all(self) -> ComplexArray:
        """E[e e^H] of all errors e, (n_line, n_plane + 1, n_line, n_plane + 1) [units of the mean]."""
        parts, turn = self.joint.reshape(2, *self.mean.shape, 2, *self.mean.shape), np.array([1, 1j])
        return np.einsum("p,pliqmj,q->limj", turn, parts, turn.conj())

    @cached_property
    def covariance(self) -> ComplexArray:
        """E[e e^H] of the errors e of each line, (n_line, n_plane + 1, n_plane + 1) [units of the mean]."""
        return np.einsum("lilj->lij", self.covariance_of_all)

    def widen(self, factor: float) -> Influence:
        """With all errors *factor* times as large [1]."""
        return replace(self, joint=factor**2 * self.joint)

    def covariance_with(self, whole: ComplexArray) -> ComplexArray:
        """Of z_0 + alpha w (..., n_line, n_line) [unit of the readings squared], *whole* (1, w) (...,
        n_plane + 1).
        """
        return np.einsum("limj,...i,...j->...lm", self.covariance_of_all, whole, whole.conj(), optimize=True)

    def variance_with(self, whole: ComplexArray) -> FloatArray:
        """Of z_0 + alpha w (n_line,) [unit of the readings squared], *whole* (1, w)."""
        return np.diagonal(self.covariance_with(whole)).real

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
        self, weights: ComplexArray, errors: ComplexArray, lines: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of a run with *weights* (n_plane,) [kg m] and readings of the covariance *errors* (n_reading,
        n_reading) [unit of the readings squared] on *lines*: gain (n, 2 n_reading), covariance (n, n) after
        it, that of what surprises.
        """
        whole, places = np.concatenate([[1.0], weights]), np.arange(lines.size)
        design = np.zeros((2, lines.size, 2, *self.mean.shape))
        design[:, places, :, lines] = [[whole.real, -whole.imag], [whole.imag, whole.real]]
        design = design.reshape(2 * lines.size, -1)
        spread = design @ self.joint @ design.T + real_covariance(errors)
        gain = np.linalg.solve(spread, design @ self.joint).T
        return gain, self.joint - gain @ spread @ gain.T, spread

    def after(self, run: BalanceRun, noise: ReadingNoise) -> Influence:
        """What is known after one more run, whose readings are linear in z_0 and alpha."""
        lines = np.flatnonzero(np.isfinite(run.readings))
        readings = run.readings[lines]
        errors = noise.covariance(readings, self.mean[lines, 1:], run.weights)
        gain, joint, spread = self.gain(run.weights, errors, lines)
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
    readings = np.array([run.readings for run in runs])
    there = np.isfinite(readings)
    design = np.array([np.concatenate([[1.0], run.weights]) for run in runs])
    n_line, n_unknown = readings.shape[1], design.shape[1]
    scale = np.max(np.abs(design), axis=0)
    design /= np.where(scale > 0, scale, 1.0)
    for rows in there.T:
        if np.linalg.matrix_rank(design[rows], tol=1e-6) < n_unknown:
            raise DataError(
                f"{np.count_nonzero(rows)} runs with readings do not determine the influence of "
                f"{n_unknown - 1} plane(s)",
                hint="a run as found, and one for each plane with a trial weight there",
            )
    # All readings (n_reading,), run by run, on all unknowns (n_reading, n).
    whole = np.einsum("ru,lk->rlku", design, np.eye(n_line)).reshape(readings.size, -1)[there.ravel()]
    z, mean = readings[there], np.zeros((n_line, n_unknown), np.complex128)
    # Errors of the weights need the influence, which the first round finds without them.
    for _ in range(ROUNDS if noise.weight else 1):
        of_runs = [
            noise.covariance(run.readings[read], mean[read, 1:], run.weights)
            for run, read in zip(runs, there, strict=True)
        ]
        errors = scipy.linalg.block_diag(*of_runs)
        weighed = np.linalg.solve(errors, whole).conj().T
        covariance = np.linalg.inv(weighed @ whole)
        unknowns = covariance @ (weighed @ z)
        mean = unknowns.reshape(mean.shape) / scale
    residual = z - whole @ unknowns
    misfit = 2 * float((residual.conj() @ np.linalg.solve(errors, residual)).real)
    size = np.tile(scale, n_line)
    joint = real_covariance(np.asarray(covariance / np.outer(size, size), np.complex128))
    return Influence(mean, joint, misfit, 2 * (z.size - unknowns.size))


def real_covariance(covariance: ComplexArray) -> FloatArray:
    """Of all real, then all imaginary parts (2 n, 2 n) of circular numbers of E[e e^H] (n, n) [any unit]."""
    real, imaginary = covariance.real / 2, covariance.imag / 2
    return np.block([[real, -imaginary], [imaginary, real]])


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
    for direction, place, amounts in zip(
        directions, places, np.split(reached, np.cumsum(numbers)[:-1]), strict=True
    ):
        target = direction @ amounts
        least = scipy.optimize.linprog(
            np.ones(direction.size),
            A_eq=np.array([direction.real, direction.imag]) / place.radius,
            b_eq=np.array([target.real, target.imag]) / place.radius,
            bounds=(0.0, place.largest),
        )
        masses.append(least.x if least.success else amounts)
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
    left = left + noise.draws(left, drawn[..., 1:], weights, SEED + 1)
    sizes = np.abs(left)
    low, high = np.percentile(sizes, COVERED, axis=0)
    first, last = np.percentile(np.sqrt(np.mean(sizes**2, axis=1)), COVERED).tolist()
    before = float(np.sqrt(np.mean(np.abs(knowledge.mean[:, 0]) ** 2)))
    if weights.size < knowledge.mean.shape[0] and not knowledge.modelled:
        upper = most_unbalance(knowledge, weights, noise.weight)
    else:
        turned = 1 + noise.weight * _circular(np.random.default_rng(SEED + 5), (400, weights.size))
        upper = np.percentile(np.abs(_made_by_planes(drawn[:400]) + turned * weights), 95, axis=0)
    if knowledge.narrow is not None:
        below = residual_of(knowledge.narrow, weights, noise)
        first, low = min(first, below.interval[0]), np.minimum(low, below.low)
    rms, amplitudes = float(np.sqrt(np.mean(sizes**2))), np.sqrt(np.mean(sizes**2, axis=0))
    return RemainingVibration(rms, (first, last), before, amplitudes, low, high, upper)


def _made_by_planes(drawn: ComplexArray) -> ComplexArray:
    """pinv(alpha) z_0 of draws, (n, n_plane) [kg m]."""
    return (np.linalg.pinv(drawn[..., 1:]) @ drawn[..., :1])[..., 0]


def most_unbalance(knowledge: Influence, weights: ComplexArray, share: float) -> FloatArray:
    """Upper ends (n_plane,) [kg m] of |u + w| with *weights* w (n_plane,) [kg m] set to a *share* of
    themselves [1], by runs alone and more lines than planes: those of the 95 % profile interval of the
    unbalance u in the planes.

    -ln p(u) = r^H V^-1 r, r = z_0 - alpha u over the lines, V(u) its covariance, larger by what no u
    explains. Draws of alpha would tell u too well where planes act nearly alike, since noise makes their
    small difference larger. Equation (balance-unbalance).
    """
    # What is left of the interval for each u, the error of setting its weights may take.
    ends = [
        np.max(np.abs(made + weight) + share * abs(weight) * np.sqrt(room / 2))
        for weight, (made, room) in zip(weights, _profiles(knowledge), strict=True)
    ]
    return np.array(ends)


def _profiles(knowledge: Influence) -> Iterator[tuple[ComplexArray, FloatArray]]:
    """Of every plane the unbalances u_q (n,) [kg m] of its 95 % profile interval to all directions, and what
    each leaves of it (n,) [1].
    """
    z, alpha = knowledge.mean[:, 0], knowledge.mean[:, 1:]
    n_line, n_plane = alpha.shape
    root: ComplexArray = np.eye(n_line, dtype=np.complex128)
    for _ in range(REWEIGHTED):
        rows = np.linalg.solve(root, alpha)
        middle = np.linalg.lstsq(rows, np.linalg.solve(root, z), rcond=None)[0]
        root = np.linalg.cholesky(knowledge.covariance_with(np.concatenate([[1.0], -middle])))
    spread = np.linalg.inv(rows.conj().T @ rows)
    turns = np.exp(2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
    steps = (np.linspace(0.0, FARTHEST, STEPS)[:, None] * turns).reshape(-1, 1)
    for plane in range(n_plane):
        made = middle + steps * (spread[:, plane] / np.sqrt(spread[plane, plane].real))
        whole = np.column_stack([np.ones(len(made)), -made])
        left = whole @ knowledge.mean.T
        weighed = np.linalg.solve(knowledge.covariance_with(whole), left[..., None])[..., 0]
        square = np.sum(left.conj() * weighed, axis=1).real
        least = float(np.min(square))
        room = PROFILE * max(1.0, least / max(n_line - n_plane, 1)) - 2 * (square - least)
        yield made[room >= 0, plane], room[room >= 0]


@dataclass(frozen=True)
class WeightInterval:
    """95 % interval of a weight that leaves nothing: *size* [kg m] and *angle* [rad], None where it
    may be any.
    """

    size: tuple[float, float]
    angle: tuple[float, float] | None


def weight_intervals(knowledge: Influence, weights: ComplexArray) -> tuple[WeightInterval, ...]:
    """Of the weight in every plane, angles about those of *weights* (n_plane,) [kg m]; by a model from draws
    of what it knows, whose covariance has no inverse. None for fewer lines than planes.
    """
    if len(knowledge.mean) < weights.size:
        return ()
    every = [made for made, _ in _profiles(knowledge)] if not knowledge.modelled else []
    every = every or list(_made_by_planes(knowledge.draws(DRAWS // 10)).T)
    # Of a profile the ends themselves.
    covered = COVERED if knowledge.modelled else (0.0, 100.0)
    intervals: list[WeightInterval] = []
    for weight, made in zip(weights, every, strict=True):
        low, high = np.percentile(np.abs(made), covered).tolist()
        turned = np.percentile(np.angle(-made / weight), covered)
        first, last = (float(np.angle(weight) % (2 * np.pi)) + turned).tolist()
        intervals.append(WeightInterval((low, high), None if last - first > np.pi else (first, last)))
    return tuple(intervals)


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
    truths = knowledge.draws(TRIED)
    if not knowledge.modelled:
        # Unbalance in the planes, and what they cannot make.
        made = (truths[..., 1:] @ _made_by_planes(truths)[..., None])[..., 0]
        truths[..., 0] = made + _unreachable_part(knowledge)
    expected = {}
    for name, weights in candidates.items():
        whole = np.concatenate([[1.0], weights])
        size = np.sqrt(np.abs(knowledge.mean @ whole) ** 2 + knowledge.variance_with(whole))
        errors = noise.covariance(size, knowledge.mean[:, 1:], weights)
        gain, joint, _ = knowledge.gain(weights, errors, np.arange(n_line))
        sizes = np.broadcast_to(size, (TRIED, n_line))
        scatter = noise.draws(sizes, truths[..., 1:], weights, SEED + 2)
        means = knowledge.move(gain, (truths - knowledge.mean) @ whole + scatter).mean
        spread = replace(knowledge, joint=joint).covariance.sum(axis=0).T
        chosen = best_weights(means.conj().swapaxes(-1, -2) @ means + spread)
        left = (truths[..., 1:] @ chosen[..., None])[..., 0] + truths[..., 0]
        set_anew = np.abs(truths[..., 1:]) ** 2 @ (noise.weight * np.abs(chosen[..., None])) ** 2
        squares = np.sum(np.abs(left) ** 2 + noise.variance(left) + set_anew[..., 0], axis=-1)
        expected[name] = float(np.sqrt(np.mean(squares) / n_line))
    return expected
