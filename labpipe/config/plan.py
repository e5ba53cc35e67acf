"""Reading a plan file: a title, and the section `plan:`, whose entries are those of the model it is for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labpipe.config.faults import Faults
from labpipe.config.reader import DECIDE, read_settings
from labpipe.marked_yaml import Marked, load_marked, set_entry
from labpipe.planner.kinds import PLANS, PlanKind
from labpipe.registry import nearest

KEYS = ("title", "plan")


@dataclass(frozen=True)
class PlanFile:
    """A plan file: where it is, its title, what is planned, and the settings of that."""

    path: Path
    title: str
    kind: PlanKind
    settings: Any


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
    kind, settings = None, None
    if "plan" not in entries:
        faults.add(tree, "plan", "is missing", "state model, expected values, noise, limits and duration")
    else:
        kind = _kind(entries["plan"], faults)
        _sort_theory(entries["plan"])
        settings = None if kind is None else read_settings(kind.load("settings"), entries["plan"], "plan", faults)
    faults.raise_any()
    assert kind is not None and settings is not None
    title = entries["title"].text if "title" in entries else ""
    return PlanFile(path, title or path.stem, kind, settings)


def _sort_theory(node: Marked) -> None:
    """expected: {bearing: FILE, ...} is what `theory` says."""
    entries = node.content if isinstance(node.content, dict) else {}
    expected = entries.get("expected")
    if (
        expected is not None
        and isinstance(expected.content, dict)
        and "theory" not in entries
        and {"bearing", "rotor"} & set(expected.content)
    ):
        entries["theory"] = entries.pop("expected")


def _kind(node: Marked, faults: Faults) -> PlanKind | None:
    """What the entry `model` asks for; None and a fault where there is none of that name."""
    entries = faults.mapping(node, "plan")
    kinds = PLANS.names()
    if "model" not in entries or entries["model"].text == DECIDE:
        faults.add(node, "plan.model", "is missing", f"known: {', '.join(kinds)}")
        return None
    name = entries["model"].text
    if name not in kinds:
        faults.add(entries["model"], "plan.model", f"unknown model '{name}'", nearest(name, kinds))
        return None
    kind: PlanKind = PLANS.load(name)
    return kind
