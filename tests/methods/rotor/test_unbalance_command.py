"""A pipeline with an unbalance: section: run, report, rules, and its faults in plain words at their place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.methods.rotor.section import unbalance_blocks
from labpipe.report.document import Figure, Table

TEXT = """title: circles
unbalance:
  rotor: {root}/configs/rotors/laval.yaml
  speeds: 50-53 Hz
  step: 1 Hz
  cases:
    healthy: {{depth: 0 um}}
    wear 1: {{depth: 20.52 um, angle: 21 deg}}
expect:
  unbalance.healthy.backward_peak: "<= 1 um"
  unbalance.wear 1.backward_peak: ">= 3 um"
"""


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("unbalance") / "circles.yaml"
    path.write_text(TEXT.format(root=Path(__file__).parents[3]), encoding="utf-8")
    return path


def test_run_leaves_result_and_report(labpipe, pipeline: Path, tmp_path: Path) -> None:
    ended = labpipe("run", pipeline, "-o", tmp_path / "out")
    assert ended.code == 0, ended
    assert "unbalance.wear 1.backward_peak >= 3 um: passed" in ended.out
    report = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "Unbalance: Laval rig after Machado and Cavalca" in report and "forward circle above" in report
    assert "the rotor, its nodes numbered from the left" in report
    path = tmp_path / "out" / "identification.json"
    found = read_identification(path)
    assert "unbalance" in found.sections and found.sections["unbalance"].speed == (50.0, 51.0, 52.0, 53.0)
    assert [source["path"].endswith("laval.yaml") for source in found.sources] == [True]
    write_identification(tmp_path / "again.json", found)
    assert json.loads((tmp_path / "again.json").read_text("utf-8")) == json.loads(path.read_text("utf-8"))

    _, table, figure = unbalance_blocks(found.sections["unbalance"])
    assert isinstance(table, Table) and isinstance(figure, Figure)
    assert [row[0] for row in table.rows] == ["healthy", "wear 1"] and table.rows[1][1:3] == ("20.52", "21")
    worn = found.sections["unbalance"].cases[1]
    assert float(table.rows[1][7]) == pytest.approx(max(worn.backward) / max(worn.forward), abs=1e-3)
    drawn = {series.name: series.y for series in figure.graphic.panels[1].series}
    np.testing.assert_allclose(drawn["wear 1"], 1e6 * np.array(worn.backward))


def test_a_rule_that_fails_ends_with_1(labpipe, pipeline: Path) -> None:
    ended = labpipe("check", pipeline, "--set", "expect={unbalance.healthy.forward_speed: '<= 45 Hz'}")
    assert ended.code == 1 and "unbalance.healthy.forward_speed <= 45 Hz fails" in ended.out


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("expect={unbalance.wear 9.forward_peak: '>= 1 um'}", "no such case of unbalance"),
        ("expect={unbalance.wear 1.peak: '>= 1 um'}", "has no 'peak'"),
        ("unbalance.rotor=none.yaml", "no such file 'none.yaml'"),
        ("unbalance.cases={}", "unbalance.cases: is empty"),
        ("unbalance.bearing=left", "no bearing 'left'"),
        ("unbalance.cases={deep: {depth: 300 um}}", "does not fit a clearance"),
        ("unbalance.step=0 Hz", "'step' must be positive"),
        ("unbalance.sped=1 Hz", "sped"),
    ],
)
def test_faults_are_said_in_plain_words(
    labpipe, pipeline: Path, tmp_path: Path, override: str, said: str
) -> None:
    ended = labpipe("run", pipeline, "-o", tmp_path / "out", "--set", override)
    assert ended.code not in (0, 1) and said in ended.err + ended.out and "Traceback" not in ended.err
    assert not (tmp_path / "out").exists()


def test_schema_knows_the_section(labpipe) -> None:
    schema = json.loads(labpipe("schema", "pipeline").out)
    section = schema["properties"]["unbalance"]
    assert set(section["properties"]) == {"rotor", "speeds", "step", "bearing", "cases"}
    assert set(section["properties"]["cases"]["additionalProperties"]["properties"]) == {"depth", "angle"}
