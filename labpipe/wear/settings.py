"""The parameters of a wear identification: the section `wear:` of a fit with model worn-bearing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, Uncertain, setting
from labpipe.rigs.rotor_rig import RotorRig, worn_place

RESPONSES = ("FRF", "dFRF")
TERMS = ("full", "direct", "cross")
OBJECTIVES = ("complex", "log")
# What may be estimated along with the wear: the name of the setting, its unit.
NUISANCES = {"viscosity": "Pa.s", "clearance": "m", "cavitation_pressure": "Pa", "beta": "s"}
DEPTH, ANGLE = "wear_depth", "wear_angle"
UNITS = {DEPTH: "m", ANGLE: "rad", **NUISANCES}


@dataclass(frozen=True)
class Gaussian:
    """What is known beforehand of some parameters: names, mean (n,) and covariance (n, n) in SI units."""

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]

    @property
    def std(self) -> FloatArray:
        """Standard deviations (n,)."""
        return np.sqrt(np.diag(np.array(self.covariance)))


@dataclass(frozen=True)
class WearSettings(Settings):
    """How wear is looked for; *rig* and *posterior* are what `rotor` and `prior` name."""

    rotor: str = setting("file", "rotor file, relative to this file", file_kind="rotor", into="rig")
    bearing: str = setting("text", "name of the worn bearing; default: the last one", default="")
    healthy: bool = setting("flag", "no wear: tune viscosity, clearance, ... to a healthy rig", default=False)
    response: str = setting("choice", "in y and z (FRF), or forward and backward (dFRF)", choices=RESPONSES, default="FRF")
    terms: str = setting("choice", "all terms of the response, direct or cross terms only", choices=TERMS, default="full")
    objective: str = setting(
        "choice", "complex: weighted by the FRF's covariance; log: squared log10 of amplitude ratios", choices=OBJECTIVES, default="complex"
    )
    lines: tuple[float, ...] = setting("values", "these frequency lines only; default: all of the band", unit="Hz", default=())
    half_power: tuple[tuple[float, float], ...] = setting(
        "bands", "lines between the half-power points of the peak in each band", unit="Hz", default=()
    )
    depth_limit: float = setting("value", "largest depth looked for", unit="m", default=50e-6)
    angle_limit: float = setting("value", "largest angle to either side", unit="rad", default=np.pi / 9)
    start_depths: tuple[float, ...] = setting("values", "depths of the mesh of starts", unit="m", default=(0.0, 15e-6, 30e-6, 45e-6))
    start_angles: tuple[float, ...] = setting(
        "values", "angles of the mesh of starts", unit="rad", default=tuple(np.deg2rad([-15.0, -7.5, 0.0, 7.5, 15.0]).tolist())
    )
    viscosity: Uncertain | None = setting("uncertain", "estimated along, e.g. 0.104 Pa.s +- 3 %", unit="Pa.s", default=None)
    clearance: Uncertain | None = setting("uncertain", "of all bearings, estimated along, e.g. 90 um +- 2 %", unit="m", default=None)
    cavitation_pressure: Uncertain | None = setting(
        "uncertain", "estimated along, e.g. -0.1 bar +- 0.1 bar; zero or negative", unit="Pa", default=None
    )
    beta: Uncertain | None = setting("uncertain", "damping of the shaft, estimated along, e.g. 1.6e-4 s +- 20 %", unit="s", default=None)
    prior: str = setting("text", "an earlier fit of this pipeline (a tuning) whose result is what is known beforehand", default="")
    cells_around: int = setting("integer", "cells of the oil film around the journal", default=120)
    cells_across: int = setting("integer", "cells of the oil film across the bearing", default=30)
    rig: RotorRig | None = None
    posterior: Gaussian | None = None

    def __post_init__(self) -> None:
        if self.lines and self.half_power:
            raise ConfigError("'lines' and 'half_power' both choose lines", hint="leave one of them out")
        if not (self.depth_limit > 0 and 0 < self.angle_limit < np.pi / 2):
            raise ConfigError("'depth_limit' must be positive and 'angle_limit' between 0 and 90 deg")
        if not self.start_depths or not self.start_angles:
            raise ConfigError("'start_depths' and 'start_angles' need one value or more")
        if not all(0 <= depth <= self.depth_limit for depth in self.start_depths):
            raise ConfigError("'start_depths' leave the range of depths", hint="from 0 to depth_limit")
        if not all(abs(angle) <= self.angle_limit for angle in self.start_angles):
            raise ConfigError("'start_angles' leave the range of angles", hint="from -angle_limit to angle_limit")
        if self.prior and self.nuisances:
            raise ConfigError(f"'prior' already tells what is known of {', '.join(self.nuisances)}", hint="leave one of them out")
        if self.healthy and not self.nuisances:
            raise ConfigError("nothing to tune", hint=f"give one or more of {', '.join(NUISANCES)} with its doubt")
        self._check_nuisances()
        if self.rig is not None and not self.healthy:
            worn_place(self.rig, self.bearing)

    def _check_nuisances(self) -> None:
        for name in NUISANCES:
            given: Uncertain | None = getattr(self, name)
            if given is None:
                continue
            if name == "cavitation_pressure":
                if given.value > 0:
                    raise ConfigError("'cavitation_pressure' is above the ambient pressure", hint="give zero or less")
            elif not given.value > 0:
                raise ConfigError(f"'{name}' must be positive")
            elif given.std_error > 0.25 * given.value:
                raise ConfigError(f"'{name}' is known to worse than 25 %", hint="say better what is known of it")

    @property
    def nuisances(self) -> tuple[str, ...]:
        """The parameters that are estimated along by their own settings."""
        return tuple(name for name in NUISANCES if getattr(self, name) is not None and getattr(self, name).std_error > 0)

    @property
    def known(self) -> Gaussian:
        """What is known beforehand of the nuisance parameters: the posterior of a tuning, or what the settings say."""
        if self.posterior is not None:
            return self.posterior
        given: list[Uncertain] = [getattr(self, name) for name in self.nuisances]
        covariance = np.diag([one.std_error**2 for one in given])
        rows = tuple(tuple(row) for row in covariance.tolist())
        return Gaussian(self.nuisances, tuple(one.value for one in given), rows)

    @property
    def given(self) -> dict[str, float]:
        """Parameters that the settings fix at a value, without doubt."""
        fixed = {name: getattr(self, name) for name in NUISANCES if name not in self.nuisances}
        return {name: one.value for name, one in fixed.items() if one is not None}
