"""The mean of repeats: against numbers of an independent calculation, closed forms, and draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from labpipe.errors import FitError
from labpipe.estimation.repeated import RepeatValues, prior_scale
from labpipe.estimation.repeats import (
    Kept,
    kept_repeats,
    mean_of_groups,
    order_in_time,
    paule_mandel,
    random_effects,
    repeat_mean,
)
from labpipe.estimation.statistics import student_limit
from labpipe.records.finding import Parameter

# An independent calculation on simulated FRFs: ln f and ln zeta of six repeats, the last of which is bad, and
# of eight that rise in order.
LN_F = [
    4.603951950006431,
    4.605869137290603,
    4.605490833065382,
    4.604771997120913,
    4.606067501454654,
    4.617104885703011,
]
LN_ZETA = [
    -4.709137310083918,
    -4.6561345057187875,
    -4.605244735553877,
    -4.559947033856714,
    -4.509708114486006,
    -4.469331491311107,
]
ERROR_F = [1.1224533410016028e-05, 1.1155172484238348e-05, 1.339301203316555e-05]
ERROR_F += [1.4777017707420146e-05, 1.5423120394926187e-05, 1.6441019415947542e-05]
ERROR_ZETA = [0.0012453832105044972, 0.0011737894489062544, 0.0013393340896195151]
ERROR_ZETA += [0.0014122866593073349, 0.0014018040600112989, 0.001435179596618388]
RISING = [4.6045091143802255, 4.604748585339753, 4.604910696139327, 4.60517414604892]
RISING += [4.605328648289621, 4.605514105144835, 4.6057711853615455, 4.605924280570683]
RISING_ZETA = [-4.443503842367116, -4.292793767917781, -4.385124471911609]
RISING_ERROR = [4.8498170226697296e-05, 9.139609552986286e-05, 6.583075100486086e-05, 0.00010853296661384406]
RISING_ERROR += [8.33136904255728e-05, 5.653767516953592e-05, 0.00010068534999778427, 7.316047311841228e-05]


def both() -> tuple[np.ndarray, np.ndarray]:
    return np.stack([LN_F, LN_ZETA], axis=1), np.stack([ERROR_F, ERROR_ZETA], axis=1) ** 2


def test_the_bad_repeat_of_the_reference_set_is_dropped() -> None:
    kept = kept_repeats(*both())
    assert kept.used.tolist() == [True] * 5 + [False] and not kept.two_populations


def test_hartung_and_knapp_as_in_the_reference() -> None:
    y, v = (values[:5] for values in both())
    ones = np.ones((5, 1))
    weights, variance = random_effects(y[:, 0], v[:, 0], ones)
    assert weights @ y[:, 0] == pytest.approx(4.60523026677332, abs=1e-9)
    assert student_limit(4) * np.sqrt(variance) == pytest.approx(0.0010791032535682748, rel=1e-5)
    assert np.sqrt(paule_mandel(y[:, 1], v[:, 1], ones)) == pytest.approx(0.07828903962422379, rel=1e-5)
    order = np.stack([np.ones(5), np.arange(5) - 2.0], axis=1)
    weights, variance = random_effects(y[:, 1], v[:, 1], order)
    assert weights @ y[:, 1] == pytest.approx(-4.608016333869893, abs=1e-7)
    assert student_limit(3) * np.sqrt(variance) == pytest.approx(0.003358004463079305, rel=1e-5)


def test_the_mean_under_the_prior_as_in_the_reference() -> None:
    y, v = (values[:3] for values in both())
    frequency = repeat_mean(y[:, 0], v[:, 0], 0.3 * np.exp(np.median(y[:, 1])))
    assert frequency.value == pytest.approx(4.605103968630685, abs=1e-9)
    assert frequency.half_width == pytest.approx(0.0026514884237816005, rel=1e-5)
    damping = repeat_mean(y[:, 1], v[:, 1], 0.3)
    assert damping.value == pytest.approx(-4.656839833366102, abs=1e-9)
    assert damping.half_width == pytest.approx(0.1791293084589256, rel=1e-5)
    rising = repeat_mean(
        np.array(RISING[:3]), np.array(RISING_ERROR[:3]) ** 2, 0.3 * np.exp(np.median(RISING_ZETA))
    )
    assert rising.half_width == pytest.approx(0.0010732245986257993, rel=1e-5)


@pytest.mark.parametrize("n", [3, 8])
@pytest.mark.parametrize("scatter", [0.0, 1e-4, 3e-3])
def test_repeats_alike_have_the_interval_of_their_scatter(n: int, scatter: float) -> None:
    """However far below the prior's scale: the half width of the mixture by its distribution function, tau
    integrated on 20,000 points of ln tau over 11 decades.
    """
    noise, scale = 1e-4, 0.3
    y = np.hypot(noise, scatter) * np.random.default_rng(n).normal(size=n)
    tau = np.exp(np.linspace(np.log(1e-8), np.log(1e3), 20001))
    w = 1 / (noise**2 + tau**2)
    mean, error = np.mean(y), 1 / np.sqrt(n * w)
    logarithm = 0.5 * (n * np.log(w) - np.log(n * w) - w * np.sum((y - mean) ** 2))
    shares = np.exp(logarithm - logarithm.max()) * tau / (1 + (tau / scale) ** 2)
    half = brentq(lambda x: shares @ norm.sf(x / error) / shares.sum() - 0.025, 0, 10, xtol=1e-12)
    assert repeat_mean(y, np.full(n, noise**2), scale).half_width == pytest.approx(half, rel=2e-3)


def test_order_in_time_as_in_the_reference() -> None:
    y, v = np.array(RISING), np.array(RISING_ERROR) ** 2
    residual = y - np.mean(y)
    stretch, correlation = order_in_time(residual)
    assert (stretch, correlation) == (
        pytest.approx(6.893564771778312, rel=1e-5),
        pytest.approx(0.7466290506476166, rel=1e-5),
    )
    # Sorted by time the interval is that of one repeat, and a covariate that is the order takes it away
    # again.
    plain, along = repeat_mean(y, v, 0.004), repeat_mean(y, v, 0.004, np.arange(8) - 3.5)
    assert plain.ordered and not along.ordered
    assert along.half_width < 0.02 * plain.half_width
    assert along.slopes[0] == pytest.approx(0.00020253097962291447, rel=0.02)
    assert order_in_time(residual[:5]) == (1.0, 0.0)


def test_without_noise_of_their_own_many_repeats_have_the_interval_of_student(
    rng: np.random.Generator,
) -> None:
    """A closed form: with a wide prior and 40 repeats the interval is t s / sqrt n.

    Equal repeats weigh alike.
    """
    y = rng.normal(size=40)
    mean = repeat_mean(y, np.full(40, 1e-12), 10.0)
    assert mean.value == pytest.approx(np.mean(y), abs=1e-6)
    assert mean.half_width == pytest.approx(student_limit(39) * np.std(y, ddof=1) / np.sqrt(40), rel=0.03)
    np.testing.assert_allclose(mean.weights, 1 / 40, rtol=1e-6)


def test_a_line_over_a_covariate_is_stated_where_it_is_zero(rng: np.random.Generator) -> None:
    x = np.linspace(1.0, 3.0, 12)
    y = 2.0 - 0.5 * x + 0.01 * rng.normal(size=12)
    mean = repeat_mean(y, np.full(12, 1e-6), 0.3, x)
    assert (
        mean.slopes.size == 1
        and mean.value == pytest.approx(2.0, abs=mean.half_width)
        and mean.half_width < 0.05
    )
    curved = repeat_mean(y + x**2, np.full(12, 1e-6), 0.3, x)
    assert curved.slopes.size == 2 and curved.slopes[1] == pytest.approx(1.0, abs=0.05)


def test_groups_are_the_repeats(rng: np.random.Generator) -> None:
    """Two days of ten runs apart by 1: the interval is that of two repeats, twice as wide as that of twenty
    and more.
    """
    y = np.repeat([0.0, 1.0], 10) + 0.01 * rng.normal(size=20)
    v = np.full(20, 1e-4)
    grouped = mean_of_groups(y, v, ["a"] * 10 + ["b"] * 10, 0.3)
    assert grouped.value == pytest.approx(0.5, abs=0.02)
    assert grouped.half_width > 2 * repeat_mean(rng.permutation(y), v, 0.3).half_width
    single = mean_of_groups(y[:3], v[:3], ["a", "b", "c"], 0.3)
    assert single.half_width == repeat_mean(y[:3], v[:3], 0.3).half_width


def test_repeats_of_a_group_that_agree_by_chance_keep_their_noise() -> None:
    """Two equal values of variance 1 have a mean of variance 1/2."""
    grouped = mean_of_groups(np.array([0.0, 0.0, 1.0, 1.0]), np.ones(4), list("aabb"), 0.3)
    single = repeat_mean(np.array([0.0, 1.0]), np.full(2, 0.5), 0.3)
    assert grouped.half_width == pytest.approx(single.half_width, rel=1e-12)
    assert grouped.weights == pytest.approx(np.full(4, 0.25))


@pytest.mark.parametrize("sizes", [(3, 3, 3), (2, 2, 2, 2), (1, 1, 6), (5, 5)])
def test_outliers_of_groups_are_judged_within_them(sizes: tuple[int, ...]) -> None:
    """Days far apart with normal runs: a sound run is lost no more often than among ten normal values without
    groups (28 of 400 sets), and one of three and more that is 100 deviations off is always left out or named
    as a second population.
    """
    groups = [str(day) for day, size in enumerate(sizes) for _ in range(size)]
    lost = missed = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        y = np.repeat(50.0 * rng.normal(size=len(sizes)), sizes) + rng.normal(size=len(groups))
        v = np.full((y.size, 1), 1e-6)
        lost += not kept_repeats(y[:, None], v, groups=groups).used.all()
        y[-1] += 100.0
        kept = kept_repeats(y[:, None], v, groups=groups)
        missed += bool(kept.used[-1]) and not kept.two_populations and sizes[-1] > 2
    assert lost <= 28 and missed == 0


def test_groups_of_single_repeats_lose_none() -> None:
    y, v = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.0])[:, None], np.full((6, 1), 1e-6)
    assert kept_repeats(y, v, groups=list("abcdef")).used.all()


def test_outliers_are_few_and_far() -> None:
    y, v = np.array([0.0, 0.1, -0.1, 0.05, 9.0])[:, None], np.full((5, 1), 1e-4)
    assert kept_repeats(y, v).used.tolist() == [True] * 4 + [False]
    # Four cannot tell which is the bad one; two of seven are a second population.
    assert kept_repeats(y[1:], v[1:]).used.all()
    two = kept_repeats(np.array([0, 0.1, -0.1, 0.05, -0.05, 9, 9.1])[:, None], np.full((7, 1), 1e-4))
    assert two.two_populations and two.used.all()
    x = np.arange(9.0)
    along = 3 * x + np.array([0.0, 0.01, -0.01, 0.02, 5.0, -0.02, 0.01, 0.0, -0.01])
    assert np.flatnonzero(~kept_repeats(along[:, None], np.full((9, 1), 1e-4), x).used).tolist() == [4]
    assert isinstance(kept_repeats(y, v), Kept)


def test_the_last_two_of_ten_are_a_step_and_two_in_between_are_bad() -> None:
    """Far outside the others by construction: neighbours at one end stay and are a second population."""
    values = np.random.default_rng(4).normal(size=(10, 1))
    for at, step in (([8, 9], True), ([0, 1], True), ([4, 5], False), ([0, 9], False), ([9], False)):
        moved = values.copy()
        moved[at] += 50.0
        kept = kept_repeats(moved, np.ones_like(values))
        assert kept.two_populations == step
        assert kept.used.sum() == (10 if step else 10 - len(at))


def test_too_few_repeats_are_refused() -> None:
    with pytest.raises(FitError, match="2 repeats do not tell 2 numbers and a spread"):
        repeat_mean(np.array([1.0, 2.0]), np.ones(2), 0.3, np.array([0.0, 1.0]))


@pytest.mark.long
@pytest.mark.parametrize(("n", "least"), [(2, 0.95), (3, 0.94), (5, 0.93), (20, 0.92)])
def test_the_interval_holds_the_mean(n: int, least: float) -> None:
    """400 draws: tau 0.02-1, noise log-normal about 0.1, 7 % outliers at 4-20 sigma.

    An independent calculation held 94-98 %.
    """
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(400):
        tau, noise = np.exp(rng.uniform(np.log(0.02), 0.0)), 0.1 * np.exp(rng.normal(size=n))
        y = tau * rng.normal(size=n) + noise * rng.normal(size=n)
        bad = rng.uniform(size=n) < 0.07
        y += bad * rng.choice([-1, 1], n) * rng.uniform(4, 20, n) * np.hypot(tau, noise)
        used = kept_repeats(y[:, None], noise[:, None] ** 2).used
        mean = repeat_mean(y[used], noise[used] ** 2, 0.3)
        held += abs(mean.value) <= mean.half_width
    assert held / 400 > least


@pytest.mark.parametrize("spread", [0.0, 50.0])
def test_few_repeats_of_a_quantity_of_unknown_scatter_hold_their_mean(spread: float) -> None:
    """Three values with noise of 1 %, *spread* times that between them: of 300 intervals at 95 % fewer than
    275 hold once in 200.
    """
    rng, held = np.random.default_rng(11), 0
    for _ in range(300):
        logs = 0.01 * np.hypot(1.0, spread) * rng.normal(size=3)
        of = RepeatValues(logs, np.full(3, 1e-4), log=True)
        mean = repeat_mean(of.values, of.variances, prior_scale(Parameter("c", 1.0, "N.s/m"), of, {}))
        held += abs(mean.value) < mean.half_width
    assert held >= 275
