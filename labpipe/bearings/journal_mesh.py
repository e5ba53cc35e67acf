"""Cells of the oil film: equal arcs around the journal, equal strips over half the width (the film is symmetric)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError

FEWEST_AROUND = 24
FEWEST_ACROSS = 4


@dataclass(frozen=True)
class FilmMesh:
    """Cells *around* the journal by cells *across* the full width; both even, because half the width is solved."""

    around: int = 120
    across: int = 30

    def __post_init__(self) -> None:
        if self.around < FEWEST_AROUND or self.across < FEWEST_ACROSS or self.around % 2 or self.across % 2:
            raise ConfigError(
                f"an oil film of {self.around} x {self.across} cells cannot be solved",
                hint=f"give even numbers, at least {FEWEST_AROUND} around and {FEWEST_ACROSS} across",
            )

    @property
    def arc(self) -> float:
        """Angle of one cell [rad]."""
        return 2 * np.pi / self.around

    @property
    def strip(self) -> float:
        """Width of one cell over half the bearing's length [-]."""
        return 2 / self.across

    def halved(self) -> FilmMesh | None:
        """The mesh with half the cells each way, rounded to even numbers; None where that is too coarse."""
        around, across = (2 * ((n + 2) // 4) for n in (self.around, self.across))
        return FilmMesh(around, max(across, FEWEST_ACROSS)) if around >= FEWEST_AROUND else None


@dataclass(frozen=True)
class FilmGrid:
    """Geometry of a mesh with n_theta cells around and n_half across half the width.

    centre, face (n_theta,): angles of cells and of the faces after them [rad]; at_centre, at_face, wedge (2, n_theta): derivative
    of film thickness over clearance, and of its slope, by the journal's displacement over clearance in y and z [-];
    curvature (n_half, n_half): minus the second difference across the width, symmetric at mid width, zero pressure at the edge.
    """

    centre: FloatArray
    face: FloatArray
    at_centre: FloatArray
    at_face: FloatArray
    wedge: FloatArray
    curvature: FloatArray


@lru_cache(maxsize=16)
def film_grid(mesh: FilmMesh) -> FilmGrid:
    """The grid of a mesh; cached, since an identification uses the same one thousands of times."""
    centre = (np.arange(mesh.around) + 0.5) * mesh.arc
    face = (np.arange(mesh.around) + 1.0) * mesh.arc
    at_centre = -np.stack([np.cos(centre), np.sin(centre)])
    at_face = -np.stack([np.cos(face), np.sin(face)])
    wedge = (at_face - np.roll(at_face, 1, axis=1)) / mesh.arc
    grid = FilmGrid(centre, face, at_centre, at_face, wedge, _curvature(mesh))
    for values in vars(grid).values():
        values.setflags(write=False)
    return grid


def _curvature(mesh: FilmMesh) -> FloatArray:
    n_half = mesh.across // 2
    curvature = 2 * np.eye(n_half) - np.eye(n_half, k=1) - np.eye(n_half, k=-1)
    curvature[0, 0], curvature[-1, -1] = 1, 3
    return curvature / mesh.strip**2


@lru_cache(maxsize=16)
def interpolation(coarse: FilmMesh, fine: FilmMesh) -> tuple[FloatArray, FloatArray]:
    """Matrices a (n_fine, n_coarse), b (n_coarse, n_fine) [1] of fine pressures = a @ coarse @ b; linear, periodic around the journal."""
    position = (np.arange(fine.around) + 0.5) * coarse.around / fine.around - 0.5
    before = np.floor(position).astype(int)
    part = position - before
    around = np.zeros((fine.around, coarse.around))
    np.add.at(around, (np.arange(fine.around), before % coarse.around), 1 - part)
    np.add.at(around, (np.arange(fine.around), (before + 1) % coarse.around), part)
    across = np.array([np.interp(_strips(fine), _strips(coarse), unit) for unit in np.eye(coarse.across // 2)])
    return around, across


def _strips(mesh: FilmMesh) -> FloatArray:
    return (np.arange(mesh.across // 2) + 0.5) * mesh.strip
