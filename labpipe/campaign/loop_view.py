"""Response of a rig with a magnetic bearing: mass, support and bearings as in a fit, from the bearing's prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.bearings.magnetic_loop import dynamic_stiffness
from labpipe.campaign.loop_fit import LoopObservation
from labpipe.errors import ConfigError
from labpipe.identify.fitting import identify
from labpipe.identify.measured import Measured, measured_part, select_ports
from labpipe.identify.settings import FitSettings, Support
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import receptance_factor

# Damping that belongs to a stiffness of a model with one value per direction.
MODELS = ("sdof", "rotor-2dof-direct")


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
        return LoopObservation(measured, lambda file, support: receptance(self, file, measured.omega, support), self.file, self.support)


def checked_view(view: View) -> View:
    """The view; ConfigError for fits whose coefficients are not those of one bearing in one direction, or without known mass."""
    name = view.settings.name
    if view.settings.model not in MODELS:
        raise ConfigError(f"fit '{name}' is of the model {view.settings.model}", hint=f"a loop is predicted for {' and '.join(MODELS)}")
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
    plant = file.levitated()
    bearings: ComplexArray = view.settings.share * dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    assert isinstance(view.settings.mass, float)
    total: ComplexArray = stiffness + 1j * omega * damping + bearings - view.settings.mass * omega**2
    matrix: ComplexArray = _directions(view) / total[:, None, None]
    return matrix


def predicted_fits(view: View, file: MagneticFile) -> Sequence[Fit]:
    """The same fits of the predicted response, on the same lines with the same weights, for comparison with the measured fits."""
    frequency = view.response.frequency
    rows, columns = view.ports
    matrix = view.response.matrix.copy()
    form = receptance_factor(view.response.form, frequency)[:, None, None]
    matrix[:, np.array(rows)[:, None], np.array(columns)] = form * receptance(view, file, 2 * np.pi * frequency)
    plain = replace(view.settings, bootstrap=0, compare=False, eliminate=False)
    return identify(replace(view.response, matrix=matrix), plain, judging=False)
