"""Poles of all orders by p-LSCF, the choice of the physical ones by stabilisation, and how many modes and
residual terms the data ask for.

H A(z) = B(z) with real polynomials of z = e^(-s T) and a common right denominator A of size (n_input,
n_input): Guillaume, Verboven, Vanlanduit, Van der Auweraer and Peeters, IMAC 2003. All normal equations are
Toeplitz in the powers of z, so that the sums of z^m, z^m H and z^m H^H H over the lines are all that the data
contribute.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray, modal_assurance
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.modal.likelihood import (
    FrfLines,
    Refined,
    ResidualTerms,
    refine,
    refine_lines,
    remaining,
    whiteness,
)
from labpipe.records.finding import NORMAL

# Position of the highest line in the period of z: below 1, so that the conjugate images of the band stay
# apart.
TOP_OF_PERIOD = 0.95
# Largest part of the frequencies that may lie below the band without a new origin.
MOST_BELOW = 0.2
# Distance of a new origin from the band, as part of its width.
BELOW_BAND = 0.1
# Relative size of eigenvalues of the normal matrix that rounding leaves of zero (noise-free FRFs of few
# modes).
ROUNDING = 1e-13


@dataclass(frozen=True)
class Poles:
    """Stable poles: *values* (n,) [rad/s] with positive imaginary part, *participation* (n, n_input) [1] of
    length 1, *orders* (n,).
    """

    values: ComplexArray
    participation: ComplexArray
    orders: IntArray

    def at(self, chosen: IntArray | BoolArray) -> Poles:
        """The poles of these numbers (n,), or of this mask [-]."""
        return Poles(self.values[chosen], self.participation[chosen], self.orders[chosen])


@dataclass(frozen=True)
class DenominatorEquations:
    """Normal matrices M of the denominator for every order, from order 1 up to the highest: (n_order, blocks,
    blocks), blocks = (order + 1) n_input filled. z = exp(-(s - j origin) T): *origin* [rad/s], *period* T
    [s]; *scale* (n_input,) of the references.
    """

    matrices: tuple[FloatArray, ...]
    origin: float
    period: float
    scale: FloatArray

    @property
    def n_input(self) -> int:
        return int(self.scale.size)

    def poles(self, order: int, *, stable_noise: bool = False) -> Poles:
        """Poles of a model of *order*; *stable_noise*: constraint A_0 = I in place of A_n = I.

        Equation (modal-poles).
        """
        n = self.n_input
        matrix = self.matrices[order - 1]
        if stable_noise:
            coefficients = _solve(matrix[n:, n:], -matrix[n:, :n]).reshape(order, n, n)[::-1]
        else:
            coefficients = _solve(matrix[:-n, :-n], -matrix[:-n, -n:]).reshape(order, n, n)
        roots = _roots(coefficients)
        with np.errstate(divide="ignore"):
            values = np.asarray(np.log(roots) * (1 if stable_noise else -1) / self.period, np.complex128)
        keep = (values.real < 0) & (values.imag > 0)
        participation = _null_vectors(coefficients, roots[keep]) / self.scale
        participation /= np.linalg.norm(participation, axis=1, keepdims=True)
        return Poles(values[keep] + 1j * self.origin, participation, np.full(len(participation), order))


def normal_equations(omega: FloatArray, matrix: ComplexArray, highest: int) -> DenominatorEquations:
    """Normal matrices of all orders up to *highest* from FRFs *matrix* (n_line, n_output, n_input) at *omega*
    (n_line,) [rad/s].

    Every output and every reference has the weight of the reciprocal of its root mean square. Equation
    (modal-lscf).
    """
    n_line, _n_output, n_input = matrix.shape
    scale = 1 / np.sqrt(np.mean(np.abs(matrix) ** 2, axis=(0, 1)))
    scaled = matrix * scale
    scaled = scaled / np.sqrt(np.mean(np.abs(scaled) ** 2, axis=(0, 2)))[None, :, None]
    # From a band far above 0 Hz z would see an arc only, and its powers be alike; a new origin makes the band
    # half the circle again. It lies below the band, since real coefficients make the FRF real there.
    lowest, top = float(omega[0]), float(omega[-1])
    origin = lowest - BELOW_BAND * (top - lowest) if lowest > MOST_BELOW * top else 0.0
    period = TOP_OF_PERIOD * np.pi / (top - origin)
    lags = np.exp(-1j * period * (omega - origin)[:, None] * np.arange(highest + 1))
    gram = np.matmul(scaled.conj().swapaxes(1, 2), scaled).reshape(n_line, -1)
    of_z = np.sum(lags, axis=0).real
    of_h = _both_lags(lags, scaled.reshape(n_line, -1)).reshape(2 * highest + 1, *matrix.shape[1:])
    of_g = _both_lags(lags, gram).reshape(2 * highest + 1, n_input, n_input)
    difference = np.arange(highest + 1)[None, :] - np.arange(highest + 1)[:, None]
    gram_of_z = of_z[np.abs(difference)]
    try:
        factor = np.linalg.cholesky(gram_of_z)
    except np.linalg.LinAlgError:
        # Lines with a gap cover too little of the circle to tell high powers of z apart.
        factor = np.linalg.cholesky(gram_of_z + ROUNDING * n_line * highest * np.eye(highest + 1))
    right = -of_h[difference + highest].transpose(0, 2, 1, 3).reshape(highest + 1, -1)
    rows = np.linalg.solve(factor, right).reshape(highest + 1, -1, (highest + 1) * n_input)
    total = of_g[difference + highest].transpose(0, 2, 1, 3).reshape((highest + 1) * n_input, -1)
    matrices = []
    for order in range(highest + 1):
        size = (order + 1) * n_input
        total = total - rows[order].T @ rows[order]
        matrices.append((total[:size, :size] + total[:size, :size].T) / 2)
    return DenominatorEquations(tuple(matrices[1:]), origin, period, scale)


def _both_lags(lags: ComplexArray, values: ComplexArray) -> FloatArray:
    """Real part of the sums over lines of z^m *values*, m from -highest to highest."""
    forward = (lags.T @ values).real
    return np.concatenate([(lags.conj().T @ values).real[:0:-1], forward])


def _solve(matrix: FloatArray, right_side: FloatArray) -> FloatArray:
    """Without the eigenvalues that rounding leaves of zero: noise-free data make the matrix singular."""
    try:
        diagonal = np.diag(np.linalg.cholesky(matrix))
        if diagonal.min() ** 2 > ROUNDING * diagonal.max() ** 2:
            return np.linalg.solve(matrix, right_side)
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(matrix)
    keep = values > ROUNDING * values[-1]
    return vectors[:, keep] @ ((vectors[:, keep].T @ right_side) / values[keep, None])


def _roots(coefficients: FloatArray) -> ComplexArray:
    """Roots (order n_input,) of det(I z^order + sum A_k z^k): eigenvalues of the block companion matrix of
    *coefficients* (order, n_input, n_input), A_0 first.
    """
    order, n, _ = coefficients.shape
    companion = np.zeros((order * n, order * n))
    companion[:-n, n:] = np.eye((order - 1) * n)
    companion[-n:] = -coefficients.transpose(2, 0, 1).reshape(n, -1)
    return np.asarray(np.linalg.eigvals(companion), np.complex128)


def _null_vectors(coefficients: FloatArray, roots: ComplexArray) -> ComplexArray:
    """Left null vectors (n, n_input) of I z^order + sum A_k z^k at *roots* z (n,)."""
    order, n, _ = coefficients.shape
    # Over the largest of their powers, so that none overflows.
    powers = roots[:, None] ** (np.arange(order + 1) - order * (np.abs(roots) > 1)[:, None])
    every = np.concatenate([coefficients, np.eye(n)[None]]).reshape(order + 1, n * n)
    transposed = (powers @ every).reshape(-1, n, n).swapaxes(1, 2)
    return np.linalg.svd(transposed)[2][:, -1].conj()


# Two poles of different orders are one mode where they differ by less than half the decay rate and a share of
# the frequency, and act on the references alike.
SHARE_OF_DECAY, SHARE_OF_FREQUENCY, ALIKE = 0.5, 2e-4, 0.7
# A mode returns in this share of the orders from FIRST_ORDER on; lower orders cannot hold all modes of the
# band.
LEAST_SHARE, FIRST_ORDER = 0.25, 10
# Lowest order of the diagram: one pole is no choice.
LOWEST_ORDER = 2
# Damping ratio above which a pole describes the background of the band.
MOST_DAMPING = 0.5
# Of more orders than this one in two shows as much.
MANY_ORDERS = 40
# Number of highest orders whose poles with least bias are averaged.
HIGH_ORDERS = 8


@dataclass(frozen=True)
class Diagram:
    """Poles of all orders [rad/s], and the modes chosen from them: *poles*; *group* (n_pole,): index of the
    mode, -1 for none.

    *modes*: one row per mode, ascending in frequency; *counted*: orders in which a mode may return.
    """

    poles: Poles
    group: IntArray
    modes: Poles
    counted: list[int]

    def returns(self, values: ComplexArray, participation: ComplexArray) -> FloatArray:
        """Share (n,) [1] of the orders that have a pole at each of *values* (n,) [rad/s], *participation* (n,
        n_input) [1]: how sure it is that each is a mode.
        """
        near = _mark_near(self.poles, values, participation)
        return np.array([np.mean(np.isin(self.counted, self.poles.orders[at])) for at in near])


def stabilisation(
    equations: DenominatorEquations, band: tuple[float, float], highest: int, lowest: int = 1
) -> Diagram:
    """The diagram of the orders *lowest* to *highest* and the modes inside *band* [rad/s] that it shows; of
    many orders every second one.

    Equation (modal-stable).
    """
    orders = range(highest, max(lowest, LOWEST_ORDER) - 1, -(1 + highest // MANY_ORDERS))
    parts = [_inside(equations.poles(order), band) for order in orders]
    poles = Poles(*(np.concatenate(of) for of in zip(*(vars(part).values() for part in parts), strict=True)))
    counted = [order for order in orders if order >= min(FIRST_ORDER, highest)]
    group = pole_groups(poles, counted)
    modes = _select_least_biased(equations, poles, group, band, counted[:HIGH_ORDERS])
    return Diagram(poles, group, modes, counted)


# Share by which named frequencies differ that are two modes, whichever pole is the nearest.
APART = 0.01


def nearest_modes(equations: DenominatorEquations, frequencies: FloatArray, order: int) -> Poles:
    """The pole of *order* nearest to each of *frequencies* (n,) [rad/s], for a choice by hand; of a lower
    order where that has none. Frequencies that are APART have poles of their own.

    No pole where no order has one.
    """
    of_orders = (equations.poles(lower) for lower in range(order, 0, -1))
    poles = next((poles for poles in of_orders if poles.values.size), None)
    if poles is None:
        return equations.poles(order)
    distance = np.abs(np.abs(poles.values) - frequencies[:, None])
    index = np.argmin(distance, axis=1)
    apart = frequencies.size <= poles.values.size and np.all(np.diff(np.log(np.sort(frequencies))) > APART)
    if apart and np.unique(index).size < index.size:
        index = scipy.optimize.linear_sum_assignment(distance)[1]
    return poles.at(index)


def damping_ratio(poles: ComplexArray) -> FloatArray:
    """-Re / |pole| [1] of *poles* (n,)."""
    return -poles.real / np.abs(poles)


def _inside(poles: Poles, band: tuple[float, float]) -> Poles:
    frequency = np.abs(poles.values)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    return poles.at(inside & (damping_ratio(poles.values) < MOST_DAMPING))


def _mark_near(poles: Poles, values: ComplexArray, participation: ComplexArray) -> BoolArray:
    limit = SHARE_OF_DECAY * np.abs(values.real) + SHARE_OF_FREQUENCY * np.abs(values)
    return (np.abs(values[:, None] - poles.values) < limit[:, None]) & (
        modal_assurance(participation, poles.participation) > ALIKE
    )


def pole_groups(poles: Poles, counted: list[int]) -> IntArray:
    """Number (n_pole,) [1] of the mode that each pole returns as in the orders *counted*, -1 for none.

    The pole with neighbours in most orders takes them out, until none returns in enough orders.
    """
    group = np.full(poles.values.size, -1)
    near = _mark_near(poles, poles.values, poles.participation)
    position = {order: n for n, order in enumerate(counted)}
    column = np.array([position.get(int(order), -1) for order in poles.orders], np.intp)
    centres: list[int] = []
    while True:
        free = near & (group < 0) & (group < 0)[:, None] & (column >= 0)
        present = np.zeros((poles.values.size, len(counted)), np.bool_)
        rows, members = np.nonzero(free)
        present[rows, column[members]] = True
        count = np.sum(present, axis=1)
        if count.size == 0 or count.max() < LEAST_SHARE * len(counted):
            break
        # Of the poles with the most neighbours the one nearest to their median.
        best = np.flatnonzero(count == count.max())
        centre = int(best[np.argmin(np.abs(poles.values[best] - _median(poles.values[best])))])
        group[near[centre] & (group < 0)] = len(centres)
        centres.append(centre)
    # Numbers of the modes in ascending frequency, and -1 for poles of none, which is the last place.
    rank = np.append(np.argsort(np.argsort(np.abs(poles.values[centres]))), -1)
    return np.asarray(rank[group], np.intp)


def _select_least_biased(
    equations: DenominatorEquations,
    poles: Poles,
    group: IntArray,
    band: tuple[float, float],
    orders: list[int],
) -> Poles:
    """At each high order the nearest pole by the constraint of least bias, then the median."""
    n_mode = int(group.max(initial=-1)) + 1
    centre = np.empty(n_mode, np.complex128)
    participation = np.empty((n_mode, equations.n_input), np.complex128)
    for mode in range(n_mode):
        of_mode = poles.values[group == mode]
        centre[mode] = _median(of_mode)
        nearest = np.argmin(np.abs(of_mode - centre[mode]))
        participation[mode] = poles.participation[group == mode][nearest]
    near_poles: list[list[complex]] = [[] for _ in range(n_mode)]
    for order in orders if n_mode else ():
        refined = _inside(equations.poles(order, stable_noise=True), (0.9 * band[0], 1.1 * band[1]))
        for mode, alike in enumerate(_mark_near(refined, centre, participation)):
            near = refined.values[alike]
            if near.size:
                near_poles[mode].append(near[np.argmin(np.abs(near - centre[mode]))])
    medians = [_median(np.array(near)) if near else centre[mode] for mode, near in enumerate(near_poles)]
    return Poles(np.array(medians, np.complex128), participation, np.full(n_mode, max(orders)))


def _median(values: ComplexArray) -> complex:
    return complex(np.median(values.real), np.median(values.imag))


# Number of residual terms by the information criterion, grown one term at a time from the refined modes.

MOST_LOWER, MOST_UPPER = 3, 8
# Steps of a trial: the modes move little by one term more.
TRIAL_STEPS = 1


def refine_with_terms(
    lines: FrfLines, poles: ComplexArray, participation: ComplexArray
) -> tuple[Refined, ResidualTerms]:
    """The refined modes and the residual terms of least AIC = 2 n_line sum ln(residual) + 2 parameters, or
    one to either side where no more are asked for.

    *poles* (n_mode,) [rad/s], *participation* (n_mode, n_input) [1].
    """
    terms = ResidualTerms(lines, 1, 1)
    best = refine(terms, poles, participation, TRIAL_STEPS)
    while lines.adds_terms:
        sizes = ((terms.lower + 1, terms.upper), (terms.lower, terms.upper + 1))
        trials = [
            (refine(more, best.poles, best.participation, TRIAL_STEPS), more)
            for more in (ResidualTerms(lines, lower, upper) for lower, upper in sizes)
            if more.lower <= MOST_LOWER and more.upper <= MOST_UPPER
            if more.count + 2 * poles.size < lines.omega.size
        ]
        if not trials:
            break
        refined, more = min(trials, key=lambda trial: criterion(*trial))
        if criterion(refined, more) >= criterion(best, terms):
            break
        best, terms = refined, more
    return refine(terms, best.poles, best.participation), terms


def criterion(refined: Refined, terms: ResidualTerms) -> float:
    """AIC [1]: a term has a complex factor in every FRF; a mode a pole, a shape, and a participation of which
    one entry is given.

    Equation (modal-aic).
    """
    _, n_output, n_input = terms.lines.matrix.shape
    n_complex = n_output * n_input * terms.count + refined.poles.size * (n_output + n_input)
    return refined.information + 4 * n_complex


MOST_ADDED = 4
# Modes beyond the edges of the band that are looked for, one for each in most cases.
MOST_BESIDE = 2
# Least decrease of AIC that a mode is added for (Burnham and Anderson 2002, sec. 2.6).
SUPPORT = 10.0
# Least decay rate as part of the distance of the lines: a sharper peak is the noise of one line.
SHARPEST = 0.01
# Largest half-power width as part of the band: a broader mode is what the residual terms are, a smooth curve.
BROADEST = 0.5
# Two poles of like participation closer than this part of their decay rate are one pole that differs from
# point to point.
DISTINCT, ALIKE_MODES = 0.25, 0.9
# Distance in decay rates, a half-power width, within which poles that are not seen may hide each other.
OVERLAP = 2.0
# Probability by noise alone, anywhere in the band, below which a mode, or a misfit, counts as seen.
SEEN_P = 1e-3


@dataclass(frozen=True)
class Completed:
    """Refined modes with the terms of their residual, and the number of modes added."""

    refined: Refined
    terms: ResidualTerms
    added: int = 0

    @cached_property
    def p_noise(self) -> float:
        """Probability [1] of the residual as noise."""
        return whiteness(remaining(self.terms, self.refined), self.terms.lines.correlation)


def kept_modes(refined: Refined, terms: ResidualTerms) -> tuple[Refined, ResidualTerms, tuple[str, ...]]:
    """The modes inside the band, not as broad as it, that stand out of the noise, refined again without the
    others; notes name these. Of several poles on one mode, which hide each other, the clearest is judged
    again by itself.

    FitError where none stays.
    """
    frequency = np.abs(refined.poles) / (2 * np.pi)
    inside, narrow, seen = _standing(terms.lines, refined)
    keep = inside & narrow & (seen | _clearest(refined, inside & narrow & ~seen))
    if np.all(keep):
        return refined, terms, ()
    reasons = (
        (~inside, "left the band in the refinement"),
        (inside & ~narrow, "is as broad as the band, which no mode can be told by"),
        (inside & narrow & ~seen, "does not stand out of the noise"),
    )
    places = [", ".join(f"{value:.4g}" for value in frequency[chosen]) for chosen, _ in reasons]
    notes = [f"modal: the pole at {at} Hz {why}." for at, (_, why) in zip(places, reasons, strict=True) if at]
    if not np.any(keep):
        what = f"no mode stays in the refinement: {' '.join(notes)}"
        raise FitError(what, hint="widen the band to where the response peaks")
    again, more = refine_with_terms(terms.lines, refined.poles[keep], refined.participation[keep])
    again, more, further = kept_modes(again, more)
    return again, more, (*notes, *further)


def _standing(lines: FrfLines, refined: Refined) -> tuple[BoolArray, BoolArray, BoolArray]:
    frequency, decay = np.abs(refined.poles), -refined.poles.real
    low, high = lines.omega[0], lines.omega[-1]
    inside = (frequency >= low) & (frequency <= high)
    seen = (shape_p(refined, lines) < SEEN_P) & (decay > SHARPEST * lines.spacing)
    return inside, 2 * decay < BROADEST * (high - low), seen


def _clearest(refined: Refined, unseen: BoolArray) -> BoolArray:
    """Of *unseen* modes (n_mode,) that overlap others and act on the references like them the largest."""
    overlap, alike = _overlap(refined)
    size = np.linalg.norm(refined.shapes, axis=0) / np.abs(refined.poles.real)
    rank = np.argsort(np.argsort(size))
    beside = (overlap < OVERLAP) & alike & unseen & ~np.eye(rank.size, dtype=bool)
    return unseen & np.any(beside, axis=1) & (np.max(np.where(beside, rank, -1), axis=1) < rank)


def shape_p(refined: Refined, lines: FrfLines) -> FloatArray:
    """Probability (n_mode,) [1] of so large a shape by noise alone, anywhere in the band: chi-square of its
    points, of 2 degrees of freedom each, over what the noise of the lines has in common, times the number of
    half-power widths (lines, of a sharper mode) that the band holds, where noise may peak as well.

    Equation (modal-seen).
    """
    probabilities = []
    for mode, shape in enumerate(refined.shapes.T):
        block, psi = slice(2 * mode, 2 * mode + 2), np.stack([shape.real, shape.imag], axis=-1)
        inverse = np.linalg.pinv(refined.shape_covariance[:, block, block])
        chi2 = float(np.einsum("oi,oij,oj->", psi, inverse, psi)) / lines.shared
        probabilities.append(chi2_tail(chi2, psi.size))
    return np.minimum(np.array(probabilities) * _places(lines, refined), 1.0)


def _places(lines: FrfLines, refined: Refined) -> FloatArray:
    widths = np.maximum(2 * np.abs(refined.poles.real), lines.spacing)
    return np.maximum((lines.omega[-1] - lines.omega[0]) / widths, 1.0)


def complete(refined: Refined, terms: ResidualTerms, *, adding: bool) -> Completed:
    """The modes and, where *adding*, those that the residual asks for, or that AIC supports in the place of
    residual terms, one at a time: in the band, or just beyond it.

    Where what is left is no noise, they are kept where they stand by themselves and explain most of it.
    """
    kept = done = Completed(refined, terms)
    while adding:
        # Many terms follow a mode in the band, or the flank of one beyond it, and leave noise.
        now, least = done.refined, ResidualTerms(done.terms.lines, 1, 1)
        spare, misfit, tried = done.terms.count > least.count, done.p_noise < MISMATCH_P, []
        if done.added < MOST_ADDED and misfit:
            tried += [_with_one_more(done, now, done.terms)]
        if done.added < MOST_ADDED and spare:
            plain = refine(least, now.poles, now.participation)
            tried += [_with_one_more(done, plain, least)]
        if len(least.lines.beside) < MOST_BESIDE and (spare or misfit):
            tried += [_with_mode_beside(done, end) for end in (0, -1)]
        supported = [more for more in tried if more is not None]
        if not supported:
            break
        done = min(supported, key=lambda more: criterion(more.refined, more.terms))
        if max(done.p_noise, kept.p_noise) >= SEEN_P or is_missing(done, kept):
            kept = done
    return kept


def is_missing(more: Completed, before: Completed) -> bool:
    """Whether *more* modes halve the squares that are left, in the geometric mean, or the logarithm of their
    probability as noise, and each is a half-power width, the larger of both, from all others, whose peaks it
    may follow else.
    """
    apart, n_before = _overlap(more.refined)[0], more.refined.poles.size - more.added
    apart = np.minimum(apart, apart.T)
    fall = before.refined.information - more.refined.information
    chances = np.log(np.maximum([more.p_noise, before.p_noise], np.finfo(float).tiny))
    most = fall > 2 * before.terms.lines.matrix.size * np.log(2) or chances[0] > chances[1] / 2
    return bool(most and np.all(np.sum(apart < OVERLAP, axis=1)[n_before:] == 1))


def _with_mode_beside(done: Completed, end: int) -> Completed | None:
    """One mode more just beyond the first or last line (*end* 0 or -1), whose flank no power of s follows:
    all poles are refined together, and those beyond are residual terms then, those in the band its modes.
    """
    lines, refined, side = done.terms.lines, done.refined, 1 if end else -1
    decay, residual = float(np.median(-refined.poles.real)), remaining(done.terms, refined)
    edge = residual[::-side][: max(3, round(2 * decay / lines.spacing))]
    participation = _main_participation(edge, refined)
    beside = np.array([*lines.beside, -decay + 1j * (lines.omega[end] + side * decay)])
    both = (
        np.append(refined.poles, beside),
        np.vstack([refined.participation, *[participation] * beside.size]),
    )
    again = refine(ResidualTerms(replace(lines, beside=()), 1, 1), *both)
    inside, narrow, seen = _standing(lines, again)
    n_more = np.count_nonzero(inside) - refined.poles.size
    if not again.converged or n_more < 0 or np.all(inside) or not np.all((narrow & seen)[inside]):
        return None
    others = replace(lines, beside=tuple(again.poles[~inside].tolist()))
    more, terms = refine_with_terms(others, again.poles[inside], again.participation[inside])
    if not more.converged or criterion(more, terms) > criterion(refined, done.terms) - SUPPORT * lines.shared:
        return None
    return Completed(more, terms, done.added + int(n_more))


def _with_one_more(done: Completed, refined: Refined, before: ResidualTerms) -> Completed | None:
    lines, residual = before.lines, remaining(before, refined)
    decay = float(np.median(-refined.poles.real))
    scaled = (residual / np.sqrt(refined.noise)).reshape(residual.shape[0], -1)
    n_wide = round(2 * decay / lines.spacing)
    summed = np.stack([np.convolve(of, np.ones(max(n_wide, 1)), mode="same") for of in scaled.T])
    line = int(np.argmax(np.sum(np.abs(summed) ** 2, axis=0)))
    near = int(np.argmin(np.abs(refined.poles.imag - lines.omega[line])))
    pole = refined.poles.real[near] + 1j * lines.omega[line]
    if abs(pole - refined.poles[near]) < decay / 2:
        # On top of a mode: the two begin on either side of the place.
        pole += 1j * decay
    width = max(3, n_wide)
    beside = residual[max(0, line - width) : line + width + 1]
    participation = _main_participation(beside, refined)
    both = np.append(refined.poles, pole), np.vstack([refined.participation, participation])
    again, terms = refine_with_terms(lines, *both)
    inside, narrow, seen = _standing(lines, again)
    if before is not done.terms:
        # Noise draws terms as well: the mode must pay against the fewest, wherever noise may peak.
        n_real = 2 * sum(lines.matrix.shape[1:])
        fall = criterion(refined, before) - criterion(again, terms) + 2 * n_real
        chance = chi2_tail(max(fall, 0.0) / lines.shared, n_real) * _places(lines, again)[-1]
        seen[-1] |= chance < SEEN_P
    pole, most = again.poles[-1], criterion(done.refined, done.terms)
    if np.min(np.abs(abs(pole) - lines.omega[[0, -1]])) < -2 * pole.real:
        # The flank of a mode beyond would be as good, whose residues every element has for itself.
        most -= 4 * (2 * residual[0].size - sum(residual.shape[1:]))
    # R / (s - lambda - d_o) with d_o of the points looks like two poles close to lambda.
    apart, alike = (of[-1] for of in _overlap(again))
    distinct = np.count_nonzero((apart < DISTINCT) & alike) == 1
    distinct |= _acts_otherwise(beside, refined, refined.participation[near], lines.shared)
    sound = again.converged and distinct and np.all(inside & narrow & seen)
    if not sound or criterion(again, terms) > most - SUPPORT:
        return None
    # A peak whose damping is not told from zero is noise, or what leaked out of the mode beside it.
    place, by_scatter = 2 * refined.poles.size, refine_lines(terms, again)
    if -pole.real < NORMAL * np.sqrt(by_scatter.covariance[place, place]):
        return None
    return Completed(again, terms, done.added + 1)


def _acts_otherwise(
    residual: ComplexArray, refined: Refined, participation: ComplexArray, shared: float
) -> bool:
    """Whether the *residual* (n, n_output, n_input) holds what no mode of this *participation* (n_input,) [1]
    leaves, however its points move.
    """
    across = scipy.linalg.null_space(participation[None])
    left = residual @ across
    chi2 = 2 * float(np.sum(np.abs(left) ** 2 / (refined.noise @ np.abs(across) ** 2))) / shared
    return left.size > 0 and chi2_tail(chi2, 2 * left.size) < SEEN_P


def _main_participation(residual: ComplexArray, refined: Refined) -> ComplexArray:
    """That (n_input,) [1] of most of a part of the *residual* (n, n_output, n_input) [unit of the FRF]."""
    weighted = residual / np.sqrt(refined.noise)
    return np.linalg.svd(weighted.reshape(-1, residual.shape[2]), full_matrices=False)[2][0]


def _overlap(refined: Refined) -> tuple[FloatArray, BoolArray]:
    """Distances of all poles in decay rates (n_mode, n_mode) [1], and whether they act on the references
    alike.
    """
    apart = np.abs(refined.poles[:, None] - refined.poles) / np.abs(refined.poles.real)
    return apart, modal_assurance(refined.participation, refined.participation) > ALIKE_MODES
