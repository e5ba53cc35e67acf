"""Reading a virtual rig file: what the rig IS. VIRTUAL_RIGS by kind."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from labpipe.config.faults import Faults
from labpipe.config.reader import read_settings
from labpipe.config.rotor import on_rotor
from labpipe.config.run_up_rotor import on_run_up_rotor
from labpipe.marked_yaml import load_marked, set_entry
from labpipe.registry import Registry, nearest
from labpipe.simulate.unbalance_rig import KIND as RUN_UPS

VIRTUAL_RIGS = Registry(
    "virtual rig",
    {
        "virtual-magnetic-rig": "labpipe.simulate.settings:VirtualRig",
        "virtual-mdof-rig": "labpipe.simulate.mdof_rig:VirtualMdofRig",
        "virtual-ball-bearing-rig": "labpipe.simulate.ball_bearing_rig:VirtualBallBearingRig",
        "virtual-journal-rig": "labpipe.simulate.journal_rig:VirtualJournalRig",
        "virtual-unbalance-rig": "labpipe.simulate.unbalance_rig:VirtualUnbalanceRig",
        "virtual-white-noise-rig": "labpipe.simulate.white_noise_rig:WhiteNoiseRig",
    },
)


def load_virtual_rig(path: Path, overrides: Iterable[str] = ()) -> Any:
    """The settings of a virtual rig file, of the class of its kind; ConfigErrors with every fault at its place."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults()
    entries = faults.mapping(tree, "")
    kind = entries["kind"].text if "kind" in entries else ""
    if not kind:
        faults.add(tree, "kind", "is missing", f"known: {', '.join(VIRTUAL_RIGS.names())}")
    elif kind not in VIRTUAL_RIGS.names():
        faults.add(entries["kind"], "kind", f"unknown virtual rig '{kind}'", nearest(kind, VIRTUAL_RIGS.names()))
    faults.raise_any()
    rig = read_settings(VIRTUAL_RIGS.load(kind), tree, "", faults)
    if rig is not None and "rotor" in entries:
        rig = (on_run_up_rotor if rig.kind == RUN_UPS else on_rotor)(rig, tree, path.parent, faults)
    faults.raise_any()
    return rig
