"""Drift: what changed between the two halves of a record, told by the shape that the change of the FRF has.

To first order a changed parameter changes H by dH/dp, a changed gain by its own row or column of H. The change of H is projected on
these shapes, whitened with the noise of H, whose own level between all lines is the measure of chance: so it does not matter how well
the covariance is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import change_text, difference_in, shown_unit
from labpipe.distributions import f_tail
from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import FittedModel
from labpipe.identify.weights import has_noise, whitened, whitener
from labpipe.records.finding import Finding

# A pipeline holds many fits of many tests, and a drift that matters is far beyond chance.
DRIFT_P = 1e-3
# Singular values of shapes of length 1 below which they are one shape: a common gain of all outputs is that of all forces.
SAME_SHAPE = 1e-8
KINDS = {"N/m": "all stiffness", "N.s/m": "all damping"}


@dataclass(frozen=True)
class _Shape:
    """A change of H by 100 % of something, whitened (n_equation,) [1], and its name."""

    name: str
    values: FloatArray


@dataclass(frozen=True)
class _Chance:
    """Variance of a projection on a smooth shape by noise alone [1], and the degrees of freedom that this rests on."""

    variance: float
    dof: float

    def p_value(self, square: float, n: int) -> float:
        """Chance of a projection on *n* dimensions with so large a *square*."""
        return f_tail(square / (n * self.variance), n, self.dof)


def drift_findings(measured: Measured, model: FittedModel, values: FloatArray, n_band: int = 1) -> list[Finding]:
    """A finding where the halves of the record differ by more than noise; *values* (n_parameter,) [parameter units] of the fit.

    Shapes: the gain of every channel, all stiffness or all damping by one factor, each by itself, and all parameters together; p-values
    are for the best of all, in *n_band* bands of one record (Bonferroni). None where the halves or the noise are not known.
    Equation (est-drift).
    """
    if measured.change is None or not has_noise(measured):
        return []
    try:
        whiten = whitener(measured)
        jacobian = whitened(whiten, model.jacobian(values, measured.omega))
        fitted = measured.plus_offset(model.receptance(values, measured.omega))
    except FitError:
        return []
    change = whitened(whiten, measured.change)
    shapes = [*_kinds(jacobian, model, values), *_gains(measured, whiten, fitted)]
    chance = _chance(change, np.vstack([jacobian, *(shape.values for shape in shapes)]), measured)
    if chance is None:
        return []
    tests = [(chance.p_value(_along(change, shape.values) ** 2, 1), shape) for shape in shapes]
    best, shape = min(tests, key=lambda entry: entry[0])
    basis = _basis(jacobian)
    together = chance.p_value(float(np.sum((basis @ change) ** 2)), basis.shape[0])
    p_value = min(1.0, min(best, together) * (len(tests) + 1) * n_band)
    if p_value >= DRIFT_P:
        return []
    said = _of_shape(shape, change, chance) if best <= together else _of_parameters(jacobian, model, values, change, chance)
    message = (
        f"the second half of the record differs from the first (p = {p_value:.2g}): {said}. An even drift is twice that from the "
        "beginning to the end. The parameters are those of no moment of the record, and their standard errors do not hold. Wait until "
        "temperature and amplifiers have settled, or record in shorter pieces"
    )
    return [Finding("drift", message)]


def _kinds(jacobian: FloatArray, model: FittedModel, values: FloatArray) -> list[_Shape]:
    """All stiffness, all damping coefficients by one factor."""
    shapes = []
    for unit, name in KINDS.items():
        chosen = [number for number, other in enumerate(model.units) if other == unit and values[number] != 0]
        if chosen:
            shapes.append(_Shape(name, values[chosen] @ jacobian[chosen]))
    return shapes


def _gains(measured: Measured, whiten: np.ndarray, fitted: np.ndarray) -> list[_Shape]:
    """The gain of every channel; of a single force and a single response only the one of both."""
    outputs, inputs = ([port.channel for port in ports] for ports in (measured.outputs, measured.inputs))
    if len(outputs) == len(inputs) == 1:
        return [_Shape(f"the gain of {outputs[0]} or {inputs[0]}", whitened(whiten, fitted))]
    rows, columns = np.eye(len(outputs))[:, None, :, None], np.eye(len(inputs))[:, None, None, :]
    masks = [*zip(outputs, rows, strict=True), *zip(inputs, columns, strict=True)]
    return [_Shape(f"the gain of {name}", whitened(whiten, fitted * mask)) for name, mask in masks]


def _basis(shapes: FloatArray) -> FloatArray:
    """Orthonormal rows (rank, n_equation) that span *shapes* (n_shape, n_equation)."""
    lengths = np.linalg.norm(shapes, axis=1)
    _, singular, rows = np.linalg.svd(shapes[lengths > 0] / lengths[lengths > 0, None], full_matrices=False)
    return np.asarray(rows[singular > SAME_SHAPE * singular[0]])


def _chance(change: FloatArray, shapes: FloatArray, measured: Measured) -> _Chance | None:
    """From what no shape explains; lines that share noise make smooth projections larger and leave fewer degrees of freedom."""
    basis = _basis(shapes)
    rest = change - (basis @ change) @ basis
    dof = change.size - basis.shape[0]
    square = float(rest @ rest)
    if dof < 1 or square == 0:
        return None
    return _Chance(measured.shared_noise * square / dof, dof / measured.shared_power)


def _along(change: FloatArray, shape: FloatArray) -> float:
    """Length of the change along a shape [1]."""
    length = float(np.linalg.norm(shape))
    return float(change @ shape) / length if length > 0 else 0.0


def _of_shape(shape: _Shape, change: FloatArray, chance: _Chance) -> str:
    length = float(np.linalg.norm(shape.values))
    amount, error = _along(change, shape.values) / length, np.sqrt(chance.variance) / length
    return f"it looks like {shape.name} changed by {change_text(100 * amount, 100 * error, '%')}"


def _of_parameters(jacobian: FloatArray, model: FittedModel, values: FloatArray, change: FloatArray, chance: _Chance) -> str:
    """The parameter that changed most, in standard errors."""
    inverse = np.linalg.pinv(jacobian @ jacobian.T)
    changes = inverse @ (jacobian @ change)
    errors = np.sqrt(chance.variance * np.maximum(np.diag(inverse), np.finfo(float).tiny))
    n = int(np.argmax(np.abs(changes) / errors))
    share = f" ({100 * changes[n] / values[n]:+.2g} %)" if values[n] else ""
    unit = shown_unit(model.units[n], changes[n], errors[n])
    by = change_text(difference_in(changes[n], unit), difference_in(errors[n], unit), unit)
    return f"its parameters changed, most of all {model.names[n]} by {by}{share}"
