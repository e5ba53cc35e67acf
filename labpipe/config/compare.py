"""The ``compare:`` section: questions to tests that differ in a condition."""

from __future__ import annotations

from pathlib import Path

from labpipe.campaign.settings import CompareSettings
from labpipe.config.faults import Faults, join
from labpipe.config.reader import read_settings
from labpipe.marked_yaml import Marked
from labpipe.registry import nearest

SECTION = "compare"


def read_comparisons(node: Marked | None, folder: Path, faults: Faults, taken: tuple[str, ...]) -> tuple[CompareSettings, ...]:
    """The comparisons in their order; faults for names that a fit has already, fits and bearing files that are not there."""
    found = []
    for name, entry in (faults.mapping(node, SECTION) if node is not None else {}).items():
        key = join(SECTION, name)
        if name in taken:
            faults.add(entry, key, "a fit or calibration has this name already", "rules could not tell them apart")
        settings = read_settings(CompareSettings, entry, key, faults, name=name)
        if settings is None:
            continue
        if settings.fit and settings.fit not in taken:
            faults.add(entry.content["fit"], join(key, "fit"), f"there is no fit '{settings.fit}'", nearest(settings.fit, taken))
        if settings.theory is not None and not (folder / settings.theory.bearing).is_file():
            place = entry.content["theory"].content["bearing"]
            faults.add(place, join(key, "theory.bearing"), f"no such file '{settings.theory.bearing}'", "paths are relative to this file")
        found.append(settings)
    return tuple(found)


def bearing_files(comparisons: tuple[CompareSettings, ...], folder: Path) -> list[Path]:
    """The bearing files that the comparisons name, each once."""
    return list(dict.fromkeys(folder / settings.theory.bearing for settings in comparisons if settings.theory is not None))
