"""Response of a rig with a magnetic bearing: mass, support and bearings as in a fit, from the bearing's prediction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.bearings.magnetic_loop import dynamic_stiffness
from labpipe.campaign.loop_problem import LoopObservation
from labpipe.campaign.loop_sources import merged
from labpipe.errors import ConfigError
from labpipe.identify.budget import mass_doubt
from labpipe.identify.fitting import identify
from labpipe.identify.matrix_errors import across_ports, matrix_errors, turned
from labpipe.identify.measured import Measured, measured_part, select_ports
from labpipe.identify.settings import MODELS, FitSettings, Support, model_kind
from labpipe.records.doubt import Doubt, MatrixError
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import receptance_factor


@dataclass(frozen=True)
class View:
    """One test with its sliding fits: the measured *response*, the fits, and their settings with mass, support and share."""

    test: str
    response: FrequencyResponse
    settings: FitSettings
    fits: tuple[Fit, ...]
    file: MagneticFile

    @property
    def support(self) -> Support:
        return self.settings.subtract or Support()

    @property
    def ports(self) -> tuple[list[int], list[int]]:
        return select_ports(self.response, self.settings.input, self.settings.output)

    @property
    def measured(self) -> Measured:
        """The lines of all bands, without repetition."""
        lines = np.any([lines_in(self.response.frequency, fit.band_hz) for fit in self.fits], axis=0)
        return measured_part(self.response, *self.ports, lines)

    @property
    def observation(self) -> LoopObservation:
        """The lines with the prediction of a file."""
        measured = self.measured
        return LoopObservation(
            measured,
            lambda file, support: receptance(self, file, measured.omega, support),
            self.file,
            self.support,
            errors=lambda file, support: view_errors(self, measured, file, support),
        )


def checked_view(view: View) -> View:
    """The view; ConfigError for fits whose coefficients are not those of one bearing in one direction, or without known mass."""
    name = view.settings.name
    if not view.settings.kind.one_direction:
        able = " and ".join(model for model in MODELS if model_kind(model).one_direction)
        raise ConfigError(f"fit '{name}' is of the model {view.settings.model}", hint=f"a loop is predicted for {able}")
    if not isinstance(view.settings.mass, float):
        raise ConfigError(f"fit '{name}' has no known mass", hint="mass: 0.92 kg, as in the rig file")
    if view.file.loop.cross is not None:
        what = "a cross-coupled controller couples x and y; a fit of one direction is not compared with it"
        raise ConfigError(what, hint="leave cross out")
    _directions(view)
    return view


def _directions(view: View) -> FloatArray:
    """cos of the angle between output and force, (n_output, n_input): all directions are equal and uncoupled."""
    rows, columns = view.ports
    outputs, inputs = [view.response.outputs[row] for row in rows], [view.response.inputs[column] for column in columns]
    return np.array([[_cosine(output, force) for force in inputs] for output in outputs])


def _cosine(output: Port, force: Port) -> float:
    if output.dof == force.dof:
        return 1.0
    if output.angle is None or force.angle is None:
        hint = "give dof: 45 deg (or x, y) in the rig file"
        raise ConfigError(f"the angle between {output.label} and {force.label} is unknown", hint=hint)
    return float(np.cos(output.angle - force.angle))


def receptance(view: View, file: MagneticFile, omega: FloatArray, support: tuple[float, float] | None = None) -> ComplexArray:
    """cos / (k_s + j w c_s + n (K G(jw) - k_n) - m w^2), (n_line, n_output, n_input) [m/N]; *support* (k_s, c_s), default: nominal."""
    stiffness, damping = support or (view.support.stiffness.value, view.support.damping.value)
    matrix: ComplexArray = _directions(view) / _total(view, file, omega, (stiffness, damping))[:, None, None]
    return matrix


def _total(view: View, file: MagneticFile, omega: FloatArray, support: tuple[float, float]) -> ComplexArray:
    """k_s + j w c_s + n (K G(jw) - k_n) - m w^2, (n_line,) [N/m]."""
    plant = file.levitated()
    bearings: ComplexArray = view.settings.share * dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    assert isinstance(view.settings.mass, float)
    total: ComplexArray = support[0] + 1j * omega * support[1] + bearings - view.settings.mass * omega**2
    return total


def view_errors(view: View, measured: Measured, file: MagneticFile, support: tuple[float, float]) -> tuple[MatrixError, ...]:
    """Changes (n_line, n_output, n_input) [m/N] of measured less predicted receptance by one standard uncertainty of every source.

    Channels and sums change what is *measured*. A given mass changes the prediction, and so does a direction, unless other sensors tell
    the motion across it. *support* (k_s, c_s) [N/m, N.s/m]. Equation (comp-loop-change).
    """
    total = _total(view, file, measured.omega, support)[:, None, None]
    errors = [*matrix_errors(measured), *_direction_errors(measured, total)]
    mass = mass_doubt(view.settings)
    if mass is not None:
        errors.append(MatrixError(mass, -mass.std_error * _directions(view) * (measured.omega**2)[:, None, None] / total**2))
    return merged(errors)


def _direction_errors(measured: Measured, total: ComplexArray) -> Iterator[MatrixError]:
    """What directions that are written too large do to measured less predicted cos(output - force) / *total* (n_line, 1, 1) [N/m]."""
    across = across_ports(measured.outputs)
    for number, port in enumerate(measured.outputs):
        for error in _doubts_of_direction(port):
            if across is not None and np.any(across[number]):
                yield MatrixError(error, error.std_error * turned(measured.matrix, number, across, of_forces=False))
            else:
                yield MatrixError(error, error.std_error * _sines(measured, port) / total)
    for force in measured.inputs:
        for error in _doubts_of_direction(force):
            yield MatrixError(error, -error.std_error * _sines(measured, force) / total)


def _doubts_of_direction(port: Port) -> list[Doubt]:
    return [doubted.doubt for doubted in port.doubts if doubted.effect == "direction" and port.angle is not None]


def _sines(measured: Measured, turned_port: Port) -> FloatArray:
    """sin(output - force) (n_output, n_input) in the row or the column of one port, where both directions are known; else zero."""
    sines = np.zeros((len(measured.outputs), len(measured.inputs)))
    for row, output in enumerate(measured.outputs):
        for column, force in enumerate(measured.inputs):
            if turned_port in (output, force) and output.angle is not None and force.angle is not None:
                sines[row, column] = np.sin(output.angle - force.angle)
    return sines


def predicted_fits(view: View, file: MagneticFile) -> Sequence[Fit]:
    """The same fits of the predicted response, on the same lines with the same weights, for comparison with the measured fits."""
    frequency = view.response.frequency
    rows, columns = view.ports
    matrix = view.response.matrix.copy()
    form = receptance_factor(view.response.form, frequency)[:, None, None]
    matrix[:, np.array(rows)[:, None], np.array(columns)] = form * receptance(view, file, 2 * np.pi * frequency)
    plain = replace(view.settings, bootstrap=0, compare=False, eliminate=False)
    return identify(replace(view.response, matrix=matrix), plain, judging=False)
