"""Resonances of a measured response: peaks, half-power points and damping ratios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError


@dataclass(frozen=True)
class HalfPower:
    """A resonance: frequency [Hz], amplitude, half-power points low and high [Hz]."""

    frequency: float
    amplitude: float
    low: float
    high: float

    @property
    def damping_ratio(self) -> float:
        """zeta = (f_2^2 - f_1^2) / (4 f_0^2) (Ewins, Modal Testing, sec. 4.3); within zeta^2 of the exact value for light damping.

        Equation (frf-half-power).
        """
        return (self.high**2 - self.low**2) / (4 * self.frequency**2)


def half_power(frequency: FloatArray, response: ComplexArray, band: tuple[float, float]) -> HalfPower:
    """The highest peak of |H| in *band* [Hz] and its half-power points, |H| = 1/sqrt(2) of the peak.

    frequency (n_frequency,) [Hz], response (n_frequency,) [any unit]. Between lines 1/|H|^2 is interpolated by a parabola in w^2, exact
    for one degree of freedom: |1/H|^2 = (k - m w^2)^2 + c^2 w^2 of a receptance. DataError when the band has no peak inside, |H| does
    not fall to half power within the lines, or the parabola through the peak's lines falls below zero.
    """
    inside = np.flatnonzero((frequency >= band[0]) & (frequency <= band[1]))
    size = np.abs(response)
    peak = int(inside[np.argmax(size[inside])]) if inside.size else 0
    if not inside.size or peak in (0, frequency.size - 1) or not size[peak - 1] <= size[peak] >= size[peak + 1]:
        raise DataError(f"no resonance within {band[0]:g}-{band[1]:g} Hz", hint="choose the band around the peak")
    square = frequency**2
    with np.errstate(divide="ignore"):
        inverse = (size[peak] / size) ** 2
    a, b, c = _parabola(square[peak - 1 : peak + 2], inverse[peak - 1 : peak + 2], square[peak])
    top = -b / (2 * a)
    least = c + b * top / 2
    if not least > 0:
        raise DataError(f"the lines are too far apart for the peak at {frequency[peak]:g} Hz", hint="give lines nearer to each other")
    low = _crossing(square, inverse, peak, -1, 2 * least)
    high = _crossing(square, inverse, peak, 1, 2 * least)
    return HalfPower(float(np.sqrt(square[peak] + top)), float(size[peak] / np.sqrt(least)), float(np.sqrt(low)), float(np.sqrt(high)))


def _parabola(x: FloatArray, y: FloatArray, origin: float) -> tuple[float, float, float]:
    """a, b, c of y = a (x - origin)^2 + b (x - origin) + c through three points."""
    a, b, c = np.linalg.solve(np.vander(x - origin, 3), y)
    return float(a), float(b), float(c)


def _crossing(square: FloatArray, inverse: FloatArray, peak: int, side: int, level: float) -> float:
    """f^2 [Hz^2] at which the inverse rises through *level* on one side of the peak."""
    beyond = np.flatnonzero(inverse[peak::side] >= level)
    if not beyond.size:
        where = "above" if side > 0 else "below"
        raise DataError(f"the response does not fall to half power {where} its peak", hint="widen the FRF's band")
    first = peak + side * int(beyond[0])
    # The lines to either side of the crossing and the next one towards the peak.
    three = np.sort([first, first - side, first - 2 * side])
    if three[0] < 0 or three[-1] >= square.size:
        three = np.sort([first, first - side, first + side])
    a, b, c = _parabola(square[three], inverse[three] - level, square[first])
    roots = np.roots([a, b, c]).real
    span = square[first - side] - square[first]
    return float(square[first] + roots[np.argmin(np.abs(roots - span / 2))])
