"""Tables of choices: what other packages add, and names that group and table share."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from labpipe import registry
from labpipe.errors import ConfigError
from labpipe.registry import Registry, group_of

TABLE = {"own": ("math:pi", "what it is")}


@pytest.fixture
def others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of installed packages, looked at by the tables of this test alone."""
    monkeypatch.syspath_prepend(tmp_path)
    shipped = {**registry._shipped_groups(), "labpipe.some_kind": TABLE}
    monkeypatch.setattr(registry, "_shipped_groups", lambda: shipped)
    registry._groups_of_others.cache_clear()
    yield tmp_path
    registry._groups_of_others.cache_clear()


def installed(folder: Path, package: str, group: str, entries: Sequence[str]) -> None:
    """The metadata of a package in *folder* with these entry points."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *entries, ""]))


@pytest.fixture
def table(others: Path) -> Registry:
    """A table with one entry of its own and two added, of which one tries to take the place of its own."""
    installed(others, "labpipe_more", "labpipe.some_kind", ["more = math:tau", "own = math:e"])
    return Registry("some kind")


def test_what_packages_add_stands_behind_and_never_in_place_of_what_is_there(table: Registry) -> None:
    import math

    assert list(table) == ["own", "more"]
    assert table["own"] == math.pi and table["more"] == math.tau
    assert "more" in table and "none" not in table
    assert [table.words(name) for name in table] == ["what it is", ""]


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


def test_shipped_entries_keep_the_order_of_their_file_whatever_metadata_lie_beside(others: Path) -> None:
    """Results write details in this order: with another one the same fit has other bytes on another
    worker.
    """
    shipped = registry._shipped_groups()["labpipe.fit_detail"]
    entries = [f"{name} = elsewhere:x" for name in ("theirs", *reversed(shipped))]
    installed(others, "theirs", "labpipe.fit_detail", entries)
    table = Registry("fit detail")
    assert table.names() == (*shipped, "theirs")
    module, attribute = next(iter(shipped.values()))[0].split(":")
    assert table.load(next(iter(shipped))) is getattr(sys.modules[module], attribute)


def test_a_package_in_an_archive_on_the_path_adds_as_one_in_a_folder_does(
    others: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (others / "content").mkdir()
    installed(others / "content", "packed", "labpipe.some_kind", ["more = math:tau"])
    archive = shutil.make_archive(str(others / "packed"), "zip", others / "content")
    monkeypatch.syspath_prepend(archive)
    assert list(Registry("some kind")) == ["own", "more"]
