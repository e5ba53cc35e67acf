"""Coefficients of a bearing's theory over speed, frequency and its uncertain inputs."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.kinds import Bearing, BearingCoefficients, MountedBearing, OperatingPoint
from labpipe.errors import FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.rotor.rig import BearingPlace
from labpipe.methods.run_ups.rotor import PARAMETERS, FilmFamily, as_matrices

# What a film's curve over the Sommerfeld number takes.
ON_CURVE = ("clearance", "viscosity")
# At least this frequency [rad/s] for a controlled bearing under a static load.
SLOWEST = 1e-3
# Evaluations of a controlled bearing that are kept.
MOST_KEPT = 64


@dataclass(frozen=True)
class Theory:
    """A bearing under its static *load* (y, z) [N]; *scales* (n_input, 2): mean and standard uncertainty
    [unit of each] in which the values of its uncertain inputs come.

    An oil film with clearance and viscosity alone is its curve over the Sommerfeld number at any values. Any
    other bearing is c(x) = c(0) + sum x (c(1) - c(-1)) / 2 + x^2 (c(1) - 2 c(0) + c(-1)) / 2 of its inputs x
    in standard uncertainties.
    """

    place: BearingPlace
    load: tuple[float, float]
    scales: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def follows(self) -> bool:
        """Whether the coefficients follow the frequency of the motion, as a controller's do."""
        bearing = self.place.bearing
        return isinstance(bearing, MountedBearing) and bearing.kind.dynamic is not None

    def block(
        self, matrix: str, spread: FloatArray, spin: FloatArray, omega: FloatArray, inputs: FloatArray
    ) -> FloatArray:
        """Stiffness [N/m] or damping [N s/m] as *spread* (k, k) over the dofs, (..., k, k), at *spin* speeds
        and frequencies *omega* (...) [rad/s] and *inputs* (n_input,) [unit of each]. Equation
        (system-theory).
        """
        x = (inputs - self.scales[:, 0]) / self.scales[:, 1]
        if self._changes is not None:
            each = self._film(matrix, spin, x)
        else:
            weights = [(self.place.bearing, 1 - float(x @ x))]
            for entry, at in zip(self.place.uncertainties, x, strict=True):
                weights += [(entry.above, (at + at**2) / 2), (entry.below, (at**2 - at) / 2)]
            parts = [weight * self._at(bearing, matrix, spin, omega) for bearing, weight in weights if weight]
            each = np.sum(parts, axis=0)
        return np.asarray(spread * np.tile(each, (spread.shape[0] // 2,) * 2))

    @cached_property
    def _changes(self) -> FloatArray | None:
        """Relative changes (n_input, 2) of ON_CURVE by the inputs; None where the curve does not know them,
        as wear.
        """
        film = self.place.bearing
        if not isinstance(film, JournalBearing) or film.wear_depth or film.cavitation_pressure:
            return None
        changes = np.zeros((len(self.place.uncertainties), len(ON_CURVE)))
        for row, entry in enumerate(self.place.uncertainties):
            for each in fields(film):
                step = (getattr(entry.above, each.name) - getattr(entry.below, each.name)) / 2
                if step and each.name not in ON_CURVE:
                    return None
                if step:
                    changes[row, ON_CURVE.index(each.name)] = step / getattr(film, each.name)
        return changes

    def _film(self, matrix: str, spin: FloatArray, x: FloatArray) -> FloatArray:
        film = self.place.bearing
        assert isinstance(film, JournalBearing) and self._changes is not None
        clearance, viscosity = 1 + x @ self._changes
        if min(clearance, viscosity) <= 0:
            raise FitError("a film without clearance or viscosity")
        weight, speed = float(np.hypot(*self.load)), np.asarray(spin, np.float64)
        values = np.zeros(len(PARAMETERS))
        values[[PARAMETERS.index(name) for name in ON_CURVE]] = np.log([clearance, viscosity])
        both = as_matrices(FilmFamily(film, 1.0, weight).coefficients(values, weight, speed))
        # Its x is along the load, its y a quarter turn further with the spin.
        y, z = np.array(self.load) / weight
        turn = np.array([[y, -z], [z, y]])
        return np.asarray(turn @ both[matrix == "damping"] @ turn.T)

    def _at(self, bearing: Bearing, matrix: str, spin: FloatArray, omega: FloatArray) -> FloatArray:
        if isinstance(bearing, MountedBearing) and bearing.kind.dynamic is not None:
            w = np.maximum(omega, SLOWEST)
            controlled = (id(bearing), w.tobytes())
            if controlled not in self._controlled:
                if len(self._controlled) > MOST_KEPT:
                    self._controlled.clear()
                self._controlled[controlled] = bearing.kind.dynamic(bearing.settings, w.ravel())
            whole = self._controlled[controlled].reshape(*w.shape, 2, 2)
            return whole.real if matrix == "stiffness" else whole.imag / w[..., None, None]
        each = []
        for speed in np.ravel(spin):
            key = (id(bearing), float(speed))
            if key not in self._points:
                self._points[key] = bearing.at(OperatingPoint(self.load, float(speed), float(speed)))
            each.append(getattr(self._points[key], matrix))
        return np.array(each).reshape(*np.shape(spin), 2, 2)

    @cached_property
    def _controlled(self) -> dict[tuple[int, bytes], ComplexArray]:
        """Stiffness and damping are one evaluation."""
        return {}

    @cached_property
    def _points(self) -> dict[tuple[int, float], BearingCoefficients]:
        return {}
