"""Patterns of URLs choose what the same patterns choose on a disk, by Python's own glob."""

from __future__ import annotations

import glob
from pathlib import Path

import pytest

from labpipe.project.settings_reader import glob_matches

FILES = (
    "a.csv",
    "b.CSV",
    "runs/a.csv",
    "runs/b.csv",
    "runs/x/y/c.csv",
    "runs/.hidden.csv",
    ".later/a.csv",
    "runs/.d/e.csv",
    "runs/a[1].csv",
)
PATTERNS = (
    "*.csv",
    "runs/*.csv",
    "**/*.csv",
    "runs/**",
    "runs/**/*.csv",
    "**/x/**/*.csv",
    "runs/[ab].csv",
    "r?ns/a*",
    "runs/.*",
    "runs/a[[]1].csv",
)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_as_on_a_disk(tmp_path: Path, pattern: str) -> None:
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    on_disk = {
        name for name in glob.glob(pattern, root_dir=tmp_path, recursive=True) if (tmp_path / name).is_file()
    }
    assert {name for name in FILES if glob_matches(Path(name).parts, Path(pattern).parts)} == on_disk
    assert on_disk
