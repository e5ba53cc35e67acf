"""Margins of a measured loop transfer function without a model, from the lines around its crossings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.campaign.amounts import with_error
from labpipe.records.identification import Parameter

# A margin by its name, of L (2,) at the lines around a crossing at omega (2,) [rad/s].
Margin = Callable[[ComplexArray, FloatArray], float]
STEP = 1e-4
# Lines of one local parabola.
LOCAL = 11
# Standard errors within which a function is zero all the way from one crossing to the next: both are one, crossed by noise.
SURE = 3.0


# A margin, its standard error, and its changes (n_source,), all in its unit.
Found = tuple[float, float, FloatArray]


def measured_margins(
    frequency: FloatArray, transfer: tuple[ComplexArray, FloatArray], changes: ComplexArray, quantile: float, suffix: str = ""
) -> list[tuple[Parameter, FloatArray]]:
    """Gain margins to either side, phase and delay margin of L (n_line,) [1] with its variance (n_line,) [1], as far as it crosses.

    Each with its change (n_source,) [its unit] by one standard uncertainty of every systematic source, that changes L by *changes*
    (n_source, n_line) [1].

    L follows a parabola over LOCAL lines, since noise makes it cross several times; where it does so all the same, one parabola over all
    these crossings and as much again, since the least of several would be too small. Intervals of 95 %, *quantile* standard errors to
    either side, hold the noise of these lines. *frequency* (n_line,) [Hz]. Equations (comp-margins) and (comp-margins-change).
    """
    plain, variance = transfer
    if frequency.size < LOCAL:
        return []
    omega, smoother = 2 * np.pi * frequency, _smoother(frequency)
    lines = _Lines(omega, plain, variance, changes, smoother)
    candidates: dict[str, list[Found]] = {}
    for near, n in lines.crossings(np.imag):
        if near.values[n].real + near.values[n + 1].real < 0:
            gain = _with_error(_gain, near, n)
            candidates.setdefault("gain_margin_lower" if gain[0] < 1 else "gain_margin_upper", []).append(gain)
    for near, n in lines.crossings(lambda values: np.abs(values) - 1):
        for name, margin in (("phase_margin", _phase), ("delay_margin", _delay)):
            candidates.setdefault(name, []).append(_with_error(margin, near, n))
    units = {"phase_margin": "rad", "delay_margin": "s"}
    chosen = {name: (max if name == "gain_margin_lower" else min)(margins, key=_value) for name, margins in candidates.items()}
    return [
        (with_error(f"measured_{name}{suffix}", units.get(name, "1"), value, error, quantile), moved)
        for name, (value, error, moved) in chosen.items()
    ]


def _value(found: Found) -> float:
    return found[0]


@dataclass(frozen=True)
class _Lines:
    """L at omega (n_line,) [rad/s]: *plain* as measured with its *variance* and its changes by every source (n_source, n_line), all [1].

    smoother (n_line, n_line) [1]: from these to smoothed values.
    """

    omega: FloatArray
    plain: ComplexArray
    variance: FloatArray
    plain_changes: ComplexArray
    smoother: FloatArray

    @cached_property
    def values(self) -> ComplexArray:
        """L smoothed, (n_line,) [1]."""
        return self.smoother @ self.plain

    @cached_property
    def covariance(self) -> FloatArray:
        """Of the smoothed values, (n_line, n_line) [1]."""
        return np.asarray(self.smoother * self.variance @ self.smoother.T)

    @cached_property
    def changes(self) -> ComplexArray:
        """Of the smoothed values by every source, (n_source, n_line) [1]."""
        return self.plain_changes @ self.smoother.T

    def crossings(self, function: Callable[[ComplexArray], FloatArray]) -> Iterator[tuple[_Lines, int]]:
        """Lines, and the number of the one behind which a real function of L changes its sign there."""
        signed = function(self.values)
        error = np.sqrt(np.diag(self.covariance) / 2)
        for first, last in _together(_changes(signed), np.abs(signed) > SURE * error):
            near = self if first == last else self._over(first, last)
            again = [n for n in _changes(function(near.values)) if first != last or n == first]
            if len(again) == 1:
                yield near, again[0]
            else:
                yield from ((self, n) for n in _changes(signed) if first <= n <= last)

    def _over(self, first: int, last: int) -> _Lines:
        """The lines from *first* to *last* and half as many to either side, L by one parabola through them."""
        reach = max(LOCAL // 2, (last - first + 1) // 2)
        part = slice(max(first - reach, 0), last + 2 + reach)
        omega = self.omega[part]
        x = (omega - omega[0]) / (omega[-1] - omega[0])
        columns = np.column_stack([np.ones_like(x), x, x**2])
        smoother = columns @ np.linalg.pinv(columns)
        return _Lines(omega, self.plain[part], self.variance[part], self.plain_changes[:, part], smoother)


def _together(crossings: Sequence[int], sure: BoolArray) -> list[tuple[int, int]]:
    """First and last of the *crossings* between which no line is *sure* (n_line,) of its sign."""
    groups: list[tuple[int, int]] = []
    for n in crossings:
        if groups and not np.any(sure[groups[-1][1] + 1 : n + 1]):
            groups[-1] = (groups[-1][0], n)
        else:
            groups.append((n, n))
    return groups


def _smoother(frequency: FloatArray) -> FloatArray:
    """(n_line, n_line) [1]: the value at every line of the parabola through the LOCAL lines around it."""
    n = frequency.size
    matrix = np.zeros((n, n))
    for line in range(n):
        first = min(max(line - LOCAL // 2, 0), n - LOCAL)
        x = frequency[first : first + LOCAL] - frequency[line]
        matrix[line, first : first + LOCAL] = np.linalg.pinv(np.column_stack([np.ones(LOCAL), x, x**2]))[0]
    return matrix


def _changes(values: FloatArray) -> list[int]:
    """Numbers of the lines behind which a function changes its sign."""
    return [int(n) for n in np.flatnonzero(values[:-1] * values[1:] < 0)]


def _gain(values: ComplexArray, _: FloatArray) -> float:
    """-1 / Re L where Im L = 0."""
    share = values[0].imag / (values[0].imag - values[1].imag)
    return float(-1 / (values[0] + share * (values[1] - values[0])).real)


def _crossing(values: ComplexArray) -> float:
    """Share of the way to the next line where |L| = 1."""
    sizes = np.log(np.abs(values))
    return float(sizes[0] / (sizes[0] - sizes[1]))


def _phase(values: ComplexArray, _: FloatArray) -> float:
    share = _crossing(values)
    return float(abs(np.angle(-(values[0] + share * (values[1] - values[0])))))


def _delay(values: ComplexArray, omega: FloatArray) -> float:
    share = _crossing(values)
    angle = float(np.angle(-(values[0] + share * (values[1] - values[0])))) % (2 * np.pi)
    return angle / float(omega[0] + share * (omega[1] - omega[0]))


def _with_error(margin: Margin, lines: _Lines, n: int) -> Found:
    """A margin, its standard error and its changes.

    Half of the covariance (n_line, n_line) [1] of L is of its real and half of its imaginary part.
    """
    pair, places, total = lines.values[n : n + 2], lines.omega[n : n + 2], 0.0
    changes = lines.changes[:, n : n + 2]
    moved = np.zeros(len(changes))
    for direction, part in ((1.0, changes.real), (1.0j, changes.imag)):
        steps = STEP * np.abs(pair).mean() * direction * np.eye(2)
        slopes = np.array([(margin(pair + step, places) - margin(pair - step, places)) / (2 * abs(step).max()) for step in steps])
        total += float(slopes @ lines.covariance[n : n + 2, n : n + 2] @ slopes) / 2
        moved += part @ slopes
    return margin(pair, places), float(np.sqrt(total)), moved
