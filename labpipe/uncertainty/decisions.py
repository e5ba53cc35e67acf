"""Decisions on limits with their risk (JCGM 106:2012, ILAC-G8:09/2019).

The probability that a value lies within limits, guard bands, the risk of a false acceptance or rejection, and
limits that are judged together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import normal_quantile, normal_tail

PASS, CONDITIONAL_PASS, CONDITIONAL_FAIL, FAIL = "pass", "conditional-pass", "conditional-fail", "fail"
OUTCOMES = (PASS, CONDITIONAL_PASS, CONDITIONAL_FAIL, FAIL)
# Standard uncertainties of the process beyond which no product is counted: 1e-18 of them lie there.
REACH = 9.0
# Points of a piece of an integral, and of the lattice for the probability of several limits.
NODES, LATTICE = 40, 1 << 14
# Pivots below this part of a variance are rounding: the value follows from those before it.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Limits:
    """What a value may be [its unit]: at least *low* and at most *high*, infinite where that side is open."""

    low: float = -math.inf
    high: float = math.inf

    def hold(self, value: float) -> bool:
        """Whether a value lies within the limits, the limits themselves included."""
        return self.low <= value <= self.high

    def narrow(self, guard: float) -> Limits:
        """The limits moved inwards by a guard band w [unit], outwards where it is negative; they may
        cross.
        """
        return Limits(self.low + guard, self.high - guard)


def conformance(value: float, error: float, limits: Limits) -> float:
    """Probability [1] that the true value lies within *limits*, by a normal distribution about the measured
    *value* with its standard uncertainty *error* [unit]. Equation (decision-conformance); JCGM 106:2012,
    clause 7. Without uncertainty it is 0 or 1.
    """
    if error == 0.0:
        return float(limits.hold(value))
    above, below = (normal_tail(gap / error) for gap in (limits.high - value, value - limits.low))
    return max(1.0 - above - below, 0.0)


def guard_band(error: float, risk: float) -> float:
    """w [unit of *error*]: a value by w inside of one limit lies beyond it with the probability *risk* [1].
    Equation (decision-guard).
    """
    return normal_quantile(1.0 - risk) * error


def outcome_by_guard(value: float, guard: float, limits: Limits) -> str:
    """Pass within the limits less the guard band [unit], fail beyond limits and guard band, conditional
    between, by the side of the limit. ILAC-G8:09/2019, 4.2.3. Each limit counts by itself.
    """
    if limits.narrow(guard).hold(value):
        return PASS
    if limits.hold(value):
        return CONDITIONAL_PASS
    return CONDITIONAL_FAIL if limits.narrow(-guard).hold(value) else FAIL


def outcome_by_risk(probability: float, risk: float) -> str:
    """Pass where the limits hold with a *probability* [1] of at least 1 - *risk*, fail where of at most
    *risk*, conditional between, by which is likelier. JCGM 106:2012, clause 8.
    """
    if probability >= 1.0 - risk:
        return PASS
    if probability <= risk:
        return FAIL
    return CONDITIONAL_PASS if probability >= 0.5 else CONDITIONAL_FAIL


def acceptance_by_risk(error: float, limits: Limits, risk: float) -> Limits | None:
    """The values [unit] that pass by a *risk* [1] below one half; None where the uncertainty leaves none."""
    guard = guard_band(error, risk)
    if not (math.isfinite(limits.low) and math.isfinite(limits.high)):
        return limits.narrow(guard)
    centre = (limits.low + limits.high) / 2
    if conformance(centre, error, limits) < 1.0 - risk:
        return None
    # The probability falls from the centre outwards: at the limit itself it is one half at most.
    inner, outer = centre, limits.high
    for _ in range(100):
        middle = (inner + outer) / 2
        if conformance(middle, error, limits) >= 1.0 - risk:
            inner = middle
        else:
            outer = middle
    return Limits(2 * centre - inner, inner)


@dataclass(frozen=True)
class GlobalRisk:
    """Of all that a process makes, the shares [1] that are accepted though beyond the limits, and refused
    though within them.
    """

    false_acceptance: float
    false_rejection: float


def global_risk(
    process: tuple[float, float], error: float, limits: Limits, acceptance: Limits | None
) -> GlobalRisk:
    """The global risks of a decision: *process*: mean and standard deviation of what is made [unit], normal;
    *error*: standard uncertainty of the measurement [unit]; *acceptance*: the measured values that are
    accepted, None for none. Equation (decision-global); JCGM 106:2012, clause 9: Gauss-Legendre integrals.
    """
    mean, spread = process
    ends = (mean - REACH * spread, mean + REACH * spread)
    edges = [limits.low, limits.high]
    if acceptance is not None:
        steps = (-REACH, -3.0, 0.0, 3.0, REACH)
        edges += [end + step * error for end in (acceptance.low, acceptance.high) for step in steps]
    edges = sorted({*ends, *(edge for edge in edges if ends[0] < edge < ends[1])})
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    false_acceptance = false_rejection = 0.0
    for low, high in itertools.pairwise(edges):
        half, centre = (high - low) / 2, (low + high) / 2
        true = centre + half * nodes
        density = np.exp(-(((true - mean) / spread) ** 2) / 2) / (spread * math.sqrt(2 * math.pi))
        accepted = np.zeros(NODES)
        if acceptance is not None:
            accepted = np.array([conformance(at, error, acceptance) for at in true])
        part = half * weights * density
        if limits.hold(centre):
            false_rejection += float(part @ (1.0 - accepted))
        else:
            false_acceptance += float(part @ accepted)
    return GlobalRisk(false_acceptance, false_rejection)


def joint_conformance(values: FloatArray, covariance: FloatArray, limits: Sequence[Limits]) -> float:
    """Probability [1] that values (n,) with their *covariance* (n, n) [units of both] lie within all their
    *limits* at once, by a normal distribution.

    Equation (decision-joint): the integral of Genz (J. Comput. Graph. Stat. 1, 1992, 141) over a fixed
    lattice, within 2e-4 for up to ten values, also of perfect correlation or without uncertainty.
    """
    from scipy.special import ndtr, ndtri

    n = len(values)
    low = np.array([limit.low for limit in limits]) - values
    high = np.array([limit.high for limit in limits]) - values
    factor = _lower_factor(covariance)
    primes = (number for number in itertools.count(2) if all(number % k for k in range(2, number)))
    roots = np.sqrt(list(itertools.islice(primes, n)))
    points = np.abs(2 * np.modf((np.arange(LATTICE) + 0.5)[:, None] * roots)[0] - 1)
    drawn = np.zeros((LATTICE, n))
    probability = np.ones(LATTICE)
    for row in range(n):
        shift = drawn[:, :row] @ factor[row, :row]
        pivot = factor[row, row]
        if pivot == 0.0:
            size = ROUNDING * max(abs(values[row]), math.sqrt(covariance[row, row]))
            probability *= (low[row] - size <= shift) & (shift <= high[row] + size)
            continue
        below, above = ndtr((low[row] - shift) / pivot), ndtr((high[row] - shift) / pivot)
        probability *= above - below
        inside = np.clip(below + points[:, row] * (above - below), 1e-300, 1 - 1e-16)
        drawn[:, row] = ndtri(inside)
    return float(np.clip(probability.mean(), 0.0, 1.0))


def _lower_factor(covariance: FloatArray) -> FloatArray:
    """L with L L' = covariance (n, n), zero columns where a value follows from those before it."""
    n = len(covariance)
    factor = np.zeros((n, n))
    for column in range(n):
        rest = covariance[column:, column] - factor[column:, :column] @ factor[column, :column]
        if rest[0] > ROUNDING * covariance[column, column]:
            factor[column:, column] = rest / math.sqrt(rest[0])
    return factor


def least_joint_conformance(probabilities: Sequence[float]) -> float:
    """The least probability [1] with which limits of these *probabilities* can hold together, however the
    values are correlated: max(0, 1 - sum (1 - p)).
    """
    return max(0.0, 1.0 - sum(1.0 - probability for probability in probabilities))
