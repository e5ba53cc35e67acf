"""Bearings, rotors and virtual rigs by the name of their kind or by their file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.bearings.kinds import BEARINGS, BearingKind
from labpipe.config.bearing import open_bearing
from labpipe.config.rotor import load_rotor
from labpipe.config.run_up_rotor import load_run_up_rotor
from labpipe.config.virtual_rig import load_virtual_rig
from labpipe.marked_yaml import load_marked
from labpipe.rigs.rotor_rig import RotorRig
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS, VirtualRig, VirtualRigKind

SETTINGS_SUFFIXES = (".yaml", ".yml")


def bearing(kind: str | Path, **settings: Any) -> BearingCoefficients:
    """Stiffness and damping of a bearing: of a bearing file, or of a *kind* with the entries of its file as keywords.

    ``bearing("journal-bearing", diameter="31 mm", length="18 mm", clearance="90 um", viscosity=0.1044, speed="50 Hz", load="58.8 N")``;
    texts carry their unit, numbers are SI. ConfigError for an unknown kind or entry.
    """
    if _is_file(kind):
        file = open_bearing(Path(kind), [f"{name}={value}" for name, value in settings.items()])
        return file.coefficients([file.settings()])[0]
    chosen: BearingKind = BEARINGS.load(str(kind))
    return chosen.coefficients([chosen.settings(kind=str(kind), **settings)])[0]


def rotor(path: str | Path) -> RotorRig | RunUpRotor:
    """The rotor of a rotor file; one with ``pins:`` is a rotor for run-ups."""
    entries = load_marked(Path(path)).content
    pinned = isinstance(entries, dict) and "pins" in entries
    return load_run_up_rotor(Path(path)) if pinned else load_rotor(Path(path))


def virtual_rig(kind: str | Path, **settings: Any) -> VirtualRig:
    """A virtual rig: of its file, or of a *kind* with the entries of its file as keywords."""
    if _is_file(kind):
        return load_virtual_rig(Path(kind), [f"{name}={value}" for name, value in settings.items()])
    chosen: VirtualRigKind = VIRTUAL_RIGS.load(str(kind))
    rig: VirtualRig = chosen.settings(kind=str(kind), **settings)
    return rig


def _is_file(kind: str | Path) -> bool:
    return isinstance(kind, Path) or kind.endswith(SETTINGS_SUFFIXES)
