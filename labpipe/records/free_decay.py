"""Free decays: what a structure does that is left to itself, cut out of recordings."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.records.arrays import frozen_array
from labpipe.records.finding import Finding
from labpipe.records.response import Port


@dataclass(frozen=True)
class FreeDecay:
    """One decay: *samples* (n_sample, n_output) [SI units of the outputs] of *recording* from *start* [s] on."""

    recording: str
    start: float
    samples: FloatArray

    def __post_init__(self) -> None:
        samples = np.atleast_2d(self.samples)
        object.__setattr__(self, "samples", frozen_array(samples, np.float64, f"decay of '{self.recording}'", samples.shape))


@dataclass(frozen=True)
class FreeDecays:
    """The free decays of one test at one *sample_rate* [Hz]; *units* of the outputs [SI]. All hits and recordings share the modes."""

    sample_rate: float
    outputs: tuple[Port, ...]
    units: tuple[str, ...]
    decays: tuple[FreeDecay, ...]
    _: KW_ONLY
    name: str = ""
    findings: tuple[Finding, ...] = ()
    conditions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.decays:
            raise DataError(f"'{self.name}' holds no free decay")
        for decay in self.decays:
            if decay.samples.shape[1] != len(self.outputs):
                raise DataError(f"a decay of '{decay.recording}' has {decay.samples.shape[1]} outputs, {len(self.outputs)} are needed")
