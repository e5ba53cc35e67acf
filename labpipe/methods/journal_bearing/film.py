"""The oil film: cells, wear, the Reynolds equation by finite volumes, its exact linearisation and its banded
factors.

Lengths over the radial clearance c, angle theta around and zeta = 2 z / L in axial direction, pressures over
6 mu Omega (R / c)^2:

    d/dtheta (h^3 dp/dtheta) + (D / L)^2 d/dzeta (h^3 dp/dzeta) = dh/dtheta + 2 dh/d(Omega t)

The pressure is never below the cavitation pressure: with gap = p - p_cav and surplus = A p + dh/dtheta + 2
dh/d(Omega t), A the discrete operator, gap >= 0, surplus >= 0 and gap * surplus = 0 in every cell
(complementarity). Therefore the equivalent condition gap = max(0, gap - c * surplus) uses a maximum rounded
over a width proportional to the diverging wedge and to the square of the mesh, so that the front crosses
about two cells gradually; away from it the equations hold exactly.

Axial grooves over the whole length are at ambient pressure and separate the film before them from that after
them.

The cells are numbered in axial direction first, so the band is one column of cells wide. The film is periodic
around the journal: where whole columns are cavitated, the ring is cut there and they are left out; a film
without such a column is folded, columns 0, n - 1, 1, n - 2, ..., which keeps the periodic ring within a band
of two columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.errors import ConfigError, FitError, SettingError


def mean_worn_depth(theta: FloatArray, depth: float, angle: float, width: float) -> FloatArray:
    """Added film thickness max(0, depth - 1 - cos(theta - pi/2 - angle)) over radial clearance, exactly
    averaged over *width* [rad] about every *theta* [rad], same shape [-]; largest wear *depth* [-] at *angle*
    [rad] from the bottom, positive with the spin. Equation (jour-wear-mean).
    """
    if depth <= 0:
        return np.zeros_like(theta)
    from_deepest = np.mod(theta - np.pi / 2 - angle, 2 * np.pi) - np.pi
    half = np.arccos(1 - depth)
    first = np.clip(from_deepest - width / 2, -half, half)
    last = np.clip(from_deepest + width / 2, -half, half)
    mean = ((depth - 1) * (last - first) + np.sin(last) - np.sin(first)) / width
    return np.maximum(mean, 0.0)


FEWEST_AROUND = 24
FEWEST_ACROSS = 4


@dataclass(frozen=True)
class FilmMesh:
    """Cells *around* the journal by cells *across* the full width, of which half is solved: both even."""

    around: int = 120
    across: int = 30

    def __post_init__(self) -> None:
        if self.around < FEWEST_AROUND or self.across < FEWEST_ACROSS or self.around % 2 or self.across % 2:
            what = f"an oil film of {self.around} x {self.across} cells cannot be solved"
            hint = f"give even numbers, at least {FEWEST_AROUND} around and {FEWEST_ACROSS} across"
            raise SettingError("cells_around", what, hint)

    @property
    def arc(self) -> float:
        return 2 * np.pi / self.around

    @property
    def strip(self) -> float:
        return 2 / self.across

    def halve(self) -> FilmMesh | None:
        """The mesh with half the cells each way, rounded to even numbers; None where that is too coarse."""
        around, across = (2 * ((n + 2) // 4) for n in (self.around, self.across))
        return FilmMesh(around, max(across, FEWEST_ACROSS)) if around >= FEWEST_AROUND else None

    def half(self) -> FilmMesh:
        """As `halve`; ConfigError where that is too coarse."""
        if (mesh := self.halve()) is None:
            what = f"a mesh of {self.around} x {self.across} cells is too coarse to halve"
            raise ConfigError(what, hint=f"give {2 * FEWEST_AROUND} x {2 * FEWEST_ACROSS} cells or more")
        return mesh


@dataclass(frozen=True)
class FilmGrid:
    """Geometry of a mesh with n_theta cells around and n_half across half the width: centre, face (n_theta,),
    angles of cells and of the faces after them [rad]; at_centre, at_face, wedge (2, n_theta), derivatives of
    film thickness, and of its slope, by the journal's displacement in y and z [-]; curvature (n_half,
    n_half), minus the second difference across, symmetric at mid width, zero pressure at the edge.
    """

    centre: FloatArray
    face: FloatArray
    at_centre: FloatArray
    at_face: FloatArray
    wedge: FloatArray
    curvature: FloatArray


@lru_cache(maxsize=16)
def film_grid(mesh: FilmMesh) -> FilmGrid:
    centre = (np.arange(mesh.around) + 0.5) * mesh.arc
    face = (np.arange(mesh.around) + 1.0) * mesh.arc
    at_centre = -np.stack([np.cos(centre), np.sin(centre)])
    at_face = -np.stack([np.cos(face), np.sin(face)])
    wedge = (at_face - np.roll(at_face, 1, axis=1)) / mesh.arc
    n_half = mesh.across // 2
    curvature = 2 * np.eye(n_half) - np.eye(n_half, k=1) - np.eye(n_half, k=-1)
    curvature[0, 0], curvature[-1, -1] = 1, 3
    grid = FilmGrid(centre, face, at_centre, at_face, wedge, curvature / mesh.strip**2)
    for values in vars(grid).values():
        values.setflags(write=False)
    return grid


@lru_cache(maxsize=16)
def interpolation(coarse: FilmMesh, fine: FilmMesh) -> tuple[FloatArray, FloatArray]:
    """a (n_fine, n_coarse) and b (n_coarse, n_fine) [1] of fine pressures = a @ coarse @ b; linear."""
    position = (np.arange(fine.around) + 0.5) * coarse.around / fine.around - 0.5
    before = np.floor(position).astype(int)
    part = position - before
    around = np.zeros((fine.around, coarse.around))
    np.add.at(around, (np.arange(fine.around), before % coarse.around), 1 - part)
    np.add.at(around, (np.arange(fine.around), (before + 1) % coarse.around), part)
    across = np.array(
        [np.interp(_strips(fine), _strips(coarse), unit) for unit in np.eye(coarse.across // 2)]
    )
    return around, across


def _strips(mesh: FilmMesh) -> FloatArray:
    return (np.arange(mesh.across // 2) + 0.5) * mesh.strip


# The front: compliance in units of a cell's own, and the part of the wedge over which the maximum is rounded:
# coefficients smooth to .1 % over the angle of wear at 120 x 30 cells, and moved by less than .6 %.
COMPLIANCE = 2.0
ROUNDING = 0.8
# Wedge below which a film counts as converging, relative to that of the journal's displacement.
LEAST_WEDGE = 0.02
# Slope of the rounded maximum where it is zero: keeps the equations of cavitated cells finite.
LEAST_SLOPE = 1e-9
# Diagonal that fixes a cell in a groove at ambient pressure.
GROOVE_DIAGONAL = 1e12
# Shortest distance from a cell's centre to a groove, in cells: keeps the flow into it finite.
LEAST_DISTANCE = 0.05


@dataclass(frozen=True)
class Film:
    """A film over a bore: *slenderness* D / L, wear *depth* over clearance at *angle* [rad] from the bottom,
    cavitation pressure (<= 0), *groove* [rad]: width of two axial grooves at the split.
    """

    mesh: FilmMesh
    slenderness: float
    depth: float = 0.0
    angle: float = 0.0
    cavitation: float = 0.0
    groove: float = 0.0

    @property
    def grid(self) -> FilmGrid:
        return film_grid(self.mesh)

    @cached_property
    def worn(self) -> tuple[FloatArray, FloatArray]:
        """Added thickness at cell centres and faces, (n_theta,) each [-]."""
        at = self.depth, self.angle, self.mesh.arc
        return mean_worn_depth(self.grid.centre, *at), mean_worn_depth(self.grid.face, *at)

    @cached_property
    def grooves(self) -> tuple[BoolArray, FloatArray]:
        """Cells in a groove, conductance of the faces by their distance to an edge, (n_theta,) [-]."""
        from_split = np.abs(np.mod(self.grid.centre + np.pi / 2, np.pi) - np.pi / 2)
        grooved = from_split < self.groove / 2
        distance = np.maximum((from_split - self.groove / 2) / self.mesh.arc, LEAST_DISTANCE)
        after = np.roll(grooved, -1)
        opening = np.ones_like(self.grid.centre)
        opening[after & ~grooved] = 1 / distance[after & ~grooved]
        opening[grooved & ~after] = 1 / np.roll(distance, -1)[grooved & ~after]
        return grooved, opening

    def coarser(self) -> Film | None:
        """The same film with half the cells each way, None where that is too coarse."""
        mesh = self.mesh.halve()
        return None if mesh is None else replace(self, mesh=mesh)

    def thickness(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h [-] at cell centres and at faces, (n_theta,), with the journal displaced by (2,) [-] in y and z.
        Equation (jour-thickness).
        """
        centre, face = self.worn
        at_centre, at_face = self.grid.at_centre, self.grid.at_face
        return 1 + centre + displacement @ at_centre, 1 + face + displacement @ at_face

    @property
    def force_weights(self) -> FloatArray:
        """(2, n_theta) [-]: force on the journal = weights @ sums of pressure. Equation (jour-force)."""
        return self.grid.at_centre * (self.mesh.arc * self.mesh.strip)


@dataclass(frozen=True)
class FilmEquations:
    """One Newton step, dimensionless [-]: (A + diagonal) dp = -residual - by_displacement @ de. around,
    across (n_theta,): conductances of faces and in axial direction; diagonal, residual (n_theta, n_half);
    by_displacement (2, n_theta, n_half); cavitated (n_theta, n_half): cells at the cavitation pressure.
    """

    around: FloatArray
    across: FloatArray
    diagonal: FloatArray
    residual: FloatArray
    by_displacement: FloatArray
    cavitated: BoolArray


def film_equations(
    film: Film, displacement: FloatArray, velocity: FloatArray, pressure: FloatArray
) -> FilmEquations:
    """The equations linearised at pressures (n_theta, n_half), a displacement (2,) and a velocity (2,) over c
    Omega [-]. Equation (jour-reynolds).
    """
    grid, arc = film.grid, film.mesh.arc
    centre, face = film.thickness(displacement)
    around, across = film.grooves[1] * face**3 / arc**2, film.slenderness**2 * centre**3
    flow = around[:, None] * (pressure - np.concatenate([pressure[1:], pressure[:1]]))
    leak = across[:, None] * (pressure @ grid.curvature)
    wedge = _out(face) / arc
    surplus = _out(flow) + leak + (wedge + 2 * velocity @ grid.at_centre)[:, None]
    thicker = 3 * grid.at_centre / centre

    compliance = COMPLIANCE / (centre**3 * (1 / arc**2 + 2 * film.slenderness**2))
    root = np.sqrt(wedge**2 + LEAST_WEDGE**2)
    width = ROUNDING / 2 * (wedge + root)
    wider = ROUNDING / 2 * (1 + wedge / root) * grid.wedge - width * thicker

    gap = pressure - film.cavitation
    argument = gap - compliance[:, None] * surplus
    largest, slope, by_width = rounded_maximum(argument, (compliance * width)[:, None])
    in_flow = 1 / (slope * compliance[:, None])
    by_width = by_width / slope
    by_displacement = np.empty((2, *pressure.shape))
    for axis in range(2):
        by_flow = _out((3 * grid.at_face[axis] / face)[:, None] * flow)
        by_displacement[axis] = by_flow + thicker[axis, :, None] * (leak - surplus)
        by_displacement[axis] += grid.wedge[axis, :, None] - wider[axis, :, None] * by_width
    diagonal, residual, cavitated = (1 - slope) * in_flow, (gap - largest) * in_flow, slope <= LEAST_SLOPE
    if film.groove > 0:
        # The equations of cells in grooves are p = 0.
        grooved = film.grooves[0]
        diagonal[grooved], residual[grooved] = GROOVE_DIAGONAL, GROOVE_DIAGONAL * pressure[grooved]
        by_displacement[:, grooved], cavitated[grooved] = 0, True
    return FilmEquations(around, across, diagonal, residual, by_displacement, cavitated)


def rounded_maximum(x: FloatArray, width: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """max(0, x) [-], exact outside +-*width* and twice continuously differentiable, and its derivatives by x
    (>= LEAST_SLOPE) and by width; x (n_theta, n_half), *width* (n_theta, 1) [-]. Equation (jour-rounded).
    """
    t = np.clip((x + width) / (2 * width), 0, 1)
    area, slope = t**3 * (1 - t / 2), t * t * (3 - 2 * t)
    largest = np.where(t < 1, 2 * width * area, x)
    return largest, np.maximum(slope, LEAST_SLOPE), 2 * area + slope * (1 - 2 * t)


def _out(flow: FloatArray) -> FloatArray:
    """Net outflow of every cell from the flows over the faces after them."""
    out = np.empty_like(flow)
    np.subtract(flow[1:], flow[:-1], out=out[1:])
    np.subtract(flow[0], flow[-1], out=out[0, ...])
    return out


@dataclass(frozen=True)
class FactoredFilm:
    """Factored equations of a film [-]: columns (n_column,) solved, in order, banded factors (n_band,
    n_cell), diagonal (n_theta, n_half) of all cells.
    """

    columns: IntArray
    factors: FloatArray
    diagonal: FloatArray

    def solve(self, sides: FloatArray) -> FloatArray:
        """(A + diagonal)^-1 times *sides* (n_side, n_theta, n_half) [-]; diagonal where cavitated."""
        # Imported here: settings of a rotor know bearings, and are read where nothing is solved.
        from scipy.linalg import lapack

        solved, _ = lapack.dpbtrs(
            self.factors, sides[:, self.columns].reshape(sides.shape[0], -1).T, lower=1, overwrite_b=1
        )
        full = sides / self.diagonal
        full[:, self.columns] = solved.T.reshape(sides.shape[0], self.columns.size, -1)
        return full


def band_room(mesh: FilmMesh) -> FloatArray:
    """Memory (n_room,) [-] for the band of a film, used again by every step of its solution."""
    n_half = mesh.across // 2
    return np.empty(mesh.around * n_half * (n_half + 1))


def factorise(equations: FilmEquations, curvature: FloatArray, room: FloatArray) -> FactoredFilm:
    """Cholesky factors of A + diagonal; *curvature* (n_half, n_half) [-] of the grid, *room* (n_room,) [-] of
    `band_room`, which holds them until it is used again. FitError when it is not positive definite.
    """
    cavitated = np.all(equations.cavitated, axis=1)
    columns = _open_ring(cavitated)
    columns, band = (
        _folded_band(equations) if columns is None else (columns, _open_band(equations, columns, room))
    )
    around = equations.around + np.roll(equations.around, 1)
    diagonal = around[:, None] + equations.across[:, None] * np.diagonal(curvature) + equations.diagonal
    band[:, :, 0] = diagonal[columns]
    band[:, :-1, 1] = equations.across[columns, None] * np.diagonal(curvature, 1)
    from scipy.linalg import lapack

    factors, info = lapack.dpbtrf(band.reshape(-1, band.shape[2]).T, lower=1, overwrite_ab=1)
    if info != 0:
        hint = "check load, speed, viscosity and clearance"
        raise FitError("the equations of the oil film are singular", hint=hint)
    return FactoredFilm(columns, factors, diagonal)


def _open_ring(cavitated: BoolArray) -> IntArray | None:
    film = np.flatnonzero(~cavitated)
    if film.size in (0, cavitated.size):
        return None
    arcs = np.diff(film, append=film[0] + cavitated.size)
    longest = int(np.argmax(arcs))
    first = int(film[(longest + 1) % film.size])
    return (first + np.arange(cavitated.size + 1 - arcs[longest])) % cavitated.size


def _open_band(equations: FilmEquations, columns: IntArray, room: FloatArray) -> FloatArray:
    n_half = equations.diagonal.shape[1]
    band = room[: columns.size * n_half * (n_half + 1)].reshape(columns.size, n_half, n_half + 1)
    band[:] = 0
    band[:-1, :, n_half] = -equations.around[columns[:-1], None]
    return band


def _folded_band(equations: FilmEquations) -> tuple[IntArray, FloatArray]:
    n, n_half = equations.diagonal.shape
    columns = np.empty(n, np.intp)
    columns[0::2], columns[1::2] = np.arange(n // 2), np.arange(n - 1, n // 2 - 1, -1)
    face_to_next = np.where(np.arange(n) % 2 == 0, columns, columns - 1)
    band = np.zeros((n, n_half, 2 * n_half + 1))
    band[:-2, :, 2 * n_half] = -equations.around[face_to_next[:-2], None]
    band[0, :, n_half], band[-2, :, n_half] = -equations.around[n - 1], -equations.around[n // 2 - 1]
    return columns, band
