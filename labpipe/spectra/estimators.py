"""FRF estimators H1, H2, Hv from the cross-spectral matrix. ESTIMATORS and INSTRUMENTS by name.

Frequency is axis 0. S_uu (n_frequency, n_input, n_input), S_yu = E[Y U*] (n_frequency, n_output, n_input),
S_yy (n_frequency, n_output, n_output); the result is (n_frequency, n_output, n_input).

Every estimator solves E[(y_o - H_o u) z_o^H] = 0 for its own instruments z_o = W_o [u; y]. The instruments determine how noise
propagates, so the covariance needs them. INSTRUMENTS gives W (n_frequency, n_output, n_input, n_input + n_output) from the response
and the power of all channels, forces first (n_frequency, n_input + n_output); n_output is 1 where all outputs share them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.spectra.matrices import definite_inverse, hermitian, inverse, product


def h1(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> ComplexArray:  # noqa: ARG001 (one signature for the whole table)
    """H1 = S_yu S_uu^-1, (n_frequency, n_output, n_input) [output unit / N]: unbiased by noise on the outputs.

    Spectra as in the module's docstring [unit^2/Hz]. Raises numpy.linalg.LinAlgError for a singular S_uu. Equation (frf-h1).
    """
    return product(s_yu, definite_inverse(s_uu)[0])


def h2(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> ComplexArray:  # noqa: ARG001
    """H2 = S_yy S_uy^-1, (n_frequency, n_output, n_input) [output unit / N]: unbiased by noise on the forces.

    Spectra as in the module's docstring [unit^2/Hz]. ConfigError unless there are as many outputs as forces; numpy.linalg.LinAlgError
    for a singular S_uy. Equation (frf-h2).
    """
    if s_yu.shape[1] != s_yu.shape[2]:
        raise ConfigError("H2 needs as many responses as forces", hint="use H1 or Hv")
    return product(s_yy, inverse(hermitian(s_yu)))


def hv(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> ComplexArray:
    """Hv, total least squares per output, (n_frequency, n_output, n_input) [output unit / N]: noise on forces and output alike.

    Spectra as in the module's docstring [unit^2/Hz]. Each channel is first divided by its own power at the line, so that the result
    does not depend on units: in metres the unscaled form would collapse to H1. Equation (frf-hv).
    """
    n_input = s_uu.shape[1]
    force_scale = np.sqrt(np.einsum("fii->fi", s_uu).real)
    columns = []
    for output in range(s_yu.shape[1]):
        response_scale = np.sqrt(s_yy[:, output, output].real)[:, None]
        scale = np.concatenate([force_scale, response_scale], axis=1)
        joint = np.empty((s_uu.shape[0], n_input + 1, n_input + 1), np.complex128)
        joint[:, :n_input, :n_input] = s_uu
        joint[:, n_input:, :n_input] = s_yu[:, output : output + 1]
        joint[:, :n_input, n_input:] = hermitian(joint[:, n_input:, :n_input])
        joint[:, n_input, n_input] = s_yy[:, output, output]
        _, vectors = np.linalg.eigh(joint / (scale[:, :, None] * scale[:, None, :]))
        smallest = vectors[:, :, 0] / scale
        columns.append(-smallest[:, :n_input].conj() / smallest[:, n_input:].conj())
    return np.stack(columns, axis=1)


def forces_as_instruments(response: ComplexArray, power: FloatArray) -> ComplexArray:  # noqa: ARG001 (one signature for the table)
    """z = u, the measured forces, for H1: W (n_frequency, 1, n_input, n_input + n_output) [1]."""
    return _chosen_channels(response, 0)


def responses_as_instruments(response: ComplexArray, power: FloatArray) -> ComplexArray:  # noqa: ARG001
    """z = y, the measured outputs, for H2: W (n_frequency, 1, n_input, n_input + n_output) [1]."""
    return _chosen_channels(response, response.shape[2])


def _chosen_channels(response: ComplexArray, first: int) -> ComplexArray:
    """W = [0 I 0], the same at every line and for every output."""
    n_frequency, n_output, n_input = response.shape
    chosen = np.eye(n_input, n_input + n_output, first, dtype=np.complex128)
    return np.broadcast_to(chosen, (n_frequency, 1, *chosen.shape))


def adjusted_forces_as_instruments(response: ComplexArray, power: FloatArray) -> ComplexArray:
    """z = the forces projected onto the plane y = H u in scaled channels, for Hv: W (n_frequency, n_output, n_input, n) [1].

    response (n_frequency, n_output, n_input) [output unit / N], power (n_frequency, n) [unit^2/Hz], n = n_input + n_output. With q the
    normal (-H, 1) of that plane in channels divided by their own power, z = (I - q q^H / q^H q) [u; y]. Equation (frf-hv-instruments).
    """
    n_frequency, n_output, n_input = response.shape
    scale = np.sqrt(power)
    weights = np.zeros((n_frequency, n_output, n_input, n_input + n_output), np.complex128)
    for output in range(n_output):
        columns = [*range(n_input), n_input + output]
        residual = np.concatenate([-response[:, output], np.ones((n_frequency, 1))], axis=1)
        normal = (residual * scale[:, columns]).conj()
        shift = normal[:, :n_input] * scale[:, :n_input] / np.sum(np.abs(normal) ** 2, axis=1)[:, None]
        weights[:, output, :, columns] = np.moveaxis(np.eye(n_input, n_input + 1) - shift[:, :, None] * residual[:, None, :], 2, 0)
    return weights


ESTIMATORS: dict[str, Callable[[ComplexArray, ComplexArray, ComplexArray], ComplexArray]] = {"H1": h1, "H2": h2, "Hv": hv}
INSTRUMENTS: dict[str, Callable[[ComplexArray, FloatArray], ComplexArray]] = {
    "H1": forces_as_instruments,
    "H2": responses_as_instruments,
    "Hv": adjusted_forces_as_instruments,
}
