"""Theory of a rotor: Campbell diagram, critical speeds, stability and unbalance response by theory alone.

Critical speeds and amplification factors are those of the unbalance response as API 684 reads them: the peak,
and the two speeds at .707 of it. Margins by the formulas of API 617 and 684, known second-hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import interpolate, optimize

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.methods.rotor.response import (
    Modes,
    forward_backward_motion,
    modes,
    onset_speed,
    unbalance_response,
)
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.shaft import Support

# Difference of ln |lambda| between neighbouring speeds that makes two modes hardly one.
FREQUENCY_STEP = 0.15
MOST_MODES = 8
# Half-power points, and speeds per peak of the response.
HALF_POWER = np.sqrt(0.5)
FINE = 1500
# Amplification below which API 684 sees no critical speed.
LEAST_AMPLIFICATION = 2.5


def margin_below(amplification: float) -> float:
    """Separation [%] that a critical speed below the lowest operating speed must have (API 617, 684).

    17 (1 - 1 / (AF - 1.5)), at most 16; 0 for AF below 2.5.
    """
    return 0.0 if amplification < LEAST_AMPLIFICATION else min(16.0, 17 * (1 - 1 / (amplification - 1.5)))


def margin_above(amplification: float) -> float:
    """The same of one above the highest operating speed: 10 + 17 (1 - 1 / (AF - 1.5)), at most 26."""
    if amplification < LEAST_AMPLIFICATION:
        return 0.0
    return min(26.0, 10 + 17 * (1 - 1 / (amplification - 1.5)))


@dataclass(frozen=True)
class Critical:
    """A peak of the unbalance response: *speed*, its half-power speeds *low*, *high* [Hz], *amplitude* [m] of
    the major semi-axis at *node*; None where the response does not fall to .707 of it within the speeds.
    """

    speed: float
    amplitude: float
    node: int
    low: float | None = None
    high: float | None = None

    @property
    def amplification(self) -> float | None:
        """AF = N_c / (N_2 - N_1)."""
        return None if self.low is None or self.high is None else self.speed / (self.high - self.low)

    def margin(self, operating: float) -> tuple[float, float] | None:
        """The separation from an *operating* speed [Hz] there is, and the one that is asked for, [%]."""
        if self.amplification is None:
            return None
        ask = margin_below if self.speed < operating else margin_above
        return 100 * abs(operating - self.speed) / operating, ask(self.amplification)


@dataclass(frozen=True)
class RotorTheory:
    """A rotor over *speed* (n_speed,) [Hz]: frequency (n_speed, n_mode) [Hz], log_decrement and whirl
    (n_speed, n_mode) [1] of the modes, followed; NaN where a mode does not oscillate.

    onset: [Hz], None within the speeds; criticals of the unbalance response, whose *amplitude*
    (n_fine, n_node) [m] over *fine* (n_fine,) [Hz] is at *nodes*.
    """

    rig: RotorRig
    speed: FloatArray
    frequency: FloatArray
    log_decrement: FloatArray
    whirl: FloatArray
    onset: float | None
    crossings: tuple[tuple[float, float, float], ...]
    criticals: tuple[Critical, ...] = ()
    fine: FloatArray | None = None
    amplitude: FloatArray | None = None
    nodes: tuple[int, ...] = ()

    def least_decrement(self) -> float:
        at = int(np.argmin(np.abs(self.speed - self.rig.speed)))
        return float(np.nanmin(self.log_decrement[at]))


def rotor_theory(rig: RotorRig, speeds: FloatArray) -> RotorTheory:
    """The theory of a rotor file over ascending *speeds* (n_speed,) [Hz]."""
    supports = [rig.at_speed(float(speed)).supports() for speed in speeds]
    each = [
        modes(rig.rotor, support, 2 * np.pi * speed) for support, speed in zip(supports, speeds, strict=True)
    ]
    order = followed(each)
    frequency, decrement, whirl = (np.full(order.shape, np.nan) for _ in range(3))
    for number, found in enumerate(each):
        there = order[number] >= 0
        roots = found.eigenvalues[order[number, there]]
        frequency[number, there] = roots.imag / (2 * np.pi)
        decrement[number, there] = -2 * np.pi * roots.real / roots.imag
        whirl[number, there] = found.whirl[order[number, there]]
    at = _SupportsBetween(speeds, supports)
    try:
        onset = onset_speed(rig.rotor, lambda omega: at(omega / (2 * np.pi)), 2 * np.pi * speeds)
    except FitError:
        onset = 2 * np.pi * float(speeds[0])
    crossings = []
    for of_mode, decrements, whirls in zip(frequency.T, decrement.T, whirl.T, strict=True):
        excess = of_mode - speeds
        for n in np.flatnonzero(np.sign(excess[:-1]) * np.sign(excess[1:]) < 0):
            share = excess[n] / (excess[n] - excess[n + 1])
            at_speed, damped, turning = (
                float((1 - share) * row[n] + share * row[n + 1]) for row in (speeds, decrements, whirls)
            )
            crossings.append((at_speed, damped, turning))
    theory = RotorTheory(
        rig,
        speeds,
        frequency,
        decrement,
        whirl,
        None if onset is None else onset / (2 * np.pi),
        tuple(sorted(crossings)),
    )
    return _with_response(theory, at) if rig.unbalances else theory


class _SupportsBetween:
    def __init__(self, speeds: FloatArray, supports: Sequence[Sequence[Support]]) -> None:
        self._nodes = [support.node for support in supports[0]]
        coefficients = np.array([[(s.stiffness, s.damping) for s in row] for row in supports])
        self._spline = interpolate.make_interp_spline(speeds, coefficients, k=min(3, speeds.size - 1))

    def __call__(self, speed: float) -> list[Support]:
        values = self._spline(speed)
        return [Support(node, k, c) for node, (k, c) in zip(self._nodes, values, strict=True)]


def followed(each: Sequence[Modes]) -> FloatArray:
    """Numbers (n_speed, n_mode) [-] of the modes at every speed so that a column is one mode; -1: it is gone.

    Neighbouring speeds are paired by the assurance criterion of their shapes times
    exp(-(d ln |lambda| / .15)^2 / 2), all pairs together (linear assignment).
    """
    n_mode = min(MOST_MODES, each[0].eigenvalues.size)
    order = np.full((len(each), n_mode), -1)
    order[0] = np.arange(n_mode)
    last = [(each[0].shapes[n].ravel(), each[0].eigenvalues[n]) for n in range(n_mode)]
    for number, now in enumerate(each[1:], 1):
        flat = now.shapes.reshape(now.eigenvalues.size, -1)
        likeness = np.array([_likeness(shape, root, flat, now.eigenvalues) for shape, root in last])
        rows, columns = optimize.linear_sum_assignment(-likeness)
        for row, column in zip(rows, columns, strict=True):
            if likeness[row, column] > 1e-3:
                order[number, row] = column
                last[row] = (flat[column], now.eigenvalues[column])
    return order


def _likeness(shape: ComplexArray, root: complex, others: ComplexArray, roots: ComplexArray) -> FloatArray:
    overlap = np.abs(others.conj() @ shape) ** 2
    alike = overlap / (np.sum(np.abs(others) ** 2, axis=1) * np.sum(np.abs(shape) ** 2))
    near = np.log(np.abs(roots) / np.abs(root)) / FREQUENCY_STEP
    return np.asarray(alike * np.exp(-(near**2) / 2))


def _with_response(theory: RotorTheory, at: _SupportsBetween) -> RotorTheory:
    rig = theory.rig
    amounts = rig.amounts
    nodes = sorted({rig.response, *amounts, *(place.node for place in rig.bearings)})
    outputs = [dof for node in nodes for dof in rig.rotor.dofs(node)]
    fine = np.linspace(theory.speed[0], theory.speed[-1], FINE)
    rows = [
        unbalance_response(rig.rotor, at(float(speed)), np.array([2 * np.pi * speed]), amounts, outputs)
        for speed in fine
    ]
    motion = np.array(rows).reshape(fine.size, len(nodes), 2)
    # The major semi-axis of an orbit is the sum of its two circles.
    amplitude = np.sum(np.abs(forward_backward_motion(motion)), axis=2)
    criticals = [critical for n, node in enumerate(nodes) for critical in peaks(fine, amplitude[:, n], node)]
    return replace(theory, criticals=_distinct(criticals), fine=fine, amplitude=amplitude, nodes=tuple(nodes))


def peaks(speed: FloatArray, amplitude: FloatArray, node: int = 0) -> list[Critical]:
    """Peaks of a response *amplitude* (n,) [m] over *speed* (n,) [Hz] with their half-power speeds."""
    curve = interpolate.CubicSpline(speed, amplitude**-2.0)
    criticals = []
    for n in np.flatnonzero((amplitude[1:-1] > amplitude[:-2]) & (amplitude[1:-1] >= amplitude[2:])) + 1:
        least = optimize.minimize_scalar(
            curve, bounds=(speed[n - 1], speed[n + 1]), method="bounded", options={"xatol": 1e-9 * speed[n]}
        )
        top, height = float(least.x), float(least.fun) ** -0.5
        below = np.flatnonzero(amplitude[:n] < HALF_POWER * height)
        above = np.flatnonzero(amplitude[n:] < HALF_POWER * height)
        low = high = None
        crossing = interpolate.CubicSpline(speed, amplitude**-2.0 - 2 * float(least.fun))
        if below.size:
            low = float(optimize.brentq(crossing, speed[below[-1]], speed[below[-1] + 1]))
        if above.size:
            high = float(optimize.brentq(crossing, speed[n + above[0] - 1], speed[n + above[0]]))
        criticals.append(Critical(top, height, node, low, high))
    return criticals


def _distinct(criticals: Sequence[Critical]) -> tuple[Critical, ...]:
    """Peaks within 3 % of each other are one critical speed, told where it is sharpest."""
    kept: list[Critical] = []
    for critical in sorted(criticals, key=lambda c: -(c.amplification or 0.0)):
        if all(abs(critical.speed / other.speed - 1) > 0.03 for other in kept):
            kept.append(critical)
    return tuple(sorted(kept, key=lambda critical: critical.speed))
