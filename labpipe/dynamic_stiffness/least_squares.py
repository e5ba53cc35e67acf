"""ls: as the literature does it, Re H on (1, -w^2) and Im H on w element by element, with H of every line from two runs.

All lines weigh alike and the noise of the motion is not regarded, so that its errors are larger than need be and its intervals, from the
residual, are those of noise that is the same at all lines. For comparison with published results; `ml` is the better estimate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.dynamic_stiffness.estimate import Estimate
from labpipe.dynamic_stiffness.forms import StiffnessModel
from labpipe.dynamic_stiffness.likelihood import Balance
from labpipe.dynamic_stiffness.lines import LineStiffness, line_stiffness
from labpipe.errors import ConfigError, FitError
from labpipe.identify.regression import triangle_of

# Functions of the real and of the imaginary part of H, by form.
REAL_PARTS = {"kc": 1, "kcm": 2}


def least_squares(balance: Balance, model: StiffnessModel) -> tuple[Estimate, Callable[[ComplexArray], FloatArray]]:
    """The estimate, and how it responds to changes of e (n, n_line, n_run, 2) [N]: (n, n_parameter) [parameter units].

    ConfigError for other forms than kc and kcm, FitError where runs do not give H. Equation (ds-ls).
    """
    if model.form.name not in REAL_PARTS or model.symmetry == "seal":
        raise ConfigError("least squares is for form kc or kcm without symmetry", hint="estimator: ml", field="estimator")
    lines = line_stiffness(balance)
    designs = _designs(model, lines.omega)
    for design in designs:
        if design.shape[0] <= design.shape[1]:
            raise FitError(f"{design.shape[0]} lines cannot determine the coefficients", hint="widen the band")
    values, variance = _solved(model, lines.stiffness, designs)
    covariance = np.zeros((values.size, values.size))
    n_element = model.elements.shape[0]
    numbers = np.arange(values.size).reshape(-1, n_element)
    for part, design in enumerate(designs):
        inverse = np.linalg.inv(design.T @ design)
        rows = numbers[_rows_of(model, part)]
        for element in range(n_element):
            covariance[np.ix_(rows[:, element], rows[:, element])] = variance[part, element] * inverse
    dof = 2 * n_element * lines.omega.size - values.size
    columns = model.jacobian(values, lines.omega).reshape(values.size, -1)
    design = triangle_of(np.concatenate([columns.real, columns.imag], axis=1).T)
    estimate = Estimate(model, values, covariance, float("nan"), dof, float("nan"), True, 0, design)
    return estimate, _response(model, lines, designs)


def _rows_of(model: StiffnessModel, part: int) -> list[int]:
    """Numbers of the matrices that the real (0) or imaginary part (1) of H tells: K and M, or C."""
    return [1] if part else [number for number in range(len(model.form.matrices)) if number != 1]


def _designs(model: StiffnessModel, omega: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Functions of the real and of the imaginary part, (n_line, n) [1, 1/s, 1/s^2]."""
    basis = model.form.basis(np.empty(0), omega)
    return basis[_rows_of(model, 0)].real.T, basis[_rows_of(model, 1)].imag.T


def _elements(model: StiffnessModel, stiffness: ComplexArray) -> ComplexArray:
    """(..., n_line, n_element) [N/m] of H (..., n_line, 2, 2)."""
    return np.einsum("...ij,cij->...c", stiffness, model.elements)


def _solved(model: StiffnessModel, stiffness: ComplexArray, designs: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Values (n_parameter,) and the variance of the residual (2, n_element) [(N/m)^2] of real and imaginary part."""
    measured = _elements(model, stiffness)
    solution = np.empty((len(model.form.matrices), measured.shape[-1]))
    variance = np.empty((2, measured.shape[-1]))
    for part, (design, side) in enumerate(zip(designs, (measured.real, measured.imag), strict=True)):
        coefficients = np.linalg.pinv(design) @ side
        solution[_rows_of(model, part)] = coefficients
        variance[part] = np.sum((side - design @ coefficients) ** 2, axis=0) / (design.shape[0] - design.shape[1])
    return solution.reshape(-1), variance


def _response(model: StiffnessModel, lines: LineStiffness, designs: tuple[FloatArray, FloatArray]) -> Callable[[ComplexArray], FloatArray]:
    def respond(errors: ComplexArray) -> FloatArray:
        return np.stack([_solved(model, error.swapaxes(-1, -2) @ lines.inverse, designs)[0] for error in errors])

    return respond
