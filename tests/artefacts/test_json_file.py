"""JSON as labpipe writes it: valid for everyone, the same bytes for the same entries, null for what is no
number.
"""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from labpipe.artefacts.json_file import json_bytes, json_value

TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
PLAIN = (
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | TEXTS
)
ENTRIES = st.recursive(
    PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3), max_leaves=8
)


def refuse(constant: str) -> Any:
    raise AssertionError(f"{constant} is no JSON")


def again(entries: dict[str, Any]) -> Any:
    """The entries as a strict reader has them from their bytes."""
    return json.loads(json_bytes(entries).decode("utf-8"), parse_constant=refuse)


@pytest.mark.long
@settings(max_examples=80)
@given(st.dictionaries(st.sampled_from(["a", "b", "c d", "schema"]), ENTRIES, max_size=4))
def test_entries_come_back_in_their_order(entries: dict[str, Any]) -> None:
    assert again(entries) == entries and list(again(entries)) == list(entries)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_null(number: float) -> None:
    entries = {"alone": number, "listed": [1.0, number], "deep": {"x": [{"y": (number, 2.0)}]}}
    assert again(entries) == {"alone": None, "listed": [1.0, None], "deep": {"x": [{"y": [None, 2.0]}]}}


@settings(max_examples=60)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_digit_of_a_number_is_kept(number: float) -> None:
    read = again({"x": number})["x"]
    assert read == number and math.copysign(1, read) == math.copysign(1, number)


def test_every_item_of_a_list_has_a_line_of_its_own() -> None:
    """A difference of two results is seen line by line."""
    entries = {"title": "T", "fits": [{"name": "a"}, {"name": "b"}], "empty": []}
    assert json_bytes(entries).decode().splitlines() == [
        "{",
        '"title": "T",',
        '"fits": [',
        ' {"name": "a"},',
        ' {"name": "b"}',
        "],",
        '"empty": []',
        "}",
    ]


def test_letters_of_other_languages_stay_readable() -> None:
    assert "Prüfstand µm ± 振動" in json_bytes({"title": "Prüfstand µm ± 振動"}).decode("utf-8")


def test_entries_that_versions_before_wrote_are_read_under_their_new_names() -> None:
    text = (
        '{"channels": [{"label": "doubt", "doubts": [{"effect": "gain", "doubt": {"source": "x", '
        '"std_error": 0.01}}]}]}'
    )
    uncertainty = {"effect": "gain", "uncertainty": {"source": "x", "std_error": 0.01}}
    assert json_value(text) == {"channels": [{"label": "doubt", "uncertainties": [uncertainty]}]}
    assert json_value('{"other": [1]}') == {"other": [1]}
