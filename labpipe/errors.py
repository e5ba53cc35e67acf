"""What can go wrong because of the user's input, and how it is said.

Every LabpipeError reads ``where: what; hint`` on one line and ends the command with exit code 2.
Anything else that escapes is a fault of labpipe itself: exit code 3, and a file with its traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import PurePath

ECHO = 80


def shorten(text: str, length: int = ECHO) -> str:
    """A text from a file as messages echo it: at most *length* characters."""
    return text if len(text) <= length else text[: length - 3] + "..."


class LabpipeError(Exception):
    """A fault of the input: *what* is wrong, *where* it is, a path for example, and a *hint* at what would be
    right.
    """

    def __init__(self, what: str, where: str | PurePath = "", hint: str = "") -> None:
        self.what = what
        self.where = str(where)
        self.hint = hint
        super().__init__(what)

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        hint = f"; {self.hint}" if self.hint else ""
        return f"{place}{self.what}{hint}"


@contextmanager
def locate_errors(where: str | PurePath) -> Iterator[None]:
    """A LabpipeError from within says that it is at *where*, unless it says its own place."""
    try:
        yield
    except LabpipeError as error:
        error.where = error.where or str(where)
        raise


class ConfigError(LabpipeError):
    """A fault in a rig, pipeline or bearing file, in ``--set`` or on the command line; *field*: the entry of
    the settings that is wrong.
    """

    def __init__(self, what: str, where: str | PurePath = "", hint: str = "", field: str = "") -> None:
        super().__init__(what, where, hint)
        self.field = field


class SettingError(ConfigError):
    """A fault of the entry *field* of settings, which whoever reads them knows the place of."""

    def __init__(self, field: str, what: str, hint: str = "") -> None:
        super().__init__(what, "", hint, field)


class ConfigErrors(ConfigError):
    """All faults of a file, found in one pass; one line each, however often the file was read."""

    def __init__(self, faults: list[ConfigError]) -> None:
        self.faults = tuple({str(fault): fault for fault in faults}.values())
        super().__init__("\n".join(map(str, self.faults)))


class DataError(LabpipeError):
    """A fault in a recording or an artefact: the measured numbers cannot be used as they are."""


class FitError(LabpipeError):
    """The measurement cannot support the requested fit."""
