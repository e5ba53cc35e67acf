"""The response of a rotor as a function of wear depth and angle, viscosity, clearance, cavitation pressure
and shaft damping.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import ReducedRotor, reduced_rotor
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.shaft import Rotor
from labpipe.methods.wear.settings import ANGLE, DEPTH, Gaussian, WearSettings
from labpipe.methods.wear.tables import (
    Ranges,
    TabledBearing,
    VaryingSupport,
    forward_backward,
    response_with_slopes,
    tabled,
)

# Range of a nuisance parameter about its prior mean, in prior standard deviations.
REACH = 4.0
# Relative step of the difference by the shaft's damping, in which the response is smooth.
BETA_STEP = 1e-3
# Margin of the tables beyond the bounds, for rounding.
TABLE_MARGIN = 1.001
SCALES = {DEPTH: 1e-6, ANGLE: float(np.deg2rad(1.0))}


@dataclass(frozen=True, kw_only=True)
class WornModel:
    """A rig's response on *frequency* [Hz]; *names* in the order of the parameters, all scaled: value [SI] =
    scale * parameter.

    low, high (n,): bounds of the scaled parameters; prior: of the nuisance parameters among them, in SI
    units.
    """

    rig: RotorRig
    bearings: tuple[TabledBearing, ...]
    frequency: tuple[float, ...]
    directional: bool
    names: tuple[str, ...]
    scale: FloatArray
    low: FloatArray
    high: FloatArray
    prior: Gaussian
    mesh: FilmMesh

    @property
    def film_mesh(self) -> FilmMesh:
        """The mesh of the films that refine a minimum: four times the tables' cells around the journal, twice
        those across.

        Around it they follow the film's front and the edges of wear.
        """
        return FilmMesh(4 * self.mesh.around, 2 * self.mesh.across)

    def refined(self, parameters: FloatArray, with_slopes: bool = True) -> WornModel:
        """The model with the films' coefficients and slopes at scaled parameters (n,) [1], on the films' own
        mesh.
        """
        values, mesh = self.values(parameters), self.film_mesh
        return replace(
            self, bearings=tuple(bearing.refined(values, mesh, with_slopes) for bearing in self.bearings)
        )

    def with_mesh_error(self, parameters: FloatArray) -> tuple[WornModel, ...]:
        """One model for every oil film, refined before, with the error of that film's mesh at scaled
        parameters (n,) [1] added.
        """
        values = self.values(parameters)
        models = []
        for number, bearing in enumerate(self.bearings):
            if bearing.place.is_film:
                shifted = bearing.shifted(bearing.mesh_error(values, self.film_mesh))
                models.append(
                    replace(self, bearings=(*self.bearings[:number], shifted, *self.bearings[number + 1 :]))
                )
        return tuple(models)

    def values(self, parameters: FloatArray) -> dict[str, float]:
        """Values by name [SI units] of scaled parameters (n,)."""
        return dict(zip(self.names, (self.scale * parameters).tolist(), strict=True))

    def response(self, parameters: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """H (n_line, 2, 2) [m/N] and its derivatives by the scaled parameters, (n, n_line, 2, 2)."""
        values = self.values(parameters)
        supports = [bearing.support(values, self.names) for bearing in self.bearings]
        beta = values.get("beta", self.rig.rotor.beta)
        response, slopes = response_with_slopes(
            self._rotor(beta), supports, self.rig.response, self.rig.force
        )
        if "beta" in self.names:
            step = BETA_STEP * self.scale[self.names.index("beta")]
            ends = [self._standing(beta + move, supports) for move in (step, -step)]
            slopes[self.names.index("beta")] = (ends[0] - ends[1]) / (2 * step)
        slopes = slopes * self.scale[:, None, None, None]
        return (
            (forward_backward(response), forward_backward(slopes)) if self.directional else (response, slopes)
        )

    def _standing(self, beta: float, supports: list[VaryingSupport]) -> ComplexArray:
        standing = self._rotor(beta).on(support.support for support in supports)
        return standing.response(self.rig.response, self.rig.force)

    def _rotor(self, beta: float) -> ReducedRotor:
        nodes = tuple(
            sorted({*(bearing.place.node for bearing in self.bearings), self.rig.force, self.rig.response})
        )
        rotor = self.rig.rotor if beta == self.rig.rotor.beta else replace(self.rig.rotor, beta=beta)
        return _reduced_rotor(rotor, nodes, self.frequency, self.rig.omega)


@lru_cache(maxsize=8)
def _reduced_rotor(
    rotor: Rotor, nodes: tuple[int, ...], frequency: tuple[float, ...], speed: float
) -> ReducedRotor:
    return reduced_rotor(rotor, nodes, np.array(frequency), speed)


def worn_model(settings: WearSettings, frequency: FloatArray) -> WornModel:
    """The model of a fit on its lines *frequency* (n_line,) [Hz].

    FitError without a rotor, ConfigError where settings and rotor do not fit together.
    """
    if settings.rig is None:
        raise FitError("no rotor was read for this fit", hint="name it with wear.rotor")
    prior = settings.nuisance_prior
    centre = {**settings.fixed_values, **dict(zip(prior.names, prior.mean, strict=True))}
    rig = _centred(settings.rig, centre)
    worn = "" if settings.healthy else rig.place(settings.bearing).name
    ranges, box = _reach(settings, prior, rig)
    loads, mesh = rig.static_loads(), FilmMesh(settings.cells_around, settings.cells_across)
    bearings = tuple(
        tabled(place, loads[place.name], rig.omega, place.name == worn, ranges, mesh)
        for place in rig.bearings
    )
    nuisances = tuple(name for name in prior.names if name not in SCALES)
    names = (*(() if settings.healthy else (DEPTH, ANGLE)), *nuisances)
    spread = dict(zip(prior.names, prior.std.tolist(), strict=True))
    scale = np.array([SCALES.get(name) or spread[name] for name in names])
    low, high = (np.array([box[name][end] for name in names]) / scale for end in (0, 1))
    return WornModel(
        rig=rig,
        bearings=bearings,
        frequency=tuple(np.asarray(frequency, float).tolist()),
        directional=settings.response == "dFRF",
        names=names,
        scale=scale,
        low=low,
        high=high,
        prior=prior,
        mesh=mesh,
    )


def _centred(rig: RotorRig, centre: dict[str, float]) -> RotorRig:
    """The rig with bearings and shaft damping at the prior means, around which the tables are made."""
    film_values: dict[str, float] = {
        name: value for name, value in centre.items() if name != "beta" and name not in SCALES
    }
    rig = rig.with_bearings((), **film_values) if film_values else rig
    return replace(rig, rotor=replace(rig.rotor, beta=centre["beta"])) if "beta" in centre else rig


def _reach(
    settings: WearSettings, prior: Gaussian, rig: RotorRig
) -> tuple[Ranges, dict[str, tuple[float, float]]]:
    """The tables' ranges and the bounds of all parameters, SI units."""
    box = {DEPTH: (0.0, settings.depth_limit), ANGLE: (-settings.angle_limit, settings.angle_limit)}
    for name, mean, std in zip(prior.names, prior.mean, prior.std, strict=True):
        low, high = box.get(name, (-np.inf, np.inf))
        box[name] = (max(low, mean - REACH * float(std)), min(high, mean + REACH * float(std)))
    if "cavitation_pressure" in box:
        box["cavitation_pressure"] = (box["cavitation_pressure"][0], min(box["cavitation_pressure"][1], 0.0))
    viscosity, clearance = (_factor(prior, box, name) for name in ("viscosity", "clearance"))
    # A pressure that is given, not estimated, needs its axis in the table as well.
    films = [place.film("wear") for place in rig.bearings if place.is_film]
    lowest = min(
        box.get("cavitation_pressure", (0.0,))[0], *(1.25 * film.cavitation_pressure for film in films)
    )
    return Ranges(settings.depth_limit, settings.angle_limit, viscosity, clearance, lowest), box


def _factor(prior: Gaussian, box: dict[str, tuple[float, float]], name: str) -> float:
    """Largest ratio of a parameter to its prior mean within its bounds, either way."""
    if name not in box:
        return 1.0
    mean = prior.mean[prior.names.index(name)]
    return TABLE_MARGIN * max(box[name][1] / mean, mean / box[name][0])
