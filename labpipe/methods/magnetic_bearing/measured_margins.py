"""Peak of S and margins of L without a model: polynomials through as many lines as a parabola follows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.distributions import chi2_quantile, f_quantile, normal_tail
from labpipe.records.finding import Parameter
from labpipe.uncertainty.amounts import from_log, with_error

# A margin by its name, of a response (2,) at two places omega (2,) [rad/s] around a crossing.
Margin = Callable[[ComplexArray, FloatArray], float]
# A margin or a place, its standard error, and its changes (n_source,), all in its unit.
Found = tuple[float, float, FloatArray]
# Step of differences as a share of a value: far below what neighbouring places differ by.
STEP = 1e-7
# Lines of a polynomial: the fewest, the most around a crossing, and how fast they become more around a peak.
FEWEST, LOCAL, GROWTH = 5, 11, 1.3
# Coefficients of the polynomial that tells how many lines go together, and of the one through them: what the
# second leaves of the first is no more than noise, so that it has no bias that counts beside it.
LINE, PARABOLA, QUARTIC = 2, 3, 5
# Chance below which a parabola leaves more than noise of its lines.
ENOUGH = 0.05
# Standard errors within which all between two crossings is zero: both are one, crossed by noise.
SURE = 3.0
# Factor by which |L| passes 1 where a crossing that noise hides is named.
PASSES = 1.5
# Standard errors that a gain margin is away from zero where it is told.
TELLING = 4.0
# Standard errors below that limit at which a loop is told in fewer than one of five thousand tests.
SELDOM = 3.6
# How names of margins without a model begin.
MEASURED = "measured_"
FINE = 32
# Places at which L is followed around Im L = 0, over its lines but this share at either end.
PLACES, EDGE = 257, 8
# Share of a response below which what is left is rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class ResponseCourse:
    """A response at omega (n_line,) [rad/s]: *plain* as measured with its *variance* and its changes by every
    source (n_source, n_line), all [1]. dof: complex degrees of freedom behind the variance.
    """

    omega: FloatArray
    plain: ComplexArray
    variance: FloatArray
    changes: ComplexArray
    dof: float

    def follows(self, starts: IntArray, width: int) -> BoolArray:
        """Whether *width* lines from *starts* (n,) on are a parabola and noise. Equation (comp-course)."""
        if width <= PARABOLA:
            return np.ones(starts.size, dtype=bool)
        lines = starts[:, None] + np.arange(width)
        plain, variance = self.plain[lines], self.variance[lines]
        basis = np.linalg.qr(_powers(self.omega[lines], self.omega[lines], PARABOLA))[0]
        left = plain - np.einsum("nwk,nk->nw", basis, np.einsum("nwk,nw->nk", basis, plain))
        expected = np.sum(variance * (1 - np.sum(basis**2, axis=2)), axis=1)
        degrees = 2.0 * (width - PARABOLA)
        limit = (
            f_quantile(1 - ENOUGH, degrees, 2 * self.dof)
            if np.isfinite(self.dof)
            else chi2_quantile(1 - ENOUGH, degrees) / degrees
        )
        rounding = ROUNDING**2 * np.sum(np.abs(plain) ** 2, axis=1)
        return np.sum(np.abs(left) ** 2, axis=1) <= np.maximum(limit * expected, rounding)

    def follow(self, lines: slice) -> bool:
        """Whether a parabola leaves no more than noise of these lines."""
        return bool(self.follows(np.array([lines.start]), lines.stop - lines.start)[0])

    def smoother(self) -> FloatArray:
        """(n_line, n_line) [1]: every line by those around it, up to LOCAL, that a parabola follows."""
        count = self.omega.size
        weights, open_lines = np.zeros((count, count)), np.arange(count)
        for width in range(LOCAL, FEWEST - 1, -2):
            starts = np.clip(open_lines - width // 2, 0, count - width)
            follows = self.follows(starts, width)
            for chosen, degree in ((follows, PARABOLA), (~follows & (width <= FEWEST), QUARTIC)):
                lines, at = starts[chosen, None] + np.arange(width), open_lines[chosen]
                weights[at[:, None], lines] = _interpolation_weights(
                    self.omega[at, None], self.omega[lines], degree
                )[:, 0]
            open_lines = open_lines[~follows]
        return weights

    def around(self, first: int, last: int, most: int) -> slice:
        """The lines first ... last and as many to either side as a parabola follows, *most* in all."""
        for width in range(most, FEWEST + 1, -2):
            lines = window(first, last, width, self.omega.size)
            if self.follow(lines):
                return lines
        return window(first, last, max(FEWEST, last - first + 1), self.omega.size)

    def at(self, omega: FloatArray, lines: slice, coefficients: int = QUARTIC) -> Smooth:
        """The response at other places *omega* (n_place,) [rad/s] by a polynomial through the *lines*."""
        return self.by(omega, _interpolation_weights(omega, self.omega[lines], coefficients), lines)

    def by(self, omega: FloatArray, weights: FloatArray, lines: slice) -> Smooth:
        """The response at *omega* (n_place,) [rad/s] by *weights* (n_place, n_line) [1] of the *lines*."""
        return Smooth(
            omega,
            weights @ self.plain[lines],
            (weights * self.variance[lines]) @ weights.T,
            self.changes[:, lines] @ weights.T,
        )


def window(first: int, last: int, width: int, count: int) -> slice:
    """*width* of *count* lines about first ... last, moved inwards at the ends."""
    width = min(width, count)
    start = min(max((first + last + 1 - width + 1) // 2, 0), count - width)
    return slice(start, start + width)


def _interpolation_weights(places: FloatArray, omega: FloatArray, coefficients: int) -> FloatArray:
    """(..., n_place, n_line) [1]: values at omega (..., n_line) to their polynomial at other places."""
    count = min(coefficients, omega.shape[-1])
    return _powers(places, omega, count) @ np.linalg.pinv(_powers(omega, omega, count))


def _powers(places: FloatArray, omega: FloatArray, count: int) -> FloatArray:
    """(..., n_place, count) [1]: powers of log omega [rad/s], -1 to 1 over omega (..., n_line)."""
    low, high = np.log(omega[..., :1]), np.log(omega[..., -1:])
    x = (2 * np.log(places) - low - high) / (high - low)
    return x[..., None] ** np.arange(count)


@dataclass(frozen=True)
class Smooth:
    """A smoothed response at omega (n_place,) [rad/s] with its covariance (n_place, n_place) and changes
    (n_source, n_place), all [1].
    """

    omega: FloatArray
    values: ComplexArray
    covariance: FloatArray
    changes: ComplexArray

    def of(self, margin: Margin, n: int) -> Found:
        """A margin between the places n and n + 1, with error and changes. Equation (comp-margins-change)."""
        part = slice(n, n + 2)
        pair, places, total = self.values[part], self.omega[part], 0.0
        moved = np.zeros(len(self.changes))
        for direction, change in ((1.0, self.changes[:, part].real), (1.0j, self.changes[:, part].imag)):
            size = STEP * np.abs(pair).mean()
            ends = (
                margin(pair + sign * size * direction * row, places) for row in np.eye(2) for sign in (1, -1)
            )
            slopes = np.array(list(ends)).reshape(2, 2) @ np.array([1.0, -1.0]) / (2 * size)
            total += float(slopes @ self.covariance[part, part] @ slopes) / 2
            moved += change @ slopes
        return margin(pair, places), float(np.sqrt(total)), moved


def measured_margins(
    frequency: FloatArray,
    transfer: tuple[ComplexArray, FloatArray],
    changes: ComplexArray,
    noise: tuple[float, float],
    suffix: str = "",
) -> list[tuple[Parameter, FloatArray]]:
    """Gain margins to either side, phase and delay margin of L (n_line,) [1] with its variance (n_line,) [1],
    as far as it crosses.

    Each with its change (n_source,) [its unit] by one standard uncertainty of every systematic source, that
    changes L by *changes* (n_source, n_line) [1]. noise: complex degrees of freedom behind the variance, and
    standard errors to either side of a 95 % interval. *frequency* (n_line,) [Hz]. Equation (comp-margins).
    """
    dof, quantile = noise
    if frequency.size < LOCAL:
        return []
    course = ResponseCourse(2 * np.pi * frequency, *transfer, changes, dof)
    smooth = course.by(course.omega, course.smoother(), slice(None))
    candidates: dict[str, list[Found]] = {}
    for gain in gain_margins(course, smooth, quantile):
        candidates.setdefault("gain_margin_lower" if gain[0] < 1 else "gain_margin_upper", []).append(gain)
    for near, n in _crossings(course, smooth, lambda values: np.abs(values) - 1):
        for name, margin in (("phase_margin", _phase), ("delay_margin", _delay)):
            candidates.setdefault(name, []).append(near.of(margin, n))
    units, found = {"phase_margin": "rad", "delay_margin": "s"}, []
    for name, margins in candidates.items():
        nearest = max if name == "gain_margin_lower" else min
        value, error, moved = nearest(margins, key=itemgetter(0))
        shown = f"{MEASURED}{name}{suffix}"
        of = value, error, quantile
        amount = with_error(shown, units[name], *of) if name in units else factor(shown, *of)
        found.append((amount, moved))
    return found


def unsure_crossings(
    frequency: FloatArray, transfer: tuple[ComplexArray, FloatArray], dof: float
) -> list[tuple[float, float]]:
    """Bands [Hz] in which |L| passes 1 and comes back by its smoothed values, by a factor of PASSES and more,
    but nowhere surely, so that no margin counts it. *transfer*: L (n_line,) [1] with its variance (n_line,)
    [1] at *frequency* (n_line,) [Hz]; *dof*: complex degrees of freedom behind the variance.
    """
    if frequency.size < LOCAL:
        return []
    none: ComplexArray = np.zeros((0, frequency.size), np.complex128)
    course = ResponseCourse(2 * np.pi * frequency, *transfer, none, dof)
    smooth = course.by(course.omega, course.smoother(), slice(None))
    size = np.abs(smooth.values)
    return [
        (float(frequency[first]), float(frequency[last + 1]))
        for first, last in _groups(smooth, size - 1)[0]
        if np.max(np.abs(np.log(size[first + 1 : last + 1])), initial=0.0) > np.log(PASSES)
    ]


def factor(name: str, value: float, error: float, quantile: float) -> Parameter:
    """A gain margin *value* [1] with its standard *error* [1] and the interval of a factor, which reaches
    further up as far as it holds given that a margin is told.

    Told are loops that noise lets look larger than they are rather than smaller: where that decides, the loop
    may be as small as chance, given that it is told, allows. Equation (comp-gain-told).
    """
    # A factor's logarithm is nearer to a normal distribution.
    plain = from_log(name, "1", float(np.log(value)), error / value, quantile)
    assert plain.ci95 is not None
    size, limit = (quantile / -np.expm1(-quantile * share) for share in (error / value, 1 / TELLING))
    chance = normal_tail(quantile)
    smaller = np.linspace(limit - SELDOM, size - quantile, PLACES)
    chances = (normal_tail(size - loop) / normal_tail(limit - loop) for loop in smaller)
    least = next((loop for loop, p in zip(smaller, chances, strict=True) if p >= chance), smaller[-1])
    return replace(plain, ci95=(plain.ci95[0], max(plain.ci95[1], float(value * size / least))))


def _crossings(
    course: ResponseCourse, smooth: Smooth, function: Callable[[ComplexArray], FloatArray]
) -> Iterator[tuple[Smooth, int]]:
    """Places, and the number of the one behind which a real function of L changes its sign there."""
    signed = function(smooth.values)
    groups, sure = _groups(smooth, signed)
    for first, last in groups:
        # Not where noise crosses up to an end of the lines, or a function that only touches zero.
        before, after = np.flatnonzero(sure[: first + 1]), np.flatnonzero(sure[last + 1 :])
        if before.size == 0 or after.size == 0 or signed[before[-1]] * signed[last + 1 + after[0]] > 0:
            continue
        ends = course.omega[[first, last + 1]]
        places = np.geomspace(ends[0], ends[1], max(FINE, last + 1 - first) + 1)
        single = first == last
        most = LOCAL + 1 if single else max(LOCAL + last - first, 2 * (last - first + 1))
        lines = course.around(first, last + 1, most)
        for coefficients in (QUARTIC, PARABOLA, LINE)[0 if single else 1 :]:
            near = course.at(places, lines, coefficients)
            again = _changes(function(near.values))
            if len(again) == 1:
                yield near, again[0]
                break


def _groups(smooth: Smooth, signed: FloatArray) -> tuple[list[tuple[int, int]], BoolArray]:
    """First and last number behind which a real function *signed* (n_line,) of L changes its sign, where no
    line between is surely not zero; which lines (n_line,) are.
    """
    sure = np.abs(signed) > SURE * np.sqrt(np.diag(smooth.covariance) / 2)
    groups: list[tuple[int, int]] = []
    for n in _changes(signed):
        if groups and not np.any(sure[groups[-1][1] + 1 : n + 1]):
            groups[-1] = (groups[-1][0], n)
        else:
            groups.append((n, n))
    return groups, sure


def gain_margins(course: ResponseCourse, smooth: Smooth, quantile: float) -> Iterator[Found]:
    """-1 / Re L [1] where Im L = 0, by as many lines as a parabola follows; none where noise crosses.

    Its error holds what the noise of Im L does to the place, however L bends there: all places count whose
    Im L is zero within *quantile* standard errors e, and there Re L +- sqrt(quantile^2 e^2 - Im^2 L).
    Equation (comp-gain-profile).
    """
    for first, last in _groups(smooth, smooth.values.imag)[0]:
        lines = _widest(course, first, last + 1)
        inside = (lines.stop - lines.start) // EDGE
        low, high = course.omega[lines.start + inside], course.omega[lines.stop - 1 - inside]
        near = course.at(np.geomspace(low, high, PLACES), lines)
        crossings = _changes(near.values.imag)
        if len(crossings) != 1 or near.values[crossings[0]].real >= 0:
            continue
        value, error, moved = near.of(_gain, crossings[0])
        square = quantile**2 * np.diag(near.covariance) / 2 - near.values.imag**2
        zero = square >= 0
        reach = np.sqrt(square[zero])
        ends = -near.values.real[zero][:, None] + reach[:, None] * np.array([-1.0, 1.0])
        # A loop that noise may turn has no gain margin there: -1 / Re L of noise is any number.
        if np.any(ends <= 0):
            continue
        away = float(np.max(np.abs(np.log(ends * value)), initial=0.0)) / quantile
        error = max(error, value * away)
        if error * TELLING < value:
            yield value, error, moved


def _widest(course: ResponseCourse, first: int, last: int) -> slice:
    """The most lines about first ... last that a parabola follows."""
    count = course.omega.size
    chosen, width = window(first, last, FEWEST, count), float(max(FEWEST, last - first + 1))
    while width < GROWTH * count:
        lines = window(first, last, round(width) | 1, count)
        chosen = lines if course.follow(lines) else chosen
        width *= GROWTH
    return chosen


def _changes(values: FloatArray) -> list[int]:
    return [int(n) for n in np.flatnonzero(values[:-1] * values[1:] < 0)]


def _gain(values: ComplexArray, _: FloatArray) -> float:
    """-1 / Re L where Im L = 0."""
    share = values[0].imag / (values[0].imag - values[1].imag)
    return float(-1 / (values[0] + share * (values[1] - values[0])).real)


def _crossing(values: ComplexArray, omega: FloatArray) -> tuple[float, float]:
    """Phase of -L [rad] and omega [rad/s] where |L| = 1 on the way to the next place."""
    sizes = np.log(np.abs(values))
    share = float(sizes[0] / (sizes[0] - sizes[1]))
    angle = float(np.angle(-(values[0] + share * (values[1] - values[0]))))
    return angle, float(omega[0] + share * (omega[1] - omega[0]))


def _phase(values: ComplexArray, omega: FloatArray) -> float:
    return abs(_crossing(values, omega)[0])


def _delay(values: ComplexArray, omega: FloatArray) -> float:
    angle, at = _crossing(values, omega)
    return angle % (2 * np.pi) / at


@dataclass(frozen=True)
class Crest:
    """The highest |S|: value [1] and place [rad/s], each with its error by noise and changes (n_source,)."""

    value: Found
    place: Found


def crest_of(course: ResponseCourse) -> Crest | None:
    """The maximum of |S| by as many lines as a parabola follows, None at an end. Equation (comp-peak)."""
    count = course.omega.size
    if count < FEWEST:
        return None
    lines, follows = _crest_lines(course)
    # A polynomial is not to be trusted at the ends of its lines.
    inside = (lines.stop - lines.start) // 4
    low = lines.start + (inside if lines.start else 0)
    high = lines.stop - 1 - (inside if lines.stop < count else 0)
    places = np.geomspace(course.omega[low], course.omega[high], FINE * (high - low) + 1)
    of_place = course.at(places, lines, PARABOLA if follows else QUARTIC)
    top = int(np.argmax(np.abs(of_place.values)))
    if (top == 0 and low == 0) or (top == places.size - 1 and high == count - 1):
        return None
    top = min(max(top, 1), places.size - 2)
    crest = _crest(course.at(places, lines), of_place, top, follows)
    place, error, changes = crest.place
    error = float(np.hypot(error, truncation(course, of_place, top, lines)))
    return replace(crest, place=(place, error, changes))


def _crest_lines(course: ResponseCourse) -> tuple[slice, bool]:
    """Most lines that a parabola follows around the highest |S|; False where it follows too few."""
    count = course.omega.size
    top = int(np.argmax(np.abs(course.plain)))
    chosen, follows, width = window(top, top, FEWEST, count), False, float(FEWEST)
    while width < GROWTH * count:
        lines = window(top, top, round(width) | 1, count)
        if course.follow(lines):
            chosen, follows = lines, True
            top = lines.start + int(np.argmax(np.abs(course.at(course.omega[lines], lines, PARABOLA).values)))
        width *= GROWTH
    return window(top, top, chosen.stop - chosen.start, count), follows


def _crest(near: Smooth, of_place: Smooth, top: int, follows: bool) -> Crest:
    """|S| of *near* where that of *of_place* is highest, the place number *top*, and its place, a step of
    Newton from there. What noise does on average is taken off: beside its maximum |S| is lower; where one
    polynomial tells both, the maximum seeks the noise; a modulus has the noise across it.
    """
    part = slice(top - 1, top + 2)
    at = np.log(near.omega[part])
    step = float(at[1] - at[0])
    slope, bend = _differences(step)
    outline, noise, moved = _modulus(of_place, part)
    size, covariance, changes = _modulus(near, part)
    curvature = -float(bend @ outline)
    height, error = float(size[1]), float(np.sqrt(covariance[1, 1]))
    sideways, of_slope = (float(slope @ matrix @ slope) / curvature for matrix in (noise, covariance))
    height += min(sideways / 2, error) * (1 if follows else -1) - error**2 / (2 * height)
    spread = float(np.sqrt(of_slope / curvature))
    shift = float(np.clip(slope @ size / curvature, -step - spread, step + spread))
    place = float(np.exp(at[1] + shift))
    shifts = (changes @ slope + shift * (moved @ bend)) / curvature
    return Crest((height, error, changes[:, 1]), (place, place * spread, place * shifts))


def _differences(step: float) -> tuple[FloatArray, FloatArray]:
    """First and second derivative (3,) in the middle of three values that lie *step* apart."""
    return np.array([-0.5, 0.0, 0.5]) / step, np.array([1.0, -2.0, 1.0]) / step**2


def truncation(course: ResponseCourse, of_place: Smooth, top: int, lines: slice) -> float:
    """Distance [rad/s] between the maximum of |S| and the minimum of |1/S| by polynomials of fourth degree
    through the same lines, a step of Newton each: what lines far apart leave of the place.
    Equation (comp-peak-truncation).
    """
    places = of_place.omega[top - 1 : top + 2]
    slope, bend = _differences(float(np.log(places[1] / places[0])))
    through = _interpolation_weights(places, course.omega[lines], QUARTIC)
    shifts = []
    for values in (course.plain[lines], 1 / course.plain[lines]):
        size = np.abs(through @ values)
        shifts.append(-float(slope @ size) / float(bend @ size))
    # A crest that noise makes flat has its maximum anywhere: no more than to the next line.
    ends = course.omega[[lines.start, lines.stop - 1]]
    most = float(np.log(ends[1] / ends[0])) / (lines.stop - 1 - lines.start)
    return float(places[1] * min(abs(shifts[1] - shifts[0]), most))


def _modulus(near: Smooth, part: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Moduli (n,), their covariance (n, n) by noise and changes (n_source, n), all [1]."""
    values = near.values[part]
    along = values.conj() / np.abs(values)
    covariance = np.real(along[:, None] * along.conj()[None]) * near.covariance[part, part] / 2
    return np.abs(values), covariance, np.real(near.changes[:, part] * along)
