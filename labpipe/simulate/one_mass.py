"""The truth of a virtual rig of one mass on a spring and a damper."""

from __future__ import annotations

import math


def one_mass_truth(mass: float, stiffness: float, damping: float) -> dict[str, float]:
    """Mass [kg], k [N/m], c [N.s/m] with f_n = sqrt(k / m) / 2 pi [Hz] and zeta = c / (2 sqrt(k m)) [1], by name.

    Equation (sim-one-mass).
    """
    natural = math.sqrt(stiffness / mass)
    return {"mass": mass, "k": stiffness, "c": damping, "f_n": natural / (2 * math.pi), "zeta": damping / (2 * mass * natural)}
