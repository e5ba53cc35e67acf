"""The marked tree as a whole: any plain document comes back, places are those of the text, overrides hit what
they name.
"""

from __future__ import annotations

import contextlib
from typing import Any

import pytest
import yaml
from hypothesis import given, strategies as st

from labpipe.errors import ConfigError, ConfigErrors
from labpipe.project.marked_yaml import Marked, parse_marked, set_entry

KEYS = st.text("abcdefgh", min_size=1, max_size=4)
SCALARS = (
    st.integers(-(10**6), 10**6)
    | st.floats(-1e6, 1e6).map(lambda number: round(number, 3))
    | st.booleans()
    | st.text("xyz ", max_size=4)
)
DOCUMENTS = st.dictionaries(
    KEYS,
    st.recursive(
        SCALARS,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
        max_leaves=6,
    ),
    min_size=1,
    max_size=4,
)


@given(DOCUMENTS, st.booleans())
def test_a_document_comes_back_as_it_was(document: dict[str, Any], flow: bool) -> None:
    assert (
        parse_marked(yaml.safe_dump(document, default_flow_style=flow, sort_keys=False), "p.yaml").plain()
        == document
    )


def places(node: Marked) -> list[tuple[str, str]]:
    """(key, place) of all entries of mappings."""
    if isinstance(node.content, dict):
        return [pair for key, entry in node.content.items() for pair in [(key, entry.place), *places(entry)]]
    return (
        [pair for entry in node.content for pair in places(entry)] if isinstance(node.content, list) else []
    )


@given(DOCUMENTS, st.booleans())
def test_every_key_stands_where_it_is_said_to_stand(document: dict[str, Any], flow: bool) -> None:
    text = yaml.safe_dump(document, default_flow_style=flow, sort_keys=False)
    lines = text.splitlines()
    for key, place in places(parse_marked(text, "p.yaml")):
        name, line, column = place.rsplit(":", 2)
        shown = lines[int(line) - 1][int(column) - 1 :]
        # Words that YAML keeps for itself stand in quotes.
        assert name == "p.yaml" and shown.lstrip("'\"?").lstrip().startswith(key)


@given(DOCUMENTS, st.data())
def test_an_override_changes_the_entry_that_it_names_and_no_other(
    document: dict[str, Any], draw: st.DataObject
) -> None:
    key = draw.draw(st.sampled_from(sorted(document)))
    tree = parse_marked(yaml.safe_dump(document, sort_keys=False), "p.yaml")
    set_entry(tree, f"{key}=3 N")
    assert tree.plain() == {**document, key: "3 N"}
    assert tree.content[key].place == f"--set {key}=3 N"


@pytest.mark.parametrize(
    ("assignment", "value"),
    [
        ("a=1", 1),
        ("a=1.5", 1.5),
        ("a=true", True),
        ("a=", ""),
        ("a=null", None),
        ("a=[1, 2]", [1, 2]),
        ("a={b: 1}", {"b": 1}),
        ("a='1'", "1"),
        ("a=>= 0.95", ">= 0.95"),
        ("a=*.csv", "*.csv"),
        ("a=b=c", "b=c"),
        ("a=65-80 Hz", "65-80 Hz"),
    ],
)
def test_the_value_of_an_override_is_yaml_or_plain_text(assignment: str, value: object) -> None:
    tree = parse_marked("a: old\n", "p.yaml")
    set_entry(tree, assignment)
    assert tree.plain() == {"a": value}


@pytest.mark.parametrize(
    ("assignment", "document"),
    [
        ("b.c=1", {"a": [{"x": 1}, 2], "b": {"c": 1}}),
        ("b.c.d=1", {"a": [{"x": 1}, 2], "b": {"c": {"d": 1}}}),
        ("a.0.x=5", {"a": [{"x": 5}, 2]}),
        ("a.0.y=5", {"a": [{"x": 1, "y": 5}, 2]}),
        ("a.1=5", {"a": [{"x": 1}, 5]}),
        (
            "accept.direct.k_xx.significant=true",
            {"a": [{"x": 1}, 2], "accept": {"direct.k_xx.significant": True}},
        ),
    ],
)
def test_overrides_reach_into_mappings_and_lists(assignment: str, document: dict[str, Any]) -> None:
    tree = parse_marked("a: [{x: 1}, 2]\n", "p.yaml")
    set_entry(tree, assignment)
    assert tree.plain() == document


@pytest.mark.parametrize("assignment", ["", "a", "=1", "a.2=1", "a.-1=1", "a.x=1", "a.1.x=1", "c=[1"])
def test_overrides_that_hit_nothing_are_refused_under_their_own_name(assignment: str) -> None:
    tree = parse_marked("a: [{x: 1}, 2]\n", "p.yaml")
    with pytest.raises(ConfigError) as caught:
        set_entry(tree, assignment)
    assert caught.value.where.startswith("--set ")


@given(st.text(max_size=30))
def test_no_text_ends_in_anything_but_a_tree_or_a_refusal(text: str) -> None:
    tree = Marked(None, "")
    with contextlib.suppress(ConfigError):
        tree = parse_marked(text, "p.yaml")
    assert tree.where.startswith("p.yaml:") or tree.content is None


@given(st.lists(KEYS, min_size=2, max_size=5))
def test_every_repeated_key_is_a_fault_of_its_own(keys: list[str]) -> None:
    text = "".join(f"'{key}': 1\n" for key in keys)
    repeated = len(keys) - len(set(keys))
    if not repeated:
        assert list(parse_marked(text, "p.yaml").content) == keys
        return
    with pytest.raises(ConfigErrors) as caught:
        parse_marked(text, "p.yaml")
    assert len(caught.value.faults) == repeated
