"""Reading the ``unbalance:`` section of a pipeline with the rotor file that it names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from labpipe.config.faults import Faults
from labpipe.config.reader import read_settings
from labpipe.config.rotor import load_rotor
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.rigs.unbalance_runs import UnbalanceSettings, WearCase

UNBALANCE = "unbalance"


def read_unbalance(node: Marked | None, folder: Path, faults: Faults) -> UnbalanceSettings | None:
    """The settings with their cases and rotor; None and faults where they cannot be read, None without the section."""
    if node is None:
        return None
    before = len(faults)
    entries = faults.mapping(node, UNBALANCE)
    plain = Marked({key: entry for key, entry in entries.items() if key != "cases"}, node.where)
    settings = read_settings(UnbalanceSettings, plain, UNBALANCE, faults)
    cases = []
    for name, entry in (faults.mapping(entries["cases"], "unbalance.cases") if "cases" in entries else {}).items():
        case = read_settings(WearCase, entry, f"unbalance.cases.{name}", faults)
        cases += [] if case is None else [(name, case)]
    if len(faults) == before and not cases:
        faults.add(node, "unbalance.cases", "are missing", "for example cases: {healthy: {depth: 0 um}}")
    if len(faults) > before or settings is None:
        return None
    return _with_rotor(settings, tuple(cases), node, folder, faults)


def _with_rotor(
    settings: UnbalanceSettings, cases: tuple[tuple[str, WearCase], ...], node: Marked, folder: Path, faults: Faults
) -> UnbalanceSettings | None:
    path = folder / settings.rotor
    if not path.exists():
        faults.add(node.content["rotor"], "unbalance.rotor", f"no such file '{settings.rotor}'", "paths are relative to the pipeline file")
        return None
    try:
        rig = load_rotor(path)
    except ConfigError as error:
        faults.merge(error)
        return None
    try:
        return replace(settings, cases=cases, rig=rig)
    except ConfigError as error:
        faults.add(node, UNBALANCE, error.what, error.hint)
        return None
