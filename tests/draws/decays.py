"""Worlds of ring-downs: the virtual rig that made the sample recordings, recorded again by a sensor that is
off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.ring_down.virtual_rig import DecayRig, decay_runs
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.identification import Fit
from labpipe.records.spectra import FreeDecays
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.settings import FrfSettings
from tests.draws.usual import Errors, factor_of

RIG = Path(__file__).parent.parent.parent / "configs" / "virtual-decay.yaml"
# Noise of a world without errors over that of the rig.
QUIET = 1e-3


@dataclass(frozen=True)
class DecayWorlds:
    """The run *name* of a virtual *rig*, recorded by the sensors of *decays*."""

    rig: DecayRig
    name: str
    decays: FreeDecays

    def recorded(self, errors: Errors, rng: np.random.Generator | None) -> FreeDecays:
        quiet = replace(self.rig, noise=self.rig.noise * QUIET) if rng is None else self.rig
        seed = 1 if rng is None else int(rng.integers(1 << 30))
        (recording,) = decay_runs(quiet, seed, [self.name])
        gains = np.array(
            [factor_of(port.uncertainties, np.zeros(1), errors)[0].real for port in self.decays.outputs]
        )
        found = free_decays(
            [replace(recording, samples=recording.samples * gains)],
            FrfSettings("decay"),
            name=self.name,
            conditions={},
        )
        return replace(found, outputs=self.decays.outputs)


def decay_worlds(decays: FreeDecays, settings: FitSettings) -> tuple[DecayWorlds, Fit]:
    worlds = DecayWorlds(load_virtual_rig(RIG), decays.name, decays)
    return worlds, identify(decays, settings)[0]
