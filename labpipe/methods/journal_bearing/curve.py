"""Coefficients of an unworn journal bearing as smooth functions of its Sommerfeld number, from the
finite-volume Reynolds solution.

At a given L / D and groove, K c / W, C c Omega / W, eccentricity and attitude depend on S = mu N L D / W (R /
c)^2 only. x points along the static load and y a quarter turn further with the spin: k_xy is force in x per
displacement in y.

The values are extrapolated to cells of no size (Richardson): (4 fine - coarse) / 3 of a mesh and of half its
cells each way.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing, JournalEquilibrium, journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh

# Cells of 1.25 deg: an edge of a 20 deg groove lies between two cells, also of half as many. Extrapolated
# from half of them, thresholds of the shipped rotor lie within .005 % of those of four times the cells; not
# extrapolated, .03 to .06 % above.
CURVE_MESH = FilmMesh(288, 40)
LOWEST_SOMMERFELD = 0.008
HIGHEST_SOMMERFELD = 30.0
NODES = 96
# x = -z (the load of the tabulated bearing acts downwards), y = y.
TO_LOAD_FRAME = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class ScaledCoefficients:
    """Stiffness K c / W and damping C c Omega / W [-], (..., 2, 2) in the order xx xy.

    Yx yy, and their derivatives by ln S.
    """

    stiffness: FloatArray
    damping: FloatArray
    stiffness_slope: FloatArray
    damping_slope: FloatArray


@dataclass(frozen=True)
class JournalCurve:
    """Coefficients over ln S at fixed length over diameter and *groove_width* [rad]; made by `journal_curve`.

    spline: K c / W (4), C c Omega / W (4), eccentricity ratio, attitude [rad]; slope: its derivative.
    """

    length_over_diameter: float
    groove_width: float
    spline: BSpline
    slope: BSpline

    def coefficients(self, sommerfeld: FloatArray) -> ScaledCoefficients:
        """Scaled coefficients [-] at Sommerfeld numbers (...) [-]; FitError outside the table."""
        place = self._place(sommerfeld)
        values, slopes = (
            spline(place)[..., :8].reshape(*place.shape, 2, 2, 2) for spline in (self.spline, self.slope)
        )
        return ScaledCoefficients(
            values[..., 0, :, :], values[..., 1, :, :], slopes[..., 0, :, :], slopes[..., 1, :, :]
        )

    def rest(self, sommerfeld: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eccentricity ratio [-] and attitude [rad] from the load with the spin, same shape as *sommerfeld*.

        FitError outside the table.
        """
        values = self.spline(self._place(sommerfeld))
        return values[..., 8], values[..., 9]

    def _place(self, sommerfeld: FloatArray) -> FloatArray:
        number = np.asarray(sommerfeld, np.float64)
        if not np.all((number >= LOWEST_SOMMERFELD) & (number <= HIGHEST_SOMMERFELD)):
            raise FitError(
                f"a Sommerfeld number of {float(np.max(number)):.3g} (lowest {float(np.min(number)):.3g}) "
                "lies outside the bearing's table",
                hint=f"from {LOWEST_SOMMERFELD:g} to {HIGHEST_SOMMERFELD:g}; check viscosity, clearance and "
                "load",
            )
        return np.log(number)


def sommerfeld_number(bearing: JournalBearing, load: FloatArray, speed: FloatArray) -> FloatArray:
    """S = mu N L D / W (R / c)^2 [-] at loads [N] and speeds [rad/s] of the same shape, N in revolutions per
    second.
    """
    scale = (
        bearing.viscosity
        * bearing.length
        * bearing.diameter
        * (bearing.diameter / (2 * bearing.clearance)) ** 2
        / (2 * np.pi)
    )
    return np.asarray(scale * np.asarray(speed) / np.asarray(load))


@lru_cache(maxsize=8)
def journal_curve(
    length_over_diameter: float, groove_width: float = 0.0, mesh: FilmMesh = CURVE_MESH, nodes: int = NODES
) -> JournalCurve:
    """The curve of a bearing by its *length_over_diameter* and *groove_width* [rad]; cached, since it takes a
    second.

    *mesh*: the finer of the two; ConfigError where it cannot be halved. Equation (jour-richardson).
    """
    half = mesh.halved()
    if half is None:
        raise ConfigError(
            f"a mesh of {mesh.around} x {mesh.across} cells is too coarse to halve",
            hint="give 24 x 8 cells or more",
        )
    bearing = JournalBearing(
        diameter=1.0, length=length_over_diameter, clearance=1e-3, viscosity=1.0, groove_width=groove_width
    )
    places = np.linspace(np.log(LOWEST_SOMMERFELD), np.log(HIGHEST_SOMMERFELD), nodes)
    fine, coarse = (_rows(bearing, places, cells) for cells in (mesh, half))
    spline = make_interp_spline(places, (4 * fine - coarse) / 3, 3)
    return JournalCurve(length_over_diameter, groove_width, spline, spline.derivative())


def _rows(bearing: JournalBearing, places: FloatArray, mesh: FilmMesh) -> FloatArray:
    """The spline's values (n_place, 10) on one mesh at logarithms of the Sommerfeld number, from the lightest
    load on.
    """
    rows = []
    near: JournalEquilibrium | None = None
    for place in places[::-1]:
        weight = bearing.force_scale(1.0) / (6 * np.pi * float(np.exp(place)))
        near = journal_equilibrium(bearing, (0.0, -weight), 1.0, mesh, near)
        scale = near.bearing.clearance / weight
        turned = (
            TO_LOAD_FRAME @ matrix @ TO_LOAD_FRAME.T * scale for matrix in (near.stiffness, near.damping)
        )
        rows.append(
            np.concatenate([*(matrix.ravel() for matrix in turned), [near.eccentricity_ratio, near.attitude]])
        )
    return np.array(rows[::-1])
