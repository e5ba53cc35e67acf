"""Data of one fit: chosen lines and ports of a measured response, as receptance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.leakage import Leakage, SharedNoise, leakage_of
from labpipe.records.response import (
    BlockCovariance,
    Blocks,
    FrequencyResponse,
    HeldCovariance,
    Port,
    StoredCovariance,
    variance_of,
)
from labpipe.records.uncertain import COURSES, MatrixError, Uncertainty
from labpipe.registry import nearest
from labpipe.spectra.convert import DERIVATIVES, TRANSMISSIBILITY, FormView


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Receptance of the chosen ports on the chosen lines, with its noise.

    omega (n_line,) [rad/s]; matrix (n_line, n_output, n_input) [m/N]; covariance (n_line, n, n) [m^2/N^2] of
    vec row-major, or None; noise_dof: complex degrees of freedom of one line's covariance estimate;
    noise_lines: lines with a common one (smoothed noise). change (n_line, n_output, n_input) [m/N]: of the
    second half of the record against the first, or None.

    shared_noise, shared_power: mean over the lines of the sum of c and of c^2, c the correlation of their
    noise (a window spreads it): factor on the variance of a sum over lines, and on that of their powers. For
    complex c shared_noise is the upper bound shared_power; where noise cancels it is 1, since no estimate is
    a plain sum. *line_noise*: that correlation, None for independent lines; *noise*: of lines with gains.

    *derivatives* in time of the measured form, in which unknown noise counts as even along the lines.
    *offset* (n_line,) [m/N]: what was taken off the measured form, on which a gain's error acts too; None for
    0. *noise_of_channels* (n_line, n_input + n_output) [1]: relative variance of every channel, forces first,
    where the covariance follows from it by the measured FRF; None else. *blocks* of random data and their
    *leakage* where it is known (H1), or None. *errors*: of sums of channels, as receptance.
    """

    omega: FloatArray
    matrix: ComplexArray
    covariance: HeldCovariance = HeldCovariance()
    noise_dof: float
    noise_lines: float
    outputs: tuple[Port, ...]
    inputs: tuple[Port, ...]
    change: ComplexArray | None = None
    shared_noise: float = 1.0
    shared_power: float = 1.0
    noise: SharedNoise | None = None
    line_noise: SharedNoise | None = None
    leakage: Leakage | None = None
    derivatives: int = 0
    offset: FloatArray | None = None
    noise_of_channels: FloatArray | None = None
    blocks: Blocks | None = None
    errors: tuple[MatrixError, ...] = ()

    @property
    def stored_covariance(self) -> StoredCovariance:
        """The covariance as it is held: whole, in factors or in blocks [m^2/N^2]."""
        covariance: StoredCovariance = self.__dict__["covariance"]
        return covariance

    @property
    def variance(self) -> FloatArray | None:
        """E|H - E H|^2 of every element, (n_line, n) [m^2/N^2], or None, of the covariance as it is held."""
        return variance_of(self.stored_covariance)

    def plus_offset(self, receptance: ComplexArray) -> ComplexArray:
        """What a sensor shows of a *receptance* (n_line, n_output, n_input) [m/N] of the model."""
        return receptance if self.offset is None else receptance + self.offset[:, None, None]

    def scatter(self, residual: ComplexArray) -> FloatArray:
        """E|n|^2 (...) of the noise in a *residual* (n_line, ...) [any unit], by second differences.

        Of lines of correlation c, E|n_(k-1) - 2 n_k + n_(k+1)|^2 = (6 - 8 Re c_1 + 2 Re c_2) E|n|^2.
        """
        shared = () if self.line_noise is None else self.line_noise.correlation.real
        first, second = (*shared[:2], 0.0, 0.0)[:2]
        square = np.mean(np.abs(np.diff(residual, 2, axis=0)) ** 2, axis=0)
        return np.asarray(square / (6 - 8 * first + 2 * second))

    @property
    def form_size(self) -> FloatArray:
        """Size of the measured form over that of the receptance, (n_line,) [1/s^derivatives]."""
        return self.omega**self.derivatives

    @property
    def n_equation(self) -> int:
        """Number of real equations."""
        return 2 * self.matrix.size

    def dof(self, n_parameter: int, *, by_noise: bool = False) -> int:
        """Degrees of freedom of a fit, whose errors are *by_noise* that is known, or by its residual.
        FitError for none, but by noise.
        """
        left = self.n_equation - n_parameter
        if left < 0 or not (left or by_noise):
            what = f"{self.n_equation} real equations cannot determine {n_parameter} parameters"
            cure = "" if left else "; where its noise is known by periods or blocks, ml needs no more"
            raise FitError(what, hint=f"widen the band{cure}")
        return left


def select_ports(
    response: FrequencyResponse, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> tuple[list[int], list[int]]:
    """Rows and columns by label, channel or dof; all without names; ConfigError for unknown names."""
    return chosen_ports(response.outputs, outputs, "response"), chosen_ports(response.inputs, inputs, "force")


def chosen_ports(ports: tuple[Port, ...], names: tuple[str, ...], what: str) -> list[int]:
    if not names:
        return list(range(len(ports)))
    chosen: list[int] = []
    for name in names:
        exact = [number for number, port in enumerate(ports) if port.label == name]
        matches = exact or [number for number, port in enumerate(ports) if port.answers_to(name)]
        if not matches:
            labels = [port.label for port in ports]
            missing = f"no {what} '{name}' in the FRF, only {', '.join(labels)}"
            raise ConfigError(missing, hint=nearest(name, labels))
        chosen.extend(number for number in matches if number not in chosen)
    return chosen


def measured_part(
    response: FrequencyResponse,
    rows: list[int],
    columns: list[int],
    lines: BoolArray,
    view: FormView | None = None,
) -> Measured:
    """The chosen part as receptance; *lines*: mask (n_frequency,) [-]; *view* of the form, its own by
    default. FitError when it is empty, constant zero, or at 0 Hz for a mobility or accelerance. Equation
    (est-shared).
    """
    frequency = response.frequency[lines]
    if not frequency.size:
        hint = f"lines from {response.frequency[0]:g} to {response.frequency[-1]:g} Hz"
        raise FitError("no frequency line lies in the band", hint=hint)
    view = view or FormView(response.form)
    factor = view.factor(frequency)
    if np.any(factor == 0):
        what = f"the line at 0 Hz of a {response.form} has no receptance"
        raise FitError(what, hint="begin the band above 0 Hz")

    def choose(values: ComplexArray) -> ComplexArray:
        return values[lines][..., rows, :][..., columns]

    matrix = (choose(response.matrix) - view.offset) / factor[:, None, None]
    outputs = tuple(response.outputs[row] for row in rows)
    inputs = tuple(response.inputs[column] for column in columns)
    still = [port.label for row, port in enumerate(outputs) if not np.any(matrix[:, row])]
    if still:
        what = f"the FRF of {', '.join(still)} is zero at every line of the band"
        raise FitError(what, hint="is the sensor connected?")
    elements = [row * len(response.inputs) + column for row in rows for column in columns]
    covariance = _chosen_covariance(response, elements, lines, factor)
    dof, noise_lines = response.covariance_dof, 1.0
    if np.isfinite(dof) and response.averages > 1:
        # A single line has averages - 1 degrees of freedom; any beyond these come from its neighbours.
        noise_lines = max(dof / (response.averages - 1), 1.0)
    # A single line has the number 0.
    spacing = np.min(np.diff(response.frequency)) if response.n_frequency > 1 else np.inf
    numbers = np.round(response.frequency / spacing).astype(np.intp)[lines]
    correlation = np.array(response.line_correlation, np.complex128)
    real, gains = response.line_gains is None and not np.any(correlation.imag), None
    if response.line_gains is not None:
        gains = choose(response.line_gains).reshape(numbers.size, -1, len(elements))
    blocks = response.blocks and response.blocks.select_forces(columns)
    line_noise = SharedNoise(numbers, correlation, gains) if correlation.size else None
    return Measured(
        omega=2 * np.pi * frequency,
        matrix=matrix,
        covariance=covariance,
        noise_dof=dof,
        noise_lines=noise_lines,
        outputs=outputs,
        inputs=inputs,
        shared_noise=max(_share(numbers, correlation.real if real else np.abs(correlation) ** 2), 1.0),
        shared_power=_share(numbers, np.abs(correlation) ** 2),
        blocks=blocks,
        leakage=leakage_of(
            blocks, frequency, np.array(response.line_correlation).real, _derivatives(response.form)
        ),
        noise=None if gains is None else line_noise,
        line_noise=line_noise,
        derivatives=_derivatives(response.form),
        offset=view.offset / np.real(factor) if view.offset else None,
        noise_of_channels=_noise_of_channels(response, rows, columns, lines),
        change=None if response.change is None else choose(response.change) / factor[:, None, None],
        errors=tuple(e.turn(lambda part: choose(part) / factor[:, None, None]) for e in response.errors),
    )


def _noise_of_channels(
    response: FrequencyResponse, rows: list[int], columns: list[int], lines: BoolArray
) -> FloatArray | None:
    # Of a mean over realisations the covariance is what they scatter by.
    if response.snr is None or response.distortion is not None:
        return None
    channels = [*columns, *(len(response.inputs) + row for row in rows)]
    return np.maximum(response.snr[lines][:, channels], 1.0) ** -2.0


def _chosen_covariance(
    response: FrequencyResponse, index: list[int], lines: BoolArray, factor: ComplexArray
) -> StoredCovariance:
    stored = response.stored_covariance
    if isinstance(stored, BlockCovariance):
        return stored.choose(lines, index).times(np.tile(1 / factor[:, None], len(index)))
    if response.covariance is None:
        return None
    whole = response.covariance[lines][:, index][:, :, index]
    return whole / (np.abs(factor) ** 2)[:, None, None]


def _derivatives(form: str) -> int:
    """Of a form beyond the receptance of its model: T = 1 + w^2 H of a transmissibility."""
    return 2 if form == TRANSMISSIBILITY else DERIVATIVES[form]


def _share(numbers: IntArray, correlation: FloatArray) -> float:
    """1 + sum of the *correlation* (n_distance,) over the pairs of chosen lines, per line."""
    chosen = np.zeros(numbers[-1] - numbers[0] + 1)
    chosen[numbers - numbers[0]] = 1.0
    distances = range(1, min(correlation.size + 1, chosen.size))
    pairs = [np.dot(chosen[distance:], chosen[:-distance]) for distance in distances]
    return 1.0 + 2 * float(np.dot(pairs, correlation[: len(pairs)])) / numbers.size


# Errors are tried at this share of their standard uncertainty on either side: slopes at the estimate.
SHARE = 1e-3
# Sine of the angle between directions below which they do not tell the plane.
PARALLEL = 0.02


def matrix_errors(measured: Measured, *, directions: bool = False) -> tuple[MatrixError, ...]:
    """dH (n_line, n_output, n_input) [m/N] by one standard uncertainty of every source; numbers of one source
    err together.

    An error d of an output changes its row by H a w^n d, one of a force its column by -H a w^n d, with a w^n
    of COURSES; with *directions* one of an angle by -d times that at right angles, where ports of known
    direction tell it. Equation (unc-port).
    """
    uncertainties: dict[str, Uncertainty] = {}
    changes: dict[str, ComplexArray] = {}

    def add(uncertainty: Uncertainty, change: ComplexArray) -> None:
        uncertainties.setdefault(uncertainty.source, uncertainty)
        changes[uncertainty.source] = changes.get(uncertainty.source, np.zeros_like(change)) + change

    whole = measured.plus_offset(measured.matrix)
    for ports, sign in ((measured.outputs, 1.0), (measured.inputs, -1.0)):
        for number, port in enumerate(ports):
            for calibration in port.uncertainties:
                if calibration.effect in COURSES:
                    slope, power = COURSES[calibration.effect]
                    change = np.zeros_like(whole)
                    at = (slice(None), number) if sign > 0 else (..., number)
                    size = sign * calibration.uncertainty.std_error * slope
                    change[at] = (size * measured.omega**power)[:, None] * whole[at]
                    add(calibration.uncertainty, change)
                elif directions and (across := across_ports(ports)) is not None:
                    turned = turn(measured.matrix, number, across, of_forces=sign < 0)
                    add(calibration.uncertainty, calibration.uncertainty.std_error * turned)
    for error in measured.errors:
        add(error.uncertainty, error.change)
    return tuple(MatrixError(uncertainties[source], change) for source, change in changes.items())


def across_ports(ports: Sequence[Port]) -> FloatArray | None:
    """What ports see at right angles to their directions, (n_port, n_port) [1] by what all of them see, zeros
    without a direction; None where they do not tell. A port at a + d sees what one at a sees, and d times
    that at a + 90 deg. Equation (unc-across).
    """
    with_angle = [number for number, port in enumerate(ports) if port.angle is not None]
    angles = np.array([ports[number].angle for number in with_angle], float)
    plane = np.column_stack([np.cos(angles), np.sin(angles)])
    if len(with_angle) < 2 or np.linalg.svd(plane, compute_uv=False)[-1] < PARALLEL:
        return None
    across = np.zeros((len(ports), len(ports)))
    turned = np.column_stack([-np.sin(angles), np.cos(angles)])
    across[np.ix_(with_angle, with_angle)] = turned @ np.linalg.pinv(plane)
    return across


def turn(matrix: ComplexArray, number: int, across: FloatArray, *, of_forces: bool) -> ComplexArray:
    """Change of a *matrix* (n_line, n_output, n_input) [m/N] per radian by which the direction of a port, of
    forces a column, was written too large; *across* (n_port, n_port) [1]. Equation (unc-direction).
    """
    change = np.zeros_like(matrix)
    if of_forces:
        change[:, :, number] = -matrix @ across[number]
    else:
        change[:, number] = -(across[number] @ matrix)
    return change


def changes_by(
    errors: tuple[MatrixError, ...], values: Callable[[ComplexArray], FloatArray]
) -> list[tuple[Uncertainty, FloatArray]]:
    """Central differences (n_parameter,) [parameter units] of *values* by every error of the matrix [m/N]."""
    return [
        (error.uncertainty, (values(SHARE * error.change) - values(-SHARE * error.change)) / (2 * SHARE))
        for error in errors
    ]
