"""Conversion of receptance, mobility and accelerance: one factor j w per time derivative; dynamic stiffness is the matrix inverse."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.matrices import hermitian, without_rounding

DERIVATIVES = {"receptance": 0, "mobility": 1, "accelerance": 2}
# Motion over motion of a base.
TRANSMISSIBILITY = "transmissibility"


def receptance_factor(form: str, frequency: FloatArray) -> ComplexArray:
    """Factor (j w)^n from receptance to *form*, (n_frequency,) [1/s^n], at *frequency* (n_frequency,) [Hz].

    ConfigError for a form other than receptance, mobility and accelerance.
    """
    if form not in DERIVATIVES:
        hint = "model: base" if form == TRANSMISSIBILITY else "displacement, velocity or acceleration per force"
        raise ConfigError(f"a response of the form '{form}' cannot be identified so", hint=hint)
    factor: ComplexArray = (2j * np.pi * frequency) ** DERIVATIVES[form]
    return factor


@dataclass(frozen=True)
class FormView:
    """How a measured *form* is seen as the receptance of a model: H = (measured - *offset*) / factor, offset [1] of a transmissibility."""

    form: str
    offset: float = 0.0

    def factor(self, frequency: FloatArray) -> ComplexArray:
        """(j w)^n of a response to a force, w^2 of a transmissibility, (n_line,) [1/s^n], at *frequency* (n_line,) [Hz]."""
        if self.form == TRANSMISSIBILITY:
            return np.asarray((2 * np.pi * frequency) ** 2, np.complex128)
        return receptance_factor(self.form, frequency)


def converted(response: FrequencyResponse, form: str) -> FrequencyResponse:
    """The response as *form*: H' = (j w)^n H, cov' = w^2n cov, n time derivatives between the two forms.

    Coherence and signal-to-noise ratio do not change. Raises ConfigError for a form other than receptance, mobility and accelerance,
    DataError for a line at 0 Hz that would have to be integrated. Equation (frf-form).
    """
    order = DERIVATIVES.get(form, 0) - DERIVATIVES.get(response.form, 0)
    for name in (form, response.form):
        receptance_factor(name, response.frequency[:0])
    if order < 0 and response.frequency[0] == 0:
        raise DataError(f"the line at 0 Hz of a {response.form} cannot be converted to {form}", hint="begin the band above 0 Hz")
    factor = (2j * np.pi * response.frequency) ** order
    covariance = response.covariance
    if covariance is not None:
        covariance = covariance * (np.abs(factor) ** 2)[:, None, None]
    change = None if response.change is None else response.change * factor[:, None, None]
    errors = tuple(dataclasses.replace(error, change=error.change * factor[:, None, None]) for error in response.errors)
    open_loop = None if response.open_loop is None else response.open_loop * factor[:, None, None]
    matrix = response.matrix * factor[:, None, None]
    return dataclasses.replace(response, matrix=matrix, covariance=covariance, change=change, open_loop=open_loop, errors=errors, form=form)


def dynamic_stiffness(response: FrequencyResponse) -> ComplexArray:
    """Z = H^-1 [N/m], the matrix inverse of the receptance, (n_frequency, n_input, n_output).

    Raises DataError when there are not as many forces as outputs, or when the matrix is singular at a line. Equation (frf-stiffness).
    """
    n_output, n_input = response.matrix.shape[1:]
    if n_output != n_input:
        hint = "as many forces as responses are needed"
        raise DataError(f"{n_output} responses to {n_input} forces have no dynamic stiffness", hint=hint)
    receptance = converted(response, "receptance")
    try:
        return np.linalg.inv(receptance.matrix)
    except np.linalg.LinAlgError:
        raise DataError("the FRF matrix is singular at a line, so it has no dynamic stiffness") from None


def dynamic_stiffness_covariance(response: FrequencyResponse) -> ComplexArray | None:
    """Covariance of vec(Z), row-major, (n_frequency, n, n) [(N/m)^2]: dZ = -Z dH Z, so cov = T cov_H T^H with T = Z kron Z^T.

    First order in the errors of H; None for a response without covariance. Raises as dynamic_stiffness does.
    Equation (frf-stiffness-covariance).
    """
    stiffness = dynamic_stiffness(response)
    if response.covariance is None:
        return None
    covariance = converted(response, "receptance").covariance
    assert covariance is not None
    n = stiffness.shape[1]
    turn = np.einsum("fab,fcd->fadbc", stiffness, stiffness).reshape(-1, n * n, n * n)
    return without_rounding(turn @ covariance @ hermitian(turn))
