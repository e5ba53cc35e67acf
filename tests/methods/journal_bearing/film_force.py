"""The force of an oil film at any place and velocity of the journal, without equilibrium or linearisation."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.journal_bearing.film import Film, FilmMesh, band_room, factorise, film_equations


def held_pressure(film: Film, place: FloatArray, motion: FloatArray) -> FloatArray:
    """Pressure (n_theta, n_half) [-] at a *place* (2,) over c and a *motion* (2,) over c Omega of the
    journal.
    """
    room, pressure = band_room(film.mesh), np.zeros((film.mesh.around, film.mesh.across // 2))
    for _ in range(40):
        equations = film_equations(film, place, motion, pressure)
        change = factorise(equations, film.grid.curvature, room).solve(equations.residual[None])[0]
        pressure = pressure - change
        if np.max(np.abs(change)) <= 1e-7 * np.max(np.abs(pressure)):
            return pressure
    raise AssertionError("the pressure did not converge")


def held_force(film: Film, place: FloatArray, motion: FloatArray) -> FloatArray:
    """Force on the journal (2,) [-] over 6 mu Omega (R / c)^2 R L, arguments as of `held_pressure`."""
    return film.force_weights @ held_pressure(film, place, motion).sum(axis=1)


def film_force(
    bearing: JournalBearing, position: FloatArray, velocity: FloatArray, speed: float, mesh: FilmMesh
) -> FloatArray:
    """Force on the journal (2,) [N] at a *position* (2,) [m] and *velocity* (2,) [m/s], *speed* [rad/s]."""
    place, motion = np.asarray(position) / bearing.clearance, np.asarray(velocity) / bearing.clearance / speed
    return held_force(bearing.film(speed, mesh), place, motion) * bearing.force_scale(speed)
