"""A mode on the lines of one FRF, and its extensions: a second mode in the band, a resonance that moves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import FitError

# The model as it is, a second mode, and four laws by which the resonance moves meanwhile.
AS_IT_IS, SECOND = "", "J"
MOVED = ("L", "G", "U", "C")
# Places where a second mode is looked for, and the factor between the damping of two modes at most.
PLACES, LIKE_DAMPING = 25, 5.0
# Weak prior around the ordinary fit, which stops run-away: ln zeta, level.
PRIOR_DAMPING, PRIOR_LEVEL = 0.7, 0.5
# Of a minimum, relative: chi-square, theta, and the slope of chi-square.
TOLERANCES = {"ftol": 1e-8, "xtol": 1e-8, "gtol": 1e-8}
_HERMITE = np.polynomial.hermite_e.hermegauss(7)
_LEGENDRE = np.polynomial.legendre.leggauss(7)
# Nodes x and weights of the laws of motion, of unit variance.
NODES: Mapping[str, tuple[FloatArray, FloatArray]] = {
    "L": (_HERMITE[0], _HERMITE[1] / _HERMITE[1].sum()),
    "G": (_HERMITE[0], _HERMITE[1] / _HERMITE[1].sum()),
    "U": (np.sqrt(3) * _LEGENDRE[0], _LEGENDRE[1] / 2),
    "C": (np.sqrt(2) * np.cos((np.arange(8) + 0.5) * np.pi / 8), np.full(8, 0.125)),
}


@dataclass(frozen=True)
class Curve:
    """One FRF on its lines: frequency (n_line,) [Hz], values (n_line,) [any unit], std (n_line,):
    sqrt(E|n|^2) of the noise there. smear: of random data, weights (n_line, n_point) [1] by which what leaks
    makes lines of the points of omega (n_point,) [rad/s].
    """

    frequency: FloatArray
    values: ComplexArray
    std: FloatArray
    _: KW_ONLY
    smear: Any = None
    omega: FloatArray | None = None

    @cached_property
    def s(self) -> ComplexArray:
        """j omega (n_line,) or (n_point,) [rad/s]."""
        return 2j * np.pi * self.frequency if self.omega is None else 1j * self.omega

    def lines_of(self, rows: ComplexArray) -> ComplexArray:
        """The lines (..., n_line) that *rows* (..., n_point) [any unit] at `s` make by what leaks."""
        if self.smear is None:
            return rows
        lines = self.smear @ rows.reshape(-1, rows.shape[-1]).T
        return np.asarray(lines.T.reshape(*rows.shape[:-1], -1), np.complex128)

    def choose(self, lines: BoolArray) -> Curve:
        """That of the chosen *lines* (n_line,)."""
        smear = None if self.smear is None else self.smear[np.flatnonzero(lines)]
        return replace(
            self, frequency=self.frequency[lines], values=self.values[lines], std=self.std[lines], smear=smear
        )

    def average(self, together: int) -> Curve:
        """Means of so many neighbours, without what is left of the last ones."""
        n = self.frequency.size // together * together
        frequency, values, std = (
            part[:n].reshape(-1, together) for part in (self.frequency, self.values, self.std)
        )
        smear = self.smear
        if smear is not None:
            mean = scipy.sparse.kron(
                scipy.sparse.eye_array(n // together), np.full((1, together), 1 / together)
            )
            smear = (mean @ smear[:n]).tocsr()
        std = np.sqrt(np.sum(std**2, axis=1)) / together
        return replace(
            self, frequency=frequency.mean(axis=1), values=values.mean(axis=1), std=std, smear=smear
        )

    def weight(self, rows: ComplexArray) -> FloatArray:
        """sqrt(2) *rows* (..., n_line) / std, real before imaginary parts: (..., 2 n_line) [1]."""
        weight = 1 / self.std
        return np.sqrt(2) * np.concatenate([rows.real * weight, rows.imag * weight], axis=-1)

    @property
    def width(self) -> float:
        """Width of the band [Hz]."""
        return float(self.frequency[-1] - self.frequency[0])


@dataclass(frozen=True)
class ModeModel:
    """h = resonance(q) + sum of complex amplitudes times columns, on the lines of a curve.

    coefficients: q = ln k, ln c, ln m of 1 / (k + c s + m s^2), without ln m where *mass* is given; else q =
    ln f_n, ln zeta of A / (s - lambda) + A^* / (s - lambda^*), A the first amplitude. residual: Legendre
    terms 1, x, ... of the band. member: a law of MOVED adds ln e, the relative rms motion, SECOND adds ln
    f_2, ln zeta_2 and an amplitude.
    """

    curve: Curve
    coefficients: bool = False
    residual: int = 1
    mass: float | None = None
    member: str = AS_IT_IS

    @cached_property
    def n_interest(self) -> int:
        """Parameters of interest, the first ones."""
        return 3 if self.coefficients and self.mass is None else 2

    @property
    def kept(self) -> list[int]:
        """Places in theta of what is stated: of interest, of a pole its amplitude and first term too."""
        n_linear = 0 if self.coefficients else 2 + 2 * min(self.residual, 1)
        return [*range(self.n_interest), *range(self.n_shape, self.n_shape + n_linear)]

    @cached_property
    def n_shape(self) -> int:
        """Parameters in which the model is not linear."""
        return self.n_interest + bool(self.law) + 2 * self.has_second

    @property
    def has_second(self) -> bool:
        """Whether a second mode stands beside the first."""
        return self.member.startswith(SECOND)

    @cached_property
    def law(self) -> str:
        """By which the resonance moves, "" where it does not."""
        return self.member.removeprefix(SECOND)

    @cached_property
    def terms(self) -> ComplexArray:
        """Residual terms (n_line, n_term) [1]."""
        f = self.curve.frequency
        if not self.residual:
            return np.zeros((f.size, 0), np.complex128)
        x = (2 * f - f[0] - f[-1]) / (f[-1] - f[0])
        return np.polynomial.legendre.legvander(x, self.residual - 1).astype(np.complex128)

    @cached_property
    def _factors(self) -> ComplexArray:
        """Rows (2 n_term, n_line) [1] of the terms by the real and the imaginary part of their factors."""
        terms = self.terms.T
        # Without zeros of negative sign: a QR would follow it.
        return np.stack([terms, 1j * terms], axis=1).reshape(-1, self.curve.frequency.size) + 0

    def frequency_and_damping(self, q: FloatArray) -> tuple[float, float]:
        """f_n [Hz] and zeta [1] at *q* (n,) [1]."""
        rows = self.to_resonance @ q[: self.n_interest] + self.offset
        return float(np.exp(rows[0])), float(np.exp(rows[1]))

    @cached_property
    def to_resonance(self) -> FloatArray:
        """ln f_n and ln zeta of the parameters of interest but for a constant, (2, n_interest) [1]."""
        if not self.coefficients:
            return np.eye(2)
        rows = np.array([[0.5, 0.0, -0.5], [-0.5, 1.0, -0.5]])
        return rows if self.mass is None else rows[:, :2]

    @cached_property
    def offset(self) -> FloatArray:
        """The constants of ln f_n and ln zeta, (2,) [1]."""
        if not self.coefficients:
            return np.zeros(2)
        of_mass = 0.0 if self.mass is None else -0.5 * np.log(self.mass)
        return np.array([of_mass - np.log(2 * np.pi), of_mass - np.log(2)])

    def prior_rows(self, q: FloatArray, n: int) -> FloatArray:
        """Rows T (n_row, n) of the weak prior |T (theta - theta_0)|^2 around an ordinary fit at *q*
        (n_shape,) [1].
        """
        rows = np.zeros((3 if self.n_interest == 3 else 2, n))
        widths = np.array([[self.frequency_and_damping(q)[1]], [PRIOR_DAMPING]])
        rows[:2, : self.n_interest] = self.to_resonance / widths
        if self.n_interest == 3:
            rows[2, [0, 2]] = 0.5 / PRIOR_LEVEL
        return rows

    def _motion(self, q: FloatArray) -> tuple[FloatArray | float, FloatArray | float]:
        """Nodes x (n_node,) of the relative motion and their weights (n_node,) [1]; 0 and 1 at rest."""
        if not self.law:
            return 0.0, 1.0
        nodes, weights = NODES[self.law]
        return np.exp(q[self.n_interest]) * nodes, weights

    @cached_property
    def _plain(self) -> ModeModel:
        return ModeModel(self.curve)

    def _with_conjugate(self, q: FloatArray) -> ComplexArray:
        """Of A a + A^* b: a, the mean of 1 / (s - lambda) over the motion, and b, of the conjugate pole, with
        derivatives by *q* (n_shape,) [1] but for a second mode's, (2, n + 1, n_line).
        """
        w, zeta = 2 * np.pi * np.exp(q[0]), np.exp(q[1])
        x, weights = self._motion(q)
        if self.law == "L":
            root = np.sqrt(max(1 - zeta**2, 1e-12))
            imaginary, ratio, by_motion, lost = root + x, zeta / root, 1j * w * x, 0 * x
        else:
            # 1 / ((1 + x) (s - lambda)), the square of whose frequency moves.
            imaginary = np.sqrt(np.maximum((1 + x) ** 2 - zeta**2, 1e-12))
            ratio, by_motion = zeta * (1 / imaginary), 1j * w * (1 + x) * x * (1 / imaginary)
            lost, weights = -x / (1 + x), weights / (1 + x)
        pole, by_damping = w * (-zeta + 1j * imaginary), -w * zeta * (1 + 1j * ratio) + 0 * x
        # What 1 / (s - lambda) and its square count in the value and its derivatives, (n + 1, n_node).
        n = 3 + bool(self.law)
        single = (weights * np.array([0 * x + 1, 0 * x, 0 * x, lost][:n], np.complex128)).reshape(n, -1)
        square = (weights * np.array([0 * x, pole, by_damping, by_motion][:n])).reshape(n, -1)
        inverse = 1 / (self.curve.s - np.array([pole, np.conj(pole)]).reshape(2, -1, 1))
        return self.curve.lines_of(single @ inverse + np.array([square, square.conj()]) @ inverse**2)

    def _coefficients_at(self, q: FloatArray) -> ComplexArray:
        """The mean of 1 / (k + c s + m s^2) over the motion and its derivatives by *q* (n_shape,) [1] but for
        a second mode's, (n + 1, n_line).
        """
        k, c = np.exp(q[:2])
        m = np.exp(q[2]) if self.mass is None else self.mass
        # Complex as all that they meet.
        x, weights = (np.asarray(part, np.complex128) for part in self._motion(q))
        x, s, stiffness = x[..., None], self.curve.s, k
        if self.law == "L":
            shift = -1j * np.sqrt(k / m) * x
            s = s + shift
        else:
            stiffness = k * (1 + x) ** 2
        s_squared = s**2
        value = 1 / (stiffness + c * s + m * s_squared)
        square = -(value**2)
        rows = [value, square * stiffness, square * c * s, square * m * s_squared][: 1 + self.n_interest]
        if self.law == "L":
            rows.append(square * (c + 2 * m * s) * shift)
            rows[1] += rows[-1] / 2
            if self.mass is None:
                rows[3] -= rows[-1] / 2
        elif self.law:
            rows.append(square * (2 * k) * (1 + x) * x)
        return np.array([weights @ row for row in rows] if self.law else rows)

    def at(self, theta: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """h (n_line,) [any unit], its derivatives (n, n_line) by *theta* (n,), and the resonance of the upper
        pole alone (n_line,).
        """
        n = self.n_shape
        if self.coefficients:
            rows = self._coefficients_at(theta)
            main, slopes, linear = rows[0], [rows[1:]], [self._factors]
        else:
            amplitude = theta[n] + 1j * theta[n + 1]
            a, b = self._with_conjugate(theta)
            main, slopes = amplitude * a[0], [amplitude * a[1:] + np.conj(amplitude) * b[1:]]
            linear = [_pair(a[0], b[0]), self._factors]
        if self.has_second:
            amplitude = theta[-2] + 1j * theta[-1]
            a, b = self._plain._with_conjugate(theta[n - 2 : n])
            slopes.append(amplitude * a[1:] + np.conj(amplitude) * b[1:])
            linear.append(_pair(a[0], b[0]))
        jacobian = np.concatenate(slopes + linear)
        value = jacobian[n:].T.copy() @ theta[n:] + (main if self.coefficients else 0.0)
        return value, jacobian, main

    def start(self, q: FloatArray) -> FloatArray:
        """theta (n,) with the amplitudes of least chi-square for *q* (n_shape,) [1]."""
        n_amplitude = self.residual + (not self.coefficients) + self.has_second
        theta = np.concatenate([q, np.zeros(2 * n_amplitude)])
        value, jacobian, _ = self.at(theta)
        weighted = self.curve.weight
        rows, side = weighted(jacobian[self.n_shape :]), weighted(self.curve.values - value)
        return np.concatenate([q, np.linalg.lstsq(rows.T, side, rcond=None)[0]]) if n_amplitude else theta

    def fit(self, theta: FloatArray) -> Fitted:
        """The ordinary fit, chi2 = 2 sum |y - h|^2 / s^2 [1], from *theta* (n,). FitError where there is no
        minimum.
        """
        weighted, values = self.curve.weight, self.curve.values

        # The derivatives are asked for where the residual was asked for last.
        @lru_cache(1)
        def at(x: bytes) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
            return self.at(np.frombuffer(x))

        def residual(x: FloatArray) -> FloatArray:
            return weighted(values - at(x.tobytes())[0])

        def slopes(x: FloatArray) -> FloatArray:
            return -weighted(at(x.tobytes())[1])

        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # Where there are no numbers, the descent would end as well.
            first = residual(theta)
            if first.size < theta.size or not np.all(np.isfinite(first)):
                raise FitError("the fit has no minimum")
            end, _, more, *_ = scipy.optimize.leastsq(
                residual, theta, Dfun=slopes, full_output=True, col_deriv=True, maxfev=60, **TOLERANCES
            )
        if not np.all(np.isfinite(end)):
            raise FitError("the fit has no minimum")
        return Fitted(self, end, float(more["fvec"] @ more["fvec"]))


def _pair(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    """Rows (2, n_line) of A a + A^* b by the real and the imaginary part of A."""
    return np.array([a + b, 1j * (a - b)])


@dataclass(frozen=True)
class Fitted:
    """A model at its minimum theta (n,), with chi-square [1]; *occam*: ln of prior over posterior volume of
    what an extension adds.
    """

    model: ModeModel
    theta: FloatArray
    chi2: float
    occam: float = 0.0

    @cached_property
    def at_minimum(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """h (n_line,) [any unit], derivatives (n, n_line) and the resonance there, as of ModeModel.at."""
        return self.model.at(self.theta)

    @property
    def dof(self) -> int:
        """2 lines - parameters."""
        return 2 * self.model.curve.frequency.size - self.theta.size

    @property
    def covariance(self) -> FloatArray:
        """Of noise alone, of what the model keeps, (n_kept, n_kept) [1]: (2 Re J^H S^-2 J)^-1."""
        rows = self.model.curve.weight(self.at_minimum[1]).T.copy()
        scale = np.linalg.norm(rows, axis=0)
        inverse = np.linalg.inv((rows / scale).T @ (rows / scale)) / np.outer(scale, scale)
        return inverse[np.ix_(self.model.kept, self.model.kept)]


def extensions(base: Fitted) -> Iterator[Fitted]:
    """The ordinary fits of the named extensions that have one: a second mode, and a resonance that moves."""
    second = second_mode(base)
    if second is not None:
        yield second
    yield from moving_resonances(base)


def moving_resonances(base: Fitted, laws: Sequence[str] = MOVED) -> Iterator[Fitted]:
    """The ordinary fits of a resonance that moves by each of the *laws* beside what *base* holds."""
    zeta = base.model.frequency_and_damping(base.theta)[1]
    n = base.model.n_interest
    for law in laws:
        model = replace(base.model, member=base.model.member + law)
        best: Fitted | None = None
        for share in (0.3, 0.8):
            try:
                fit = model.fit(np.concatenate([base.theta[:n], [np.log(share * zeta)], base.theta[n:]]))
            except FitError:
                continue
            if is_extension(base, model, fit.theta) and (best is None or fit.chi2 < best.chi2):
                best = fit
        if best is not None:
            yield replace(best, occam=base.occam + 0.5 * np.log(2 * np.pi) - np.log(3.5))


def second_beside_moving(base: Fitted, fits: Mapping[str, Fitted]) -> Fitted | None:
    """The ordinary fit of a second mode beside a resonance that moves, from either of these in *fits*."""
    moving = [fit for fit in fits.values() if fit.model.law]
    likely = min(moving, key=lambda fit: fit.chi2, default=base)
    candidates = [second_mode(likely)] if moving else []
    if SECOND in fits:
        candidates += moving_resonances(fits[SECOND], (likely.model.law,) if moving else MOVED)
    usable = [fit for fit in candidates if fit is not None and is_extension(base, fit.model, fit.theta)]
    return min(usable, key=lambda fit: fit.chi2, default=None)


def is_extension(base: Fitted, model: ModeModel, theta: FloatArray) -> bool:
    """Whether a *model* at *theta* (n,) [1] is still *base* with what its member adds: a second mode in the
    band, of like damping, beside one that moved by less than its width; a motion neither longer nor too short
    to be seen.
    """
    # In logarithms, since what runs away would not be a number.
    n, band = model.n_interest, np.log(model.curve.frequency[[0, -1]])
    f_n, zeta = np.log(base.model.frequency_and_damping(base.theta))
    if model.law and not np.log(0.05) < theta[n] - zeta < np.log(3):
        return False
    if not model.has_second:
        return True
    frequency, damping = model.to_resonance @ theta[:n] + model.offset
    f_2, zeta_2 = theta[model.n_shape - 2 : model.n_shape]
    like = abs(zeta_2 - damping) < np.log(LIKE_DAMPING)
    return bool(band[0] <= f_2 <= band[1] and like and abs(frequency - f_n) < 2 * np.exp(zeta))


def half_width(model: ModeModel, q: FloatArray) -> float:
    """The half-power width B = 2 zeta f_n [Hz] at *q* (n,) [1], at least two lines and at most the band."""
    f_n, zeta = model.frequency_and_damping(q)
    spacing = float(np.median(np.diff(model.curve.frequency)))
    return float(np.clip(2 * zeta * f_n, 2 * spacing, model.curve.width))


def second_mode(base: Fitted) -> Fitted | None:
    """The fit with one more mode in the band, from the two best of PLACES; None without a like one."""
    model, n = replace(base.model, member=SECOND + base.model.law), base.model.n_shape
    f_n, zeta = base.model.frequency_and_damping(base.theta)
    frequency, b = base.model.curve.frequency, half_width(base.model, base.theta)
    value, jacobian, _ = base.at_minimum
    weighted = base.model.curve.weight
    rows, side = weighted(jacobian).T, weighted(base.model.curve.values - value)
    basis = np.linalg.qr(rows / np.linalg.norm(rows, axis=0))[0]
    places = np.linspace(frequency[0], frequency[-1], PLACES)
    poles = 2 * np.pi * places * (-zeta + 1j * np.sqrt(max(1 - zeta**2, 1e-12)))
    curve = base.model.curve
    a, b_ = curve.lines_of(1 / (curve.s - np.array([poles, poles.conj()])[..., None]))
    # Of every place two real rows, without what the model has of them: (PLACES, 2, 2 n_line).
    pairs = weighted(_pair(a, b_)).swapaxes(0, 1)
    pairs = pairs - pairs @ basis @ basis.T
    along = pairs @ side
    gains = np.einsum("pi,pij,pj->p", along, np.linalg.pinv(pairs @ pairs.mT), along)
    order = np.argsort(gains)[::-1]
    chosen = [order[0], *[i for i in order if abs(places[i] - places[order[0]]) >= b][:1]]
    fits = []
    for i in chosen:
        q = np.concatenate([base.theta[:n], np.log([places[i], zeta])])
        try:
            fits.append(_nearest_first(model.fit(model.start(q)), f_n))
        except FitError:
            continue
    fits = [fit for fit in fits if is_extension(base, model, fit.theta)]
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit.chi2)
    theta = best.theta
    residue = abs(complex(*theta[n + 2 : n + 4]))
    if model.coefficients:
        k, m = np.exp(theta[0]), np.exp(theta[2]) if model.mass is None else model.mass
        residue = 1 / (2 * np.sqrt(k * m))
    t2 = (0.3 * residue) ** 2 / 2
    size = abs(complex(*theta[-2:])) ** 2
    places_by_prior = base.model.curve.width / np.exp(theta[n]) * 2 * np.log(4)
    occam = np.log(2 * np.pi / t2) - np.log(places_by_prior)
    return replace(best, occam=base.occam + float(occam - min(size / (2 * t2), 20.0)))


def _nearest_first(fit: Fitted, f_n: float) -> Fitted:
    """The same two modes, the one nearer to the old pole first; the residue of the second is 1 / (2 sqrt(k
    m)) of its own.
    """
    theta, model, n = fit.theta, fit.model, fit.model.n_interest
    if not min(model.frequency_and_damping(theta)) > 0:
        return fit
    first, second = np.log(model.frequency_and_damping(theta)), theta[model.n_shape - 2 : model.n_shape]
    if abs(second[0] - np.log(f_n)) >= abs(first[0] - np.log(f_n)):
        return fit
    shape = second
    if model.coefficients:
        w, zeta = 2 * np.pi * np.exp(second[0]), np.exp(second[1])
        m = model.mass or 1 / (2 * w * abs(complex(*theta[-2:])))
        shape = np.log([m * w**2, 2 * zeta * m * w, m][:n])
    return model.fit(model.start(np.concatenate([shape, theta[n : model.n_shape - 2], first])))
