"""Data of one fit: chosen lines and ports of a measured response, as receptance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.records.response import FrequencyResponse, Port
from labpipe.registry import nearest
from labpipe.spectra.convert import receptance_factor


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Receptance of the chosen ports on the chosen lines, with its noise.

    omega (n_line,) [rad/s]; matrix (n_line, n_output, n_input) [m/N]; covariance (n_line, n, n) [m^2/N^2] of vec row-major, or None;
    noise_dof: complex degrees of freedom of one line's covariance estimate; noise_lines: lines with a common one (smoothed noise).
    change (n_line, n_output, n_input) [m/N]: of the second half of the record against the first, or None.
    shared_noise, shared_power: sum of c and of c^2 over the chosen lines, itself included, averaged over the lines, c the correlation
    of their noise (a window spreads it over neighbours): factor on the variance of a sum over lines.
    """

    omega: FloatArray
    matrix: ComplexArray
    covariance: ComplexArray | None
    noise_dof: float
    noise_lines: float
    outputs: tuple[Port, ...]
    inputs: tuple[Port, ...]
    change: ComplexArray | None = None
    shared_noise: float = 1.0
    shared_power: float = 1.0

    @property
    def n_equation(self) -> int:
        """Number of real equations."""
        return 2 * self.matrix.size


def select_ports(response: FrequencyResponse, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[list[int], list[int]]:
    """Rows and columns by label, channel or dof (all without names); ConfigError for unknown names."""
    return _chosen(response.outputs, outputs, "response"), _chosen(response.inputs, inputs, "force")


def _chosen(ports: tuple[Port, ...], names: tuple[str, ...], what: str) -> list[int]:
    if not names:
        return list(range(len(ports)))
    chosen: list[int] = []
    for name in names:
        exact = [number for number, port in enumerate(ports) if port.label == name]
        matches = exact or [number for number, port in enumerate(ports) if port.answers_to(name)]
        if not matches:
            labels = [port.label for port in ports]
            raise ConfigError(f"no {what} '{name}' in the FRF, only {', '.join(labels)}", hint=nearest(name, labels))
        chosen.extend(number for number in matches if number not in chosen)
    return chosen


def measured_part(response: FrequencyResponse, rows: list[int], columns: list[int], lines: BoolArray) -> Measured:
    """The chosen part as receptance; *lines*: mask (n_frequency,) [-] of the lines.

    FitError when it is empty, constant zero, or at 0 Hz for a mobility or accelerance.
    """
    frequency = response.frequency[lines]
    if not frequency.size:
        raise FitError("no frequency line lies in the band", hint=f"lines from {response.frequency[0]:g} to {response.frequency[-1]:g} Hz")
    factor = receptance_factor(response.form, frequency)
    if np.any(factor == 0):
        raise FitError(f"the line at 0 Hz of a {response.form} has no receptance", hint="begin the band above 0 Hz")
    matrix = response.matrix[lines][:, rows][:, :, columns] / factor[:, None, None]
    _check_moving(matrix, [response.outputs[row].label for row in rows])
    covariance = None
    if response.covariance is not None:
        index = [row * len(response.inputs) + column for row in rows for column in columns]
        covariance = response.covariance[lines][:, index][:, :, index] / (np.abs(factor) ** 2)[:, None, None]
    dof = response.covariance_dof
    # A single line has averages - 1 degrees of freedom; any beyond these come from its neighbours.
    noise_lines = max(dof / (response.averages - 1), 1.0) if np.isfinite(dof) and response.averages > 1 else 1.0
    outputs = tuple(response.outputs[row] for row in rows)
    inputs = tuple(response.inputs[column] for column in columns)
    return Measured(
        omega=2 * np.pi * frequency,
        matrix=matrix,
        covariance=covariance,
        noise_dof=dof,
        noise_lines=noise_lines,
        outputs=outputs,
        inputs=inputs,
        change=None if response.change is None else response.change[lines][:, rows][:, :, columns] / factor[:, None, None],
        shared_noise=_shared(response, lines, 1),
        shared_power=_shared(response, lines, 2),
    )


def _shared(response: FrequencyResponse, lines: BoolArray, power: int) -> float:
    """1 + sum of c_d^power over the pairs of chosen lines, per line; distant lines are uncorrelated."""
    if response.n_frequency < 2:
        return 1.0
    numbers = np.round(response.frequency / np.min(np.diff(response.frequency))).astype(np.int64)[lines]
    pairs = [np.count_nonzero(np.isin(numbers + distance, numbers)) for distance in range(1, len(response.line_correlation) + 1)]
    return 1.0 + 2 * float(np.dot(pairs, np.power(response.line_correlation, power))) / numbers.size


def _check_moving(matrix: ComplexArray, labels: list[str]) -> None:
    """FitError for an output that is zero at every line."""
    still = [label for row, label in enumerate(labels) if not np.any(matrix[:, row])]
    if still:
        raise FitError(f"the FRF of {', '.join(still)} is zero at every line of the band", hint="is the sensor connected?")
