"""A squeeze-film damper: short, cavitated, its journal on a circle around the centre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.bearings.kinds import Amount, BearingCoefficients, BearingKind, frequency_hz
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class SqueezeFilm(Settings):
    """What a squeeze-film file holds.

    Every entry is read with its unit, and refused at its place when it cannot be.
    """

    kind: str = setting("choice", "which kind of bearing", choices=("squeeze-film-damper",))
    name: str = setting("text", "name of the damper", default="")
    diameter: float = setting("value", "diameter of the journal", unit="m")
    length: float = setting("value", "length of the film", unit="m")
    clearance: float = setting("value", "radial clearance", unit="m")
    viscosity: float = setting("value", "dynamic viscosity of the oil", unit="Pa.s")
    eccentricity: float = setting("value", "radius of the orbit over the clearance", unit="1", default=0.0)
    frequency: float = setting("value", "frequency of the orbit", unit="Hz")

    def __post_init__(self) -> None:
        if not 0 <= self.eccentricity < 1:
            raise ConfigError("'eccentricity' must be at least 0 and below 100 %")


def coefficients(settings: Sequence[SqueezeFilm]) -> list[BearingCoefficients]:
    """k = 2 mu R L^3 w e / (c^3 (1 - e^2)^2), c = pi mu R L^3 / (2 c^3 (1 - e^2)^(3/2)), alike in all
    directions.

    Short bearing, half film, circular centred orbit (Vance 1988, Rotordynamics of Turbomachinery, ch. 6).
    """
    return [_one(entry) for entry in settings]


def _one(damper: SqueezeFilm) -> BearingCoefficients:
    e, w = damper.eccentricity, 2 * np.pi * damper.frequency
    film = damper.viscosity * damper.diameter / 2 * (damper.length / damper.clearance) ** 3
    stiffness, damping = 2 * film * w * e / (1 - e**2) ** 2, np.pi * film / 2 / (1 - e**2) ** 1.5
    rest = (Amount("eccentricity_ratio", e, "1"),)
    return BearingCoefficients(("y", "z"), stiffness * np.eye(2), damping * np.eye(2), rest)


SQUEEZE_FILM = BearingKind(SqueezeFilm, coefficients, operating={"frequency": frequency_hz})
