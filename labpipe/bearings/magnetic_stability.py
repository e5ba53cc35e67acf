"""Stability of a mass on a magnetic bearing: closed-loop poles, the argument principle, and the sensitivity with its zone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.controller_blocks import ControllerBlock, in_series
from labpipe.bearings.magnetic_loop import ControlLoop, controller, controller_matrix, loop_stiffness, stiffness_matrix
from labpipe.bearings.sampled_loop import Suspended, sampled_loop, sampled_matrix

PADE_ORDER = 4
# Sizes of z: of what is no state but an empty place in a delay line, and beyond 1 of a pole that grows.
EMPTY, MARGINAL = 1e-6, 1e-9
# Upper ends of the zones A, B, C of ISO 14839-3, peak of |S|; D lies above. 3 is 9.5 dB.
ZONES = (("A", 3.0), ("B", 4.0), ("C", 5.0))
# Frequencies searched [Hz]: from far below any lag to the upper limit of the standard, three times the speed or 2 kHz.
SEARCH = (1e-3, 2000.0, 20_001)
TURNING = (1e-5, 1e7, 400_001)


@dataclass(frozen=True)
class Levitated:
    """A *mass* [kg] on one loop with the bias field's *negative_stiffness* [N/m]."""

    loop: ControlLoop
    negative_stiffness: float
    mass: float


@dataclass(frozen=True)
class SensitivityPeak:
    """The largest |S| (1), its frequency [Hz], and the zone of ISO 14839-3; at 0 Hz where the static value is the largest."""

    value: float
    frequency: float
    zone: str


def pade(delay: float, order: int = PADE_ORDER) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of the Pade approximation [n/n] of e^{-s tau}: Q(s) = sum_k (2n-k)! n! / ((2n)! k! (n-k)!) (s tau)^k.

    Equation (mag-pade).
    """
    terms = [
        factorial(2 * order - k) * factorial(order) / (factorial(2 * order) * factorial(k) * factorial(order - k)) * delay**k
        for k in range(order + 1)
    ]
    return Polynomial([(-1) ** k * term for k, term in enumerate(terms)]), Polynomial(terms)


def characteristic_polynomial(plant: Levitated, time: float, order: int = PADE_ORDER) -> Polynomial:
    """det((m s^2 - k_n) I + K G) times all denominators, the delay by Pade, in s * *time* so that the coefficients are of equal magnitude.

    Of one direction unless the controller is a matrix. Equation (mag-characteristic).
    """
    loop = plant.loop
    ahead, behind = pade(loop.delay / time, order if loop.delay > 0 else 0)
    for corner in loop.corners:
        behind = behind * Polynomial([1.0, corner / time])
    ahead = loop_stiffness(loop) * ahead
    rotor = Polynomial([-plant.negative_stiffness, 0.0, plant.mass / time**2])
    above, below = _controller_polynomials(loop, time)
    x = rotor * below * behind + above * ahead
    if loop.cross is None:
        return x
    above, below = _polynomials(loop.blocks("y", "y"), time)
    y = rotor * below * behind + above * ahead
    (xy, below_xy), (yx, below_yx) = (_polynomials(loop.blocks(*pair), time) for pair in ("xy", "yx"))
    x_below = _controller_polynomials(loop, time)[1]
    return x * y * below_xy * below_yx - xy * yx * ahead**2 * x_below * below


def _controller_polynomials(loop: ControlLoop, time: float) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of the controller x by x in s * *time*."""
    if loop.controller:
        return _polynomials(loop.controller, time)
    differentiator, lag = Polynomial([1.0, loop.derivative_time / time]), Polynomial([1.0, loop.lag_time / time])
    pid = loop.proportional * differentiator * lag + Polynomial([0.0, loop.derivative / time]) * lag + loop.lag * differentiator
    return pid, differentiator * lag


def _polynomials(blocks: Sequence[ControllerBlock], time: float) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of blocks of s in series in s * *time*; no blocks are zero."""
    if not blocks:
        return Polynomial([0.0]), Polynomial([1.0])
    continuous, _ = in_series(blocks)
    above, below = (Polynomial(_from_roots(np.array(roots) * time)) for roots in (continuous.zeros, continuous.poles))
    return continuous.gain * time ** (len(continuous.poles) - len(continuous.zeros)) * above, below


def _from_roots(roots: NDArray[Any]) -> FloatArray:
    """Coefficients (n + 1,) [1] of prod(s - root), roots in conjugate pairs."""
    return np.asarray(Polynomial.fromroots(roots).coef.real if roots.size else np.ones(1))


def sampled(plant: Levitated, rate: float) -> FloatArray:
    """Matrix (n_state, n_state) [1] from sample to sample at *rate* [Hz], of one direction unless the controller is a matrix."""
    suspended = Suspended(plant.loop, plant.negative_stiffness, plant.mass)
    return sampled_loop(suspended, rate).a if plant.loop.cross is None else sampled_matrix(suspended, rate)


def closed_loop_poles(plant: Levitated, order: int = PADE_ORDER) -> ComplexArray:
    """Poles s of mass and loop, least damped first, (n_pole,) [rad/s]; the delay as Pade approximation of *order*.

    With discrete blocks s = f_s ln z of the sampled loop, without approximation.
    """
    rate = plant.loop.rate
    if rate is not None:
        return ordered_poles(sampled_poles(sampled(plant, rate), rate))
    time = 1e-3
    return ordered_poles(np.asarray(characteristic_polynomial(plant, time, order).roots(), np.complex128) / time)


def sampled_poles(matrix: FloatArray, rate: float) -> ComplexArray:
    """s = f_s ln z [rad/s] of the eigenvalues z of *matrix* (n_state, n_state) [1]; those at z = 0, empty memory, are left out.

    Equation (mag-sampled).
    """
    z = np.asarray(np.linalg.eigvals(matrix), np.complex128)
    return np.asarray(rate * np.log(z[np.abs(z) > EMPTY]), np.complex128)


def ordered_poles(poles: ComplexArray) -> ComplexArray:
    """Least damped first, (n_pole,) [rad/s]."""
    ordered: ComplexArray = poles[np.lexsort((np.abs(poles.imag), -poles.real))]
    return ordered


def unstable_poles(plant: Levitated) -> int:
    """Number of poles in the right half-plane with the exact delay, Z = n / 2 - (phase change of D(jw) over w = 0 ... inf) / pi.

    Argument principle for D(s) = det((m s^2 - k_n) I + K G(s)) times the denominator of degree d of the controller, n = 2 + d per
    direction (the lags of amplifier and probe are stable and cancel). Of discrete blocks the eigenvalues z beyond the unit circle.
    Equation (mag-unstable).
    """
    loop = plant.loop
    if loop.rate is not None:
        return int(np.sum(np.abs(np.linalg.eigvals(sampled(plant, loop.rate))) > 1 + MARGINAL))
    omega = 2 * np.pi * np.geomspace(*TURNING)
    dynamic = stiffness_matrix(loop, plant.negative_stiffness, omega) - plant.mass * omega[:, None, None] ** 2 * np.eye(2)
    curve: ComplexArray = dynamic[:, 0, 0] if loop.cross is None else np.asarray(np.linalg.det(dynamic))
    poles = np.array([pole for blocks in _elements(loop) for pole in in_series(blocks)[0].poles], np.complex128)
    # Stable poles turn by what they add to n, so that only the others count; those at s = 0 as the slow ones of a damped loop.
    turned = curve
    for pole in poles:
        turned = turned * (1j * omega - pole)
    # From 0 Hz, where D is real, to the frequencies where the mass dominates.
    angle = np.unwrap(np.angle(turned))
    first = np.angle(turned[0]) - (0.0 if turned[0].real > 0 else np.pi)
    change = float(angle[-1] - angle[0] + np.angle(np.exp(1j * first)))
    degree = 2 * (1 if loop.cross is None else 2) + poles.size
    return round((degree - 2 * change / np.pi) / 2)


def _elements(loop: ControlLoop) -> list[tuple[ControllerBlock, ...]]:
    """The blocks of every element of the controller that is not zero."""
    pairs = ["xx"] if loop.cross is None else ["xx", "xy", "yx", "yy"]
    return [blocks for blocks in (loop.blocks(*pair) for pair in pairs) if blocks]


def sensitivity(plant: Levitated, omega: FloatArray) -> ComplexArray:
    """S(jw) = 1 / (1 + L) with the loop L = K G / (-m w^2 - k_n), (n_line,) [1]; ISO 14839-3. Of a controller matrix that of x."""
    if plant.loop.cross is not None:
        return sensitivity_matrix(plant, omega)[:, 0, 0]
    rotor: ComplexArray = -plant.mass * omega.astype(np.complex128) ** 2 - plant.negative_stiffness
    controlled = loop_stiffness(plant.loop) * controller(plant.loop, omega)
    # An integrator at rest: S = 0.
    # At a pole on the axis it is infinite, and says so.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: ComplexArray = rotor / (rotor + controlled)
    return np.where(np.isfinite(controlled), ratio, 0.0)


def sensitivity_matrix(plant: Levitated, omega: FloatArray) -> ComplexArray:
    """S(jw) = (I + L)^-1 of both directions, L = K G / (-m w^2 - k_n), (n_line, 2, 2) [1]; ISO 14839-3 takes the largest |S_ii|.

    Equation (mag-sensitivity).
    """
    rotor: ComplexArray = -plant.mass * omega.astype(np.complex128) ** 2 - plant.negative_stiffness
    ratio: ComplexArray = rotor[:, None, None] * np.linalg.inv(
        rotor[:, None, None] * np.eye(2) + loop_stiffness(plant.loop) * controller_matrix(plant.loop, omega)
    )
    return ratio


def zone_of(peak: float) -> str:
    """Zone of ISO 14839-3 of a sensitivity's peak: A below 3 (9.5 dB), B below 4, C below 5, D above. Equation (mag-zone)."""
    return next((zone for zone, end in ZONES if peak < end), "D")


def sensitivity_peak(plant: Levitated) -> SensitivityPeak:
    """The largest |S| from 0 Hz to 2 kHz and its zone; meaningful for a stable loop only."""
    frequency = np.concatenate([[0.0], np.geomspace(*SEARCH)])
    if plant.loop.cross is None:
        size = np.abs(sensitivity(plant, 2 * np.pi * frequency))
    else:
        frequency = frequency[1:]
        size = np.max(np.abs(np.einsum("fii->fi", sensitivity_matrix(plant, 2 * np.pi * frequency))), axis=1)
    place = int(np.argmax(size))
    return SensitivityPeak(float(size[place]), float(frequency[place]), zone_of(float(size[place])))
