"""What is known of a rotor and how well, and the model that follows: which unknown acts on what, and the
small errors that are everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.kinds import (
    Bearing,
    BearingCoefficients,
    LinearBearingSettings,
    MountedBearing,
    OperatingPoint,
)
from labpipe.errors import FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.rotor import shaft
from labpipe.methods.rotor.rig import BearingPlace, RotorRig
from labpipe.methods.rotor_system.model import Curve, MatrixBlock, SystemModel, Unknown
from labpipe.methods.run_ups.rotor import PARAMETERS, FilmFamily, as_matrices
from labpipe.records.settings import StandardDeviations, quantity
from labpipe.records.uncertain import Uncertainty

# What a film's curve over the Sommerfeld number takes.
ON_CURVE = ("clearance", "viscosity")
# At least this frequency [rad/s] for a controlled bearing under a static load.
SLOWEST = 1e-3
# Evaluations of a controlled bearing that are kept.
MOST_KEPT = 64


@dataclass(frozen=True)
class Theory:
    """A bearing under its static *load* (y, z) [N]; *scales* (n_input, 2): mean and standard uncertainty
    [unit of each] in which the values of its uncertain inputs come. An oil film with clearance and viscosity
    alone is its curve over the Sommerfeld number at any values. Any other bearing is c(x) = c(0) + sum x
    (c(1) - c(-1)) / 2 + x^2 (c(1) - 2 c(0) + c(-1)) / 2 of its inputs x in standard uncertainties.
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
            values = self._film(matrix, spin, x)
        else:
            weights = [(self.place.bearing, 1 - float(x @ x))]
            for entry, at in zip(self.place.uncertainties, x, strict=True):
                weights += [(entry.above, (at + at**2) / 2), (entry.below, (at**2 - at) / 2)]
            parts = [weight * self._at(bearing, matrix, spin, omega) for bearing, weight in weights if weight]
            values = np.sum(parts, axis=0)
        return spread * np.tile(values, (spread.shape[0] // 2,) * 2)

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
            for dimension in fields(film):
                step = (getattr(entry.above, dimension.name) - getattr(entry.below, dimension.name)) / 2
                if step and dimension.name not in ON_CURVE:
                    return None
                if step:
                    changes[row, ON_CURVE.index(dimension.name)] = step / getattr(film, dimension.name)
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
        return turn @ both[matrix == "damping"] @ turn.T

    def _at(self, bearing: Bearing, matrix: str, spin: FloatArray, omega: FloatArray) -> FloatArray:
        if isinstance(bearing, MountedBearing) and bearing.kind.dynamic is not None:
            w = np.maximum(omega, SLOWEST)
            key = (id(bearing), w.tobytes())
            if key not in self._controlled:
                if len(self._controlled) > MOST_KEPT:
                    self._controlled.clear()
                self._controlled[key] = bearing.kind.dynamic(bearing.settings, w.ravel())
            whole = self._controlled[key].reshape(*w.shape, 2, 2)
            return whole.real if matrix == "stiffness" else whole.imag / w[..., None, None]
        values = [getattr(self._point(bearing, float(speed)), matrix) for speed in np.ravel(spin)]
        return np.array(values).reshape(*np.shape(spin), 2, 2)

    def _point(self, bearing: Bearing, speed: float) -> BearingCoefficients:
        key = id(bearing), speed
        if key not in self._points:
            self._points[key] = bearing.at(OperatingPoint(self.load, speed, speed))
        return self._points[key]

    @cached_property
    def _controlled(self) -> dict[tuple[int, bytes], ComplexArray]:
        return {}

    @cached_property
    def _points(self) -> dict[tuple[int, float], BearingCoefficients]:
        return {}


# Relative uncertainty of an unbalance that is stated without one.
EXACT = 1e-6
# Apparent mass at a bearing that an unknown of 1 stands for [kg].
APPARENT = 5.0
# The name under which predictions ask for what acts at speed; no test has it.
RUNNING = ""
DIRECTIONS = ("y", "z")
COEFFICIENTS = ("yy", "yz", "zy", "zz")
# Direct coefficients that are one number, by their letter.
ALIKE = {"k": "k_yy", "c": "c"}


@dataclass(frozen=True)
class SmallErrors(StandardDeviations):
    """Errors that no drawing knows and that are everywhere; 0 turns one off. They are in the model, so that
    predictions carry them.
    """

    elements: float = quantity("stiffness of every element", "1", 0.01)
    inertia: float = quantity("moments of inertia of every disc", "1", 0.05)
    bearings: float = quantity("every bearing coefficient, running against standing", "1", 0.1)
    apparent_mass: float = quantity("apparent mass at every bearing, in 5 kg", "1", 0.03)
    phase: float = quantity("phase of every probe", "rad", 0.01)
    together: float = quantity(
        "stiffness and damping of all bearings alike, running against standing", "1", 0.0
    )


@dataclass(frozen=True)
class Pedestal:
    """What carries a bearing: *mass* [kg], *stiffness* [N/m] and *damping* [N s/m] to ground in y and z.

    error, mass_error: standard uncertainties of ln stiffness and ln mass.
    """

    bearing: str
    mass: float
    stiffness: float
    damping: float = 0.0
    error: float = 0.0
    mass_error: float = 0.0


@dataclass(frozen=True)
class LinearBearing:
    """Constant *stiffness* [N/m] and *damping* [N s/m], (2, 2) in y and z, with their standard uncertainties,
    0 where one is known: of the logarithms of direct coefficients, which keep their sign, and of the numbers
    themselves where they are zero or cross-coupled. *common*: letters, k and c, whose direct coefficients are
    one number. *skew*: k_yz is -k_zy, of a seal, and acts while the rotor turns.
    """

    stiffness: FloatArray
    damping: FloatArray
    stiffness_error: FloatArray
    damping_error: FloatArray
    common: str = ""
    skew: bool = False


def linear_bearing(
    place: BearingPlace,
    settings: LinearBearingSettings,
    stiffness_error: float,
    damping_error: float,
    cross_error: float,
) -> LinearBearing:
    """A bearing of a rotor file with the uncertainties of its coefficients; where one has none, these shares
    [1] of its stiffness or damping, and of the direct stiffness for a seal's cross-coupling.
    """
    stated = {entry.key: entry.uncertainty.std_error for entry in place.uncertainties}
    k, c = settings.stiffness, settings.damping
    bare = not (k[0, 1] or k[1, 0] or {"k_yz", "k_zy"} & stated.keys())
    skew = settings.k_cross is not None or (cross_error > 0 and bare)

    common = ("k" if settings.k_zz is None else "") + ("c" if settings.c is not None else "")

    def errors(letter: str, values: FloatArray, default: float) -> FloatArray:
        names = [f"{letter}_{label}" for label in COEFFICIENTS]
        if letter in common:
            names[0] = names[3] = ALIKE[letter]
        if letter == "k" and skew:
            names[1] = names[2] = "k_cross"
        # A direct coefficient keeps its sign, so that it is the logarithm that is uncertain.
        sizes = np.abs(values).ravel()
        units = np.where((sizes > 0) & np.array([True, False, False, True]), sizes, 1.0)
        usual = sizes * default / units
        if letter == "k" and skew:
            usual[1] = usual[2] = cross_error * float(np.mean(np.abs(np.diag(values))))
        coefficients = zip(names, units, usual, strict=True)
        errors = [stated[name] / unit if name in stated else error for name, unit, error in coefficients]
        return np.array(errors).reshape(2, 2)

    return LinearBearing(k, c, errors("k", k, stiffness_error), errors("c", c, damping_error), common, skew)


@dataclass(frozen=True)
class RotorSystem:
    """A rotor and what is known of it. *rig*: shaft, discs, bearings, speed.

    young: standard uncertainty of ln E by material. masses: of ln m of every disc. sleeves: by name, their
    elements (from 1), ln of the factor on their stiffness, and its standard uncertainty. internal: damping
    that turns with the shaft, C = internal K [s], and the uncertainty of its logarithm. unbalances: (node,
    mean, standard uncertainty of each part) [kg m]. linear: bearings of constant coefficients by name.
    """

    rig: RotorRig
    young: Mapping[shaft.Material, float] = field(default_factory=dict)
    masses: tuple[float, ...] = ()
    sleeves: Mapping[str, tuple[tuple[int, ...], float, float]] = field(default_factory=dict)
    pedestals: tuple[Pedestal, ...] = ()
    internal: tuple[float, float] = (0.0, 0.0)
    unbalances: tuple[tuple[int, complex, float], ...] = ()
    linear: Mapping[str, LinearBearing] = field(default_factory=dict)

    @property
    def has_unknown(self) -> bool:
        """Whether any number of it is uncertain."""
        errors = [*self.young.values(), *self.masses, self.internal[1]]
        errors += [error for _, _, error in (*self.sleeves.values(), *self.unbalances)]
        errors += [pedestal.error for pedestal in self.pedestals]
        coefficients = [(b.stiffness_error, b.damping_error) for b in self.linear.values()]
        return any(errors) or bool(np.any(coefficients)) or bool(self.rig.sources)

    @property
    def is_uncertain(self) -> bool:
        """Whether the plain theory of its rig says less than there is."""
        return self.has_unknown or bool(self.pedestals or self.internal[0])


@dataclass(frozen=True)
class Built:
    """A model with what tests need: planes (dof of y, numbers of the real and imaginary part) of the
    unbalances by node, gains and phases of the probes by run-up, and the numbers of errors by their sources.
    """

    model: SystemModel
    planes: Mapping[int, tuple[int, int, int]]
    gains: Mapping[str, tuple[int, ...]]
    phases: Mapping[str, tuple[int, ...]]
    sources: Mapping[str, int]


@dataclass(frozen=True)
class Sensors:
    """The sensors of a test: their *labels*, standard uncertainty of each *gain*, whether the rotor turns
    meanwhile, whether their *phase* counts, as of the vectors of a run-up, and what their rig file states of
    their *calibrations*.
    """

    labels: tuple[str, ...]
    gain: float = 0.0
    turning: bool = False
    phase: bool = False
    calibrations: tuple[Uncertainty, ...] = ()


# Named alternatives to a model that does not fit: pedestals that the file does not have, bearings that all
# change together between rest and speed.
PEDESTALS, TOGETHER = "pedestals", "bearings changed together"
# Standard uncertainties of the logarithms of their numbers; a pedestal is about so many times as stiff as its
# bearing, and has this share of the rotor's mass.
PEDESTAL_STIFFNESS, PEDESTAL_MASS, ALTOGETHER = 1.0, 0.7, 0.3
STIFFER, HEAVY = 5.0, 0.25


def build(
    system: RotorSystem, small: SmallErrors, sensors: Mapping[str, Sensors], alternative: str = ""
) -> Built:
    """The model of a system for tests with *sensors*, or a named *alternative* to it."""
    if alternative == PEDESTALS:
        pedestals = tuple(_unknown_pedestal(system, place) for place in system.rig.bearings)
        system = replace(system, pedestals=pedestals)
    elif alternative == TOGETHER:
        small = replace(small, together=ALTOGETHER)
    turning = frozenset([name for name, channels in sensors.items() if channels.turning] + [RUNNING])
    return _Builder(system, small, turning).build(sensors)


def _unknown_pedestal(system: RotorSystem, place: BearingPlace) -> Pedestal:
    linear = system.linear.get(place.name)
    if linear is not None:
        bearing = linear.stiffness
    else:
        certain, speed = replace(place, uncertainties=()), np.array(system.rig.omega)
        theory = Theory(certain, system.rig.static_loads()[place.name])
        bearing = theory.block("stiffness", np.ones((2, 2)), speed, speed, np.zeros(0))
    mass = HEAVY * float(shaft.free_rotor(system.rig.rotor).mass[0::4, 0::4].sum())
    stiffness = STIFFER * float(np.mean(np.abs(np.diag(bearing))))
    damping = 0.04 * float(np.sqrt(stiffness * mass))
    return Pedestal(place.name, mass, stiffness, damping, PEDESTAL_STIFFNESS, PEDESTAL_MASS)


class _Builder:
    def __init__(self, system: RotorSystem, small: SmallErrors, running: frozenset[str]) -> None:
        self.system, self.small, self.running = system, small, running
        self.unknowns: list[Unknown] = []
        self.terms: list[MatrixBlock] = []
        # Inputs of bearing models and calibrations by their sources: numbers of one source have one error.
        self.sources: dict[str, int] = {}
        self.together = {
            letter: self.unknown(f"all bearings {letter} running", small.together, tests=running)
            for letter in "kc"
        }

    def unknown(self, name: str, error: float, mean: float = 0.0, **entries: object) -> tuple[int, ...]:
        """The number of a new unknown; none where its *error* is zero."""
        if error <= 0:
            return ()
        self.unknowns.append(Unknown(name, error, mean, **entries))  # type: ignore[arg-type]
        return (len(self.unknowns) - 1,)

    def add(
        self,
        matrix: str,
        dofs: Sequence[int],
        block: FloatArray | Curve,
        factors: tuple[int, ...] = (),
        **entries: object,
    ) -> None:
        term = MatrixBlock(matrix, tuple(dofs), block, factors, **entries)  # type: ignore[arg-type]
        self.terms.append(term)

    def build(self, sensors: Mapping[str, Sensors]) -> Built:
        rig = self.system.rig
        self._shaft()
        self._discs()
        for place in rig.bearings:
            self._bearing(place)
        planes = {}
        for node, mean, error in self.system.unbalances:
            parts = [
                self.unknown(f"unbalance {node} {axis}", error or EXACT * abs(mean), part, unit="kg.m")
                for axis, part in (("re", mean.real), ("im", mean.imag))
            ]
            if all(parts):
                planes[node] = (rig.rotor.dofs(node)[0], parts[0][0], parts[1][0])
        gains: dict[str, tuple[int, ...]] = {}
        phases: dict[str, tuple[int, ...]] = {}
        for test, channels in sensors.items():
            phase = self.small.phase if channels.phase else 0.0
            gains[test] = self._sensor_unknowns("gain", test, channels, channels.gain)
            phases[test] = self._sensor_unknowns("phase", test, channels, phase, unit="rad", group="phase")
            for stated in channels.calibrations:
                self._source(f"sensor {stated.source}", stated, 0.0)
        n_shaft = 4 * rig.rotor.n_node
        n_dof = n_shaft + 2 * len(self.system.pedestals)
        model = SystemModel(tuple(self.unknowns), tuple(self.terms), n_dof, n_shaft)
        return Built(model, planes, gains, phases, self.sources)

    def _sensor_unknowns(
        self, what: str, test: str, sensors: Sensors, error: float, **entries: Any
    ) -> tuple[int, ...]:
        return tuple(
            number
            for label in sensors.labels
            for number in self.unknown(f"{what} {test} {label}", error, tests=frozenset([test]), **entries)
        )

    def _shaft(self) -> None:
        rotor = self.system.rig.rotor
        materials = list(dict.fromkeys(element.material for element in rotor.elements))
        young = {
            material: self.unknown(
                "young" if len(materials) == 1 else f"young of {material.name or number}",
                self.system.young.get(material, 0.0),
                nominal=material.elastic_modulus,
                nominal_unit="Pa",
            )
            for number, material in enumerate(materials, 1)
        }
        factors: dict[int, tuple[tuple[int, ...], float]] = {}
        for name, (elements, mean, error) in self.system.sleeves.items():
            numbers = self.unknown(f"sleeve {name}", error, mean)
            constant = 1.0 if numbers else float(np.exp(mean))
            for place in elements:
                others, before = factors.get(place, ((), 1.0))
                factors[place] = ((*others, *numbers), before * constant)
        beta, error = self.system.internal
        internal = self.unknown("internal damping", error if beta else 0.0, nominal=beta, nominal_unit="s")
        for number, element in enumerate(rotor.elements, 1):
            dofs, mass = range(4 * number - 4, 4 * number + 4), self._inertia(number, element)
            sleeve, constant = factors.get(number, ((), 1.0))
            local = self.unknown(f"element {number}", self.small.elements, group="elements")
            acting = (*young[element.material], *sleeve, *local)
            plane = constant * shaft.plane_stiffness(element)
            stiffness, turning = shaft.expand_to_both_planes(plane), (*acting, *internal)
            self.add("stiffness", dofs, stiffness, acting)
            if rotor.alpha or rotor.beta:
                self.add("damping", dofs, rotor.alpha * mass)
                self.add("damping", dofs, rotor.beta * stiffness, acting)
            if beta:
                self.add("damping", dofs, beta * stiffness, turning)
                self.add("circulatory", dofs, beta * shaft.across_planes(plane), turning)
        for ring in rotor.sleeves:
            element = rotor.elements[ring.element - 1]
            self._inertia(ring.element, element, ring.tube(element))

    def _inertia(self, number: int, element: shaft.ShaftElement, *ring: shaft.ShaftElement) -> FloatArray:
        mass, gyroscopic = shaft.inertia_matrices(element, *ring)
        for name, matrix in (("mass", mass), ("gyroscopic", gyroscopic)):
            self.add(name, range(4 * number - 4, 4 * number + 4), matrix)
        return mass

    def _discs(self) -> None:
        rotor = self.system.rig.rotor
        errors = self.system.masses or (0.0,) * len(rotor.discs)
        for number, (disc, error) in enumerate(zip(rotor.discs, errors, strict=True), 1):
            y, z, about_y, about_z = range(4 * disc.node - 4, 4 * disc.node)
            mass = self.unknown(f"mass of disc {number}", error, nominal=disc.mass, nominal_unit="kg")
            moments = (("J_t", disc.transverse_inertia), ("J_p", disc.polar_inertia))
            own = [
                self.unknown(f"{name} of disc {number}", self.small.inertia * bool(j), group="inertia")
                for name, j in moments
            ]
            transverse, polar = ((*mass, *factor) for factor in own)
            self.add("mass", (y, z), disc.mass * np.eye(2), mass)
            self.add("mass", (about_y, about_z), disc.transverse_inertia * np.eye(2), transverse)
            turning = disc.polar_inertia * np.array([[0.0, 1.0], [-1.0, 0.0]])
            self.add("gyroscopic", (about_y, about_z), turning, polar)

    def _bearing(self, place: BearingPlace) -> None:
        rig = self.system.rig
        node = rig.rotor.dofs(place.node)
        linear = self.system.linear.get(place.name)
        dofs, spread = tuple(node), np.ones((2, 2))
        pedestals = [pedestal for pedestal in self.system.pedestals if pedestal.bearing == place.name]
        if pedestals:
            first = 4 * rig.rotor.n_node + 2 * self.system.pedestals.index(pedestals[0])
            dofs, spread = (*node, first, first + 1), np.kron(np.array([[1, -1], [-1, 1]]), spread)
        if linear is not None:
            self._coefficients(place.name, linear, dofs, spread)
        else:
            self._theory(place, dofs, spread)
        for pedestal in pedestals:
            for matrix, letter, size, error, unit in (
                ("stiffness", "k", pedestal.stiffness, pedestal.error, "N/m"),
                ("mass", "m", pedestal.mass, pedestal.mass_error, "kg"),
                ("damping", "c", pedestal.damping, 0.0, "N.s/m"),
            ):
                name = f"pedestal {place.name} {letter}"
                factor = self.unknown(name, error, nominal=size, nominal_unit=unit)
                self.add(matrix, dofs[2:], size * np.eye(2), factor, support=True)
        for direction, dof in zip(DIRECTIONS, node, strict=True):
            name = f"apparent mass {place.name} {direction}"
            apparent = self.unknown(name, self.small.apparent_mass, unit="1", group="apparent_mass")
            for number in apparent:
                self.add("mass", (dof,), np.array([[APPARENT]]), amount=number, support=True)

    def _coefficients(
        self, name: str, bearing: LinearBearing, dofs: tuple[int, ...], spread: FloatArray
    ) -> None:
        """A term for each coefficient: its own factor, and that of running against standing."""
        matrices = (
            ("stiffness", "k", "N/m", bearing.stiffness, bearing.stiffness_error),
            ("damping", "c", "N.s/m", bearing.damping, bearing.damping_error),
        )
        for matrix, letter, unit, values, errors in matrices:
            numbers: dict[str, tuple[tuple[int, ...], dict[str, int]]] = {}
            for place, label in enumerate(COEFFICIENTS):
                row, column = divmod(place, 2)
                value, error = float(values[row, column]), float(errors[row, column])
                if not value and not error:
                    continue
                alike = letter in bearing.common and row == column
                turning = letter == "k" and bearing.skew and row != column
                shown = ALIKE[letter] if alike else "k_cross" if turning else f"{letter}_{label}"
                if shown not in numbers:
                    linear = not value or row != column
                    numbers[shown] = self._with_running(f"{name} {shown}", error, value, unit, linear)
                factors, amount = numbers[shown]
                entry = np.zeros((2, 2))
                entry[row, column] = (-1.0 if turning and row else 1.0) if amount else value
                block = spread * np.tile(entry, (len(dofs) // 2,) * 2)
                acting = partial(_turning, block) if turning else block
                self.add(matrix, dofs, acting, factors, support=True, **amount)

    def _with_running(
        self, name: str, error: float, value: float, unit: str, linear: bool
    ) -> tuple[tuple[int, ...], dict[str, int]]:
        """The factors of a coefficient, and its amount where it is *linear*."""
        if linear:
            numbers = self.unknown(name, error, value, unit=unit)
            return self._running(name), {"amount": numbers[0]} if numbers else {}
        numbers = self.unknown(name, error, nominal=value, nominal_unit=unit)
        return (*numbers, *self._running(name)), {}

    def _running(self, name: str) -> tuple[int, ...]:
        """Of a coefficient "left k_yy" or "left k": what changes it between rest and speed, by itself and
        with those of all bearings.
        """
        running = self.unknown(f"{name} running", self.small.bearings, tests=self.running, group="bearings")
        return (*running, *self.together[name.rpartition(" ")[2][0]])

    def _source(self, name: str, stated: Uncertainty, value: float) -> int:
        """The number of what errs by a *stated* uncertainty; a new one where its source is new."""
        if stated.source not in self.sources:
            unit = stated.unit or "1"
            (self.sources[stated.source],) = self.unknown(name, stated.std_error, value, unit=unit)
        return self.sources[stated.source]

    def _theory(self, place: BearingPlace, dofs: tuple[int, ...], spread: FloatArray) -> None:
        stated = ((entry.uncertainty, entry.value) for entry in place.uncertainties)
        inputs = tuple(self._source(of.source.replace(": ", " "), of, value) for of, value in stated)
        scales = np.array([(self.unknowns[n].mean, self.unknowns[n].error) for n in inputs]).reshape(-1, 2)
        theory = Theory(place, self.system.rig.static_loads()[place.name], scales)
        for matrix, letter in (("stiffness", "k"), ("damping", "c")):
            block, running = partial(theory.block, matrix, spread), self._running(f"{place.name} {letter}")
            self.add(matrix, dofs, block, running, support=True, inputs=inputs, follows=theory.follows)


def _turning(block: FloatArray, spin: FloatArray, _omega: FloatArray, _inputs: FloatArray) -> FloatArray:
    return block * (np.asarray(spin) != 0)[..., None, None]
