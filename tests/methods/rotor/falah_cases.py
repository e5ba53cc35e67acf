"""The rotor of the unbalance tests: two discs on a pinned shaft, bearing coefficients that depend on
speed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.journal_bearing.curve import journal_curve, sommerfeld_number
from labpipe.methods.rotor.pinned import pinned_rotor
from labpipe.methods.rotor.shaft import Disc, Rotor, ShaftElement

RPM = np.pi / 30
DISC = (4.3, 4.453e-3, 4.3 * 0.05**2 / 2)
ROTOR = Rotor(tuple(ShaftElement(0.19, 16.5e-3) for _ in range(4)), (Disc(2, *DISC), Disc(4, *DISC)))
PINNED = pinned_rotor(ROTOR, (1, 5))
UNBALANCE = {2: 5e-5 + 0j, 4: 3e-5 * np.exp(1j * np.pi / 3)}
LOAD = 0.823 * 4.4482216
BEARING = JournalBearing(
    diameter=16.5e-3, length=8.25e-3, clearance=0.2e-3, viscosity=0.55, groove_width=np.deg2rad(20)
)


def film(load: float = LOAD) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """K and C over speed under a load."""

    def coefficients(speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, _ = journal_curve(0.5, np.deg2rad(20)).coefficients(sommerfeld_number(BEARING, load, speed))
        both = (found * load / BEARING.clearance).reshape(*np.shape(speed), 2, 2, 2)
        return both[..., 0, :, :], both[..., 1, :, :] / np.asarray(speed)[..., None, None]

    return coefficients
