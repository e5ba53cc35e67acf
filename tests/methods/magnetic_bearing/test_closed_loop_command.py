"""The shipped levitated rotor as a user runs it: by its reference, and taken for an open loop."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest


def result(folder: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((folder / "identification.json").read_text(encoding="utf-8"))
    return read


def test_the_reference_opens_the_loop(root: Path, tmp_path: Path, labpipe) -> None:
    """Its rules hold the truth of the virtual rig; H1 is shown beside the FRF, as biased."""
    assert labpipe("run", root / "pipelines/levitated.yaml", "-o", tmp_path, "-q").code == 0
    assert "open_loop" in result(tmp_path)["responses"][0]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "a biased estimate, shown as what it is" in page
    assert "H1, biased" in page


@pytest.mark.long
def test_without_it_nothing_is_accepted(root: Path, tmp_path: Path, labpipe) -> None:
    """The pipeline expects the warning, so it passes.

    Where no rule expects it, it fails, with other rules and without any.
    """
    pipeline = root / "pipelines/levitated-open.yaml"
    assert labpipe("run", pipeline, "-o", tmp_path, "-q").code == 0
    assert "feedback" in [warning["code"] for warning in result(tmp_path)["fits"][0]["warnings"]]
    for rules in ("{}", "{open.k_xx: <= -220 kN/m}"):
        assert labpipe("run", pipeline, "-o", tmp_path, "-q", "--set", f"expect={rules}").code == 1
        assert result(tmp_path)["accept"][-1] == {
            "rule": "open.warnings: not feedback",
            "value": "feedback",
            "passed": False,
        }
    assert "NOT ACCEPTED" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "said"),
    [("[f_x, r_y]", "'f_x' is a force of the FRF"), ("[r_x, r_z]", "'r_z' is not a channel")],
)
def test_a_reference_that_is_none_is_refused(
    name: str, said: str, root: Path, tmp_path: Path, labpipe
) -> None:
    ended = labpipe(
        "run", root / "pipelines/levitated.yaml", "-o", tmp_path, "--set", f"frf.reference={name}"
    )
    assert ended.code == 2
    assert said in ended.err
