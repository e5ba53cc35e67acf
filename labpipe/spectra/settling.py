"""How long after each step the transient lasts: until what is left of it is far below the noise of the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError

# Bins of the time after a step, from zero to the end of the longest dwell.
N_BIN = 40
# Standard errors by which the scatter in a bin exceeds that of noise while a transient is seen.
SEEN = 4.0
# Share of a standard error that the transient may leave in a result.
LEFT = 0.2
# Noise of a block [of its amplitude] below which no sensor is believed to be: a transient smaller than that has settled.
LEAST_NOISE = 1e-4


@dataclass(frozen=True)
class Course:
    """Amplitudes of a dwell, block by block: *times* (n_block,) [s] after the step, *values* (n_block, n_channel) [unit of the channel]."""

    times: FloatArray
    values: ComplexArray

    def of(self, channel: int) -> Course:
        return Course(self.times, self.values[:, [channel]])

    def deviation(self) -> FloatArray:
        """|X - its mean over the last half|^2 over the noise from differences there, less what noise gives, (n_block, n_channel) [1]."""
        half = self.values[self.values.shape[0] // 2 :]
        n = half.shape[0]
        noise = np.mean(np.abs(np.diff(half, axis=0)) ** 2, axis=0) / 2
        floor = LEAST_NOISE * np.mean(np.abs(half), axis=0)
        scale = np.maximum(noise, floor**2)
        early = np.arange(self.values.shape[0])[:, None] < self.values.shape[0] - n
        return np.asarray(np.abs(self.values - half.mean(axis=0)) ** 2 / scale - np.where(early, 1 + 1 / n, 1 - 1 / n))


def settle_time(courses: Sequence[Course]) -> float:
    """Time [s] after each step until the transient is below LEFT standard errors of every dwell's result; 0 where none is seen.

    All dwells decay alike: the sum over dwells and channels of what exceeds the noise, S(t) = S_1 exp(-2 (t - t_1) / tau), shows the
    transient up to t_1, and is continued from there. A transient of a/s standard deviations of a block leaves the mean of n blocks
    off by a tau / (n T) in standard errors s / sqrt(n). DataError when the transient outlasts the dwells. Equation (frf-settle).
    """
    longest = max(float(course.times[-1]) for course in courses)
    edges = np.linspace(0, longest * (1 + 1e-9), N_BIN + 1)
    time, excess, error = _binned(courses, edges)
    seen = excess > SEEN * error
    last = int(np.argmin(seen)) if not np.all(seen) else seen.size
    if last == 0:
        return 0.0
    if time[last - 1] > 0.6 * longest:
        what = f"the responses have not settled {time[last - 1]:.3g} s after a step, where the dwells last {longest:.3g} s"
        raise DataError(what, hint="longer dwells; or state `settle`")
    end = float(edges[_bin(edges, time[last - 1]) + 1])
    tau = _time_constant(time[:last], excess[:last])
    wanted = min(_allowed(course, tau) for course in courses)
    return end + max(0.0, 0.5 * tau * float(np.log(excess[last - 1] / wanted)))


def _bin(edges: FloatArray, time: float) -> int:
    return int(np.searchsorted(edges, time, side="right")) - 1


def _binned(courses: Sequence[Course], edges: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean time [s] in each bin that is not empty, excess [1] as a sum over dwells and channels, and its standard error under noise."""
    total, variance = np.zeros(edges.size - 1), np.zeros(edges.size - 1)
    when, count = np.zeros(edges.size - 1), np.zeros(edges.size - 1)
    for course in courses:
        place = np.minimum(np.searchsorted(edges, course.times, side="right") - 1, edges.size - 2)
        number = np.bincount(place, minlength=edges.size - 1)
        some = number > 0
        deviation = course.deviation()
        sums = np.bincount(place, deviation.sum(axis=1), minlength=edges.size - 1)
        total[some] += sums[some] / number[some]
        # |noise|^2 of a block over its estimate from few others: F with 2 and about n degrees of freedom, heavier than chi2.
        variance[some] += deviation.shape[1] * (1.0 + 8.0 / deviation.shape[0]) / number[some]
        when += np.bincount(place, course.times, minlength=edges.size - 1)
        count += number
    some = count > 0
    return when[some] / count[some], total[some], np.sqrt(variance[some])


def _time_constant(time: FloatArray, excess: FloatArray) -> float:
    """tau [s] of an excess exp(-2 t / tau), from its largest value to the end of what is seen; at least a bin, where it falls faster."""
    top = int(np.argmax(excess))
    shortest = float(time[-1]) / max(time.size, 1)
    if time.size - top < 2:
        return shortest
    slope = np.polyfit(time[top:], np.log(excess[top:]), 1)[0]
    return max(shortest, -2.0 / float(slope)) if slope < 0 else float(time[-1])


def _allowed(course: Course, tau: float) -> float:
    """Largest (a / s)^2 at the start of what is used that leaves LEFT standard errors in the mean of its n blocks."""
    n = course.times.size
    step = float(course.times[-1] - course.times[0]) / max(n - 1, 1)
    return float(LEFT**2 * n / max(1.0, tau / step) ** 2)
