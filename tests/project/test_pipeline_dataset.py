"""Results of many tests as a dataset: the numbers are those of the whole result, and what reads Parquet finds
them without labpipe.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.dataset as ds
import pytest

from labpipe.artefacts.dataset_file import SCHEMA, parts, read_rows
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.parquet import read_header
from labpipe.errors import ConfigError, DataError
from labpipe.project import many_tests
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.run import Manner
from labpipe.records.identification import Identification
from tests.project.laboratory import PIPELINE, contents, done, laboratory

MANY = f"results: dataset\n{PIPELINE}".replace(
    "report:", "expect: {direct.k: 18 kN/m +- 5 %, direct.count: '>= 2'}\nreport:"
)
WHOLE = MANY.replace("results: dataset", "results: whole")
# What pandas reads by itself, by the names that others rely on.
PUBLIC = {
    "rig",
    "date",
    "test",
    "fit",
    "parameter",
    "value",
    "unit",
    "std_error",
    "combined",
    "warnings",
    "accepted",
    "digest",
}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A laboratory whose pipeline was run both ways: "many" as a dataset, "whole" in one file."""
    folder = tmp_path_factory.mktemp("dataset")
    laboratory(folder, MANY)
    done(folder / "pipeline.yaml", folder / "many")
    (folder / "whole.yaml").write_text(WHOLE)
    done(folder / "whole.yaml", folder / "whole")
    return folder


@pytest.fixture(scope="module")
def many(home: Path) -> Identification:
    return read_identification(home / "many/identification.json")


@pytest.fixture(scope="module")
def whole(home: Path) -> Identification:
    return read_identification(home / "whole/identification.json")


def test_rows_are_the_numbers_of_the_whole_result(home: Path, whole: Identification) -> None:
    """Read by pandas alone; independent of labpipe's readers."""
    frame = pd.read_parquet(home / "many/dataset")
    assert set(frame.columns) >= PUBLIC | {"condition.preload", "amount.preload"}
    assert len(frame) == sum(len(fit.parameters) for fit in whole.fits)
    for fit in whole.fits:
        for parameter in fit.parameters:
            row = frame[
                (frame.test == fit.test) & (frame.fit == fit.name) & (frame.parameter == parameter.name)
            ].iloc[0]
            assert (row.value, row.unit, row.std_error) == (
                parameter.value,
                parameter.unit,
                parameter.std_error,
            )
            assert parameter.ci95 == (row.ci_low, row.ci_high)
    assert set(frame["condition.preload"]) == {"100 N", "200 N"} and set(frame["amount.preload"]) == {
        100.0,
        200.0,
    }
    assert set(frame["rig"]) == {"Small rig"}


def test_the_covariance_gives_the_stated_errors_and_correlations(home: Path, whole: Identification) -> None:
    """cov_ii = s_i^2, and cov_ij / (s_i s_j) is the correlation of the fit."""
    table = read_rows(home / "many").to_pandas()
    fit = next(fit for fit in whole.fits if fit.test == "soft" and fit.name == "direct")
    names = [parameter.name for parameter in fit.parameters if not parameter.derived]
    rows = table[(table.test == "soft") & (table.fit == "direct")].set_index("parameter").loc[names]
    covariance = np.array(rows["covariance"].tolist())
    errors = rows["std_error"].to_numpy()
    assert np.allclose(np.sqrt(np.diag(covariance)), errors, rtol=1e-12)
    assert np.allclose(covariance / np.outer(errors, errors), fit.correlation, rtol=1e-12)
    assert table[table.parameter == "f_n"]["covariance"].isna().all()


def test_the_index_sums_up_what_the_whole_result_says(many: Identification, whole: Identification) -> None:
    assert many.fits == () and many.dataset is not None
    assert many.outcomes == whole.outcomes
    assert (many.dataset.tests, many.dataset.rows) == (2, sum(len(fit.parameters) for fit in whole.fits))
    assert many.dataset.fits == {"direct": 2, "plain": 2}
    # 22 kN/m is not 18 kN/m within 5 %: one test of two is not accepted.
    assert many.dataset.not_accepted == 1 and not many.accepted


def test_each_test_is_judged_by_itself(home: Path) -> None:
    frame = pd.read_parquet(home / "many/dataset")
    assert frame.groupby("test")["accepted"].unique().map(list).to_dict() == {"soft": [True], "hard": [False]}


def test_the_layout_is_that_of_hive_and_the_schema_has_a_number(home: Path) -> None:
    (part,) = parts(home / "many")
    assert part.path.parent.name.startswith("date=20") and part.path.parent.parent.name == "rig=Small rig"
    assert read_header(part.path).parameters == {"schema": SCHEMA}
    found = ds.dataset(home / "many/dataset", partitioning="hive").to_table(
        filter=ds.field("parameter") == "k", columns=["test", "value"]
    )
    assert sorted(found["test"].to_pylist()) == ["hard", "hard", "soft", "soft"]


def test_the_same_work_gives_the_same_bytes_in_any_order(home: Path, tmp_path: Path) -> None:
    backwards = Manner(execute=lambda work, jobs: map(work, reversed(jobs)))
    done(home / "pipeline.yaml", tmp_path / "again", manner=backwards)
    assert contents(tmp_path / "again") == contents(home / "many")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "again").rglob("*.frf.parquet")}
    done(home / "pipeline.yaml", tmp_path / "again")
    assert contents(tmp_path / "again") == contents(home / "many")
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_parts_hold_a_number_of_tests_each(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, many: Identification
) -> None:
    monkeypatch.setattr(many_tests, "PART_TESTS", 1)
    result = done(home / "pipeline.yaml", tmp_path / "out")
    assert len(parts(tmp_path / "out")) == 2 and result.dataset == many.dataset
    monkeypatch.undo()
    done(home / "pipeline.yaml", tmp_path / "out")
    assert len(parts(tmp_path / "out")) == 1, "parts that are no longer of the result go"


def test_a_test_that_fails_is_a_row_with_its_reason(home: Path, tmp_path: Path) -> None:
    for name in ("rig.yaml", "pipeline.yaml", "soft.csv"):
        shutil.copy(home / name, tmp_path)
    (tmp_path / "hard.csv").write_text("t [s],force [N],y [um]\n0,1,x\n")
    result = done(tmp_path / "pipeline.yaml", tmp_path / "out")
    assert result.dataset is not None and (result.dataset.tests, result.dataset.failed) == (1, 1)
    assert [failed.name for failed in result.failed] == ["hard"] and not result.accepted
    rows = read_rows(tmp_path / "out").to_pylist()
    (row,) = [row for row in rows if row["test"] == "hard"]
    assert "hard.csv" in row["failed"] and row["parameter"] is None and row["condition.preload"] == "200 N"


def test_a_damaged_part_is_noticed_and_made_again(home: Path, tmp_path: Path) -> None:
    shutil.copytree(home, tmp_path / "lab")
    (part,) = parts(tmp_path / "lab/many")
    whole = part.path.read_bytes()
    part.path.write_bytes(whole[:200] + bytes([whole[200] ^ 255]) + whole[201:])
    with pytest.raises(DataError, match="does not match its digest"):
        read_rows(tmp_path / "lab/many")
    done(tmp_path / "lab/pipeline.yaml", tmp_path / "lab/many")
    assert part.path.read_bytes() == whole


@pytest.mark.parametrize(
    ("entries", "what"),
    [
        (
            "compare: {rise: {kind: trend, fit: direct, parameter: k, over: preload}}",
            "the section compare is there",
        ),
        ("results: some", "no way 'some' to keep results"),
    ],
)
def test_what_needs_all_tests_at_once_is_refused_in_words(tmp_path: Path, entries: str, what: str) -> None:
    text = MANY.replace("results: dataset\n", "") if entries.startswith("results") else MANY
    laboratory(tmp_path, f"{text}{entries}\n")
    with pytest.raises(ConfigError, match=what):
        done(tmp_path / "pipeline.yaml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_levels_are_judged_over_all_tests(tmp_path: Path) -> None:
    laboratory(tmp_path, MANY.replace("preload:", "level:"))
    with pytest.raises(ConfigError, match="asks whether the rig is linear"):
        done(tmp_path / "pipeline.yaml", tmp_path / "out")


def test_what_a_result_is_does_not_depend_on_the_number_of_tests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Six recordings of one support, each a copy, one more than are many here: every fit stands in
    # identification.json, and a remark names the dataset.
    force = np.random.default_rng(5).standard_normal(2000)
    response = np.fft.irfft(
        np.fft.rfft(force) / (40e3 + 60j * (w := 2 * np.pi * np.arange(1001)) - 0.5 * w**2), 2000
    )
    table = pd.DataFrame({"t": np.arange(6000) / 2000, "f": np.tile(force, 3), "x": np.tile(response, 3)})
    (tmp_path / "runs").mkdir()
    monkeypatch.setattr(many_tests, "MANY_TESTS", 5)
    for number in range(6):
        table.assign(x=table.x + 1e-8 * np.random.default_rng(number).standard_normal(6000)).to_parquet(
            tmp_path / f"runs/{number:03}.parquet"
        )
    (tmp_path / "rig.yaml").write_text(
        "name: R\ntime: t\nmass: 0.5 kg\nchannels:\n"
        "  f: {quantity: force, unit: N, role: input, dof: x}\n  x: {quantity: displacement, unit: m, role: "
        "output, dof: x}\n"
    )
    (tmp_path / "p.yaml").write_text(
        "rig: rig.yaml\ntests:\n  - {each: runs/*.parquet}\nfrf: {excitation: periodic, period: 1 s, band: "
        "20-80 Hz}\n"
        "identify:\n  s: {model: sdof, mass: 0.5 kg}\nreport: {formats: []}\n"
    )
    result = done(tmp_path / "p.yaml", tmp_path / "out")
    assert (
        result.dataset is None
        and len(json.loads((tmp_path / "out/identification.json").read_text())["fits"]) == 6
    )
    assert "results: dataset" in many_tests.advice(load_pipeline(tmp_path / "p.yaml"), ["s"])
    (tmp_path / "old.yaml").write_text((tmp_path / "p.yaml").read_text() + "results: auto\n")
    assert load_pipeline(tmp_path / "old.yaml").results == "whole"
