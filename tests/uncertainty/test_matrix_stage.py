"""The section matrix from YAML to report, tables and rules: FRFs of known bearings at every condition, theory
beside, faults.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from labpipe.artefacts.identification_file import read_identification
from labpipe.cli.main import run_command
from labpipe.errors import ConfigError, ConfigErrors, DataError
from labpipe.project.compare import point_theory
from labpipe.project.matrix_table import AXES, matrix_table, rotor_sheets, write_rotor_xlsx
from labpipe.project.pipeline_file import load_pipeline
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import FitDetail
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.uncertainty.matrix import PointTheory
from labpipe.uncertainty.settings import MatrixSettings, MatrixTheorySettings

SPEEDS, LOADS, REPEATS = (1500, 3000), (1, 2), 3
MASS = 5.0
PIPELINE = """
title: A bearing over speed and load
tests:
{tests}
identify:
  film: {{model: rotor-2dof, mass: 5 kg}}
matrix:
  tm:
    fit: film
    over: [speed, load]
    parameters: [k_xx, k_xy, k_yx, k_yy, c_xx, c_xy, c_yx, c_yy]
    beside: [oil]
    theory: {{table: theory.csv}}
accept:
  tm.k_xx.largest_error: "<= 1 %"
  tm.missing: "<= 0"
expect:
  tm.points: 4
"""


def coefficients(speed: float, load: float) -> tuple[np.ndarray, np.ndarray]:
    """A made-up bearing: stiffness grows with load, cross-coupling with speed."""
    k = np.array([[1e7 * load, 2e3 * speed], [-2e3 * speed, 1.4e7 * load]])
    return k, np.array([[2e4, 0.0], [0.0, 3e4]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """FRFs with 0.1 % noise of 12 tests, and the truth as a table of another program."""
    folder = tmp_path_factory.mktemp("matrix")
    rng = np.random.default_rng(20261122)
    frequency = np.arange(20.0, 200.0, 5.0)
    w = 2 * np.pi * frequency[:, None, None]
    entries, rows = [], []
    for speed, load in itertools.product(SPEEDS, LOADS):
        k, c = coefficients(speed, load)
        rows.append([speed, load, *(k.reshape(-1) / 1e6), *(c.reshape(-1) / 1e3)])
        h = np.linalg.inv(k + 1j * w * c - MASS * w**2 * np.eye(2))
        std = 1e-3 * np.max(np.abs(h))
        for repeat in range(REPEATS):
            noisy = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
            ports = (
                (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2)),
                (Port("fx", "fx", "x", 0.0), Port("fy", "fy", "y", np.pi / 2)),
            )
            name = f"{speed}rpm-{load}kN-{repeat}"
            response = FrequencyResponse(
                frequency, noisy, *ports, covariance=diagonal_covariance(np.full(h.shape, std**2)), name=name
            )
            write_frf_csv(folder / f"{name}.csv", response)
            oil = f"oil: {40 + repeat} degC"
            conditions = f"{{speed: {speed + repeat} rpm, load: {load} kN, {oil}}}"
            entries.append(f"  - {{name: {name}, frfs: {name}.csv, conditions: {conditions}}}")
    names = [
        f"{letter}_{axes} [{unit}]"
        for letter, unit in (("k", "MN/m"), ("c", "kN.s/m"))
        for axes in ("xx", "xy", "yx", "yy")
    ]
    pd.DataFrame(rows, columns=["speed [rpm]", "load [kN]", *names]).to_csv(
        folder / "theory.csv", index=False
    )
    (folder / "p.yaml").write_text(PIPELINE.format(tests="\n".join(entries)))
    return folder


@pytest.fixture(scope="module")
def result(folder: Path) -> Path:
    assert run_command(["run", str(folder / "p.yaml"), "-o", str(folder / "out")]) == 0
    return folder / "out/identification.json"


def test_every_point_is_near_its_truth_and_mostly_holds_it(result: Path) -> None:
    """32 intervals of 95 %: at least 26 hold the truth (chance of fewer: 1e-3 by the binomial
    distribution).
    """
    (matrix,) = read_identification(result).sections["matrix"]
    assert matrix.statement.startswith("film: 12 tests at 4 points (2 speed x 2 load); the theory lies in")
    held = 0
    for point in matrix.points:
        speed, load = matrix.levels_of(point)
        k, c = coefficients(round(60 * speed / 500) * 500, load / 1e3)
        for name, truth in zip(matrix.names, [*k.reshape(-1), *c.reshape(-1)], strict=True):
            value = point.value(name)
            low, high = value.parameter.ci95
            held += low <= truth <= high
            assert value.theory == pytest.approx(truth, rel=1e-2, abs=1e3)
        assert point.beside[0].value == pytest.approx(273.15 + 41)
    assert held >= 26
    assert all(outcome.passed for outcome in read_identification(result).outcomes)


def test_the_report_begins_with_the_matrix_and_draws_tests_on_demand(
    result: Path, folder: Path, labpipe
) -> None:
    page = (result.parent / "report.html").read_text("utf-8")
    assert "Test matrix: tm" in page and "Result: film, test" not in page
    one = labpipe("report", result.parent, "--test", "1500rpm-1kN-0", "-o", folder / "one.md")
    assert one.code == 0
    text = (folder / "one.md").read_text("utf-8")
    assert "Result: film, test 1500rpm-1kN-0" in text and "1500rpm-1kN-1" not in text
    unknown = labpipe("report", result.parent, "--test", "1500rpm-1kN-00", "-o", folder / "two.md")
    assert unknown.code == 2 and "the result has no test '1500rpm-1kN-00'; did you mean" in unknown.err
    assert not (folder / "two.md").exists()


def test_a_condition_that_no_test_has_is_named_at_its_line(folder: Path, labpipe) -> None:
    text = (folder / "p.yaml").read_text()
    assert "over: [speed, load]" in text
    (folder / "typo.yaml").write_text(text.replace("over: [speed, load]", "over: [speed, lod]"))
    line = 1 + next(n for n, row in enumerate(text.splitlines()) if "over:" in row)
    ended = labpipe("run", folder / "typo.yaml", "-o", folder / "typo")
    assert ended.code == 2 and f"typo.yaml:{line}:" in ended.err and not (folder / "typo").exists()
    assert "matrix.tm.over: no test has the condition 'lod'; did you mean 'load'?" in ended.err


def test_tables_hold_conditions_values_and_uncertainties(result: Path) -> None:
    (matrix,) = read_identification(result).sections["matrix"]
    table = matrix_table((matrix,))
    assert len(table) == 4 * 8
    row = table[(table["coefficient"] == "k_xx") & (table["load [N]"] == 2000)].iloc[0]
    assert row["repeats"] == 3 and row["unit"] == "N/m"
    assert row["ci95_low"] < row["value"] < row["ci95_high"]


def test_rotor_tables_give_k_and_c_at_the_whirl_frequency(result: Path) -> None:
    """K + jwC without mass: k and c are those of the points at every frequency, over speed in rad/s."""
    identification = read_identification(result)
    (matrix,) = identification.sections["matrix"]
    sheets = dict(rotor_sheets(identification, (matrix,)))
    assert list(sheets)[:3] == ["1 synchronous", "1 1501 rpm", "1 3001 rpm"]
    synchronous = sheets["1 synchronous"]
    np.testing.assert_allclose(synchronous["speed"], 2 * np.pi * np.array([1501, 3001]) / 60, rtol=1e-9)
    first = matrix.points[0]
    assert "frequency" not in synchronous and "speed" not in sheets["1 1501 rpm"]
    assert synchronous["kxx"][0] == pytest.approx(first.value("k_xx").parameter.value, rel=1e-9)
    assert synchronous["cyy"][0] == pytest.approx(first.value("c_yy").parameter.value, rel=1e-9)
    whirl = sheets["1 1501 rpm"]
    np.testing.assert_allclose(
        whirl["frequency"].iloc[[0, -1]], 2 * np.pi * np.array(identification.fits[0].band_hz)
    )
    assert np.ptp(whirl["kxy"]) < 1e-6 * whirl["kxx"][0] and whirl["kyx"][0] == synchronous["kyx"][0]
    # Of a band above the speed k and c are those of its lowest frequency.
    narrow = [replace(fit, band_hz=(100.0, 120.0), details=()) for fit in identification.fits]
    beyond = dict(rotor_sheets(replace(identification, fits=tuple(narrow)), (matrix,)))["1 synchronous"]
    np.testing.assert_allclose(beyond["cyy"], synchronous["cyy"], rtol=1e-9)


@dataclass(frozen=True)
class Stiffness(FitDetail):
    """The same stiffness [N/m] at all lines, in all directions."""

    size: float

    @property
    def course(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([10.0, 100.0]), np.full((2, 2, 2), self.size, complex)


def test_rotor_tables_weigh_repeats_as_the_matrix_does(result: Path) -> None:
    """Stiffnesses of 1 and 1.001 MN/m, known to 1 and 3 kN/m: the mean by their variances is 1.0001 MN/m."""
    whole = read_identification(result)
    (matrix,) = whole.sections["matrix"]
    (point, tests) = matrix.points[0], matrix.points[0].tests[:2]
    fits = []
    for size, error, test in zip((1e6, 1.001e6), (1e3, 3e3), tests, strict=True):
        names = [f"{letter}_{axes}" for letter in "kc" for axes in AXES]
        same = tuple(Parameter(name, size, "N/m", std_error=error) for name in names)
        fits.append(replace(whole.fits[0], test=test, parameters=same, details=(Stiffness(size),)))
    alone = replace(matrix, points=(replace(point, tests=tests),))
    sheets = dict(rotor_sheets(replace(whole, fits=tuple(fits)), (alone,)))
    np.testing.assert_allclose(sheets["1 synchronous"]["kxx"], 1.0001e6, rtol=1e-9)


@pytest.mark.parametrize(("kind", "name"), [("rotor", "x.csv"), ("rotor-csv", "x.xlsx"), ("matrix", "x.mat")])
def test_an_ending_of_another_format_is_refused(result: Path, tmp_path: Path, labpipe, kind, name) -> None:
    ended = labpipe("export", result, "--to", kind, "-o", tmp_path / name)
    assert ended.code == 2 and not (tmp_path / name).exists() and "known: ." in ended.err
    assert f"'{Path(name).suffix}' is no ending of a file in the format {kind}" in ended.err


def test_ross_reads_the_rotor_table(result: Path, tmp_path: Path) -> None:
    """The bearing element of another program made from the file; done where that program is installed."""
    ross = pytest.importorskip("ross", exc_type=ImportError)
    write_rotor_xlsx(result, tmp_path / "rotor.xlsx")
    bearing = ross.BearingElement.from_table(0, str(tmp_path / "rotor.xlsx"), sheet_name="1 synchronous")
    (matrix,) = read_identification(result).sections["matrix"]
    assert bearing.kxy[0] == pytest.approx(matrix.points[0].value("k_xy").parameter.value)
    axes = {name: getattr(bearing, name, None) for name in ("speed", "frequency")}
    speeds = axes["frequency"] if axes["speed"] is None else axes["speed"]
    np.testing.assert_allclose(speeds, 2 * np.pi * np.array([1501, 3001]) / 60, rtol=1e-6)


def of_table(path: Path, *over: str) -> PointTheory:
    entries = MatrixTheorySettings(table=path.name)
    theory = point_theory(MatrixSettings(fit="a", over=over, tolerance=0.02, theory=entries), path.parent)
    assert theory is not None
    return theory


def test_a_table_is_linear_along_the_first_condition(folder: Path) -> None:
    theory = of_table(folder / "theory.csv", "speed", "load")
    between = theory((37.5, 1000.0), ("Hz", "N"))
    assert between["k_xy"] == pytest.approx((2e3 * 1500 + 2e3 * 3000) / 2)
    assert theory((80.0, 1000.0), ("Hz", "N")) == {}
    assert theory((30.0, 1500.0), ("Hz", "N")) == {}
    # Also where its conditions are small in SI: beyond the tolerance of the last row it says nothing.
    (folder / "gap.csv").write_text("gap [um],k_xx [N/m]\n10,1\n20,3\n")
    theory = of_table(folder / "gap.csv", "gap")
    at = [theory((gap,), ("m",)) for gap in (5e-6, 15e-6, 20.3e-6, 21e-6)]
    assert at == [{}, pytest.approx({"k_xx": 2.0}), {"k_xx": 3.0}, {}]


def test_a_bearing_file_is_asked_in_the_axes_of_the_rig(tmp_path: Path) -> None:
    """x along -z: products of two axes that are turned alike keep their sign, the others change it.

    A condition sets an entry of the file, the other none.
    """
    (tmp_path / "b.yaml").write_text(
        "kind: linear-bearing\nk_yy: 1 MN/m\nk_zz: 2 MN/m\nk_yz: 0.3 MN/m\nk_zy: -0.4 MN/m\n"
        "c_yy: 10 N.s/m\nc_zz: 20 N.s/m\nc_yz: 3 N.s/m\nc_zy: 4 N.s/m\n"
    )

    def beside(**axes: tuple[str, ...]) -> dict[str, float]:
        entries = MatrixTheorySettings(bearing="b.yaml", entries=("k_yy", "none"), **axes)
        settings = MatrixSettings(fit="a", over=("spring", "load"), theory=entries)
        return dict(point_theory(settings, tmp_path)((5e6, 7.0), ("N/m", "N")))

    names = [f"{letter}_{axes}" for letter in "kc" for axes in ("xx", "xy", "yx", "yy")]
    assert beside() == dict(zip(names, [5e6, 0.3e6, -0.4e6, 2e6, 10, 3, 4, 20], strict=True))
    turned = dict(zip(names, [2e6, 0.4e6, -0.3e6, 5e6, 20, -4, -3, 10], strict=True))
    assert beside(axes=("-z", "y")) == turned
    with pytest.raises(ConfigError, match="no dof 'u'"):
        beside(axes=("u", "y"))


def test_faults_of_a_table_are_named(folder: Path) -> None:
    with pytest.raises(DataError, match="has no column of the condition 'pressure'"):
        of_table(folder / "theory.csv", "speed", "pressure")
    (folder / "wrong.csv").write_text("speed [rpm],k_xx [N.s/m]\n1,2\n")
    with pytest.raises(DataError, match=r"'k_xx': 'N.s/m' has the wrong dimension, N/m is needed"):
        of_table(folder / "wrong.csv", "speed")
    (folder / "twice.csv").write_text("speed [rpm],k_xx [N/m],k_xx [kN/m]\n1,2,3\n")
    with pytest.raises(DataError, match="has several columns of 'k_xx'"):
        of_table(folder / "twice.csv", "speed")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("speed [rad/s],k_xx [N/m]\n100,1\n200,3\n", {"k_xx": 2.0}),
        ("speed [rpm],k_xx [N/m],k_yy [N/m]\n1200,1,7\n1800,,7\n", {"k_yy": 7.0}),
        ("speed [mm],k_xx [N/m]\n1,1\n2,3\n", "'speed': 'mm' has the wrong dimension, Hz is needed"),
        ("speed [rpm],load [N],k_xx [N/m]\n60,1,1\n60,2,3\n", "has several rows at speed 1 Hz"),
    ],
)
def test_the_conditions_of_a_table(tmp_path: Path, text: str, found: dict[str, float] | str) -> None:
    """At 150 rad/s: an angle per time is not a number of revolutions, and a gap is not a theory."""
    (tmp_path / "t.csv").write_text(text)
    theory = of_table(tmp_path / "t.csv", "speed")
    if isinstance(found, dict):
        assert theory((150 / (2 * np.pi),), ("Hz",)) == pytest.approx(found)
    else:
        with pytest.raises(DataError, match=found):
            theory((150 / (2 * np.pi),), ("Hz",))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fit: film", "fit: flim", "there is no fit 'flim'"),
        ("over: [speed, load]", "over: []", "over: is empty"),
        ("{table: theory.csv}", "{table: no.csv}", "no such file 'no.csv'"),
        ("beside: [oil]", "besides: [oil]", "unknown key"),
        ("{table: theory.csv}", "{table: theory.csv, bearing: b.yaml}", "no such file 'b.yaml'"),
    ],
)
def test_faults_stand_at_their_place(folder: Path, tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (folder / "p.yaml").read_text().replace(old, new)
    (folder / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigErrors, match=r"wrong.yaml:\d+:\d+: ") as caught:
        load_pipeline(folder / "wrong.yaml")
    assert any(message in str(fault) for fault in caught.value.faults)


def test_an_unknown_amount_of_a_rule_is_named(folder: Path, tmp_path: Path, labpipe_without_report) -> None:
    (folder / "rule.yaml").write_text((folder / "p.yaml").read_text().replace("tm.points: 4", "tm.pionts: 4"))
    ended = labpipe_without_report("run", folder / "rule.yaml", "-o", tmp_path / "out")
    assert ended.code == 2
    assert "the matrix has no 'pionts'; did you mean 'points'?" in ended.err
