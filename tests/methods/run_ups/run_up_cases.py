"""Run-ups of the virtual rig for the tests of their identification; truths and runs are made once."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import RunUpRotor
from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from labpipe.methods.run_ups.virtual_rig import VirtualUnbalanceRig, run_ups
from labpipe.project.simulate import load_virtual_rig

CONFIGS = Path(__file__).parents[3] / "configs"
RIG: RunUpRotor = load_run_up_rotor(CONFIGS / "rotors/falah.yaml")
LOADS = ("load-1", "load-2", "load-3", "load-4")


@lru_cache(maxsize=8)
def virtual(truth: str, *further: str) -> VirtualUnbalanceRig:
    """The shipped virtual rig with another truth."""
    found: VirtualUnbalanceRig = load_virtual_rig(
        CONFIGS / "virtual-unbalance.yaml", [f"truth={truth}", *further]
    )
    return found


@lru_cache(maxsize=16)
def trained(truth: str, seed: int = 1) -> tuple[RunUp, ...]:
    """The four run-ups that a fit may see."""
    return run_ups(virtual(truth), seed, LOADS)


def per_cent_rms(differences: list[float]) -> float:
    return float(100 * np.sqrt(np.mean(np.square(differences))))
