"""Reading a plan file: a title, and the section `plan:`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from labpipe.config.faults import Faults
from labpipe.config.reader import read_settings
from labpipe.marked_yaml import load_marked, set_entry
from labpipe.planner.settings import PlanSettings

KEYS = ("title", "plan")


@dataclass(frozen=True)
class PlanFile:
    """A plan file: where it is, its title, and its settings."""

    path: Path
    title: str
    settings: PlanSettings


def load_plan(path: Path, overrides: Iterable[str] = ()) -> PlanFile:
    """The content of a plan file; ConfigErrors with every fault at its place.

    It is a file of its own: a pipeline is run again with every new recording, and what was planned before the test is not to change then.
    """
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    if entries:
        faults.unknown_keys(tree, "", KEYS)
    if "plan" not in entries:
        faults.add(tree, "plan", "is missing", "state model, expected values, noise, limits and duration")
    settings = read_settings(PlanSettings, entries["plan"], "plan", faults) if "plan" in entries else None
    faults.raise_any()
    assert settings is not None
    title = entries["title"].text if "title" in entries else ""
    return PlanFile(path, title or path.stem, settings)
