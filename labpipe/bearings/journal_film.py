"""The Reynolds equation of a journal bearing by finite volumes and its exact linearisation; all quantities dimensionless.

Lengths over the radial clearance c, angle theta around and zeta = 2 z / L in axial direction, pressures over 6 mu Omega (R / c)^2:

    d/dtheta (h^3 dp/dtheta) + (D / L)^2 d/dzeta (h^3 dp/dzeta) = dh/dtheta + 2 dh/d(Omega t)

The pressure is never below the cavitation pressure: with gap = p - p_cav and surplus = A p + dh/dtheta + 2 dh/d(Omega t), A the
discrete operator, gap >= 0, surplus >= 0 and gap * surplus = 0 in every cell (complementarity). A front that jumps from cell to
cell makes stiffness and damping rough functions of load, wear depth and angle. Therefore the equivalent condition
gap = max(0, gap - c * surplus) uses a maximum rounded over a width proportional to the diverging wedge and to the square of the
mesh, so that the front crosses about two cells gradually; away from it the equations hold exactly.

Axial grooves over the whole length are at ambient pressure and separate the film before them from that after them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.bearings.journal_mesh import FilmGrid, FilmMesh, film_grid
from labpipe.bearings.journal_wear import mean_worn_depth

# The front: compliance in units of a cell's own, and the part of the wedge over which the maximum is rounded.
# Together they make coefficients smooth to .1 % over the angle of wear at 120 x 30 cells and move them by less than .6 %.
COMPLIANCE = 2.0
ROUNDING = 0.8
# Wedge below which a film counts as converging, relative to that of the journal's displacement.
LEAST_WEDGE = 0.02
# Slope of the rounded maximum where it is zero: keeps the equations of cavitated cells finite.
LEAST_SLOPE = 1e-9
# Diagonal that fixes a cell in a groove at ambient pressure.
GROOVE_DIAGONAL = 1e12
# Shortest distance from a cell's centre to the edge of a groove, in cells: keeps the flow into the groove finite.
LEAST_DISTANCE = 0.05


@dataclass(frozen=True, kw_only=True)
class Film:
    """A film: *slenderness* D / L, wear *depth* over clearance at *angle* [rad] from the bottom, cavitation pressure (<= 0).

    worn_centre, worn_face (n_theta,) [-]: added thickness at cell centres and faces; groove [rad]: width of each of two axial grooves at
    the horizontal split, zero for none; grooved (n_theta,): cells in a groove; opening (n_theta,): conductance factor of the face after
    each cell for the distance to the groove's edge.
    """

    mesh: FilmMesh
    grid: FilmGrid
    slenderness: float
    depth: float
    angle: float
    cavitation: float
    worn_centre: FloatArray
    worn_face: FloatArray
    groove: float
    grooved: BoolArray
    opening: FloatArray

    @classmethod
    def of(
        cls, mesh: FilmMesh, slenderness: float, depth: float = 0.0, angle: float = 0.0, cavitation: float = 0.0, groove: float = 0.0
    ) -> Film:
        """The film over a bore with wear *depth* (over clearance) at *angle* [rad] from the bottom, with or without grooves."""
        grid = film_grid(mesh)
        centre, face = (mean_worn_depth(theta, depth, angle, mesh.arc) for theta in (grid.centre, grid.face))
        grooved, opening = _grooves(grid, mesh.arc, groove)
        return cls(
            mesh=mesh,
            grid=grid,
            slenderness=slenderness,
            depth=depth,
            angle=angle,
            cavitation=cavitation,
            worn_centre=centre,
            worn_face=face,
            groove=groove,
            grooved=grooved,
            opening=opening,
        )

    def coarser(self) -> Film | None:
        """The same film with half the cells each way, None where that is too coarse."""
        mesh = self.mesh.halved()
        return None if mesh is None else Film.of(mesh, self.slenderness, self.depth, self.angle, self.cavitation, self.groove)

    def thickness(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Film thickness h [-] at cell centres and at faces, (n_theta,); *displacement* (2,) [-] of the journal in y and z.

        Equation (jour-thickness).
        """
        return 1 + self.worn_centre + displacement @ self.grid.at_centre, 1 + self.worn_face + displacement @ self.grid.at_face

    @property
    def force_weights(self) -> FloatArray:
        """Weights (2, n_theta) [-]: force on the journal = weights @ axial sums of pressure, over 6 mu Omega (R/c)^2 R L.

        Equation (jour-force).
        """
        return self.grid.at_centre * (self.mesh.arc * self.mesh.strip)


@dataclass(frozen=True)
class FilmEquations:
    """One Newton step, dimensionless [-]: (A + diagonal) dp = -residual - by_displacement @ de - by_velocity @ dv.

    around, across (n_theta,): conductances of faces and in axial direction; diagonal, residual (n_theta, n_half);
    by_displacement (2, n_theta, n_half); cavitated (n_theta, n_half): cells at the cavitation pressure.
    """

    around: FloatArray
    across: FloatArray
    diagonal: FloatArray
    residual: FloatArray
    by_displacement: FloatArray
    cavitated: BoolArray


def film_equations(film: Film, displacement: FloatArray, velocity: FloatArray, pressure: FloatArray) -> FilmEquations:
    """The equations linearised at a pressure field (n_theta, n_half), a displacement (2,) and a velocity (2,) over c Omega [-].

    Equation (jour-reynolds).
    """
    grid, arc = film.grid, film.mesh.arc
    centre, face = film.thickness(displacement)
    around, across = film.opening * face**3 / arc**2, film.slenderness**2 * centre**3
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
        by_displacement[axis] = _out((3 * grid.at_face[axis] / face)[:, None] * flow) + thicker[axis, :, None] * (leak - surplus)
        by_displacement[axis] += grid.wedge[axis, :, None] - wider[axis, :, None] * by_width
    diagonal, residual, cavitated = (1 - slope) * in_flow, (gap - largest) * in_flow, slope <= LEAST_SLOPE
    if film.groove > 0:
        _hold_ambient(film.grooved, pressure, diagonal, residual, by_displacement, cavitated)
    return FilmEquations(around, across, diagonal, residual, by_displacement, cavitated)


def _hold_ambient(
    grooved: BoolArray, pressure: FloatArray, diagonal: FloatArray, residual: FloatArray, by_displacement: FloatArray, cavitated: BoolArray
) -> None:
    """Replace the equations of cells in grooves by p = 0, in place."""
    diagonal[grooved] = GROOVE_DIAGONAL
    residual[grooved] = GROOVE_DIAGONAL * pressure[grooved]
    by_displacement[:, grooved] = 0
    cavitated[grooved] = True


def _grooves(grid: FilmGrid, arc: float, groove: float) -> tuple[BoolArray, FloatArray]:
    """Cells in the grooves at theta = 0 and 180 deg, and conductance factors of the faces: 1 / distance to the edge [cells]."""
    from_split = np.abs(np.mod(grid.centre + np.pi / 2, np.pi) - np.pi / 2)
    grooved: BoolArray = from_split < groove / 2
    distance = np.maximum((from_split - groove / 2) / arc, LEAST_DISTANCE)
    after = np.roll(grooved, -1)
    opening = np.ones_like(grid.centre)
    opening[after & ~grooved] = 1 / distance[after & ~grooved]
    opening[grooved & ~after] = 1 / np.roll(distance, -1)[grooved & ~after]
    return grooved, opening


def rounded_maximum(x: FloatArray, width: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """max(0, x) [-], exact outside +-*width* and twice continuously differentiable; its derivatives by x (>= LEAST_SLOPE) and by width.

    x (n_theta, n_half), *width* (n_theta, 1) [-]. With t = (x + width) / (2 width): 2 width (t^3 - t^4 / 2), slope t^2 (3 - 2 t).
    Equation (jour-rounded).
    """
    t = np.clip((x + width) / (2 * width), 0, 1)
    area, slope = t**3 * (1 - t / 2), t * t * (3 - 2 * t)
    largest = np.where(t < 1, 2 * width * area, x)
    return largest, np.maximum(slope, LEAST_SLOPE), 2 * area + slope * (1 - 2 * t)


def _out(flow: FloatArray) -> FloatArray:
    """Net outflow of every cell from the flows over the faces after them, axis 0 around."""
    out = np.empty_like(flow)
    np.subtract(flow[1:], flow[:-1], out=out[1:])
    np.subtract(flow[0], flow[-1], out=out[0, ...])
    return out
