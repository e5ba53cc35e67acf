"""labpipe plan for wear tests: files, words, light wear, refusals, and tests made on the virtual rig as
planned.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from labpipe.artefacts.writing import output_folder
from labpipe.methods.planning.plan_file import load_plan, plan_files, read_plan
from labpipe.methods.planning.records import RunPlan
from labpipe.methods.planning.wear import WearTests
from tests.conftest import Command

ROTOR = Path(__file__).parents[3] / "configs/rotors/mendes.yaml"
PLAN = {
    "model": "worn-bearing",
    "rotor": str(ROTOR),
    "bearing": "bearing 2",
    "expected": {"depth": "20 um", "angle": "8 deg"},
    "clearance": "90 um +- 2 %",
    "speeds": ["50 Hz"],
    "loads": ["-40 N", "-80 N"],
    "bands": ["15-40 Hz", "60-100 Hz"],
    "force": "5 N",
    "sample_rate": "256 Hz",
    "noise": {"displacement": "1 um", "force": "50 mN"},
    "run": "32 s",
    "duration": "192 s",
    "goal": {"depth": "0.2 um", "angle": "0.3 deg"},
}


def _write(folder: Path, **changes: object) -> Path:
    path = folder / "plan.yaml"
    entries = {name: value for name, value in {**PLAN, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump({"title": "Wear", "plan": entries}), encoding="utf-8")
    return path


def test_files_and_words(labpipe: Command, tmp_path: Path) -> None:
    folder = tmp_path / "planned"
    ended = labpipe("plan", _write(tmp_path), "-o", folder)
    assert ended.code == 0, ended.err
    assert "frequency responses of the worn rotor under" in ended.out
    assert "The goals are met" in ended.out and "From the cross terms alone: depth to" in ended.out
    plan = read_plan(folder / "plan.json")
    assert isinstance(plan, RunPlan) and plan.duration == 192 and plan.efficiency > 0.8
    assert {number.name for number in plan.numbers} == {"wear_depth", "wear_angle", "clearance"}
    pipeline = yaml.safe_load((folder / "pipeline.yaml").read_text("utf-8"))
    assert [test["name"] for test in pipeline["tests"]] == [run.name for run in plan.runs]
    first, *others = pipeline["identify"].values()
    assert "clearance" in first["wear"] and all(fit["wear"]["same_wear"] for fit in others)
    assert labpipe("verify", folder).code == 0


def test_a_horizontal_load_at_the_node_stays(tmp_path: Path) -> None:
    """30 N across beside what is set up; what is known of the oil keeps its shape and source."""
    entries = yaml.safe_load(ROTOR.read_text("utf-8"))
    node = entries["force"]
    entries["loads"] = [{"node": node, "y": "30 N", "z": "-80 N"}]
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(entries), encoding="utf-8")
    oil = "0.1 Pa.s +- 0.003 Pa.s (rectangular, source=label)"
    one = {"bands": ["15-40 Hz"], "speeds": ["50 Hz"], "loads": ["-40 N"], "duration": "70 s"}
    file = load_plan(_write(tmp_path, rotor="rotor.yaml", viscosity=oil, goal=None, **one))
    with output_folder(tmp_path / "out") as folder:
        plan_files(file, folder)
    loads = yaml.safe_load((tmp_path / "out/rotor-50Hz.yaml").read_text("utf-8"))["loads"]
    assert loads == [{"node": node, "y": "30 N", "z": "0 N"}, {"node": node, "z": "-40.0 N"}]
    tests = WearTests(file.settings, file.settings.expected)
    at = tests.expected.at(50.0, node, -40.0)
    assert np.sum([part[1:] for part in at.rig.loads], axis=0).tolist() == [30.0, -40.0]
    (fit,) = yaml.safe_load((tmp_path / "out/pipeline.yaml").read_text("utf-8"))["identify"].values()
    assert fit["wear"]["viscosity"].endswith("Pa.s (rectangular, source=label)")


def test_light_wear_has_no_angle(labpipe: Command, tmp_path: Path) -> None:
    one = {"speeds": ["50 Hz"], "loads": ["-80 N"], "bands": ["60-100 Hz"], "duration": "70 s"}
    ended = labpipe(
        "plan",
        _write(tmp_path, **one, expected={"depth": "0.3 um"}, goal={"depth": "1 um"}),
        "-o",
        tmp_path / "light",
    )
    assert ended.code == 0, ended.err
    assert "At a depth of 0.3 um these tests do not tell the angle" in ended.out
    # At no wear the angle is none: whatever the time. Some wear makes it one.
    ended = labpipe(
        "plan",
        _write(tmp_path, **one, expected={"depth": "0 um"}, goal={"angle": "1 deg"}),
        "-o",
        tmp_path / "none",
    )
    assert ended.code == 2
    assert "however many runs there are, they do not determine wear_angle" in ended.err
    assert "a wear of 5 um would determine all" in ended.err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bearing": "bearing 3"}, "no bearing 'bearing 3'"),
        ({"clearance": "90 um"}, "clearance has no uncertainty"),
        ({"bands": ["60-130 Hz"]}, "between 0 and half the sampling rate"),
        ({"run": "4 s"}, "two blocks or more"),
        ({"bands": []}, "bands: is empty"),
        ({"speeds": ["50 Hz", "3000 rpm"]}, "speeds: one appears twice"),
        ({"bands": ["49.9-50.1 Hz"]}, "no line is left between 49.9 and 50.1 Hz"),
        ({"expected": {"depth": "20 um", "angle": "40 deg"}}, "beyond its limits"),
        ({"goal": {"depth": "0 um"}}, "depth must be positive"),
        ({"noise": {"displacement": "0 um"}}, "displacement must be positive"),
        ({"load_node": 99}, "99"),
        ({"duration": "10 s"}, "no run fits into 10 s"),
    ],
)
def test_refusals_name_place_and_remedy(
    labpipe: Command, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    one = {"speeds": ["50 Hz"], "loads": ["-80 N"], "bands": ["60-100 Hz"]}
    ended = labpipe("plan", _write(tmp_path, **{**one, **changes}), "-o", tmp_path / "out")
    assert ended.code == 2
    assert message in ended.err and "plan.yaml" in ended.err and "Traceback" not in ended.err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_tests_made_as_planned_end_within_the_predicted_errors(labpipe: Command, tmp_path: Path) -> None:
    """The rehearsal on the virtual rig: the last fit knows what all tests told.

    Beside noise, its films have finite cells.
    """
    folder = tmp_path / "planned"
    small = {"bands": ["60-100 Hz"], "duration": "200 s", "force": "2 N", "clearance": None}
    assert labpipe("plan", _write(tmp_path, **small, criterion="D"), "-o", folder).code == 0
    plan = read_plan(folder / "plan.json")
    assert isinstance(plan, RunPlan)
    for run in plan.runs:
        ended = labpipe(
            "simulate", folder / f"virtual-{run.name}.yaml", "-o", folder / "recordings" / run.name
        )
        assert ended.code == 0, ended.err
    for stage in ("frf", "identify"):
        ended = labpipe(stage, "-c", folder / "pipeline.yaml", "-o", tmp_path / "out")
        assert ended.code == 0, ended.err
    fits = json.loads((tmp_path / "out/identification.json").read_text("utf-8"))["fits"]
    found = {p["name"]: p for p in fits[-1]["parameters"]}
    for number in plan.numbers:
        assert number.error is not None
        stated = found[number.name]["std_error"]
        assert abs(found[number.name]["value"] - number.expected) < 4 * stated
        assert (
            0.8 * number.error
            < stated
            < np.hypot(1.3 * number.error, 0.1e-6 if number.unit == "m" else np.deg2rad(0.05))
        )
