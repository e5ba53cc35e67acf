"""Whole or nothing: what is under its name is complete, whatever happens on the way."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labpipe.artefacts.writing import existing_home, hold_lock, output_file, output_folder
from labpipe.errors import DataError


class Torn(Exception):
    """What goes wrong on the way."""


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


NAMES = st.lists(
    st.sampled_from(["a.txt", "b.txt", "sub/a.txt", "sub/deep/c.txt", "d"]),
    min_size=1,
    max_size=5,
    unique=True,
)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(old=NAMES, new=NAMES, place=st.integers(0, 5))
def test_either_all_new_files_or_the_old_ones(
    tmp_path_factory: pytest.TempPathFactory, old: list[str], new: list[str], place: int
) -> None:
    """Torn before any of the writes, the folder is as it was.

    Not torn, every new file has taken its place and the others stay.
    """
    target = tmp_path_factory.mktemp("whole")
    for name in old:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_text(f"old {name}")
    before = contents(target)
    try:
        with output_folder(target) as folder:
            for number, name in enumerate(new):
                if number == place:
                    raise Torn
                folder.write_path(name).write_text(f"new {name}")
    except Torn:
        assert contents(target) == before
    else:
        assert contents(target) == {**before, **{name: f"new {name}".encode() for name in new}}
    assert not [path for path in target.iterdir() if path.name.startswith(".labpipe-")]


def test_nothing_stands_under_its_name_before_the_end(tmp_path: Path) -> None:
    with output_folder(tmp_path) as folder:
        folder.write_path("a.txt").write_text("half")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "half"


def test_what_was_just_written_is_read_before_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    with output_folder(tmp_path) as folder:
        assert folder.read_path("a.txt").read_text() == "old"
        folder.write_path("a.txt").write_text("new")
        assert folder.read_path("a.txt").read_text() == "new"
        assert folder.read_path("b.txt") == tmp_path / "b.txt" and not folder.read_path("b.txt").exists()


def test_a_folder_that_is_not_there_is_made_only_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "one" / "two"
    with output_folder(target) as folder:
        folder.write_path("a.txt").write_text("x")
        assert not (tmp_path / "one").exists()
    assert (target / "a.txt").read_text() == "x"


def test_a_folder_in_which_nothing_was_made_is_not_made(tmp_path: Path) -> None:
    with output_folder(tmp_path / "out"):
        pass
    assert not (tmp_path / "out").exists()


def test_two_may_write_into_one_folder_at_the_same_time(tmp_path: Path) -> None:
    """Each has a hidden folder of its own; both arrive."""
    with output_folder(tmp_path) as first, output_folder(tmp_path) as second:
        assert first.staging != second.staging
        first.write_path("a.txt").write_text("1")
        second.write_path("b.txt").write_text("2")
    assert contents(tmp_path) == {"a.txt": b"1", "b.txt": b"2"}


def test_unfinished_work_may_stand_elsewhere(tmp_path: Path) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    with output_folder(tmp_path / "out", scratch) as folder:
        assert folder.staging.parent == scratch
        folder.write_path("a.txt").write_text("x")
    assert list(scratch.iterdir()) == [] and (tmp_path / "out/a.txt").read_text() == "x"


@pytest.mark.parametrize("kind", [Torn, KeyboardInterrupt, SystemExit])
def test_nothing_is_left_behind_whatever_ends_the_work(tmp_path: Path, kind: type[BaseException]) -> None:
    with pytest.raises(kind), output_folder(tmp_path / "out") as folder:
        folder.write_path("sub/a.txt").write_text("half")
        raise kind
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_place_of_the_folder_is_refused_and_kept(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("precious")
    with (
        pytest.raises(DataError, match=r"out: is a file, a folder is needed"),
        output_folder(tmp_path / "out"),
    ):
        pass
    assert (tmp_path / "out").read_text() == "precious"


@pytest.mark.parametrize("depth", [0, 1, 3])
def test_the_home_is_the_nearest_folder_that_is_there(tmp_path: Path, depth: int) -> None:
    assert existing_home(tmp_path.joinpath(*"abc"[:depth])) == tmp_path


def test_a_single_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    path.write_text("old")
    with pytest.raises(Torn), output_file(path) as half:
        half.write_text("half")
        raise Torn
    assert path.read_text() == "old" and [one.name for one in tmp_path.iterdir()] == ["report.md"]
    with output_file(path) as whole:
        whole.write_text("new")
    assert path.read_text() == "new" and [one.name for one in tmp_path.iterdir()] == ["report.md"]


def test_a_single_file_in_a_new_folder(tmp_path: Path) -> None:
    with output_file(tmp_path / "new/deep/a.txt") as path:
        path.write_text("x")
    assert (tmp_path / "new/deep/a.txt").read_text() == "x"


def test_a_file_keeps_its_ending_while_it_is_made(tmp_path: Path) -> None:
    """Writers choose their format by the ending."""
    with output_file(tmp_path / "table.csv") as path:
        assert path.name == "table.csv"
        path.write_text("")


def test_a_folder_in_the_place_of_the_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is a folder, a file name is needed"), output_file(tmp_path):
        pass


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_a_device_is_written_as_it_is(tmp_path: Path) -> None:
    """A pipe cannot be renamed into place."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with output_file(pipe) as path:
        assert path == pipe


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no /dev/null on this system")
def test_the_null_device_stays_a_device() -> None:
    with output_file(Path("/dev/null")) as path:
        path.write_text("gone")
    assert Path("/dev/null").is_char_device()


def test_one_at_a_time_holds_a_lock(tmp_path: Path) -> None:
    """A second one is refused as long as the first works, within one process as between two."""
    with hold_lock(tmp_path / "lock"):
        with (
            pytest.raises(DataError, match="another process works on this folder"),
            hold_lock(tmp_path / "lock"),
        ):
            pass
        with hold_lock(tmp_path / "another"):
            pass
    with hold_lock(tmp_path / "lock"):
        pass
