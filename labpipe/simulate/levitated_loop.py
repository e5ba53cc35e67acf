"""The virtual levitated rig as matrices: rotor, bearings and amplifiers in continuous time, the loop closed from step to step.

M q'' + (C + W G) q' = B (k_i i - k_s B' q + ...) + Q, y = S q + n, i_c = -C(z) X (y + r_in) + r_out, held and one delay late. The
coordinates q of a rotor on two bearings are x_c, y_c, dx/dz, dy/dz of its centre of gravity, then the bending mode in x and in y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.sampled_loop import integrals, step_matrices, tustin
from labpipe.errors import ConfigError
from labpipe.simulate.levitated_settings import AXES, LevitatedRig, LongRotor

ROUNDING = 1e-9
# Steps of one piece in which a loop is run.
PIECE = 512
# Times in an interval of the controller at which motion and current are known.
BETWEEN = 8


@dataclass(frozen=True)
class Mechanics:
    """M [kg], C + W G [N.s/m] and the rotor's own K [N/m], (n_q, n_q); tilts in kg.m^2 and so on.

    at_bearings, at_sensors (n_axis, n_q) [1, m]: displacement there per coordinate; at_unbalance (n_direction, n_q).
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
        shapes: tuple[FloatArray, FloatArray, FloatArray] = np.ones((1, 1)), np.ones((1, 1)), np.ones((1, 1))
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


def _inertias(mass: float, rotor: LongRotor) -> tuple[list[float], list[float], list[float], list[float]]:
    """Masses, polar inertias, own stiffnesses and dampings of the coordinates of one plane."""
    masses, gyroscopic, stiffnesses, damping = [mass, rotor.inertia], [0.0, rotor.polar_inertia], [0.0, 0.0], [0.0, 0.0]
    if rotor.bending is not None:
        natural = 2 * np.pi * rotor.bending.frequency
        masses, gyroscopic = [*masses, 1.0], [*gyroscopic, 0.0]
        stiffnesses, damping = [*stiffnesses, natural**2], [*damping, 2 * rotor.bending.damping_ratio * natural]
    return masses, gyroscopic, stiffnesses, damping


def _shapes(rotor: LongRotor, unbalance: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacement in one plane per coordinate at bearings and sensors (2, n) and at the unbalance (1, n)."""
    places = [np.array(rotor.bearings), np.array(rotor.sensors), np.array([unbalance])]
    rigid = [np.column_stack([np.ones_like(place), place]) for place in places]
    if rotor.bending is None:
        return rigid[0], rigid[1], rigid[2]
    bending = [rotor.bending.at_bearings, rotor.bending.at_sensors, (rotor.bending.at_unbalance,)]
    bent = [np.column_stack([shape, np.array(values)]) for shape, values in zip(rigid, bending, strict=True)]
    return bent[0], bent[1], bent[2]


def bearing_stiffness(rig: LevitatedRig) -> FloatArray:
    """Stiffness of the bearings without their currents (n_axis, n_axis) [N/m]: k_s, and what couples x with y."""
    n = len(rig.labels)
    coupling = np.array([[0.0, 1.0], [-1.0, 0.0]]) * rig.cross_stiffness if rig.axes == "xy" else np.zeros((1, 1))
    return np.asarray(-rig.negative_stiffness * np.eye(n) + np.kron(np.eye(n // coupling.shape[0]), coupling))


def rotor_receptance(rig: LevitatedRig, frequency: FloatArray) -> ComplexArray:
    """S (-w^2 M + j w C + K + B' k_s B)^-1 B', (n_line, n_axis, n_axis) [m/N] at *frequency* (n_line,) [Hz]: reading per force k_i i.

    Equation (sim-rotor).
    """
    of = mechanics(rig)
    jw = 2j * np.pi * np.asarray(frequency, float)[:, None, None]
    dynamic = jw**2 * of.mass + jw * of.damping + of.stiffness + of.at_bearings.T @ bearing_stiffness(rig) @ of.at_bearings
    return np.asarray(of.at_sensors @ np.linalg.solve(dynamic, np.broadcast_to(of.at_bearings.T, (*jw.shape[:1], *of.at_bearings.T.shape))))


@dataclass(frozen=True)
class Signals:
    """What a run of the loop gives: *output* of the controller (n_sample, n_axis) [A] with what is added there, at its rate.

    motion at the sensors [m] and current [A], (n_sample * BETWEEN, n_axis): a held output leaves a current that is not smooth from step
    to step, and a logger's filter sees it between them.
    """

    output: FloatArray
    motion: FloatArray
    current: FloatArray


@dataclass(frozen=True)
class LevitatedLoop:
    """s[k+1] = A s[k] + B w[k], z[k] = C s[k] + D w[k] at *rate* [Hz].

    w: generalised forces [N] at this and at the next sample, what sensors see besides the motion [m], injection at the controller's input
    [m] and output [A]; z: output of the controller [A], then motion [m] and current [A] BETWEEN times in the interval; all but the
    forces n_axis each. a (n_state, n_state), b (n_state, n_input), c (n_output, n_state), d (n_output, n_input). Equation (sim-step).
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    rate: float
    n_axis: int

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop (n_state,) [1/s], s = rate ln z; what a delay holds alone (z = 0) is left out. Equation (sim-poles)."""
        values = np.linalg.eigvals(self.a)
        values = values[np.abs(values) > ROUNDING]
        return np.asarray(self.rate * np.log(values.astype(np.complex128)))

    def run(self, inputs: FloatArray) -> Signals:
        """The signals of *inputs* (n_sample, n_input) [N, m, m, A], from rest; ConfigError where unstable."""
        growth = float(np.max(self.poles.real))
        if growth > ROUNDING * self.rate:
            message = f"the levitated rotor is unstable: its fastest pole grows by e in {1e3 / growth:.3g} ms"
            raise ConfigError(message, hint="raise proportional and derivative gain, or shorten the delay", field="control")
        outputs = linear_states(self.a, inputs @ self.b.T) @ self.c.T + inputs @ self.d.T
        fine = outputs[:, self.n_axis :].reshape(-1, 2, self.n_axis)
        return Signals(outputs[:, : self.n_axis], fine[:, 0], fine[:, 1])


def linear_states(step: FloatArray, driven: FloatArray) -> FloatArray:
    """s[k] of s[k+1] = A s[k] + *driven*[k] (n_sample, n_state) [units of the states] from rest, with A = *step* (n_state, n_state).

    All pieces at once from rest, then what each inherits from the one before: as many products as a piece has steps and there are pieces.
    """
    n_sample, n = driven.shape
    n_piece = -(-n_sample // PIECE)
    pieces = np.zeros((n_piece * PIECE, n))
    pieces[:n_sample] = driven
    pieces = pieces.reshape(n_piece, PIECE, n)
    states = np.zeros((n_piece, PIECE + 1, n))
    for number in range(PIECE):
        states[:, number + 1] = states[:, number] @ step.T + pieces[:, number]
    over = np.linalg.matrix_power(step, PIECE)
    start = np.zeros((n_piece, n))
    for number in range(1, n_piece):
        start[number] = over @ start[number - 1] + states[number - 1, PIECE]
    for number in range(PIECE):
        states[:, number] += start
        start = start @ step.T
    return np.asarray(states[:, :PIECE].reshape(-1, n)[:n_sample])


def levitated_loop(rig: LevitatedRig) -> LevitatedLoop:
    """The closed loop of a rig."""
    of, control = mechanics(rig), rig.control
    n_q, n_axis = of.mass.shape[0], len(rig.labels)
    plant = [_sampled_plant(rig, of, part / BETWEEN) for part in range(BETWEEN + 1)]
    n_plant = plant[0][0].shape[0]
    interval = 1 / control.rate
    terms = [tustin(control.derivative, 0.0, control.derivative_time, interval), _integrator(control.integral, interval)]
    mixing = np.eye(n_axis) if control.mixing is None else np.array(control.mixing, float)

    def advance(state: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        motion, memory, waiting = np.split(state, [n_plant, n_plant + 2 * n_axis])
        forces, seen, added_in, added_out = np.split(inputs, [2 * n_q, 2 * n_q + n_axis, 2 * n_q + 2 * n_axis])
        error = mixing @ (of.at_sensors @ motion[:n_q] + seen + added_in)
        parts = [b0 * error + stored for (b0, _, _), stored in zip(terms, memory.reshape(2, n_axis), strict=True)]
        memories = [b1 * error - a1 * part for (_, b1, a1), part in zip(terms, parts, strict=True)]
        output = added_out - control.proportional * error - parts[0] - parts[1]
        line = np.concatenate([waiting, output])
        moved = [step @ motion + hold @ line[:n_axis] + force @ forces for step, hold, force in plant]
        fine = [part for at in moved[:-1] for part in (of.at_sensors @ at[:n_q], at[2 * n_q :])]
        return np.concatenate([moved[-1], *memories, line[n_axis:]]), np.concatenate([output, *fine])

    n_state = n_plant + 2 * n_axis + control.delay * n_axis
    return LevitatedLoop(*step_matrices(advance, n_state, 2 * n_q + 3 * n_axis), control.rate, n_axis)


def _integrator(gain: float, interval: float) -> tuple[float, float, float]:
    """(b0, b1, a1) of gain / s by the bilinear transform."""
    return gain * interval / 2, gain * interval / 2, -1.0


def _sampled_plant(rig: LevitatedRig, of: Mechanics, share: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """q, q' and currents after a *share* of the controller's interval: step, held outputs, generalised forces at its ends (straight)."""
    n_q, n_axis = of.mass.shape[0], len(rig.labels)
    n = 2 * n_q + n_axis
    corner = 2 * np.pi * rig.amplifier_bandwidth
    inverse = np.linalg.inv(of.mass)
    stiffness = of.stiffness + of.at_bearings.T @ bearing_stiffness(rig) @ of.at_bearings
    slope, outputs, forces = np.zeros((n, n)), np.zeros((n, n_axis)), np.zeros((n, n_q))
    slope[:n_q, n_q : 2 * n_q] = np.eye(n_q)
    slope[n_q : 2 * n_q] = inverse @ np.hstack([-stiffness, -of.damping, rig.force_per_current * of.at_bearings.T])
    slope[2 * n_q :, 2 * n_q :] = -corner * np.eye(n_axis)
    outputs[2 * n_q :] = corner * np.eye(n_axis)
    forces[n_q : 2 * n_q] = inverse
    interval = 1 / rig.control.rate
    step, hold, _ = integrals(slope, outputs, share * interval)
    _, constant, rising = integrals(slope, forces, share * interval)
    return step, hold, np.hstack([constant - rising / interval, rising / interval])
