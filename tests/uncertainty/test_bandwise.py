"""Two tests band by band: Holm's correction, its rate of false alarms, what it finds, and what both tests
share.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.artefacts.json_file import entry_of, record_of
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.budget import with_sources
from labpipe.methods.magnetic_bearing.loop_problem import with_unknowns
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Fit
from labpipe.records.uncertain import Uncertainty
from labpipe.report.comparison import comparison_blocks
from labpipe.report.document import Figure, Table
from labpipe.uncertainty.amounts import holm
from labpipe.uncertainty.bandwise import bandwise, two_tests
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.settings import CompareSettings
from tests.methods.magnetic_bearing.loop_cases import SETTINGS, bearing, measured
from tests.uncertainty.conftest import a_fit

ASKED = CompareSettings(
    kind="bands", fit="sliding", group="speed", groups=("0 rpm", "8000 rpm"), name="rotation"
)


def test_holm_is_that_of_the_textbook() -> None:
    """Holm (1979): p = .01 .04 .03 .005 -> .03 .06 .06 .02; by hand: 4 x .005, 3 x .01, 2 x .03, then not
    below .06.
    """
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm(np.array([0.6, 0.7])), [1.0, 1.0])


def made(
    values: Sequence[tuple[float, float]], test: str, errors: Sequence[tuple[float, float]] | None = None
) -> tuple[Fit, ...]:
    """A fit per band of 10 Hz with (k, c) and *errors*, by default 100 N/m and 1 N.s/m."""
    fits = []
    for number, (k, c) in enumerate(values):
        own = (100.0, 1.0) if errors is None else errors[number]
        fit = a_fit(test, {"k": (k, own[0]), "c": (c, own[1])}, name="sliding")
        fits.append(replace(fit, band_hz=(10.0 * number, 10.0 * number + 10)))
    return tuple(fits)


def compared(first: tuple[Fit, ...], second: tuple[Fit, ...], **asked) -> Comparison:
    return bandwise(replace(ASKED, **asked), (first, second))


def test_a_term_is_compared_with_its_own_alone() -> None:
    """Both directions in one band: k_y stays at 1000 N/m and k_z at 2000 N/m, 10 errors apart."""
    tests = [
        tuple(replace(made([(k, 10.0)], test)[0], term=term) for term, k in (("y", 1000.0), ("z", 2000.0)))
        for test in ("a", "b")
    ]
    found = compared(*tests)
    assert found.verdict == "no difference"
    assert [(band.parameter, band.ratio) for band in found.bands] == [
        (f"{name} of {term}", 1.0) for name in ("k", "c") for term in ("y", "z")
    ]


def test_a_coefficient_that_one_test_does_not_have_is_left_out() -> None:
    """`eliminate` dropped c of the second test: k alone is compared."""
    first, second = made([(1e4, 5.0)], "a"), made([(1e4, 5.0)], "b")
    second = (replace(second[0], parameters=second[0].parameters[:1]),)
    found = compared(first, second)
    assert [band.parameter for band in found.bands] == ["k"] and "1 have no standard error" in found.statement


def test_the_p_value_is_welch_s(rng: np.random.Generator) -> None:
    """t = 500 / (100 sqrt 2), dof = (2 s^2)^2 / (s^4 / 20 + s^4 / 20) = 40 for two fits with 20 each.

    Four coefficients.
    """
    found = compared(made([(1e4, 5.0), (1e4, 5.0)], "a"), made([(1e4, 5.0), (10_500.0, 5.0)], "b"))
    assert (
        found.verdict == "different"
        and found.amount("different").value == 1
        and found.amount("tested").value == 4
    )
    assert found.amount("p_value").value == pytest.approx(4 * 2 * stats.t.sf(5 / np.sqrt(2), 40))
    assert "k 10-20 Hz" in found.statement and "k 0-10 Hz" not in found.statement
    band = next(band for band in found.bands if band.p_value < 0.05)
    assert band.ratio == pytest.approx(1.05)
    # Fieller: at both ends b - r a is t of its errors.
    for ratio in band.ratio_ci95:
        away = (10_500 - ratio * 1e4) / (100 * np.hypot(1, ratio))
        assert abs(away) == pytest.approx(stats.t.ppf(0.975, 40))


def test_the_interval_of_a_ratio_holds_the_error_of_both(rng: np.random.Generator) -> None:
    """3000 +- 100 over 1000 +- 100 N/m: 316 of the ratio's thousandths, by draws; 141 are of a difference.
    Over a coefficient that may be zero it has no end.
    """
    found = compared(made([(1000.0, 5.0)], "a"), made([(3000.0, 5.0)], "b"))
    drawn = rng.normal(3000.0, 100.0, 40_000) / rng.normal(1000.0, 100.0, 40_000)
    low, high = found.bands[0].ratio_ci95
    # t of 40 degrees of freedom for 1.96; draws tell such ends to 1 %.
    assert (low, high) == pytest.approx(np.percentile(drawn, [2.5, 97.5]), rel=0.03)
    small = compared(made([(150.0, 5.0)], "a"), made([(3000.0, 5.0)], "b")).bands[0]
    assert small.ratio == pytest.approx(20.0) and small.ratio_ci95 is None


def test_a_coefficient_without_an_interval_is_left_out() -> None:
    first, second = made([(1e4, 5.0)], "a"), made([(1e4, 5.0)], "b")
    withheld = replace(second[0].parameters[0], ci95=None)
    second = (replace(second[0], parameters=(withheld, second[0].parameters[1])),)
    assert [band.parameter for band in compared(first, second).bands] == ["c"]


def test_what_the_support_adds_to_both_is_no_part_of_the_difference() -> None:
    """60 N/m are each test's own, 80 N/m come from the support under both: the difference has 60 sqrt(2)
    N/m.
    """
    support = Uncertainty("stiffness of the support", 160.0, "N/m")

    def on_it(k: float, test: str) -> tuple[Fit, ...]:
        return tuple(
            with_sources(fit, [(support, np.array([-80.0, 0.0]))])
            for fit in made([(k, 5.0)], test, [(60.0, 1.0)])
        )

    found = compared(on_it(1e4, "a"), on_it(10_300.0, "b"), parameter="k")
    tested = compared(made([(1e4, 5.0)], "a"), made([(10_300.0, 5.0)], "b"), parameter="k")
    # k is the default, which stands for all coefficients; so both have two tests.
    assert found.amount("p_value").value == pytest.approx(2 * 2 * stats.t.sf(300 / (60 * np.sqrt(2)), 40))
    assert tested.amount("p_value").value > 10 * found.amount("p_value").value


@pytest.mark.long
def test_false_alarms_are_as_rare_as_stated(rng: np.random.Generator) -> None:
    """300 pairs of tests of one rig, 20 bands with errors as stated, estimated from 20 degrees of freedom
    each.

    Independent bands come near to Holm's 5 %: the binomial at 1 in 100 to either side, which sees 10 %
    in 88 of 100.
    """
    alarms = 0
    for _ in range(300):
        pair = []
        for test in "ab":
            errors = np.sqrt(rng.chisquare(20, (20, 2)) / 20) * [100.0, 1.0]
            values = [1e4, 50.0] + rng.normal(size=(20, 2)) * [100.0, 1.0]
            pair.append(made(values, test, errors))
        alarms += compared(*pair).verdict == "different"
    low, high = stats.binom.ppf([0.01, 0.99], 300, 0.05)
    assert low <= alarms <= high


@pytest.mark.long
def test_fits_of_one_rig_raise_no_alarm_more_often(rng: np.random.Generator) -> None:
    """Sliding fits of two recordings of one rig, noise from 6 averages each: at most one of 4 alarms, 1 in 70
    at 5 %; at 60 % four in five fail.
    """
    file = bearing("hmb-geometry")
    alarms = 0
    for _ in range(4):
        pair = [measured(file, rng, 0.02, 6, fits=True, support=(134.5e3, 3.68)).fits for _ in range(2)]
        alarms += compared(*pair).verdict == "different"
    assert alarms <= stats.binom.ppf(0.98, 4, 0.05)


def test_errors_of_fits_that_miss_something_are_enlarged() -> None:
    """Where the residual is twice the noise, the difference counts half."""
    first, second = made([(1e4, 5.0)], "a"), made([(10_300.0, 5.0)], "b")
    missing = tuple(
        replace(fit, parameters=tuple(replace(p, std_error_inflated=2 * p.std_error) for p in fit.parameters))
        for fit in (*first, *second)
    )
    found = compared(missing[:1], missing[1:])
    assert found.amount("p_value").value == pytest.approx(2 * 2 * stats.t.sf(300 / (200 * np.sqrt(2)), 40))


@pytest.mark.long
def test_a_difference_is_found_in_its_bands(rng: np.random.Generator) -> None:
    """The amplifier's bandwidth drops from 1 kHz to 300 Hz: damping falls in the bands around the
    resonance.
    """
    file = bearing("hmb-geometry")
    other = with_unknowns(file, {"bandwidth": 300.0})
    views = [measured(each, rng, fits=True) for each in (file, other)]
    found = compared(views[0].fits, views[1].fits)
    differing = [band for band in found.bands if band.p_value is not None and band.p_value < 0.05]
    assert found.verdict == "different"
    assert any(band.parameter == "c" and band.band_hz[0] <= 67 <= band.band_hz[1] for band in differing)


def test_each_group_is_the_fits_of_its_one_test() -> None:
    first, second = made([(1e4, 5.0)], "turning"), made([(1e4, 5.0)], "still")
    groups = [("turning", "8000 rpm"), ("still", "0 rpm"), ("warm", "0 C")]
    found = two_tests(ASKED, (*first, *second), groups)
    assert found == (second, first)
    with pytest.raises(ConfigError, match="2 tests have speed: 0 rpm"):
        two_tests(ASKED, (*first, *second), [*groups, ("cold", "0 rpm")])


@pytest.mark.long
def test_groups_are_found_by_their_condition(rng: np.random.Generator) -> None:
    views = {name: measured(bearing("hmb-geometry"), rng, fits=True) for name in ("still", "turning")}
    speeds = {"still": "0 rpm", "turning": "8000 rpm"}
    responses = tuple(
        replace(view.response, name=name, conditions={"speed": speeds[name]}) for name, view in views.items()
    )
    fits = tuple(replace(fit, test=name) for name, view in views.items() for fit in view.fits)
    evidence = Evidence(fits, responses, (SETTINGS,))
    found = compare(ASKED, evidence)
    assert {band.test for band in found.bands} == {"8000 rpm against 0 rpm"}
    with pytest.raises(ConfigError, match="0 tests have speed: 9000 rpm"):
        compare(replace(ASKED, groups=("0 rpm", "9000 rpm")), evidence)
    with pytest.raises(ConfigError, match="no condition 'load'"):
        compare(replace(ASKED, group="load"), evidence)


def test_bands_without_errors_are_left_out_and_counted() -> None:
    first = made([(1e4, 5.0), (1e4, 5.0)], "a")
    second = made([(1e4, 5.0), (1e4, 5.0)], "b")
    bare = replace(second[1], parameters=tuple(replace(p, std_error=None) for p in second[1].parameters))
    found = compared(first, (second[0], bare))
    assert found.amount("tested").value == 2 and "2 have no standard error" in found.statement
    with pytest.raises(FitError, match="no band in common"):
        compared((first[0],), (second[1],))


def test_it_survives_its_file_and_is_reported() -> None:
    found = compared(made([(1e4, 5.0), (1e4, 5.0)], "a"), made([(1e4, 5.0), (11_000.0, 5.0)], "b"))
    assert record_of(json.loads(json.dumps(entry_of(found))), Comparison) == found
    blocks = comparison_blocks(found, ())
    (figure,) = (block for block in blocks if isinstance(block, Figure))
    assert [panel.y.label for panel in figure.graphic.panels] == ["k: ratio", "c: ratio"]
    assert {series.name for series in figure.graphic.panels[0].series if series.name} == {
        "alike",
        "different",
    }
    table = [block for block in blocks if isinstance(block, Table)][1]
    assert table.header[-1] == "p-value, corrected" and table.rows[1][0] == "10-20"
