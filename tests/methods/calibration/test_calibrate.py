"""Straight lines through tables: slopes and units by hand, groups, ranges, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from scipy import stats

from labpipe.artefacts.identification_file import read_identification
from labpipe.errors import ConfigError, DataError, FitError, LabpipeError, SettingError
from labpipe.methods.calibration.section import CalibrationSettings, calibrate, si_name
from labpipe.quantities import parse_unit
from labpipe.records.identification import Fit

PROBE = CalibrationSettings("probe.csv", "x [um]", "u [V]", name="probe")


def table(
    folder: Path, x: np.ndarray, y: np.ndarray, names: str = "x [um],u [V]", group: np.ndarray | None = None
) -> Path:
    columns = [x, y] if group is None else [x, y, group]
    rows = "".join(
        ",".join(f"{number!r}" for number in row) + "\n" for row in np.column_stack(columns).tolist()
    )
    (folder / "probe.csv").write_text(f"{names}\n{rows}")
    return folder / "probe.csv"


def fitted(path: Path, **changes: object) -> list[Fit]:
    return calibrate([replace(PROBE, path=path, **changes)])  # type: ignore[arg-type]


X = np.arange(0.0, 200.0, 10.0)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(1e-3, 1e3), st.floats(-100, 100))
def test_a_straight_line_is_found_in_si_units(tmp_path: Path, slope: float, intercept: float) -> None:
    """V per um is 1e6 V/m."""
    (fit,) = fitted(table(tmp_path, X, slope * X + intercept))
    assert fit.parameter("slope").value == pytest.approx(1e6 * slope, rel=1e-8, abs=1e-5)
    assert fit.parameter("intercept").value == pytest.approx(
        intercept, rel=1e-8, abs=1e-8 * (1 + 200 * slope)
    )
    assert (fit.parameter("slope").unit, fit.parameter("intercept").unit) == ("V/m", "V")


def test_uncertainty_is_that_of_linear_regression(tmp_path: Path) -> None:
    """Against scipy's linregress: slope, its error, the 95 % interval of 18 degrees of freedom."""
    y = 8.2e-3 * X + 0.1 + 0.01 * np.random.default_rng(4).normal(size=X.size)
    (fit,) = fitted(table(tmp_path, X, y))
    theirs = stats.linregress(X * 1e-6, y)
    slope = fit.parameter("slope")
    assert slope.value == pytest.approx(theirs.slope, rel=1e-9) and slope.std_error == pytest.approx(
        theirs.stderr, rel=1e-7
    )
    reach = stats.t.ppf(0.975, X.size - 2) * theirs.stderr
    assert slope.ci95 == pytest.approx((theirs.slope - reach, theirs.slope + reach), rel=1e-7)
    assert fit.parameter("intercept").std_error == pytest.approx(theirs.intercept_stderr, rel=1e-7)
    assert fit.gof.r2 == pytest.approx(theirs.rvalue**2, rel=1e-9) and fit.dof == X.size - 2


def test_through_the_origin_the_slope_is_the_ratio_of_sums(tmp_path: Path) -> None:
    y = 8.2e-3 * X + 0.1
    (fit,) = fitted(table(tmp_path, X, y), through_origin=True)
    assert fit.parameter("slope").value == pytest.approx(1e6 * (X @ y) / (X @ X), rel=1e-9)
    assert [parameter.name for parameter in fit.parameters] == ["slope"] and fit.dof == X.size - 1


@pytest.mark.parametrize(
    ("names", "changes", "units", "factor"),
    [
        ("x [mm],u [mV]", {"x": "x [mm]", "y": "u [mV]"}, ("V/m", "V"), 1.0),
        ("x [m],u [V]", {"x": "x [m]"}, ("V/m", "V"), 1.0),
        ("i [A],f [N]", {"x": "i [A]", "y": "f [N]"}, ("N/A", "N"), 1.0),
        ("x,u", {"x": "x", "y": "u"}, ("1", "1"), 1.0),
        ("x,u", {"x": "x", "y": "u", "x_unit": "um", "y_unit": "N"}, ("N/m", "N"), 1e6),
        ("v [m/s],u [V]", {"x": "v [m/s]"}, ("V/(m/s)", "V"), 1.0),
        ("p [%],u [V]", {"x": "p [%]"}, ("V", "V"), 100.0),
        ("x,u [V]", {"x": "x", "x_unit": "mm"}, ("V/m", "V"), 1e3),
        ("x [um],u [V]", {"x_unit": "µm"}, ("V/m", "V"), 1e6),
    ],
)
def test_units_of_slope_and_intercept(
    tmp_path: Path, names: str, changes: dict[str, str], units: tuple[str, str], factor: float
) -> None:
    (fit,) = fitted(table(tmp_path, X, 3 * X + 1, names), **changes)
    assert (fit.parameter("slope").unit, fit.parameter("intercept").unit) == units
    assert fit.parameter("slope").value == pytest.approx(3 * factor, rel=1e-9)


def test_a_power_of_the_set_value(tmp_path: Path) -> None:
    f = np.linspace(100, 400, 9)
    (fit,) = fitted(
        table(tmp_path, f, 0.009189 * f**2, "f [Hz],p [N]"),
        x="f [Hz]",
        y="p [N]",
        x_power=2,
        through_origin=True,
    )
    assert (
        fit.parameter("slope").value == pytest.approx(0.009189, rel=1e-9)
        and fit.parameter("slope").unit == "N/Hz^2"
    )


def test_the_power_of_a_quotient_is_that_of_all_of_it(tmp_path: Path) -> None:
    """A drag over the square of a speed, N s^2 / m^2."""
    (fit,) = fitted(table(tmp_path, X, 3 * X**2, "v [m/s],u [N]"), x="v [m/s]", y="u [N]", x_power=2)
    assert parse_unit(fit.parameter("slope").unit) == parse_unit("N.s^2/m^2")


def test_one_line_for_each_value_of_a_group(tmp_path: Path) -> None:
    x = np.tile(X, 3)
    group = np.repeat([0.4, 0.5, 0.6], X.size)
    path = table(tmp_path, x, x * 10 * group, "x [um],u [V],gap [mm]", group)
    fits = fitted(path, group="gap [mm]")
    assert [fit.parameter("slope").value for fit in fits] == pytest.approx([4e6, 5e6, 6e6])
    assert [fit.test for fit in fits] == ["gap 0.0004 m", "gap 0.0005 m", "gap 0.0006 m"] and {
        fit.name for fit in fits
    } == {"probe"}


@pytest.mark.parametrize(
    ("name", "tests"),
    [("sensor", ["sensor 1", "sensor 2"]), ("e [%]", ["e 1 %", "e 2 %"]), ("p [Pa]", ["p 1 Pa", "p 2 Pa"])],
)
def test_the_names_of_groups(tmp_path: Path, name: str, tests: list[str]) -> None:
    group = np.repeat([1.0, 2.0], X.size)
    path = table(tmp_path, np.tile(X, 2), np.tile(X, 2), f"x [um],u [V],{name}", group)
    assert [fit.test for fit in fitted(path, group=name)] == tests
    close = table(tmp_path, np.tile(X, 2), np.tile(X, 2), f"x [um],u [V],{name}", 1 + 1e-7 * group)
    assert len({fit.test for fit in fitted(close, group=name)}) == 2


def test_a_group_without_a_line_is_named(tmp_path: Path) -> None:
    x, group = np.concatenate([X, 0 * X]), np.repeat([1.0, 2.0], X.size)
    with pytest.raises(FitError, match=r"gap 0\.002 m: all points have the same x"):
        fitted(table(tmp_path, x, x, "x [um],u [V],gap [mm]", group), group="gap [mm]")


def test_the_range_in_which_a_slope_holds(tmp_path: Path) -> None:
    """Straight up to 100 um, twice as steep beyond: within 10 % the line holds up to 100 um, to one step."""
    y = np.where(X <= 100, X, 2 * X - 100) * 1e-2
    (fit,) = fitted(table(tmp_path, X, y), tolerance=0.1)
    reach = fit.parameter("linear_range")
    assert reach.unit == "m" and reach.value == pytest.approx(100e-6, abs=10.1e-6)
    (whole,) = fitted(table(tmp_path, X, 1e-2 * X), tolerance=0.1)
    assert whole.parameter("linear_range").value == pytest.approx(190e-6)


@pytest.mark.parametrize(
    ("names", "changes", "kind", "said"),
    [
        ("x [um],u [V]", {"x": "z [um]"}, DataError, "no column 'z [um]'"),
        ("x [um],u [V]", {"x_unit": "umm"}, ConfigError, "unit of column 'x [um]': unknown unit 'umm'"),
        (
            "x [um],u [V]",
            {"x_unit": "mm"},
            ConfigError,
            "is in um by the file's own header, in mm by the entry",
        ),
        ("x,u [V]", {"x": "x", "x_unit": "m^7"}, ConfigError, "a calibration column has an unusual unit"),
    ],
)
def test_what_cannot_be_fitted_is_said_with_the_table(
    tmp_path: Path, names: str, changes: dict, kind: type[LabpipeError], said: str
) -> None:
    path = table(tmp_path, X, X, names)
    with pytest.raises(kind) as caught:
        fitted(path, **changes)
    assert said in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"x_power": 0}, "x_power must be positive"),
        ({"tolerance": -0.05}, "tolerance must be positive"),
        ({"y": "x [um]"}, "'x [um]' is a column of the line already"),
        ({"group": "u [V]"}, "'u [V]' is a column of the line already"),
    ],
)
def test_settings_that_make_no_line_are_refused(changes: dict, said: str) -> None:
    with pytest.raises(SettingError) as caught:
        replace(PROBE, **changes)
    assert said in str(caught.value)


def test_a_cell_that_is_no_number_is_named_by_its_row(tmp_path: Path) -> None:
    y = 1.0 * X
    y[4] = np.nan
    with pytest.raises(DataError, match=r"column 'u \[V\]' has no number in row 5"):
        fitted(table(tmp_path, X, y))
    with pytest.raises(DataError, match=r"column 'x \[um\]' to the power 1000 has no number in row 2"):
        fitted(table(tmp_path, 1e9 * X, X), x_power=1000)


@pytest.mark.parametrize(
    "unit", ["m", "N", "V", "A", "kg", "s", "Hz", "rad", "K", "1", "Pa", "m/s", "m/s^2", "N/m", "N.s/m", "T"]
)
def test_the_si_name_of_a_unit(unit: str) -> None:
    assert si_name(parse_unit(unit)) == unit


@pytest.mark.parametrize(
    ("unit", "name"),
    [("kN", "N"), ("um", "m"), ("rpm", "Hz"), ("%", "1"), ("degC", "K"), ("bar", "Pa"), ("gn", "m/s^2")],
)
def test_the_si_name_of_other_units(unit: str, name: str) -> None:
    assert si_name(parse_unit(unit)) == name


def magnet(current: np.ndarray, place: np.ndarray) -> np.ndarray:
    """F = K ((i0 + i)^2 / (s0 - x)^2 - (i0 - i)^2 / (s0 + x)^2) of K = 20 uN m^2/A^2, 2.5 A and .5 mm: at the
    centre k_i = 4 K i0 / s0^2 = 800 N/A and k_x = 4 K i0^2 / s0^3 = 4 MN/m (Schweitzer and Maslen 2009).
    """
    return 2e-5 * ((2.5 + current) ** 2 / (5e-4 - place) ** 2 - (2.5 - current) ** 2 / (5e-4 + place) ** 2)


def plane_of(folder: Path, force: np.ndarray, grid: tuple[np.ndarray, np.ndarray]) -> Fit:
    current, place = grid
    path = table(folder, current, 1e6 * place, "i [A],x [um],F [kN]", force / 1e3)
    settings = CalibrationSettings("probe.csv", "i [A]", "F [kN]", beside="x [um]", name="magnet", path=path)
    (fit,) = calibrate([settings])
    return fit


def grid(current: float, place: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = np.meshgrid(np.linspace(-current, current, 5), np.linspace(-place, place, 5))
    return mesh[0].ravel(), mesh[1].ravel()


def test_a_plane_gives_force_per_current_and_stiffness_with_their_intervals(tmp_path: Path) -> None:
    """Of a linear magnet: against the normal equations, and 95 % of 600 intervals within four deviations."""
    i, x = grid(0.5, 30e-6)
    rng, held, named = np.random.default_rng(6), 0, 0
    for _ in range(200):
        force = 800 * i + 4e6 * x + 3.0 + 2.0 * rng.standard_normal(i.size)
        fit = plane_of(tmp_path, force, (i, x))
        intervals = [fit.parameter(name).ci95 for name in ("slope", "slope_beside", "intercept")]
        held += sum(low <= true <= high for (low, high), true in zip(intervals, (800, 4e6, 3), strict=True))
        named += bool(fit.findings)
    columns = np.column_stack([i, x, np.ones_like(x)])
    expected, (square,), *_ = np.linalg.lstsq(columns, force)
    errors = np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)) * square / (i.size - 3))
    shown = fit.parameters
    assert [p.value for p in shown] == pytest.approx(expected, rel=1e-9)
    assert [p.std_error for p in shown] == pytest.approx(errors, rel=1e-6)
    assert ([p.unit for p in shown], fit.model) == (["N/A", "N/m", "N"], "plane")
    assert held >= 0.95 * 600 - 4 * np.sqrt(600 * 0.95 * 0.05) and named <= 10


def test_a_magnet_driven_beyond_its_plane_is_named(tmp_path: Path) -> None:
    noise = np.random.default_rng(7).standard_normal(25)
    (finding,) = plane_of(tmp_path, magnet(*grid(1.0, 80e-6)) + 2 * noise, grid(1.0, 80e-6)).findings
    assert finding.code == "model-mismatch" and "for a plane)" in finding.message
    small = plane_of(tmp_path, magnet(*grid(0.05, 3e-6)) + 1e-3 * noise, grid(0.05, 3e-6))
    assert small.parameter("slope").value == pytest.approx(800, rel=1e-3)
    assert small.parameter("slope_beside").value == pytest.approx(4e6, rel=1e-3)


def test_values_that_change_together_make_no_plane(tmp_path: Path) -> None:
    i = np.linspace(-1.0, 1.0, 9)
    with pytest.raises(FitError, match="x and beside change together"):
        plane_of(tmp_path, 800 * i, (i, 1e-5 * i))
    for changes in ({"beside": "i [A]"}, {"beside": "x [um]", "tolerance": 0.1}, {"beside_unit": "um"}):
        with pytest.raises(SettingError):
            CalibrationSettings("probe.csv", "i [A]", "F [kN]", **changes)


def test_the_command_fits_the_lines_alone_and_judges_their_rules(tmp_path: Path, labpipe) -> None:
    """8.2 mV/um; exit code 1 where a rule fails."""
    table(tmp_path, X, 8.2e-3 * X)
    (tmp_path / "p.yaml").write_text(
        "calibrate:\n  probe: {table: probe.csv, x: 'x [um]', y: 'u [V]'}\n"
        "expect:\n  probe.slope: 8.2 mV/um +- 0.1 %\n"
    )
    ended = labpipe("calibrate", "-c", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 0 and "expect: probe.slope 8.2 mV/um +- 0.1 %: passed" in ended.out, ended.err
    (fit,) = read_identification(tmp_path / "out/identification.json").fits
    assert fit.parameter("slope").value == pytest.approx(8200.0)
    assert labpipe("report", tmp_path / "out", "-o", tmp_path / "out/r.md").code == 0
    page = (tmp_path / "out/r.md").read_text("utf-8")
    assert "No rig file was named." in page and "FRFs were given" not in page
    # Neither a variance inflation nor a coherence is there to speak of.
    assert "VIF" not in page and "coherence" not in page
    wrong = ("--set", "expect.probe.slope=8.3 mV/um +- 0.1 %")
    ended = labpipe("calibrate", "-c", tmp_path / "p.yaml", "-o", tmp_path / "out", *wrong)
    assert ended.code == 1 and "FAILED" in ended.out
