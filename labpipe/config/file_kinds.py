"""Kinds of files that a settings file can name: how each is read, and which further files it depends on. FILE_KINDS by name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from labpipe.records.file_kind import FileKind
from labpipe.records.settings import settings_of
from labpipe.registry import Registry

FILE_KINDS = Registry(
    "file kind",
    {
        "path": "labpipe.config.file_kinds:PATH",
        "rig": "labpipe.config.rig:RIG_FILE",
        "rotor": "labpipe.config.rotor:ROTOR_FILE",
        "run-up-rotor": "labpipe.config.run_up_rotor:RUN_UP_ROTOR_FILE",
        "virtual-rig": "labpipe.config.virtual_rig:VIRTUAL_RIG_FILE",
        "bearing": "labpipe.config.bearing:BEARING_FILE",
        "geometry": "labpipe.formats.geometry:GEOMETRY_FILE",
    },
)


# The content of a table or recording is read later, by those who know its columns.
PATH = FileKind(lambda path: path)


def named_files(settings: Any, folder: Path) -> Iterator[Path]:
    """Every file that settings name, nested settings too, and the files that those name; *folder*: of the file that holds the settings."""
    for name, (setting, _) in settings_of(type(settings)).items():
        value = getattr(settings, name)
        if setting.kind == "file" and value:
            path = folder / value
            yield from FILE_KINDS[setting.file_kind].files(path) if setting.file_kind else (path,)
    for field in fields(settings):
        nested = getattr(settings, field.name)
        for part in nested if isinstance(nested, tuple) else (nested,):
            if is_dataclass(part) and not isinstance(part, type) and settings_of(type(part)):
                yield from named_files(part, folder)
