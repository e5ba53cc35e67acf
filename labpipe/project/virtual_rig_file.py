"""Reading a virtual rig file: what the rig IS."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from labpipe.project.marked_yaml import load_marked, set_entry
from labpipe.project.settings_reader import Faults, read_settings
from labpipe.records.settings import FileKind
from labpipe.registry import nearest
from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS, VirtualRig, VirtualRigKind


def load_virtual_rig(path: Path, overrides: Iterable[str] = ()) -> VirtualRig:
    """The settings of a virtual rig file, of the class of its kind.

    ConfigErrors with every fault at its place.
    """
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    kind = entries["kind"].text if "kind" in entries else ""
    if not kind:
        faults.add(tree, "kind", "is missing", f"known: {', '.join(VIRTUAL_RIGS.names())}")
    elif kind not in VIRTUAL_RIGS.names():
        faults.add(
            entries["kind"], "kind", f"unknown virtual rig '{kind}'", nearest(kind, VIRTUAL_RIGS.names())
        )
    faults.raise_any()
    chosen: VirtualRigKind = VIRTUAL_RIGS.load(kind)
    rig: VirtualRig | None = read_settings(chosen.settings, tree, "", faults)
    faults.raise_any()
    assert rig is not None
    return rig


VIRTUAL_RIG_FILE = FileKind(load_virtual_rig)
