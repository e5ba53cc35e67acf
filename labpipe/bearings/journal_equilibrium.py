"""Static equilibrium of the journal on its film: Newton's method for pressures and displacement together, dimensionless."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.journal_band import FactoredFilm, band_room, factored
from labpipe.bearings.journal_film import Film, film_equations
from labpipe.bearings.journal_mesh import interpolation
from labpipe.errors import FitError

# Largest change of displacement (over clearance), or of pressure (over its maximum), in the last step.
TOLERANCE = 1e-7
ROUGH_TOLERANCE = 1e-3
# The same for the change on half the cells, from which a neighbour starts, and the fewest cells of a film that is started so.
START_TOLERANCE = 1e-4
MANY_CELLS = 480 * 30
MOST_STEPS = 40
MOST_HALVINGS = 6
# Largest share of the film thickness that one step may close.
LARGEST_CLOSING = 0.7
# Least film thickness over clearance.
THINNEST = 1e-6
# First guess: this eccentricity ratio in the direction of the load.
FIRST_ECCENTRICITY = 0.3
NO_EQUILIBRIUM = "no equilibrium of the journal in its oil film was found"
CHECK_LOAD = "the load may be too high for the film; check load, viscosity, speed and clearance"


@dataclass(frozen=True)
class FilmState:
    """State of the film, dimensionless [-]: displacement (2,), pressure (n_theta, n_half), force on the journal (2,), Newton steps.

    stiffness = -dF/de and damping = -dF/d(e'/Omega), (2, 2), from the factors of the last step. coarse: roughly, the state of the same
    film on half the cells each way; None where it was not needed.
    """

    displacement: FloatArray
    pressure: FloatArray
    force: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    steps: int
    coarse: FilmState | None = None

    def moved(self, first: FilmState, second: FilmState) -> FilmState:
        """This state with displacement and pressure changed as from *first* to *second*: a start value, no equilibrium."""
        displacement = self.displacement + second.displacement - first.displacement
        return replace(self, displacement=displacement, pressure=self.pressure + second.pressure - first.pressure, coarse=None)


def film_equilibrium(film: Film, load: FloatArray, near: FilmState | None = None, tolerance: float = TOLERANCE) -> FilmState:
    """Equilibrium with a *load* (2,) [-] over 6 mu Omega (R/c)^2 R L; *near*: state of a similar film on the same mesh.

    *tolerance*: largest change of the displacement over clearance [-] in the last step. Without *near*, or where Newton's method fails
    from it, coarser meshes give the start value. FitError when there is no equilibrium. Equation (jour-equilibrium).
    """
    if near is not None:
        try:
            start = _start_near(film, load, near)
            return replace(_balanced(film, load, start.displacement, start.pressure, tolerance), coarse=start.coarse)
        except FitError:
            pass
    displacement, pressure, coarse = _first_guess(film, load)
    return replace(_balanced(film, load, displacement, pressure, tolerance), coarse=coarse)


def _start_near(film: Film, load: FloatArray, near: FilmState) -> FilmState:
    """The state *near*, changed as the equilibrium on half the cells changes from that film to this.

    Newton's method moves the front of the film by about a cell each step: over many cells it is cheaper to follow it on few of them.
    """
    coarse = film.coarser() if film.mesh.around * film.mesh.across >= MANY_CELLS else None
    if coarse is None or near.coarse is None or near.coarse.pressure.shape != (coarse.mesh.around, coarse.mesh.across // 2):
        return replace(near, coarse=None)
    state = film_equilibrium(coarse, load, near.coarse, START_TOLERANCE)
    around, across = interpolation(coarse.mesh, film.mesh)
    pressure = near.pressure + around @ (state.pressure - near.coarse.pressure) @ across
    return replace(near, displacement=near.displacement + state.displacement - near.coarse.displacement, pressure=pressure, coarse=state)


def _first_guess(film: Film, load: FloatArray) -> tuple[FloatArray, FloatArray, FilmState | None]:
    """Displacement, pressure and, where there are coarser meshes, the state on half the cells."""
    coarse = film.coarser()
    if coarse is None:
        return FIRST_ECCENTRICITY * load / np.hypot(*load), _ambient(film), None
    state = _rough_state(coarse, load, MOST_HALVINGS)
    around, across = interpolation(coarse.mesh, film.mesh)
    return state.displacement, around @ state.pressure @ across, state


def _rough_state(film: Film, load: FloatArray, halvings: int) -> FilmState:
    """The state on a coarse mesh; where Newton's method fails, started from the state under half the load."""
    try:
        displacement, pressure, coarse = _first_guess(film, load)
        return replace(_balanced(film, load, displacement, pressure, ROUGH_TOLERANCE), coarse=coarse)
    except FitError:
        if halvings == 0:
            raise
    lighter = _rough_state(film, load / 2, halvings - 1)
    return _balanced(film, load, lighter.displacement, lighter.pressure, ROUGH_TOLERANCE)


def _ambient(film: Film) -> FloatArray:
    return np.zeros((film.mesh.around, film.mesh.across // 2))


def _balanced(film: Film, load: FloatArray, displacement: FloatArray, pressure: FloatArray, tolerance: float) -> FilmState:
    still = np.zeros(2)
    room, squeeze, weight = band_room(film.mesh), _squeeze(film), film.mesh.arc * film.mesh.strip / 2
    for step in range(1, MOST_STEPS + 1):
        equations = film_equations(film, displacement, still, pressure)
        factors = factored(equations, film.grid.curvature, room)
        # The weights of the force are those of the squeeze term, and A is symmetric: W A^-1 b = (A^-1 W)^T b, for every b.
        squeezed = factors.solve(squeeze)
        by_force = weight * squeezed
        stiffness = np.einsum("aij,bij->ab", by_force, equations.by_displacement)
        missing = load + film.force_weights @ pressure.sum(axis=1) - np.einsum("aij,ij->a", by_force, equations.residual)
        change = np.linalg.solve(stiffness, missing)
        part = _allowed_part(film, displacement, change)
        displacement = displacement + part * change
        side = equations.residual + change[0] * equations.by_displacement[0] + change[1] * equations.by_displacement[1]
        pressure = pressure - part * factors.solve(side[None])[0]
        if np.max(np.abs(change)) < tolerance:
            force = film.force_weights @ pressure.sum(axis=1)
            return FilmState(displacement, pressure, force, stiffness, film.force_weights @ squeezed.sum(axis=2).T, step)
    raise FitError(NO_EQUILIBRIUM, hint=CHECK_LOAD)


def film_at(film: Film, displacement: FloatArray, velocity: FloatArray, near: FilmState | None = None) -> FilmState:
    """State of the film at *displacement* (2,) [-] over c and *velocity* (2,) [-] over c Omega.

    FitError when Newton's method does not converge.
    """
    room, pressure = band_room(film.mesh), _ambient(film) if near is None else near.pressure
    for step in range(1, MOST_STEPS + 1):
        equations = film_equations(film, displacement, velocity, pressure)
        factors = factored(equations, film.grid.curvature, room)
        changes = -factors.solve(np.concatenate([equations.residual[None], equations.by_displacement]))
        pressure = pressure + changes[0]
        if np.max(np.abs(changes[0])) <= TOLERANCE * np.max(np.abs(pressure)):
            force, slopes = (film.force_weights @ field.sum(axis=-1).T for field in (pressure, changes[1:]))
            return FilmState(displacement, pressure, force, -slopes, _damping(film, factors), step)
    raise FitError("the pressure in the oil film did not converge", hint="check displacement and wear")


def _damping(film: Film, factors: FactoredFilm) -> FloatArray:
    """-dF/d(e'/Omega): the squeeze term through the same factors; symmetric, because they are."""
    return film.force_weights @ factors.solve(_squeeze(film)).sum(axis=2).T


def _squeeze(film: Film) -> FloatArray:
    """Derivative of the squeeze term 2 dh/d(Omega t) by the velocity of the journal, (2, n_theta, n_half) [-]."""
    return np.broadcast_to(2 * film.grid.at_centre[:, :, None], (2, film.mesh.around, film.mesh.across // 2))


def _allowed_part(film: Film, displacement: FloatArray, change: FloatArray) -> float:
    _, face = film.thickness(displacement)
    if np.min(face) < THINNEST:
        raise FitError(NO_EQUILIBRIUM, hint=CHECK_LOAD)
    closing = float(np.max(-(change @ film.grid.at_face) / face))
    return min(1.0, LARGEST_CLOSING / closing) if closing > 0 else 1.0
