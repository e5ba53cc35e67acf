"""The README's commands, run as printed (the installing part is what .ci/run does), and its notebook code."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"
TEXT = README.read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_first_command_s_main_job_leaves_a_report(tmp_path: Path, labpipe, monkeypatch) -> None:
    (first, second) = blocks("sh")
    job = first.strip().split(" && ")[-1]
    assert job == ".venv/bin/labpipe run pipelines/pedestal.yaml -o out/pedestal"
    assert second.strip().split(" && ")[-1] == ".venv-test/bin/python -m pytest"
    for folder in ("pipelines", "configs", "sample_data"):
        shutil.copytree(README.parent / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    assert labpipe(*shlex.split(job)[1:]).code == 0
    assert (tmp_path / "out/pedestal/report.html").stat().st_size > 20_000


def test_the_tutorial_runs_as_printed(tmp_path: Path, labpipe, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    ran = 0
    for block in blocks("console"):
        lines = block.strip().splitlines()
        for number, line in enumerate(lines):
            if not line.startswith("$ "):
                continue
            program, *arguments = shlex.split(line[2:])
            assert program == "labpipe"
            ended = labpipe(*arguments)
            shown = [text for text in lines[number + 1 :] if text.startswith("error")]
            assert ended.code == (2 if shown else 0), ended
            assert ended.err.strip().splitlines() == shown or not shown
            ran += 1
    assert ran == 9
    assert (tmp_path / "my-rig/out/report.pdf").exists()


def test_the_tutorial_s_rig_file_is_the_scaffold_s(tmp_path: Path, labpipe) -> None:
    from labpipe.project.rig_file import load_rig

    labpipe("init", tmp_path / "p")
    (tmp_path / "shown.yaml").write_text(blocks("yaml")[0])
    assert load_rig(tmp_path / "shown.yaml") == load_rig(tmp_path / "p/rig.yaml")


def test_the_notebook_code_runs(capsys) -> None:
    (code,) = blocks("python")
    names: dict[str, object] = {}
    exec(code, names)
    assert "k          134." in capsys.readouterr().out
    assert "<!DOCTYPE html>" in str(names["html"])


@pytest.mark.parametrize("name", sorted(p.name for p in (README.parent / "pipelines").glob("*.yaml")))
def test_every_pipeline_is_listed(name: str) -> None:
    assert f"`{name}`" in (README.parent / "docs/pages/pipelines.md").read_text(encoding="utf-8")


def test_the_front_page_is_short_and_every_link_leads_somewhere() -> None:
    assert len(TEXT.splitlines()) < 150
    links = re.findall(r"\]\(([^)#]+)", TEXT)
    assert len(links) > 15 and all((README.parent / link).exists() for link in links)
