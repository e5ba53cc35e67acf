"""What is written is read again: every writer of `labpipe export`, with what a random artefact holds.

Expected values are the records themselves. Numbers of CSV, Parquet, MATLAB and binary universal files come
back to the last digit, those of text universal files to the 13 digits that stand there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from scipy.io import loadmat

from labpipe.artefacts.identification_file import read_fits, write_fits
from labpipe.artefacts.measured_files import read_decays, read_response, read_spectra
from labpipe.artefacts.recording_file import open_recording
from labpipe.artefacts.writing import text_of
from labpipe.cli.report import WRITERS
from labpipe.methods.planning.plan_file import read_plan, write_plan
from labpipe.methods.planning.records import Plan
from labpipe.project.ready_response import load_response
from labpipe.raw_files.table import open_table
from labpipe.records.comparison import ConditionAxis, ConditionMatrix, MatrixPoint, Repeated
from labpipe.records.finding import WARNING, Parameter
from labpipe.records.fit_details import Modes, RobustPlant
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from tests.artefacts.any_record import any_of, fits, same
from tests.raw_files.any_artefact import decays, fit, measured, recording, response, result, spectra, spread

FEW = settings(
    max_examples=3, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
)
SEEDS = st.integers(0, 10**6)
Export = Callable[[str, Path], Path]


@pytest.fixture
def export(tmp_path: Path) -> Export:
    """The file that a writer makes of an artefact."""

    def written(name: str, artefact: Path) -> Path:
        target = tmp_path / f"target.{SUFFIX.get(name, name)}"
        WRITERS.load(name)(artefact, target)
        return target

    return written


SUFFIX = {
    "uff58b": "uff", "shapes": "csv", "covariance": "csv", "covariance-parquet": "parquet", "band": "csv",
    "plant": "mat",
    "matrix": "csv", "matrix-parquet": "parquet", "rotor": "xlsx", "rotor-csv": "csv",
}  # fmt: skip


def table_of(path: Path) -> pd.DataFrame:
    """A written table, its texts as they were before they became cells."""
    if path.suffix == ".parquet":
        return pd.read_parquet(path)
    found = pd.read_csv(path, keep_default_na=False, na_values={}, dtype=str)
    found = found.map(text_of).rename(columns=text_of)
    return found.apply(
        lambda column: column if not _all_numbers(column) else column.replace("", "nan").astype(float)
    )


def _all_numbers(column: pd.Series) -> bool:
    try:
        column.replace("", "nan").astype(float)
    except ValueError:
        return False
    return True


# Own files.


@FEW
@given(SEEDS)
def test_artefacts(tmp_path: Path, seed: int) -> None:
    for make, read in ((response, read_response), (spectra, read_spectra), (decays, read_decays)):
        record = make(seed)
        assert same(read(measured(tmp_path, record)), record)
    assert same(open_recording(measured(tmp_path, recording(seed))).in_memory(), recording(seed))


@FEW
@given(any_of(Plan), fits())
def test_plans_and_fits(tmp_path: Path, plan: Plan, made: Fit) -> None:
    write_plan(tmp_path / "plan.json", plan)
    assert same(read_plan(tmp_path / "plan.json"), plan)
    write_fits(tmp_path / "fits.json", [made], (), ())
    (again,) = read_fits(tmp_path / "fits.json")
    # Files keep warnings before notes.
    assert same(
        again,
        replace(made, findings=tuple(sorted(made.findings, key=lambda finding: finding.level != WARNING))),
    )


# Measured data as files of other programs, to be read by labpipe.


def check_response(
    found: FrequencyResponse, record: FrequencyResponse, digits: float, places: float = 1e-15
) -> None:
    labels = [port.label for port in (*record.outputs, *record.inputs)]
    assert [port.label for port in (*found.outputs, *found.inputs)] == labels and found.form == record.form
    np.testing.assert_allclose(found.frequency, record.frequency, rtol=places)
    for part in (np.real, np.imag):
        np.testing.assert_allclose(part(found.matrix), part(record.matrix), rtol=digits)
    assert (found.coherence is None) == (record.coherence is None)
    if record.coherence is not None:
        np.testing.assert_allclose(found.coherence, record.coherence, rtol=digits)


def exported_response(
    export: Export, folder: Path, name: str, seed: int, digits: float = 0.0, places: float = 1e-15
) -> None:
    record = response(seed)
    found = load_response(export(name, measured(folder, record)))
    check_response(found, record, digits, places)
    if name in ("csv", "mat"):
        assert (found.variance is None) == (record.variance is None)
        if record.variance is not None:
            np.testing.assert_allclose(found.variance, record.variance, rtol=1e-15)


def exported_recording(export: Export, folder: Path, name: str, seed: int, digits: float = 0.0) -> None:
    record = recording(seed)
    table = open_table(export(name, measured(folder, record)))
    wanted = [
        column
        for channel in ("f", "y")
        for column in table.columns
        if column in (channel, f"{channel} [{UNITS[channel]}]")
    ]
    assert len(wanted) == 2
    np.testing.assert_allclose(np.concatenate(list(table.chunks(wanted))), record.samples, rtol=digits)
    if "t [s]" in table.columns:
        times = np.concatenate(list(table.chunks(["t [s]"])))[:, 0]
        np.testing.assert_allclose(times, np.arange(record.n_sample) / record.sample_rate, rtol=1e-15)
    else:
        # A step of 1/3000 s has the digits that a universal file gives it.
        assert table.sample_rate == pytest.approx(record.sample_rate, rel=1e-6)


UNITS = {"f": "N", "y": "m"}


def exported_tables(export: Export, folder: Path, name: str, seed: int) -> None:
    """Spectra and decays: every number that the record has."""
    record = spectra(seed)
    found = table_of(export(name, measured(folder, record)))
    for number, run in enumerate(record.runs):
        rows = found[found["run"] == run]
        np.testing.assert_array_equal(rows["frequency_hz"], record.frequency)
        for column, channel in enumerate(record.channels):
            parts = [rows[f"{channel.name}:{part} [{channel.unit}]"] for part in ("re", "im", "std")]
            np.testing.assert_array_equal(parts[0] + 1j * parts[1], record.vectors[:, number, column])
            np.testing.assert_allclose(
                parts[2] ** 2, record.covariance[:, number, column, column].real, rtol=1e-14
            )
    ringing = decays(seed)
    found = table_of(export(name, measured(folder, ringing)))
    for number, decay in enumerate(ringing.decays, 1):
        rows = found[found["decay"] == number]
        assert set(rows["recording"]) == {decay.recording}
        np.testing.assert_array_equal(rows["y [m]"], decay.samples[:, 0])
        np.testing.assert_allclose(
            rows["t [s]"], decay.start + np.arange(len(rows)) / ringing.sample_rate, rtol=1e-15
        )


def exported_parameters(export: Export, folder: Path, name: str, seed: int) -> None:
    made = fit(seed, "k", "c", "=m")
    found = table_of(export(name, result(folder, made)))
    assert found["parameter"].tolist() == ["k", "c", "=m"] and set(found["test"]) == {"=t, 1"}
    assert found["value"].tolist() == [parameter.value for parameter in made.parameters]
    np.testing.assert_array_equal(
        found["std_error"].astype(float), [p.std_error or np.nan for p in made.parameters]
    )


def round_csv(export: Export, folder: Path, seed: int) -> None:
    exported_response(export, folder, "csv", seed)
    exported_recording(export, folder, "csv", seed)
    exported_tables(export, folder, "csv", seed)
    exported_parameters(export, folder, "csv", seed)


def round_parquet(export: Export, folder: Path, seed: int) -> None:
    record = response(seed)
    found = table_of(export("parquet", measured(folder, record)))
    np.testing.assert_array_equal(found["frequency_hz"], record.frequency)
    for o, output in enumerate(record.outputs):
        for i, port in enumerate(record.inputs):
            pair = f"{output.label}/{port.label}"
            np.testing.assert_array_equal(
                found[f"{pair}:re"] + 1j * found[f"{pair}:im"], record.matrix[:, o, i]
            )
    exported_recording(export, folder, "parquet", seed)
    exported_tables(export, folder, "parquet", seed)
    exported_parameters(export, folder, "parquet", seed)


def round_uff(export: Export, folder: Path, seed: int) -> None:
    # As text twelve digits of values, and six of frequencies without a constant step.
    exported_response(export, folder, "uff", seed, 5e-12, 5e-6)
    exported_recording(export, folder, "uff", seed, 5e-12)


def round_uff58b(export: Export, folder: Path, seed: int) -> None:
    exported_response(export, folder, "uff58b", seed)
    exported_recording(export, folder, "uff58b", seed)


def round_mat(export: Export, folder: Path, seed: int) -> None:
    exported_response(export, folder, "mat", seed)
    exported_recording(export, folder, "mat", seed)


# Results as tables.


def round_shapes(export: Export, folder: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shapes = spread(rng, 2, 2) + 1j * spread(rng, 2, 2)
    modes = Modes(
        np.array([1.0, 2.0]), rng.uniform(0, 0.1, 2), shapes=shapes, shape_std_errors=np.abs(spread(rng, 2,
        2)), scale=shapes[0],
        participation=shapes[:, :1], points=("=a", "b, c"), references=("b, c",), forces_move=False,
        mac=np.eye(2), collinearity=np.ones(2),
        lower=1, upper=1, dofs=("a.x", "b.y"),
    )  # fmt: skip
    found = table_of(export("shapes", result(folder, fit(seed, "k", details=(modes,)))))
    assert found["point"].tolist() == ["=a", "b, c"] * 2 and found["mode"].tolist() == [1, 1, 2, 2]
    np.testing.assert_array_equal(found["real"] + 1j * found["imaginary"], shapes.T.ravel())
    np.testing.assert_array_equal(found["std_error"], modes.shape_std_errors.T.ravel())
    np.testing.assert_array_equal(found["damping_ratio"], np.repeat(modes.damping_ratio, 2))


def round_covariance(export: Export, folder: Path, seed: int, name: str = "covariance") -> None:
    """Noise: correlation times both standard errors, of every pair that has them."""
    made = fit(seed, "=k", "c", "m")
    found = table_of(export(name, result(folder, made)))
    first, second, _ = made.parameters
    assert first.std_error and second.std_error
    pairs = {("=k", "=k"): first.std_error**2, ("c", "c"): second.std_error**2}
    pairs["=k", "c"] = made.correlation[0, 1] * first.std_error * second.std_error
    read = {(one, other): number for one, other, number in zip(*(found[key] for key in PAIR), strict=True)}
    assert read.keys() == pairs.keys() and set(found["source"]) == {"noise"}
    for pair, number in pairs.items():
        assert read[pair] == pytest.approx(number, rel=1e-14)


PAIR = ("parameter_1", "parameter_2", "covariance")


def plant(seed: int) -> RobustPlant:
    rng = np.random.default_rng(seed)
    shape = (4, 2, 1)
    nominal = spread(rng, *shape) + 1j * spread(rng, *shape)
    a, b, c, d = (spread(rng, *size) for size in ((2, 2), (2, 1), (2, 2), (2, 1)))
    radius, weight, overbound = (np.abs(spread(rng, *size)) for size in (shape, shape, (2, 1, 3)))
    return RobustPlant(
        np.arange(1.0, 5), nominal, radius, weight, a, b, c, d, overbound, 0.95, "m/A", ("x", "y"), ("i",)
    )


def round_band(export: Export, folder: Path, seed: int) -> None:
    made = plant(seed)
    found = table_of(export("band", result(folder, fit(seed, "k", details=(made,)))))
    for row, output in enumerate(made.outputs):
        rows = found[found["output"] == output]
        np.testing.assert_array_equal(rows["re"] + 1j * rows["im"], made.nominal[:, row, 0])
        for name in ("radius", "weight"):
            np.testing.assert_array_equal(rows[name], getattr(made, name)[:, row, 0])
        # |k (1 + j f / z) / (1 + j f / p)| by hand.
        k, zero, pole = made.overbound[row, 0]
        np.testing.assert_allclose(
            rows["overbound"],
            k * np.hypot(1, rows["frequency_hz"] / zero) / np.hypot(1, rows["frequency_hz"] / pole),
        )


def round_plant(export: Export, folder: Path, seed: int) -> None:
    made = plant(seed)
    found = loadmat(export("plant", result(folder, fit(seed, "k", details=(made,)))), squeeze_me=False)
    for name, values in {
        "A": made.a,
        "B": made.b,
        "C": made.c,
        "D": made.d,
        "nominal": made.nominal,
        "radius": made.radius,
    }.items():
        np.testing.assert_array_equal(np.reshape(found[name], values.shape), values)
    np.testing.assert_array_equal(np.reshape(found["overbound"], made.overbound.shape), made.overbound)


COEFFICIENTS = tuple(f"{letter}_{axes}" for letter in "kcm" for axes in ("xx", "xy", "yx", "yy"))


def condition_matrix(seed: int) -> tuple[Fit, ConditionMatrix]:
    """Eight coefficients and four masses at two speeds, of one fit each."""
    rng = np.random.default_rng(seed)
    points = []
    for place in range(2):
        values = tuple(
            Repeated(Parameter(name, float(spread(rng)), "N/m", std_error=1.0), 1, theory=2.5)
            for name in COEFFICIENTS
        )
        points.append(MatrixPoint((place,), ("=t, 1",), values))
    axis = ConditionAxis("speed", "Hz", (25.0, 50.0))
    return fit(seed, "k"), ConditionMatrix(
        name="=m", fit="a", axes=(axis,), names=COEFFICIENTS, points=tuple(points)
    )


def round_matrix(export: Export, folder: Path, seed: int, name: str = "matrix") -> None:
    made, matrix = condition_matrix(seed)
    found = table_of(export(name, result(folder, made, matrix=(matrix,))))
    assert set(found["matrix"]) == {"=m"} and set(found["theory"]) == {2.5}
    for point, rpm in zip(matrix.points, (1500.0, 3000.0), strict=True):
        rows = found[np.isclose(found["speed [rpm]"], rpm)]
        assert rows["coefficient"].tolist() == list(COEFFICIENTS)
        assert rows["value"].tolist() == [value.parameter.value for value in point.values]


def check_rotor(tables: dict[str, pd.DataFrame], made: Fit, matrix: ConditionMatrix) -> None:
    """k = Re H and c = Im H / w of H = K + jwC - w^2 M at the ends of the fit's band."""
    for point, rpm in zip(matrix.points, (1500, 3000), strict=True):
        values = {value.parameter.name: value.parameter.value for value in point.values}
        table = tables[f"1 {rpm} rpm"]
        for row, frequency in ((0, made.band_hz[0]), (-1, made.band_hz[1])):
            w = 2 * np.pi * frequency
            assert table["frequency"].iloc[row] == pytest.approx(w, rel=1e-14)
            for axes in ("xx", "xy", "yx", "yy"):
                stiffness, inertia = values[f"k_{axes}"], w**2 * values[f"m_{axes}"]
                size = abs(stiffness) + abs(inertia)
                assert table[f"k{axes}"].iloc[row] == pytest.approx(stiffness - inertia, abs=1e-13 * size)
                assert table[f"c{axes}"].iloc[row] == pytest.approx(values[f"c_{axes}"], rel=1e-12)


def round_rotor(export: Export, folder: Path, seed: int) -> None:
    made, matrix = condition_matrix(seed)
    check_rotor(
        pd.read_excel(export("rotor", result(folder, made, matrix=(matrix,))), sheet_name=None), made, matrix
    )


def round_rotor_csv(export: Export, folder: Path, seed: int) -> None:
    made, matrix = condition_matrix(seed)
    found = table_of(export("rotor-csv", result(folder, made, matrix=(matrix,))))
    check_rotor({str(name): rows for name, rows in found.groupby("sheet")}, made, matrix)


def round_dcc(export: Export, folder: Path, seed: int) -> None:
    """What has an uncertainty stands in the certificate as it is in the result; a result of no known day is
    none that the reader of certificates takes.
    """
    made, _ = condition_matrix(seed)
    stated = [element.text for element in ElementTree.parse(export("dcc", result(folder, made))).iter()]
    certain = [parameter for parameter in made.parameters if parameter.full_error is not None]
    assert certain and all(repr(float(parameter.value)) in stated for parameter in certain)


ROUNDS: dict[str, Callable[[Export, Path, int], None]] = {
    "csv": round_csv,
    "parquet": round_parquet,
    "uff": round_uff,
    "uff58b": round_uff58b,
    "mat": round_mat,
    "shapes": round_shapes,
    "covariance": round_covariance,
    "covariance-parquet": lambda export, folder, seed: round_covariance(
        export, folder, seed, "covariance-parquet"
    ),
    "band": round_band,
    "plant": round_plant,
    "matrix": round_matrix,
    "matrix-parquet": lambda export, folder, seed: round_matrix(export, folder, seed, "matrix-parquet"),
    "rotor": round_rotor,
    "rotor-csv": round_rotor_csv,
    "dcc": round_dcc,
}


@pytest.mark.parametrize("name", WRITERS.names())
@FEW
@given(seed=SEEDS)
def test_what_a_writer_writes_is_read(export: Export, tmp_path: Path, name: str, seed: int) -> None:
    """A new writer without a round trip here fails by its name."""
    ROUNDS[name](export, tmp_path, seed)
