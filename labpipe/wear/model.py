"""The response of a rotor as a function of wear depth and angle, viscosity, clearance, cavitation pressure and shaft damping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.journal_mesh import FilmMesh
from labpipe.errors import FitError
from labpipe.rigs.rotor_rig import RotorRig
from labpipe.rotors.parts import Rotor
from labpipe.rotors.reduction import ReducedRotor, reduced_rotor
from labpipe.rotors.worn import VaryingSupport, forward_backward, response_with_slopes
from labpipe.wear.settings import ANGLE, DEPTH, Gaussian, WearSettings
from labpipe.wear.tables import Ranges, TabledBearing, tabled

# Nuisance parameters may move this many standard deviations of what is known of them.
REACH = 4.0
# Relative step of the difference by the shaft's damping, in which the response is smooth.
BETA_STEP = 1e-3
# Tables reach a little beyond the bounds, where rounding may ask.
TABLE_MARGIN = 1.001
SCALES = {DEPTH: 1e-6, ANGLE: float(np.deg2rad(1.0))}


@dataclass(frozen=True)
class WornModel:
    """A rig's response on *frequency* [Hz]; *names* in the order of the parameters, all scaled: value [SI] = scale * parameter.

    low, high (n,): bounds of the scaled parameters; known: what is known of some of them beforehand, in SI units.
    """

    rig: RotorRig
    bearings: tuple[TabledBearing, ...]
    frequency: tuple[float, ...]
    directional: bool
    names: tuple[str, ...]
    scale: FloatArray
    low: FloatArray
    high: FloatArray
    known: Gaussian
    mesh: FilmMesh

    def refined(self, parameters: FloatArray, with_slopes: bool = True) -> WornModel:
        """The model with the films' own coefficients and slopes at these parameters, on a mesh with cells of half the size.

        A table cannot follow every bend of the coefficients: its error moves a deep wear by a micrometre.
        """
        fine, values = FilmMesh(2 * self.mesh.around, 2 * self.mesh.across), self.values(parameters)
        return replace(self, bearings=tuple(bearing.refined(values, fine, with_slopes) for bearing in self.bearings))

    def values(self, parameters: FloatArray) -> dict[str, float]:
        """SI values by name."""
        return dict(zip(self.names, (self.scale * parameters).tolist(), strict=True))

    def response(self, parameters: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """H (n_line, 2, 2) [m/N] and its derivatives by the scaled parameters, (n, n_line, 2, 2)."""
        values = self.values(parameters)
        supports = [bearing.support(values, self.names) for bearing in self.bearings]
        beta = values.get("beta", self.rig.rotor.beta)
        response, slopes = response_with_slopes(self._rotor(beta), supports, self.rig.response, self.rig.force)
        if "beta" in self.names:
            step = BETA_STEP * self.scale[self.names.index("beta")]
            ends = [self._standing(beta + move, supports) for move in (step, -step)]
            slopes[self.names.index("beta")] = (ends[0] - ends[1]) / (2 * step)
        slopes = slopes * self.scale[:, None, None, None]
        return (forward_backward(response), forward_backward(slopes)) if self.directional else (response, slopes)

    def _standing(self, beta: float, supports: list[VaryingSupport]) -> ComplexArray:
        """H of the rotor with another damping on the same bearings."""
        standing = self._rotor(beta).on(one.support for one in supports)
        return standing.response(self.rig.response, self.rig.force)

    def _rotor(self, beta: float) -> ReducedRotor:
        nodes = tuple(sorted({*(bearing.place.node for bearing in self.bearings), self.rig.force, self.rig.response}))
        rotor = self.rig.rotor if beta == self.rig.rotor.beta else replace(self.rig.rotor, beta=beta)
        return _kept_rotor(rotor, nodes, self.frequency, self.rig.omega)


@lru_cache(maxsize=8)
def _kept_rotor(rotor: Rotor, nodes: tuple[int, ...], frequency: tuple[float, ...], speed: float) -> ReducedRotor:
    """The free rotor between the nodes, solved once."""
    return reduced_rotor(rotor, nodes, np.array(frequency), speed)


def worn_model(settings: WearSettings, frequency: FloatArray) -> WornModel:
    """The model of a fit on its lines; FitError without a rotor, ConfigError where settings and rotor do not fit together."""
    if settings.rig is None:
        raise FitError("no rotor was read for this fit", hint="name it with wear.rotor")
    known = settings.known
    centre = {**settings.given, **dict(zip(known.names, known.mean, strict=True))}
    rig = _centred(settings.rig, centre)
    worn = "" if settings.healthy else rig.place(settings.bearing).name
    ranges, box = _reach(settings, known, rig)
    loads, mesh = rig.static_loads(), FilmMesh(settings.cells_around, settings.cells_across)
    bearings = tuple(tabled(place, loads[place.name], rig.omega, place.name == worn, ranges, mesh) for place in rig.bearings)
    names = (*(() if settings.healthy else (DEPTH, ANGLE)), *known.names)
    scale = np.array([*(SCALES[name] for name in names if name in SCALES), *known.std])
    low, high = (np.array([box[name][end] for name in names]) / scale for end in (0, 1))
    lines = tuple(np.asarray(frequency, float).tolist())
    return WornModel(rig, bearings, lines, settings.response == "dFRF", names, scale, low, high, known, mesh)


def _centred(rig: RotorRig, centre: dict[str, float]) -> RotorRig:
    """The rig with what is known of its bearings and its damping, around which the tables are made."""
    own: dict[str, float] = {name: value for name, value in centre.items() if name != "beta"}
    rig = rig.with_bearings((), **own) if own else rig
    return replace(rig, rotor=replace(rig.rotor, beta=centre["beta"])) if "beta" in centre else rig


def _reach(settings: WearSettings, known: Gaussian, rig: RotorRig) -> tuple[Ranges, dict[str, tuple[float, float]]]:
    """The tables' ranges and the bounds of all parameters, SI units."""
    box = {DEPTH: (0.0, settings.depth_limit), ANGLE: (-settings.angle_limit, settings.angle_limit)}
    for name, mean, std in zip(known.names, known.mean, known.std, strict=True):
        box[name] = (mean - REACH * float(std), mean + REACH * float(std))
    if "cavitation_pressure" in box:
        box["cavitation_pressure"] = (box["cavitation_pressure"][0], min(box["cavitation_pressure"][1], 0.0))
    viscosity, clearance = (_factor(known, box, name) for name in ("viscosity", "clearance"))
    # A pressure that is given, not estimated, needs its axis in the table as well.
    films = [place.film("wear") for place in rig.bearings if place.is_film]
    lowest = min(box.get("cavitation_pressure", (0.0,))[0], *(1.25 * film.cavitation_pressure for film in films))
    return Ranges(settings.depth_limit, settings.angle_limit, viscosity, clearance, lowest), box


def _factor(known: Gaussian, box: dict[str, tuple[float, float]], name: str) -> float:
    """How far up and down from its mean a parameter goes."""
    if name not in box:
        return 1.0
    mean = known.mean[known.names.index(name)]
    return TABLE_MARGIN * max(box[name][1] / mean, mean / box[name][0])
