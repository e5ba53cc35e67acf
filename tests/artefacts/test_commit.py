"""The commit of a checkout, read from its files as git lays them out (gitrepository-layout, documented by
git).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.artefacts.header import checkout_commit, commit

FIRST, SECOND = "4db4e400c3bd5e8f9a7c6d5b4a39281706f5e4d3", "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def git(tmp_path: Path) -> Path:
    (tmp_path / ".git/refs/heads").mkdir(parents=True)
    return tmp_path / ".git"


def test_a_branch_is_followed_to_its_commit(git: Path) -> None:
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    (git / "refs/heads/main").write_text(FIRST + "\n")
    assert checkout_commit(git) == FIRST
    assert commit(git.parent / "labpipe") == FIRST[:10]


def test_packed_branches_are_found_by_their_whole_name(git: Path) -> None:
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    (git / "packed-refs").write_text(
        f"# pack-refs with: peeled\n{SECOND} refs/heads/not-main\n{FIRST} refs/heads/main\n^{SECOND}\n"
    )
    assert checkout_commit(git) == FIRST


def test_a_commit_checked_out_by_itself(git: Path) -> None:
    (git / "HEAD").write_text(FIRST + "\n")
    assert checkout_commit(git) == FIRST


def test_nothing_is_said_where_nothing_is_known(git: Path, tmp_path: Path) -> None:
    (git / "HEAD").write_text("ref: refs/heads/unborn\n")
    assert checkout_commit(git) == "" == checkout_commit(tmp_path / "none")
    (git / "HEAD").write_bytes(b"\xff\xfe")
    assert checkout_commit(git) == ""
