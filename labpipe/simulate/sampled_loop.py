"""One direction of a levitated rotor in the time domain: mass, springs and bias field under a controller that samples, computes and holds.

The frequency-domain twin is bearings/magnetic_loop: K_eq + j w C_eq = K G(jw) - k_n with the hold as half a sampling interval of delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_loop import ControlLoop
from labpipe.errors import ConfigError

# Controller of Lim et al. (2009), section 4: sampled at 20 kHz.
CONTROL_RATE = 20e3
ROUNDING = 1e-9
INPUTS = ("force", "next_force", "noise", "injection")
OUTPUTS = ("reading", "before", "after", "output", "current")


@dataclass(frozen=True)
class Suspended:
    """Moving parts in one direction: *mass* [kg] on *bearings* equal bearings, and springs [N/m] and guides [N.s/m] in parallel."""

    loop: ControlLoop
    negative_stiffness: float
    mass: float
    bearings: int = 1
    stiffness: float = 0.0
    damping: float = 0.0


@dataclass(frozen=True)
class SampledLoop:
    """s[k+1] = A s[k] + B w[k], z[k] = C s[k] + D w[k] at *rate* [Hz]; w: INPUTS [N, N, m, V], z: OUTPUTS [m, V, V, V, A].

    a (n_state, n_state), b (n_state, 4), c (5, n_state), d (5, 4). The force is linear between samples, *injection* is added between the
    probe ("before") and the controller ("after").
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    rate: float

    def run(self, inputs: FloatArray) -> FloatArray:
        """Outputs (n_sample, n_direction, 5) [m, V, V, V, A] of inputs (n_sample, n_direction, 4) [N, N, m, V], from rest.

        ConfigError for an unstable loop.
        """
        largest = float(np.max(np.abs(np.linalg.eigvals(self.a))))
        if largest > 1 + ROUNDING:
            rate = np.log(largest) * self.rate
            message = f"the loop is unstable: its fastest pole grows by e in {1e3 / rate:.3g} ms, so there is no recording of it"
            raise ConfigError(message, hint="`labpipe bearing` shows the poles of its bearing file")
        state = np.zeros((self.a.shape[0], inputs.shape[1]))
        driven = inputs @ self.b.T
        states = np.empty((inputs.shape[0], inputs.shape[1], self.a.shape[0]))
        for number in range(inputs.shape[0]):
            states[number] = state.T
            state = self.a @ state + driven[number].T
        return states @ self.c.T + inputs @ self.d.T

    def response(self, omega: FloatArray) -> ComplexArray:
        """z over force, noise and injection at *omega* [rad/s], (n_line, 5, 3); the force as `straight` feeds it."""
        z = np.exp(1j * omega / self.rate)[:, None, None]
        inverse = np.linalg.inv(z * np.eye(self.a.shape[0]) - self.a)
        whole = self.c @ inverse @ self.b + self.d
        force = (whole[:, :, :1] + z * whole[:, :, 1:2]) / straight(omega, self.rate)[:, None, None]
        joined: ComplexArray = np.concatenate([force, whole[:, :, 2:]], axis=2)
        return joined


def straight(omega: FloatArray, rate: float) -> FloatArray:
    """Amplitude of a sampled wave with linear interpolation, sinc^2(w T / 2), (n_line,) [-]; samples are divided by it."""
    shape: FloatArray = np.sinc(omega / (2 * np.pi * rate)) ** 2
    return shape


@dataclass(frozen=True)
class _Plant:
    """Motion, current and probe over one sampling interval, exact for a held voltage and a straight force.

    hold: of the voltage from before and of the newest one (they change over within the interval); ramp: of the force at both ends.
    """

    step: FloatArray
    hold: FloatArray
    ramp: FloatArray


def sampled_loop(plant: Suspended, rate: float = CONTROL_RATE) -> SampledLoop:
    """The closed loop as matrices; ConfigError for a delay shorter than the hold, or a differentiator without time constant."""
    loop = plant.loop
    if loop.derivative_time <= 0 or loop.lag_time <= 0:
        raise ConfigError("a sampled controller needs derivative_time and lag_time above zero")
    intervals = loop.delay * rate - 0.5
    if intervals < -1e-9:
        message = f"delay: {1e6 * loop.delay:g} us is shorter than half a sampling interval of the controller, which it holds"
        raise ConfigError(message, hint=f"at least {5e5 / rate:g} us at {rate / 1e3:g} kHz")
    whole = int(np.floor(intervals + 1e-9))
    motion = _plant(plant, max(intervals - whole, 0.0), 1 / rate)
    terms = [tustin(loop.derivative, 0.0, loop.derivative_time, 1 / rate), tustin(0.0, loop.lag, loop.lag_time, 1 / rate)]

    def step(state: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _step(loop, motion, terms, state, inputs)

    return SampledLoop(*step_matrices(step, motion.step.shape[0] + 2 + whole + 1, len(INPUTS)), rate)


def _step(
    loop: ControlLoop, plant: _Plant, terms: list[tuple[float, float, float]], state: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One sampling interval. state: motion, the controller's two memories, voltages on their way, oldest first."""
    n = plant.step.shape[0]
    motion, memory, waiting = state[:n], state[n : n + 2], state[n + 2 :]
    position = motion[3] if n == 4 else motion[0]
    reading = position + inputs[2]
    before = loop.sensor * reading
    after = before + inputs[3]
    parts = [b0 * after + state_part for (b0, _, _), state_part in zip(terms, memory, strict=True)]
    output = loop.proportional * after + sum(parts)
    memories = [b1 * after - a1 * part for (_, b1, a1), part in zip(terms, parts, strict=True)]
    # The voltage that arrives within this interval takes over from the one before it.
    line = np.append(waiting, output)
    moved = plant.step @ motion + plant.hold @ line[:2] + plant.ramp @ inputs[:2]
    return np.concatenate([moved, memories, line[1:]]), np.array([reading, before, after, output, motion[2]])


def tustin(derivative: float, constant: float, time: float, interval: float) -> tuple[float, float, float]:
    """(b0, b1, a1) [unit of *constant*] of (constant + derivative s) / (1 + s time) by the bilinear transform; *time*, *interval* [s]."""
    fast = 2 / interval
    whole = 1 + fast * time
    return (constant + fast * derivative) / whole, (constant - fast * derivative) / whole, (1 - fast * time) / whole


def _plant(plant: Suspended, late: float, interval: float) -> _Plant:
    """Exact solution over one *interval* [s]; the newest voltage arrives after *late* of it."""
    loop, n = plant.loop, 3 if plant.loop.sensor_bandwidth is None else 4
    slope, voltage, force = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    slope[0, 1] = 1.0
    slope[1, :3] = -plant.stiffness + plant.bearings * plant.negative_stiffness, -plant.damping, -plant.bearings * loop.force_per_current
    slope[1] /= plant.mass
    slope[2, 2], voltage[2] = -1 / loop.corners[0], loop.amplifier / loop.corners[0]
    if n == 4:
        slope[3, 0], slope[3, 3] = 1 / loop.corners[1], -1 / loop.corners[1]
    force[1] = 1 / plant.mass
    step, _, _ = integrals(slope, voltage[:, None], interval)
    rest, newest, _ = integrals(slope, voltage[:, None], (1 - late) * interval)
    _, oldest, _ = integrals(slope, voltage[:, None], late * interval)
    _, constant, rising = integrals(slope, force[:, None], interval)
    return _Plant(step, np.hstack([rest @ oldest, newest]), np.hstack([constant - rising / interval, rising / interval]))


def integrals(slope: FloatArray, inputs: FloatArray, time: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """e^{A t} (n, n), and the responses (n, m) to a constant 1 and to a ramp t of every input after *time* [s] (Van Loan, 1978).

    *slope* A (n, n) [1/s], *inputs* B (n, m) [unit of the state per second].
    """
    n, m = inputs.shape
    joint = np.zeros((n + 2 * m, n + 2 * m))
    joint[:n, :n], joint[:n, n : n + m], joint[n : n + m, n + m :] = slope, inputs, np.eye(m)
    whole = linalg.expm(joint * time)
    return whole[:n, :n], whole[:n, n : n + m], whole[:n, n + m :]


def step_matrices(
    step: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]], n_state: int, n_input: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A, B, C, D of a linear *step* (state, inputs) -> (next state, outputs) [any unit], column by column: (n_state, n_state), ..."""
    still = np.zeros(n_input)
    by_state = [step(unit, still) for unit in np.eye(n_state)]
    by_input = [step(np.zeros(n_state), unit) for unit in np.eye(n_input)]
    a, c = (np.column_stack([column[part] for column in by_state]) for part in (0, 1))
    b, d = (np.column_stack([column[part] for column in by_input]) for part in (0, 1))
    return a, b, c, d
