"""Journal coefficients as smooth functions: of the Sommerfeld number without wear, and as a table over wear.

At a given L / D and groove, K c / W, C c Omega / W, eccentricity and attitude depend on S = mu N L D / W (R /
c)^2 only; extrapolated to cells of no size (Richardson): (4 fine - coarse) / 3 of a mesh and of half its
cells each way. x points along the static load and y a quarter turn further with the spin.

With wear they depend on sqrt(depth / c), the wear angle, ln S and p_cav L D / W: a tensor product of cubic
splines, even in the root, so that at zero depth angle and derivative by depth vanish.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.methods.journal_bearing.bearing import (
    DEFAULT_MESH,
    TOLERANCE,
    JournalBearing,
    JournalEquilibrium,
    journal_equilibrium,
)
from labpipe.methods.journal_bearing.film import FilmMesh

# Cells of 1.25 deg: an edge of a 20 deg groove lies between two cells, also of half as many. Thresholds of
# the shipped rotor lie within .005 % of those of four times the cells.
CURVE_MESH = FilmMesh(288, 40)
LOWEST_SOMMERFELD = 0.008
HIGHEST_SOMMERFELD = 30.0
NODES = 96
# x = -z (the load of the tabulated bearing acts downwards), y = y.
TO_LOAD_FRAME = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class JournalCurve:
    """Coefficients over ln S at one length over diameter and groove width; made by `journal_curve`.
    spline: K c / W (4), C c Omega / W (4), eccentricity ratio, attitude [rad]; slope: its derivative.
    """

    spline: scipy.interpolate.BSpline
    slope: scipy.interpolate.BSpline

    def coefficients(self, sommerfeld: FloatArray) -> tuple[FloatArray, FloatArray]:
        """K c / W, then C c Omega / W, row by row [-] at Sommerfeld numbers (...) [-], and their derivatives
        by ln S, (..., 8) each; FitError outside the table.
        """
        place = self._place(sommerfeld)
        return self.spline(place)[..., :8], self.slope(place)[..., :8]

    def rest(self, sommerfeld: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eccentricity ratio [-] and attitude [rad] from the load with the spin, same shape; FitError outside
        the table.
        """
        values = self.spline(self._place(sommerfeld))
        return values[..., 8], values[..., 9]

    def _place(self, sommerfeld: FloatArray) -> FloatArray:
        number = np.asarray(sommerfeld, np.float64)
        if not np.all((number >= LOWEST_SOMMERFELD) & (number <= HIGHEST_SOMMERFELD)):
            ends = f"{np.max(number):.3g} (lowest {np.min(number):.3g})"
            table = f"from {LOWEST_SOMMERFELD:g} to {HIGHEST_SOMMERFELD:g}"
            what = f"a Sommerfeld number of {ends} lies outside the bearing's table"
            raise FitError(what, hint=f"{table}; check viscosity, clearance and load")
        return np.log(number)


def sommerfeld_number(bearing: JournalBearing, load: FloatArray, speed: FloatArray) -> FloatArray:
    """S = mu N L D / W (R / c)^2 [-], N in [Hz], at loads [N] and speeds [rad/s] of the same shape."""
    return np.asarray(bearing.force_scale(1.0) / (6 * np.pi) * np.asarray(speed) / np.asarray(load))


@lru_cache(maxsize=8)
def journal_curve(
    length_over_diameter: float, groove_width: float = 0.0, mesh: FilmMesh = CURVE_MESH, nodes: int = NODES
) -> JournalCurve:
    """The curve of a bearing by its *length_over_diameter* and *groove_width* [rad], made in a second;
    *mesh*: the finer of the two, ConfigError where it cannot be halved. Equation (jour-richardson).
    """
    half = mesh.half()
    bearing = JournalBearing(
        diameter=1.0, length=length_over_diameter, clearance=1e-3, viscosity=1.0, groove_width=groove_width
    )
    places = np.linspace(np.log(LOWEST_SOMMERFELD), np.log(HIGHEST_SOMMERFELD), nodes)
    fine, coarse = (_rows(bearing, places, cells) for cells in (mesh, half))
    spline = scipy.interpolate.make_interp_spline(places, (4 * fine - coarse) / 3, 3)
    return JournalCurve(spline, spline.derivative())


def curve_of(bearing: JournalBearing) -> JournalCurve:
    """The curve of a *bearing*; ConfigError for wear or a cavitation pressure, which it does not hold."""
    if bearing.wear_depth or bearing.cavitation_pressure:
        what = "a worn oil film, or one that tears below ambient, has no curve over its Sommerfeld number"
        raise ConfigError(what, hint="leave 'wear' and 'cavitation_pressure' out")
    return journal_curve(bearing.length / bearing.diameter, bearing.groove_width)


def _rows(bearing: JournalBearing, places: FloatArray, mesh: FilmMesh) -> FloatArray:
    rows = []
    near: JournalEquilibrium | None = None
    for place in places[::-1]:
        weight = bearing.force_scale(1.0) / (6 * np.pi * float(np.exp(place)))
        near = journal_equilibrium(bearing, (0.0, -weight), 1.0, mesh, near)
        scale = near.bearing.clearance / weight
        turned = TO_LOAD_FRAME @ np.stack([near.stiffness, near.damping]) @ TO_LOAD_FRAME.T * scale
        rows.append([*turned.ravel(), near.eccentricity_ratio, near.attitude])
    return np.array(rows[::-1])


AXES = ("wear depth", "wear angle", "Sommerfeld number", "cavitation pressure")
PARAMETERS = ("wear_depth", "wear_angle", "viscosity", "clearance", "cavitation_pressure")
CUBIC = 3
# Root of depth over clearance below which the limit of the derivative at zero depth applies.
LEAST_ROOT = 1e-4


@dataclass(frozen=True, kw_only=True)
class TableRange:
    """Ranges and numbers of nodes: depth up to *depth* [m] (zero: no axes of wear), angle +-*angle* [rad],
    viscosity and clearance by factors up and down (1 and 1: no Sommerfeld axis), cavitation pressures down to
    *cavitation_pressure* [Pa] (zero: no axis); *tolerance* [-] of the equilibria.
    """

    depth: float = 50e-6
    angle: float = np.pi / 9
    viscosity_factor: float = 1.0
    clearance_factor: float = 1.0
    cavitation_pressure: float = 0.0
    n_depth: int = 41
    n_angle: int = 9
    n_sommerfeld: int = 4
    n_cavitation: int = 5
    tolerance: float = TOLERANCE

    @property
    def sommerfeld_factor(self) -> float:
        """Factor of S = mu / c^2 from those of viscosity and clearance."""
        return self.viscosity_factor * self.clearance_factor**2


@dataclass(frozen=True)
class JournalTable:
    """Scaled coefficients K c / W and C c Omega / W [-], made by `journal_table`; active: indices of the AXES
    with more than one node; low, high (4,): their ranges; spline: K, then C.
    """

    bearing: JournalBearing
    load: tuple[float, float]
    active: tuple[int, ...]
    low: FloatArray
    high: FloatArray
    spline: scipy.interpolate.NdBSpline

    def coefficients(
        self, bearing: JournalBearing, speed: float, size: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Stiffness [N/m] and damping [N s/m] (2, 2, 2) of a bearing that differs from the table's by
        PARAMETERS, at *speed* [rad/s] and a load of *size* [N], by default the table's, and their derivatives
        (2, 5, 2, 2) by PARAMETERS [SI units]. FitError outside the table. Equation (jour-table).
        """
        weight = float(np.hypot(*self.load)) if size is None else size
        point, slopes = _place(bearing, weight, speed)
        inside = self._inside(point)
        values = self.spline(inside)[0]
        by_axis = np.zeros((len(AXES), 8))
        for number, axis in enumerate(self.active):
            by_axis[axis] = self.spline(inside, nu=[int(n == number) for n in range(len(self.active))])[0]
        scale = weight / bearing.clearance * np.repeat([1, 1 / speed], 4)
        by_parameter = (slopes @ by_axis) * scale
        by_parameter[PARAMETERS.index("clearance")] -= values * scale / bearing.clearance
        return (values * scale).reshape(2, 2, 2), by_parameter.reshape(-1, 2, 2, 2).swapaxes(0, 1)

    def _inside(self, point: FloatArray) -> FloatArray:
        slack = 1e-9 * (1 + np.abs(self.high))
        for axis in np.flatnonzero((point < self.low - slack) | (point > self.high + slack)):
            what = f"the {AXES[axis]} lies outside the table of bearing coefficients"
            raise FitError(what, hint="make the table wider")
        return np.clip(point, self.low, self.high)[None, list(self.active)]


def _place(bearing: JournalBearing, weight: float, speed: float) -> tuple[FloatArray, FloatArray]:
    """Coordinates (4,) in the table and their derivatives by PARAMETERS, (5, 4)."""
    c, mu = bearing.clearance, bearing.viscosity
    root = float(np.sqrt(bearing.wear_depth / c))
    mean_pressure = weight / (bearing.length * bearing.diameter)
    sommerfeld = bearing.force_scale(speed) / (6 * np.pi * weight)
    slopes = np.zeros((len(PARAMETERS), len(AXES)))
    slopes[0, 0] = 1 / (2 * max(root, LEAST_ROOT) * c)
    slopes[1, 1] = 1
    slopes[2, 2] = 1 / mu
    slopes[3, [0, 2]] = -root / (2 * c), -2 / c
    slopes[4, 3] = 1 / mean_pressure
    return np.array(
        [root, bearing.wear_angle, np.log(sommerfeld), bearing.cavitation_pressure / mean_pressure]
    ), slopes


def journal_table(
    bearing: JournalBearing,
    load: tuple[float, float],
    speed: float,
    ranges: TableRange | None = None,
    mesh: FilmMesh = DEFAULT_MESH,
) -> JournalTable:
    """The table of a *bearing*, whatever its wear, under a *load* (2,) [N] at *speed* [rad/s]."""
    ranges = ranges or TableRange()
    weight = float(np.hypot(*load))
    mean_pressure = weight / (bearing.length * bearing.diameter)
    centre = np.log(bearing.force_scale(speed) / (6 * np.pi * weight))
    half = np.log(ranges.sommerfeld_factor)
    deepest = np.sqrt(ranges.depth * ranges.clearance_factor / bearing.clearance)
    worn, low = ranges.depth > 0, ranges.cavitation_pressure / mean_pressure
    nodes = (
        np.linspace(0, deepest, ranges.n_depth if worn else 1),
        np.linspace(-ranges.angle, ranges.angle, ranges.n_angle) if worn else np.array([bearing.wear_angle]),
        np.linspace(centre - half, centre + half, ranges.n_sommerfeld) if half > 0 else np.array([centre]),
        np.linspace(low, 0, ranges.n_cavitation if low else 1),
    )
    sheets = [_Sheet(bearing, load, speed, mesh, root, nodes, ranges.tolerance) for root in nodes[0].tolist()]
    return _fit(bearing, load, nodes, np.array([sheet.values() for sheet in sheets]))


@dataclass(frozen=True)
class _Sheet:
    """A table at one *root* of depth over clearance."""

    bearing: JournalBearing
    load: tuple[float, float]
    speed: float
    mesh: FilmMesh
    root: float
    nodes: tuple[FloatArray, ...]
    tolerance: float

    def equilibrium(
        self, angle: float, log_sommerfeld: float, cavitation: float, near: JournalEquilibrium | None
    ) -> JournalEquilibrium:
        bearing, weight = self.bearing, float(np.hypot(*self.load))
        force = bearing.viscosity * np.exp(log_sommerfeld) * 6 * np.pi * weight
        worn = replace(
            bearing,
            viscosity=float(force / bearing.force_scale(self.speed)),
            wear_depth=float(self.root**2 * bearing.clearance),
            wear_angle=float(angle),
            cavitation_pressure=float(cavitation * weight / (bearing.length * bearing.diameter)),
        )
        return journal_equilibrium(worn, self.load, self.speed, self.mesh, near, self.tolerance)

    def scale(self, equilibrium: JournalEquilibrium) -> FloatArray:
        matrices = np.stack([equilibrium.stiffness, equilibrium.damping * self.speed])
        return matrices * (self.bearing.clearance / float(np.hypot(*self.load)))

    def values(self) -> FloatArray:
        """Coefficients (n_angle, n_sommerfeld, n_cavitation, 8); the angle varies slowest."""
        _, angles, numbers, pressures = self.nodes
        rows: list[list[FloatArray]] = []
        before: list[JournalEquilibrium] = []
        for angle in angles if self.root > 0 else angles[:1]:
            here: list[JournalEquilibrium] = []
            for number, place in enumerate(product(numbers, pressures)):
                here.append(self.equilibrium(angle, *place, _start(here, before, number)))
            rows.append([self.scale(equilibrium) for equilibrium in here])
            before = here
        shape = (numbers.size, pressures.size, 8)
        return np.broadcast_to(np.reshape(rows, (-1, *shape)), (angles.size, *shape))


def _start(
    here: list[JournalEquilibrium], before: list[JournalEquilibrium], number: int
) -> JournalEquilibrium | None:
    """The last equilibrium, moved as its neighbours at the angle *before* differ."""
    if not here:
        return before[number] if before else None
    if not before:
        return here[-1]
    return here[-1].move(before[number - 1], before[number])


def _fit(
    bearing: JournalBearing, load: tuple[float, float], nodes: tuple[FloatArray, ...], values: FloatArray
) -> JournalTable:
    """Splines through *values* (n_depth, n_angle, n_sommerfeld, n_cavitation, 8), reflected at zero depth."""
    active = tuple(axis for axis in range(len(AXES)) if nodes[axis].size > 1)
    values = values.reshape(*(nodes[axis].size for axis in active), 8)
    places = [nodes[axis] for axis in active]
    low, high = (np.array([place[end] for place in nodes]) for end in (0, -1))
    if active[0] == 0:
        places[0] = np.concatenate([-places[0][:0:-1], places[0]])
        values = np.concatenate([values[:0:-1], values])
    knots, degrees = [], tuple(min(CUBIC, place.size - 1) for place in places)
    for number, (place, degree) in enumerate(zip(places, degrees, strict=True)):
        along = scipy.interpolate.make_interp_spline(place, np.moveaxis(values, number, 0), degree)
        knots.append(along.t)
        values = np.moveaxis(along.c, 0, number)
    spline = scipy.interpolate.NdBSpline(tuple(knots), np.ascontiguousarray(values), degrees)
    return JournalTable(bearing, load, active, low, high, spline)
