"""Intervals that include the model error: a discrepancy of unknown kind, size and length, averaged with the
weight of its evidence.

y = h(theta) + delta + n on the lines of one FRF, n the measured noise, delta a complex circular Gaussian
course with E delta_i delta_j^* = b_i b_j^* kappa(|f_i - f_j| / l), kappa(u) = (1 + sqrt(3) u) exp(-sqrt(3) u)
(Matern 3/2), of three types: a (b = 1: other modes), m (b = h: gain of sensor or cable), z (b = h^2 of the
resonance: damping law, nonlinearity, drift). Amplitude 0 is the model as it is. Beside the model stand named
extensions: a second mode in the band, and a resonance that moves while it is measured.

(Kennedy and O'Hagan, JRSS B 63 (2001) 425; Brynjarsdottir and O'Hagan, Inverse Problems 30 (2014) 114007.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation import mode_model
from labpipe.estimation.statistics import mixture_interval
from labpipe.records.finding import NORMAL

# Priors of the members.
LADDER = {mode_model.AS_IT_IS: 0.8, mode_model.SECOND: 0.1, **dict.fromkeys(mode_model.MOVED, 0.025)}
# Amplitudes of a discrepancy over noise, and the prior of none.
AMPLITUDES = np.concatenate([[0.0], 10.0 ** np.arange(-1, 4.01, 0.25)])
SOUND = 0.95
# The type of noise that is larger than measured.
WHITE = "n"
# Standard deviations of that prior beyond which a component is not a continuation of the fit.
FARTHEST = 4.0
LINEARISATIONS, LARGEST_STEP, SMALL_STEP = 3, 0.7, 0.02
# The excess of an interval over that of noise counts by this factor.
CALIBRATION = 1.5
# Lines below which, and half-power widths of a band below which, a course cannot be told from the resonance.
FEWEST_LINES, FEWEST_WIDTHS = 20, 3.0


@dataclass(frozen=True)
class DiscrepancyCourse:
    """One type and length [Hz] of a discrepancy beside noise S (I + a^2 K) S: eigenvalues (n_line,) of K, of
    trace n_line, and rotated whitening *rotate* (n_line, n_line) [1 / unit]; *before*: ln det of other noise;
    *amplitudes* a (n_amplitude,) [1].
    """

    kind: str
    length: float
    eigenvalues: FloatArray
    rotate: ComplexArray
    before: float = 0.0
    amplitudes: FloatArray = field(default_factory=lambda: AMPLITUDES)

    @cached_property
    def damped(self) -> FloatArray:
        """d = 1 / (1 + a^2 L) of rotated lines, (n_amplitude, n_line) [1]."""
        return 1 / (1 + np.outer(self.amplitudes**2, self.eigenvalues))

    @cached_property
    def volume(self) -> FloatArray:
        """ln det of all noise (n_amplitude,) [1]."""
        return self.before - np.sum(np.log(self.damped), axis=1)


def matern(first: FloatArray, second: FloatArray, length: float) -> FloatArray:
    """kappa(|f_i - f_j| / l), (n_first, n_second) [1], of frequencies and a *length* l [Hz]."""
    u = np.sqrt(3) * np.abs(first[:, None] - second) / length
    falling = np.exp(-u)
    u += 1
    return u * falling


def _shape(base: mode_model.Fitted, kind: str) -> ComplexArray:
    value, _, main = base.at_minimum
    return {"a": np.ones_like(value), "m": value, "z": main**2}[kind]


def lengths_of(base: mode_model.Fitted) -> dict[str, FloatArray]:
    """Lengths (n_length,) [Hz] of each type."""
    b, w = mode_model.half_width(base.model, base.theta), base.model.curve.width
    return {
        "a": np.geomspace(0.4 * b, 2 * w, 6),
        "m": w * np.array([0.25, 0.5, 1.0, 2.0]),
        "z": b * np.array([0.5, 1.0, 2.0, 4.0]),
    }


def course(base: mode_model.Fitted, kind: str, length: float) -> DiscrepancyCourse:
    """A course beside the measured noise; phases of b only turn the eigenvectors: the problem is real."""
    curve, b = base.model.curve, _shape(base, kind)
    size = np.abs(b) / curve.std
    matrix = matern(curve.frequency, curve.frequency, length) * size * size[:, None]
    matrix *= curve.frequency.size / np.trace(matrix)
    # In LAPACK's order of columns, without a copy.
    values, vectors = linalg.eigh(matrix.T, driver="evd", check_finite=False, overwrite_a=True)
    turned = np.conj(b / np.maximum(np.abs(b), np.finfo(float).tiny)) / curve.std
    return DiscrepancyCourse(kind, length, np.maximum(values, 0.0), vectors.T * turned)


def larger_noise(base: mode_model.Fitted) -> DiscrepancyCourse:
    """Noise larger than the measured one, alike relative to it on all lines: a course without length."""
    size = base.model.curve.frequency.size
    return DiscrepancyCourse(
        WHITE, 0.0, np.ones(size), np.diag(1 / base.model.curve.std).astype(np.complex128)
    )


def courses_beside(
    base: mode_model.Fitted, first: DiscrepancyCourse, amplitude: float, tried: Sequence[tuple[str, float]]
) -> list[DiscrepancyCourse]:
    """Courses as *tried*, none like the *first*, beside the noise and this one of *amplitude* [1]."""
    curve = base.model.curve
    # Whitening of noise and first course: (I + a^2 L)^-1/2 of the rotated, whitened lines.
    whitening = (first.rotate.T / np.sqrt(1 + amplitude**2 * first.eigenvalues)).T
    before = float(np.sum(np.log1p(amplitude**2 * first.eigenvalues)))
    courses = []
    for kind, length in tried:
        if kind == first.kind and abs(length - first.length) < 0.3 * first.length:
            continue
        b = _shape(base, kind)
        white = whitening * b
        matrix = white @ matern(curve.frequency, curve.frequency, length) @ white.conj().T
        # Relative to the measured noise, as a first course is.
        matrix *= curve.frequency.size / float(np.sum(np.abs(b / curve.std) ** 2))
        values, vectors = linalg.eigh(matrix, driver="evd", check_finite=False)
        rotate = vectors.conj().T @ whitening
        name, values = f"+{first.kind}{kind}", np.maximum(values, 0.0)
        courses.append(DiscrepancyCourse(name, length, values, rotate, before, first.amplitudes[1:]))
    return courses


@dataclass(frozen=True)
class MemberEvidence:
    """Of a member with each course: ln of the restricted marginal likelihood (n_course, n_amplitude) [1],
    minus infinity without a solution; mean (n_course, n_amplitude, n_kept) and covariance (n_course,
    n_amplitude, n_kept, n_kept) of what is kept; the ends *theta* (n_course, n) [1].
    """

    log: FloatArray
    mean: FloatArray
    covariance: FloatArray
    theta: FloatArray


def evidence(
    fit: mode_model.Fitted,
    courses: Sequence[DiscrepancyCourse],
    rows: FloatArray,
    steps: int,
    begin: FloatArray | None = None,
) -> MemberEvidence:
    """Linear-Gaussian evidence around the fit, or *begin* (n,), linearised again up to *steps* times where it
    is greatest.

    F = 2 Re(J^H d J) + P, g = 2 Re(J^H d r) + P (theta_0 - theta), d = 1 / (1 + a^2 L) on rotated lines, P =
    T^T T of the prior's *rows* T (n_row, n) [1]; ln E = -sum ln(1 + a^2 L) - r^H d r - (theta_0 - theta)^T P
    (theta_0 - theta) / 2 + g^T F^-1 g / 2 - ln det F / 2.
    """
    model, n, kept, prior = fit.model, fit.model.n_interest, fit.model.kept, rows.T @ rows
    theta = np.tile(fit.theta if begin is None else begin, (len(courses), 1))
    log = np.full((len(courses), courses[0].amplitudes.size), -np.inf)
    mean = np.zeros((*log.shape, len(kept)))
    covariance = np.zeros((*mean.shape, len(kept)))
    going, start = np.arange(len(courses)), fit.at_minimum if begin is None else model.at(begin)
    for step in range(steps):
        linear = (
            _linearise(courses[i], fit, theta[i], model.at(theta[i]) if step else start, prior)
            for i in going.tolist()
        )
        scale, f, g, marginal = (np.array(part) for part in zip(*linear, strict=True))
        sign, log_det = np.linalg.slogdet(f)
        # What has run away, or has no solution, is no component.
        usable = np.all(np.isfinite(scale), axis=1) & np.all(sign != 0, axis=1)
        log[going[~usable]] = -np.inf
        going, scale, f, g, marginal, sign, log_det = (
            part[usable] for part in (going, scale, f, g, marginal, sign, log_det)
        )
        inverse = np.linalg.inv(f)
        move = np.einsum("capq,caq->cap", inverse, g)
        marginal += 0.5 * np.sum(g * move, axis=2) - 0.5 * log_det
        marginal = np.where(sign > 0, marginal - np.sum(np.log(scale), axis=1)[:, None], -np.inf)
        move /= scale[:, None]
        inverse /= (scale[:, :, None] * scale[:, None])[:, None]
        # Without a course the fit is the minimum: seen from anywhere else it is off, and looks likelier.
        new = slice(int(step > 0 and begin is None and courses[0].amplitudes[0] == 0), None)
        log[going, new] = marginal[:, new]
        mean[going, new] = (theta[going, None] + move)[:, new, kept]
        covariance[going, new] = inverse[:, new, kept][..., kept]
        best = np.argmax(log[going], axis=1)
        change = move[np.arange(going.size), best]
        largest = np.max(np.abs(change[:, :n]), axis=1)
        change *= np.minimum(1.0, LARGEST_STEP / np.maximum(largest, 1e-300))[:, None]
        theta[going] += change
        variance = np.diagonal(covariance[going, best], axis1=1, axis2=2)[:, :n]
        small = np.max(np.abs(change[:, :n]), axis=1) < SMALL_STEP * np.sqrt(np.min(variance, axis=1))
        going = going[~small]
        if not going.size:
            break
    return MemberEvidence(log, mean, covariance, theta)


def _linearise(
    of: DiscrepancyCourse,
    fit: mode_model.Fitted,
    theta: FloatArray,
    at: tuple[ComplexArray, ...],
    prior: FloatArray,
) -> tuple[FloatArray, ...]:
    """Lengths of the columns of J (n,), not finite if run away; F (n_amplitude, n, n) and g (n_amplitude, n)
    over them; what of ln E needs no solution (n_amplitude,).
    """
    r, j = of.rotate @ (fit.model.curve.values - at[0]), of.rotate @ at[1].T
    scale, away = np.sqrt(np.sum(np.abs(j) ** 2, axis=0)), fit.theta - theta
    if not np.all(scale > 0) or not np.all(np.isfinite(r)):
        scale = np.full(scale.size, np.nan)
    columns = np.ascontiguousarray((j / scale).T)
    turned = columns.conj()
    products = (turned[:, None] * columns).real.reshape(-1, r.size)
    of_prior = prior * np.outer(1 / scale, 1 / scale)
    f = 2 * (of.damped @ products.T).reshape(-1, scale.size, scale.size) + of_prior
    g = 2 * (of.damped @ (turned * r).real.T) + (prior @ away) / scale
    return scale, f, g, -of.volume - of.damped @ np.abs(r) ** 2 - 0.5 * away @ prior @ away


@dataclass(frozen=True)
class Mixture:
    """The parameters of interest with noise and model error, as a mixture of normal distributions.

    Components of these *names* (member and type, "+" beside a second course, "" for the model as it is) have
    *weights* (n_component,) [1], means (n_component, n_kept) and covariances (n_component, n_kept, n_kept)
    [1]; *noise*: covariance (n_kept, n_kept) by noise alone; *base*: the ordinary fit; second: frequency of a
    second mode [Hz], motion: relative rms of the resonance's, if any.
    """

    names: Sequence[str]
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    noise: FloatArray
    base: mode_model.Fitted
    second: float | None = None
    motion: float | None = None

    def interval(self, row: FloatArray) -> tuple[float, float, float]:
        """Mean, 2.5 and 97.5 % of the mixture of *row* (n_kept,) [any unit] times what is kept."""
        means, deviations = np.vecdot(self.means, row), np.sqrt(np.vecdot(row @ self.covariances, row))
        return float(self.weights @ means), *mixture_interval(self.weights, means, deviations)

    @property
    def sound(self) -> float:
        """Share of the evidence for the model as it is, beside noise as measured [1]."""
        return self.shares.get("none", 0.0)

    def stated_interval(self, row: FloatArray) -> tuple[float, float, float]:
        """The interval of *row* (n_kept,) [any unit] whose excess over that of noise counts by CALIBRATION:
        d_* = sqrt(d^2 + (1.5^2 - 1) max(d^2 - d_A^2, 0)).
        """
        centre, low, high = self.interval(row)
        by_noise = NORMAL * float(np.sqrt(row @ self.noise @ row))
        sides, growth = (centre - low, high - centre), CALIBRATION**2 - 1
        below, above = (float(np.sqrt(d**2 + growth * max(d**2 - by_noise**2, 0.0))) for d in sides)
        return centre, centre - below, centre + above

    @property
    def shares(self) -> dict[str, float]:
        """Posterior weight by the names of components, "none" for the model as it is."""
        shares: dict[str, float] = {}
        for name, weight in zip(self.names, self.weights, strict=True):
            shares[name or "none"] = shares.get(name or "none", 0.0) + float(weight)
        return shares


@dataclass(frozen=True)
class Settled(Mixture):
    """A mixture with the same mode in *others*: other bands, other terms. Equation (modal-settled)."""

    others: tuple[Mixture, ...] = ()

    def stated_interval(self, row: FloatArray) -> tuple[float, float, float]:
        """Of *row* (n_kept,) [any unit] the mixture of N(c, (h / 1.96)^2) over them all, h the half-width of
        each, with weights 1 / (h^2 + median h^2): its mean, 2.5 and 97.5 %.
        """
        ends = np.array(
            [super().stated_interval(row), *(other.stated_interval(row) for other in self.others)]
        )
        centres, reach = (ends[:, 1] + ends[:, 2]) / 2, (ends[:, 2] - ends[:, 1]) / 2
        weights = 1 / (reach**2 + np.median(reach) ** 2)
        weights /= np.sum(weights)
        return float(weights @ ends[:, 0]), *mixture_interval(weights, centres, reach / NORMAL)


def settle(first: Mixture, others: tuple[Mixture, ...]) -> Mixture:
    """The mixture, with *others* of the same mode beside it where there are any."""
    if not others:
        return first
    return Settled(**vars(first), others=others)


def mixture(base: mode_model.Fitted) -> Mixture:
    """Every member of the ladder beside the ordinary fit *base* with every course, weighted by evidence and
    prior. FitError where band or lines do not tell a course from the resonance. Equation (unc-discrepancy).
    """
    model = base.model
    b = mode_model.half_width(model, base.theta)
    if model.curve.frequency.size < FEWEST_LINES or model.curve.width < FEWEST_WIDTHS * b:
        raise FitError("the band is too narrow to tell a model error from the resonance")
    courses, priors = [larger_noise(base)], [np.log(3)]
    for kind, lengths in lengths_of(base).items():
        courses += [course(base, kind, float(length)) for length in lengths]
        priors += [np.log(3 * lengths.size)] * lengths.size
    amplitude_prior = np.where(AMPLITUDES == 0, np.log(SOUND), np.log((1 - SOUND) / (AMPLITUDES.size - 1)))
    fits = {base.model.member: base} | {fit.model.member: fit for fit in mode_model.extensions(base)}
    ladder = {member: LADDER[member] / sum(LADDER[other] for other in fits) for member in fits}

    def scan(fit: mode_model.Fitted, prior: float) -> _Scan:
        priors_of = (np.log(prior) + fit.occam - np.array(priors))[:, None] + amplitude_prior
        return _scan(base, fit, courses, priors_of)

    scans = [scan(fit, ladder[member]) for member, fit in fits.items()]
    best = max(scans, key=lambda scan: np.max(scan.log))
    if not np.isfinite(np.max(best.log)):
        raise FitError("no course of a model error continues the fit")
    together = (
        mode_model.second_beside_moving(base, fits) if best.likeliest[1] or best.fit.model.member else None
    )
    if together is not None:
        scans.append(scan(together, LADDER[mode_model.SECOND] ** 2))
        best = max(scans, key=lambda scan: np.max(scan.log))
    if best.likeliest[1]:
        scans.append(_second_scan(base, best))
    names, logs, means, covariances = (
        np.concatenate(parts) for parts in zip(*(scan.components for scan in scans), strict=True)
    )
    weights = np.exp(logs - special.logsumexp(logs))
    keep = weights > 1e-9
    weights, names = weights[keep] / np.sum(weights[keep]), names[keep].tolist()
    members = np.array([name[:1] for name in names])
    laws = [law for law in mode_model.MOVED if law in fits]
    likely = max(laws, key=lambda law: float(np.sum(weights[members == law])), default=None)
    second, motion = (
        float(np.exp(fits[member].theta[model.n_interest])) if member in fits else None
        for member in (mode_model.SECOND, likely)
    )
    return Mixture(names, weights, means[keep], covariances[keep], base.covariance, base, second, motion)


@dataclass(frozen=True)
class _Scan:
    """A *fit* with *courses*: ln of *prior* and weights (n_course, n_amplitude) [1], minus infinity where
    there is none.
    """

    fit: mode_model.Fitted
    courses: Sequence[DiscrepancyCourse]
    prior: FloatArray
    evidence: MemberEvidence
    log: FloatArray

    @property
    def likeliest(self) -> tuple[int, float]:
        """Course and amplitude [1] of the greatest weight."""
        place, number = np.unravel_index(np.argmax(self.log), self.log.shape)
        return int(place), float(self.courses[0].amplitudes[number])

    @property
    def components(self) -> tuple[NDArray[np.str_], FloatArray, FloatArray, FloatArray]:
        """Names, ln of weights [1], means and covariances of the components, as of Mixture."""
        member, chosen = self.fit.model.member, self.log > -np.inf
        names = [[member + of.kind] for of in self.courses]
        names_of_all = np.where(self.courses[0].amplitudes > 0, names, member)
        return (
            names_of_all[chosen],
            self.log[chosen],
            self.evidence.mean[chosen],
            self.evidence.covariance[chosen],
        )


def _scan(
    base: mode_model.Fitted,
    fit: mode_model.Fitted,
    courses: Sequence[DiscrepancyCourse],
    prior: FloatArray,
    begin: FloatArray | None = None,
) -> _Scan:
    """A *fit* with *courses*, without components that have no solution or are far from the ordinary one."""
    n, rows = base.model.n_interest, base.model.prior_rows(base.theta, fit.theta.size)
    # What runs away is sorted out below.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        judged = evidence(fit, courses, rows, LINEARISATIONS if begin is None else 2, begin)
        away = np.abs((judged.mean[..., :n] - base.theta[:n]) @ rows[:, :n].T)
        # What an extension adds may vanish, or leave its range: its volume is not evidence then.
        inside = np.array([mode_model.is_extension(base, fit.model, theta) for theta in judged.theta])
    usable = inside[:, None] & np.isfinite(judged.log) & np.all(away <= FARTHEST, axis=2)
    usable &= np.all(np.diagonal(judged.covariance, axis1=2, axis2=3) > 0, axis=2)
    return _Scan(fit, courses, prior, judged, np.where(usable, judged.log + prior, -np.inf))


def _second_scan(base: mode_model.Fitted, best: _Scan) -> _Scan:
    b, w = mode_model.half_width(base.model, base.theta), base.model.curve.width
    of_modes = [("a", b), ("a", np.sqrt(2 * b * w)), ("a", 2 * w)]
    tried = [*of_modes, ("m", 0.5 * w), ("m", 2 * w), ("z", b), ("z", 3 * b)]
    place, amplitude = best.likeliest
    courses = courses_beside(base, best.courses[place], amplitude, tried)
    prior = best.prior[place, -1:] + np.log(3 / 7 / 7 / (AMPLITUDES.size - 1))
    return _scan(base, best.fit, courses, prior, best.evidence.theta[place])
