"""Matrices of tests: levels, means of repeats with what repeating does not make smaller, theory beside, rest
positions.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import ConfigError
from labpipe.records.comparison import EquilibriumPath, PathPoint
from labpipe.records.finding import IntervalParts, Parameter
from labpipe.records.identification import Fit, Identification, listed_parameters
from labpipe.report.condition_matrix import coefficient_figures, matrix_sections
from labpipe.uncertainty.matrix import condition_matrix, repeat
from labpipe.uncertainty.settings import EquilibriumSettings, MatrixSettings, MatrixTheorySettings, levels_of
from tests.uncertainty.conftest import a_fit

SETTINGS = MatrixSettings(fit="axial", over=("speed", "load"), name="tm")


def a_matrix(tests, settings: MatrixSettings = SETTINGS, theory=None, correlation: float = 0.0):
    """The matrix of tests (values, conditions)."""
    fits = [a_fit(f"t{n}", values, correlation) for n, (values, _) in enumerate(tests)]
    return condition_matrix(settings, fits, {f"t{n}": given for n, (_, given) in enumerate(tests)}, theory)


def at(speed: str, load: str, **more: str) -> dict[str, str]:
    return {"speed": speed, "load": load, **more}


def test_set_values_closer_than_the_tolerance_are_one_level() -> None:
    levels, number = levels_of(np.array([1000.0, 2003.0, 998.0, 1001.0, 1997.0]), 0.02)
    np.testing.assert_allclose(levels, [999.6666667, 2000.0])
    assert number.tolist() == [0, 1, 0, 0, 1]


def test_points_are_ordered_by_measured_conditions_and_repeats_averaged() -> None:
    """Equal errors: the mean of two has 1 / sqrt 2 of their error."""
    tests = [
        ({"k": (1.00e6, 1e3)}, at("2999 rpm +- 2 rpm", "1002 N")),
        ({"k": (1.001e6, 1e3)}, at("3001 rpm", "998 N")),
        ({"k": (2.0e6, 1e3)}, at("6000 rpm", "1 kN")),
    ]
    matrix = a_matrix(tests)
    assert [axis.levels for axis in matrix.axes] == [
        (pytest.approx(50.0), pytest.approx(100.0)),
        (pytest.approx(1000.0),),
    ]
    (first, second) = matrix.points
    assert (first.tests, second.tests) == (("t0", "t1"), ("t2",))
    assert first.values[0].parameter.value == pytest.approx(1.0005e6)
    assert first.values[0].parameter.std_error == pytest.approx(1e3 / np.sqrt(2))
    assert first.values[0].scatter == pytest.approx(1e3 / np.sqrt(2))
    assert second.values[0].repeats == 1
    assert matrix.text_of(first) == "speed 3000 rpm, load 1 kN"
    assert [matrix.axes[0].digits(level) for level in (200.0, 2000 / 6)] == ["12000", "20000"]
    listed = list(listed_parameters(Identification((), sections={"matrix": (matrix,)})))
    assert [(one.fit, one.test, one.model) for one in listed] == [
        ("tm", "speed 3000 rpm, load 1 kN", "matrix"),
        ("tm", "speed 6000 rpm, load 1 kN", "matrix"),
    ]
    assert [one.parameter for one in listed] == [point.values[0].parameter for point in matrix.points]


def test_what_is_common_to_repeats_does_not_shrink() -> None:
    """100 repeats, noise 1 and common part 3: sqrt(0.1^2 + 3^2), closed form."""
    one = Parameter(
        "k", 10.0, "N/m", std_error=1.0, std_error_inflated=float(np.sqrt(10.0)), ci95=(8.0, 12.0)
    )
    values = 10.0 + np.linspace(-1.7, 1.7, 100)
    mean = repeat([dataclasses.replace(one, value=value) for value in values]).parameter
    assert mean.value == pytest.approx(10.0)
    assert mean.std_error == pytest.approx(0.1)
    assert mean.full_error == pytest.approx(np.sqrt(0.01 + 9.0))
    assert mean.ci95 == pytest.approx((10 - 1.95996 * np.sqrt(9.01), 10 + 1.95996 * np.sqrt(9.01)), rel=1e-5)


def test_tests_of_several_recordings_are_not_apart_by_what_these_scatter() -> None:
    """Noise of 1 and a scatter of 10 between the recordings of each test: two that differ by 12 are alike
    (12 / sqrt(202) = .84 standard errors), and their mean is known to sqrt(101 / 2).
    """
    parts = IntervalParts(1.0, repeats=10.0)
    each = [
        Parameter("k", value, "N/m", std_error=1.0, std_error_inflated=101**0.5, interval=parts)
        for value in (994.0, 1006.0)
    ]
    mean = repeat(each)
    assert mean.p_value == pytest.approx(2 * stats.norm.sf(12 / 202**0.5))
    assert mean.parameter.full_error == pytest.approx((101 / 2) ** 0.5)


def test_repeats_without_errors_have_that_of_their_scatter() -> None:
    """9, 10 and 11: 1 / sqrt 3 with 2 degrees of freedom, 4.3026527 of them to either side; alike, none."""
    bare = Parameter("k", 9.0, "N/m")
    mean = repeat([bare, dataclasses.replace(bare, value=10.0), dataclasses.replace(bare, value=11.0)])
    assert (mean.parameter.value, mean.repeats, mean.scatter) == (10.0, 3, 1.0)
    assert mean.parameter.std_error == pytest.approx(3**-0.5) and mean.p_value is None
    reach = 4.3026527 / 3**0.5
    assert mean.parameter.ci95 == pytest.approx((10 - reach, 10 + reach), rel=1e-7)
    alike = repeat([dataclasses.replace(bare, std_error=1.0), bare]).parameter
    assert (alike.value, alike.std_error, alike.ci95, alike.significant) == (9.0, None, None, None)


def test_repeats_apart_are_named_and_their_mean_widened() -> None:
    tests = [({"k": (value, 1e3)}, at("50 Hz", "1 kN")) for value in (1.00e6, 1.02e6, 0.98e6)]
    matrix = a_matrix(tests)
    assert [finding.code for finding in matrix.findings] == ["repeats-apart"]
    assert "speed 3000 rpm, load 1 kN" in matrix.findings[0].message
    # The error of the mean is that of the scatter, 2e4 / sqrt 3.
    assert matrix.points[0].values[0].parameter.std_error == pytest.approx(2e4 / np.sqrt(3), rel=1e-9)
    assert matrix.amount("repeats_apart").value == 1
    assert "Something changes between repeats" in matrix.findings[0].message
    # Two designs are no repeats; repeats have numbers of their own.
    values = [(1.00e6, "A"), (1.02e6, "B"), (0.98e6, "B")]
    tests = [
        ({"k": (k, 1e3)}, at("50 Hz", "1 kN", design=design, flow=f"{k:g} l/min")) for k, design in values
    ]
    message = a_matrix(tests).findings[0].message
    assert "no repeats, but differ in design: name it in `over`, as a number" in message


@pytest.mark.long
def test_sound_repeats_are_rarely_called_apart(rng) -> None:
    """100 matrices of 6 points with 5 repeats: at most 5 % + 3.5 binomial standard deviations have any
    finding: 12, which 20 % exceed in 97 of 100.
    """
    alarms = 0
    for _ in range(100):
        tests = [
            ({"k": (1e6 + 1e3 * rng.standard_normal(), 1e3)}, at(f"{speed} Hz", "1 kN"))
            for speed in range(10, 70, 10)
            for _ in range(5)
        ]
        alarms += bool(a_matrix(tests).findings)
    assert alarms <= 100 * 0.05 + 3.5 * np.sqrt(100 * 0.05 * 0.95)


def test_means_of_repeats_hold_the_truth(rng) -> None:
    """1500 points of 4 repeats with a common error three times that of noise: 95 % intervals hold, within 3.5
    binomial deviations.
    """
    held = 0
    for _ in range(1500):
        common = 3.0 * rng.standard_normal()
        draws = [
            Parameter(
                "k",
                100 + common + rng.standard_normal(),
                "N/m",
                std_error=1.0,
                std_error_inflated=10**0.5,
                ci95=(0.0, 1.0),
            )
            for _ in range(4)
        ]
        low, high = repeat(draws).parameter.ci95 or (0.0, 0.0)
        held += low <= 100 <= high
    assert abs(held / 1500 - 0.95) < 3.5 * np.sqrt(0.95 * 0.05 / 1500)


def test_missing_combinations_and_a_theory_stand_in_the_matrix() -> None:
    tests = [({"k": (1e6, 1e3)}, at("50 Hz", "1 kN")), ({"k": (2e6, 1e3)}, at("100 Hz", "2 kN"))]
    matrix = a_matrix(tests, theory=lambda conditions, _units: {"k": 1e6 if conditions[0] < 60 else 3e6})
    assert matrix.missing == ((0, 1), (1, 0))
    assert [point.values[0].holds_theory for point in matrix.points] == [True, False]
    assert matrix.amount("theory_share").value == 0.5
    assert matrix.amount("k.largest_error").value == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (dataclasses.replace(SETTINGS, over=("sped", "load")), "test 't0' has no condition 'sped'"),
        (dataclasses.replace(SETTINGS, parameters=("k_xx",)), "fit 'axial' has no 'k_xx'"),
    ],
)
def test_what_tests_do_not_have_is_named(settings, message) -> None:
    with pytest.raises(ConfigError, match=message):
        a_matrix([({"k": (1e6, 1e3)}, at("50 Hz", "1 kN"))], settings)


PATH = {"load": "load", "x": "x", "y": "y"}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"over": ()}, "over: is empty"),
        ({"over": ("speed", "speed")}, "'over' names 'speed' twice"),
        ({"beside": ("speed", "leak", "leak")}, "'beside' names 'leak' twice"),
        ({"parameters": ("k_xx", "k_xx")}, "'parameters' names 'k_xx' twice"),
        ({"tolerance": 1.0}, "at least 0 and below 100 %"),
        ({"tolerance": -0.01}, "at least 0 and below 100 %"),
        ({"level": 0.0}, "between 0 and 100 %"),
        ({"level": 1.0}, "between 0 and 100 %"),
        ({"path": PATH}, "the load 'load' of the path is none of 'over'"),
        ({"path": {**PATH, "clearance": 0.0}, "over": ("load",)}, "clearance must be positive"),
        ({"path": {**PATH, "centre": (0.0,)}, "over": ("load",)}, "two coordinates"),
        ({"theory": {}}, "one of 'bearing' and 'table' is needed"),
        ({"theory": {"bearing": "b.yaml", "table": "t.csv"}}, "one of 'bearing' and 'table' is needed"),
        ({"theory": {"table": "t.csv", "axes": ("x", "y")}}, "belong to a bearing file"),
        ({"theory": {"bearing": "b.yaml", "entries": ("speed",), "axes": ("x", "-x")}}, "names two dofs"),
        ({"theory": {"bearing": "b.yaml"}}, "one entry for each of 1 conditions"),
    ],
)
def test_settings_that_cannot_be_are_refused(entries, message) -> None:
    with pytest.raises(ConfigError, match=message):
        parts = {"path": EquilibriumSettings, "theory": MatrixTheorySettings}
        made = {name: parts[name](**entry) if name in parts else entry for name, entry in entries.items()}
        MatrixSettings(**{"fit": "axial", "over": ("speed",), **made})


def test_settings_at_their_limits_are_taken() -> None:
    assert MatrixSettings(fit="axial", over=("speed",), tolerance=0.0, level=0.999).theory is None
    theory = MatrixTheorySettings(bearing="b.yaml", entries=("speed",), axes=("-z", "y"))
    assert MatrixSettings(fit="axial", over=("speed",), theory=theory).theory == theory


STIFFNESS = np.array([[8e6, 3e6], [-4e6, 1.2e7]])


def _fit_of(stiffness: np.ndarray, error: float, test: str) -> Fit:
    names = ("k_xx", "k_xy", "k_yx", "k_yy")
    return a_fit(
        test, {name: (float(value), error) for name, value in zip(names, stiffness.reshape(-1), strict=True)}
    )


def a_path(rng, tests_per_load: int, static: np.ndarray, shaken: np.ndarray, spread: float = 1e-8):
    """The path of a linear bearing K d = W u, u at 90 deg, with noise on the mean positions and on K."""
    settings = MatrixSettings(
        fit="axial",
        over=("load",),
        path=EquilibriumSettings(load="load", x="x", y="y", direction=np.pi / 2, clearance=100e-6),
        name="tm",
    )
    fits, conditions = [], {}
    for load in (500.0, 600.0, 700.0):
        rest = np.linalg.solve(static, [0.0, load])
        for number in range(tests_per_load):
            name = f"{load:g}-{number}"
            measured = rest + spread * rng.standard_normal(2)
            fits.append(_fit_of(shaken + 2e4 * rng.standard_normal((2, 2)), 2e4, name))
            conditions[name] = {
                "load": f"{load} N",
                "x": f"{measured[0] * 1e6:.12g} um",
                "y": f"{measured[1] * 1e6:.12g} um",
            }
    return condition_matrix(settings, fits, conditions).paths[0]


def test_the_slope_of_the_path_is_the_compliance(rng) -> None:
    """K d = W u: d is linear in W, so its slope is K^-1 u, with eccentricity and attitude in closed form."""
    path = a_path(rng, 6, STIFFNESS, STIFFNESS)
    expected = np.linalg.solve(STIFFNESS, [0.0, 1.0])
    for point in path.points:
        np.testing.assert_allclose(point.statics, expected, atol=5 * max(point.statics_error))
        np.testing.assert_allclose(point.shaking, expected, atol=5 * max(point.shaking_error))
        rest = expected * point.load
        assert point.eccentricity == pytest.approx(np.hypot(*rest), rel=1e-3)
        assert point.attitude == pytest.approx(np.arctan2(rest[1], rest[0]) - np.pi / 2, abs=2e-3)


def test_static_and_shaken_stiffness_that_differ_are_shown(rng) -> None:
    """A static stiffness 20 % above that from shaking.

    Where both agree, p-values are seldom small (binomial, 60 points).
    """
    apart = a_path(rng, 6, 1.2 * STIFFNESS, STIFFNESS)
    assert all(point.p_value < 1e-3 for point in apart.points)
    for repeats in (2, 12):
        paths = [a_path(rng, repeats, STIFFNESS, STIFFNESS) for _ in range(20)]
        alike = [point.p_value for path in paths for point in path.points]
        assert sum(p < 0.05 for p in alike) <= 60 * 0.05 + 3.5 * np.sqrt(60 * 0.05 * 0.95)


def test_a_path_without_repeats_has_no_error_and_is_not_compared(rng) -> None:
    for point in a_path(rng, 1, STIFFNESS, STIFFNESS).points:
        assert np.all(np.isnan([*point.position_error, *point.statics_error]))
        assert point.p_value is None


def test_the_report_shows_all_points_in_the_unit_of_the_largest_the_second_condition_upwards() -> None:
    tests = [
        ({"k": (value, 1e4)}, at(speed, load))
        for value, speed, load in (
            (2.5e6, "25 Hz", "2 kN"),
            (40.0e6, "50 Hz", "2 kN"),
            (104.0e6, "25 Hz", "5 kN"),
            (226.1e6, "50 Hz", "5 kN"),
        )
    ]
    matrix = a_matrix(tests, theory=lambda _conditions, _units: {"k": 3e6})
    lines, chart = (figure.graphic.panels[0] for figure in coefficient_figures(matrix, "k"))
    assert [axis.shown_unit for axis in matrix.axes] == ["rpm", "kN"] and lines.y.unit == "MN/m"
    assert [series.name for series in lines.series] == ["load 2 kN", "load 5 kN", "theory", ""]
    np.testing.assert_allclose(lines.series[1].y, [104.0, 226.1])
    assert chart.series[0].texts == (("104.0", "226.1"), ("2.500", "40.00"))
    assert [name for _, name in chart.y.ticks or ()] == ["5", "2"]


def test_a_coefficient_is_drawn_at_those_further_conditions_that_have_it(recwarn) -> None:
    """c belongs to one preload alone: a map of nothing but gaps gave a warning of numpy."""
    settings = dataclasses.replace(SETTINGS, over=("speed", "load", "preload"), parameters=("k", "c"))
    tests = [
        ({"k": (1e6, 1e4), **({"c": (1e3, 1e1)} if tight == "3 N" else {})}, at(speed, load, preload=tight))
        for speed in ("25 Hz", "50 Hz")
        for load in ("2 kN", "5 kN")
        for tight in ("1 N", "3 N")
    ]
    captions = [figure.caption for figure in coefficient_figures(a_matrix(tests, settings), "c")]
    assert len(captions) == 2 and all("preload 3 N" in caption for caption in captions) and not recwarn.list


@pytest.mark.parametrize("clearance", [None, 100e-6])
def test_rest_positions_are_shown_in_um_or_in_shares_of_the_clearance(clearance: float | None) -> None:
    """30 and -40 um from the centre: 50 um, half of a clearance of 100 um."""
    first = PathPoint(
        1e3,
        (30e-6, -40e-6),
        (1e-6, 2e-6),
        50e-6,
        np.pi / 6,
        statics=(12e-9, 3e-9),
        statics_error=(1e-9, 0.5e-9),
        p_value=0.034,
    )
    second = dataclasses.replace(first, load=2e3, position=(60e-6, -80e-6), eccentricity=100e-6)
    path = EquilibriumPath("speed 3000 rpm", (first, second), clearance)
    matrix = dataclasses.replace(a_matrix([({"k": (1e6, 1e3)}, at("50 Hz", "1 kN"))]), paths=(path,))
    shown = {section.heading: section for section in matrix_sections((matrix,), Identification(()))}
    _, figure, table = shown["Rest position: tm"].blocks
    (panel,) = figure.graphic.panels
    course, *circle = panel.series
    scale = 1e6 if clearance is None else 1e4
    np.testing.assert_allclose([course.x, course.y], scale * np.array([[30e-6, 60e-6], [-40e-6, -80e-6]]))
    assert (course.name, panel.x.unit) == (path.at, "um" if clearance is None else "")
    assert panel.y.title == ("y" if clearance is None else "y / clearance")
    assert len(circle) == (0 if clearance is None else 1)
    np.testing.assert_allclose([np.hypot(one.x, one.y) for one in circle], 1)
    size = "50" if clearance is None else "0.5"
    by_slope, by_shaking = ("12.0 ± 1.0", "3.00 ± 0.50"), ("none", "none")
    assert table.rows[0] == ("1000", "30.0", "-40.0", size, "30", *by_slope, *by_shaking, "0.034")
    assert table.caption == "Rest positions at speed 3000 rpm; p-value: that static slope and shaking agree"


def test_temperatures_some_kelvin_apart_are_two_levels() -> None:
    """2 % of 298 K are 6 K: 20 and 25 degC were one level, and their coefficients its repeats."""
    tests = [({"k": (k, 1e3)}, {"oil": oil}) for k, oil in ((1e6, "20 degC"), (1.1e6, "25 degC"))]
    matrix = a_matrix(tests, MatrixSettings(fit="axial", over=("oil",), name="tm"))
    assert matrix.axes[0].levels == pytest.approx((293.15, 298.15))


def test_a_load_that_is_no_force_has_no_slope_of_its_path() -> None:
    path = EquilibriumSettings(load="load", x="x", y="y")
    settings = MatrixSettings(fit="axial", over=("load",), path=path, name="tm")
    tests = [({"k": (1e6, 1e3)}, {"load": f"{load} kg", "x": "1 um", "y": "2 um"}) for load in (1, 2)]
    with pytest.raises(ConfigError, match="'load' is not a force but in kg"):
        a_matrix(tests, settings)
