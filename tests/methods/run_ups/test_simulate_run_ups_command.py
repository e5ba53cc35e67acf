"""labpipe simulate on the virtual unbalance rig, and the sample data that it made."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from labpipe.methods.run_ups.run_up_csv import read_run_up_csv
from tests.conftest import Ended

RUNS = ("load-1", "load-2", "load-3", "load-4", "held-out")


def test_the_sample_data_are_made_by_their_command(labpipe, root: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """To the digits that are written; and small."""
    ended: Ended = labpipe("simulate", root / "configs/virtual-unbalance.yaml", "-o", tmp_path, "--seed", 1)
    assert ended.code == 0, ended.err
    folder = root / "sample_data/falah"
    for name in RUNS:
        made, kept = read_run_up_csv(tmp_path / f"{name}.csv"), read_run_up_csv(folder / f"{name}.csv")
        np.testing.assert_allclose(made.speed, kept.speed)
        np.testing.assert_allclose(made.response, kept.response, rtol=2e-5)
        assert made.threshold is not None and kept.threshold is not None
        np.testing.assert_allclose(made.threshold.value, kept.threshold.value, rtol=1e-6)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 200_000


def test_truth_json_holds_speeds_and_coefficients(root: Path) -> None:
    stated = json.loads((root / "sample_data/falah/truth.json").read_text())["truth"]
    assert set(stated["loads"]) == set(RUNS)
    assert np.shape(stated["loads"]["held-out"]["coefficients"]) == (27, 8)
    assert stated["loads"]["load-1"]["threshold"] < stated["speeds"][-1]


def test_one_run_alone_and_a_run_that_is_not_there(labpipe, root: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    config = root / "configs/virtual-unbalance.yaml"
    ended: Ended = labpipe(
        "simulate", config, "-o", tmp_path / "one", "--run", "load-2-shaker", "--set", "shaker=true"
    )
    assert ended.code == 0, ended.err
    run = read_run_up_csv(tmp_path / "one/load-2-shaker.csv")
    assert run.shaker is not None and run.shaker.frequency_ratio == 0.95
    refused: Ended = labpipe("simulate", config, "-o", tmp_path / "none", "--run", "load-9")
    assert refused.code == 2 and "no run 'load-9'" in refused.err
    assert not (tmp_path / "none").exists() or not list((tmp_path / "none").iterdir())
