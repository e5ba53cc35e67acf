"""Stability of a mass on a magnetic bearing: closed-loop poles, the argument principle, and the sensitivity with its zone."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.polynomial import Polynomial

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_loop import ControlLoop, controller, dynamic_stiffness, loop_stiffness

PADE_ORDER = 4
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
    """Numerator and denominator of the Pade approximation [n/n] of e^{-s tau}: Q(s) = sum_k (2n-k)! n! / ((2n)! k! (n-k)!) (s tau)^k."""
    terms = [
        factorial(2 * order - k) * factorial(order) / (factorial(2 * order) * factorial(k) * factorial(order - k)) * delay**k
        for k in range(order + 1)
    ]
    return Polynomial([(-1) ** k * term for k, term in enumerate(terms)]), Polynomial(terms)


def characteristic_polynomial(plant: Levitated, time: float, order: int = PADE_ORDER) -> Polynomial:
    """(m s^2 - k_n) den(s) + K num(s) with the delay by Pade, in s * *time* so that the coefficients are of equal magnitude."""
    loop = plant.loop
    differentiator, lag = Polynomial([1.0, loop.derivative_time / time]), Polynomial([1.0, loop.lag_time / time])
    ahead, behind = pade(loop.delay / time, order if loop.delay > 0 else 0)
    pid = loop.proportional * differentiator * lag + Polynomial([0.0, loop.derivative / time]) * lag + loop.lag * differentiator
    denominator = differentiator * lag * behind
    for corner in loop.corners:
        denominator = denominator * Polynomial([1.0, corner / time])
    rotor = Polynomial([-plant.negative_stiffness, 0.0, plant.mass / time**2])
    return rotor * denominator + loop_stiffness(loop) * pid * ahead


def closed_loop_poles(plant: Levitated, order: int = PADE_ORDER) -> ComplexArray:
    """Poles s of mass and loop, least damped first, (n_pole,) [rad/s]; the delay as Pade approximation of *order*."""
    time = 1e-3
    poles = np.asarray(characteristic_polynomial(plant, time, order).roots(), np.complex128) / time
    ordered: ComplexArray = poles[np.lexsort((np.abs(poles.imag), -poles.real))]
    return ordered


def unstable_poles(plant: Levitated) -> int:
    """Number of poles in the right half-plane with the exact delay, Z = 1 - (phase change of D(jw) over w = 0 ... inf) / pi.

    Argument principle for D(s) = K G(s) - k_n + m s^2, whose elements are stable.
    """
    omega = 2 * np.pi * np.geomspace(*TURNING)
    dynamic = dynamic_stiffness(plant.loop, plant.negative_stiffness, omega) - plant.mass * omega**2
    angle = np.unwrap(np.angle(dynamic))
    # From 0 Hz, where D is real, to the frequencies where the mass dominates and D is real and negative.
    start, end = (0.0 if dynamic[0].real > 0 else np.pi), angle[-1]
    first = start + np.angle(dynamic[0] * np.exp(-1j * start))
    return round(1 - float(end - angle[0] + first - start) / np.pi)


def sensitivity(plant: Levitated, omega: FloatArray) -> ComplexArray:
    """S(jw) = 1 / (1 + L) with the loop L = K G / (-m w^2 - k_n), (n_line,) [1]; ISO 14839-3."""
    rotor: ComplexArray = -plant.mass * omega.astype(np.complex128) ** 2 - plant.negative_stiffness
    ratio: ComplexArray = rotor / (rotor + loop_stiffness(plant.loop) * controller(plant.loop, omega))
    return ratio


def zone_of(peak: float) -> str:
    """Zone of ISO 14839-3 of a sensitivity's peak: A below 3 (9.5 dB), B below 4, C below 5, D above."""
    return next((zone for zone, end in ZONES if peak < end), "D")


def sensitivity_peak(plant: Levitated) -> SensitivityPeak:
    """The largest |S| from 0 Hz to 2 kHz and its zone; meaningful for a stable loop only."""
    frequency = np.concatenate([[0.0], np.geomspace(*SEARCH)])
    size = np.abs(sensitivity(plant, 2 * np.pi * frequency))
    place = int(np.argmax(size))
    return SensitivityPeak(float(size[place]), float(frequency[place]), zone_of(float(size[place])))
