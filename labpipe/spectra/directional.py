"""Forward and backward: the directional frequency response (dFRF) of a rotor measured in two directions."""

from __future__ import annotations

import dataclasses

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.matrices import without_rounding

# [x, y] = A [f, b]: forward turns from x to y, backward the other way.
FROM_DIRECTIONAL = np.array([[1, 1], [-1j, 1j]])
FORWARD_BACKWARD = ("f", "b")
# Smallest sine of the angle between two directions that span a plane.
SMALLEST_ANGLE = 1e-3


def directional(response: FrequencyResponse) -> FrequencyResponse:
    """The dFRF H_d = A^-1 H A = [[H_ff, H_fb], [H_bf, H_bb]], A = [[1, 1], [-j, j]], with its covariance (Mendes et al.).

    Rows and columns are labelled f and b. The two outputs and the two forces may point in any two known directions; they are
    transformed to x and y first. An isotropic rotor has H_fb = H_bf = 0. Coherence and distortion are dropped. Raises DataError
    unless there are two outputs and two forces in known, different directions. Equation (frf-directional).
    """
    to_xy = np.linalg.inv(directions(response.outputs, "responses"))
    from_xy = np.linalg.inv(directions(response.inputs, "forces").T)
    from_left = np.linalg.inv(FROM_DIRECTIONAL) @ to_xy
    from_right = from_xy @ FROM_DIRECTIONAL
    # vec(L H R) = (L kron R^T) vec(H) in row-major order.
    turn = np.kron(from_left, from_right.T)
    covariance = None if response.covariance is None else without_rounding(turn @ response.covariance @ turn.conj().T)
    ports = tuple(Port(label, label, label) for label in FORWARD_BACKWARD)
    return dataclasses.replace(
        response,
        matrix=from_left @ response.matrix @ from_right,
        covariance=covariance,
        change=None if response.change is None else from_left @ response.change @ from_right,
        errors=tuple(dataclasses.replace(error, change=from_left @ error.change @ from_right) for error in response.errors),
        open_loop=None if response.open_loop is None else from_left @ response.open_loop @ from_right,
        outputs=ports,
        inputs=ports,
        coherence=None,
        multiple_coherence=None,
        partial_coherence=None,
        distortion=None,
        snr=None,
        line_gains=None,
        snr_channels=(),
    )


def directions(ports: tuple[Port, ...], what: str) -> FloatArray:
    """Rows (cos, sin) of the directions of two ports, (2, 2) [1]; DataError unless there are two known directions that differ."""
    angles = [port.angle for port in ports if port.angle is not None]
    if len(ports) != 2 or len(angles) != 2:
        named = ", ".join(port.label for port in ports)
        hint = "give dof: x, dof: y or an angle in the rig file"
        raise DataError(f"forward and backward terms need two {what} in known directions, found {named}", hint=hint)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    if abs(np.linalg.det(directions)) < SMALLEST_ANGLE:
        raise DataError(f"the two {what} {ports[0].label} and {ports[1].label} stand in one direction")
    return directions


def two_sided(response: FrequencyResponse) -> tuple[FloatArray, ComplexArray]:
    """Frequency from -f_max to f_max [Hz], (2 n,), and H_ff and H_fb over it, (2 n, 2) [unit of the response].

    Of a real system H_ff(-w) = conj H_bb(w) and H_fb(-w) = conj H_bf(w) (Lee, Vibration Analysis of Rotors, 1993): the backward
    row is the forward row at negative frequencies. A line at 0 Hz appears twice, as -0 and 0. DataError for a response that is not
    directional. Equation (frf-two-sided).
    """
    labels = tuple(port.label for port in (*response.outputs, *response.inputs))
    if labels != (*FORWARD_BACKWARD, *FORWARD_BACKWARD):
        raise DataError("a two-sided view needs forward and backward terms", hint="directional: true")
    negative = response.matrix[::-1, 1, ::-1].conj()
    return np.concatenate([-response.frequency[::-1], response.frequency]), np.concatenate([negative, response.matrix[:, 0]])
