"""Decisions on limits: guard bands of ILAC-G8, probabilities and risks against scipy and against draws."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import integrate, special, stats

from labpipe.uncertainty.decisions import (
    OUTCOMES,
    Limits,
    acceptance_by_risk,
    conformance,
    global_risk,
    guard_band,
    joint_conformance,
    least_joint_conformance,
    outcome_by_guard,
    outcome_by_risk,
)


@pytest.mark.parametrize(
    ("guard", "printed"), [(3.0, 1e-6), (1.5, 0.0016), (1.0, 0.025), (0.83, 0.05), (0.0, 0.50)]
)
def test_the_table_of_ilac_g8_on_guard_bands(guard: float, printed: float) -> None:
    """ILAC-G8:09/2019, table 1: w = r U with U = 2 u gives a specific risk of false acceptance below the
    printed one, and (but for six sigma, printed as an order of magnitude) hardly below.
    """
    risk = 1.0 - conformance(10.0 - guard * 2.0, 1.0, Limits(high=10.0))
    assert risk <= printed and (guard == 3.0 or risk > 0.8 * printed)


@given(st.floats(-5, 5), st.floats(0.01, 3), st.floats(-5, 0), st.floats(0.1, 5))
def test_probabilities_within_limits(value: float, error: float, low: float, width: float) -> None:
    """By scipy; the printed examples of JCGM 106 stand in the validation manual."""
    normal = stats.norm(value, error)
    for limits in (Limits(low, low + width), Limits(low=low), Limits(high=low)):
        wanted = normal.cdf(limits.high) - normal.cdf(limits.low)
        assert conformance(value, error, limits) == pytest.approx(wanted, abs=1e-12)


def test_a_guard_band_for_five_per_cent() -> None:
    assert guard_band(2.0, 0.05) == pytest.approx(2.0 * 1.6448536269514722, rel=1e-12)


@pytest.mark.parametrize(
    ("value", "outcome"),
    [
        (10.0, "pass"),
        (9.0, "pass"),
        (8.99, "conditional-pass"),
        (8.0, "conditional-pass"),
        (7.99, "conditional-fail"),
        (7.0, "conditional-fail"),
        (6.99, "fail"),
        (12.5, "conditional-pass"),
        (13.01, "conditional-fail"),
        (14.01, "fail"),
    ],
)
def test_four_outcomes_by_the_guard_band(value: float, outcome: str) -> None:
    """ILAC-G8:09/2019, 4.2.3, with limits 8 and 13 and w = 1."""
    assert outcome_by_guard(value, 1.0, Limits(8.0, 13.0)) == outcome


@given(st.floats(-5, 5), st.floats(0.01, 0.45))
def test_of_one_limit_risk_and_guard_band_decide_alike(value: float, risk: float) -> None:
    limits = Limits(low=0.0)
    guard = guard_band(1.0, risk)
    if min(abs(value - guard), abs(value), abs(value + guard)) > 1e-9:
        by_risk = outcome_by_risk(conformance(value, 1.0, limits), risk)
        assert by_risk == outcome_by_guard(value, guard, limits)


@given(st.floats(0.05, 3.0), st.floats(0.01, 0.3), st.floats(-6, 6))
def test_what_passes_by_a_risk_lies_within_the_acceptance_limits(
    error: float, risk: float, value: float
) -> None:
    limits = Limits(-2.0, 3.0)
    acceptance = acceptance_by_risk(error, limits, risk)
    passes = outcome_by_risk(conformance(value, error, limits), risk) == "pass"
    if acceptance is None:
        assert not passes
    elif min(abs(value - acceptance.low), abs(value - acceptance.high)) > 1e-9:
        assert passes == acceptance.hold(value)


@pytest.mark.parametrize("ratio", [0.05, 1 / 3, 1.0])
@pytest.mark.parametrize("guard", [-0.05, 0.0, 0.06])
def test_global_risks_against_scipy_and_draws(ratio: float, guard: float) -> None:
    """Resistors of 1500 ohm +- 0.2 ohm from a process with a standard deviation of 0.12 ohm, as in the
    example of JCGM 106:2012, clause 9; expected by scipy's adaptive integral, and by draws within 1 % of
    what there is to decide.
    """
    spread, limits = 0.12, Limits(1499.8, 1500.2)
    error = ratio * spread
    acceptance = limits.narrow(guard)
    risks = global_risk((1500.0, spread), error, limits, acceptance)

    def made(at: float) -> float:
        return math.exp(-0.5 * ((at - 1500.0) / spread) ** 2) / (spread * math.sqrt(2 * math.pi))

    def accepted(true: float) -> float:
        high, low = special.ndtr([(acceptance.high - true) / error, (acceptance.low - true) / error])
        return float(high - low)

    ends = [1500.0 - 9 * spread, limits.low, limits.high, 1500.0 + 9 * spread]
    parts = []
    for low, high in itertools.pairwise(ends):
        steps = [end for end in (acceptance.low, acceptance.high) if low < end < high] or None
        falsely = (lambda at: made(at) * accepted(at)) if (low, high) != tuple(ends[1:3]) else None
        wanted = falsely or (lambda at: made(at) * (1 - accepted(at)))
        parts.append(integrate.quad(wanted, low, high, points=steps, epsabs=1e-12, limit=400)[0])
    assert risks.false_acceptance == pytest.approx(parts[0] + parts[2], rel=1e-6, abs=1e-10)
    assert risks.false_rejection == pytest.approx(parts[1], rel=1e-6, abs=1e-10)
    rng = np.random.default_rng(41)
    true = rng.normal(1500.0, spread, 400_000)
    read = true + rng.normal(0.0, error, true.size)
    good = (true >= limits.low) & (true <= limits.high)
    taken = (read >= acceptance.low) & (read <= acceptance.high)
    # Three standard deviations of the draws themselves are less than 0.25 % of all.
    assert np.mean(taken & ~good) == pytest.approx(risks.false_acceptance, abs=0.0025)
    assert np.mean(~taken & good) == pytest.approx(risks.false_rejection, abs=0.0025)


def test_the_resistors_of_jcgm_106() -> None:
    """JCGM 106:2012, clause 9: u0 = 0.12 ohm, u = 0.04 ohm, tolerance +- 0.2 ohm. Of simple acceptance the
    global risks are those of the bivariate normal distribution, here of scipy.
    """
    spread, error, half = 0.12, 0.04, 0.2
    risks = global_risk((0.0, spread), error, Limits(-half, half), Limits(-half, half))
    common = spread**2
    joint = stats.multivariate_normal([0, 0], [[common, common], [common, common + error**2]])
    both = joint.cdf([half, half], lower_limit=[-half, -half])
    read = stats.norm(0, math.hypot(spread, error))
    true = stats.norm(0, spread)
    assert risks.false_acceptance == pytest.approx(read.cdf(half) - read.cdf(-half) - both, abs=2e-6)
    assert risks.false_rejection == pytest.approx(true.cdf(half) - true.cdf(-half) - both, abs=2e-6)


def test_nothing_is_accepted_where_nothing_passes() -> None:
    limits = Limits(-1.0, 1.0)
    assert acceptance_by_risk(1.0, limits, 0.05) is None
    risks = global_risk((0.0, 1.0), 1.0, limits, None)
    assert risks.false_acceptance == 0.0
    assert risks.false_rejection == pytest.approx(math.erf(1 / math.sqrt(2)), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_limits_together_against_scipy(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    covariance = root @ root.T + 0.1 * np.eye(n)
    low, high = -rng.uniform(0.5, 3, n), rng.uniform(0.5, 3, n)
    low[0] = -np.inf
    limits = [Limits(*pair) for pair in zip(low, high, strict=True)]
    values = rng.normal(0, 0.3, n)
    wanted = stats.multivariate_normal(values, covariance, seed=1).cdf(high, lower_limit=low)
    assert joint_conformance(values, covariance, limits) == pytest.approx(wanted, abs=2e-4)


def test_limits_together_within_one_per_cent_of_draws() -> None:
    """Three values with one systematic source in common and noise of their own."""
    rng = np.random.default_rng(3)
    changes, noise = np.array([1.0, -0.5, 2.0]), np.array([0.5, 0.5, 1.0])
    covariance = np.outer(changes, changes) + np.diag(noise**2)
    limits = [Limits(-1.5, 1.5), Limits(high=1.0), Limits(-2.0, 3.0)]
    drawn = rng.normal(size=(1_000_000, 1)) * changes + rng.normal(size=(1_000_000, 3)) * noise
    inside = np.ones(len(drawn), dtype=bool)
    for column, limit in enumerate(limits):
        inside &= (drawn[:, column] >= limit.low) & (drawn[:, column] <= limit.high)
    probability = joint_conformance(np.zeros(3), covariance, limits)
    assert probability == pytest.approx(inside.mean(), rel=0.01)
    # Independent of each other they would be less likely to hold at once.
    assert probability > np.prod([conformance(0.0, math.sqrt(covariance[k, k]), limits[k]) for k in range(3)])


def test_more_limits_than_small_primes() -> None:
    """150 independent values, each within its limit with 0.9995: the product."""
    limits = [Limits(high=3.290526731491926)] * 150
    together = joint_conformance(np.zeros(150), np.eye(150), limits)
    assert together == pytest.approx(0.9995**150, abs=2e-4)


def test_values_with_one_error_hold_together_like_the_narrowest() -> None:
    covariance = np.outer([1.0, 2.0], [1.0, 2.0])
    together = joint_conformance(np.zeros(2), covariance, [Limits(-1.0, 1.0), Limits(-4.0, 4.0)])
    assert together == pytest.approx(conformance(0.0, 1.0, Limits(-1.0, 1.0)), abs=1e-4)


def test_values_without_uncertainty_hold_or_do_not() -> None:
    limits = [Limits(0.0, 1.0), Limits(0.0, 1.0)]
    assert joint_conformance(np.array([0.5, 1.0]), np.zeros((2, 2)), limits) == 1.0
    assert joint_conformance(np.array([0.5, 1.1]), np.zeros((2, 2)), limits) == 0.0


@given(st.floats(-0.99, 0.99), st.floats(-2, 2), st.floats(-2, 2))
def test_no_correlation_leaves_less_than_the_least(correlation: float, first: float, second: float) -> None:
    limits = [Limits(low=0.0), Limits(low=0.0)]
    covariance = np.array([[1.0, correlation], [correlation, 1.0]])
    single = [conformance(value, 1.0, Limits(low=0.0)) for value in (first, second)]
    together = joint_conformance(np.array([first, second]), covariance, limits)
    assert least_joint_conformance(single) - 2e-4 <= together <= min(single) + 2e-4


def test_outcomes_are_in_order() -> None:
    order = [outcome_by_risk(p, 0.05) for p in (0.99, 0.6, 0.4, 0.01)]
    assert tuple(order) == OUTCOMES
