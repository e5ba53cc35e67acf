"""The reader that holds every result against itself sees numbers that were changed."""

from __future__ import annotations

import copy
import json
from pathlib import Path

from tests.agreement import disagreements, misprints
from tests.project.laboratory import ALONE, RIG, STIFFNESS, recording


def test_a_changed_number_contradicts_the_others_or_the_report(tmp_path: Path, labpipe) -> None:
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "soft.csv").write_text(recording(STIFFNESS["soft"]))
    (tmp_path / "pipeline.yaml").write_text(ALONE)
    ended = labpipe(
        "run", tmp_path / "pipeline.yaml", "-o", tmp_path / "out", "--set", "report.formats=[html]"
    )
    assert ended.code == 0, ended.err
    result = json.loads((tmp_path / "out/identification.json").read_text())
    report = (tmp_path / "out/report.html").read_text()
    damaged = copy.deepcopy(result)
    damaged["fits"][0]["dof"] = damaged["fits"][0]["equations"] + 1
    assert disagreements(damaged) and not disagreements(result)
    for number, parameter in enumerate(result["fits"][0]["parameters"]):
        for key in ("value", "std_error", "ci95"):
            if parameter[key] is None:
                continue
            damaged = copy.deepcopy(result)
            entry = damaged["fits"][0]["parameters"][number]
            entry[key] = [1.1 * end for end in entry[key]] if key == "ci95" else 1.1 * entry[key]
            assert disagreements(damaged) or misprints(report, damaged), (parameter["name"], key)
