"""Measured responses of a control loop beside the prediction of a bearing file, over its unknowns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.estimation.budget import mass_uncertainty, support_uncertainties
from labpipe.estimation.fitting import identify
from labpipe.estimation.measured import (
    Measured,
    across_ports,
    matrix_errors,
    measured_part,
    select_ports,
    turn,
)
from labpipe.estimation.settings import MODELS, FitSettings, Support, model_kind
from labpipe.estimation.weights import whiten_values, whitener
from labpipe.methods.magnetic_bearing.bearing import Magnet, MagneticFile
from labpipe.methods.magnetic_bearing.loop import ControlLoop, dynamic_stiffness
from labpipe.methods.magnetic_bearing.transfer import ControllerBlock
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.settings import settings_of
from labpipe.records.uncertain import MatrixError, Uncertainty
from labpipe.registry import nearest
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import receptance_factor

ALIASES = {"gain": "amplifier"}
# An entry of the controller's blocks, "controller.2.frequency"; they count from 1.
BLOCK = "controller."


def _units(owner: type) -> dict[str, str]:
    return {name: entry.unit for name, (entry, _) in settings_of(owner).items() if entry.kind == "value"}


# Section of the file -> entries that may be unknown, with their units.
ENTRIES = {
    "": {"force_per_current": "N/A", "negative_stiffness": "N/m", "static_stiffness": "N/m"},
    "loop": _units(ControlLoop),
    "magnet": _units(Magnet),
}
_BLOCK_ENTRIES = _units(ControllerBlock)


@dataclass(frozen=True)
class LoopUnknown:
    """An entry of the file to be fitted: its *name* as written, *value* in the file and *unit* [SI]."""

    name: str
    value: float
    unit: str


def _place(file: MagneticFile, name: str) -> tuple[str, str, str]:
    """Section (of a block its number), entry and unit of an unknown; ConfigError where there is none."""
    field = ALIASES.get(name, name)
    if field.startswith(BLOCK):
        number, _, entry = field.removeprefix(BLOCK).partition(".")
        count = len(file.loop.controller)
        if not number.isdigit() or not 1 <= int(number) <= count:
            hint = f"controller.1 to controller.{count}" if count else ""
            raise ConfigError(f"estimate: '{name}' names no block of the controller", hint=hint)
        if entry not in _BLOCK_ENTRIES:
            hint = nearest(entry, list(_BLOCK_ENTRIES))
            raise ConfigError(f"estimate: '{name}' is not a number of a block", hint=hint)
        return number, entry, _BLOCK_ENTRIES[entry]
    for section, units in ENTRIES.items():
        if field in units and not (section == "" and field == "force_per_current" and file.factor_of_loop):
            return section, field, units[field]
    names = dict.fromkeys([*ALIASES, *(entry for units in ENTRIES.values() for entry in units)])
    raise ConfigError(
        f"estimate: '{name}' is not an unknown of a magnetic bearing", hint=nearest(name, names)
    )


def unknown(file: MagneticFile, name: str) -> LoopUnknown:
    """The unknown of that name; ConfigError where the file has no such entry, or zero as a start value."""
    section, field, unit = _place(file, name)
    value: float | None
    if section == "" and field != "static_stiffness":
        plant = file.suspension()
        value = getattr(plant.loop if field == "force_per_current" else plant, field)
    else:
        owner = {"": file, "loop": file.loop, "magnet": file.magnet}.get(section)
        value = getattr(file.loop.controller[int(section) - 1] if section.isdigit() else owner, field, None)
    if value is None:
        where = {"": field, "magnet": f"magnet: {{{field}: ...}}", "loop": f"loop.{field}"}.get(
            section, f"{field} of block {section} of the controller"
        )
        raise ConfigError(f"estimate: the bearing file has no '{name}'", hint=f"give it as {where}")
    if value == 0:
        hint = "a value near the expected one is needed to start from"
        raise ConfigError(f"estimate: '{name}' is zero in the bearing file", hint=hint)
    return LoopUnknown(name, float(value), unit)


def with_unknowns(file: MagneticFile, values: Mapping[str, float]) -> MagneticFile:
    """The file with other values of its unknowns; ConfigError for impossible values (a negative gap)."""
    changes: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        section, field, _ = _place(file, name)
        changes.setdefault(section, {})[field] = value
    of_file, of_loop, of_magnet = (changes.get(section, {}) for section in ("", "loop", "magnet"))
    # An explicit negative stiffness replaces the one inferred from the static stiffness.
    if "negative_stiffness" in of_file:
        of_file["static_stiffness"] = None
    numbered = enumerate(file.loop.controller, 1)
    blocks = tuple(
        replace(block, **changes[str(number)]) if str(number) in changes else block
        for number, block in numbered
    )
    of_file["loop"] = replace(file.loop, controller=blocks, **of_loop)
    if file.magnet is not None and of_magnet:
        of_file["magnet"] = replace(file.magnet, **of_magnet)
    return replace(file, **of_file)


def response_errors(
    response: FrequencyResponse, rows: Sequence[int], columns: Sequence[int]
) -> tuple[MatrixError, ...]:
    """Changes (n_line, n_output, n_input) [unit of the response] of the chosen part by one standard
    uncertainty of every source. Gain, delay and phase of the channels, and sums of channels; a direction,
    which another channel of the same quantity would have to tell, is left out.
    """
    lines = np.ones(response.n_frequency, bool)
    part = measured_part(replace(response, form="receptance"), list(rows), list(columns), lines)
    return matrix_errors(part)


def merge(errors: Iterable[MatrixError]) -> tuple[MatrixError, ...]:
    """The errors with those of one source added up."""
    by_source: dict[str, MatrixError] = {}
    for error in errors:
        source = error.uncertainty.source
        before = by_source.get(source)
        by_source[source] = error if before is None else replace(before, change=before.change + error.change)
    return tuple(by_source.values())


STEP = 1e-5

Predict = Callable[[MagneticFile, tuple[float, float]], ComplexArray]
# What one standard uncertainty of every source does to measured less predicted, at the same.
Errors = Callable[[MagneticFile, tuple[float, float]], Sequence[MatrixError]]


@dataclass(frozen=True)
class LoopObservation:
    """A *measured* response of a loop, the prediction by a *file* on the same lines, and the *support* beside
    the bearings. *nuisance*: real numbers that the prediction takes from the measurement. *errors*: of
    channels, and of numbers that the prediction rests on. *left_out*: signals that tell nothing beside these.
    """

    measured: Measured
    predict: Predict
    file: MagneticFile
    support: Support = Support()
    nuisance: int = 0
    errors: Errors = lambda *_: ()
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class LoopProblem:
    """Whitened residual of all responses over u: unknowns as shares of their start, then deviations in
    standard uncertainties, of the support's numbers and of all other sources. *support*: 0 for stiffness or 1
    for damping, with its standard error, of every number of the support that has one.
    """

    observations: tuple[LoopObservation, ...]
    unknowns: tuple[LoopUnknown, ...]
    support: tuple[tuple[int, float], ...]

    @cached_property
    def weights(self) -> list[ComplexArray]:
        """Whitener of every observation, (n_line, n, n) [1/unit of the response] each."""
        return [whitener(observation.measured) for observation in self.observations]

    @property
    def size(self) -> float:
        pairs = zip(self.observations, self.weights, strict=True)
        rows = [whiten_values(weight, loop.measured.matrix) for loop, weight in pairs]
        return float(np.linalg.norm(np.concatenate(rows)))

    @cached_property
    def sources(self) -> tuple[Uncertainty, ...]:
        """Uncertainties in the order of their deviations: of the support, then of all others, each once."""
        of_support = support_uncertainties(self.observations[0].support)
        others: dict[str, Uncertainty] = {}
        for observation in self.observations:
            place = self._at(observation, np.zeros(self.n_shared))
            for error in observation.errors(*place):
                others.setdefault(error.uncertainty.source, error.uncertainty)
        return (*(uncertainty for _, uncertainty in of_support), *others.values())

    @property
    def n_shared(self) -> int:
        """Number of parameters the prediction depends on: unknowns and the support's deviations."""
        return len(self.unknowns) + len(self.support)

    @property
    def start(self) -> FloatArray:
        """The file as it is and all numbers as they were stated (n_parameter,) [1]."""
        return np.zeros(len(self.unknowns) + len(self.sources))

    def file_values(self, u: FloatArray) -> dict[str, float]:
        """The unknowns by name at u (n_parameter,) [1]."""
        return {
            entry.name: entry.value * (1 + float(share))
            for entry, share in zip(self.unknowns, u, strict=False)
        }

    def residual(self, u: FloatArray) -> FloatArray:
        """(n_equation,) [1]: measured minus predicted, each source off by its deviation, then the deviations.

        What the sources change is taken out of the data and does not tilt the unknowns by the weights, which
        follow the data with all their errors.
        """
        residuals = []
        for observation, weight in zip(self.observations, self.weights, strict=True):
            predicted = observation.predict(*self._at(observation, u))
            residuals.append(whiten_values(weight, observation.measured.matrix - predicted))
        deviations = u[len(self.unknowns) :]
        of_sources = u[self.n_shared :]
        change = of_sources @ self.changes(u) if np.any(of_sources) else 0.0
        return np.concatenate([np.concatenate(residuals) + change, deviations])

    def _at(self, observation: LoopObservation, u: FloatArray) -> tuple[MagneticFile, tuple[float, float]]:
        support = [observation.support.stiffness.value, observation.support.damping.value]
        deviations = u[len(self.unknowns) : self.n_shared]
        for (which, error), deviation in zip(self.support, deviations, strict=True):
            support[which] += error * float(deviation)
        return with_unknowns(observation.file, self.file_values(u)), (support[0], support[1])

    def changes(self, u: FloatArray) -> FloatArray:
        """Change (n_source, n_datum) [1] of all residuals by each source beside the support."""
        others = [source.source for source in self.sources[len(self.support) :]]
        parts = []
        for observation, weight in zip(self.observations, self.weights, strict=True):
            part = np.zeros((len(others), observation.measured.n_equation))
            for error in merge(observation.errors(*self._at(observation, u))):
                part[others.index(error.uncertainty.source)] = whiten_values(weight, error.change)
            parts.append(part)
        return np.hstack(parts)

    def jacobian(self, u: FloatArray) -> FloatArray:
        """(n_equation, n_parameter) [1] by centred, at an edge one-sided differences; linear in sources."""
        shared = self.n_shared
        count = sum(loop.measured.n_equation for loop in self.observations) + u.size - len(self.unknowns)
        slopes = np.zeros((count, u.size))
        for number, step in enumerate(STEP * np.eye(u.size)[:shared]):
            slopes[:, number] = self._slope(u, step)
        if u.size > shared:
            changes = self.changes(u)
            slopes[: changes.shape[1], shared:] = changes.T
            slopes[count - (u.size - shared) :, shared:] = np.eye(u.size - shared)
        return slopes

    def _slope(self, u: FloatArray, step: FloatArray) -> FloatArray:
        ahead, behind = (self.residual_within(u + sign * step) for sign in (1.0, -1.0))
        if ahead is not None and behind is not None:
            return (ahead - behind) / (2 * STEP)
        middle = self.residual(u)
        ahead, behind = (middle if side is None else side for side in (ahead, behind))
        return (ahead - behind) / STEP

    def residual_within(self, u: FloatArray) -> FloatArray | None:
        """The residual (n_equation,) [1] at u (n_parameter,) [1]; None for what no bearing can have."""
        try:
            return self.residual(u)
        except ConfigError:
            return None

    def chi2(self, u: FloatArray) -> float:
        """Sum of squares [1] at u (n_parameter,) [1]."""
        residual = self.residual_within(u)
        return float("inf") if residual is None else float(residual @ residual)


@dataclass(frozen=True)
class View:
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
    """The view. ConfigError for fits of other than one bearing in one direction, or without known mass."""
    name = view.settings.name
    if not view.settings.kind.one_direction:
        able = " and ".join(model for model in MODELS if model_kind(model).one_direction)
        hint = f"a loop is predicted for {able}"
        raise ConfigError(f"fit '{name}' is of the model {view.settings.model}", hint=hint)
    if not isinstance(view.settings.mass, float):
        raise ConfigError(f"fit '{name}' has no known mass", hint="mass: 0.92 kg, as in the rig file")
    if view.file.loop.cross is not None:
        what = "a cross-coupled controller couples x and y; a fit of one direction is not compared with it"
        raise ConfigError(what, hint="leave cross out")
    _directions(view)
    return view


def _directions(view: View) -> FloatArray:
    """cos between output and force, (n_output, n_input): all directions are equal and uncoupled."""
    (rows, columns), of = view.ports, view.response
    return np.array([[_cosine(of.outputs[row], of.inputs[column]) for column in columns] for row in rows])


def _cosine(output: Port, force: Port) -> float:
    if output.dof == force.dof:
        return 1.0
    if output.angle is None or force.angle is None:
        hint = "give dof: 45 deg (or x, y) in the rig file"
        raise ConfigError(f"the angle between {output.label} and {force.label} is unknown", hint=hint)
    return float(np.cos(output.angle - force.angle))


def receptance(
    view: View, file: MagneticFile, omega: FloatArray, support: tuple[float, float] | None = None
) -> ComplexArray:
    """cos / (k_s + j w c_s + n (K G(jw) - k_n) - m w^2), (n_line, n_output, n_input) [m/N]."""
    support = support or (view.support.stiffness.value, view.support.damping.value)
    return _directions(view) / _total(view, file, omega, support)[:, None, None]


def _total(view: View, file: MagneticFile, omega: FloatArray, support: tuple[float, float]) -> ComplexArray:
    """k_s + j w c_s + n (K G(jw) - k_n) - m w^2, (n_line,) [N/m]."""
    plant = file.suspension()
    bearings = view.settings.share * dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    assert isinstance(view.settings.mass, float)
    return support[0] + 1j * omega * support[1] + bearings - view.settings.mass * omega**2


def view_errors(
    view: View, measured: Measured, file: MagneticFile, support: tuple[float, float]
) -> tuple[MatrixError, ...]:
    """Changes (n_line, n_output, n_input) [m/N] of measured less predicted receptance by one standard
    uncertainty of every source. A given mass changes the prediction, and so does a direction, unless other
    sensors tell the motion across it. *support* (k_s, c_s) [N/m, N.s/m]. Equation (comp-loop-change).
    """
    total = _total(view, file, measured.omega, support)[:, None, None]
    # Of the prediction: in proportion to the measurement a gain would shrink its noise with it.
    predicted = replace(measured, matrix=receptance(view, file, measured.omega, support))
    errors = [*matrix_errors(predicted), *_direction_errors(measured, total)]
    mass = mass_uncertainty(view.settings)
    if mass is not None:
        inertia = mass.std_error * (measured.omega**2)[:, None, None]
        errors.append(MatrixError(mass, -_directions(view) * inertia / total**2))
    return merge(errors)


def _direction_errors(measured: Measured, total: ComplexArray) -> Iterator[MatrixError]:
    """What directions too large do to measured less cos(output - force) / *total* (n_line, 1, 1) [N/m]."""
    across = across_ports(measured.outputs)
    for number, port in enumerate(measured.outputs):
        turned: NDArray[Any] = _sines(measured, port) / total
        if across is not None and np.any(across[number]):
            turned = turn(measured.matrix, number, across, of_forces=False)
        yield from _errors_of_direction(port, turned)
    for force in measured.inputs:
        yield from _errors_of_direction(force, -_sines(measured, force) / total)


def _errors_of_direction(port: Port, turned: NDArray[Any]) -> Iterator[MatrixError]:
    for calibration in port.uncertainties:
        if calibration.effect == "direction" and port.angle is not None:
            error = np.asarray(calibration.uncertainty.std_error * turned, np.complex128)
            yield MatrixError(calibration.uncertainty, error)


def _sines(measured: Measured, turned_port: Port) -> FloatArray:
    """sin(output - force) (n_output, n_input) along one port, where both directions are known."""
    sines = np.zeros((len(measured.outputs), len(measured.inputs)))
    for row, output in enumerate(measured.outputs):
        for column, force in enumerate(measured.inputs):
            if turned_port in (output, force) and output.angle is not None and force.angle is not None:
                sines[row, column] = np.sin(output.angle - force.angle)
    return sines


def predicted_fits(view: View, file: MagneticFile) -> Sequence[Fit]:
    """The fits of the predicted response, on the same lines with the same weights."""
    frequency, matrix = view.response.frequency, view.response.matrix.copy()
    form = receptance_factor(view.response.form, frequency)[:, None, None]
    part = np.ix_(range(frequency.size), *view.ports)
    matrix[part] = form * receptance(view, file, 2 * np.pi * frequency)
    plain = replace(view.settings, bootstrap=0, compare=False, eliminate=False)
    return identify(replace(view.response, matrix=matrix), plain, judging=False)
