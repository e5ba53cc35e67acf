"""Reading a rotor file with ``pins:``: a shaft in pinned ends on one loaded bearing, for run-ups."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.artefacts.json_file import read_digested
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.methods.rotor.rig import Unbalance
from labpipe.methods.rotor.rotor_file import read_parts, try_making
from labpipe.methods.run_ups.metamodels import Metamodel, from_entries
from labpipe.methods.run_ups.rotor import RunUpRotor
from labpipe.project.marked_yaml import Marked, load_marked
from labpipe.project.settings_reader import Faults, join
from labpipe.records.settings import FileKind, Settings, setting, text
from labpipe.registry import nearest

OWN_LISTS = ("elements", "discs", "sleeves", "unbalances")
# Keys that the file needs, with hints.
NEEDED = {
    "pins": "for example pins: [1, 5]",
    "planes": "for example planes: {disc 1: 2}",
    "bearings": "one entry",
}


@dataclass(frozen=True)
class PinnedSettings(Settings):
    """The plain entries of a rotor file with pins."""

    name: str = text("name of the rotor, as the report shows it")
    description: str = text("what a reader should know of the rotor")
    speeds: tuple[float, float] | None = setting(
        "band",
        "range of the critical speeds, thresholds up to twice its end; default: that of the run-ups",
        "Hz",
        None,
    )
    coefficients: str = text("FILE#NAME: a metamodel of an identification.json, instead of the film")

    def __post_init__(self) -> None:
        self.require_positive("speeds")


def load_run_up_rotor(path: Path, overrides: Iterable[str] = ()) -> RunUpRotor:
    """The rotor of a rotor file with pins; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    rig = read_run_up_rotor(tree, path.stem, faults, path.parent)
    faults.raise_any()
    assert rig is not None
    return rig


def files_of(path: Path) -> tuple[Path, ...]:
    """The rotor file and the file of its coefficients."""
    entries, named = load_marked(path).content, None
    if isinstance(entries, dict) and "coefficients" in entries:
        named = entries["coefficients"].content
    return (path, path.parent / named.rpartition("#")[0]) if isinstance(named, str) else (path,)


def read_run_up_rotor(tree: Marked, stem: str, faults: Faults, folder: Path) -> RunUpRotor | None:
    """The rotor of a marked tree, files it names relative to *folder*."""
    before = len(faults)
    entries = faults.mapping(tree, "")
    settings, rotor, bearings, lists = read_parts(tree, entries, PinnedSettings, OWN_LISTS, NEEDED, faults)
    pins = _nodes(entries.get("pins"), faults)
    named = faults.mapping(entries["planes"], "planes") if "planes" in entries else {}
    planes = tuple((name, _node(entry, join("planes", name), faults)) for name, entry in named.items())
    listed = entries.get("bearings")
    if listed is not None and isinstance(listed.content, list) and len(listed.content) != 1:
        faults.add(listed, "bearings", "a rotor between pins runs on one bearing")
    tabulated = None
    if settings and settings.coefficients:
        tabulated = read_coefficients(settings.coefficients, folder, entries["coefficients"], faults)
    if rotor is None or settings is None or len(faults) > before:
        return None
    (entry, place), *_ = bearings
    if place.uncertainties:
        names = ", ".join(uncertain.uncertainty.source for uncertain in place.uncertainties)
        hint = "leave it out: the film's numbers are estimated about the value that is given here"
        faults.add(entry, "bearings.1", f"the uncertainty of {names} is not used by run-ups", hint)
        return None
    place = replace(place, name="bearing") if place.name == "1" else place
    speeds = (
        None if settings.speeds is None else (2 * np.pi * settings.speeds[0], 2 * np.pi * settings.speeds[1])
    )
    unbalances = tuple(Unbalance(part.node, part.size, part.phase) for _, part in lists["unbalances"])
    rest: dict[str, Any] = {"pins": pins, "planes": planes, "unbalances": unbalances}
    rest |= {"tabulated": tabulated, "speeds": speeds}
    return try_making(lambda: RunUpRotor(settings.name or stem, rotor, place=place, **rest), tree, "", faults)


def read_coefficients(named: str, folder: Path, node: Marked, faults: Faults) -> Metamodel | None:
    """The metamodel NAME of an identification of run-ups, named as FILE#NAME."""
    file, mark, name = named.rpartition("#")
    if not (file and mark and name):
        hint = "for example identification.json#physical"
        faults.add(node, "coefficients", f"'{named}' is not FILE#NAME", hint)
        return None
    try:
        return _metamodel(folder / file, name)
    except LabpipeError as error:
        faults.add(node, "coefficients", error.what, error.hint)
        return None


def _metamodel(path: Path, name: str) -> Metamodel:
    try:
        entries = read_digested(path, "identification.json")
    except FileNotFoundError as error:
        hint = "paths are relative to the file that names them"
        raise ConfigError(f"no such file '{path}'", hint=hint) from error
    except DataError as error:
        raise DataError(f"'{path}' {error.what}", hint=error.hint) from error
    try:
        models = {str(model["name"]): model["model"] for model in entries["run_ups"]["metamodels"]}
    except (KeyError, TypeError):
        models = {}
    if not models:
        hint = "name the identification.json of run-ups whose section asks for metamodels:"
        raise DataError(f"'{path}' holds no metamodels", hint=hint)
    if name not in models:
        raise ConfigError(f"no metamodel '{name}' in '{path}'", hint=nearest(name, models))
    return from_entries(models[name])


def _nodes(node: Marked | None, faults: Faults) -> tuple[int, ...]:
    if node is None:
        return ()
    if not isinstance(node.content, list):
        faults.add(node, "pins", "a list of nodes is needed", "for example [1, 5]")
        return ()
    return tuple(_node(entry, f"pins.{number}", faults) for number, entry in enumerate(node.content, 1))


def _node(entry: Marked, key: str, faults: Faults) -> int:
    if isinstance(entry.content, bool) or not isinstance(entry.content, int):
        faults.add(entry, key, "the number of a node is needed", "nodes are counted from 1, from the left")
        return 0
    return entry.content


RUN_UP_ROTOR_FILE = FileKind(load_run_up_rotor, files_of)
