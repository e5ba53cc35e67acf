"""The files of planned runs."""

from __future__ import annotations

from pathlib import Path

import yaml

from labpipe.artefacts.writing import output_folder
from labpipe.methods.planning.plan_file import read_plan, write_runs
from labpipe.methods.planning.records import PlannedNumber, PlannedRun, RunPlan

RUN = PlannedRun("5 N", 2, 30.0, 1.0, (("load", "5 N"),))
PLAN = RunPlan(
    "Planned", "run-ups", "D", 60.0, 1.0, 1.0, 1, (PlannedNumber("k_xx", "N/m", 1e6, 1e4, 2e4),), (RUN,)
)


def test_settings_are_readable_and_text_stays_as_it_is(tmp_path: Path) -> None:
    """Lines of settings are no longer than 120 characters, which an editor shows."""
    title = " ".join(["run"] * 100)
    with output_folder(tmp_path / "out") as output:
        names = write_runs(
            PLAN, {"pipeline.yaml": {"title": title, "a": 1}, "rotor.yaml": "# as it is\nname: é\n"}, output
        )
    written = tmp_path / "out"
    assert names == ["plan.json", "report.html", "runs.csv", "runs.md", "pipeline.yaml", "rotor.yaml"]
    assert {path.name for path in written.iterdir()} == set(names)
    assert read_plan(written / "plan.json") == PLAN
    text = (written / "pipeline.yaml").read_text("utf-8")
    assert list(yaml.safe_load(text).items()) == [("title", title), ("a", 1)]
    assert 100 < max(len(line) for line in text.splitlines()) <= 123
    assert (written / "rotor.yaml").read_text("utf-8") == "# as it is\nname: é\n"
