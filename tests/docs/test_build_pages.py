"""What docs/build.py makes of the marks in a page: figures, sections of shipped pipelines, and the pages of a
folder in the navigation.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
import yaml

pytest.importorskip("math_core")
sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

import build

DOCS = Path(__file__).parents[2] / "docs"
GALLERY = (DOCS / "pages/gallery.md").read_text(encoding="utf-8")
KINDS = re.split(r"^### ", GALLERY, flags=re.MULTILINE)[1:]


def section(mark: str) -> str:
    found = build.PIPELINE.search(mark)
    assert found is not None
    return build.pipeline_block(found)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.partition("\n")[0])
def test_a_figure_of_the_gallery_stands_with_yaml_of_the_pipeline_it_comes_from(kind: str) -> None:
    (figure,) = build.FIGURE.findall(kind)
    (shown,) = build.PIPELINE.findall(kind)
    assert figure[0] == shown[0]
    whole = yaml.safe_load((DOCS.parent / f"pipelines/{shown[0]}.yaml").read_text(encoding="utf-8"))
    part = yaml.safe_load(
        re.search(r"```yaml\n(.*?)```", section(f"{{{{ pipeline {shown[0]} | {shown[1]} }}}}"), re.DOTALL)[1]
    )
    for key, value in part.items():
        assert value == (
            whole[key] if key in shown[1].split(", ") else {name: whole[key][name] for name in value}
        )


def test_the_gallery_has_many_kinds_of_figures() -> None:
    assert len({build.FIGURE.search(kind).groups() for kind in KINDS}) == len(KINDS) >= 30


def test_entries_of_one_section_share_its_head() -> None:
    assert section("{{ pipeline ring-down | identify.ring, identify.joint }}") == (
        "`pipelines/ring-down.yaml`:\n\n```yaml\nidentify:\n  ring: {model: decay, modes: 1, test: "
        "[struck]}\n"
        "  joint: {model: decay, modes: 1, test: [joint]}\n```"
    )
    with pytest.raises(SystemExit, match=r"pipelines/ring-down.yaml has no 'identify.other'"):
        section("{{ pipeline ring-down | identify.other }}")


def test_a_folder_in_the_navigation_is_its_pages_in_the_order_of_its_index(tmp_path: Path) -> None:
    (tmp_path / "theory").mkdir()
    for name, text in {
        "a": "",
        "b": "",
        "c": "",
        "index": "[c](c.md), [a](a.md), [out](../x.md), [c](c.md)",
    }.items():
        (tmp_path / f"theory/{name}.md").write_text(text, encoding="utf-8")
    assert build.in_full({"Theory": "theory/"}, tmp_path) == [
        {"Theory": [f"theory/{name}.md" for name in ("index", "c", "a", "b")]}
    ]
    assert build.in_full({"Trust": [{"One": "one.md"}, {"None": "none/"}]}, tmp_path) == [
        {"Trust": [{"One": "one.md"}]}
    ]


def test_a_mark_that_is_none_ends_the_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pages").mkdir()
    (tmp_path / "pages/a.md").write_text("# A\n\n{{ figur pedestal | measured }}\n", encoding="utf-8")
    monkeypatch.setattr(build, "DOCS", tmp_path)
    monkeypatch.setattr(build.api, "modules", dict)
    with pytest.raises(SystemExit, match=r"docs/pages/a.md: '\{\{ figur pedestal"):
        build.write_pages(tmp_path / "out", lambda name, words, up: "")
