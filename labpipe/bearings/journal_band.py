"""Banded Cholesky factors of the film's equations.

The cells are numbered in axial direction first, so the band is one column of cells wide. The film is periodic around the journal:
where whole columns are cavitated, the ring is cut there and they are left out; a film without such a column is folded, columns
0, n - 1, 1, n - 2, ..., which keeps the periodic ring within a band of two columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.bearings.journal_film import FilmEquations
from labpipe.bearings.journal_mesh import FilmMesh
from labpipe.errors import FitError


@dataclass(frozen=True)
class FactoredFilm:
    """Factored equations of a film, dimensionless [-]: columns (n_column,) solved, in order, and banded factors (n_band, n_cell).

    diagonal (n_theta, n_half): of all cells.
    """

    columns: IntArray
    factors: FloatArray
    diagonal: FloatArray

    def solve(self, sides: FloatArray) -> FloatArray:
        """(A + diagonal)^-1 times right-hand sides (n_side, n_theta, n_half) [-], same shape; only the diagonal in cavitated columns."""
        # Imported here: settings of a rotor know bearings, and are read where nothing is solved.
        from scipy.linalg import lapack

        solved, _ = lapack.dpbtrs(self.factors, sides[:, self.columns].reshape(sides.shape[0], -1).T, lower=1, overwrite_b=1)
        full = sides / self.diagonal
        full[:, self.columns] = solved.T.reshape(sides.shape[0], self.columns.size, -1)
        return full


def band_room(mesh: FilmMesh) -> FloatArray:
    """Memory (n_room,) [-] for the band of a film, used again by every step of its solution.

    Fresh pages would cost as much as the factors.
    """
    n_half = mesh.across // 2
    return np.empty(mesh.around * n_half * (n_half + 1))


def factored(equations: FilmEquations, curvature: FloatArray, room: FloatArray) -> FactoredFilm:
    """Cholesky factors of A + diagonal; *curvature* (n_half, n_half) [-] of the grid. FitError when it is not positive definite.

    *room* (n_room,) [-] of `band_room` may hold the factors until it is used again.
    """
    cavitated: BoolArray = np.all(equations.cavitated, axis=1)
    columns = _open_ring(cavitated)
    columns, band = _folded_band(equations) if columns is None else (columns, _open_band(equations, columns, room))
    diagonal = _diagonal(equations, curvature)
    band[:, :, 0] = diagonal[columns]
    band[:, :-1, 1] = equations.across[columns, None] * np.diagonal(curvature, 1)
    from scipy.linalg import lapack

    factors, info = lapack.dpbtrf(band.reshape(-1, band.shape[2]).T, lower=1, overwrite_ab=1)
    if info != 0:
        raise FitError("the equations of the oil film are singular", hint="check load, speed, viscosity and clearance")
    return FactoredFilm(columns, factors, diagonal)


def _diagonal(equations: FilmEquations, curvature: FloatArray) -> FloatArray:
    around = equations.around + np.roll(equations.around, 1)
    return around[:, None] + equations.across[:, None] * np.diagonal(curvature) + equations.diagonal


def _open_ring(cavitated: BoolArray) -> IntArray | None:
    """Columns from the end of the longest cavitated arc to its start; None when no column is completely cavitated."""
    film = np.flatnonzero(~cavitated)
    if film.size in (0, cavitated.size):
        return None
    arcs = np.diff(film, append=film[0] + cavitated.size)
    longest = int(np.argmax(arcs))
    first = int(film[(longest + 1) % film.size])
    return (first + np.arange(cavitated.size + 1 - arcs[longest])) % cavitated.size


def _open_band(equations: FilmEquations, columns: IntArray, room: FloatArray) -> FloatArray:
    """(n_column, n_half, n_half + 1), the lower band of every cell."""
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
