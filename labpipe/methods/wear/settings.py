"""The model worn-bearing: its settings, the prior of a healthy rig, and its entry in the table of models."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.rig import RotorRig, worn_place
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import Settings, choice, flag, integer, quantity, setting, text
from labpipe.records.uncertain import Uncertain
from labpipe.registry import nearest

RESPONSES = ("FRF", "dFRF")
TERMS = ("full", "direct", "cross")
OBJECTIVES = ("complex", "log")
# Parameters that can be estimated together with the wear: name of the setting, unit.
NUISANCES = {"viscosity": "Pa.s", "clearance": "m", "cavitation_pressure": "Pa", "beta": "s"}
POSITIVE = ("viscosity", "clearance", "beta")
OF_WEAR = ("bearing", "depth_limit", "angle_limit", "start_depths", "start_angles")
DEPTH, ANGLE = "wear_depth", "wear_angle"
# Range of a nuisance parameter about its prior mean, in prior standard deviations.
REACH = 4.0
UNITS = {DEPTH: "m", ANGLE: "rad", **NUISANCES}


def nuisance(words: str, unit: str) -> Any:
    """A number [*unit*] that may be estimated together with the wear."""
    return setting("uncertain", words, unit, None)


@dataclass(frozen=True)
class Gaussian:
    """Joint normal distribution of parameters: names, mean (n,), covariance (n, n) [SI units]. origin:
    test and band [Hz] of the fit that it comes from, if any.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    origin: tuple[str, tuple[float, float]] | None = None

    @classmethod
    def of(cls, names: Iterable[str], mean: Iterable[float], covariance: FloatArray) -> Gaussian:
        """The distribution of these, *covariance* (n, n) [SI units]."""
        return cls(tuple(names), tuple(mean), tuple(tuple(row) for row in covariance.tolist()))

    @property
    def std(self) -> FloatArray:
        """Standard deviations (n,) [SI units]."""
        return np.sqrt(np.diag(np.array(self.covariance)))


@dataclass(frozen=True)
class WearSettings(Settings):
    """Settings of a wear identification; *rig* and *posterior*: contents of `rotor` and of `prior`."""

    rotor: str = setting("file", "rotor file, relative to this file", file_kind="rotor", into="rig")
    _: KW_ONLY
    bearing: str = text("name of the worn bearing; default: the last one")
    healthy: bool = flag("no wear: tune viscosity, clearance, ... to a healthy rig")
    response: str = choice("in y and z (FRF), or forward and backward (dFRF)", RESPONSES, "FRF")
    terms: str = choice("all terms of the response, direct or cross terms only", TERMS, "full")
    objective: str = choice(
        "complex: weighted by the FRF's covariance; log: squared log10 of amplitude ratios",
        OBJECTIVES,
        "complex",
    )
    lines: tuple[float, ...] = setting(
        "values", "these frequency lines only; default: all of the band", "Hz", ()
    )
    half_power: tuple[tuple[float, float], ...] = setting(
        "bands", "lines between the half-power points of the peak in each band", "Hz", ()
    )
    depth_limit: float = quantity("largest depth of the search", "m", 50e-6)
    angle_limit: float = quantity("largest angle of the search, either way", "rad", np.pi / 9)
    start_depths: tuple[float, ...] = setting(
        "values", "depths of the mesh of starts", "m", (0.0, 15e-6, 30e-6, 45e-6)
    )
    start_angles: tuple[float, ...] = setting(
        "values",
        "angles of the mesh of starts",
        "rad",
        tuple(np.deg2rad([-15.0, -7.5, 0.0, 7.5, 15.0]).tolist()),
    )
    viscosity: Uncertain | None = nuisance("estimated along, e.g. 0.104 Pa.s +- 3 %", "Pa.s")
    clearance: Uncertain | None = nuisance("of all bearings, estimated along, e.g. 90 um +- 2 %", "m")
    cavitation_pressure: Uncertain | None = nuisance(
        "estimated along, e.g. -0.1 bar +- 0.1 bar; zero or negative", "Pa"
    )
    beta: Uncertain | None = nuisance("damping of the shaft, estimated along, e.g. 1.6e-4 s +- 20 %", "s")
    prior: str = text("an earlier fit of this pipeline (a tuning) whose posterior is the prior")
    same_wear: bool = flag("the fit of `prior` was of this same wear: its depth and angle are known too")
    cells_around: int = integer("cells of the oil film around the journal", 120)
    cells_across: int = integer("cells of the oil film across the bearing", 30)
    rig: RotorRig | None = None
    posterior: Gaussian | None = None

    def __post_init__(self) -> None:
        if self.lines and self.half_power:
            raise SettingError("lines", "'lines' and 'half_power' both choose lines", "leave one of them out")
        self.require_positive("depth_limit")
        if not 0 < self.angle_limit < np.pi / 2:
            raise SettingError("angle_limit", "'angle_limit' must lie between 0 and 90 deg")
        if not all(0 <= depth <= self.depth_limit for depth in self.start_depths):
            what = "'start_depths' leave the range of depths"
            raise SettingError("start_depths", what, "from 0 to depth_limit")
        if not all(abs(angle) <= self.angle_limit for angle in self.start_angles):
            what = "'start_angles' leave the range of angles"
            raise SettingError("start_angles", what, "from -angle_limit to angle_limit")
        if self.same_wear and (not self.prior or self.healthy):
            what = "'same_wear' goes with the 'prior' of a worn bearing"
            raise SettingError("same_wear", what, "prior: FIT, the fit of another speed or load")
        if self.prior and self.nuisances:
            what = f"'prior' already covers {', '.join(self.nuisances)}"
            raise SettingError("prior", what, "leave one of them out")
        self._check_nuisances()
        assert self.mesh
        if self.rig is not None and not self.healthy:
            worn_place(self.rig, self.bearing)

    def _check_nuisances(self) -> None:
        for name in OF_WEAR if self.healthy else ():
            if name in self.written:
                what = f"'{name}' is of a worn bearing; a healthy rig is tuned in all of them"
                raise SettingError(name, what, "leave it out")
        if self.healthy and not self.nuisances:
            hint = f"give one or more of {', '.join(NUISANCES)} with its uncertainty"
            raise SettingError("healthy", "nothing to tune", hint)
        for name, nuisance in self._given.items():
            if name in POSITIVE and not nuisance.value > 0:
                raise SettingError(name, f"'{name}' must be positive")
            if name not in POSITIVE and nuisance.value > 0:
                raise SettingError(name, f"'{name}' is above the ambient pressure", "give zero or less")
        prior = self.nuisance_prior
        for name, mean, std in zip(prior.names, prior.mean, prior.std.tolist(), strict=True):
            # The search reaches as many standard errors to either side, and no further than to zero.
            if name in POSITIVE and REACH * std >= mean:
                what = f"standard error of '{name}' not below {100 / REACH:g} %"
                key = name if self.posterior is None else "prior"
                raise SettingError(key, what, "give a smaller uncertainty")

    @property
    def mesh(self) -> FilmMesh:
        """The cells of the tables' films; ConfigError where they cannot be solved."""
        return FilmMesh(self.cells_around, self.cells_across)

    @property
    def nuisances(self) -> tuple[str, ...]:
        """Nuisance parameters with a standard error, estimated together with the wear."""
        return tuple(name for name, nuisance in self._given.items() if nuisance.std_error > 0)

    @property
    def _given(self) -> dict[str, Uncertain]:
        given = {name: getattr(self, name) for name in NUISANCES}
        return {name: nuisance for name, nuisance in given.items() if nuisance is not None}

    @property
    def nuisance_prior(self) -> Gaussian:
        """The posterior of a tuning, or the settings' values."""
        if self.posterior is not None:
            return self.posterior
        nuisances = [self._given[name] for name in self.nuisances]
        covariance = np.diag([nuisance.std_error**2 for nuisance in nuisances])
        return Gaussian.of(self.nuisances, [nuisance.value for nuisance in nuisances], covariance)

    @property
    def fixed_values(self) -> dict[str, float]:
        """Nuisance parameters fixed at a value, by name."""
        given = self._given.items()
        return {name: nuisance.value for name, nuisance in given if name not in self.nuisances}


# Standard error of a parameter at its bound, relative to its value.
LEAST_SHARE = 1e-3


def with_prior(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    """Settings with the posterior of the fit that `prior` names; ConfigError where there is not one."""
    wear: WearSettings = settings.model_settings
    if not wear.prior:
        return settings
    named = [fit for fit in fits if fit.name == wear.prior]
    if len(named) > 1:
        what = f"wear.prior: '{wear.prior}' has {len(named)} results"
        raise ConfigError(what, hint="give that fit one `test` and one `band`")
    if named:
        whole = replace(posterior(named[0], wear.same_wear), origin=(named[0].test, named[0].band_hz))
        if twice := [name for name in wear.fixed_values if name in whole.names]:
            what = f"wear.{twice[0]}: '{wear.prior}' has tuned it, and a value is given as well"
            raise ConfigError(what, hint="leave it out")
        return replace(settings, model_settings=replace(wear, posterior=whole))
    hint = nearest(wear.prior, [fit.name for fit in fits])
    what = f"wear.prior: no earlier fit '{wear.prior}'"
    raise ConfigError(what, hint=f"fits are made in their order; {hint}")


def posterior(fit: Fit, same_wear: bool = False) -> Gaussian:
    """Mean and covariance of the tuned parameters of a fit [SI units], of depth and angle as well where it
    was of the *same_wear*, inflated where its residual exceeds the noise. ConfigError where it tuned nothing.
    """
    estimated = fit.estimated
    carried = (DEPTH, ANGLE, *NUISANCES) if same_wear else tuple(NUISANCES)
    numbers = [number for number, parameter in enumerate(estimated) if parameter.name in carried]
    if same_wear and not all(
        any(p.name == name and p.std_error for p in estimated) for name in (DEPTH, ANGLE)
    ):
        what = f"wear.same_wear: the fit '{fit.name}' gives no depth and angle with standard errors"
        raise ConfigError(what, hint="begin with the test that tells both best")
    if not numbers:
        hint = "give it wear: {healthy: true, ...}"
        raise ConfigError(f"wear.prior: the fit '{fit.name}' tuned none of {', '.join(NUISANCES)}", hint=hint)
    chosen = [estimated[number] for number in numbers]
    errors = [
        parameter.std_error_inflated or parameter.std_error or LEAST_SHARE * max(abs(parameter.value), 1e-12)
        for parameter in chosen
    ]
    covariance = fit.correlation[np.ix_(numbers, numbers)] * np.outer(errors, errors)
    return Gaussian.of(
        (parameter.name for parameter in chosen), (parameter.value for parameter in chosen), covariance
    )


def check_after(settings: FitSettings, earlier: FitSettings) -> None:
    """ConfigError for a prior of other films, or another shaft, than the rotor file of this fit has."""
    wear, tuned = settings.model_settings, earlier.model_settings
    for name in wear.nuisance_prior.names:
        before, now = (_stated_in_file(each.rig, name) for each in (tuned, wear))
        if before != now:
            what = f"wear.prior: '{wear.prior}' tuned {name}, {before} {UNITS[name]} in its rotor file"
            hint = f"give {name} with its uncertainty in place of `prior`"
            raise ConfigError(f"{what}, and {now} {UNITS[name]} in that of this fit", hint=hint)


def _stated_in_file(rig: RotorRig | None, name: str) -> str:
    """What a rotor file says of a parameter, the films one after the other; none of wear [SI units]."""
    if rig is None or name in (DEPTH, ANGLE):
        return ""
    films = [place.film("wear") for place in rig.bearings if place.is_film]
    numbers = [rig.rotor.beta] if name == "beta" else [getattr(film, name) for film in films]
    return ", ".join(f"{number:.6g}" for number in numbers)


def _fit(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.wear.fit import worn_fit

    prior: Gaussian | None = settings.model_settings.posterior
    if prior is not None and prior.origin is not None:
        test, (low, high) = prior.origin
        begin, end = settings.band or (0.0, math.inf)
        if test == response.name and begin < high and low < end:
            what = f"wear.prior: '{settings.model_settings.prior}' is of this test: its lines count once"
            raise ConfigError(what, hint="name another `test`, or another band")
    return (worn_fit(response, settings),)


WORN_BEARING = ModelKind(
    _fit,
    "wear",
    WearSettings,
    "wear: {rotor: ../configs/rotors/FILE.yaml}",
    earlier=lambda settings: settings.model_settings.prior,
    begin=with_prior,
    check_after=check_after,
    keys=(),
    estimators=("ml",),
)
