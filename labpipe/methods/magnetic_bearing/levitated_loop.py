"""The virtual levitated rig: settings, and rotor, bearings and amplifiers in continuous time, the loop closed
from step to step.

M q'' + (C + W G) q' = B (k_i i - k_s B' q + ...) + Q, y = S q + n, i_c = -C(z) X (y + r_in) + r_out, held and
one delay late. The coordinates q of a rotor on two bearings are x_c, y_c, dx/dz, dy/dz of its centre of
gravity, then the bending mode in x and in y.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import SettingError
from labpipe.methods.magnetic_bearing import sampled_loop
from labpipe.records.settings import Settings, StandardDeviations, choice, flag, quantity, section, setting
from labpipe.simulate.linear import receptance

KIND = "virtual-levitated-rig"
PLACES = ("output", "input")
AXES = {"x": ("x",), "xy": ("x", "y")}
ENDS = ("a", "b")
# Runs with all axes excited at once, or none; others are named after their axis, as multisine-x.
RANDOM, SHAKER, REST, MULTISINE = "random", "shaker", "rest", "multisine"


@dataclass(frozen=True)
class BendingMode(Settings):
    """One free-free mode in either plane, modal mass 1 kg: q'' + 2 zeta w_0 q' + w_0^2 q = shape * force."""

    frequency: float = quantity("natural frequency w_0", "Hz")
    at_bearings: tuple[float, ...] = setting(
        "values", "its shape at both bearings, for a modal mass of 1 kg", "1"
    )
    at_sensors: tuple[float, ...] = setting("values", "its shape at both sensors", "1")
    damping_ratio: float = quantity("damping ratio of the mode", "1", 0.003)
    at_unbalance: float = quantity("its shape at the unbalance", "1", 0.0)

    def __post_init__(self) -> None:
        self.require_positive("frequency")
        self.require_not_negative("damping_ratio")
        for name in ("at_bearings", "at_sensors"):
            if len(getattr(self, name)) != len(ENDS):
                raise SettingError(name, f"'{name}' needs a number for each of the two ends")


@dataclass(frozen=True)
class LongRotor(Settings):
    """A rotor on two bearings: its inertias, and places along the axis from the centre of gravity on."""

    inertia: float = quantity("transverse moment of inertia about the centre of gravity", "kg.m^2")
    bearings: tuple[float, ...] = setting("values", "places of the two bearings", "m")
    sensors: tuple[float, ...] = setting("values", "places of the two sensors, of either axis", "m")
    polar_inertia: float = quantity("polar moment of inertia", "kg.m^2", 0.0)
    bending: BendingMode | None = section("a bending mode", BendingMode, None)

    def __post_init__(self) -> None:
        self.require_positive("inertia")
        for name in ("bearings", "sensors"):
            places = getattr(self, name)
            if len(places) != len(ENDS) or places[0] == places[1]:
                raise SettingError(name, f"'{name}' needs two different places")


@dataclass(frozen=True)
class SampledPid(Settings):
    """i = -(P + I / s + D s / (1 + s T)) X y by the bilinear transform, sampled and held at *rate*, *delay*
    intervals late. y are the readings of all sensors, X mixes them: the unit matrix unless `mixing` is given.
    """

    proportional: float = quantity("P, current per displacement", "A/m")
    derivative: float = quantity("D, current per velocity", "A.s/m")
    integral: float = quantity("I, current per displacement and time", "A/(m.s)", 0.0)
    derivative_time: float = quantity("time constant T of the differentiator", "s", 2e-4)
    rate: float = quantity("sampling rate of the controller", "Hz", 10e3)
    delay: int = setting(
        "integer", "whole intervals from a reading to the output computed from it", default=1
    )
    mixing: tuple[tuple[float, ...], ...] | None = setting(
        "matrix", "X, from readings to axes of control (order of the axes)", "1", None
    )

    def __post_init__(self) -> None:
        self.require_positive("rate", "derivative_time")


@dataclass(frozen=True)
class Injection(Settings):
    """What is added at the controller's output (a current) or input (a displacement), rms of one axis."""

    rms: float = quantity("rms at the output [A]; at the input [m] it is this times `per_ampere`", "A", 0.1)
    place: str = choice("where it is added", PLACES, "output")
    per_ampere: float = quantity("displacement added at the input for 1 A", "m/A", 1e-4)
    band: tuple[float, float] = setting("band", "excited frequencies", "Hz", (5.0, 500.0))
    spacing: float = quantity("spacing of the lines of a multisine", "Hz", 1.0)
    periods: int = setting("integer", "periods of a multisine recorded, all of them steady", default=20)
    duration: float = quantity("length of the other runs", "s", 20.0)

    def __post_init__(self) -> None:
        self.require_positive("rms", "per_ampere", "spacing", "periods", "duration")


@dataclass(frozen=True)
class LevitatedNoise(StandardDeviations):
    """What the rig adds to the recordings, of the part up to half their sampling rate."""

    displacement: float = quantity("position sensors; it is in the loop", "m", 1e-7)
    current: float = quantity("measured currents", "A", 1e-4)
    force: float = quantity("measured force of a shaker", "N", 0.05)
    disturbance: float = quantity("random force on the rotor at every bearing and axis", "N", 1.0)
    reference: float = quantity("recorded injection, of the unit in which it is recorded", "1", 0.0)


@dataclass(frozen=True)
class LevitatedRig(Settings):
    """A rotor in magnetic bearings under a sampled controller: a mass on one bearing, or a `rotor` on two."""

    kind: str = choice("which virtual rig", (KIND,))
    mass: float = quantity("mass of the rotor", "kg")
    control: SampledPid = section("the controller", SampledPid)
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual levitated rotor")
    axes: str = choice("directions", tuple(AXES), "x")
    rotor: LongRotor | None = section("rotor on two bearings; without it, a mass on one", LongRotor, None)
    force_per_current: float = quantity("k_i of one bearing", "N/A", 80.0)
    negative_stiffness: float = quantity(
        "pull of one bearing's bias field per displacement, -k_s", "N/m", 2e5
    )
    damping: float = quantity("passive damping at every bearing", "N.s/m", 0.0)
    cross_stiffness: float = quantity("k_xy = -k_yx at every bearing, as of a seal", "N/m", 0.0)
    amplifier_bandwidth: float = quantity("-3 dB bandwidth of the current amplifiers", "Hz", 2000.0)
    injection: Injection = section("what is added in the loop", Injection, Injection())
    shaker: float = quantity("rms force of a shaker at every bearing and axis (run shaker)", "N", 10.0)
    speed: float = quantity("shaft speed", "Hz", 0.0)
    unbalance: float = quantity("mass times eccentricity", "kg.m", 0.0)
    unbalance_place: float = quantity("its place along the axis", "m", 0.0)
    runout: tuple[float, ...] = setting("values", "amplitudes of 1x, 2x, ... that the sensors see", "m", ())
    sample_rate: float = quantity(
        "sampling rate of the recording: the controller's over a whole number", "Hz", 2000.0
    )
    force_recorded: bool = flag("the currents are recorded as the forces k_i i")
    output_recorded: bool = flag("the controller's outputs, with what is added there, are recorded too (u_)")
    noise: LevitatedNoise = section("noise", LevitatedNoise, LevitatedNoise())

    def __post_init__(self) -> None:
        self.require_positive("mass", "force_per_current", "amplifier_bandwidth", "sample_rate", "shaker")
        self.require_not_negative("speed", "damping", "unbalance", "runout")
        polar_inertia = self.rotor is not None and self.rotor.polar_inertia
        if self.axes == "x" and (self.cross_stiffness or polar_inertia):
            raise SettingError("axes", "cross-coupling and gyroscopic moments need both axes", "axes: xy")
        if self.rotor is None and self.unbalance_place:
            raise SettingError("unbalance_place", "a mass on one bearing has no places", "leave it out")
        what = f"the recording's rate divides that of the controller, {self.control.rate:g} Hz"
        _whole(self.control.rate / self.sample_rate, what)
        what = "a period of the injection holds no whole number of samples"
        _whole(self.sample_rate / self.injection.spacing, what)
        if self.injection.duration * self.sample_rate < 1:
            raise SettingError("injection", "its duration holds no sample", "for example duration: 20 s")
        if not self.injection.band[1] < self.sample_rate / 2:
            what = f"the injection's band must lie below {self.sample_rate / 2:g} Hz"
            raise SettingError("injection", what)
        n = len(self.labels)
        if self.control.mixing is not None and np.shape(self.control.mixing) != (n, n):
            hint = f"its axes are {', '.join(self.labels)}"
            raise SettingError("control", f"control.mixing is not a {n} x {n} matrix", hint)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the controlled axes: x, y of one bearing, ax, ay, bx, by of two."""
        ends = ("",) if self.rotor is None else ENDS
        return tuple(end + axis for end in ends for axis in AXES[self.axes])

    @property
    def runs(self) -> tuple[str, ...]:
        """The names of all recordings that can be made."""
        single = (f"{kind}-{label}" for kind in (MULTISINE, RANDOM) for label in self.labels)
        return (RANDOM, *single, SHAKER, REST)

    @property
    def usual(self) -> tuple[str, ...]:
        """All axes at random, and a multisine on each."""
        return (RANDOM, *(f"{MULTISINE}-{label}" for label in self.labels))

    @property
    def decimation(self) -> int:
        """Steps of the controller per recorded sample."""
        return round(self.control.rate / self.sample_rate)


def _whole(number: float, what: str) -> None:
    if abs(number - round(number)) > 1e-9 * number or round(number) < 1:
        raise SettingError("sample_rate", what)


# Times in an interval of the controller at which motion and current are known.
BETWEEN = 8


@dataclass(frozen=True)
class Mechanics:
    """M [kg], C + W G [N.s/m] and the rotor's own K [N/m], (n_q, n_q). at_bearings, at_sensors (n_axis, n_q)
    [1, m]: displacement there per coordinate; at_unbalance (n_direction, n_q).
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    at_bearings: FloatArray
    at_sensors: FloatArray
    at_unbalance: FloatArray


def mechanics(rig: LevitatedRig) -> Mechanics:
    """The rotor's matrices with the passive damping, without k_i and k_s."""
    directions = np.eye(len(AXES[rig.axes]))
    if rig.rotor is None:
        masses, gyroscopic, stiffnesses, own_damping = [rig.mass], [0.0], [0.0], [0.0]
        shapes: list[FloatArray] = [np.ones((1, 1))] * 3
    else:
        masses, gyroscopic, stiffnesses, own_damping = _inertias(rig.mass, rig.rotor)
        shapes = _shapes(rig.rotor, rig.unbalance_place)
    at_bearings, at_sensors, at_unbalance = (np.kron(shape, directions) for shape in shapes)
    # Spin from x to y: J a'' - W J_p b' and J b'' + W J_p a' of the slopes b in x, a in y.
    spin = np.array([[0.0, 1.0], [-1.0, 0.0]]) if directions.shape[0] == 2 else np.zeros((1, 1))
    turning = 2 * np.pi * rig.speed * np.kron(np.diag(gyroscopic), spin)
    passive = rig.damping * at_bearings.T @ at_bearings
    return Mechanics(
        mass=np.kron(np.diag(masses), directions),
        damping=np.kron(np.diag(own_damping), directions) + turning + passive,
        stiffness=np.kron(np.diag(stiffnesses), directions),
        at_bearings=at_bearings,
        at_sensors=at_sensors,
        at_unbalance=at_unbalance,
    )


def _inertias(mass: float, rotor: LongRotor) -> list[list[float]]:
    rigid = [[mass, rotor.inertia], [0.0, rotor.polar_inertia], [0.0, 0.0], [0.0, 0.0]]
    if rotor.bending is None:
        return rigid
    natural = 2 * np.pi * rotor.bending.frequency
    of_mode = 1.0, 0.0, natural**2, 2 * rotor.bending.damping_ratio * natural
    return [[*both, own] for both, own in zip(rigid, of_mode, strict=True)]


def _shapes(rotor: LongRotor, unbalance: float) -> list[FloatArray]:
    """Displacement in one plane per coordinate at bearings and sensors (2, n) and at the unbalance (1, n)."""
    places = [rotor.bearings, rotor.sensors, (unbalance,)]
    rigid = [np.column_stack([np.ones(len(place)), place]) for place in places]
    if rotor.bending is None:
        return rigid
    bending = [rotor.bending.at_bearings, rotor.bending.at_sensors, (rotor.bending.at_unbalance,)]
    return [np.column_stack([shape, values]) for shape, values in zip(rigid, bending, strict=True)]


def bearing_stiffness(rig: LevitatedRig) -> FloatArray:
    """Stiffness of the bearings without currents (n_axis, n_axis) [N/m]: k_s, and what couples x with y."""
    direct = -rig.negative_stiffness * np.eye(len(rig.labels))
    if rig.axes == "x":
        return direct
    coupling = np.array([[0.0, 1.0], [-1.0, 0.0]]) * rig.cross_stiffness
    return direct + np.kron(np.eye(len(direct) // 2), coupling)


def rotor_receptance(rig: LevitatedRig, frequency: FloatArray) -> ComplexArray:
    """S (-w^2 M + j w C + K + B' k_s B)^-1 B', (n_line, n_axis, n_axis) [m/N] at *frequency* (n_line,) [Hz]:
    reading per force k_i i. Equation (sim-rotor).
    """
    rotor = mechanics(rig)
    stiffness = rotor.stiffness + rotor.at_bearings.T @ bearing_stiffness(rig) @ rotor.at_bearings
    moved = receptance(rotor.mass, stiffness, rotor.damping, np.asarray(frequency, float))
    return np.asarray(rotor.at_sensors @ moved @ rotor.at_bearings.T)


@dataclass(frozen=True)
class LevitatedLoop(sampled_loop.SampledLoop):
    """w: generalised forces [N] at this and at the next sample, what sensors see besides the motion [m],
    injection at the controller's input [m] and output [A]; z: output of the controller [A], then motion [m]
    and current [A] BETWEEN times in the interval; all but the forces *n_axis* each. Equation (sim-step).
    """

    n_axis: int

    @property
    def poles(self) -> ComplexArray:
        """Poles (n_state,) [1/s], s = rate ln z, but z = 0 that a delay holds. Equation (sim-poles)."""
        values = np.linalg.eigvals(self.a)
        values = values[np.abs(values) > sampled_loop.ROUNDING]
        return self.rate * np.log(values.astype(np.complex128))

    def signals(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Output of the controller with what is added (n_sample, n_axis) [A], motion at the sensors [m] and
        current [A] BETWEEN times as often, of *inputs* (n_sample, n_input) [N, m, m, A], from rest;
        ConfigError where unstable.
        """
        growth = float(np.max(self.poles.real))
        if growth > sampled_loop.ROUNDING * self.rate:
            what = f"the levitated rotor is unstable: its fastest pole grows by e in {1e3 / growth:.3g} ms"
            hint = "raise proportional and derivative gain, or shorten the delay"
            raise SettingError("control", what, hint)
        outputs = self.respond(inputs)
        fine = outputs[:, self.n_axis :].reshape(-1, 2, self.n_axis)
        return outputs[:, : self.n_axis], fine[:, 0], fine[:, 1]


def levitated_loop(rig: LevitatedRig) -> LevitatedLoop:
    of, control = mechanics(rig), rig.control
    n_q, n_axis = of.mass.shape[0], len(rig.labels)
    plant = [_sampled_plant(rig, of, part / BETWEEN) for part in range(BETWEEN + 1)]
    n_plant = plant[0][0].shape[0]
    interval = 1 / control.rate
    trapezoid = control.integral * interval / 2
    differentiator = sampled_loop.tustin(control.derivative, 0.0, control.derivative_time, interval)
    terms = [differentiator, (trapezoid, trapezoid, -1.0)]
    mixing = np.eye(n_axis) if control.mixing is None else np.array(control.mixing, float)

    def advance(state: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        motion, memory, waiting = np.split(state, [n_plant, n_plant + 2 * n_axis])
        forces, (seen, added_in, added_out) = inputs[: 2 * n_q], inputs[2 * n_q :].reshape(3, n_axis)
        error = mixing @ (of.at_sensors @ motion[:n_q] + seen + added_in)
        pairs = zip(terms, memory.reshape(2, n_axis), strict=True)
        parts = [b0 * error + stored for (b0, _, _), stored in pairs]
        memories = [b1 * error - a1 * part for (_, b1, a1), part in zip(terms, parts, strict=True)]
        output = added_out - control.proportional * error - parts[0] - parts[1]
        line = np.concatenate([waiting, output])
        moved = [step @ motion + hold @ line[:n_axis] + force @ forces for step, hold, force in plant]
        fine = [part for at in moved[:-1] for part in (of.at_sensors @ at[:n_q], at[2 * n_q :])]
        return np.concatenate([moved[-1], *memories, line[n_axis:]]), np.concatenate([output, *fine])

    n_state = n_plant + 2 * n_axis + control.delay * n_axis
    matrices = sampled_loop.step_matrices(advance, n_state, 2 * n_q + 3 * n_axis)
    return LevitatedLoop(*matrices, control.rate, n_axis)


def _sampled_plant(
    rig: LevitatedRig, of: Mechanics, share: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """q, q', currents after a *share* of an interval: step, held outputs, straight forces."""
    n_q, n_axis = of.mass.shape[0], len(rig.labels)
    n = 2 * n_q + n_axis
    corner = 2 * np.pi * rig.amplifier_bandwidth
    inverse = np.linalg.inv(of.mass)
    stiffness = of.stiffness + of.at_bearings.T @ bearing_stiffness(rig) @ of.at_bearings
    slope, outputs, forces = np.zeros((n, n)), np.zeros((n, n_axis)), np.zeros((n, n_q))
    slope[:n_q, n_q : 2 * n_q] = np.eye(n_q)
    push = rig.force_per_current * of.at_bearings.T
    slope[n_q : 2 * n_q] = inverse @ np.hstack([-stiffness, -of.damping, push])
    slope[2 * n_q :, 2 * n_q :] = -corner * np.eye(n_axis)
    outputs[2 * n_q :] = corner * np.eye(n_axis)
    forces[n_q : 2 * n_q] = inverse
    interval = 1 / rig.control.rate
    step, hold, _ = sampled_loop.integrals(slope, outputs, share * interval)
    _, constant, rising = sampled_loop.integrals(slope, forces, share * interval)
    return step, hold, np.hstack([constant - rising / interval, rising / interval])
