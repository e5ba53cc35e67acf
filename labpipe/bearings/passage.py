"""Ball passage: variation of a rolling bearing's stiffness while its cage turns by one element."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import FloatArray
from labpipe.bearings.rolling import DOFS, RollingBearing
from labpipe.bearings.rolling_equilibrium import equilibrium

POSITIONS = 24


@dataclass(frozen=True)
class Passage:
    """Stiffness (n_position, n_case, 5, 5) [N/m, N/rad, N m/rad] and displacement (n_position, n_case, 5) [m, rad] over one passage.

    cage_angle (n_position,) [rad]: equal steps over 2 pi / z without the end point, so that the mean over positions is the mean over time.
    """

    cage_angle: FloatArray
    stiffness: FloatArray
    displacement: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Mean stiffness, (n_case, 5, 5) [N/m, N/rad, N m/rad]."""
        mean: FloatArray = self.stiffness.mean(axis=0)
        return mean

    @property
    def lowest(self) -> FloatArray:
        """Smallest value of each coefficient, (n_case, 5, 5) [N/m, N/rad, N m/rad]."""
        lowest: FloatArray = self.stiffness.min(axis=0)
        return lowest

    @property
    def highest(self) -> FloatArray:
        """Largest value of each coefficient, (n_case, 5, 5) [N/m, N/rad, N m/rad]."""
        highest: FloatArray = self.stiffness.max(axis=0)
        return highest


def ball_passage(
    bearing: RollingBearing,
    loads: ArrayLike,
    displacements: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    fixed_dofs: Sequence[str] = (),
    positions: int = POSITIONS,
) -> Passage:
    """Equilibrium and stiffness at *positions* cage angles of one passage; arguments and errors as in `equilibrium`.

    Equation (roll-passage).
    """
    f, q = (np.atleast_2d(np.asarray(values, np.float64)) for values in (loads, displacements))
    n_case = max(len(f), len(q))
    angles = 2 * np.pi / bearing.elements * np.arange(positions) / positions
    cases = [np.tile(np.broadcast_to(values, (n_case, values.shape[-1])), (positions, 1)) for values in (f, q)]
    state = equilibrium(bearing, cases[0], cases[1], fixed_dofs, np.repeat(angles, n_case))
    n = len(DOFS)
    return Passage(angles, state.stiffness.reshape(positions, n_case, n, n), state.displacement.reshape(positions, n_case, n))
