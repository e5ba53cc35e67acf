"""Intervals that include the model error: a discrepancy of unknown kind, size and length, averaged with the
weight of its evidence.

y = h(theta) + delta + n on the lines of one FRF, n the measured noise, delta a complex circular Gaussian
course with E delta_i delta_j^* = b_i b_j^* kappa(|f_i - f_j| / l), kappa(u) = (1 + sqrt(3) u) exp(-sqrt(3) u)
(Matern 3/2), of three types: a (b = 1: other modes), m (b = h: gain of sensor or cable), z (b = h^2 of the
resonance: damping law, nonlinearity, drift). Amplitude 0 is the model as it is. Beside the model stand named
extensions: a second mode in the band, and a resonance that moves while it is measured.

Bayesian model averaging of a discrepancy (Kennedy and O'Hagan, JRSS B 63 (2001) 425; Brynjarsdottir and
O'Hagan, Inverse Problems 30 (2014) 114007).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import linalg, special

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation.mode_model import (
    AS_IT_IS,
    MOVED,
    SECOND,
    Fitted,
    extensions,
    half_width,
    is_extension,
    second_beside_moving,
)
from labpipe.estimation.statistics import mixture_interval

# Priors of the members.
LADDER = {AS_IT_IS: 0.8, SECOND: 0.1, **dict.fromkeys(MOVED, 0.025)}
# Amplitudes of a discrepancy over noise, and the prior of none.
AMPLITUDES = np.concatenate([[0.0], 10.0 ** np.arange(-1, 4.01, 0.25)])
SOUND = 0.95
# The type of noise that is larger than measured.
WHITE = "n"
# Standard deviations of that prior beyond which a component is no continuation of the fit.
FARTHEST = 4.0
LINEARISATIONS, LARGEST_STEP, SMALL_STEP = 3, 0.7, 0.02
# The excess of an interval over that of noise counts by this factor.
CALIBRATION = 1.5
NORMAL = float(special.ndtri(0.975))
# Lines below which, and half-power widths of a band below which, a course cannot be told from the resonance.
FEWEST_LINES, FEWEST_WIDTHS = 20, 3.0


# Courses of a discrepancy, and what the data say of each.


@dataclass(frozen=True)
class Course:
    """One type and length [Hz] of a discrepancy beside noise S (I + a^2 K) S: eigenvalues (n_line,) of K,
    which has trace n_line, and *rotate*, the rotated whitening (n_line, n_line) [1 / unit]; *before*: ln det
    of what else the noise holds.
    """

    kind: str
    length: float
    eigenvalues: FloatArray
    rotate: ComplexArray
    before: float = 0.0


def matern(first: FloatArray, second: FloatArray, length: float) -> FloatArray:
    """kappa(|f_i - f_j| / l), (n_first, n_second) [1], of frequencies and a *length* l [Hz]."""
    u = np.sqrt(3) * np.abs(first[:, None] - second) / length
    return np.asarray((1 + u) * np.exp(-u))


def _shape(base: Fitted, kind: str) -> ComplexArray:
    """b (n_line,) of a type at the ordinary fit."""
    value, _, main = base.at_minimum
    return {"a": np.ones_like(value), "m": value, "z": main**2}[kind]


def lengths_of(base: Fitted) -> dict[str, FloatArray]:
    """Lengths (n_length,) [Hz] of each type."""
    b, w = half_width(base.model, base.theta), base.model.curve.width
    return {
        "a": np.geomspace(0.4 * b, 2 * w, 6),
        "m": w * np.array([0.25, 0.5, 1.0, 2.0]),
        "z": b * np.array([0.5, 1.0, 2.0, 4.0]),
    }


def course(base: Fitted, kind: str, length: float) -> Course:
    """A course beside the measured noise.

    The phases of b only turn the eigenvectors, so the problem is real.
    """
    curve, b = base.model.curve, _shape(base, kind)
    size = np.abs(b) / curve.std
    matrix = size[:, None] * matern(curve.frequency, curve.frequency, length) * size
    values, vectors = linalg.eigh(
        matrix * (curve.frequency.size / np.trace(matrix)), driver="evd", check_finite=False
    )
    turned = np.conj(b / np.maximum(np.abs(b), np.finfo(float).tiny)) / curve.std
    return Course(kind, length, np.maximum(values, 0.0), vectors.T * turned)


def larger_noise(base: Fitted) -> Course:
    """Noise larger than the measured one, alike relative to it on all lines: a course without length."""
    size = base.model.curve.frequency.size
    return Course(WHITE, 0.0, np.ones(size), np.diag(1 / base.model.curve.std).astype(np.complex128))


def course_beside(base: Fitted, first: Course, amplitude: float, kind: str, length: float) -> Course:
    """A course beside the noise and a first one of that *amplitude* [1]."""
    curve, b = base.model.curve, _shape(base, kind)
    # Whitening of noise and first course: (I + a^2 L)^-1/2 of the rotated, whitened lines.
    whitening = (first.rotate.T / np.sqrt(1 + amplitude**2 * first.eigenvalues)).T
    matrix = (whitening * b) @ matern(curve.frequency, curve.frequency, length) @ (whitening * b).conj().T
    # Relative to the measured noise, as a first course is.
    scale = curve.frequency.size / float(np.sum(np.abs(b / curve.std) ** 2))
    values, vectors = linalg.eigh(matrix * scale, driver="evd", check_finite=False)
    before = float(np.sum(np.log1p(amplitude**2 * first.eigenvalues)))
    return Course(kind, length, np.maximum(values, 0.0), vectors.conj().T @ whitening, before)


@dataclass(frozen=True)
class Evidence:
    """What the data say of a member with a course at all amplitudes (n_amplitude,): ln of the restricted
    marginal likelihood [1], mean (n_amplitude, n_kept) and covariance (n_amplitude, n_kept, n_kept) of what
    the model keeps; *theta* (n,) [1]: where it ended.
    """

    log: FloatArray
    mean: FloatArray
    covariance: FloatArray
    theta: FloatArray


def evidence(
    fit: Fitted,
    of: Course,
    amplitudes: FloatArray,
    rows: FloatArray,
    steps: int,
    begin: FloatArray | None = None,
) -> Evidence:
    """Linear-Gaussian evidence around the fit, or *begin* (n,), linearised again up to *steps* times where it
    is greatest.

    F = 2 Re(J^H d J) + P, g = 2 Re(J^H d r) + P (theta_0 - theta), d = 1 / (1 + a^2 L) on rotated lines, P =
    T^T T of the prior's *rows* T (n_row, n) [1]; ln E = -sum ln(1 + a^2 L) - r^H d r - (theta_0 - theta)^T P
    (theta_0 - theta) / 2 + g^T F^-1 g / 2 - ln det F / 2.
    """
    model, start, n, kept = fit.model, fit.theta, fit.model.n_interest, fit.model.kept
    prior = rows.T @ rows
    damped = 1 / (1 + np.outer(amplitudes**2, of.eigenvalues))
    volume = of.before - np.sum(np.log(damped), axis=1)
    theta, as_it_is = start if begin is None else begin, None
    for step in range(steps):
        value, jacobian, _ = fit.at_minimum if begin is None and step == 0 else model.at(theta)
        r, j = of.rotate @ (model.curve.values - value), of.rotate @ jacobian.T
        scale = np.sqrt(np.sum(np.abs(j) ** 2, axis=0))
        if not np.all(np.isfinite(scale)) or not np.all(scale > 0) or not np.all(np.isfinite(r)):
            raise FitError("a component of the discrepancy has run away")
        j = j / scale
        products = (j.conj()[:, :, None] * j[:, None, :]).real.reshape(r.size, -1)
        away = start - theta
        f = 2 * (damped @ products).reshape(-1, scale.size, scale.size)
        f += prior * np.outer(1 / scale, 1 / scale)
        g = 2 * (damped @ (j.conj() * r[:, None]).real) + (prior @ away) / scale
        try:
            inverse = np.linalg.inv(f)
        except np.linalg.LinAlgError:
            raise FitError("a component of the discrepancy has no solution") from None
        move = np.einsum("apq,aq->ap", inverse, g)
        sign, log_det = np.linalg.slogdet(f)
        log = -volume - damped @ np.abs(r) ** 2 - 0.5 * away @ prior @ away
        log += 0.5 * np.sum(g * move, axis=1) - 0.5 * log_det
        log = np.where(sign > 0, log - np.sum(np.log(scale)), -np.inf)
        covariance = inverse[:, kept][:, :, kept] / np.outer(scale[kept], scale[kept])
        result = Evidence(log, theta[kept] + move[:, kept] / scale[kept], covariance, theta)
        if begin is None and amplitudes[0] == 0:
            # Without a course the fit is the minimum: seen from anywhere else it is off, and looks likelier.
            as_it_is = as_it_is or result
            result.log[0], result.mean[0] = as_it_is.log[0], as_it_is.mean[0]
            covariance[0] = as_it_is.covariance[0]
        best = int(np.argmax(log))
        change = move[best] / scale
        change = change * min(1.0, LARGEST_STEP / max(float(np.max(np.abs(change[:n]))), 1e-300))
        result = replace(result, theta=theta + change)
        deviation = np.sqrt(np.diag(covariance[best])[:n])
        if np.max(np.abs(change[:n])) < SMALL_STEP * np.min(deviation):
            break
        theta = theta + change
    return result


@dataclass(frozen=True)
class Component:
    """A member with a course at one amplitude: ln of its weight, mean (n_kept,) and covariance (n_kept,
    n_kept) of what is kept [1].
    """

    member: str
    kind: str
    amplitude: float
    log_weight: float
    mean: FloatArray
    covariance: FloatArray
    theta: FloatArray


@dataclass(frozen=True)
class Mixture:
    """The parameters of interest with noise and model error, as a mixture of normal distributions.

    components with *weights* (n_component,) [1]; *noise*: covariance (n_kept, n_kept) by noise alone; at: the
    ordinary fit; second: frequency of a second mode [Hz], motion: relative rms motion of the resonance, each
    where its member has weight.
    """

    components: tuple[Component, ...]
    weights: FloatArray
    noise: FloatArray
    base: Fitted
    second: float | None = None
    motion: float | None = None

    def interval(self, row: FloatArray) -> tuple[float, float, float]:
        """Mean, lower and upper end of *row* (n_kept,) [any unit] times what is kept: 2.5 and 97.5 % of the
        mixture.
        """
        means = np.array([component.mean @ row for component in self.components])
        deviations = np.sqrt([row @ component.covariance @ row for component in self.components])
        return float(self.weights @ means), *mixture_interval(self.weights, means, deviations)

    @property
    def sound(self) -> float:
        """Share of the evidence for the model as it is, beside noise as measured [1]."""
        return self.shares.get("none", 0.0)

    def stated(self, row: FloatArray) -> tuple[float, float, float]:
        """The interval of *row* (n_kept,) [any unit] whose excess over that of noise counts by CALIBRATION:
        d_* = sqrt(d^2 + (1.5^2 - 1) max(d^2 - d_A^2, 0)).
        """
        centre, low, high = self.interval(row)
        by_noise = NORMAL * float(np.sqrt(row @ self.noise @ row))
        below, above = (
            float(np.sqrt(d**2 + (CALIBRATION**2 - 1) * max(d**2 - by_noise**2, 0.0)))
            for d in (centre - low, high - centre)
        )
        return centre, centre - below, centre + above

    @property
    def shares(self) -> dict[str, float]:
        """Posterior weight by member and type: "J" with "a", "+" beside a second course.

        Amplitude 0 is "none".
        """
        shares: dict[str, float] = {}
        for component, weight in zip(self.components, self.weights, strict=True):
            name = component.member + (component.kind if component.amplitude else "")
            shares[name or "none"] = shares.get(name or "none", 0.0) + float(weight)
        return shares


@dataclass(frozen=True)
class Settled(Mixture):
    """A mixture with the same mode in *others*: other bands, other terms. Equation (modal-settled)."""

    others: tuple[Mixture, ...] = ()

    def stated(self, row: FloatArray) -> tuple[float, float, float]:
        """Of *row* (n_kept,) [any unit] the mixture of N(c, (h / 1.96)^2) over them all, h the half-width of
        each, with weights 1 / (h^2 + median h^2): its mean, 2.5 and 97.5 %.
        """
        ends = np.array([super().stated(row), *(other.stated(row) for other in self.others)])
        centres, reach = (ends[:, 1] + ends[:, 2]) / 2, (ends[:, 2] - ends[:, 1]) / 2
        weights = 1 / (reach**2 + np.median(reach) ** 2)
        weights /= np.sum(weights)
        return float(weights @ ends[:, 0]), *mixture_interval(weights, centres, reach / NORMAL)


def settle(first: Mixture, others: tuple[Mixture, ...]) -> Mixture:
    """The mixture, with *others* of the same mode beside it where there are any."""
    if not others:
        return first
    parts = {field.name: getattr(first, field.name) for field in fields(first)}
    return Settled(**parts, others=others)


def mixture(base: Fitted) -> Mixture:
    """Every member of the ladder with every course at every amplitude, weighted by evidence and prior.

    *base*: the ordinary fit. FitError where the band is too narrow, or the lines too few, for a course to be
    told from the resonance. Equation (unc-discrepancy).
    """
    model = base.model
    b = half_width(model, base.theta)
    if model.curve.frequency.size < FEWEST_LINES or model.curve.width < FEWEST_WIDTHS * b:
        raise FitError("the band is too narrow to tell a model error from the resonance")
    by_kind = lengths_of(base)
    courses = [larger_noise(base)]
    courses += [course(base, kind, float(length)) for kind, of_kind in by_kind.items() for length in of_kind]
    counts = {WHITE: 1} | {kind: len(lengths) for kind, lengths in by_kind.items()}
    amplitude_prior = np.where(AMPLITUDES == 0, np.log(SOUND), np.log((1 - SOUND) / (AMPLITUDES.size - 1)))
    fits = {base.model.member: base} | {fit.model.member: fit for fit in extensions(base)}
    ladder = {member: LADDER[member] / sum(LADDER[other] for other in fits) for member in fits}
    components: list[Component] = []
    sources: list[tuple[Fitted, Course]] = []

    def add(member: str, fit: Fitted) -> None:
        rows = model.prior_rows(base.theta, fit.theta.size)
        for of in courses:
            prior = np.log(ladder[member]) + fit.occam - np.log(3 * counts[of.kind])
            parts = _components(
                member, of.kind, fit, of, AMPLITUDES, rows, prior + amplitude_prior, LINEARISATIONS, base
            )
            components.extend(parts)
            sources.extend([(fit, of)] * len(parts))

    for member, fit in fits.items():
        add(member, fit)
    if not components:
        raise FitError("no course of a model error continues the fit")
    best = int(np.argmax([component.log_weight for component in components]))
    explained = components[best].amplitude > 0 or components[best].member
    together = second_beside_moving(base, fits) if explained else None
    if together is not None:
        ladder[together.model.member] = LADDER[SECOND] ** 2
        add(together.model.member, together)
        best = int(np.argmax([component.log_weight for component in components]))
    if components[best].amplitude > 0:
        components.extend(
            _second_courses(base, *sources[best], components[best], float(amplitude_prior[1]), ladder)
        )
    logs = np.array([component.log_weight for component in components])
    weights = np.exp(logs - special.logsumexp(logs))
    keep = weights > 1e-9
    kept = tuple(component for component, chosen in zip(components, keep, strict=True) if chosen)
    weights = weights[keep] / np.sum(weights[keep])
    second = float(np.exp(fits[SECOND].theta[model.n_interest])) if SECOND in fits else None
    members = np.array([component.member for component in kept])
    by_law = {law: float(np.sum(weights[members == law])) for law in MOVED if law in fits}
    likely = max(by_law, key=lambda law: by_law[law], default="")
    motion = float(np.exp(fits[likely].theta[model.n_interest])) if likely else None
    return Mixture(kept, weights, base.covariance, base, second, motion)


def _components(
    member: str,
    kind: str,
    fit: Fitted,
    of: Course,
    amplitudes: FloatArray,
    rows: FloatArray,
    priors: FloatArray,
    steps: int,
    base: Fitted,
    begin: FloatArray | None = None,
) -> list[Component]:
    """The components of a member with a course.

    None where it has no solution, and without those far from the ordinary fit.
    """
    try:
        # What runs away is sorted out below.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            judged = evidence(fit, of, amplitudes, rows, steps, begin)
            # What an extension adds may vanish, or leave its range: its volume is no evidence then.
            if not is_extension(base, fit.model, judged.theta):
                return []
    except FitError:
        return []
    n = base.model.n_interest
    away = np.abs((judged.mean[:, :n] - base.theta[:n]) @ rows[:, :n].T)
    usable = (
        np.isfinite(judged.log)
        & np.all(away <= FARTHEST, axis=1)
        & np.all(np.einsum("aii->ai", judged.covariance) > 0, axis=1)
    )
    return [
        Component(
            member,
            kind,
            float(amplitudes[i]),
            float(judged.log[i] + priors[i]),
            judged.mean[i],
            judged.covariance[i],
            judged.theta,
        )
        for i in np.flatnonzero(usable)
    ]


def _second_courses(
    base: Fitted,
    fit: Fitted,
    first: Course,
    best: Component,
    amplitude_prior: float,
    ladder: Mapping[str, float],
) -> list[Component]:
    """A second course beside the best one, which is frozen."""
    b, w = half_width(base.model, base.theta), base.model.curve.width
    of_modes = [("a", b), ("a", np.sqrt(2 * b * w)), ("a", 2 * w)]
    tried = [*of_modes, ("m", 0.5 * w), ("m", 2 * w), ("z", b), ("z", 3 * b)]
    counts = {WHITE: 1} | {kind: len(lengths) for kind, lengths in lengths_of(base).items()}
    prior = np.log(ladder[fit.model.member]) + fit.occam - np.log(3 * counts[first.kind]) + amplitude_prior
    prior += np.log(3 / 7 / 7 / (AMPLITUDES.size - 1))
    rows = base.model.prior_rows(base.theta, fit.theta.size)
    components: list[Component] = []
    begin = best.theta
    for kind, length in tried:
        if kind == first.kind and abs(length - first.length) < 0.3 * first.length:
            continue
        of = course_beside(base, first, best.amplitude, kind, float(length))
        priors = np.full(AMPLITUDES.size - 1, prior)
        name = f"+{first.kind}{kind}"
        components.extend(
            _components(fit.model.member, name, fit, of, AMPLITUDES[1:], rows, priors, 2, base, begin)
        )
    return components
