"""Damping read from a response: half-power points, and what an exponential window adds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray, freeze_bases
from labpipe.errors import DataError
from labpipe.records.response import BlockCovariance, FrequencyResponse, variance_of
from labpipe.spectra.matrices import without_rounding
from labpipe.spectra.ports import Parts

# Half width of the local rational fit [lines].
HALF_WIDTH = 4
# Squared standard errors by which a second pole must move a line of a force, in the mean over the responses.
NEEDED = 16.0
# Elements of a matrix that are corrected together.
ELEMENTS = 16
# Relative differences of the spacing of lines, which files print with six digits.
EVEN = 1e-2


@dataclass(frozen=True)
class Undamped:
    """H(j w) from the windowed H_w(j w + s), and how an error of H_w moves it: dH(k) = sum_j gains(k, j)
    dH_w(k + j - HALF_WIDTH). matrix (n_frequency, n_output, n_input) [unit of H]; gains (n_frequency, 2
    HALF_WIDTH + 1, n_output, n_input) [1].
    """

    matrix: ComplexArray
    gains: ComplexArray


def without_added_damping(
    frequency: FloatArray, matrix: ComplexArray, decay: float, poles: int = 1
) -> Undamped:
    """H(j w) from the windowed H(j w + s) = *matrix*, s = 1/decay, (n_frequency, n_output, n_input) [unit of
    H]. frequency (n_frequency,) [Hz] evenly spaced, *decay* [s]. Around every line H is approximated by (a0 +
    a1 x + a2 x^2) / (1 + b1 x + b2 x^2), x = j (w' - w) / dw, on 4 lines to either side (local rational
    method: McKelvey and Guerin 2012), and evaluated at x = -s/dw, with b2 = 0 of one of the *poles*. As many
    modes are exact, however close. Fewer than 5 lines are returned unchanged. The gains are the first-order
    effect of an error on the solution a0 ... b2. Equation (frf-undamped).
    """
    n_line = frequency.size
    if n_line <= HALF_WIDTH:
        return Undamped(
            matrix, _centre(np.ones((n_line, 1, *matrix.shape[1:]), np.complex128), np.arange(n_line))
        )
    spacing = 2 * np.pi * (frequency[-1] - frequency[0]) / (n_line - 1)
    width = min(2 * HALF_WIDTH + 1, n_line)
    first = np.clip(np.arange(n_line) - width // 2, 0, n_line - width)
    lines = first[:, None] + np.arange(width)
    x = 1j * (lines - np.arange(n_line)[:, None])
    flat = matrix.reshape(n_line, -1)
    # A few elements at a time: each takes some hundred numbers per line.
    both = [
        _evaluate(flat[:, start : start + ELEMENTS], lines, x, -1 / (decay * spacing), poles)
        for start in range(0, flat.shape[1], ELEMENTS)
    ]
    values, gains = (np.concatenate(parts, axis=-1) for parts in zip(*both, strict=True))
    return Undamped(
        values.reshape(matrix.shape), _centre(gains.reshape(n_line, width, *matrix.shape[1:]), first)
    )


def _evaluate(
    flat: ComplexArray, lines: IntArray, x: ComplexArray, shift: float, poles: int
) -> tuple[ComplexArray, ComplexArray]:
    size = np.max(np.abs(flat), axis=0)
    neighbours = flat[lines] / np.where(size > 0, size, 1.0)
    powers = np.broadcast_to(x[:, :, None, None] ** np.arange(3), (*neighbours.shape, 3))
    of_poles = x[:, :, None, None] ** np.arange(1, 1 + poles)
    equations = np.concatenate([powers, -of_poles * neighbours[:, :, :, None]], axis=3).swapaxes(1, 2)
    # Minimum-norm solution where the equations are rank deficient: a constant H has no pole.
    inverse = np.linalg.pinv(equations, rcond=1e-9)
    solution = np.einsum("fekl,fel->fek", inverse, neighbours.swapaxes(1, 2))
    of_shift = shift ** np.arange(3.0), shift ** np.arange(1.0, 1 + poles)
    denominator = 1 + solution[:, :, 3:] @ of_shift[1]
    value = solution[:, :, :3] @ of_shift[0] / denominator
    # An error dH of a neighbour changes the right side of its equation by (1 + b1 x + b2 x^2) dH.
    slopes = np.concatenate(
        [np.broadcast_to(of_shift[0], (*value.shape, 3)), -value[:, :, None] * of_shift[1]], axis=2
    )
    errors = 1 + np.einsum("fep,fkqp->fke", solution[:, :, 3:], of_poles)
    gains = np.einsum("fek,fekl->fle", slopes / denominator[:, :, None], inverse) * errors
    return value * np.where(size > 0, size, 1.0), gains


def remove_window_damping(response: FrequencyResponse, decay: float) -> FrequencyResponse:
    """A ready response (n_frequency, n_output, n_input) [unit of the form] without the damping of a window
    exp(-t / *decay*), *decay* [s]. Its covariance has no place: how the noise of neighbouring lines goes
    together is not known. DataError for lines that are not evenly spaced.
    """
    spacing = np.diff(response.frequency)
    if spacing.size and np.ptp(spacing) > EVEN * spacing.mean():
        what = "the lines are not evenly spaced, so that a window cannot be taken out"
        raise DataError(what, hint="leave out windowed")
    matrix = without_added_damping(response.frequency, response.matrix, decay, 2).matrix
    return replace(response, matrix=matrix, covariance=None, line_correlation=(), line_gains=None)


def _centre(gains: ComplexArray, first: IntArray) -> ComplexArray:
    """The gains of lines from *first* on by their distance, at most HALF_WIDTH: at the ends some are lost."""
    n_line, width = gains.shape[:2]
    centred = np.zeros((n_line, 2 * HALF_WIDTH + 1, *gains.shape[2:]), np.complex128)
    place = first[:, None] + np.arange(width) - np.arange(n_line)[:, None] + HALF_WIDTH
    line, neighbour = np.nonzero((place >= 0) & (place <= 2 * HALF_WIDTH))
    centred[line, place[line, neighbour]] = gains[line, neighbour]
    return centred


def covariance_without_damping(
    gains: ComplexArray, covariance: ComplexArray, correlation: ComplexArray
) -> ComplexArray:
    """Covariance of the response without added damping, (n_frequency, n, n) [unit of H^2]: sum_ij G_i C_w r(i
    - j) G_j^H.

    gains as in Undamped; covariance (n_frequency, n, n) [unit of H^2] of the windowed response, the same for
    the neighbours of a line, n = n_output * n_input; correlation (n_distance,) [1] of its noise 1, 2, ...
    lines apart (windows.exponential_correlation). Equation (frf-undamped-covariance).
    """
    n_line, width = gains.shape[:2]
    flat = gains.reshape(n_line, width, -1)
    spread = np.einsum(
        "fia,ij,fjb->fab", flat, correlation_matrix(np.arange(width), correlation), flat.conj()
    )
    return without_rounding(covariance * spread)


def correlation_matrix(lines: IntArray, correlation: ComplexArray) -> ComplexArray:
    """E[z_a z_b*] (n, n) [1] of lines with the numbers *lines* (n,). *correlation* (n_distance,) of z_(k + d)
    with z_k, d = 1, 2, ...
    """
    whole = np.concatenate([[1.0], correlation, np.zeros(1)])
    distance = lines[:, None] - lines[None, :]
    values: ComplexArray = whole[np.minimum(np.abs(distance), whole.size - 1)]
    return np.where(distance >= 0, values, values.conj())


@dataclass(frozen=True)
class HalfPower:
    """A resonance: frequency [Hz], amplitude, half-power points low and high [Hz]."""

    frequency: float
    amplitude: float
    low: float
    high: float

    @property
    def damping_ratio(self) -> float:
        """zeta = (f_2^2 - f_1^2) / (4 f_0^2) (Ewins, Modal Testing, sec. 4.3); within zeta^2 of the exact
        value for light damping. Equation (frf-half-power).
        """
        return (self.high**2 - self.low**2) / (4 * self.frequency**2)


def half_power(frequency: FloatArray, response: ComplexArray, band: tuple[float, float]) -> HalfPower:
    """The highest peak of |H| in *band* [Hz] and its half-power points, |H| = 1/sqrt(2) of the peak.
    frequency (n_frequency,) [Hz], response (n_frequency,) [any unit]. Between lines 1/|H|^2 is interpolated
    by a parabola in w^2, exact for one degree of freedom: |1/H|^2 = (k - m w^2)^2 + c^2 w^2 of a receptance.
    DataError when the band has no peak inside, |H| does not fall to half power within the lines, or the
    parabola through the peak's lines falls below zero.
    """
    inside = np.flatnonzero((frequency >= band[0]) & (frequency <= band[1]))
    size = np.abs(response)
    peak = int(inside[np.argmax(size[inside])]) if inside.size else 0
    if (
        not inside.size
        or peak in (0, frequency.size - 1)
        or not size[peak - 1] <= size[peak] >= size[peak + 1]
    ):
        what = f"no resonance within {band[0]:g}-{band[1]:g} Hz"
        raise DataError(what, hint="choose the band around the peak")
    square = frequency**2
    with np.errstate(divide="ignore"):
        inverse = (size[peak] / size) ** 2
    a, b, c = _parabola(square[peak - 1 : peak + 2], inverse[peak - 1 : peak + 2], square[peak])
    top = -b / (2 * a)
    least = c + b * top / 2
    if not least > 0:
        what = f"the lines are too far apart for the peak at {frequency[peak]:g} Hz"
        raise DataError(what, hint="give lines nearer to each other")
    low = _crossing(square, inverse, peak, -1, 2 * least)
    high = _crossing(square, inverse, peak, 1, 2 * least)
    return HalfPower(
        float(np.sqrt(square[peak] + top)),
        float(size[peak] / np.sqrt(least)),
        float(np.sqrt(low)),
        float(np.sqrt(high)),
    )


def _parabola(x: FloatArray, y: FloatArray, origin: float) -> tuple[float, float, float]:
    """a, b, c of y = a (x - origin)^2 + b (x - origin) + c through three points."""
    a, b, c = np.linalg.solve(np.vander(x - origin, 3), y)
    return float(a), float(b), float(c)


def _crossing(square: FloatArray, inverse: FloatArray, peak: int, side: int, level: float) -> float:
    """f^2 [Hz^2] at which the inverse rises through *level* on one side of the peak."""
    beyond = np.flatnonzero(inverse[peak::side] >= level)
    if not beyond.size:
        where = "above" if side > 0 else "below"
        what = f"the response does not fall to half power {where} its peak"
        raise DataError(what, hint="widen the FRF's band")
    first = peak + side * int(beyond[0])
    # The lines to either side of the crossing and the next one towards the peak.
    three = np.sort([first, first - side, first - 2 * side])
    if three[0] < 0 or three[-1] >= square.size:
        three = np.sort([first, first - side, first + side])
    a, b, c = _parabola(square[three], inverse[three] - level, square[first])
    roots = np.roots([a, b, c]).real
    span = square[first - side] - square[first]
    return float(square[first] + roots[np.argmin(np.abs(roots - span / 2))])


def parts_without_window(parts: Parts, decay: float, correlation: ComplexArray) -> Parts:
    """The parts less the damping that a window exp(-t / *decay*) [s] added, with their covariance;
    *correlation* (n_distance,) [1] of the noise of lines under it.
    """
    single, double = (without_added_damping(parts.frequency, parts.matrix, decay, poles) for poles in (1, 2))
    between = correlation_matrix(np.arange(single.gains.shape[1]), correlation)
    needed = _needs_second_pole(parts, single, double, between)
    matrix: ComplexArray = np.where(needed, double.matrix, single.matrix)
    gains: ComplexArray = np.where(needed, double.gains, single.gains)
    covariance = parts.covariance
    if isinstance(covariance, np.ndarray):
        covariance = covariance_without_damping(gains, covariance, correlation)
    elif isinstance(covariance, BlockCovariance):
        by_element = gains.reshape(*gains.shape[:2], -1)
        blocks = np.empty_like(covariance.blocks)
        for number, elements in enumerate(covariance.elements):
            blocks[:, number] = covariance_without_damping(
                by_element[:, :, elements], covariance.blocks[:, number], correlation
            )
        covariance = BlockCovariance(covariance.elements, freeze_bases(blocks))
    size = np.sqrt(_noise_power(gains, between))
    return replace(
        parts,
        matrix=matrix,
        covariance=covariance,
        line_correlation=tuple(complex(c) for c in correlation),
        line_gains=np.asarray(gains / np.where(size > 0, size, 1.0)[:, None]),
    )


def _noise_power(gains: ComplexArray, between: ComplexArray) -> FloatArray:
    """sum_ij g_i r(i - j) g_j* (n_frequency, n_output, n_input) [1] of gains as in Undamped."""
    power: FloatArray = np.einsum("fioa,ij,fjoa->foa", gains, between, gains.conj()).real
    return power


def _needs_second_pole(parts: Parts, single: Undamped, double: Undamped, between: ComplexArray) -> BoolArray:
    """Of every force (n_input,) whether a second pole moves a line by more than its noise: where nothing
    needs it, it adds noise. True where the noise is not known.
    """
    variance = variance_of(parts.covariance)
    if variance is None:
        return np.ones(parts.matrix.shape[2], bool)
    noise = _noise_power(double.gains - single.gains, between) * variance.reshape(single.matrix.shape)
    moved = np.abs(double.matrix - single.matrix) ** 2
    squares = np.divide(moved, noise, out=np.zeros_like(noise), where=noise > 0)
    return np.asarray(np.any(squares.mean(axis=1) > NEEDED, axis=0))
