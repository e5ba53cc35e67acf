"""Worlds of control loops: a response or signals as the loop of the bearing file gives them, with the support
that really is there.

Drawn are the noise of the response, its channels, a given mass and the support; the true unknowns are those
that were fitted to the measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.estimation.budget import mass_uncertainty
from labpipe.estimation.fitting import identify
from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.certificate import certificate
from labpipe.methods.magnetic_bearing.comparisons import magnetic_theory
from labpipe.methods.magnetic_bearing.loop import dynamic_stiffness
from labpipe.methods.magnetic_bearing.loop_fit import loop_fit
from labpipe.methods.magnetic_bearing.loop_problem import View, with_unknowns
from labpipe.methods.magnetic_bearing.sensitivity import loop_sensitivity, response_per_injection
from labpipe.methods.magnetic_bearing.stability import open_loop, sensitivity
from labpipe.project.pipeline_file import Pipeline
from labpipe.records.finding import Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Uncertainty
from labpipe.spectra.convert import receptance_factor
from labpipe.uncertainty.observations import condition_of
from labpipe.uncertainty.settings import CompareSettings
from tests.draws.cases import measured_tests
from tests.draws.responses import ResponseWorlds, worlds_about
from tests.draws.usual import Errors, angle_error, with_usual_mass

KINDS = ("prediction", "sensitivity", "certificate")


@dataclass(frozen=True)
class LoopWorlds:
    """One comparison of a loop; *recorded*: what is measured in a world; *found*: the amounts that are found
    in it.
    """

    name: str
    recorded: Callable[[Errors, np.random.Generator | None], list[FrequencyResponse]]
    found: Callable[[list[FrequencyResponse]], tuple[Parameter, ...]]

    def truth(self) -> dict[str, float]:
        return {name: one.value for name, one in self.amounts(Errors(), None).items()}

    def amounts(self, errors: Errors, rng: np.random.Generator | None) -> dict[str, Parameter]:
        return {f"{self.name}.{one.name}": one for one in self.found(self.recorded(errors, rng))}


def loop_worlds(pipeline: Pipeline) -> list[LoopWorlds]:
    """The comparisons of a pipeline that hold a loop against its bearing file."""
    chosen = [
        one for one in pipeline.sections.get("compare", ()) if one.kind in KINDS and one.theory is not None
    ]
    make = {"prediction": _prediction, "sensitivity": _sensitivity, "certificate": _certificate}
    tests = measured_tests(pipeline) if chosen else ()
    return [make[one.kind](one, pipeline, [_with_ports(test) for test in tests]) for one in chosen]


def _with_ports(test: FrequencyResponse | ChannelSpectra) -> FrequencyResponse:
    """The response, uncertainties of channels at its ports, where worlds take them not only to first
    order.
    """
    if not isinstance(test, ChannelSpectra):
        return test
    response, uncertainties = (
        response_per_injection(test),
        {channel.name: channel.uncertainties for channel in test.channels},
    )
    ports = {
        name: tuple(
            replace(port, uncertainties=uncertainties[port.label]) for port in getattr(response, name)
        )
        for name in ("outputs", "inputs")
    }
    # Spectra of all channels have a covariance of every line's own.
    return replace(response, errors=(), averages=response.covariance_dof + 1, **ports)


def _prediction(settings: CompareSettings, pipeline: Pipeline, tests: list[FrequencyResponse]) -> LoopWorlds:
    fit = with_usual_mass(next(one for one in pipeline.fits if one.name == settings.fit))
    assert settings.theory is not None
    theory = magnetic_theory(pipeline.folder, settings.theory)
    views = []
    for test in tests:
        at = condition_of(settings.condition, test.name, test.conditions) if settings.over else (None, "")
        views.append(View(test.name, test, fit, identify(test, fit, judging=False), theory(*at)))
    fitted = loop_fit([view.observation for view in views], settings.estimate).values()
    true = [replace(view, file=with_unknowns(view.file, fitted)) for view in views]

    def recorded(errors: Errors, rng: np.random.Generator | None) -> list[FrequencyResponse]:
        return [worlds_about(_on_support(view, errors)).recorded(errors, rng) for view in true]

    def found(responses: list[FrequencyResponse]) -> tuple[Parameter, ...]:
        again = [replace(view, response=response) for view, response in zip(views, responses, strict=True)]
        return loop_fit([view.observation for view in again], settings.estimate).parameters

    return LoopWorlds(settings.name, recorded, found)


def _on_support(view: View, errors: Errors) -> FrequencyResponse:
    """cos / (k_s + j w c_s + n K(jw) - m w^2) of the true support and mass, in the form of the response."""
    response, plant, own = view.response, view.file.suspension(), view.settings
    omega = 2 * np.pi * response.frequency
    stiffness, damping = (
        getattr(view.support, name).value
        + errors.of(Uncertainty(f"{name} of the support", getattr(view.support, name).std_error, ""))
        for name in ("stiffness", "damping")
    )
    assert isinstance(own.mass, float)
    uncertain = mass_uncertainty(own)
    mass = own.mass - (0.0 if uncertain is None else errors.of(uncertain))
    bearings = own.share * dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    total = stiffness + 1j * omega * damping + bearings - mass * omega**2
    (column,), rows = view.ports[1], view.ports[0]
    force = response.inputs[column]
    matrix = response.matrix.copy()
    # Sensors of known direction beside those of the fit tell what these read across.
    for row in dict.fromkeys(
        [*rows, *(n for n, port in enumerate(response.outputs) if port.angle is not None)]
    ):
        angles = response.outputs[row].angle, force.angle
        cosine = (
            1.0
            if None in angles
            else np.cos(angles[0] - angles[1] + angle_error(force.uncertainties, errors))
        )
        matrix[:, row, column] = cosine / total * receptance_factor(response.form, response.frequency)
    return replace(response, matrix=matrix)


def _sensitivity(settings: CompareSettings, pipeline: Pipeline, tests: list[FrequencyResponse]) -> LoopWorlds:
    """Both sides of the sum per excitation: S - 1 ahead of it, S behind it."""
    (response,), assumed = tests, _file(settings, pipeline)
    true = _fitted_file(assumed, loop_sensitivity(settings, response, assumed).amounts, settings)
    values = sensitivity(true.suspension(), 2 * np.pi * response.frequency)
    rows = {settings.before: values - 1, settings.after: values}
    return _of_signals(
        settings, response, rows, lambda measured: loop_sensitivity(settings, measured, assumed).amounts
    )


def _certificate(settings: CompareSettings, pipeline: Pipeline, tests: list[FrequencyResponse]) -> LoopWorlds:
    """All signals per injection, of the loop as it is sampled."""
    (response,), assumed, own = tests, _file(settings, pipeline), settings.certificate
    assert own is not None
    true = _fitted_file(assumed, certificate(settings, response, assumed).amounts, settings)
    signals = open_loop(
        true.suspension(), 2 * np.pi * response.frequency, own.rate or assumed.loop.rate, own.filtered
    ).signals(own.injection)
    named = {
        "after": own.after[0],
        "output": own.output,
        "displacement": own.displacement,
        "current": own.current,
    }
    rows = {name: signals[signal] for signal, name in named.items() if name}
    return _of_signals(
        settings, response, rows, lambda measured: certificate(settings, measured, assumed).amounts
    )


def _file(settings: CompareSettings, pipeline: Pipeline) -> MagneticFile:
    assert settings.theory is not None
    return magnetic_theory(pipeline.folder, settings.theory)(None, "")


def _fitted_file(
    file: MagneticFile, amounts: tuple[Parameter, ...], settings: CompareSettings
) -> MagneticFile:
    return with_unknowns(file, {one.name: one.value for one in amounts if one.name in settings.estimate})


def _of_signals(
    settings: CompareSettings,
    response: FrequencyResponse,
    rows: dict[str, np.ndarray],
    found: Callable[[FrequencyResponse], tuple[Parameter, ...]],
) -> LoopWorlds:
    labels = [port.label for port in response.outputs]
    matrix = response.matrix.copy()
    for name, values in rows.items():
        matrix[:, labels.index(name), 0] = values
    worlds: ResponseWorlds = worlds_about(replace(response, matrix=matrix))
    return LoopWorlds(
        settings.name,
        lambda errors, rng: [worlds.recorded(errors, rng)],
        lambda responses: found(responses[0]),
    )
