"""The page on measurements by others: its pipelines are read whole, and run again where `LABPIPE_MEASURED`
names the raw files.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.io import loadmat, savemat

from labpipe.methods.live.charts import Goal
from labpipe.methods.live.session import Session
from labpipe.methods.live.sources import GrowingText
from labpipe.project.pipeline_file import load_for_stream, load_pipeline
from labpipe.project.rig_file import load_rig
from tests.validation.held import Place, Stated
from tests.validation.measured_page import BLOCKS, RIGS
from tests.validation.peers import recorded
from tests.validation.record_measured import RUNS, SETS, pipeline_of, recorded as recorded_anew

DATA = os.environ.get("LABPIPE_MEASURED", "")


@pytest.fixture
def stand_ins(tmp_path: Path) -> Path:
    """Files by the names of the page, of the same layout; its rig files."""
    for name, text in RIGS.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    for of in SETS.values():
        for name in of.files:
            (tmp_path / name).write_text("1 0 0\n2 0 0\n", encoding="utf-8")
    savemat(tmp_path / "ruler_grid_acc_3.mat", {"yspec": np.ones((20, 10), complex)})
    return tmp_path


@pytest.mark.parametrize("title", RUNS)
def test_every_pipeline_is_read(title: str, stand_ins: Path) -> None:
    path = stand_ins / "page.yaml"
    path.write_text(yaml.safe_dump(pipeline_of(RUNS[title])), encoding="utf-8")
    assert load_pipeline(path).title == RUNS[title].title


def test_every_block_is_run_and_every_rig_file_read(stand_ins: Path) -> None:
    assert {yaml.safe_load(block)["title"] for block in BLOCKS} == {run.title for run in RUNS.values()}
    for name in RIGS:
        assert load_rig(stand_ins / name).all_channels


def test_the_record_names_commit_and_digest_of_every_raw_file() -> None:
    record = recorded("measured")["sets"]
    assert list(record) == list(SETS)
    for name, of in SETS.items():
        assert (record[name]["repository"], record[name]["commit"]) == (of.repository, of.commit)
        assert set(record[name]["sha256"]) == set(of.files) and all(
            len(digest) == 64 for digest in record[name]["sha256"].values()
        )
        assert set(record[name]["labpipe"]) == {title for title, run in RUNS.items() if run.raw == name}


@pytest.mark.parametrize(("value", "agrees"), [(1.0, True), (0.5, False), (5.1, False)])
def test_a_reference_is_as_sure_as_the_others_agree(value: float, agrees: bool) -> None:
    """Median 3 of 1 to 5, half of them within 1: u = 1.25 * 1.483 / sqrt(5) = 0.829, so that U = 1.658; with
    1.5 on the side of the reference and 0.5 on the other, E_n is 1 at 3 - 2.236 and at 3 + 1.732.
    """
    others = {"frequency": (5.0, 1.0, 3.0, 2.0, 4.0)}
    stated = Stated(Place("", "", "", others), "frequency", value, (value - 0.5, value + 1.5), ())
    assert stated.reference_error == pytest.approx(0.829, abs=5e-4) and stated.agrees == agrees


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.skipif(not DATA, reason="LABPIPE_MEASURED names no folder with the repositories")
def test_the_raw_files_give_the_record_again() -> None:
    for name, entry in recorded_anew(Path(DATA)):
        of = recorded("measured")["sets"][name]
        assert entry["sha256"] == of["sha256"]
        for title, fits in of["labpipe"].items():
            for fit, said in fits.items():
                anew = entry["labpipe"][title][fit]
                assert anew["warnings"] == said["warnings"]
                for parameter, stated in said["values"].items():
                    assert anew["values"][parameter]["value"] == pytest.approx(stated["value"], rel=1e-4)


class Replay(GrowingText):
    """A text file to which another period (n, n_column) of a recording is added at every look."""

    def __init__(self, path: Path, columns: list[str], rows: np.ndarray, period: int) -> None:
        super().__init__(path, columns)
        self._periods = [rows[start : start + period] for start in range(0, len(rows), period)]
        path.write_text(",".join(columns) + "\n", encoding="utf-8")

    def read(self) -> np.ndarray | None:
        rows = super().read()
        if not rows.size and not self._periods:
            return None
        if self._periods:
            with self.path.open("a", encoding="utf-8") as stream:
                np.savetxt(stream, self._periods.pop(0), "%.12g", delimiter=",")
        return rows


@pytest.mark.skipif(not DATA, reason="the raw files of others are not shipped")
@pytest.mark.parametrize(("of", "stops", "floor"), [("A", 12, 0.5), ("B", 10, 0.15)])
def test_the_motor_bench_period_by_period(of: str, stops: int, floor: float, tmp_path: Path) -> None:
    """It stops for 1 % of the frequency once ten averages are there and model error allows it, within the
    interval of all 19 periods, and for 0.1 % never: the interval of all of them is wider (*floor* [%]).
    """
    (tmp_path / "bench.yaml").write_text(RIGS["bench.yaml"], encoding="utf-8")
    page = {key: entry for key, entry in pipeline_of(RUNS[f"bench {of}"]).items() if key != "recordings"}
    (tmp_path / "page.yaml").write_text(yaml.safe_dump(page), encoding="utf-8")
    pipeline = load_for_stream(tmp_path / "page.yaml", ())
    assert pipeline.rig is not None
    (file,) = Path(DATA).rglob(f"MultisineType{of}.mat")
    raw = loadmat(file, squeeze_me=True)
    columns = [channel.column for channel in pipeline.rig.channels]
    rows = np.stack([raw[column] for column in columns], axis=1).astype(float)
    updates = {}
    for goal in ("1", "0.1"):
        source = Replay(tmp_path / f"{goal}.csv", columns, rows, 2500)
        wanted = [Goal.of(f"modes.f_n_1.expanded<={goal}%")]
        updates[goal] = list(Session(pipeline, pipeline.rig, source, wanted).updates())
    first = next(update for update in updates["1"] if update.stop)
    last = updates["0.1"][-1].standings["modes.f_n_1"]
    assert first.averages == stops and not any(update.stop for update in updates["0.1"])
    stood = first.standings["modes.f_n_1"].parameter
    low, high = last.parameter.ci95 or (np.nan, np.nan)
    assert low < stood.value < high and last.half > floor / 100 * stood.value
