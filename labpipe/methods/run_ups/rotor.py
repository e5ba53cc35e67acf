"""The rotor of run-ups: a pinned shaft on one loaded bearing, its response, critical and threshold speeds.

Frame: x along the static load, y a quarter turn further with the spin.

The physical family of journal coefficients over load and speed is the Reynolds solution with twelve
parameters, natural logarithms, zero for the rotor file's own bearing. With Omega_0, W_0 reference speed and
load

    mu(Omega, W) = mu_0 exp(a) (Omega / Omega_0)^b (W / W_0)^d,   c = c_0 exp(g),
    K_ij = W / c  k_ij(S) exp(f_ij),   C_ij = W / (c Omega)  c_ij(S) exp(f'_ij),   S from mu and c.

A larger clearance with more viscosity (mu / c^2 kept) only lowers all eight coefficients alike: no run-up
tells clearance, viscosity and the common factor apart, priors do (`PRIOR`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.kinds import OperatingPoint
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.journal_bearing.curve import TO_LOAD_FRAME, JournalCurve, curve_of, sommerfeld_number
from labpipe.methods.rotor.pinned import (
    CoefficientsAtSpeed,
    CondensedRotor,
    PinnedRotor,
    Stability,
    condensed_rotor,
    pinned_rotor,
    resonance_speed,
    threshold_speed,
    unbalance_forces,
)
from labpipe.methods.rotor.rig import BearingPlace, Unbalance
from labpipe.methods.rotor.shaft import Rotor
from labpipe.methods.run_ups.records import MeasuredRun, RunUp, Shaker
from labpipe.registry import nearest

COEFFICIENTS = ("k_xx", "k_xy", "k_yx", "k_yy", "c_xx", "c_xy", "c_yx", "c_yy")
PARAMETERS = (
    "viscosity",
    "viscosity_speed",
    "viscosity_load",
    "clearance",
    *(f"factor_{name}" for name in COEFFICIENTS),
)
# Prior standard deviations of the logarithms.
PRIOR = np.array([0.5, 0.3, 0.3, 0.1, *[0.1] * 8])
# Bound of a logarithm; at the bound the rotor file describes another bearing.
BOUND = np.array([1.5, 1.0, 1.0, 0.4, *[0.5] * 8])


class CoefficientFamily(Protocol):
    """The eight coefficients over load [N] and speed [rad/s] with parameters *values* (n_parameter,)."""

    def coefficients_and_slopes(
        self, values: FloatArray, load: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(n_point, 8) [N/m, N.s/m] and their derivatives (n_point, 8, n_parameter)."""
        ...

    def at_load(self, values: FloatArray, load: float) -> CoefficientsAtSpeed:
        """K [N/m] and C [N s/m] over speed, of parameters (n_parameter,)."""
        ...


@dataclass(frozen=True)
class FilmFamily:
    """The family about a *bearing*; *speed* [rad/s] and *load* [N] are the references of the slopes."""

    bearing: JournalBearing
    speed: float
    load: float

    @property
    def curve(self) -> JournalCurve:
        return curve_of(self.bearing)

    def sommerfeld(self, values: FloatArray, load: FloatArray, speed: FloatArray) -> FloatArray:
        """S (n_point,) of the parameters *values* (12,) at loads [N] and speeds [rad/s], (n_point,)."""
        a, b, d, g = values[:4]
        change = a + b * np.log(speed / self.speed) + d * np.log(load / self.load) - 2 * g
        return sommerfeld_number(self.bearing, load, speed) * np.exp(change)

    def coefficients(self, values: FloatArray, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m]; FitError outside the bearing's table. Equation (run-family)."""
        load, speed = np.broadcast_arrays(np.asarray(load, np.float64), np.asarray(speed, np.float64))
        eight, _ = self.curve.coefficients(self.sommerfeld(values, load, speed))
        return eight * self._scale(values, load, speed)

    def coefficients_and_slopes(
        self, values: FloatArray, load: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`coefficients` [N/m, N s/m] and their derivatives by PARAMETERS, (n_point, 8, 12)."""
        curve_values = self.curve.coefficients(self.sommerfeld(values, load, speed))
        scale = self._scale(values, load, speed)
        eight, by_place = (part * scale for part in curve_values)
        slopes = np.zeros((*eight.shape, len(PARAMETERS)))
        slopes[..., 0] = by_place
        slopes[..., 1] = by_place * np.log(speed / self.speed)[:, None]
        slopes[..., 2] = by_place * np.log(load / self.load)[:, None]
        slopes[..., 3] = -2 * by_place - eight
        numbers = np.arange(8)
        slopes[:, numbers, 4 + numbers] = eight
        return eight, slopes

    def at_load(self, values: FloatArray, load: float) -> CoefficientsAtSpeed:
        """K [N/m] and C [N s/m], (n_speed, 2, 2), over speed [rad/s]."""
        return lambda speed: as_matrices(self.coefficients(values, load, speed))

    def _scale(self, values: FloatArray, load: FloatArray, speed: FloatArray) -> FloatArray:
        per_length = load / (self.bearing.clearance * np.exp(values[3]))
        both = np.stack([per_length] * 4 + [per_length / speed] * 4, axis=-1)
        return both * np.exp(values[4:])


def as_matrices(coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """K [N/m] and C [N s/m], (..., 2, 2), from COEFFICIENTS (..., 8)."""
    split = coefficients.reshape(*coefficients.shape[:-1], 2, 2, 2)
    return split[..., 0, :, :], split[..., 1, :, :]


def as_eight(stiffness: FloatArray, damping: FloatArray) -> FloatArray:
    """COEFFICIENTS (..., 8) from K [N/m] and C [N s/m], (..., 2, 2)."""
    parts = [matrix.reshape(*matrix.shape[:-2], 4) for matrix in (stiffness, damping)]
    return np.concatenate(parts, axis=-1)


def extend_over_speed(
    eight: Callable[[FloatArray], FloatArray], low: float, high: float
) -> CoefficientsAtSpeed:
    """K and C over speed from coefficients (n_speed, 8) [N/m, N s/m] between *low* and *high* [rad/s];
    outside K and Omega C stay constant, as those of a film at one Sommerfeld number.
    """

    def coefficients(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        speed = np.asarray(speed, np.float64)
        within = np.clip(speed, low, high)
        stiffness, damping = as_matrices(eight(within))
        return stiffness, damping * (within / speed)[..., None, None]

    return coefficients


def coefficient_errors(estimate: FloatArray, true: FloatArray) -> FloatArray:
    """rms error of *estimate* over the rms of *true*, (8,) [-], over the points of (n_point, 8) each."""
    return np.sqrt(np.mean((estimate - true) ** 2, axis=0) / np.mean(true**2, axis=0))


RPM = np.pi / 30
# Number of speeds in the search for peaks and thresholds; range of thresholds relative to the highest speed.
N_CRITICAL, N_THRESHOLD, BEYOND = 131, 29, 2.0


class TabulatedCoefficients(Protocol):
    """The eight coefficients over load [N] and speed [rad/s], as a metamodel gives them."""

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that they hold for."""
        ...

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        ...


@dataclass(frozen=True)
class SpeedSearch:
    """Critical speeds are searched from *low* to *high* [rad/s], thresholds of instability to *highest*."""

    low: float
    high: float

    @property
    def highest(self) -> float:
        return BEYOND * self.high

    @property
    def critical(self) -> FloatArray:
        """(n_speed,) [rad/s] of the search for a peak."""
        return np.linspace(self.low, self.high, N_CRITICAL)

    @property
    def threshold(self) -> FloatArray:
        """(n_speed,) [rad/s] of the search for a sign change of the growth rate."""
        return np.linspace(self.low, self.highest, N_THRESHOLD)

    @property
    def text(self) -> str:
        return f"{self.low / RPM:.0f} and {self.high / RPM:.0f} rpm"


@dataclass(frozen=True)
class RunUpRotor:
    """A rotor file with pins: *pins* and *planes* (name, node) are nodes of the *rotor*. *tabulated*:
    coefficients instead of the film's. *speeds*: range of the search for critical speeds [rad/s], by default
    that of the run-ups. ConfigError for a node that is none or outside the pins, or that two planes share.
    """

    name: str
    rotor: Rotor
    _: KW_ONLY
    pins: tuple[int, ...]
    place: BearingPlace
    planes: tuple[tuple[str, int], ...]
    unbalances: tuple[Unbalance, ...] = ()
    tabulated: TabulatedCoefficients | None = None
    speeds: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.planes:
            hint = "for example planes: {disc 1: 2}"
            raise ConfigError("planes: a run-up needs a plane at which it is measured", hint=hint)
        if len({node for _, node in self.planes}) < len(self.planes):
            raise ConfigError("planes: two planes sit on one node")
        for node in (self.place.node, *(node for _, node in self.planes)):
            self.pinned.dofs(node)
        for unbalance in self.unbalances:
            self.pinned.dofs(unbalance.node)
            self.plane_at(unbalance.node)

    @property
    def search(self) -> SpeedSearch:
        """ConfigError where neither the rotor file nor a run-up gives one."""
        if self.speeds is None:
            hint = "for example speeds: 400-3000 rpm"
            raise ConfigError("speeds: are missing, and there is no run-up to take them from", hint=hint)
        return SpeedSearch(*self.speeds)

    @cached_property
    def pinned(self) -> PinnedRotor:
        return pinned_rotor(self.rotor, self.pins)

    @cached_property
    def stability(self) -> Stability:
        return Stability.of(self.pinned, self.place.node)

    @property
    def plane_names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.planes)

    @property
    def known_unbalance(self) -> dict[str, complex]:
        """Unbalance [kg m] by plane, complex with its angle."""
        amounts: dict[str, complex] = {}
        for unbalance in self.unbalances:
            plane = self.plane_at(unbalance.node)
            amounts[plane] = amounts.get(plane, 0j) + unbalance.size * complex(np.exp(1j * unbalance.phase))
        return amounts

    def node(self, plane: str) -> int:
        """ConfigError with the nearest known name on a miss."""
        nodes = dict(self.planes)
        if plane not in nodes:
            raise ConfigError(f"no plane '{plane}' in {self.name}", hint=nearest(plane, nodes))
        return nodes[plane]

    def plane_at(self, node: int) -> str:
        for name, here in self.planes:
            if here == node:
                return name
        hint = "name it under planes:"
        raise ConfigError(f"there is no plane at node {node}, where an unbalance sits", hint=hint)

    def condense(
        self, speed: FloatArray, unbalance: Mapping[str, complex], shaker: Shaker | None = None
    ) -> CondensedRotor:
        """x, y of every plane at *speed* (n_speed,) [rad/s] under an *unbalance* [kg m] or a *shaker*."""
        nodes = tuple(node for _, node in self.planes)
        if shaker is None:
            at_nodes = {self.node(plane): size for plane, size in unbalance.items()}
            forces = unbalance_forces(self.pinned, at_nodes, speed)
            return condensed_rotor(self.pinned, self.place.node, speed, forces, nodes)
        forces = np.zeros((np.size(speed), self.pinned.n_dof), np.complex128)
        forces[:, self.pinned.dofs(self.node(shaker.plane))] = [shaker.x, shaker.y]
        frequency = speed * shaker.frequency_ratio
        return condensed_rotor(self.pinned, self.place.node, frequency, forces, nodes, speed)

    def excite(self, run: RunUp) -> CondensedRotor:
        """Condensed at the speeds and under the excitation of a run; DataError for other planes, or none."""
        if run.planes != self.plane_names:
            own, measured = ", ".join(self.plane_names), ", ".join(run.planes)
            what = f"run '{run.name}' was measured at {measured}, the rotor has {own}"
            hint = "name the planes alike in the rotor file and the run-up, in one order"
            raise DataError(what, hint=hint)
        acting = run.unbalance.values() if run.shaker is None else (run.shaker.x, run.shaker.y)
        if not any(acting):
            what = f"run '{run.name}' was excited by nothing: its unbalance or force is zero"
            raise DataError(what, hint="state what was added, or subtract the run")
        return self.condense(run.speed, run.unbalance, run.shaker)

    def start_coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """K [N/m] and C [N s/m], (n_speed, 2, 2), of the rotor file's bearing or as *tabulated*."""
        bearing, speed = self.place.bearing, np.asarray(speed, np.float64)
        if self.tabulated is not None:
            return extend_over_speed(partial(self.tabulated.predict, load), *self.tabulated.speeds)(speed)
        if not isinstance(bearing, JournalBearing):
            points = [bearing.at(OperatingPoint((0.0, -load), omega, omega)) for omega in speed.tolist()]
            both = np.stack([[point.stiffness, point.damping] for point in points], axis=1)
            stiffness, damping = TO_LOAD_FRAME @ both @ TO_LOAD_FRAME.T
            return stiffness, damping
        film, _ = curve_of(bearing).coefficients(sommerfeld_number(bearing, np.asarray(load), speed))
        stiffness, damping = as_matrices(film * (load / bearing.clearance))
        return stiffness, damping / speed[..., None, None]

    def start(self, load: float) -> CoefficientsAtSpeed:
        """`start_coefficients` as a function of speed."""
        return lambda speed: self.start_coefficients(load, speed)

    def response(self, speed: FloatArray, coefficients: CoefficientsAtSpeed) -> ComplexArray:
        """Phasors (n_speed, n_plane, 2) [m] under the known unbalance."""
        outputs = self.condense(speed, self.known_unbalance).response(*coefficients(speed))
        return outputs.reshape(np.size(speed), len(self.planes), 2)

    def critical_speed(self, coefficients: CoefficientsAtSpeed, plane: str = "") -> float:
        """Speed [rad/s] of the largest displacement at a plane, or the last one, under the known unbalance;
        FitError without a peak within the search.
        """
        number = self.plane_names.index(plane) if plane else -1
        search = self.search.critical
        grid = largest_displacement(self.response(search, coefficients))[:, number]
        top = int(np.argmax(grid))
        if top in (0, grid.size - 1):
            hint = "look at the response over speed; speeds: in the rotor file sets the range"
            raise FitError(f"the response to unbalance has no peak between {self.search.text}", hint=hint)
        low, high = search[top - 1], search[top + 1]
        # Between three points of a smooth peak a fine grid and a parabola are exact to a millionth.
        fine = np.linspace(low, high, 41)
        values = largest_displacement(self.response(fine, coefficients))[:, number]
        middle = int(np.clip(np.argmax(values), 1, fine.size - 2))
        before, here, after = values[middle - 1 : middle + 2]
        return float(fine[middle] + (fine[1] - fine[0]) / 2 * (before - after) / (before - 2 * here + after))

    def resonance(self, coefficients: CoefficientsAtSpeed) -> float | None:
        """Speed [rad/s] that equals the imaginary part of an eigenvalue, if there is one."""
        return resonance_speed(self.stability, coefficients, self.search.critical[::5])

    def threshold(self, coefficients: CoefficientsAtSpeed) -> float | None:
        """Onset speed of instability [rad/s], if there is one up to twice the highest speed of the search."""
        return threshold_speed(self.stability, coefficients, self.search.threshold)


def with_search_range(rig: RunUpRotor, runs: Iterable[RunUp | MeasuredRun]) -> RunUpRotor:
    """The rotor with the speeds of *runs* as its range of search, unless it has one."""
    if rig.speeds is not None:
        return rig
    ends = [(float(run.speed[0]), float(run.speed[-1])) for run in runs]
    return replace(rig, speeds=(min(low for low, _ in ends), max(high for _, high in ends))) if ends else rig


def largest_displacement(response: ComplexArray) -> FloatArray:
    """The major semi-axis |X + jY| / 2 + |X - jY| / 2 [m] of the orbit, (...) of phasors (..., 2). Equation
    (rotor-largest).
    """
    x, y = response[..., 0], response[..., 1]
    return (np.abs(x + 1j * y) + np.abs(x - 1j * y)) / 2
