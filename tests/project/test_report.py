"""The format that a report's name asks for."""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.errors import ConfigError
from labpipe.project.report import format_of


def test_the_ending_says_the_format_of_a_file_that_is_there_or_not(tmp_path: Path) -> None:
    (tmp_path / "there.pdf").touch()
    (tmp_path / "there.txt").touch()
    (tmp_path / "folder.txt").mkdir()
    assert (
        format_of(tmp_path / "there.pdf") == "pdf"
        and format_of(tmp_path / "new.MD") == "md"
        and format_of(tmp_path / "new.htm") == "html"
    )
    # What is not a file, such as a pipe, has no ending that says anything.
    assert format_of(tmp_path / "folder.txt") == "html"
    for name in ("there.txt", "new.txt", "new"):
        with pytest.raises(ConfigError, match="no report format"):
            format_of(tmp_path / name)
