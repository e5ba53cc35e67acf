"""Stability of a mass on a magnetic bearing: closed-loop poles, argument principle, the loop cut open."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial

import numpy as np
from numpy.polynomial import Polynomial

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.methods.magnetic_bearing.loop import (
    ControlLoop,
    chain_factors,
    controller,
    controller_matrix,
    controller_terms,
    dynamic_stiffness,
    loop_stiffness,
    stiffness_matrix,
)
from labpipe.methods.magnetic_bearing.sampled_loop import (
    SampledLaw,
    Suspended,
    sampled_law,
    sampled_loop,
    sampled_plant,
)
from labpipe.methods.magnetic_bearing.transfer import ControllerBlock, connect_series

PADE_ORDER = 4
# Sizes of z: of what is not a state but an empty place in a delay line, and beyond 1 of a pole that grows.
EMPTY, MARGINAL = 1e-6, 1e-9
# Upper ends of the zones A, B, C of ISO 14839-3, peak of |S|; D lies above. 3 is 9.5 dB.
ZONES = (("A", 3.0), ("B", 4.0), ("C", 5.0))
# Frequencies searched [Hz]: from far below any lag to the standard's limit, three times the speed or 2 kHz.
SEARCH = (1e-3, 2000.0, 20_001)
TURNING = (1e-5, 1e7, 400_001)


@dataclass(frozen=True)
class SensitivityPeak:
    """The largest |S| (1), its frequency [Hz], and the zone of ISO 14839-3."""

    value: float
    frequency: float
    zone: str


def pade(delay: float, order: int) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of the Pade approximation [n/n] of e^{-s tau}: Q(s) = sum_k (2n-k)! n! /
    ((2n)! k! (n-k)!) (s tau)^k. Equation (mag-pade).
    """
    terms = [delay**k * comb(order, k) / (comb(2 * order, k) * factorial(k)) for k in range(order + 1)]
    return Polynomial([(-1) ** k * term for k, term in enumerate(terms)]), Polynomial(terms)


def characteristic_polynomial(plant: Suspended, time: float) -> Polynomial:
    """det((m s^2 - k_n) I + K G) times all denominators, the delay by Pade, in s * *time* so that the
    coefficients are of equal magnitude.

    Of one direction unless the controller is a matrix. Equation (mag-characteristic).
    """
    loop = plant.loop
    ahead, behind = pade(loop.delay / time, PADE_ORDER if loop.delay > 0 else 0)
    for corner in loop.corners:
        behind = behind * Polynomial([1.0, corner / time])
    ahead = loop_stiffness(loop) * ahead
    rotor = Polynomial([-plant.negative_stiffness, 0.0, plant.mass / time**2])
    above, below_x = _controller_polynomials(loop, time)
    x = rotor * below_x * behind + above * ahead
    if loop.cross is None:
        return x
    (above, below_y), (xy, below_xy), (yx, below_yx) = (
        _polynomials(loop.blocks(*pair), time) for pair in ("yy", "xy", "yx")
    )
    y = rotor * below_y * behind + above * ahead
    return x * y * below_xy * below_yx - xy * yx * ahead**2 * below_x * below_y


def _controller_polynomials(loop: ControlLoop, time: float) -> tuple[Polynomial, Polynomial]:
    if loop.controller:
        return _polynomials(loop.controller, time)
    differentiator, lag = (Polynomial([1.0, t / time]) for t in (loop.derivative_time, loop.lag_time))
    pid = (
        loop.proportional * differentiator * lag
        + Polynomial([0.0, loop.derivative / time]) * lag
        + loop.lag * differentiator
    )
    return pid, differentiator * lag


def _polynomials(blocks: tuple[ControllerBlock, ...], time: float) -> tuple[Polynomial, Polynomial]:
    if not blocks:
        return Polynomial([0.0]), Polynomial([1.0])
    continuous, _ = connect_series(blocks)
    above, below = (
        Polynomial(np.atleast_1d(np.poly(np.array(roots) * time)).real[::-1])
        for roots in (continuous.zeros, continuous.poles)
    )
    return continuous.gain * time ** (len(continuous.poles) - len(continuous.zeros)) * above, below


def closed_loop_poles(plant: Suspended) -> ComplexArray:
    """Poles s of mass and loop, least damped first, (n_pole,) [rad/s]; the delay as Pade approximation. With
    discrete blocks s = f_s ln z of the sampled loop, without approximation.
    """
    rate = plant.loop.rate
    if rate is not None:
        return ordered_poles(sampled_poles(sampled_loop(plant, rate).a, rate))
    time = 1e-3
    return ordered_poles(np.asarray(characteristic_polynomial(plant, time).roots(), np.complex128) / time)


def sampled_poles(matrix: FloatArray, rate: float) -> ComplexArray:
    """s = f_s ln z [rad/s], z of *matrix* (n_state, n_state) [1] but empty z = 0. Equation (mag-sampled)."""
    z = np.asarray(np.linalg.eigvals(matrix), np.complex128)
    return np.asarray(rate * np.log(z[np.abs(z) > EMPTY]), np.complex128)


def ordered_poles(poles: ComplexArray) -> ComplexArray:
    """Least damped first, (n_pole,) [rad/s]."""
    return poles[np.lexsort((np.abs(poles.imag), -poles.real))]


def unstable_poles(plant: Suspended) -> int:
    """Number of poles in the right half-plane with the exact delay, Z = n / 2 - (phase change of D(jw) over w
    = 0 ... inf) / pi. Argument principle for D(s) = det((m s^2 - k_n) I + K G(s)) times the denominator of
    degree d of the controller, n = 2 + d per direction (the lags of amplifier and probe are stable and
    cancel). Of discrete blocks the eigenvalues z beyond the unit circle. Equation (mag-unstable).
    """
    loop = plant.loop
    if loop.rate is not None:
        return int(np.sum(np.abs(np.linalg.eigvals(sampled_loop(plant, loop.rate).a)) > 1 + MARGINAL))
    omega = 2 * np.pi * np.geomspace(*TURNING)
    inertia = plant.mass * omega**2
    if loop.cross is None:
        pairs, turned = ["xx"], dynamic_stiffness(loop, plant.negative_stiffness, omega) - inertia
    else:
        pairs, dynamic = ["xx", "xy", "yx", "yy"], stiffness_matrix(loop, plant.negative_stiffness, omega)
        turned = np.linalg.det(dynamic - inertia[:, None, None] * np.eye(2))
    poles = [pole for pair in pairs for pole in connect_series(loop.blocks(*pair))[0].poles]
    # Stable poles turn by what they add to n, so that only others count, at s = 0 as slow damped ones.
    for pole in poles:
        turned = turned * (1j * omega - pole)
    # From 0 Hz, where D is real, to the frequencies where the mass dominates.
    angle = np.unwrap(np.angle(turned))
    first = np.angle(turned[0]) - (0.0 if turned[0].real > 0 else np.pi)
    change = float(angle[-1] - angle[0] + np.angle(np.exp(1j * first)))
    degree = (2 if loop.cross is None else 4) + len(poles)
    return round((degree - 2 * change / np.pi) / 2)


def sensitivity(plant: Suspended, omega: FloatArray) -> ComplexArray:
    """S(jw) = 1 / (1 + L), L = K G / (-m w^2 - k_n), (n_line,) [1], ISO 14839-3; of a matrix that of x."""
    if plant.loop.cross is not None:
        return sensitivity_matrix(plant, omega)[:, 0, 0]
    rotor = -plant.mass * omega.astype(np.complex128) ** 2 - plant.negative_stiffness
    controlled = loop_stiffness(plant.loop) * controller(plant.loop, omega)
    # An integrator at rest: S = 0. At a pole on the axis it is infinite, and says so.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = rotor / (rotor + controlled)
    return np.where(np.isfinite(controlled), ratio, 0.0)


def sensitivity_matrix(plant: Suspended, omega: FloatArray) -> ComplexArray:
    """S(jw) = (I + L)^-1 of both directions, L = K G / (-m w^2 - k_n), (n_line, 2, 2) [1]; ISO 14839-3 takes
    the largest |S_ii|. Equation (mag-sensitivity).
    """
    rotor = -plant.mass * omega.astype(np.complex128) ** 2 - plant.negative_stiffness
    return rotor[:, None, None] * np.linalg.inv(
        rotor[:, None, None] * np.eye(2) + loop_stiffness(plant.loop) * controller_matrix(plant.loop, omega)
    )


def zone_of(peak: float) -> str:
    """Zone of ISO 14839-3 of a peak of |S|: A below 3 (9.5 dB), B 4, C 5, D above. Equation (mag-zone)."""
    return next((zone for zone, end in ZONES if peak < end), "D")


def sensitivity_peak(plant: Suspended) -> SensitivityPeak:
    """The largest |S_ii| from 0 Hz to 2 kHz (ISO 14839-3) and its zone, of a stable loop only."""
    frequency = np.geomspace(*SEARCH)
    if plant.loop.cross is None:
        frequency = np.concatenate([[0.0], frequency])
        size = np.abs(sensitivity(plant, 2 * np.pi * frequency))
    else:
        size = np.max(np.abs(np.einsum("fii->fi", sensitivity_matrix(plant, 2 * np.pi * frequency))), axis=1)
    place = int(np.argmax(size))
    return SensitivityPeak(float(size[place]), float(frequency[place]), zone_of(float(size[place])))


# Signals of a loop that an injection e moves; the units are per volt at either place.
SIGNALS = ("before", "after", "output", "displacement", "current")
INPUT, OUTPUT = "input", "output"
# Distance of z from a pole of the controller below which it is there.
AT_A_POLE = 1e-12


@dataclass(frozen=True)
class OpenLoop:
    """Controller C [1] with the probe's sensitivity k [V/m], motion X [m/V] and current I [A/V] per command,
    (n_line,) each. L = -k X C is the loop, S = 1 / (1 + L); the force on the rotor is -k_i i, so that X has a
    minus sign. recorded_motion: what a logger with a filter sees of X, None where it is X.
    """

    sensor: float
    controller: ComplexArray
    motion: ComplexArray
    current: ComplexArray
    recorded_motion: ComplexArray | None = None

    @property
    def loop(self) -> ComplexArray:
        """L (n_line,) [1]."""
        with np.errstate(invalid="ignore"):
            return -self.sensor * self.motion * self.controller

    @property
    def sensitivity(self) -> ComplexArray:
        """S = 1 / (1 + L) (n_line,) [1]."""
        return 1 / (1 + self.loop)

    def signals(self, place: str) -> dict[str, ComplexArray]:
        """SIGNALS per injection (n_line,) [V/V, m/V, A/V], added ahead of the controller (input) or behind it
        (output). before and after are the two sides of the sum where it is added.
        """
        s = self.sensitivity
        command = self.controller * s if place == INPUT else s
        motion = self.motion if self.recorded_motion is None else self.recorded_motion
        return dict(zip(SIGNALS, (s - 1, s, command, motion * command, self.current * command), strict=True))


def open_loop(
    plant: Suspended, omega: FloatArray, rate: float | None = None, filtered: bool = False
) -> OpenLoop:
    """The loop at *omega* [rad/s] (n_line,), sampled and held at *rate* [Hz]; without one in continuous time,
    the hold as delay. *filtered*: current and motion are recorded through a filter against aliasing, not as
    the controller samples them. ConfigError for what cannot be sampled.
    """
    loop, chain = plant.loop, chain_factors(plant.loop, omega)
    current: ComplexArray = loop.amplifier * chain["delay"] * chain["amplifier"]
    motion = -loop.force_per_current * current / (-plant.mass * omega**2 - plant.negative_stiffness)
    motion = motion * chain.get("sensor", 1.0)
    if rate is None:
        law: ComplexArray = np.sum(list(controller_terms(loop, omega).values()), axis=0)
        return OpenLoop(loop.sensor, law, motion, current)
    law_at = law_response(_own_law(loop, rate), omega, rate)
    sampled_motion, sampled_current = _sampled_motion(plant, omega, rate)
    if not filtered:
        return OpenLoop(loop.sensor, law_at, sampled_motion, sampled_current)
    # The delay holds half an interval for the hold already.
    held = np.sinc(omega / (2 * np.pi * rate))
    return OpenLoop(loop.sensor, law_at, sampled_motion, held * current, held * motion)


@lru_cache(maxsize=16)
def _own_law(loop: ControlLoop, rate: float) -> SampledLaw:
    return sampled_law(loop, rate, loop.blocks())


def law_response(law: SampledLaw, omega: FloatArray, rate: float) -> ComplexArray:
    """C(z) (n_line,) [1] of a sampled controller at omega (n_line,) [rad/s]; infinite at a pole."""
    if not len(law.a):
        return np.full(np.shape(omega), law.d, np.complex128)
    law_bytes = (law.a.tobytes(), law.b.tobytes(), law.c.tobytes())
    return _law_response(*law_bytes, law.d, np.asarray(omega, np.complex128).tobytes(), rate)


@lru_cache(maxsize=16)
def _law_response(a: bytes, b: bytes, c: bytes, d: float, omega: bytes, rate: float) -> ComplexArray:
    """C(z) of the law and the lines in these bytes: a fit asks for it again while it moves the plant."""
    row, column = np.frombuffer(c), np.frombuffer(b)
    matrix = np.frombuffer(a).reshape(row.size, row.size)
    z = np.exp(1j * np.frombuffer(omega, np.complex128) / rate)
    values = np.full(z.shape, np.inf, np.complex128)
    away = np.min(np.abs(z[:, None] - np.linalg.eigvals(matrix)), axis=1) > AT_A_POLE
    shifted = z[away, None, None] * np.eye(row.size) - matrix
    states = np.linalg.solve(shifted, np.broadcast_to(column[:, None], (len(shifted), row.size, 1)))
    values[away] = row @ states[..., 0].T + d
    values.flags.writeable = False
    return values


def _sampled_motion(plant: Suspended, omega: FloatArray, rate: float) -> tuple[ComplexArray, ComplexArray]:
    motion, whole = sampled_plant(plant, rate)
    n, z = motion.step.shape[0], np.exp(1j * np.asarray(omega) / rate)
    late = (motion.hold[:, 0] / z[:, None] + motion.hold[:, 1]) * z[:, None] ** -float(whole)
    states = np.linalg.solve(z[:, None, None] * np.eye(n) - motion.step, late[..., None])[..., 0]
    return states[:, motion.probe], states[:, 2]
