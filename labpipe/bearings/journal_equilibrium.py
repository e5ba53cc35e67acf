"""Static equilibrium of the journal on its film: Newton's method for pressures and displacement together, dimensionless."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.journal_band import FactoredFilm, factored
from labpipe.bearings.journal_film import Film, film_equations
from labpipe.bearings.journal_mesh import interpolation
from labpipe.errors import FitError

# Largest change of displacement (over clearance), or of pressure (over its maximum), in the last step.
TOLERANCE = 1e-7
ROUGH_TOLERANCE = 1e-3
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

    stiffness = -dF/de and damping = -dF/d(e'/Omega), (2, 2), from the factors of the last step.
    """

    displacement: FloatArray
    pressure: FloatArray
    force: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    steps: int


def film_equilibrium(film: Film, load: FloatArray, near: FilmState | None = None) -> FilmState:
    """Equilibrium with a *load* (2,) [-] over 6 mu Omega (R/c)^2 R L; *near*: state of a similar film on the same mesh.

    Without *near*, or where Newton's method fails from it, coarser meshes give the start value. FitError when there is no equilibrium.
    Equation (jour-equilibrium).
    """
    if near is not None:
        try:
            return _balanced(film, load, near.displacement, near.pressure, TOLERANCE)
        except FitError:
            pass
    return _balanced(film, load, *_first_guess(film, load), TOLERANCE)


def _first_guess(film: Film, load: FloatArray) -> tuple[FloatArray, FloatArray]:
    coarse = film.coarser()
    if coarse is None:
        return FIRST_ECCENTRICITY * load / np.hypot(*load), _ambient(film)
    state = _rough_state(coarse, load, MOST_HALVINGS)
    around, across = interpolation(coarse.mesh, film.mesh)
    return state.displacement, around @ state.pressure @ across


def _rough_state(film: Film, load: FloatArray, halvings: int) -> FilmState:
    """The state on a coarse mesh; where Newton's method fails, started from the state under half the load."""
    try:
        return _balanced(film, load, *_first_guess(film, load), ROUGH_TOLERANCE)
    except FitError:
        if halvings == 0:
            raise
    lighter = _rough_state(film, load / 2, halvings - 1)
    return _balanced(film, load, lighter.displacement, lighter.pressure, ROUGH_TOLERANCE)


def _ambient(film: Film) -> FloatArray:
    return np.zeros((film.mesh.around, film.mesh.across // 2))


def _balanced(film: Film, load: FloatArray, displacement: FloatArray, pressure: FloatArray, tolerance: float) -> FilmState:
    still = np.zeros(2)
    for step in range(1, MOST_STEPS + 1):
        equations = film_equations(film, displacement, still, pressure)
        factors = factored(equations, film.grid.curvature)
        changes = -factors.solve(np.concatenate([equations.residual[None], equations.by_displacement]))
        slopes = film.force_weights @ changes.sum(axis=2).T
        change = -np.linalg.solve(slopes[:, 1:], load + film.force_weights @ pressure.sum(axis=1) + slopes[:, 0])
        part = _allowed_part(film, displacement, change)
        displacement = displacement + part * change
        pressure = pressure + part * (changes[0] + change[0] * changes[1] + change[1] * changes[2])
        if np.max(np.abs(change)) < tolerance:
            force = film.force_weights @ pressure.sum(axis=1)
            return FilmState(displacement, pressure, force, -slopes[:, 1:], _damping(film, factors), step)
    raise FitError(NO_EQUILIBRIUM, hint=CHECK_LOAD)


def film_at(film: Film, displacement: FloatArray, velocity: FloatArray, near: FilmState | None = None) -> FilmState:
    """State of the film at *displacement* (2,) [-] over c and *velocity* (2,) [-] over c Omega.

    FitError when Newton's method does not converge.
    """
    pressure = _ambient(film) if near is None else near.pressure
    for step in range(1, MOST_STEPS + 1):
        equations = film_equations(film, displacement, velocity, pressure)
        factors = factored(equations, film.grid.curvature)
        changes = -factors.solve(np.concatenate([equations.residual[None], equations.by_displacement]))
        pressure = pressure + changes[0]
        if np.max(np.abs(changes[0])) <= TOLERANCE * np.max(np.abs(pressure)):
            force, slopes = (film.force_weights @ field.sum(axis=-1).T for field in (pressure, changes[1:]))
            return FilmState(displacement, pressure, force, -slopes, _damping(film, factors), step)
    raise FitError("the pressure in the oil film did not converge", hint="check displacement and wear")


def _damping(film: Film, factors: FactoredFilm) -> FloatArray:
    """-dF/d(e'/Omega): the squeeze term 2 dh/d(Omega t) through the same factors; symmetric, because they are."""
    squeeze = np.broadcast_to(2 * film.grid.at_centre[:, :, None], (2, film.mesh.around, film.mesh.across // 2))
    return film.force_weights @ factors.solve(squeeze).sum(axis=2).T


def _allowed_part(film: Film, displacement: FloatArray, change: FloatArray) -> float:
    _, face = film.thickness(displacement)
    if np.min(face) < THINNEST:
        raise FitError(NO_EQUILIBRIUM, hint=CHECK_LOAD)
    closing = float(np.max(-(change @ film.grid.at_face) / face))
    return min(1.0, LARGEST_CLOSING / closing) if closing > 0 else 1.0
