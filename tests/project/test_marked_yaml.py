"""YAML with positions."""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.errors import ConfigError, ConfigErrors
from labpipe.project.marked_yaml import load_marked, parse_marked, set_entry

TEXT = """title: Test
frf:
  period: 1 s
  exclude: [49-51 Hz, 99-101 Hz]
"""


def test_every_entry_knows_its_place() -> None:
    tree = parse_marked(TEXT, "p.yaml")
    assert tree.content["frf"].content["period"].place == "p.yaml:3:3"
    assert tree.content["frf"].content["exclude"].content[1].place == "p.yaml:4:23"
    assert tree.plain() == {"title": "Test", "frf": {"period": "1 s", "exclude": ["49-51 Hz", "99-101 Hz"]}}


def test_every_duplicate_key_is_named() -> None:
    with pytest.raises(ConfigErrors) as caught:
        parse_marked("a: 1\nb: 2\na: 3\nb: 4\n", "p.yaml")
    assert [str(fault) for fault in caught.value.faults] == [
        "p.yaml:3:1: a: the key appears twice; first at p.yaml:1:1",
        "p.yaml:4:1: b: the key appears twice; first at p.yaml:2:1",
    ]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("a: [1, 2\n", "p.yaml:2:1"),
        ("a: 1\n\tb: 2\n", "p.yaml:2:1"),
        ("a: b: c\n", "p.yaml:1:5"),
        ("", "p.yaml"),
        ("a: &x [*x]\n", "p.yaml:1:"),
    ],
)
def test_what_is_no_yaml_is_refused_with_its_place(text: str, place: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_marked(text, "p.yaml")
    assert caught.value.where.startswith(place)


def test_scalars_stay_what_was_written() -> None:
    tree = parse_marked("a: 1_000\nb: 45:30\nc: yes\nd: 1e3\ne: '5'\nf: 2024-01-01\ng: true\n", "p")
    assert tree.plain() == {
        "a": "1_000",
        "b": "45:30",
        "c": "yes",
        "d": 1000.0,
        "e": "5",
        "f": "2024-01-01",
        "g": True,
    }
    assert tree.content["d"].text == "1e3"


def test_set_overrides_nested_entries_and_lists() -> None:
    tree = parse_marked(TEXT, "p.yaml")
    set_entry(tree, "frf.period=2 s")
    set_entry(tree, "frf.exclude.0=10-20 Hz")
    set_entry(tree, "identify.direct.model=sdof")
    assert tree.plain()["frf"] == {"period": "2 s", "exclude": ["10-20 Hz", "99-101 Hz"]}
    assert (
        tree.content["identify"].content["direct"].content["model"].place
        == "--set identify.direct.model=sdof"
    )


@pytest.mark.parametrize(
    "assignment", ["frf.period", "=3", "title.sub=3", "frf.exclude.7=1-2 Hz", "frf.exclude.x=1"]
)
def test_what_cannot_be_set_is_refused(assignment: str) -> None:
    with pytest.raises(ConfigError):
        set_entry(parse_marked(TEXT, "p.yaml"), assignment)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_marked(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="is a directory"):
        load_marked(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"a: \xff\n")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_marked(tmp_path / "latin.yaml")


def test_a_result_in_place_of_settings_is_named_before_it_is_read(tmp_path: Path) -> None:
    # As artefacts begin; what follows would not even be YAML.
    path = tmp_path / "identification.json"
    path.write_text('{\n"schema": "labpipe/identification/2",\n"fits": [[[')
    with pytest.raises(ConfigError, match=r"identification/2\); a YAML file of settings is needed"):
        load_marked(path)
