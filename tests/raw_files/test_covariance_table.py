"""The covariance split by source: sums and correlations against what the result itself states."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from labpipe.artefacts.identification_file import write_identification
from labpipe.project.exports import covariance_table
from labpipe.records.identification import Identification
from labpipe.records.uncertain import Budget, Uncertainty
from tests.uncertainty.conftest import a_fit

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_sources_add_up_to_the_combined_uncertainty(tmp_path: Path, labpipe_without_report) -> None:
    labpipe_without_report(
        "run",
        ROOT / "pipelines/budget.yaml",
        "-o",
        tmp_path / "out",
        "-q",
        "--set",
        "uncertainty.method=first-order",
    )
    result = tmp_path / "out/identification.json"
    for name, read in (("covariance", pd.read_csv), ("covariance-parquet", pd.read_parquet)):
        assert labpipe_without_report("export", result, "--to", name, "-o", tmp_path / name).code == 0
        table = read(tmp_path / name)
        for fit in json.loads(result.read_text())["fits"]:
            own = table[(table.fit == fit["name"]) & (table.parameter_1 == table.parameter_2)]
            for parameter in fit["parameters"]:
                if parameter.get("combined"):
                    rows = own[own.parameter_1 == parameter["name"]]
                    assert np.sqrt(rows.covariance.sum()) == pytest.approx(parameter["combined"], rel=1e-9)
                    parts = {
                        part["source"]: part["contribution"]
                        for part in parameter["budget"]
                        if part["contribution"]
                    }
                    assert dict(zip(rows.source, np.sqrt(rows.covariance), strict=True)) == pytest.approx(
                        parts, rel=1e-9
                    )
    # With a given mass k and c are uncorrelated; a free mass goes with the stiffness.
    noise = table[
        (table.fit == "free")
        & (table.source == "noise")
        & (table.parameter_1 == "k")
        & (table.parameter_2 == "m")
    ]
    (free,) = (fit for fit in json.loads(result.read_text())["fits"] if fit["name"] == "free")
    names = [parameter["name"] for parameter in free["parameters"]]
    k, m = (free["parameters"][names.index(name)] for name in "km")
    correlation = free["correlation"][names.index("k")][names.index("m")]
    assert noise.covariance.iloc[0] == pytest.approx(correlation * k["std_error"] * m["std_error"], rel=1e-9)


def test_an_artefact_without_parameters_is_refused(tmp_path: Path, labpipe_without_report) -> None:
    (tmp_path / "a.frf.parquet").write_text("")
    ended = labpipe_without_report(
        "export", tmp_path / "a.frf.parquet", "--to", "covariance", "-o", tmp_path / "x.csv"
    )
    assert ended.code == 2 and "holds no parameters" in ended.err and not (tmp_path / "x.csv").exists()


def test_noise_goes_by_its_correlation_and_a_source_by_its_changes(tmp_path: Path) -> None:
    """Standard errors of 10 and .1, correlated by .5; a probe moves both, one up and one down."""
    plain = a_fit("run", {"k": (1e3, 10.0), "c": (2.0, 0.1)}, correlation=0.5)
    budget = Budget(
        names=("k", "c"),
        random=np.array([10.0, 0.1]),
        random_dof=None,
        sources=(Uncertainty("probe", 0.01, "1"),),
        changes=np.array([[3.0, -0.02]]),
    )
    write_identification(tmp_path / "identification.json", Identification((replace(plain, budget=budget),)))
    table = covariance_table(tmp_path / "identification.json")
    pairs = [("k", "k"), ("k", "c"), ("c", "c")]
    for source, values in (("noise", [100.0, 0.5, 0.01]), ("probe", [9.0, -0.06, 4e-4])):
        rows = table[table.source == source]
        assert list(zip(rows.parameter_1, rows.parameter_2, strict=True)) == pairs
        assert rows.covariance.tolist() == pytest.approx(values)
    assert rows.change_1.tolist() == [3.0, 3.0, -0.02] and rows.change_2.tolist() == [3.0, -0.02, -0.02]
    assert table[table.source == "noise"].change_1.isna().all()
    assert set(zip(table.test, table.fit, table.band_high_hz, strict=True)) == {
        ("run", plain.name, plain.band_hz[1])
    }
