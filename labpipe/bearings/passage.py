"""One ball passage: how the stiffness of a rolling bearing changes while its cage turns by one element."""

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

    cage_angle (n_position,) [rad]: equal steps over 2 pi / z, the end left out, so that the mean over positions is the mean over time.
    """

    cage_angle: FloatArray
    stiffness: FloatArray
    displacement: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Mean stiffness, (n_case, 5, 5)."""
        mean: FloatArray = self.stiffness.mean(axis=0)
        return mean

    @property
    def lowest(self) -> FloatArray:
        """The smallest value of each coefficient, (n_case, 5, 5)."""
        lowest: FloatArray = self.stiffness.min(axis=0)
        return lowest

    @property
    def highest(self) -> FloatArray:
        """The largest value of each coefficient, (n_case, 5, 5)."""
        highest: FloatArray = self.stiffness.max(axis=0)
        return highest


def ball_passage(
    bearing: RollingBearing,
    loads: ArrayLike,
    displacements: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    held: Sequence[str] = (),
    positions: int = POSITIONS,
) -> Passage:
    """Rest position and stiffness at *positions* cage angles of one passage; arguments and errors as in `equilibrium`."""
    f, q = (np.atleast_2d(np.asarray(each, np.float64)) for each in (loads, displacements))
    n_case = max(len(f), len(q))
    angles = 2 * np.pi / bearing.elements * np.arange(positions) / positions
    cases = [np.tile(np.broadcast_to(each, (n_case, each.shape[-1])), (positions, 1)) for each in (f, q)]
    state = equilibrium(bearing, cases[0], cases[1], held, np.repeat(angles, n_case))
    n = len(DOFS)
    return Passage(angles, state.stiffness.reshape(positions, n_case, n, n), state.displacement.reshape(positions, n_case, n))
