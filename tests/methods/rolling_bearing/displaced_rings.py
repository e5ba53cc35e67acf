"""Loads and stiffness of a rolling bearing at given displacements."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import FloatArray
from labpipe.methods.rolling_bearing import loads


def bearing_loads(bearing: loads.RollingBearing, q: ArrayLike, cage_angle: ArrayLike = 0.0) -> FloatArray:
    """Loads (Fx, Fy, Fz [N], Mx, My [N m]) on the inner ring at displacements *q* (n_case, 5) [m, rad]."""
    return loads.load_sum(*_contacts(bearing, q, cage_angle))


def bearing_stiffness(bearing: loads.RollingBearing, q: ArrayLike, cage_angle: ArrayLike = 0.0) -> FloatArray:
    """K = d(loads)/dq at displacements *q* (n_case, 5) [m, rad]: (n_case, 5, 5) [N/m, N/rad, N m/rad]."""
    return loads.stiffness_sum(*_contacts(bearing, q, cage_angle))


def _contacts(
    bearing: loads.RollingBearing, q: ArrayLike, cage_angle: ArrayLike
) -> tuple[loads.Contacts, loads.ElementFrame]:
    displacement = np.atleast_2d(np.asarray(q, np.float64))
    frame = loads.ElementFrame.at(bearing.angles(cage_angle), bearing.pitch_radius)
    return loads.contacts(bearing, displacement, frame), frame


def load_vector(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, mx: float = 0.0, my: float = 0.0
) -> FloatArray:
    """(Fx, Fy, Fz, Mx, My), (5,) [N, N m]."""
    return np.array([x, y, z, mx, my], np.float64)
