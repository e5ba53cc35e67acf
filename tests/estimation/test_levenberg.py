"""Levenberg-Marquardt on test functions of More, Garbow and Hillstrom (1981, ACM TOMS 7:17), and against the
full normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.estimation.descent import minimise, scaled_triangle, sum_of_squares


@dataclass
class Rosenbrock:
    """Test function 1: r = (10 (x2 - x1^2), 1 - x1), from (-1.2, 1) to the minimum 0 at (1, 1).

    Counts its Jacobians.
    """

    size: float = 1.0
    jacobians: list[FloatArray] = field(default_factory=list)

    def residual(self, parameters: FloatArray) -> FloatArray:
        x, y = parameters
        return np.array([10 * (y - x**2), 1 - x])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        self.jacobians.append(parameters)
        return np.array([[-20 * parameters[0], 10.0], [-1.0, 0.0]])

    def chi2(self, parameters: FloatArray) -> float:
        return sum_of_squares(self.residual, parameters)


@dataclass
class KowalikOsborne(Rosenbrock):
    """Test function 15: 11 residuals of y = x1 (u^2 + u x2) / (u^2 + u x3 + x4); minimum 3.07505e-4."""

    Y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
    U = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])

    def residual(self, parameters: FloatArray) -> FloatArray:
        a, b, c, d = parameters
        return self.Y - a * (self.U**2 + self.U * b) / (self.U**2 + self.U * c + d)

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        self.jacobians.append(parameters)
        a, b, c, d = parameters
        above, below = self.U**2 + self.U * b, self.U**2 + self.U * c + d
        return -np.stack(
            [above / below, a * self.U / below, -a * above * self.U / below**2, -a * above / below**2], axis=1
        )


def test_rosenbrock_reaches_its_minimum() -> None:
    minimum = minimise(Rosenbrock(), np.array([-1.2, 1.0]))
    assert minimum.converged
    np.testing.assert_allclose(minimum.values, [1.0, 1.0], rtol=1e-9)


def test_kowalik_and_osborne_reaches_the_printed_minimum() -> None:
    problem = KowalikOsborne()
    minimum = minimise(problem, np.array([0.25, 0.39, 0.415, 0.39]))
    assert minimum.converged
    assert problem.chi2(minimum.values) == pytest.approx(3.07505e-4, rel=2e-6)


def test_a_step_solves_the_damped_normal_equations() -> None:
    problem, start = KowalikOsborne(), np.array([0.2, 0.2, 0.12, 0.14])
    taken = minimise(problem, start, most_steps=1).values - start
    jacobian, residual = problem.jacobian(start), problem.residual(start)
    products = jacobian.T @ jacobian
    # The first damping of the descent, 1e-3, on columns of length 1 (Marquardt 1963).
    step = np.linalg.solve(products + 1e-3 * np.diag(np.diag(products)), -jacobian.T @ residual)
    np.testing.assert_allclose(taken, step, rtol=1e-6)


def test_the_number_of_steps_is_bounded() -> None:
    problem = Rosenbrock()
    minimum = minimise(problem, np.array([-1.2, 1.0]), most_steps=5)
    assert (minimum.converged, minimum.steps, len(problem.jacobians)) == (False, 5, 5)


def test_derivatives_whose_squares_are_no_numbers_are_refused() -> None:
    """1e160, squared, is beyond 1.8e308: it ended in a matrix without singular values."""
    with pytest.raises(FitError, match="too far off to compute with"):
        scaled_triangle(np.array([[1e160, 0.0], [1e160, 1.0]]))
