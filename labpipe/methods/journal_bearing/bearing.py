"""Journal bearings with a finite-length oil film: equilibrium and the eight linear coefficients.

Axes: y horizontal, z up, theta from +y to +z, spin from y to z, the bottom at 270 deg. k_yz is force in y per
displacement in z: K = -dF/dx and C = -dF/dx', F the force of the film on the journal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.kinds import BearingCoefficients, OperatingPoint
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.methods.journal_bearing.film import (
    Film,
    FilmMesh,
    band_room,
    factorise,
    film_equations,
    interpolation,
)

# Largest change of displacement (over clearance), or of pressure (over its maximum), in the last step.
TOLERANCE = 1e-7
ROUGH_TOLERANCE = 1e-3
# The same on half the cells, from which a neighbour starts, and the fewest cells of a film that does so.
START_TOLERANCE = 1e-4
MANY_CELLS = 480 * 30
MOST_STEPS = 40
MOST_HALVINGS = 6
# Largest share of the film thickness that one step may close.
LARGEST_CLOSING = 0.7
THINNEST = 1e-6
# First guess: this eccentricity ratio in the direction of the load.
FIRST_ECCENTRICITY = 0.3
NO_EQUILIBRIUM = "no equilibrium of the journal in its oil film was found"
NO_LOAD = "a journal bearing needs a load for its equilibrium"
CHECK_LOAD = "the load may be too high for the film; check load, viscosity, speed and clearance"


@dataclass(frozen=True)
class FilmState:
    """State of the film, dimensionless [-]: displacement (2,), pressure (n_theta, n_half), force on the
    journal (2,), Newton steps; stiffness = -dF/de and damping = -dF/d(e'/Omega), (2, 2). coarse: roughly,
    that on half the cells each way.
    """

    displacement: FloatArray
    pressure: FloatArray
    force: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    steps: int
    coarse: FilmState | None = None

    def move(self, first: FilmState, second: FilmState) -> FilmState:
        """A start value: this state changed as from *first* to *second*."""
        return replace(
            self,
            displacement=self.displacement + second.displacement - first.displacement,
            pressure=self.pressure + second.pressure - first.pressure,
            coarse=None,
        )


def film_equilibrium(
    film: Film, load: FloatArray, near: FilmState | None = None, tolerance: float = TOLERANCE
) -> FilmState:
    """Equilibrium with a *load* (2,) [-] over 6 mu Omega (R/c)^2 R L, from *near*, a similar film on the same
    mesh, else from coarser meshes; *tolerance*: largest change of displacement over clearance [-] in the last
    step. FitError when there is none. Equation (jour-equilibrium).
    """
    if near is not None:
        try:
            return _balance(film, load, *_start_near(film, load, near), tolerance)
        except FitError:
            pass
    return _balance(film, load, *_first_guess(film, load), tolerance)


# Displacement, pressure, and the state on half the cells that gave them.
Start = tuple[FloatArray, FloatArray, FilmState | None]


def _start_near(film: Film, load: FloatArray, near: FilmState) -> Start:
    coarse, before = film.coarser(), near.coarse
    many = film.mesh.around * film.mesh.across >= MANY_CELLS
    if not many or coarse is None or before is None or before.pressure.shape != _ambient(coarse).shape:
        return near.displacement, near.pressure, None
    state = film_equilibrium(coarse, load, before, START_TOLERANCE)
    around, across = interpolation(coarse.mesh, film.mesh)
    pressure = near.pressure + around @ (state.pressure - before.pressure) @ across
    return near.displacement + state.displacement - before.displacement, pressure, state


def _first_guess(film: Film, load: FloatArray) -> Start:
    coarse = film.coarser()
    if coarse is None:
        return FIRST_ECCENTRICITY * load / np.hypot(*load), _ambient(film), None
    state = _rough_state(coarse, load, MOST_HALVINGS)
    around, across = interpolation(coarse.mesh, film.mesh)
    return state.displacement, around @ state.pressure @ across, state


def _rough_state(film: Film, load: FloatArray, halvings: int) -> FilmState:
    try:
        return _balance(film, load, *_first_guess(film, load), ROUGH_TOLERANCE)
    except FitError:
        if halvings == 0:
            raise
    lighter = _rough_state(film, load / 2, halvings - 1)
    return _balance(film, load, lighter.displacement, lighter.pressure, None, ROUGH_TOLERANCE)


def _ambient(film: Film) -> FloatArray:
    return np.zeros((film.mesh.around, film.mesh.across // 2))


def _balance(
    film: Film,
    load: FloatArray,
    displacement: FloatArray,
    pressure: FloatArray,
    coarse: FilmState | None,
    tolerance: float,
) -> FilmState:
    still = np.zeros(2)
    room, squeeze, weight = band_room(film.mesh), _squeeze(film), film.mesh.arc * film.mesh.strip / 2
    for step in range(1, MOST_STEPS + 1):
        equations = film_equations(film, displacement, still, pressure)
        factors = factorise(equations, film.grid.curvature, room)
        # The force has the weights of the squeeze term, and A is symmetric: W A^-1 b = (A^-1 W)^T b.
        squeezed = factors.solve(squeeze)
        by_force = weight * squeezed
        stiffness = np.einsum("aij,bij->ab", by_force, equations.by_displacement)
        missing = load + film.force_weights @ pressure.sum(axis=1)
        missing -= np.einsum("aij,ij->a", by_force, equations.residual)
        change = np.linalg.solve(stiffness, missing)
        _, face = film.thickness(displacement)
        if np.min(face) < THINNEST:
            raise FitError(NO_EQUILIBRIUM, hint=CHECK_LOAD)
        closing = float(np.max(-(change @ film.grid.at_face) / face))
        part = min(1.0, LARGEST_CLOSING / closing) if closing > 0 else 1.0
        displacement = displacement + part * change
        y, z = equations.by_displacement
        side = equations.residual + change[0] * y + change[1] * z
        pressure = pressure - part * factors.solve(side[None])[0]
        if np.max(np.abs(change)) < tolerance:
            force = film.force_weights @ pressure.sum(axis=1)
            damping = film.force_weights @ squeezed.sum(axis=2).T
            return FilmState(displacement, pressure, force, stiffness, damping, step, coarse)
    raise FitError(NO_EQUILIBRIUM, hint=CHECK_LOAD)


def _squeeze(film: Film) -> FloatArray:
    """Derivative of 2 dh/d(Omega t) by the journal's velocity."""
    return np.broadcast_to(2 * film.grid.at_centre[:, :, None], (2, film.mesh.around, film.mesh.across // 2))


DEFAULT_MESH = FilmMesh(120, 30)
MOST_CELLS_AROUND = 960
# In an arc as long as the bearing, within which the pressure of a short one ends.
CELLS_PER_LENGTH = 9
WIDEST_GROOVE = 2 * np.pi / 3


@dataclass(frozen=True, kw_only=True)
class JournalBearing:
    """A plain journal bearing; lengths in [m], *clearance* radial, viscosity [Pa s].

    wear_depth [m]: largest wear; wear_angle [rad]: its place from the bottom, positive with the spin.
    cavitation_pressure [Pa] against ambient, zero or less. groove_width [rad]: of each of two axial grooves
    at the horizontal split, at ambient pressure. ConfigError for impossible values.
    """

    diameter: float
    length: float
    clearance: float
    viscosity: float
    wear_depth: float = 0.0
    wear_angle: float = 0.0
    cavitation_pressure: float = 0.0
    groove_width: float = 0.0

    def __post_init__(self) -> None:
        for name in ("diameter", "length", "clearance", "viscosity"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise SettingError(name, f"the {name} of a journal bearing is positive, not {value:g}")
        if not 0 <= self.wear_depth < 2 * self.clearance:
            depth, clearance = 1e6 * self.wear_depth, 1e6 * self.clearance
            what = f"a wear of {depth:g} um does not fit a clearance of {clearance:g} um"
            raise SettingError("wear", what, "from zero to less than twice the radial clearance")
        if not abs(self.wear_angle) <= np.pi:
            what = f"a wear angle of {np.degrees(self.wear_angle):g} deg is out of range"
            raise SettingError("wear", what, "from -180 to 180 deg from the bottom")
        if not -np.inf < self.cavitation_pressure <= 0:
            what = f"{self.cavitation_pressure:g} Pa is above the ambient pressure"
            raise SettingError("cavitation_pressure", what, "give zero or less")
        if not 0 <= self.groove_width <= WIDEST_GROOVE:
            what = f"a groove of {np.degrees(self.groove_width):g} deg is out of range"
            raise SettingError("groove_width", what, "from 0 to 120 deg, one on either side")

    def pressure_scale(self, speed: float) -> float:
        """6 mu Omega (R / c)^2 [Pa]; *speed* [rad/s]. Equation (jour-pressure-scale)."""
        if not 0 < speed < np.inf:
            raise ConfigError(f"an oil film needs a speed above zero, not {speed:g} rad/s")
        return 6 * self.viscosity * speed * (self.diameter / (2 * self.clearance)) ** 2

    def force_scale(self, speed: float) -> float:
        """6 mu Omega (R / c)^2 R L [N]: unit of the dimensionless film force. Equation (jour-force-scale)."""
        return self.pressure_scale(speed) * self.diameter / 2 * self.length

    def at(self, point: OperatingPoint) -> BearingCoefficients:
        """Coefficients (2, 2) in y and z [N/m, N.s/m]."""
        film = journal_equilibrium(self, point.load, point.speed)
        return BearingCoefficients(("y", "z"), film.stiffness, film.damping)

    def film(self, speed: float, mesh: FilmMesh) -> Film:
        return Film(
            mesh,
            self.diameter / self.length,
            self.wear_depth / self.clearance,
            self.wear_angle,
            self.cavitation_pressure / self.pressure_scale(speed),
            self.groove_width,
        )


@dataclass(frozen=True)
class JournalEquilibrium:
    """Equilibrium of a journal on its oil film: *load* (2,) [N] on the journal in y and z, *speed* [rad/s],
    dimensionless *state*. error: estimated mesh error of the coefficients relative to the largest, if it was.
    """

    bearing: JournalBearing
    speed: float
    load: tuple[float, float]
    mesh: FilmMesh
    state: FilmState
    error: float | None = None

    @property
    def position(self) -> FloatArray:
        """Displacement of the journal's centre from the bearing's, (2,) [m]."""
        return self.state.displacement * self.bearing.clearance

    @property
    def eccentricity_ratio(self) -> float:
        """Displacement of the journal over the radial clearance [-]; above 1 only inside a worn arc."""
        return float(np.hypot(*self.state.displacement))

    @property
    def attitude(self) -> float:
        """Angle from the load to the displacement, positive with the spin [rad]. Equation (jour-attitude)."""
        return float(np.angle(complex(*self.state.displacement) * complex(*self.load).conjugate()))

    @property
    def sommerfeld(self) -> float:
        """S = mu N L D / W (R / c)^2 with N in revolutions per second [-]. Equation (jour-sommerfeld)."""
        return self.bearing.force_scale(self.speed) / (6 * np.pi * float(np.hypot(*self.load)))

    @property
    def stiffness(self) -> FloatArray:
        """K = -dF/dx [N/m], (2, 2). Equation (jour-stiffness)."""
        return self.state.stiffness * (self.bearing.force_scale(self.speed) / self.bearing.clearance)

    @property
    def damping(self) -> FloatArray:
        """C = -dF/dx' [N s/m], (2, 2), symmetric. Equation (jour-damping)."""
        scale = self.bearing.force_scale(self.speed) / (self.bearing.clearance * self.speed)
        return self.state.damping * scale

    def move(self, first: JournalEquilibrium, second: JournalEquilibrium) -> JournalEquilibrium:
        """A start value: its state moved as that of *second* differs from that of *first*, of one mesh."""
        return replace(self, state=self.state.move(first.state, second.state))

    @property
    def coarser(self) -> JournalEquilibrium | None:
        """Roughly the same on half the cells each way, a start value; None where it was not needed."""
        mesh = self.mesh.halve()
        if self.state.coarse is None or mesh is None:
            return None
        return replace(self, mesh=mesh, state=self.state.coarse, error=None)

    @property
    def theta(self) -> FloatArray:
        """Angles of the cells [rad], (n_theta,)."""
        return self.bearing.film(self.speed, self.mesh).grid.centre

    @property
    def axial(self) -> FloatArray:
        """Axial positions of the cells from mid width [m], (n_axial,)."""
        return ((np.arange(self.mesh.across) + 0.5) / self.mesh.across - 0.5) * self.bearing.length

    @property
    def pressure(self) -> FloatArray:
        """Pressure against ambient [Pa], (n_theta, n_axial)."""
        half = self.state.pressure * self.bearing.pressure_scale(self.speed)
        return np.concatenate([half[:, ::-1], half], axis=1)

    @property
    def film_thickness(self) -> FloatArray:
        """Film thickness [m], (n_theta,)."""
        film = self.bearing.film(self.speed, self.mesh)
        return film.thickness(self.state.displacement)[0] * self.bearing.clearance


def journal_equilibrium(
    bearing: JournalBearing,
    load: tuple[float, float],
    speed: float,
    mesh: FilmMesh = DEFAULT_MESH,
    near: JournalEquilibrium | None = None,
    tolerance: float = TOLERANCE,
) -> JournalEquilibrium:
    """Static equilibrium and coefficients under a *load* (2,) [N] in y and z, at *speed* [rad/s]; *near* and
    *tolerance* as in `film_equilibrium`. ConfigError for a load of zero, FitError without an equilibrium.
    """
    if not 0 < np.hypot(*load) < np.inf:
        raise ConfigError(NO_LOAD, hint="give the static load in newtons")
    start = near.state if near is not None and near.mesh == mesh else None
    scaled = np.asarray(load, np.float64) / bearing.force_scale(speed)
    state = film_equilibrium(bearing.film(speed, mesh), scaled, start, tolerance)
    return JournalEquilibrium(bearing, speed, (float(load[0]), float(load[1])), mesh, state)


def converged_equilibrium(
    bearing: JournalBearing,
    load: tuple[float, float],
    speed: float,
    tolerance: float = 0.01,
    mesh: FilmMesh | None = None,
) -> JournalEquilibrium:
    """The equilibrium on the coarsest mesh, from *mesh* on and doubling, with coefficient errors below
    *tolerance* of the largest: a third of the change from half the cells each way (second order). FitError
    where the finest mesh does not do, ConfigError where the first cannot be halved. Without a *mesh* it
    begins with CELLS_PER_LENGTH: where a short film ends, the order does not hold. Equation (jour-mesh).
    """
    if mesh is None:
        mesh = DEFAULT_MESH
        while mesh.around < min(
            CELLS_PER_LENGTH * np.pi * bearing.diameter / bearing.length, MOST_CELLS_AROUND
        ):
            mesh = FilmMesh(2 * mesh.around, 2 * mesh.across)
    coarse = journal_equilibrium(bearing, load, speed, mesh.half())
    while mesh.around <= MOST_CELLS_AROUND:
        fine = journal_equilibrium(bearing, load, speed, mesh)
        pairs = ((coarse.stiffness, fine.stiffness), (coarse.damping, fine.damping))
        error = max(float(np.max(np.abs(a - b)) / np.max(np.abs(b))) for a, b in pairs) / 3
        if error <= tolerance:
            return replace(fine, error=error)
        coarse, mesh = fine, FilmMesh(2 * mesh.around, 2 * mesh.across)
    what = f"the oil film needs more than {MOST_CELLS_AROUND} cells around"
    raise FitError(what, hint=f"allow a larger error than {tolerance:g}")
