"""How faults read: where, what, cure, on one line each.

And tables of choices that name the nearest known choice.
"""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from labpipe import registry
from labpipe.errors import ConfigError, ConfigErrors, DataError, FitError, LabpipeError
from labpipe.registry import Registry, nearest

KINDS = [ConfigError, DataError, FitError]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("where", "hint", "text"),
    [
        ("", "", "what is wrong"),
        ("rig.yaml:3:1", "", "rig.yaml:3:1: what is wrong"),
        ("", "what would be right", "what is wrong; what would be right"),
        ("rig.yaml:3:1", "what would be right", "rig.yaml:3:1: what is wrong; what would be right"),
    ],
)
def test_a_fault_reads_where_what_cure(kind: type[LabpipeError], where: str, hint: str, text: str) -> None:
    error = kind("what is wrong", where=where, hint=hint)
    assert str(error) == text and (error.what, error.where, error.hint) == ("what is wrong", where, hint)


@pytest.mark.parametrize("kind", KINDS)
def test_every_fault_of_the_input_is_caught_as_one_kind(kind: type[LabpipeError]) -> None:
    with pytest.raises(LabpipeError):
        raise kind("x")
    assert not issubclass(kind, (ValueError, KeyError, OSError))


def test_the_place_may_be_added_by_who_knows_it() -> None:
    error = DataError("too short")
    error.where = error.where or "run.csv"
    assert str(error) == "run.csv: too short"


@given(st.lists(st.text("abc", min_size=1, max_size=3), min_size=1, max_size=4))
def test_many_faults_are_a_line_each(texts: list[str]) -> None:
    faults = [ConfigError(text, where=f"p.yaml:{number}:1") for number, text in enumerate(texts, 1)]
    whole = ConfigErrors(faults)
    assert str(whole).splitlines() == [f"p.yaml:{number}:1: {text}" for number, text in enumerate(texts, 1)]
    assert whole.faults == tuple(faults) and isinstance(whole, ConfigError)


# nearest names


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("periodc", "did you mean 'periodic'?"),
        ("PERIODIC", "did you mean 'periodic'?"),
        ("impakt", "did you mean 'impact'?"),
        ("sweep", "known: periodic, random, impact"),
        ("", "known: periodic, random, impact"),
    ],
)
def test_the_nearest_known_name_or_all_of_them(name: str, hint: str) -> None:
    assert nearest(name, ("periodic", "random", "impact")) == hint


def test_where_nothing_is_known_that_is_said() -> None:
    assert nearest("x", ()) == "known: none"


@given(st.text("abcdefgh", min_size=4, max_size=10), st.integers(0, 9))
def test_one_letter_too_few_is_forgiven(name: str, place: int) -> None:
    place = min(place, len(name) - 1)
    assert nearest(name[:place] + name[place + 1 :], (name, "0000000")) == f"did you mean '{name}'?"


# tables


TABLE = Registry("shape of test")
SHAPES = {"circle": "math:pi", "root": "math:sqrt", "broken": "math:nothing", "missing": "no_such_module:x"}


@pytest.fixture(autouse=True)
def shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = {"labpipe.shape_of_test": {name: (target, "") for name, target in SHAPES.items()}}
    monkeypatch.setattr(registry, "_shipped_groups", lambda: shipped)


def test_a_table_imports_a_choice_when_it_is_used() -> None:
    """Names are known although one of the targets cannot be imported."""
    assert TABLE.names() == ("circle", "root", "broken", "missing") and list(TABLE) == list(TABLE.names())
    assert TABLE["root"](9.0) == 3.0 and TABLE.load("circle") == pytest.approx(3.14159, abs=1e-5)
    assert "missing" in TABLE and "square" not in TABLE


def test_an_unknown_choice_names_the_nearest() -> None:
    with pytest.raises(ConfigError) as caught:
        TABLE["cirle"]
    assert str(caught.value) == "unknown shape of test 'cirle'; did you mean 'circle'?"


def test_a_target_that_is_not_there_is_a_fault_of_ours() -> None:
    with pytest.raises(AttributeError):
        TABLE["broken"]
    with pytest.raises(ModuleNotFoundError):
        TABLE["missing"]
