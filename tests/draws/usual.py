"""Uncertainties of usual size on what a pipeline was given: numbers of its rig that have none, the mass, what
is subtracted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from labpipe.estimation.draws import drawn_error
from labpipe.estimation.settings import FitSettings
from labpipe.project.measured import MeasuredTest
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra, FreeDecays
from labpipe.records.uncertain import ChannelUncertainty, Uncertain, Uncertainty, uncertainty_of
from labpipe.spectra.channels import calibration_factors

GAIN_OF_FORCE, GAIN_OF_RESPONSE, DELAY, ANGLE, MASS = 0.005, 0.01, 2e-6, np.radians(0.5), 0.005


@dataclass
class Errors:
    """The errors of one world in standard uncertainties, by source: drawn when they are first asked for.

    All 0 without an *rng*.
    """

    rng: np.random.Generator | None = None
    drawn: dict[str, float] = field(default_factory=dict)

    def of(self, uncertainty: Uncertainty) -> float:
        """The error of a number with this uncertainty [unit of the uncertainty]."""
        if self.rng is None:
            return 0.0
        if uncertainty.source not in self.drawn:
            self.drawn[uncertainty.source] = drawn_error(replace(uncertainty, std_error=1.0), self.rng)
        return self.drawn[uncertainty.source] * uncertainty.std_error


def with_usual_uncertainties(measured: MeasuredTest) -> MeasuredTest:
    """The test with uncertainties on all sensors that the rig file gives none: gains, delays, and directions
    that are known as angles.
    """
    if isinstance(measured, ChannelSpectra):
        channels = tuple(
            replace(
                one,
                uncertainties=one.uncertainties
                or _of(one.name, one.role == "input", one.angle is not None, one.name),
            )
            for one in measured.channels
        )
        recorded = [one for one in channels if not one.terms]
        assert len(recorded) == len(channels)
        return replace(
            measured,
            channels=channels,
            factors=calibration_factors(channels, np.eye(len(channels), dtype=np.complex128)),
        )
    if isinstance(measured, FreeDecays):
        return replace(measured, outputs=tuple(_uncertain(port, False) for port in measured.outputs))
    forces = tuple(_uncertain(port, True) for port in measured.inputs)
    return replace(
        measured, outputs=tuple(_uncertain(port, False) for port in measured.outputs), inputs=forces
    )


def _uncertain(port: Port, force: bool) -> Port:
    return replace(
        port, uncertainties=port.uncertainties or _of(port.channel, force, port.angle is not None, port.label)
    )


def _of(name: str, force: bool, directed: bool, place: str) -> tuple[ChannelUncertainty, ...]:
    """One sensor has one gain and one delay in all tests; it is mounted at every *place* by itself."""
    found = [
        ChannelUncertainty(
            "gain", Uncertainty(f"{name}.sensitivity", GAIN_OF_FORCE if force else GAIN_OF_RESPONSE, "1")
        )
    ]
    found += [] if force else [ChannelUncertainty("delay", Uncertainty(f"{name}.delay", DELAY, "s"))]
    return (
        *found,
        *([ChannelUncertainty("direction", Uncertainty(f"{place}.dof", ANGLE, "rad"))] if directed else []),
    )


def with_usual_mass(settings: FitSettings) -> FitSettings:
    """The fit with an uncertainty of its given mass, where it has none."""
    if (
        not isinstance(settings.mass, float)
        or dict(settings.uncertainties).get("mass", Uncertain(0.0)).std_error
    ):
        return settings
    return replace(
        settings,
        uncertainties=(*settings.uncertainties, ("mass", Uncertain(settings.mass, MASS * settings.mass))),
    )


def with_given_off(settings: FitSettings, errors: Errors) -> FitSettings:
    """The fit with its given numbers off by the errors of a world, their uncertainties as they are."""
    of_mass = dict(settings.uncertainties).get("mass")
    if of_mass is not None and isinstance(settings.mass, float):
        off = _off(of_mass, "mass", errors)
        settings = replace(
            settings,
            mass=off.value,
            uncertainties=tuple((k, off if k == "mass" else v) for k, v in settings.uncertainties),
        )
    if settings.subtract is not None:
        support = settings.subtract
        parts = {
            name: _off(getattr(support, name), f"{name} of the support", errors)
            for name in ("stiffness", "damping")
        }
        settings = replace(settings, subtract=replace(support, **parts))
    own = settings.model_settings
    given = {
        name: getattr(own, name)
        for name in ("stator_mass", "inertia", "viscosity", "clearance")
        if _is_uncertain(own, name)
    }
    if given:
        moved = {name: _off(number, name, errors) for name, number in given.items()}
        settings = replace(settings, model_settings=replace(own, **moved))
    return settings


def _is_uncertain(own: Any, name: str) -> bool:
    number = getattr(own, name, None)
    return isinstance(number, Uncertain) and number.std_error > 0


def _off(number: Uncertain, name: str, errors: Errors) -> Uncertain:
    return (
        replace(number, value=number.value + errors.of(uncertainty_of(number, name, "")))
        if number.std_error > 0
        else number
    )


def factor_of(uncertainties: Iterable[ChannelUncertainty], omega: np.ndarray, errors: Errors) -> np.ndarray:
    """What a sensor reads over what it should, (n_line,) complex: (1 + a) e^{-jw tau} e^{-j phi}, not only to
    first order.
    """
    factor = np.ones(omega.size, np.complex128)
    for uncertain in uncertainties:
        error = errors.of(uncertain.uncertainty)
        # As in `labpipe.records.uncertain`: an error d of the number changes X to X (1 - d), X e^{jwd}, X
        # e^{jd}.
        factor = factor * {
            "gain": 1 - error,
            "delay": np.exp(1j * omega * error),
            "phase": np.exp(1j * error),
        }.get(uncertain.effect, 1.0)
    return factor


def angle_error(uncertainties: Iterable[ChannelUncertainty], errors: Errors) -> float:
    """The error of a direction [rad]: what was written less what is true."""
    return sum(errors.of(one.uncertainty) for one in uncertainties if one.effect == "direction")


def is_response(measured: MeasuredTest) -> bool:
    return isinstance(measured, FrequencyResponse)
