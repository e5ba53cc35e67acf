"""Bearings that the tests of rolling bearings share, and a readable twin of their load sum."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from labpipe.methods.rolling_bearing.loads import RollingBearing

Twin = Callable[[RollingBearing, np.ndarray, float], np.ndarray]


@pytest.fixture(scope="session")
def deep_groove() -> RollingBearing:
    """NSK 6208, data printed by Knaapen (1997), appendix A."""
    return RollingBearing(9, 1.10e10, 30.1488e-3, groove_distance=5.953e-4)


@pytest.fixture(scope="session")
def angular() -> RollingBearing:
    """RPF 7208, data printed by Knaapen (1997), appendix A."""
    return RollingBearing(12, 6.262e9, 30.12e-3, math.radians(40), groove_distance=5.571e-4)


@pytest.fixture(scope="session")
def taper() -> RollingBearing:
    """A taper roller bearing of ordinary size; our own numbers."""
    return RollingBearing(17, 1.0e9, 32e-3, math.radians(14))


@pytest.fixture(scope="session")
def twin() -> Twin:
    """The loads of one load case, element by element, as the model's equations stand."""

    def loads(bearing: RollingBearing, q: np.ndarray, cage_angle: float = 0.0) -> np.ndarray:
        dx, dy, dz, bx, by = q
        r, a0 = bearing.pitch_radius, bearing.contact_angle
        total = np.zeros(5)
        for j in range(bearing.elements):
            psi = cage_angle + 2 * math.pi * j / bearing.elements
            dz_j = dz + r * (bx * math.sin(psi) - by * math.cos(psi))
            dr_j = dx * math.cos(psi) + dy * math.sin(psi) - bearing.clearance
            if bearing.groove_distance is not None:
                axial = bearing.groove_distance * math.sin(a0) + dz_j
                radial = bearing.groove_distance * math.cos(a0) + dr_j
                angle, delta = math.atan2(axial, radial), math.hypot(axial, radial) - bearing.groove_distance
                exponent = 1.5
            else:
                angle, delta, exponent = a0, dr_j * math.cos(a0) + dz_j * math.sin(a0), 10 / 9
            q_j = bearing.stiffness_constant * max(delta, 0.0) ** exponent
            radial_load, axial_load = q_j * math.cos(angle), q_j * math.sin(angle)
            moments = [r * axial_load * math.sin(psi), -r * axial_load * math.cos(psi)]
            total += [radial_load * math.cos(psi), radial_load * math.sin(psi), axial_load, *moments]
        return total

    return loads


@pytest.fixture(scope="session")
def mixed_loads() -> Callable[[RollingBearing, np.random.Generator, int], np.ndarray]:
    """Loads of 1 N to 20 kN in every mix of directions (n_case, 5); moments as forces at the pitch radius.

    Some components zero.
    """

    def loads(bearing: RollingBearing, rng: np.random.Generator, n_case: int) -> np.ndarray:
        directions = rng.normal(size=(n_case, 5)) * (rng.random((n_case, 5)) < 0.7)
        directions[:, 2] += 1e-3
        size = 10 ** rng.uniform(0, np.log10(20e3), (n_case, 1))
        scale = np.array([1, 1, 1, bearing.pitch_radius, bearing.pitch_radius])
        mixed: np.ndarray = size * directions / np.linalg.norm(directions, axis=1, keepdims=True) * scale
        return mixed

    return loads
