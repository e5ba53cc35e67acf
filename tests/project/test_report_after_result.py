"""The result is on disk before its report is drawn: what stops the drawing costs the report alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import labpipe as library
from labpipe.artefacts.identification_file import read_identification
from labpipe.document import render
from tests.project.laboratory import ALONE, laboratory

DRAWN = ALONE.replace("formats: []", "formats: [md]")


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    return laboratory(tmp_path, DRAWN).parent


class Stopped:
    """A table of renderers whose every drawing is stopped."""

    def __init__(self, error: type[BaseException]) -> None:
        self.error = error

    def load(self, name: str) -> object:
        raise self.error(name)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, MemoryError])
def test_what_stops_the_drawing_leaves_the_result(
    lab: Path, labpipe, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(render, "RENDERERS", Stopped(error))
        with pytest.raises(error):
            library.run(lab / "pipeline.yaml", lab / "out")
    result = lab / "out/identification.json"
    assert (
        read_identification(result).fits[0].converged
        and not list((lab / "out").glob("report.*"))
        and not list(lab.rglob(".labpipe-*"))
    )
    written = result.stat().st_mtime_ns
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    assert (lab / "out/report.md").exists() and result.stat().st_mtime_ns == written


@pytest.mark.long
def test_a_process_that_is_killed_while_drawing_leaves_the_result(lab: Path) -> None:
    script = (
        "import os, sys, labpipe.document.render as render\n"
        "render.RENDERERS = type('Killed', (), {'load': lambda self, name: os._exit(9)})()\n"
        "from labpipe.cli.main import run_command\n"
        "run_command(['run', 'pipeline.yaml', '-o', 'out'])\n"
    )
    assert (
        subprocess.run([sys.executable, "-c", script], cwd=lab, capture_output=True, check=False).returncode
        == 9
    )
    assert (
        read_identification(lab / "out/identification.json").fits[0].converged
        and not (lab / "out/report.md").exists()
    )


def test_no_report_of_an_earlier_result_stays_beside_a_new_one(
    lab: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    first = (lab / "out/report.md").read_text()
    (lab / "pipeline.yaml").write_text(DRAWN.replace("10-40 Hz", "12-38 Hz"))
    with monkeypatch.context() as patch:
        patch.setattr(render, "RENDERERS", Stopped(RuntimeError))
        with pytest.raises(RuntimeError):
            library.run(lab / "pipeline.yaml", lab / "out")
    assert not (lab / "out/report.md").exists()
    assert read_identification(lab / "out/identification.json").fits[0].band_hz == (12.0, 38.0)
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    assert "12–38 Hz" in (lab / "out/report.md").read_text() and "12–38 Hz" not in first
    # Nor one that is not drawn any more, unless somebody has written in it.
    undrawn = ("--set", "report.formats=[]", "-o", lab / "out")
    assert labpipe("run", lab / "pipeline.yaml", *undrawn, "--set", "title=same").code == 0
    assert not (lab / "out/report.md").exists()
    (lab / "out/report.md").write_text("noted by hand")
    assert labpipe("run", lab / "pipeline.yaml", *undrawn, "--set", "title=other").code == 0
    assert (lab / "out/report.md").read_text() == "noted by hand"


def test_a_damaged_report_of_the_same_result_stays_until_it_is_drawn_again(
    lab: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    damaged = (lab / "out/report.md").read_bytes()[:-1]
    (lab / "out/report.md").write_bytes(damaged)
    with monkeypatch.context() as patch:
        patch.setattr(render, "RENDERERS", Stopped(RuntimeError))
        with pytest.raises(RuntimeError):
            library.run(lab / "pipeline.yaml", lab / "out")
    assert (lab / "out/report.md").read_bytes() == damaged
