"""Sensitivity of one loop or of several that are coupled, line by line from both sides of the sums where
excitation is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import normal_quantile, student_quantile
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.measured import chosen_ports
from labpipe.methods.magnetic_bearing.loop_problem import merged, response_errors
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import MatrixError, Uncertainty

# Condition number of the injections of all runs beyond which they are one.
ONE_INJECTION = 1e6


def per_injection(spectra: ChannelSpectra) -> FrequencyResponse:
    """H = Y R^-1 of the runs, Y the channels of role output and R those of role input, dH = (dY - H dR) R^-1.

    Uncertainties of channels and of sums go the same way, but for directions that no other channel tells,
    which stay at their ports. ConfigError where there is not one run per injection, or where the runs do not
    tell them apart. Equation (comp-injection).
    """
    inputs, outputs = (
        [n for n, channel in enumerate(spectra.channels) if channel.role == role]
        for role in ("input", "output")
    )
    if len(spectra.runs) != len(inputs):
        hint = "one recording per injection, the injections alone with role: input"
        raise ConfigError(f"{len(spectra.runs)} run(s) for {len(inputs)} injection(s)", hint=hint)
    injected = spectra.vectors[:, :, inputs].swapaxes(1, 2)
    if np.any(np.linalg.cond(injected) > ONE_INJECTION):
        raise ConfigError(
            "the runs do not tell the injections apart", hint="inject into one loop after the other"
        )
    inverse = np.linalg.inv(injected)
    matrix = spectra.vectors[:, :, outputs].swapaxes(1, 2) @ inverse
    return FrequencyResponse(
        spectra.frequency,
        matrix,
        tuple(_port(spectra, n) for n in outputs),
        tuple(_port(spectra, n) for n in inputs),
        form="other",
        covariance=_covariance(spectra, (outputs, inputs), matrix, inverse),
        covariance_dof=spectra.covariance_dof,
        line_correlation=spectra.line_correlation,
        errors=_errors(spectra, (outputs, inputs), matrix, inverse),
        name=spectra.name,
        findings=spectra.findings,
        conditions=dict(spectra.conditions),
    )


def _covariance(
    spectra: ChannelSpectra, places: tuple[list[int], list[int]], matrix: ComplexArray, inverse: ComplexArray
) -> ComplexArray:
    """E[dH dH^H] (n_line, n, n) row by row: sum over runs of E[(dY - H dR)(dY - H dR)^H] times what the run
    is in R^-1.
    """
    outputs, inputs = places
    rows = np.zeros((*matrix.shape[:2], len(spectra.channels)), np.complex128)
    rows[:, np.arange(len(outputs)), outputs] = 1.0
    rows[:, :, inputs] -= matrix
    noise = np.einsum("loc,lrcd,lpd->lrop", rows, spectra.covariance, rows.conj())
    joint = np.einsum("lrop,lri,lrj->loipj", noise, inverse, inverse.conj())
    n = matrix.shape[1] * matrix.shape[2]
    return joint.reshape(-1, n, n)


def _errors(
    spectra: ChannelSpectra, places: tuple[list[int], list[int]], matrix: ComplexArray, inverse: ComplexArray
) -> tuple[MatrixError, ...]:
    """dH (n_line, n_output, n_input) by one standard uncertainty of every source in the channels and their
    sums.
    """
    outputs, inputs = places
    uncertainties = {
        calibration.uncertainty.source: calibration.uncertainty
        for channel in spectra.channels
        for calibration in channel.uncertainties
    }
    omega = 2 * np.pi * spectra.frequency
    errors = []
    for factor in spectra.factors:
        moved = (
            spectra.vectors @ factor.derivative.T * (factor.std_error * omega**factor.power)[:, None, None]
        )
        change = (moved[:, :, outputs].swapaxes(1, 2) - matrix @ moved[:, :, inputs].swapaxes(1, 2)) @ inverse
        uncertainty = uncertainties.get(
            factor.source, Uncertainty(factor.source, factor.std_error, factor.unit)
        )
        errors.append(MatrixError(uncertainty, change))
    return merged(errors)


def _port(spectra: ChannelSpectra, number: int) -> Port:
    channel = spectra.channels[number]
    factor_sources = {factor.source for factor in spectra.factors}
    left = tuple(
        calibration
        for calibration in channel.uncertainties
        if calibration.uncertainty.source not in factor_sources
    )
    return Port(channel.name, channel.name, channel.dof, channel.angle, left)


SAME_SIGNAL = 1e-9


@dataclass(frozen=True)
class SensitivityMatrix:
    """S over *frequency* [Hz], (n_line, n, n) [1] by loops, covariance (n_line, n^2, n^2) [1] of its elements
    row by row.

    dof: complex degrees of freedom behind the covariance; names of the loops. errors: changes (n_line, n, n)
    [1] of S by one standard uncertainty of every source.
    """

    frequency: FloatArray
    values: ComplexArray
    covariance: ComplexArray
    dof: float
    loops: tuple[str, ...]
    errors: tuple[MatrixError, ...] = ()

    @property
    def quantile(self) -> float:
        """Standard errors to either side of a 95 % interval."""
        return student_quantile(0.975, 2 * self.dof) if np.isfinite(self.dof) else normal_quantile(0.975)

    def errors_of(self, loop: int) -> tuple[MatrixError, ...]:
        """Changes (n_line, 1, 1) [1] of S_ii of a loop."""
        part = slice(loop, loop + 1)
        return tuple(replace(error, change=error.change[:, part, part]) for error in self.errors)

    def size(self, loop: int) -> tuple[FloatArray, FloatArray]:
        """|S_ii| of a loop and its standard error, (n_line,) each [1]."""
        n = len(self.loops)
        return np.abs(self.values[:, loop, loop]), np.sqrt(
            np.maximum(self.covariance[:, loop * (n + 1), loop * (n + 1)].real / 2, 0.0)
        )

    def largest(self) -> tuple[FloatArray, FloatArray]:
        """The largest singular value of S and its standard error, d sigma = Re u^H dS v, (n_line,) each
        [1].
        """
        slopes = self._largest_slopes()
        variance = np.einsum("lc,lcd,ld->l", slopes, self.covariance, slopes.conj()).real
        return np.linalg.svd(self.values, compute_uv=False)[:, 0], np.sqrt(np.maximum(variance / 2, 0.0))

    def largest_changes(self) -> FloatArray:
        """Changes of the largest singular value by every source, (n_source, n_line) [1].

        Equation (mag-singular-change).
        """
        slopes = self._largest_slopes()
        changes = [np.sum(slopes * error.change.reshape(slopes.shape), axis=1).real for error in self.errors]
        return np.array(changes).reshape(len(self.errors), len(slopes))

    def combined_size(self, loop: int) -> tuple[FloatArray, FloatArray]:
        """|S_ii| of a loop and its combined standard uncertainty, (n_line,) each [1]."""
        size, error = self.size(loop)
        along = self.values[:, loop, loop].conj() / np.maximum(size, 1e-300)
        changes = [(along * error_of.change[:, loop, loop]).real for error_of in self.errors]
        return size, np.sqrt(error**2 + np.sum(np.square(changes), axis=0))

    def combined_largest(self) -> tuple[FloatArray, FloatArray]:
        """The largest singular value and its combined standard uncertainty, (n_line,) each [1]."""
        size, error = self.largest()
        return size, np.sqrt(error**2 + np.sum(self.largest_changes() ** 2, axis=0))

    def _largest_slopes(self) -> ComplexArray:
        """u_i* v_j of the largest singular value, (n_line, n^2) [1]."""
        left, _, right = np.linalg.svd(self.values)
        slopes = left[:, :, 0].conj()[:, :, None] * right[:, 0].conj()[:, None, :]
        return slopes.reshape(len(slopes), -1)

    def loop_transfer(self, loop: int) -> tuple[ComplexArray, FloatArray]:
        """L = 1 / S_ii - 1 of a loop that is cut alone, the others closed, and its variance |S_ii|^-4 var
        S_ii, (n_line,) each [1].

        Equation (mag-loop-transfer).
        """
        size, error = self.size(loop)
        return np.asarray(1 / self.values[:, loop, loop] - 1), 2 * error**2 / size**4

    def transfer_changes(self, loop: int) -> ComplexArray:
        """Changes of L of a loop by every source, dL = -S_ii^-2 dS_ii, (n_source, n_line) [1].

        Equation (mag-transfer-change).
        """
        changes = np.array([error.change[:, loop, loop] for error in self.errors]).reshape(
            len(self.errors), len(self.values)
        )
        return np.asarray(-changes / self.values[:, loop, loop] ** 2)


def sensitivity_matrix(
    response: FrequencyResponse, before: Sequence[str], after: Sequence[str]
) -> SensitivityMatrix:
    """S = H_after (H_after - H_before)^-1; without *before* the responses behind the sums are per excitation
    themselves, S = H_after.

    ConfigError where there is not one excitation per loop, FitError without a covariance or where both sides
    are one signal. Equation (mag-sensitivity-matrix).
    """
    rows = [chosen_ports(response.outputs, (name,), "response")[0] for name in after]
    ahead = [chosen_ports(response.outputs, (name,), "response")[0] for name in before]
    n, n_input = len(rows), len(response.inputs)
    if n_input != n:
        hint = "role: input for the excitations alone, one per loop"
        raise ConfigError(f"{n} loop(s) and {n_input} excitation(s)", hint=hint)
    if response.covariance is None:
        raise FitError(
            "the noise of the response is not known, so nothing has an interval",
            hint="average several periods or blocks",
        )
    h_after = response.matrix[:, rows]
    added = (
        h_after - response.matrix[:, ahead]
        if ahead
        else np.broadcast_to(np.eye(n), h_after.shape).astype(np.complex128)
    )
    if np.any(
        np.linalg.svd(added, compute_uv=False)[:, -1] < SAME_SIGNAL * np.linalg.norm(h_after, axis=(1, 2))
    ):
        raise FitError(
            "both sides of a sum are the same signal", hint="record one ahead of the sum and one behind it"
        )
    inverse = np.linalg.inv(added)
    values = h_after @ inverse
    # dS = (dH_after - S (dH_after - dH_before)) added^-1.
    of_after = np.eye(n) - values if ahead else np.broadcast_to(np.eye(n), values.shape)
    picked = np.zeros((len(values), n, len(response.outputs)), np.complex128)
    picked[:, :, rows] += of_after
    if ahead:
        picked[:, :, ahead] += values
    slopes = np.einsum("lio,lkj->lijok", picked, inverse).reshape(len(values), n * n, -1)
    covariance = slopes @ response.covariance @ slopes.conj().swapaxes(1, 2)
    loops = tuple(port.label for port in response.inputs)
    errors = tuple(
        replace(error, change=picked @ error.change @ inverse)
        for error in _recorded_errors(response, (rows, ahead), picked)
    )
    return SensitivityMatrix(response.frequency, values, covariance, response.covariance_dof, loops, errors)


def _recorded_errors(
    response: FrequencyResponse, places: tuple[list[int], list[int]], picked: ComplexArray
) -> tuple[MatrixError, ...]:
    used = list(dict.fromkeys([*places[0], *places[1]]))
    errors = []
    for error in response_errors(response, used, list(range(len(response.inputs)))):
        change = np.zeros((len(picked), len(response.outputs), len(response.inputs)), np.complex128)
        change[:, used] = error.change
        errors.append(replace(error, change=change))
    return tuple(errors)
