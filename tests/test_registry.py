"""Tables of choices: what other packages add, and names that group and table share."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from labpipe import registry
from labpipe.errors import ConfigError
from labpipe.registry import Registry, group_of

TABLE = {"own": "math:pi"}


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """A table with one entry of its own and two added, of which one tries to take the place of its own."""
    added = (
        EntryPoint("more", "math:tau", "labpipe.some_kind"),
        EntryPoint("own", "math:e", "labpipe.some_kind"),
    )
    monkeypatch.setattr(registry, "entry_points", lambda: EntryPoints(added))
    registry._of_others.cache_clear()
    yield Registry("some kind", TABLE)
    registry._of_others.cache_clear()


def test_what_packages_add_stands_behind_and_never_in_place_of_what_is_there(table: Registry) -> None:
    import math

    assert list(table) == ["own", "more"]
    assert table["own"] == math.pi and table["more"] == math.tau
    assert "more" in table and "none" not in table


def test_an_unknown_name_is_answered_with_the_nearest(table: Registry) -> None:
    with pytest.raises(ConfigError, match=r"unknown some kind 'mor'") as caught:
        table["mor"]
    assert caught.value.hint == "did you mean 'more'?"


@pytest.mark.parametrize(
    ("kind", "group"),
    [("reader", "labpipe.reader"), ("frf-reader", "labpipe.frf_reader"), ("a b", "labpipe.a_b")],
)
def test_groups_hold_only_what_packagers_allow(kind: str, group: str) -> None:
    assert group_of(kind) == group


def test_shipped_entries_keep_the_order_of_their_file_whatever_metadata_lie_beside(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Results write details in this order: with another one the same fit has other bytes on another
    worker.
    """
    shipped = list(registry._shipped_entries()["labpipe.fit_detail"])
    others = [
        EntryPoint(name, "elsewhere:x", "labpipe.fit_detail") for name in ("theirs", *reversed(shipped))
    ]
    monkeypatch.setattr(registry, "entry_points", lambda: EntryPoints(others))
    registry._of_others.cache_clear()
    try:
        table = Registry("fit detail")
        assert table.names() == (*shipped, "theirs")
        assert table.load(shipped[0]) is registry._shipped_entries()["labpipe.fit_detail"][shipped[0]].load()
    finally:
        registry._of_others.cache_clear()
