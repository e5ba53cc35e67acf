"""A kind of file that a settings file can name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class FileKind:
    """*load*: the content of a file, ConfigError where it cannot be read; *files*: the file and every file that it names itself."""

    load: Callable[[Path], Any]
    files: Callable[[Path], tuple[Path, ...]] = lambda path: (path,)
