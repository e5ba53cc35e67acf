"""Reading the ``run_ups:`` section of a pipeline: which run-ups of which rotor, and what is to be identified from them."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.config.faults import Faults, join
from labpipe.config.reader import read_settings
from labpipe.config.rig import load_rig
from labpipe.config.run_up_rotor import files_of, load_run_up_rotor
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError, parse_value
from labpipe.records.rig import Rig
from labpipe.records.run_up_result import HELD_OUT
from labpipe.run_ups.settings import RunSettings, RunUpSettings

RUN_UPS = "run_ups"


def files_of_run_ups(settings: RunUpSettings) -> list[Path]:
    """Every file that the result depends on, each once."""
    subtracted = [run.subtracted for run in settings.runs if run.subtracted is not None]
    return list(dict.fromkeys([*files_of(settings.rotor_path), *(run.path for run in settings.runs), *subtracted]))


def read_run_ups(node: Marked | None, folder: Path, faults: Faults) -> RunUpSettings | None:
    """The settings with their runs; None and faults where they cannot be read, None without the section."""
    if node is None:
        return None
    before = len(faults)
    entries = faults.mapping(node, RUN_UPS)
    plain = Marked({key: entry for key, entry in entries.items() if key != "runs"}, node.where)
    settings = read_settings(RunUpSettings, plain, RUN_UPS, faults)
    runs = _runs(entries.get("runs"), node, folder, faults)
    if settings is not None:
        _check_rotor(folder / settings.rotor, settings, entries, faults)
        _check_wants(settings, runs, entries, faults)
    if len(faults) > before or settings is None:
        return None
    return replace(settings, runs=tuple(runs), rotor_path=folder / settings.rotor)


def _check_rotor(path: Path, settings: RunUpSettings, entries: dict[str, Marked], faults: Faults) -> None:
    if not path.exists():
        faults.add(entries["rotor"], "run_ups.rotor", f"no such file '{settings.rotor}'", "paths are relative to the pipeline file")
        return
    try:
        rig = load_run_up_rotor(path)
        if settings.plane:
            rig.node(settings.plane)
    except ConfigError as error:
        if "plane" in entries and not error.where:
            faults.add(entries["plane"], "run_ups.plane", error.what, error.hint)
        else:
            faults.merge(error)


def _check_wants(settings: RunUpSettings, runs: list[RunSettings], entries: dict[str, Marked], faults: Faults) -> None:
    """What only the whole section shows."""
    needed = {settings.metamodels_of} | ({"joint"} if "physical" in settings.metamodels else set()) if settings.metamodels else set()
    for name in sorted(needed - set(settings.methods)):
        hint = f"add {name} to run_ups.methods"
        faults.add(entries["metamodels"], "run_ups.metamodels", f"metamodels need the method '{name}', which is not wanted", hint)
    if runs and all(run.role == HELD_OUT for run in runs):
        faults.add(entries["runs"], "run_ups.runs", "every run is held out, and nothing is left to fit", "leave out role: of some")


def _runs(node: Marked | None, section: Marked, folder: Path, faults: Faults) -> list[RunSettings]:
    if node is None or not isinstance(node.content, list) or not node.content:
        faults.add(node or section, "run_ups.runs", "a list of runs is needed", "for example - {file: load-1.csv}")
        return []
    found: dict[str, RunSettings] = {}
    for number, entry in enumerate(node.content, 1):
        run = _run(entry, f"run_ups.runs.{number}", folder, faults)
        if run is None:
            continue
        if run.name in found:
            faults.add(entry, f"run_ups.runs.{number}", f"a second run named '{run.name}'", "give it a name of its own")
        found[run.name] = run
    return list(found.values())


def _run(node: Marked, key: str, folder: Path, faults: Faults) -> RunSettings | None:
    entries = faults.mapping(node, key)
    plain = Marked({name: entry for name, entry in entries.items() if name != "unbalance"}, node.where)
    unbalance = _unbalance(entries.get("unbalance"), join(key, "unbalance"), faults)
    run = read_settings(RunSettings, plain, key, faults)
    if run is None:
        return None
    _check_excited(run, unbalance, node, key, faults)
    paths = {name: _path(entries, name, key, folder, faults) for name in ("file", "recording", "subtract", "rig")}
    own_rig = None
    if paths["rig"] is not None:
        own_rig = _rig(paths["rig"], faults)
    path = paths["file"] or paths["recording"] or Path()
    name = run.name or path.name.split(".")[0]
    return replace(run, name=name, unbalance=unbalance, path=path, subtracted=paths["subtract"], own_rig=own_rig)


def _check_excited(run: RunSettings, unbalance: tuple[tuple[str, complex], ...], node: Marked, key: str, faults: Faults) -> None:
    if run.recording and not unbalance:
        faults.add(node, join(key, "unbalance"), "is missing", "a recording does not state it; for example {disc 1: 50 g.mm at 0 deg}")


def _path(entries: dict[str, Marked], name: str, key: str, folder: Path, faults: Faults) -> Path | None:
    if name not in entries:
        return None
    path = folder / entries[name].text
    if not path.is_file():
        faults.add(entries[name], join(key, name), f"no such file '{entries[name].text}'", "paths are relative to the pipeline file")
    return path


def _rig(path: Path, faults: Faults) -> Rig | None:
    try:
        return load_rig(path) if path.is_file() else None
    except ConfigError as error:
        faults.merge(error)
        return None


def _unbalance(node: Marked | None, key: str, faults: Faults) -> tuple[tuple[str, complex], ...]:
    """{disc 1: 50 g.mm at 0 deg} -> (("disc 1", 5e-5 + 0j),) [kg m]; the angle is zero unless given."""
    found: list[tuple[str, complex]] = []
    for plane, entry in (faults.mapping(node, key) if node is not None else {}).items():
        try:
            found.append((plane, parse_unbalance(entry.text)))
        except UnitError as error:
            faults.add_unit(entry, join(key, plane), error)
    return tuple(found)


def parse_unbalance(text: str) -> complex:
    """ "50 g.mm at 60 deg" in kg m, complex with its angle, which is zero unless given; UnitError where it cannot be read."""
    size_text, _, angle_text = (part.strip() for part in text.partition(" at "))
    size = parse_value(size_text, "kg.m")
    return size * complex(np.exp(1j * (parse_value(angle_text, "rad") if angle_text else 0.0)))


def run_ups_entry(settings: RunUpSettings) -> dict[str, Any]:
    """The settings as JSON holds them, files by the names in the pipeline file."""
    plain = {key: value for key, value in asdict(settings).items() if key not in ("runs", "rotor_path")}
    left_out = ("path", "subtracted", "unbalance", "own_rig")
    runs = [
        {
            **{key: value for key, value in asdict(run).items() if key not in left_out},
            "unbalance": {plane: [size.real, size.imag] for plane, size in run.unbalance},
            "recorded_by": None if run.own_rig is None else asdict(run.own_rig),
        }
        for run in settings.runs
    ]
    return {**plain, "runs": runs}
