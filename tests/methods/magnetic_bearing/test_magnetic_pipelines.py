"""The shipped pipelines of magnetic bearings meet their rules, tell an unstable setting, and say what cannot
be compared.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

BEARINGS = "../configs/bearings"
SLIDING = {"kind": "prediction", "fit": "sliding"}
GEOMETRY = {"bearing": f"{BEARINGS}/hmb-geometry.yaml"}


@pytest.fixture
def labpipe(labpipe_without_report):
    """Reports are drawn only where a test looks at one."""
    return labpipe_without_report


def project(
    root: Path, tmp_path: Path, name: str, compare: dict[str, object], rules: dict[str, object] | None = None
) -> Path:
    """The shipped pipeline with other comparisons, and few bands."""
    plan = yaml.safe_load((root / f"pipelines/{name}.yaml").read_text(encoding="utf-8"))
    text = json.dumps({**plan, "compare": compare, "expect": rules or {}}).replace("../", f"{root}/")
    entry = json.loads(text)
    if "identify" in entry:
        entry["identify"]["sliding"] |= {"band": "40-100 Hz", "sliding": {"width": "15 Hz", "step": "15 Hz"}}
    (tmp_path / "pipeline.yaml").write_text(yaml.safe_dump(entry, sort_keys=False), encoding="utf-8")
    return tmp_path / "pipeline.yaml"


def test_an_unstable_setting_is_said_beside_the_verdict(root: Path, tmp_path: Path, labpipe) -> None:
    """k_p = 0.9 with the bias field of the rig: k_0 = 46.4 (0.9 - 0.25) - 33.1 < 0, so the rotor alone leaves
    the centre.
    """
    text = (
        (root / "configs/bearings/hmb-gains.yaml")
        .read_text(encoding="utf-8")
        .replace("proportional: 1", "proportional: 0.9")
    )
    (tmp_path / "weak.yaml").write_text(text, encoding="utf-8")
    asked = {
        "kind": "prediction",
        "fit": "sliding",
        "parameter": "k_yy",
        "theory": {"bearing": str(tmp_path / "weak.yaml")},
    }
    path = project(
        root,
        tmp_path,
        "magnetic-loop",
        {"weak": asked},
        {"weak.verdict": "unstable", "weak.unstable_poles": ">= 1"},
    )
    assert labpipe("run", path, "-o", tmp_path / "out", "--set", "report.formats=[html]").code == 0
    report = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert (
        "unstable-loop" in report
        and "The loop as stated is unstable on the mass of the bearing file" in report
    )
    found = json.loads((tmp_path / "out/identification.json").read_text(encoding="utf-8"))["comparisons"][0]
    assert found["findings"][0]["code"] == "unstable-loop"


@pytest.mark.parametrize(
    ("name", "compare", "message"),
    [
        (
            "magnetic-loop",
            {**SLIDING, "theory": {"bearing": f"{BEARINGS}/nsk-6208.yaml"}},
            "of the kind ball-bearing",
        ),
        ("magnetic-loop", SLIDING, "'theory' is missing"),
        (
            "magnetic-loop",
            {**SLIDING, "kind": "trend", "over": "speed", "estimate": ["gap"]},
            "'estimate' is not for the kind trend",
        ),
        (
            "magnetic-loop",
            {**SLIDING, "estimate": ["gap"], "theory": {"bearing": f"{BEARINGS}/hmb-magnetic.yaml"}},
            "no 'gap'",
        ),
        (
            "magnetic-loop",
            {**SLIDING, "estimate": ["gap", "gap"], "theory": GEOMETRY},
            "names an unknown twice",
        ),
        ("magnetic-gains", {**SLIDING, "over": "gain", "theory": GEOMETRY}, "'theory.entry' is missing"),
        (
            "magnetic-gains",
            {**SLIDING, "over": "gain", "theory": {**GEOMETRY, "entry": "loop.delay"}, "estimate": ["delay"]},
            "'loop.delay' is set by 'gain'",
        ),
        (
            "magnetic-loop",
            {"kind": "bands", "fit": "sliding", "group": "speed", "groups": ["0 rpm"]},
            "two groups are compared",
        ),
        ("magnetic-sensitivity", {"kind": "sensitivity", "before": "volts"}, "no response 'volts'"),
    ],
)
def test_what_cannot_be_compared_is_said(
    name: str, compare: dict[str, object], message: str, root: Path, tmp_path: Path, labpipe
) -> None:
    ended = labpipe("run", project(root, tmp_path, name, {"asked": compare}), "-o", tmp_path / "out")
    assert ended.code == 2 and message in ended.err, ended
