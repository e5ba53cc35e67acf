"""Ocvirk's closed forms of a short journal bearing, against which finite films are held."""

from __future__ import annotations

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.methods.journal_bearing.bearing import JournalBearing


def short_bearing_load(bearing: JournalBearing, eccentricity_ratio: float, speed: float) -> float:
    """Load [N] carried at an eccentricity ratio; f = pi D Omega mu L^3 e / (8 c^2 (1 - e^2)^2) sqrt((16/pi^2
    - 1) e^2 + 1).

    Friswell et al., Dynamics of Rotating Machines (2010), chapter 5.
    """
    e = eccentricity_ratio
    scale = (
        np.pi * bearing.diameter * speed * bearing.viscosity * bearing.length**3 / (8 * bearing.clearance**2)
    )
    return float(scale * e / (1 - e**2) ** 2 * np.sqrt((16 / np.pi**2 - 1) * e**2 + 1))


def short_bearing_equilibrium(bearing: JournalBearing, load: float, speed: float) -> tuple[float, float]:
    """Eccentricity ratio [-] and attitude angle [rad] under a *load* [N] at *speed* [rad/s]; tan = pi sqrt(1
    - e^2) / (4 e).
    """
    e = float(
        scipy.optimize.brentq(
            lambda ratio: short_bearing_load(bearing, ratio, speed) / load - 1, 1e-9, 1 - 1e-9, xtol=1e-14
        )
    )
    return e, float(np.arctan2(np.pi * np.sqrt(1 - e**2), 4 * e))


def short_bearing_coefficients(
    bearing: JournalBearing, load: float, speed: float
) -> tuple[FloatArray, FloatArray]:
    """Stiffness [N/m] and damping [N s/m], (2, 2) in the order yy yz; zy zz, under a *load* [N] along -z.

    Friswell et al., Dynamics of Rotating Machines (2010), chapter 5.
    """
    e, _ = short_bearing_equilibrium(bearing, load, speed)
    p, rest = np.pi, 1 - e**2
    root = e * np.sqrt(rest)
    h = 1 / (p**2 * rest + 16 * e**2) ** 1.5
    k_yy = 4 * (p**2 * (2 - e**2) + 16 * e**2)
    k_yz = p * (p**2 * rest**2 - 16 * e**4) / root
    k_zy = -p * (p**2 * rest * (1 + 2 * e**2) + 32 * e**2 * (1 + e**2)) / root
    k_zz = 4 * (p**2 * (1 + 2 * e**2) + 32 * e**2 * (1 + e**2) / rest)
    c_yy = 2 * p * np.sqrt(rest) * (p**2 * (1 + 2 * e**2) - 16 * e**2) / e
    c_yz = -8 * (p**2 * (1 + 2 * e**2) - 16 * e**2)
    c_zz = 2 * p * (p**2 * rest**2 + 48 * e**2) / root
    per_length = load / bearing.clearance * h
    return np.array([[k_yy, k_yz], [k_zy, k_zz]]) * per_length, np.array([[c_yy, c_yz], [c_yz, c_zz]]) * (
        per_length / speed
    )
