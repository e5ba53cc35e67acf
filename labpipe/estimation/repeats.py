"""The mean of hits, decays, recordings or points that measure one quantity, and its interval.

y_i = mu + x_i beta + u_i + e_i: e_i noise of known variance v_i, u_i ~ (0, tau^2) between the repeats. The
interval of mu holds both, but no error that all repeats share, which their scatter cannot show.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.statistics import bisect, mixture_interval, student_limit

# Below this number of repeats none can stand out, below the second more is asked for.
LEAST_FOR_OUTLIERS, FEW = 5, 8
# Robust standard deviations beyond which a repeat stands out: of few repeats, and of more.
FAR_OF_FEW, FAR = 7.0, 4.5
# The median of |y - median| of normal values times this is their standard deviation.
MAD_SCALE = 1.4826
# Share of repeats outside above which they are not outliers but a second population.
MOST_OUTSIDE = 0.25
# Rounds of reweighting towards the least absolute deviations.
ROUNDS = 50
# Scale of the half-Cauchy prior of tau: of ln f in units of zeta, and of ln zeta (measured: 0.05-0.45).
PRIOR_SCALE = 0.3
# Edges in u of the points on which tau is integrated: equal steps, or close ones towards 0 for repeats that
# scatter by far less than the prior's scale; the change of an interval [1] from which on these are needed.
TAU_EDGES = np.linspace(0.0, 1.0, 81)
CLOSE_EDGES = np.concatenate([[0.0], np.geomspace(1e-6, 0.1, 240), np.linspace(0.1, 1.0, 145)[1:]])
COARSE = 2e-3
# Repeats from which on a curvature, and an order in time, can be seen, and their critical values.
LEAST_FOR_CURVE, LEAST_FOR_ORDER = 8, 6
CURVED, ORDERED = 2.0, 1.645
# Repeats from which on a course over a condition is looked for, and its range over the middle.
LEAST_FOR_COURSE, LEAST_RANGE = 5, 0.25
# Largest correlation of neighbours that is believed.
MOST_CORRELATED = 0.9


@dataclass(frozen=True)
class RepeatMean:
    """The mean *value* of repeats (at covariate 0) and the *half_width* of its 95 % interval [any unit].

    *spread*: median of tau; *weights* (n,) of the repeats in the mean, sum 1; *slopes* (n_column,) over the
    covariate and its square; *ordered*: neighbours in time are alike, the repeats drift or come in steps.
    """

    value: float
    half_width: float
    spread: float
    weights: FloatArray
    slopes: FloatArray
    ordered: bool = False


@dataclass(frozen=True)
class Kept:
    """Which repeats are used, (n,): all where so many stand outside that they are two populations."""

    used: BoolArray
    two_populations: bool = False


def kept_repeats(
    values: FloatArray, variances: FloatArray, covariate: FloatArray | None = None, groups: Sequence[str] = ()
) -> Kept:
    """Drops repeats beyond k sqrt(MAD^2 + v_i) in any of their quantities, k = 7 for n < 8, else 4.5; none
    for n < 5.

    *values*, *variances* (n, n_quantity) [any unit, its square]; judged are residuals of a line of least
    absolute deviations over a *covariate* (n,) [any unit], or values less the median of their *groups* (n,).
    More than a quarter outside, or several at one end, are two populations. Equation (repeats-outliers).
    """
    n, n_group = len(values), len(set(groups))
    if n - max(n_group - 1, 0) < LEAST_FOR_OUTLIERS:
        return Kept(np.ones(n, bool))
    if groups:
        labels = np.array(groups)
        middle = np.array([np.median(values[labels == label], axis=0) for label in groups])
    else:
        middle = np.median(values, axis=0) if covariate is None else _least_absolute(values, covariate)
    off = values - middle
    # The middle one of every group is off by nothing.
    deviation = MAD_SCALE * np.median(np.sort(np.abs(off), axis=0)[n_group:], axis=0)
    far = FAR_OF_FEW if n < FEW else FAR
    outside = np.any(np.abs(off) > far * np.sqrt(deviation**2 + variances), axis=1)
    at = np.flatnonzero(outside)
    # Neighbours at one end of the order come by a step; one alone may as well be bad.
    step = 1 < at.size == np.ptp(at) + 1 and (outside[0] or outside[-1])
    if np.mean(outside) > MOST_OUTSIDE or step:
        return Kept(np.ones(n, bool), two_populations=True)
    return Kept(~outside)


def _least_absolute(values: FloatArray, covariate: FloatArray) -> FloatArray:
    columns = np.stack([np.ones_like(covariate), covariate - np.mean(covariate)], axis=1)
    lines = np.empty_like(values)
    for number, y in enumerate(values.T):
        weights = np.ones_like(y)
        for _ in range(ROUNDS):
            solution = np.linalg.lstsq(columns * weights[:, None], y * weights, rcond=None)[0]
            off = np.abs(y - columns @ solution)
            weights = 1 / np.sqrt(np.maximum(off, 1e-9 * max(float(np.max(off)), np.finfo(float).tiny)))
        lines[:, number] = columns @ solution
    return lines


@dataclass(frozen=True)
class _Mixture:
    """Means by every tau: taus (n_tau,) [unit of the values], shares (n_tau,) [1], solutions (n_tau,
    n_column), and the weights (n_tau, n) [1] of the repeats in the first, and its half width.
    """

    taus: FloatArray
    shares: FloatArray
    solutions: FloatArray
    weights: FloatArray
    half_width: float


def _mix(
    values: FloatArray, variances: FloatArray, columns: FloatArray, scale: float, edges: FloatArray
) -> _Mixture:
    taus = scale * np.tan(np.pi * (edges[1:] + edges[:-1]) / 4)
    weights = 1 / (variances + taus[:, None] ** 2)
    normal = np.einsum("tn,np,nq->tpq", weights, columns, columns)
    inverse = np.linalg.inv(normal)
    projection = inverse @ np.einsum("tn,np->tpn", weights, columns)
    solutions = projection @ values
    residuals = values - solutions @ columns.T
    squares = np.sum(weights * residuals**2, axis=1)
    logarithm = 0.5 * (np.sum(np.log(weights), axis=1) - np.linalg.slogdet(normal)[1] - squares)
    shares = np.exp(logarithm - logarithm.max()) * np.diff(edges)
    shares /= shares.sum()
    low, high = mixture_interval(shares, solutions[:, 0], np.sqrt(inverse[:, 0, 0]))
    return _Mixture(taus, shares, solutions, projection[:, 0], (high - low) / 2)


def repeat_mean(
    values: FloatArray, variances: FloatArray, scale: float, covariate: FloatArray | None = None
) -> RepeatMean:
    """The mean of two repeats or more with its 95 % interval under a half-Cauchy prior of *scale* on tau.

    *values* (n,) [any unit] in the order of recording, *variances* (n,) of their noise, *covariate* (n,) that
    is 0 where the value is stated. On tau = scale tan(pi u / 2) each point weighs exp(1/2 sum ln w - 1/2 ln
    det X'WX - 1/2 sum w r^2), w = 1 / (v + tau^2); the interval is that of the mixture, longer where
    neighbours in time are alike. FitError for too few repeats. Equations (repeats-mean) and (repeats-order).
    """
    columns = design(values, variances, covariate)
    n, n_column = columns.shape
    if n <= n_column:
        raise FitError(f"{n} repeats do not tell {n_column} numbers and a spread", hint="record more repeats")
    equal, close = (_mix(values, variances, columns, scale, edges) for edges in (TAU_EDGES, CLOSE_EDGES))
    is_coarse = abs(equal.half_width / close.half_width - 1) > COARSE
    mixture = close if is_coarse else equal
    solution = mixture.shares @ mixture.solutions
    stretch, _ = order_in_time(values - columns @ solution)
    spread = float(mixture.taus[np.searchsorted(np.cumsum(mixture.shares), 0.5)])
    half_width = mixture.half_width
    if stretch > 1.0:
        # sqrt(k) and the quantile of fewer repeats where neighbours are alike.
        limit = student_limit(max(1.0, n / stretch - 1))
        half_width *= float(np.sqrt(stretch) * limit / student_limit(n - n_column))
    mean_weights = mixture.shares @ mixture.weights
    return RepeatMean(float(solution[0]), half_width, spread, mean_weights, solution[1:], stretch > 1.0)


def design(values: FloatArray, variances: FloatArray, covariate: FloatArray | None) -> FloatArray:
    """Columns (n, n_column) [1] of the mean: 1, the *covariate* (n,), its square where eight show it."""
    ones = np.ones_like(values)
    if covariate is None:
        return ones[:, None]
    line = np.stack([ones, covariate], axis=1)
    if values.size < LEAST_FOR_CURVE:
        return line
    curved = np.stack([ones, covariate, covariate**2], axis=1)
    weights = 1 / (variances + paule_mandel(values, variances, curved))
    inverse = np.linalg.pinv(curved.T @ (weights[:, None] * curved))
    solution = inverse @ curved.T @ (weights * values)
    return curved if abs(solution[2]) > CURVED * np.sqrt(inverse[2, 2]) else line


def follows(values: FloatArray, variances: FloatArray, covariate: FloatArray) -> bool:
    """Whether five *values* (n,) [any unit] or more, *variances* (n,) of their noise, follow a *covariate*
    (n,) [1] of some range by more than two standard errors.
    """
    if values.size < LEAST_FOR_COURSE or np.ptp(covariate) < LEAST_RANGE:
        return False
    turned = np.stack([covariate, np.ones_like(covariate)], axis=1)
    weights, variance = random_effects(values, variances, turned)
    slope = float(weights @ values)
    return paule_mandel(values, variances, turned[:, 1:]) > 0 and abs(slope) > CURVED * np.sqrt(variance)


def drifts(values: FloatArray, variances: FloatArray, place: FloatArray) -> bool:
    """Whether *values* (n,) [any unit], *variances* (n,) of their noise, follow their *place* (n,) [1] in the
    order of recording: neighbours are alike, and a line leaves less than one or two steps.
    """
    if order_in_time(values)[0] == 1.0 or not follows(values, variances, place):
        return False
    line = float(np.polyfit(place, values, 1, full=True)[1].sum())
    n = values.size
    # Of two steps no part is a single repeat.
    steps: list[tuple[int, ...]] = [(at,) for at in range(1, n)]
    steps += [pair for pair in itertools.combinations(range(2, n - 1), 2) if pair[1] - pair[0] > 1]
    parts = (np.split(values, edges) for edges in steps)
    return line < min(sum(float(np.var(part)) * part.size for part in pieces) for pieces in parts)


def paule_mandel(values: FloatArray, variances: FloatArray, columns: FloatArray) -> float:
    """tau^2 [unit^2] at which sum w r^2 = n - p, 0 where noise alone explains the scatter. *columns* (n,
    n_column) [1].
    """
    freedom = values.size - columns.shape[1]

    def excess(square: float) -> float:
        weights = 1 / (variances + square)
        root = np.sqrt(weights)
        solution = np.linalg.lstsq(columns * root[:, None], values * root, rcond=None)[0]
        return float(np.sum(weights * (values - columns @ solution) ** 2)) - freedom

    high = 10 * float(np.var(values)) + np.finfo(float).tiny
    if freedom <= 0 or excess(0.0) <= 0:
        return 0.0
    return bisect(lambda square: excess(square) > 0, 0.0, high)


def random_effects(
    values: FloatArray, variances: FloatArray, columns: FloatArray
) -> tuple[FloatArray, float]:
    """Weights (n,) [1] of the values in the first coefficient of *columns* (n, n_column) [1], and its
    variance (X'WX)^-1_11 with w = 1/(v + tau^2) of Paule and Mandel: that of Hartung and Knapp, but never
    below the noise. Equation (repeats-group).
    """
    turned = columns.T / (variances + paule_mandel(values, variances, columns))
    inverse = np.linalg.inv(turned @ columns)
    return (inverse @ turned)[0], float(inverse[0, 0])


def groups_of(patterns: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """The pattern that each of the *names* of recordings matches, which is its group. ConfigError for a name
    that does not match one of them, and where all are of one group.
    """
    groups = []
    for name in names:
        matching = [pattern for pattern in patterns if fnmatchcase(name, pattern)]
        if len(matching) != 1:
            which = " and ".join(f"'{pattern}'" for pattern in matching) or "none of them"
            what = f"repeat_groups: '{name}' matches {which}"
            raise ConfigError(what, hint=f"there are {', '.join(names)}")
        groups.append(matching[0])
    if len(set(groups)) < 2:
        raise ConfigError(f"repeat_groups: all are of the group '{groups[0]}'", hint="name two at least")
    return tuple(groups)


def groups_text(patterns: Sequence[str]) -> str:
    """How a note goes on behind what the mean is over, where *patterns* name groups."""
    listed = ", ".join(patterns)
    return f" in the groups {listed}, the mean of each of which is one repeat" if patterns else ""


def mean_of_groups(
    values: FloatArray, variances: FloatArray, groups: Sequence[str], scale: float
) -> RepeatMean:
    """The mean over known *groups* (n,), such as days or mountings, the mean of each is one repeat.

    *values* (n,) [any unit], *variances* (n,) [unit^2] and *scale* as in repeat_mean; weights of the values.
    Equation (repeats-group).
    """
    names, labels = list(dict.fromkeys(groups)), np.array(groups)
    within, noise = np.zeros((len(names), values.size)), np.empty(len(names))
    for number, name in enumerate(names):
        members = labels == name
        y, v = values[members], variances[members]
        within[number, members], noise[number] = random_effects(y, v, np.ones((y.size, 1)))
    mean = repeat_mean(within @ values, noise, scale)
    return replace(mean, weights=mean.weights @ within)


def order_in_time(residual: FloatArray) -> tuple[float, float]:
    """(stretch, correlation) of residuals (n,) [any unit] in recording order.

    k = (1 + rho)/(1 - rho) where rho = r_1 + 1/n > 1.645 / sqrt(n). (1, 0) for fewer than six repeats, k = 1
    where no order is seen. Equation (repeats-order).
    """
    residual = residual - np.mean(residual)
    n, power = residual.size, float(np.sum(residual**2))
    if n < LEAST_FOR_ORDER or power == 0:
        return 1.0, 0.0
    rho = float(np.sum(residual[1:] * residual[:-1])) / power + 1 / n
    if rho <= ORDERED / np.sqrt(n):
        return 1.0, rho
    believed = min(rho, MOST_CORRELATED)
    return (1 + believed) / (1 - believed), rho
