"""One direction of a levitated rotor in the time domain under a controller that samples, computes and holds.

The frequency-domain twin is `loop`: K_eq + j w C_eq = K G(jw) - k_n with the hold as half a sampling interval
of delay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.magnetic_bearing.loop import ControlLoop
from labpipe.methods.magnetic_bearing.transfer import ControllerBlock, connect_series

# Controller of Lim et al. (2009), section 4: sampled at 20 kHz.
CONTROL_RATE = 20e3
ROUNDING = 1e-9
# Steps of one piece in which a loop is run.
PIECE = 512
INPUTS = ("force", "next_force", "noise", "injection")
OUTPUTS = ("reading", "before", "after", "output", "current")


@dataclass(frozen=True)
class Suspended:
    """Moving *mass* [kg] in one direction on equal *bearings*, springs [N/m] and guides [N.s/m]."""

    loop: ControlLoop
    negative_stiffness: float
    mass: float
    bearings: int = 1
    stiffness: float = 0.0
    damping: float = 0.0


@dataclass(frozen=True)
class SampledLoop:
    """s[k+1] = A s[k] + B w[k], z[k] = C s[k] + D w[k] at *rate* [Hz]; w: INPUTS [N, N, m, V], z: OUTPUTS [m,
    V, V, V, A]. a (n_state, n_state), b (n_state, n_input), c (n_output, n_state), d (n_output, n_input). The
    force is linear between samples, *injection* is added between the probe ("before") and the controller
    ("after").
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    rate: float

    def respond(self, inputs: FloatArray) -> FloatArray:
        """z (n_sample, n_output) [its units] of *inputs* w (n_sample, n_input) [its units], from rest."""
        return linear_states(self.a, inputs @ self.b.T) @ self.c.T + inputs @ self.d.T

    def run(self, inputs: FloatArray) -> FloatArray:
        """Outputs (n_sample, n_direction, 5) [m, V, V, V, A] of inputs (n_sample, n_direction, 4) [N, N, m,
        V], from rest. ConfigError for an unstable loop, and for one of two directions.
        """
        if self.b.shape[1] > len(INPUTS):
            hint = "leave cross out"
            raise SettingError("cross", "a cross-coupled controller has no loop of one direction", hint)
        largest = float(np.max(np.abs(np.linalg.eigvals(self.a))))
        if largest > 1 + ROUNDING:
            rate = np.log(largest) * self.rate
            what = f"the loop is unstable: its fastest pole grows by e in {1e3 / rate:.3g} ms"
            hint = "`labpipe bearing` shows the poles of its bearing file"
            raise ConfigError(f"{what}, so there is no recording of it", hint=hint)
        return np.stack([self.respond(driven) for driven in inputs.swapaxes(0, 1)], axis=1)


def linear_states(step: FloatArray, driven: FloatArray) -> FloatArray:
    """s[k] of s[k+1] = A s[k] + *driven*[k] (n_sample, n_state) [units of the states] from rest, with A =
    *step* (n_state, n_state). All pieces at once from rest, then what each inherits from the one before: as
    many products as a piece has steps and there are pieces.
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
    return states[:, :PIECE].reshape(-1, n)[:n_sample]


def straight(omega: FloatArray, rate: float) -> FloatArray:
    """Amplitude of a sampled wave with linear interpolation, sinc^2(w T / 2), (n_line,) [-]."""
    return np.sinc(omega / (2 * np.pi * rate)) ** 2


@dataclass(frozen=True)
class SampledPlant:
    """Motion, current and probe over one sampling interval, exact for a held voltage and a straight force.

    step (n, n), hold and ramp (n, 2) [SI units of the states m, m/s, A, m, per V and per N]; hold: of the
    voltage from before and of the newest one (they change over within the interval); ramp: of the force at
    both ends.
    """

    step: FloatArray
    hold: FloatArray
    ramp: FloatArray

    @property
    def probe(self) -> int:
        """Place of what the probe reads among the states."""
        return 3 if len(self.step) == 4 else 0


def sampled_loop(plant: Suspended, rate: float = CONTROL_RATE) -> SampledLoop:
    """The closed loop of one direction, under a controller matrix of both; the eigenvalues of its A are z.
    ConfigError for a delay shorter than the hold, more zeros than poles, and blocks at another rate.
    """
    axes = "x" if plant.loop.cross is None else "xy"
    motion, whole = sampled_plant(plant, rate)
    laws = [
        (o, i, sampled_law(plant.loop, rate, plant.loop.blocks(axes[o], axes[i]), zero=o != i))
        for o, i in np.ndindex(len(axes), len(axes))
    ]
    ends = np.cumsum([len(axes) * len(motion.step), *(len(law.a) for _, _, law in laws)])

    def step(state: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        # By direction: motion, the controller's memory, voltages on their way, oldest first.
        moving, *memories, waiting = np.split(state, ends)
        at, (*forces, noise, injection) = moving.reshape(len(axes), -1), inputs.reshape(-1, len(axes))
        reading, output = at[:, motion.probe] + noise, np.zeros(len(axes))
        before = plant.loop.sensor * reading
        after = before + injection
        for number, (o, i, law) in enumerate(laws):
            output[o] += law.c @ memories[number] + law.d * after[i]
            memories[number] = law.a @ memories[number] + law.b * after[i]
        # The voltage that arrives within this interval takes over from the one before it.
        line = np.column_stack([waiting.reshape(len(axes), -1), output])
        moved = at @ motion.step.T + line[:, :2] @ motion.hold.T + np.transpose(forces) @ motion.ramp.T
        outputs = np.concatenate([reading, before, after, output, at[:, 2]])
        return np.concatenate([moved.ravel(), *memories, line[:, 1:].ravel()]), outputs

    n_state = int(ends[-1]) + len(axes) * (whole + 1)
    return SampledLoop(*step_matrices(step, n_state, len(INPUTS) * len(axes)), rate)


@dataclass(frozen=True)
class SampledLaw:
    """m[k+1] = A m[k] + b e[k], u[k] = c m[k] + d e[k]: A (n, n), b and c (n,), d [1] of a controller."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: float

    @classmethod
    def constant(cls, gain: float) -> SampledLaw:
        return cls(np.empty((0, 0)), np.empty(0), np.empty(0), gain)


def sampled_law(
    loop: ControlLoop, rate: float, blocks: Sequence[ControllerBlock], zero: bool = False
) -> SampledLaw:
    """The PID or *blocks* at *rate* [Hz]: those of s by the bilinear transform, those of z as they are;
    *zero*: no PID without blocks.

    ConfigError for a PID without time constants, blocks at another rate, and more zeros than poles.
    """
    if not blocks:
        return SampledLaw.constant(0.0) if zero else _sampled_pid(loop, rate)
    continuous, discrete = connect_series(blocks)
    if discrete.rate is not None and abs(discrete.rate - rate) > ROUNDING * rate:
        what = f"controller: its blocks are at {discrete.rate:g} Hz, the loop at {rate:g} Hz"
        raise SettingError("controller", what)
    if len(continuous.zeros) > len(continuous.poles) or len(discrete.zeros) > len(discrete.poles):
        hint = "add a low-pass, or a derivative_time"
        raise SettingError("controller", "controller: more zeros than poles cannot be sampled", hint)
    zeros, poles, gain = scipy.signal.bilinear_zpk(continuous.zeros, continuous.poles, continuous.gain, rate)
    zeros, poles = np.append(zeros, discrete.zeros), np.append(poles, discrete.poles)
    sections = scipy.signal.zpk2sos(zeros, poles, float(np.real(gain)) * discrete.gain)
    # Where zeros are fewer than poles, scipy puts others at z = 0, which takes as many sampling intervals of
    # delay away: [z^-1] each.
    late = [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]] * (len(poles) - len(zeros))
    law = SampledLaw.constant(1.0)
    for b0, b1, b2, _, a1, a2 in np.vstack([sections, *late]):
        inward, n = np.array([b1 - a1 * b0, b2 - a2 * b0]), len(law.a)
        a = np.zeros((n + 2, n + 2))
        a[:n, :n], a[n:, n:], a[n:, :n] = law.a, [[-a1, 1.0], [-a2, 0.0]], np.outer(inward, law.c)
        b, c = np.append(law.b, inward * law.d), np.append(b0 * law.c, [1.0, 0.0])
        law = SampledLaw(a, b, c, float(b0) * law.d)
    return law


def _sampled_pid(loop: ControlLoop, rate: float) -> SampledLaw:
    if loop.derivative_time <= 0 or loop.lag_time <= 0:
        raise ConfigError("a sampled controller needs derivative_time and lag_time above zero")
    differentiator = tustin(loop.derivative, 0.0, loop.derivative_time, 1 / rate)
    b0, b1, a1 = np.array([differentiator, tustin(0.0, loop.lag, loop.lag_time, 1 / rate)]).T
    return SampledLaw(np.diag(-a1), b1 - a1 * b0, np.ones(2), loop.proportional + float(np.sum(b0)))


@lru_cache(maxsize=16)
def sampled_plant(plant: Suspended, rate: float) -> tuple[SampledPlant, int]:
    """Motion, and the delay's whole sampling intervals; ConfigError for one shorter than the hold."""
    loop = plant.loop
    intervals = loop.delay * rate - 0.5
    if intervals < -1e-9:
        what = f"delay: {1e6 * loop.delay:g} us is shorter than half a sampling interval of the controller"
        hint = f"at least {5e5 / rate:g} us at {rate / 1e3:g} kHz"
        raise SettingError("delay", f"{what}, which it holds", hint)
    whole = int(np.floor(intervals + 1e-9))
    motion = _plant(plant, max(intervals - whole, 0.0), 1 / rate)
    # A search for margins asks for the same plant at one frequency after the other.
    for matrix in (motion.step, motion.hold, motion.ramp):
        matrix.flags.writeable = False
    return motion, whole


def tustin(derivative: float, constant: float, time: float, interval: float) -> tuple[float, float, float]:
    """(b0, b1, a1) [unit of *constant*] of (constant + derivative s) / (1 + s time) by the bilinear
    transform; *time*, *interval* [s]. Equation (mag-tustin).
    """
    fast = 2 / interval
    whole, slope = 1 + fast * time, fast * derivative
    return (constant + slope) / whole, (constant - slope) / whole, (1 - fast * time) / whole


def _plant(plant: Suspended, late: float, interval: float) -> SampledPlant:
    loop, n = plant.loop, 3 if plant.loop.sensor_bandwidth is None else 4
    slope, voltage, force = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    slope[0, 1] = 1.0
    pull, push = plant.bearings * plant.negative_stiffness, plant.bearings * loop.force_per_current
    slope[1, :3] = np.array([pull - plant.stiffness, -plant.damping, -push]) / plant.mass
    slope[2, 2], voltage[2] = -1 / loop.corners[0], loop.amplifier / loop.corners[0]
    if n == 4:
        slope[3, 0], slope[3, 3] = 1 / loop.corners[1], -1 / loop.corners[1]
    force[1] = 1 / plant.mass
    step, _, _ = integrals(slope, voltage[:, None], interval)
    rest, newest, _ = integrals(slope, voltage[:, None], (1 - late) * interval)
    _, oldest, _ = integrals(slope, voltage[:, None], late * interval)
    _, constant, rising = integrals(slope, force[:, None], interval)
    ramp = np.hstack([constant - rising / interval, rising / interval])
    return SampledPlant(step, np.hstack([rest @ oldest, newest]), ramp)


def integrals(
    slope: FloatArray, inputs: FloatArray, time: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """e^{A t} (n, n), and the responses (n, m) to a constant 1 and to a ramp t of every input after *time*
    [s] (Van Loan, 1978). *slope* A (n, n) [1/s], *inputs* B (n, m) [unit of the state per second].
    """
    n, m = inputs.shape
    joint = np.zeros((n + 2 * m, n + 2 * m))
    joint[:n, :n], joint[:n, n : n + m], joint[n : n + m, n + m :] = slope, inputs, np.eye(m)
    whole = scipy.linalg.expm(joint * time)
    return whole[:n, :n], whole[:n, n : n + m], whole[:n, n + m :]


def step_matrices(
    step: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]], n_state: int, n_input: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A (n_state, n_state), B, C, D of a linear *step* (state, inputs) -> (next, outputs) [any unit]."""
    still = np.zeros(n_input)
    by_state = [step(unit, still) for unit in np.eye(n_state)]
    by_input = [step(np.zeros(n_state), unit) for unit in np.eye(n_input)]
    a, c = (np.column_stack([column[part] for column in by_state]) for part in (0, 1))
    b, d = (np.column_stack([column[part] for column in by_input]) for part in (0, 1))
    return a, b, c, d
