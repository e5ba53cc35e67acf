"""Receptance, mobility, accelerance and dynamic stiffness; forward and backward responses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.matrices import without_rounding

DERIVATIVES = {"receptance": 0, "mobility": 1, "accelerance": 2}
# Motion over motion of a base.
TRANSMISSIBILITY = "transmissibility"


def receptance_factor(form: str, frequency: FloatArray) -> ComplexArray:
    """Factor (j w)^n from receptance to *form*, (n_frequency,) [1/s^n], at *frequency* (n_frequency,) [Hz].
    ConfigError for a form other than receptance, mobility and accelerance.
    """
    if form not in DERIVATIVES:
        hint = (
            "model: base; or where the mass is known a force by a channel under derived: in the rig file, "
            "{f: {sum: {a: 1500 kg}, quantity: force, dof: x}}"
            if form == TRANSMISSIBILITY
            else "displacement, velocity or acceleration per force; a moment and an angle at an arm of "
            "1 m, by channels under derived: in the rig file, {f: {sum: {M: 1 1/m}, quantity: force, dof: x}}"
        )
        raise ConfigError(f"a response of the form '{form}' cannot be identified", hint=hint)
    factor: ComplexArray = (2j * np.pi * frequency) ** DERIVATIVES[form]
    return factor


@dataclass(frozen=True)
class FormView:
    """How a measured *form* is seen as the receptance of a model: H = (measured - *offset*) / factor, offset
    [1] of a transmissibility.
    """

    form: str
    offset: float = 0.0

    def factor(self, frequency: FloatArray) -> ComplexArray:
        """(j w)^n of a response to a force, w^2 of a transmissibility, (n_line,) [1/s^n], at *frequency*
        (n_line,) [Hz].
        """
        if self.form == TRANSMISSIBILITY:
            return np.asarray((2 * np.pi * frequency) ** 2, np.complex128)
        return receptance_factor(self.form, frequency)


def convert(response: FrequencyResponse, form: str) -> FrequencyResponse:
    """The response as *form*: H' = (j w)^n H, cov' = w^2n cov, n time derivatives between the two forms.
    Raises ConfigError for a form other than receptance, mobility and accelerance, DataError for a line at 0
    Hz that would have to be integrated. Equation (frf-form).
    """
    order = DERIVATIVES.get(form, 0) - DERIVATIVES.get(response.form, 0)
    for name in (form, response.form):
        receptance_factor(name, response.frequency[:0])
    if order < 0 and response.frequency[0] == 0:
        what = f"the line at 0 Hz of a {response.form} cannot be converted to {form}"
        raise DataError(what, hint="begin the band above 0 Hz")
    factor = ((2j * np.pi * response.frequency) ** order)[:, None, None]
    covariance, distortion = response.covariance, response.distortion
    return replace(
        _with_each(response, lambda values: values * factor),
        covariance=None if covariance is None else covariance * np.abs(factor) ** 2,
        distortion=None if distortion is None else distortion * np.abs(factor),
        form=form,
    )


def _with_each(
    response: FrequencyResponse, turn: Callable[[ComplexArray], ComplexArray]
) -> FrequencyResponse:
    beside = {name: getattr(response, name) for name in ("change", "open_loop", "repeats")}
    turned: dict[str, Any] = {name: None if part is None else turn(part) for name, part in beside.items()}
    return replace(
        response,
        matrix=turn(response.matrix),
        errors=tuple(error.turn(turn) for error in response.errors),
        **turned,
    )


# [x, y] = A [f, b]: forward turns from x to y, backward the other way.
FROM_DIRECTIONAL = np.array([[1, 1], [-1j, 1j]])
FORWARD_BACKWARD = ("f", "b")
# What is known of single elements, or of single channels, alone.
OF_ELEMENTS = ("coherence", "multiple_coherence", "partial_coherence", "distortion", "snr", "line_gains")
# Smallest sine of the angle between two directions that span a plane.
SMALLEST_ANGLE = 1e-3


def directional(response: FrequencyResponse) -> FrequencyResponse:
    """The dFRF H_d = A^-1 H A = [[H_ff, H_fb], [H_bf, H_bb]], A = [[1, 1], [-j, j]], with its covariance
    (Mendes et al.). Outputs and forces may point in any two known directions each. Coherence and distortion
    are dropped. DataError unless there are two outputs and two forces in known, different directions.
    Equation (frf-directional).
    """
    to_xy = np.linalg.inv(directions(response.outputs, "responses"))
    from_xy = np.linalg.inv(directions(response.inputs, "forces").T)
    from_left = np.linalg.inv(FROM_DIRECTIONAL) @ to_xy
    from_right = from_xy @ FROM_DIRECTIONAL
    # vec(L H R) = (L kron R^T) vec(H) in row-major order.
    turn = np.kron(from_left, from_right.T)
    covariance = (
        None if response.covariance is None else without_rounding(turn @ response.covariance @ turn.conj().T)
    )
    ports = tuple(Port(label, label, label) for label in FORWARD_BACKWARD)
    nothing: dict[str, Any] = dict.fromkeys(OF_ELEMENTS)
    return replace(
        _with_each(response, lambda values: from_left @ values @ from_right),
        covariance=covariance,
        outputs=ports,
        inputs=ports,
        blocks=response.blocks and replace(response.blocks, by_force=(), apart=False),
        snr_channels=(),
        **nothing,
    )


def is_directional(response: FrequencyResponse) -> bool:
    """Whether a response is a dFRF, from forces forward and backward to motions forward and backward."""
    return tuple(port.label for port in (*response.outputs, *response.inputs)) == 2 * FORWARD_BACKWARD


def directions(ports: tuple[Port, ...], what: str) -> FloatArray:
    """Rows (cos, sin) of the directions of two ports, (2, 2) [1]. DataError unless there are two known
    directions that differ.
    """
    angles = [port.angle for port in ports if port.angle is not None]
    if len(ports) != 2 or len(angles) != 2:
        named = ", ".join(port.label for port in ports)
        hint = "give dof: x, dof: y or an angle in the rig file"
        raise DataError(
            f"forward and backward terms need two {what} in known directions, found {named}", hint=hint
        )
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    if abs(np.linalg.det(directions)) < SMALLEST_ANGLE:
        raise DataError(f"the two {what} {ports[0].label} and {ports[1].label} stand in one direction")
    return directions


def two_sided_response(response: FrequencyResponse) -> tuple[FloatArray, ComplexArray]:
    """Frequency from -f_max to f_max [Hz], (2 n,), and H_ff and H_fb over it, (2 n, 2) [unit of the
    response]. Of a real system H_ff(-w) = conj H_bb(w) and H_fb(-w) = conj H_bf(w) (Lee, Vibration Analysis
    of Rotors, 1993). DataError for a response that is not directional. Equation (frf-two-sided).
    """
    if not is_directional(response):
        raise DataError("a two-sided view needs forward and backward terms", hint="directional: true")
    negative = response.matrix[::-1, 1, ::-1].conj()
    return np.concatenate([-response.frequency[::-1], response.frequency]), np.concatenate(
        [negative, response.matrix[:, 0]]
    )
