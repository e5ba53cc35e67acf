"""The balance of a levitated rotor, M x'' = K_i i - K_s x, between samples: B z = 0 with z = [I, X] and its slopes.

Smooth currents: B = [-K_i, K_s - w^2 M + j w C]. Behind a held output the current between samples is not smooth; then exactly, with
A = M^-1 K_s, x[k+1] + x[k-1] - 2 cos(sqrt(A) T) x[k] = the integral of sin(sqrt(A) (T - |t|)) / sqrt(A) M^-1 K_i i(t) over -T ... T.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.magnet.settings import BEARING, DIRECT

# Powers of A T^2, the square of the pole times the sampling interval, beyond which rounding is larger.
POWERS = 6
NODES = 24
# Relative step of differences.
STEP = 1e-5
UNITS = {"k_i": "N/A", "k_s": "N/m", "c": "N.s/m"}


@dataclass(frozen=True)
class Between:
    """How the current goes on between samples: held at *rate* [Hz], behind an amplifier of *bandwidth* [Hz] or at once."""

    rate: float
    bandwidth: float | None = None

    def moments(self, omega: FloatArray) -> ComplexArray:
        """n_j(w), (n_power, n_line) [s^(2 j)]: (1/T^2) integral of (T - |t|)^(2 j + 1) / (2 j + 1)! i(t) / i_0 over -T ... T.

        Equation (mag-moments).
        """
        interval = 1 / self.rate
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        t, weights = interval * (nodes + 1) / 2, interval * weights / 2
        later = np.zeros_like(t)
        if self.bandwidth is not None:
            corner = 2 * np.pi * self.bandwidth
            later = np.expm1(-corner * t) / np.expm1(-corner * interval)
        z = np.exp(1j * np.asarray(omega) * interval)[:, None]
        ahead, behind = (1 - later) + z * later, (1 - later) / z + later
        moments = []
        for j in range(POWERS):
            power = 2 * j + 1
            moments.append((((interval - t) ** power * ahead + t**power * behind) @ weights) / factorial(power) * self.rate**2)
        return np.array(moments)


@dataclass(frozen=True)
class MagnetModel:
    """Parameters K_i, K_s and C by their places (row, column), in the order of *names*; *mass* (n, n) [kg].

    places: (kind, row, column) of every parameter; *between* None for smooth currents.
    """

    names: tuple[str, ...]
    places: tuple[tuple[str, int, int], ...]
    mass: FloatArray
    between: Between | None = None

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(UNITS[kind] for kind, _, _ in self.places)

    def matrices(self, values: FloatArray) -> dict[str, FloatArray]:
        """K_i [N/A], K_s [N/m] and C [N.s/m], (n, n), of values (n_parameter,)."""
        n = len(self.mass)
        matrices: dict[str, FloatArray] = {kind: np.zeros((n, n)) for kind in UNITS}
        for (kind, row, column), value in zip(self.places, values, strict=True):
            matrices[kind][row, column] = value
        return matrices

    def rows(self, values: FloatArray, omega: FloatArray, mass: FloatArray | None = None) -> ComplexArray:
        """B (n_line, n, 2 n) [N/A, N/m] of values (n_parameter,) at omega (n_line,) [rad/s]; another *mass* (n, n) [kg] in its place.

        Equation (mag-balance).
        """
        mass = self.mass if mass is None else mass
        matrices, w = self.matrices(values), np.asarray(omega)[:, None, None]
        if self.between is None:
            current = np.broadcast_to(-matrices["k_i"].astype(np.complex128), (len(omega), *mass.shape))
            return np.concatenate([current, matrices["k_s"] - w**2 * mass + 1j * w * matrices["c"]], axis=2)
        interval = 1 / self.between.rate
        a = np.linalg.solve(mass, matrices["k_s"])
        powers = [np.linalg.matrix_power(-a, j) for j in range(POWERS + 1)]
        moments = self.between.moments(omega)
        pushed = mass @ sum(moments[j][:, None, None] * powers[j] for j in range(POWERS)) @ np.linalg.solve(mass, matrices["k_i"])
        # 2 (cos(w T) - cos(sqrt(A) T)) / T^2, the one of both cosines taken from both series.
        turned = 2 * sum(powers[j] * interval ** (2 * j - 2) / factorial(2 * j) for j in range(1, POWERS + 1))
        moved = -4 * np.sin(w * interval / 2) ** 2 / interval**2 * mass - mass @ turned
        return np.concatenate([-pushed, moved + 1j * np.sin(w * interval) / interval * matrices["c"]], axis=2)

    def slopes(self, values: FloatArray, omega: FloatArray) -> ComplexArray:
        """dB/dp (n_parameter, n_line, n, 2 n) [N/A, N/m per parameter unit], by differences where B is not linear."""
        scale = np.maximum(np.abs(values), self._sizes(omega))
        changes = []
        for number in range(values.size):
            step = STEP * scale[number] * np.eye(values.size)[number]
            changes.append((self.rows(values + step, omega) - self.rows(values - step, omega)) / (2 * STEP * scale[number]))
        return np.array(changes)

    def _sizes(self, omega: FloatArray) -> FloatArray:
        """Sizes of parameters that count [their units], from the inertia at the middle of the band."""
        inertia = float(np.max(np.abs(self.mass))) * float(np.median(omega)) ** 2
        return np.array([{"k_i": 1.0, "k_s": inertia, "c": inertia / float(np.median(omega))}[kind] for kind, _, _ in self.places])


def magnet_model(
    labels: tuple[str, ...], bearing: tuple[int, ...], mass: FloatArray, coupling: str, damping: bool, between: Between | None
) -> MagnetModel:
    """The model of axes *labels* on their bearings with mass (n, n) [kg]: which terms of K_i, K_s and C are estimated."""
    n = len(labels)
    pairs = [(row, column) for row in range(n) for column in range(n) if _estimated(coupling, row, column, bearing)]
    kinds = [kind for kind in UNITS if kind != "c" or damping]
    places = tuple((kind, row, column) for kind in kinds for row, column in pairs)
    glue = "" if all(len(label) == 1 for label in labels) else "_"
    names = tuple(kind if n == 1 else f"{kind}_{labels[row]}{glue}{labels[column]}" for kind, row, column in places)
    return MagnetModel(names, places, mass, between)


def _estimated(coupling: str, row: int, column: int, bearing: tuple[int, ...]) -> bool:
    if coupling == DIRECT:
        return row == column
    return coupling != BEARING or bearing[row] == bearing[column]
