"""Coefficients of the bearings of a rotor as functions of wear and its conditions, and the response of the
rotor with them.

With Z = K + j w C of the bearings and H the receptance of the rotor on them, dH/dp = -H_ob (dZ/dp) H_bf:
exact, and from the few dofs of the reduced rotor only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing.bearing import JournalBearing, JournalEquilibrium, journal_equilibrium
from labpipe.methods.journal_bearing.curve import PARAMETERS, JournalTable, TableRange, journal_table
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import ReducedRotor
from labpipe.methods.rotor.rig import BearingPlace
from labpipe.methods.rotor.shaft import NodeSupport
from labpipe.spectra.convert import FROM_DIRECTIONAL


@dataclass(frozen=True)
class VaryingSupport:
    """A bearing, and the derivatives of its coefficients by *n* parameters, (n, 2, 2) [SI] each."""

    support: NodeSupport
    stiffness_slopes: FloatArray
    damping_slopes: FloatArray


def response_with_slopes(
    rotor: ReducedRotor, bearings: Iterable[VaryingSupport], output: int, force: int
) -> tuple[ComplexArray, ComplexArray]:
    """H (n_line, 2, 2) [m/N] from forces at a node to displacements at another, and dH/dp (n, n_line, 2, 2).
    *bearings*, added to *rotor*, share their parameters; all nodes are its own. Equation (rotor-slopes).
    """
    bearings = list(bearings)
    response, to_output, from_force = rotor.paths([bearing.support for bearing in bearings], output, force)
    # H_ob H_bf of every bearing and element of its coefficients: all parameters are one product of matrices.
    elements = np.ndindex(len(bearings), 2, 2)
    places = [(2 * number + row, 2 * number + column) for number, row, column in elements]
    products = np.empty((2, len(places), rotor.omega.size, 2, 2), np.complex128)
    for product, (row, column) in zip(products[0], places, strict=True):
        np.multiply(to_output[:, :, row, None], from_force[:, column, None, :], out=product)
    np.multiply(products[0], 1j * rotor.omega[:, None, None], out=products[1])
    each = [*(of.stiffness_slopes for of in bearings), *(of.damping_slopes for of in bearings)]
    slopes = np.concatenate([of_one.reshape(-1, 4) for of_one in each], axis=1)
    return response, -(slopes @ products.reshape(slopes.shape[1], -1)).reshape(-1, *response.shape)


def forward_backward(matrix: ComplexArray) -> ComplexArray:
    """The directional response A^-1 H A = [[H_ff, H_fb], [H_bf, H_bb]] of (..., 2, 2) [m/N] in y and z
    (Mendes et al. 2017, eq. 18).
    """
    return np.linalg.inv(FROM_DIRECTIONAL) @ matrix @ FROM_DIRECTIONAL


# Nodes of depth and angle by the number of further axes. The search uses tables; minima are refined on the
# films.
WEAR_NODES = ((41, 9), (21, 7), (13, 5))
# Nodes along further axes, and of the Sommerfeld number where it varies by less than a factor either way.
FURTHER_NODES = 4
NARROW, NARROW_NODES = 1.1, 3
# Change of displacement over clearance in the last step of a table's equilibria, far below its nodes'.
TABLE_TOLERANCE = 1e-5
# The same of a film that corrects a table: tight, whatever film it started from.
FILM_TOLERANCE = 1e-9
WEAR = ("wear_depth", "wear_angle")
# Steps of the film's differences, relative for viscosity and clearance [m, rad, 1, 1, Pa].
STEPS = {
    "wear_depth": 1e-6,
    "wear_angle": float(np.deg2rad(1.0)),
    "viscosity": 0.01,
    "clearance": 0.01,
    "cavitation_pressure": 2e3,
}


def table_range(depth: float, angle: float, *factors: float, cavitation_pressure: float = 0.0) -> TableRange:
    """What the tables must cover: wear limits [m, rad], *factors* of viscosity and clearance up and down,
    lowest cavitation pressure [Pa].
    """
    viscosity, clearance = factors or (1.0, 1.0)
    further = (max(viscosity, clearance) > 1) + (cavitation_pressure < 0)
    return TableRange(
        depth=depth,
        angle=angle,
        viscosity_factor=viscosity,
        clearance_factor=clearance,
        cavitation_pressure=cavitation_pressure,
        n_depth=WEAR_NODES[further][0],
        n_angle=WEAR_NODES[further][1],
        n_sommerfeld=NARROW_NODES if viscosity * clearance**2 < NARROW else FURTHER_NODES,
        n_cavitation=FURTHER_NODES,
        tolerance=TABLE_TOLERANCE,
    )


def _point(bearing: JournalBearing) -> FloatArray:
    return np.array([getattr(bearing, name) for name in PARAMETERS])


def film_slopes(film: JournalEquilibrium, names: Collection[str]) -> dict[str, FloatArray]:
    """Derivatives (2, 2, 2) of stiffness and damping by parameters *names* [N/m, N s/m per SI unit], by
    differences wide enough for a film of finite cells.

    Without wear K c / W and C c Omega / W depend on mu / c^2 (and the cavitation pressure) only: the
    derivative by clearance follows from that by viscosity.
    """
    alike = film.bearing.wear_depth == 0 and "clearance" in names
    differing = {*names, "viscosity"} - {"clearance"} if alike else names
    slopes = {name: _difference(film, name) for name in differing}
    if alike:
        scaled = np.stack([film.stiffness, film.damping]) + 2 * film.bearing.viscosity * slopes["viscosity"]
        slopes["clearance"] = -scaled / film.bearing.clearance
    return {name: slopes[name] for name in names}


def _difference(film: JournalEquilibrium, name: str) -> FloatArray:
    here = float(getattr(film.bearing, name))
    step = STEPS[name] * (here if name in ("viscosity", "clearance") else 1.0)
    ends = [here + step, here - step]
    if name == "wear_depth":
        ends[1] = max(ends[1], 0.0)
    if name == "cavitation_pressure":
        ends[0] = min(ends[0], 0.0)
    films = [
        journal_equilibrium(replace(film.bearing, **{name: end}), film.load, film.speed, film.mesh, film)
        for end in ends
    ]
    change = np.array([films[0].stiffness - films[1].stiffness, films[0].damping - films[1].damping])
    return change / (ends[0] - ends[1])


cached_table = lru_cache(maxsize=32)(journal_table)


@dataclass(frozen=True)
class Correction:
    """Film minus table at a *point* (5,) of PARAMETERS [SI units]: *offset* (2, 2, 2) of stiffness [N/m] and
    damping [N s/m], and its *slopes* (2, 5, 2, 2) by each of them.
    """

    point: FloatArray
    offset: FloatArray
    slopes: FloatArray

    def at(self, point: FloatArray) -> FloatArray:
        """Of stiffness [N/m] and damping [N s/m], (2, 2, 2), at a nearby *point* (5,)."""
        return self.offset + np.einsum("kpij,p->kij", self.slopes, point - self.point)


@dataclass(frozen=True)
class TabledBearing:
    """A bearing on its node with its *table*, or *fixed* coefficients where nothing varies it. film: the last
    one that corrected it, from which the next one starts.
    """

    place: BearingPlace
    load: tuple[float, float]
    speed: float
    worn: bool
    table: JournalTable | None
    fixed: NodeSupport | None = None
    correction: Correction | None = None
    film: JournalEquilibrium | None = None

    def support(self, values: Mapping[str, float], names: tuple[str, ...]) -> VaryingSupport:
        """Coefficients at *values* by name [SI], with their derivatives by the parameters *names*."""
        if self.table is None:
            assert self.fixed is not None
            return VaryingSupport(self.fixed, *np.zeros((2, len(names), 2, 2)))
        bearing = self._bearing(values)
        matrices, by_parameter = self.table.coefficients(bearing, self.speed)
        if self.correction is not None:
            matrices = matrices + self.correction.at(_point(bearing))
            by_parameter += self.correction.slopes
        slopes = np.zeros((2, len(names), 2, 2))
        for name in self._followed_names(names):
            slopes[:, names.index(name)] = by_parameter[:, PARAMETERS.index(name)]
        return VaryingSupport(NodeSupport(self.place.node, *matrices), *slopes)

    def refine(self, values: Mapping[str, float], mesh: FilmMesh, with_slopes: bool) -> TabledBearing:
        """This bearing with the film's own coefficients at *values*, on a finer mesh, and its slopes as well
        (*with_slopes*) or those of the last correction, made nearby.
        """
        if not self.place.is_film:
            return self
        bearing = self._bearing(values)
        film = self._film(bearing, mesh)
        if self.table is None:
            return replace(self, fixed=self.place.springs(film), film=film)
        matrices, by_parameter = self.table.coefficients(bearing, self.speed)
        slopes = np.zeros_like(by_parameter) if self.correction is None else self.correction.slopes
        if with_slopes:
            slopes = np.zeros_like(by_parameter)
            for name, slope in film_slopes(film, self._followed_names(values)).items():
                number = PARAMETERS.index(name)
                slopes[:, number] = slope - by_parameter[:, number]
        correction = Correction(_point(bearing), np.stack([film.stiffness, film.damping]) - matrices, slopes)
        return replace(self, correction=correction, film=film)

    def _film(self, bearing: JournalBearing, mesh: FilmMesh) -> JournalEquilibrium:
        if self.film is not None and self.film.bearing == bearing and self.film.mesh == mesh:
            return self.film
        return journal_equilibrium(bearing, self.load, self.speed, mesh, self.film, FILM_TOLERANCE)

    def mesh_error(self, values: Mapping[str, float], mesh: FilmMesh) -> FloatArray:
        """Error of stiffness [N/m] and damping [N s/m] by the film's *mesh*, (2, 2, 2), a standard deviation
        with its signs: a third of the change from half the cells each way (second order).
        """
        bearing = self._bearing(values)
        fine = self._film(bearing, mesh)
        coarse = journal_equilibrium(bearing, self.load, self.speed, mesh.halve() or mesh, fine.coarser)
        return np.array([fine.stiffness - coarse.stiffness, fine.damping - coarse.damping]) / 3

    def shift(self, change: FloatArray) -> TabledBearing:
        """This bearing, refined before, with a *change* (2, 2, 2) of stiffness [N/m] and damping [N s/m]."""
        if (fixed := self.fixed) is not None:
            shifted = NodeSupport(self.place.node, fixed.stiffness + change[0], fixed.damping + change[1])
            return replace(self, fixed=shifted)
        assert self.correction is not None
        return replace(self, correction=replace(self.correction, offset=self.correction.offset + change))

    def _followed_names(self, names: Collection[str]) -> list[str]:
        return [name for name in PARAMETERS if name in names and (self.worn or name not in WEAR)]

    def _bearing(self, values: Mapping[str, float]) -> JournalBearing:
        return replace(
            self.place.film("wear"), **{name: values[name] for name in self._followed_names(values)}
        )


def tabulate(
    place: BearingPlace,
    load: tuple[float, float],
    speed: float,
    worn: bool,
    ranges: TableRange,
    mesh: FilmMesh,
) -> TabledBearing:
    """A bearing of the rig with its table. ConfigError where one with fixed wear would follow parameters."""
    wide = ranges.sommerfeld_factor > 1 or ranges.cavitation_pressure < 0
    if not worn and not (place.is_film and wide):
        return TabledBearing(place, load, speed, worn, None, place.support(load, speed, mesh))
    bearing = place.film("wear")
    if bearing.wear_depth > 0 and not worn:
        what = "has a fixed wear, which cannot be combined with estimated viscosity, clearance or cavitation"
        raise ConfigError(f"'{place.name}' {what} pressure", hint="leave them out, or its wear")
    ranges = ranges if worn else replace(ranges, depth=0.0)
    return TabledBearing(place, load, speed, worn, cached_table(bearing, load, speed, ranges, mesh))
