"""A report that was drawn from the very result is not drawn again.

One that was edited, damaged or drawn from another result is.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from labpipe.project import report as report_stage
from labpipe.project.report import COMMENTS, drawn_from, is_drawn, stamp
from tests.project.laboratory import laboratory

FORMATS = ("html", "md")


@pytest.fixture
def pipeline(tmp_path: Path) -> Path:
    return laboratory(tmp_path)


def test_a_report_that_is_asked_for_is_one_of_the_result_beside_it(
    pipeline: Path, tmp_path: Path, labpipe
) -> None:
    """It can be signed there, where `verify` holds it against the result, and archived with it."""
    out = tmp_path / "out"
    assert labpipe("run", pipeline, "-o", out, "-q").code == 0
    for name in ("pdf", "md"):
        assert labpipe("report", out, "-o", out / f"report.{name}", "-q").code == 0
        assert is_drawn(out / f"report.{name}", drawn_from(out / "identification.json"))
    assert labpipe("archive", out, "-c", pipeline, "-o", tmp_path / "evidence.zip").code == 0


@pytest.mark.long
def test_nothing_is_drawn_twice(
    pipeline: Path, tmp_path: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ("run", pipeline, "-o", tmp_path / "out", "-q", "--set", "report.formats=[html, md]")
    assert labpipe(*arguments).code == 0
    files = [tmp_path / "out" / f"report.{name}" for name in FORMATS]
    first = [file.read_bytes() for file in files]
    assert all(content.count(b"labpipe drew this from") == 1 for content in first)
    drawn = []
    renderer = report_stage.renderer_of
    monkeypatch.setattr(
        report_stage, "renderer_of", lambda table, name: drawn.append(name) or renderer(table, name)
    )
    assert labpipe(*arguments).code == 0 and drawn == []
    # One byte in a heading, and a missing end.
    files[0].write_bytes(first[0].replace(b"<h1", b"<h2", 1))
    files[1].write_bytes(first[1][:-5])
    assert labpipe(*arguments).code == 0 and drawn == list(FORMATS)
    assert [file.read_bytes() for file in files] == first
    # Another result.
    drawn.clear()
    assert labpipe(*arguments, "--set", "title=Other").code == 0 and drawn == list(FORMATS)
    assert b"Other" in files[1].read_bytes()


@pytest.mark.long
def test_an_html_report_that_is_up_to_date_loads_nothing_that_draws(
    pipeline: Path, tmp_path: Path, labpipe
) -> None:
    assert labpipe("run", pipeline, "-o", tmp_path / "out", "-q").code == 0
    code = (
        "import sys; from labpipe.cli.main import run_command; run_command(sys.argv[1:]); "
        "print('matplotlib' in sys.modules)"
    )
    again = [sys.executable, "-c", code, "run", str(pipeline), "-o", str(tmp_path / "out"), "-q"]
    assert subprocess.run(again, capture_output=True, text=True, check=True).stdout.strip() == "False"


@pytest.mark.parametrize("report_format", sorted(COMMENTS))
def test_a_stamp_holds_for_its_source_and_content_alone(tmp_path: Path, report_format: str) -> None:
    path = tmp_path / "report"
    source = "ab" * 32
    path.write_bytes(stamp(b"a report", source, report_format))
    assert (
        is_drawn(path, source)
        and not is_drawn(path, "cd" * 32)
        and not is_drawn(path, "")
        and not is_drawn(tmp_path / "none", source)
    )
    path.write_bytes(path.read_bytes().replace(b"report\n", b"Report\n", 1))
    assert not is_drawn(path, source)
    path.write_bytes(stamp(b"a report", source, "docx"))
    assert path.read_bytes() == b"a report" and not is_drawn(path, source)
