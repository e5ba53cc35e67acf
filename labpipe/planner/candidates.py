"""Candidates of a design: one line, one direction of force each, with what they tell at unit cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.planner.information import Noise, sensitivities, vector_information
from labpipe.planner.model import PlannedModel


@dataclass(frozen=True)
class Candidates:
    """Single lines with a direction of force each.

    line (n_candidate,): index of the line; direction (n_candidate, n_dof) [1]; cost (n_candidate,) [1]: of a mean square of 1 N^2, unit
    force power by default; information (n_candidate, n_coefficient, n_coefficient) [1/s] at unit cost, of relative coefficients.
    """

    line: IntArray
    direction: ComplexArray
    cost: FloatArray
    information: FloatArray

    def power(self, shares: FloatArray) -> FloatArray:
        """Mean square forces (n_candidate,) [N^2] of cost *shares* (n_candidate,) [1] of a cost of 1."""
        return np.asarray(shares / self.cost)


def candidates(
    model: PlannedModel,
    noise: Noise,
    omega: FloatArray,
    directions: ComplexArray,
    displacement_share: float = 0.0,
    stroke: float = 1.0,
) -> Candidates:
    """All *directions* (n_direction, n_dof) [1] on all lines omega (n_line,) [rad/s].

    A mean square of 1 N^2 costs (1 - a) + a |H u|^2 / stroke^2, a = *displacement_share* [1], *stroke* [m/N]: the limit of displacement
    over that of force. Equation (plan-cost).
    """
    sensitivity = sensitivities(model, noise, omega)
    receptance = model.receptance(omega)
    line = np.repeat(np.arange(omega.size), len(directions))
    direction = np.tile(directions, (omega.size, 1))
    motion = np.einsum("lij,lj->li", receptance[line], direction)
    cost = (1 - displacement_share) + displacement_share * np.sum(np.abs(motion) ** 2, axis=1) / stroke**2
    # A mean square of 1 N^2 is an amplitude of sqrt(2) N.
    information = 2 * vector_information(sensitivity[line], direction) / cost[:, None, None]
    return Candidates(line, direction, cost, information)
