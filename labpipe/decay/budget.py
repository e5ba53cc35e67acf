"""What the doubts of sensors and of a given mass do to decays: the law over the amplitude goes as one over the sensor's gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.budget import Source, mass_source
from labpipe.identify.settings import FitSettings
from labpipe.records.doubt import Doubt
from labpipe.records.parameter import Parameter
from labpipe.records.response import Port

PER_AMPLITUDE = ("zeta_slope", "f_slope")


def decay_sources(parameters: Sequence[Parameter], settings: FitSettings, ports: Mapping[int, Port]) -> list[Source]:
    """The sources that change *parameters* of decays; *ports*: the sensor that the amplitude of every mode, from 0, was read by.

    An error d of a gain makes all amplitudes A (1 - d), and what is per amplitude 1 / (1 - d) times as large. Poles do not know it.
    """
    doubts: dict[str, Doubt] = {}
    changes: dict[str, FloatArray] = {}
    for mode, port in ports.items():
        scaled = np.array(
            [parameter.value if parameter.name in {f"{name}_{mode + 1}" for name in PER_AMPLITUDE} else 0.0 for parameter in parameters]
        )
        for doubted in port.doubts:
            if doubted.effect == "gain":
                source = doubted.doubt.source
                doubts.setdefault(source, doubted.doubt)
                changes[source] = changes.get(source, np.zeros(len(parameters))) + doubted.doubt.std_error * scaled
    return [*mass_source(parameters, settings), *((doubts[source], change) for source, change in changes.items())]
