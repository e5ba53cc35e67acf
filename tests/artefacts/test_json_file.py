"""JSON as labpipe writes it: valid for everyone, the same bytes for the same entries, null for what is no
number.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labpipe.artefacts.json_file import json_value, write_json

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


def read(path: Path) -> Any:
    """The entries as a strict reader has them."""
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.mark.long
@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(["a", "b", "c d", "schema"]), ENTRIES, max_size=4))
def test_entries_come_back_in_their_order(tmp_path: Path, entries: dict[str, Any]) -> None:
    write_json(tmp_path / "a.json", entries)
    again = read(tmp_path / "a.json")
    assert again == entries and list(again) == list(entries)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(["a", "b"]), ENTRIES, max_size=2))
def test_the_same_entries_give_the_same_bytes(tmp_path: Path, entries: dict[str, Any]) -> None:
    for name in ("a", "b"):
        write_json(tmp_path / name, entries)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_null(tmp_path: Path, number: float) -> None:
    entries = {"alone": number, "listed": [1.0, number], "deep": {"x": [{"y": (number, 2.0)}]}}
    write_json(tmp_path / "a.json", entries)
    assert read(tmp_path / "a.json") == {
        "alone": None,
        "listed": [1.0, None],
        "deep": {"x": [{"y": [None, 2.0]}]},
    }


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_digit_of_a_number_is_kept(tmp_path: Path, number: float) -> None:
    write_json(tmp_path / "a.json", {"x": number})
    again = read(tmp_path / "a.json")["x"]
    assert again == number and math.copysign(1, again) == math.copysign(1, number)


def test_every_item_of_a_list_has_a_line_of_its_own(tmp_path: Path) -> None:
    """A difference of two results is seen line by line."""
    write_json(tmp_path / "a.json", {"title": "T", "fits": [{"name": "a"}, {"name": "b"}], "empty": []})
    assert (tmp_path / "a.json").read_text("utf-8").splitlines() == [
        "{",
        '"title": "T",',
        '"fits": [',
        ' {"name": "a"},',
        ' {"name": "b"}',
        "],",
        '"empty": []',
        "}",
    ]


def test_letters_of_other_languages_stay_readable(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"title": "Prüfstand µm ± 振動"})
    assert "Prüfstand µm ± 振動" in (tmp_path / "a.json").read_text("utf-8")


def test_entries_that_versions_before_wrote_are_read_under_their_new_names() -> None:
    text = (
        '{"channels": [{"label": "doubt", "doubts": [{"effect": "gain", "doubt": {"source": "x", '
        '"std_error": 0.01}}]}]}'
    )
    uncertainty = {"effect": "gain", "uncertainty": {"source": "x", "std_error": 0.01}}
    assert json_value(text) == {"channels": [{"label": "doubt", "uncertainties": [uncertainty]}]}
    assert json_value('{"other": [1]}') == {"other": [1]}
