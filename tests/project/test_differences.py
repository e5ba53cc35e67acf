"""Two results compared with each other, and a value over many: p-values by hand, Holm's correction, order of
the conditions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

from labpipe.cli.results import _cells
from labpipe.errors import ConfigError, DataError
from labpipe.project import catalogue_search as compared
from labpipe.project.catalogue import ValueRow
from labpipe.project.catalogue_search import Difference, trends
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness, Identification, of_fit
from labpipe.uncertainty.weighted import ControlLimits, adjust, trends_of

FIT = Fit(
    "direct",
    "sdof",
    "ml",
    band_hz=(60.0, 70.0),
    lines=20,
    equations=40,
    dof=38,
    gof=Goodness(0.99, 0.99),
    parameters=(),
    condition_number=3.0,
    correlation=np.eye(1),
    test="a",
)


def result(
    test: str = "a", error: float | None = 10.0, name: str = "direct", term: str = "", **values: float
) -> Identification:
    parameters = tuple(Parameter(key, value, "N/m", std_error=error) for key, value in values.items())
    return Identification((replace(FIT, name=name, term=term, parameters=parameters, test=test),))


def differences(first: Identification, second: Identification) -> list[Difference]:
    """The differences of all parameters of all fits."""
    return compared.differences(
        *([listed for fit in side.fits for listed in of_fit(fit)] for side in (first, second))
    )


def test_the_p_value_of_a_single_difference() -> None:
    """z = 30 / sqrt(10^2 + 10^2) = 2.1213: p = 2 (1 - Phi(z)) = 0.0339."""
    (found,) = differences(result(k=1000.0), result(k=1030.0))
    assert found.p_value == pytest.approx(0.033895, abs=1e-6) and found.differs
    assert (found.first, found.second, found.std_error) == (1000.0, 1030.0, pytest.approx(np.sqrt(200)))


@given(st.floats(-100, 100), st.floats(0.1, 50), st.floats(0.1, 50))
def test_the_order_of_the_two_does_not_matter(shift: float, first: float, second: float) -> None:
    one, other = result(k=1000.0, error=first), result(k=1000.0 + shift, error=second)
    (ours,), (theirs,) = differences(one, other), differences(other, one)
    assert (
        ours.p_value
        == theirs.p_value
        == pytest.approx(2 * stats.norm.sf(abs(shift) / np.hypot(first, second)), rel=1e-6, abs=1e-300)
    )


def test_a_chance_that_a_double_cannot_hold_is_below_a_limit() -> None:
    """200 standard errors: exp(-20000) is no number, and the chance is not 0."""
    pair = Difference(
        fit="a", test="", parameter="k", unit="N/m", first=1e6, second=2e6, std_error=5e3, p_value=0.0
    )
    assert _cells(pair)[-2:] == ("< 1e-15", "differs")
    assert _cells(replace(pair, p_value=0.92))[-2:] == ("0.92", "")


def test_many_parameters_are_corrected_by_holm() -> None:
    """By hand: p of 4, 3 and 0 standard errors of the difference times 3, 2 and 1, not falling."""
    s = np.sqrt(200)
    found = differences(result(k=0.0, c=0.0, m=0.0), result(k=4 * s, c=3 * s, m=0.0))
    raw = 2 * stats.norm.sf([4, 3, 0])
    assert [one.p_value for one in found] == pytest.approx([3 * raw[0], 2 * raw[1], 1.0], rel=1e-9)
    assert [one.differs for one in found] == [True, True, False]


def test_a_value_without_error_is_shown_and_not_tested() -> None:
    (found,) = differences(result(k=1000.0, error=None), result(k=2000.0))
    assert (found.p_value, found.std_error, found.differs) == (None, None, False)


def test_an_error_that_was_enlarged_counts() -> None:
    """Twice the error on both sides: z halves."""
    sides = [result(k=value) for value in (1000.0, 1030.0)]
    wide = [
        replace(
            side,
            fits=tuple(
                replace(f, parameters=(replace(f.parameters[0], std_error_inflated=20.0),)) for f in side.fits
            ),
        )
        for side in sides
    ]
    (found,) = differences(*wide)
    assert found.p_value == pytest.approx(2 * stats.norm.sf(30 / np.sqrt(800)), rel=1e-9)


def test_of_one_test_each_the_names_do_not_matter() -> None:
    (found,) = differences(result("monday", k=1.0), result("tuesday", k=2.0))
    assert (found.first, found.second) == (1.0, 2.0)


def test_of_several_tests_each_is_held_against_its_namesake() -> None:
    sides = []
    for values in ((1.0, 2.0), (3.0, 4.0)):
        parts = [result(test, k=value) for test, value in zip(("a", "b"), values, strict=True)]
        sides.append(Identification(tuple(fit for part in parts for fit in part.fits)))
    assert [(one.test, one.first, one.second) for one in differences(*sides)] == [
        ("a", 1.0, 3.0),
        ("b", 2.0, 4.0),
    ]


@pytest.mark.parametrize(
    "other",
    [
        result(name="curve", k=1.0),
        result(term="y", k=1.0),
        result(c=1.0),
        Identification((replace(FIT, band_hz=(60.0, 71.0)),)),
        Identification(()),
    ],
    ids=["name", "term", "parameter", "band", "nothing"],
)
def test_results_with_nothing_in_common_are_refused(other: Identification) -> None:
    with pytest.raises(DataError, match="the two have no fit in common"):
        differences(result(k=1.0), other)


def test_tests_of_other_names_are_said() -> None:
    (fit,) = result(k=1.0).fits
    sides = [Identification(tuple(replace(fit, test=name) for name in names)) for names in ("ab", "cd")]
    with pytest.raises(DataError, match=r"no fit in common \(tests: a, b; c, d\)"):
        differences(*sides)


def test_a_parameter_in_another_unit_is_another_parameter() -> None:
    other = result(k=1.0)
    torsion = replace(
        other,
        fits=tuple(
            replace(fit, parameters=(replace(fit.parameters[0], unit="N.m/rad"),)) for fit in other.fits
        ),
    )
    with pytest.raises(DataError, match="no fit in common"):
        differences(result(k=1.0), torsion)


# trends


def row(
    value: float, preload: str = "", date: str = "2026-11-03", error: float | None = 1.0, **changes: object
) -> ValueRow:
    amounts = {"preload": (float(preload.split()[0]), preload.split()[1])} if preload else {}
    plain = ValueRow(
        path=f"{date}-{value:g}/identification.json",
        date=date,
        fit="direct",
        term="",
        test="",
        model="sdof",
        estimator="ml",
        low_hz=60.0,
        high_hz=70.0,
        parameter="k",
        value=value,
        unit="N/m",
        std_error=error,
        random_error=error,
        changes="{}",
        ci_low=None,
        ci_high=None,
        warnings="",
        conditions={},
        amounts=amounts,
    )
    return replace(plain, **changes)


def test_a_series_rises_with_its_condition() -> None:
    (series,) = trends([row(3.0, "300 N"), row(1.0, "100 N"), row(2.0, "200 N")], "preload")
    np.testing.assert_array_equal(series.condition, [100.0, 200.0, 300.0])
    np.testing.assert_array_equal(series.values, [1.0, 2.0, 3.0])
    assert (series.condition_unit, series.unit, series.fit) == ("N", "N/m", "direct 60-70 Hz")


def limits_of(series: compared.ParameterSeries) -> ControlLimits | None:
    (adjusted,) = adjust([series], trends_of([series]))
    return adjusted.limits


def test_a_straight_line_is_met_exactly() -> None:
    """5 + 0.01 per newton about the mean of 200 N."""
    (series,) = trends([row(5 + 0.01 * x, f"{x} N") for x in (100, 200, 300, 400)], "preload")
    line = series.line_over("preload")
    assert line is not None
    level, slope = line.values
    assert level == pytest.approx(5 + 0.01 * 250) and slope == pytest.approx(0.01)


def test_dates_count_in_days_from_the_first() -> None:
    (series,) = trends(
        [row(1.0, date="2024-02-28"), row(2.0, date="2024-03-01"), row(3.0, date="2025-02-28")], "date"
    )
    np.testing.assert_array_equal(series.condition, [0.0, 2.0, 366.0])
    assert series.condition_unit == "d since 2024-02-28"


@pytest.mark.parametrize("number", [1, 2])
def test_fewer_than_three_values_show_neither_line_nor_limits(number: int) -> None:
    (series,) = trends([row(float(n), f"{n} N") for n in range(1, number + 1)], "preload")
    assert series.line_over("preload") is None and limits_of(series) is None


def test_control_limits_by_hand() -> None:
    """Moving ranges 1, 1, 1, 1 of 10 11 10 11 10: sigma = 1 / 1.1284; 5 % over both sides of five values are
    2.5758 of these (normal table at .995): limits 10.4 -+ 2.2827.
    """
    (series,) = trends(
        [row(value, date=f"2026-11-0{day}") for day, value in enumerate((10.0, 11.0, 10.0, 11.0, 10.0), 1)],
        "date",
    )
    limits = limits_of(series)
    assert limits is not None and limits.outside == ()
    assert (limits.low, limits.high) == pytest.approx((10.4 - 2.2827, 10.4 + 2.2827), abs=1e-4)


def test_a_value_out_of_control_is_the_one_that_jumped() -> None:
    found = [row(10.0 + 0.1 * (day % 2), date=f"2026-11-{day:02d}") for day in range(1, 21)] + [
        row(20.0, date="2026-11-21")
    ]
    (series,) = trends(found, "date")
    limits = limits_of(series)
    assert limits is not None and [series.values[n] for n in limits.outside] == [20.0]


def test_fits_terms_and_bands_are_series_of_their_own() -> None:
    rows = [
        row(1.0, "1 N"),
        row(2.0, "1 N", fit="curve"),
        row(3.0, "1 N", term="y"),
        row(4.0, "1 N", high_hz=80.0),
        row(5.0, "1 N", parameter="c"),
    ]
    names = [(series.fit, series.parameter) for series in trends(rows, "preload")]
    assert names == [
        ("direct 60-70 Hz", "k"),
        ("curve 60-70 Hz", "k"),
        ("direct of y 60-70 Hz", "k"),
        ("direct 60-80 Hz", "k"),
        ("direct 60-70 Hz", "c"),
    ]


def test_a_recording_that_two_results_hold_counts_once() -> None:
    """Run again into another folder, three tests are six rows: the line's error is that of three. Values of
    other recordings count, were they alike to the last digit.
    """
    rows = [row(5 + 0.01 * x, f"{x} N", digests=frozenset({f"{x}"})) for x in (100, 200, 400)]
    again = [replace(one, path="again/identification.json", value=one.value + 1e-9) for one in rows]
    (once,), (series,) = trends(rows, "preload"), trends([*rows, *again], "preload")
    assert series.rows == once.rows and series.condition.tolist() == [100.0, 200.0, 400.0]
    assert [copy.path for copy in series.copies] == ["again/identification.json"] * 3
    line, line_of_once = series.line_over("preload"), once.line_over("preload")
    assert line is not None and line_of_once is not None
    assert line.std_error(1) == line_of_once.std_error(1)
    others = [replace(one, digests=frozenset({"other"})) for one in again]
    (all_count,) = trends([*rows, *others], "preload")
    assert len(all_count.rows) == 6 and not all_count.copies


def test_tests_without_the_condition_are_left_out() -> None:
    (series,) = trends([row(1.0, "1 N"), row(2.0)], "preload")
    np.testing.assert_array_equal(series.values, [1.0])


def test_a_missing_error_leaves_no_line() -> None:
    rows = [row(value, f"{value:g} N") for value in (1.0, 2.0, 3.0)]
    (whole,), (series,) = (
        trends(rows, "preload"),
        trends([replace(rows[0], random_error=None), *rows[1:]], "preload"),
    )
    assert whole.line_over("preload") is not None and series.line_over("preload") is None


def test_what_cannot_be_a_trend_is_said() -> None:
    with pytest.raises(ConfigError, match="no test has the amount 'preloat'; did you mean 'preload'"):
        trends([row(1.0, "1 N")], "preloat")
    with pytest.raises(
        ConfigError, match="the condition 'preload' has the units N, m; write it in one dimension"
    ):
        trends([row(1.0, "1 N"), row(2.0, "1 m")], "preload")
